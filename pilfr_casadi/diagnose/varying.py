"""Whether a mismatch that no law explains is a machine that changed, between recordings or in the time of each.

One set of values for every recording is put up against one for each, or one for the first halves and one for the
second. Where these follow far better, what differs is said; why, only the engineer knows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._base import InputError
from ..data import Recording
from ..simulators import states_along
from .floor import effective_size
from .gates import Gate
from .proof import deviations
from .search import Search
from .standing import opened_at_the_start
from .workbench import Fitted, Workbench

SHARE = 0.25  # of the mean square that values of their own leave at most
ROOM = 12.0  # nats that they have to gain beyond what their number costs
CLEARLY = 5.0  # standard errors by which a value differs
NAMED = 3  # values told

Group = tuple[str, Sequence[Recording], Sequence[np.ndarray]]  # what it is called, recordings, and first states


def varying(search: Search) -> tuple[Gate, ...]:
    """A note on what differs between the recordings, or else between the halves of each."""
    bench, whole = search.bench, search.root.fitted
    if search.interrupted or not np.any(whole.model.parameters.free):
        return ()
    try:
        for groups, where in ((_each(bench, whole), "the recordings"), (_halves(bench, whole), "the halves")):
            found = _told(search, groups, where) if len(groups) > 1 else None
            if found is not None:
                return (found,)
    except KeyboardInterrupt:
        search.interrupted = True
    return ()


def _each(bench: Workbench, whole: Fitted) -> list[Group]:
    names = [r.name or f"recording {i + 1}" for i, r in enumerate(bench.recordings)]
    return [(n, (r,), (x,)) for n, r, x in zip(names, bench.recordings, whole.initial, strict=True)]


def _halves(bench: Workbench, whole: Fitted) -> list[Group]:
    first, second, middle = list[Recording](), list[Recording](), list[np.ndarray]()
    for r, x in zip(bench.recordings, whole.initial, strict=True):
        cut = (r.skip + len(r)) // 2
        first.append(opened_at_the_start(r.slice(0, cut)))
        second.append(opened_at_the_start(r.slice(cut)))
        middle.append(states_along(whole.model, whole.model.drive(r), whole.vector, x)[cut * whole.model.substeps])
    return [("first", first, whole.initial), ("second", second, middle)]


def _told(search: Search, groups: Sequence[Group], where: str) -> Gate | None:
    bench, whole = search.bench, search.root.fitted
    fits, benches = list[Fitted](), list[Workbench]()
    for _, recordings, states in groups:
        part = bench.on(recordings)
        try:
            fitted = part.fit(whole.simulator, [whole.values], states=states, model=whole.model, engine=whole.engine)
        except InputError:
            return None
        fits.append(fitted)
        benches.append(part)
    sizes = [sum(len(r) - r.skip for r in part.recordings) for part in benches]
    cost = float(np.average([f.cost for f in fits], weights=sizes))
    begun = sum(len(part.recordings) for part in benches) - len(bench.recordings)
    more = whole.model.parameters.free.sum() * (len(fits) - 1) + len(whole.initial[0]) * begun
    n = effective_size([e for f in fits for e in f.residual])
    gained = 0.5 * n * np.log(whole.cost / max(cost, search.floor2)) - 0.5 * more * np.log(max(n, 2.0))
    if cost > SHARE * whole.cost or gained < ROOM:
        return None
    values = _apart(whole, fits, benches)
    if not values:
        return None
    listed = "; ".join(f"{name}: {' / '.join(f'{v:.4g}' for v in found)}" for name, found in values)
    called = " / ".join(name for name, *_ in groups)
    sentence = (
        f"With values of their own, {where} ({called}) are followed to {cost**0.5:.3g} of the outputs' deviation "
        f"instead of {whole.cost**0.5:.3g} ({listed}): something differs between them, such as a setting, a "
        "temperature or a level that the simulator does not know."
    )
    return Gate(", ".join(name for name, _ in values), "varying", [v for _, v in values], sentence, False)


def _apart(whole: Fitted, fits: Sequence[Fitted], benches: Sequence[Workbench]) -> list[tuple[str, list[float]]]:
    """Parameters whose values differ most clearly, most first."""
    spreads = [deviations(part, f) for part, f in zip(benches, fits, strict=True)]
    out = list[tuple[float, str, list[float]]]()
    for name, p in whole.simulator.parameters.items():
        if np.size(p.value) != 1 or np.all(p.fixed):
            continue
        values = [float(np.ravel(f.values[name])[0]) for f in fits]
        errors = [float(np.ravel(s[name])[0]) for s in spreads]
        error = np.sqrt(np.nanmean(np.square(errors))) if np.any(np.isfinite(errors)) else np.inf
        clear = np.ptp(values) / max(error, 1e-300)
        if clear > CLEARLY:
            out.append((clear, name, values))
    return [(name, values) for _, name, values in sorted(out, reverse=True)[:NAMED]]
