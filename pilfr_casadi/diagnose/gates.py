"""Faults of whole channels, looked for first: sign, unit, exchange, unit of time; and the choice of the hold.

Each is a change of the recordings; it counts when the simulator, refitted, follows the changed recordings far better
than the given ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from .._base import InputError, side_by_side
from ..data import Recording
from ..engine import make_engine
from ..optimise import GaussNewton
from .workbench import QUICK, Fitted, Workbench

Change = Callable[[Recording], Recording]
Trial = tuple[str, str, Any, Change]  # channel, finding, value, what puts it right
# metric prefixes, degrees, standard gravity, revolutions a minute, km/h, bar, minutes, pounds, inches to mm and m, psi
UNITS = (1e3, 1e6, 1e2, 180 / np.pi, 9.80665, 30 / np.pi, 3.6, 1e5, 60.0, 4.4482216, 25.4, 1 / 0.0254, 6894.757)
FAHRENHEIT = 1.8  # its zero is another one: it comes with an offset
FACTORS = tuple(f for unit in UNITS for f in (unit, 1 / unit))
GLANCE = GaussNewton(max_iterations=20, tolerance=1e-2, patience=3)
# mean square error that a wrong unit of time leaves at least, and where it has driven parameters to their bounds
HOPELESS, STRAINED = 0.1, 0.01
MOST_AT_BOUNDS = 0.3  # share of the parameters at their bounds, beyond which a unit of time has bent the simulator
CURED = 0.12  # share of the mean square that a sign or a unit put right leaves at most
SEVERAL = 0.8  # share of the mean square that one channel in another unit leaves, for all to be
NEAR = 6.0  # a factor is tried where it brings the simulated and the measured size this near


@dataclass(frozen=True)
class Gate:
    """One finding about a channel; `fault` where it is a fault of the recording rather than a note."""

    channel: str
    finding: str
    value: Any
    sentence: str
    corrected: bool
    fault: bool = False
    change: Change | None = None
    parameter: str = ""
    left: float = 1.0  # share of the mean square error that is left once it is put right

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as in diagnosis.json."""
        keys = ("channel", "finding", "value", "sentence", "corrected")
        return {k: getattr(self, k) for k in keys}


def scaled(kind: str, index: int | list[int], factor: float) -> Change:
    """Multiply one channel, or several."""

    def change(r: Recording) -> Recording:
        values = np.array(getattr(r, kind))
        values[:, index] *= factor
        return r.with_(**{kind: values})

    return change


def exchanged(kind: str, one: int, other: int) -> Change:
    """Exchange two channels."""

    def change(r: Recording) -> Recording:
        values = np.array(getattr(r, kind))
        values[:, [one, other]] = values[:, [other, one]]
        return r.with_(**{kind: values})

    return change


def shifted(kind: str, index: Sequence[int], seconds: float, rate: float = 0.0, cut: bool = True) -> Change:
    """Read some channels at `t + seconds + rate t`, interpolated.

    Samples read from before the recording are skipped, samples from behind it are cut off; without `cut`, the ends are
    held. A periodic recording goes round.
    """

    def change(r: Recording) -> Recording:
        values, at = np.array(getattr(r, kind)), r.t * (1 + rate) + seconds
        end = len(r) * r.dt if r.period and len(r) % r.period == 0 and not rate else None
        for i in index:
            values[:, i] = _read(r.t, values[:, i], at, end, smooth=kind == "y")
        other = r.with_(**{kind: values})
        if kind == "y" and r.begins == "zero":  # at rest when it was said to be
            other = other.with_(initial="estimate")
        if end is not None or not cut:
            return other
        early, late = int(np.sum(at < 0)), int(np.sum(at > r.t[-1] + 1e-9 * r.dt))
        if early:
            other = other.with_(skip=min(max(r.skip, early), len(r) - 2))
        return other.slice(0, max(len(r) - late, other.skip + 2)) if late else other

    return change


def _read(t: np.ndarray, v: np.ndarray, at: np.ndarray, end: float | None, smooth: bool) -> np.ndarray:
    """Interpolate a signal: an output along a cubic spline, an input along its chords; ends are held."""
    if not smooth:
        return np.interp(at, t, v, period=end)
    from scipy.interpolate import CubicSpline

    if end is None:
        return np.asarray(CubicSpline(t, v)(np.clip(at, t[0], t[-1])))
    return np.asarray(CubicSpline(np.append(t, end), np.append(v, v[0]), bc_type="periodic")(at))


def slower_by(factor: float) -> Change:
    """Multiply the time."""
    return lambda r: r.with_(dt=r.dt * factor)


def opened_at_the_start(r: Recording) -> Recording:
    """Leave the initial state of a periodic recording that is not on its steady cycle to be estimated."""
    return r.with_(initial="estimate", period=None) if r.begins == "periodic" else r


def changed(bench: Workbench, change: Change) -> Workbench:
    """Return the bench with changed recordings, errors in units of their own deviation."""
    recordings = tuple(change(r) for r in bench.recordings)
    scale = np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
    return replace(bench, recordings=recordings, scale=scale)


def refit(
    bench: Workbench,
    previous: Fitted | None = None,
    solver: GaussNewton = QUICK,
    within: float = np.inf,
    same: Fitted | None = None,
) -> Fitted | None:
    """Fit the simulator from the user's values and from a previous fit; `same` lends its compiled model.

    Returns None where it diverges, or does not come within the mean square error `within`.
    """
    starts: list[dict[str, Any]] = [{}]
    if previous is not None:
        starts.append(previous.values)
    try:
        model, engine = (same.model, same.engine) if same else (None, None)
        states = () if previous is None else previous.begin
        found = bench.fit(bench.simulator, starts, states=states, solver=solver, model=model, engine=engine)
    except InputError:
        return None
    return found if found.cost < within else None


def said_hold(simulator: Any, recordings: Sequence[Recording], said: str | None) -> str | None:
    """Return the hold that the user, the simulator or a recording states; None if none does."""
    return next((h for h in (said, simulator.hold, *(r.hold for r in recordings)) if h is not None), None)


def choose_hold(
    simulator: Any, recordings: tuple[Recording, ...], said: str | None, engine: str
) -> tuple[str, list[Gate]]:
    """Choose the hold: as stated, else the one that fits better."""
    known = said_hold(simulator, recordings, said)
    if known is not None:
        return known, []
    errors = {}
    for hold in ("zero", "linear"):
        try:
            found = refit(Workbench.of(simulator, recordings, hold, engine))
        except InputError:  # said again, or put right, where the bench is opened for good
            return "zero", []
        errors[hold] = np.inf if found is None else found.cost
    best = "linear" if errors["linear"] < errors["zero"] else "zero"
    ratio = np.sqrt(max(errors.values()) / max(min(errors.values()), 1e-300))
    return (best, [hold_note(simulator, best, ratio)]) if ratio >= 1.02 else ("zero", [])


def hold_note(simulator: Any, hold: str, ratio: float) -> Gate:
    """Note that the hold was chosen from the data; the other's error is `ratio` times as large."""
    words = {"zero": "held over each sample", "linear": "interpolated between samples"}
    why = f"fits better (error {ratio:.3g} times smaller)"
    return Gate(
        ", ".join(simulator.inputs),
        "hold",
        hold,
        f"The recordings do not say what inputs do between samples; {words[hold]} {why} and is used.",
        True,
    )


def opened(simulator: Any, recordings: tuple[Recording, ...], hold: str, engine: str) -> tuple[Workbench, list[Gate]]:
    """Make the bench; if the simulator is too fast for the recordings' step, with the time in another unit.

    Raises
    ------
    InputError
        If no unit of time makes simulator and recordings fit each other.
    """
    try:
        return Workbench.of(simulator, recordings, hold, engine), []
    except InputError as error:
        for factor in (1e-3, 1 / 60, 1e-6, 1 / 3600):
            slower = tuple(r.with_(dt=r.dt * factor) for r in recordings)
            try:
                bench = Workbench.of(simulator, slower, hold, engine)
            except InputError:
                continue
            found = refit(bench)
            if found is not None and found.cost < 0.25:
                words = (
                    f"The time of the recordings is off by a factor of {1 / factor:.4g}, as from a wrong unit: as "
                    f"given, the simulator cannot follow at all; corrected, its error is {found.cost**0.5:.3g} of the "
                    "outputs' deviation."
                )
                return bench, [Gate("time", "time-unit", factor, words, True, True, slower_by(factor))]
        raise error


def slips(bench: Workbench, plain: Fitted, workers: int, beside: str = "") -> tuple[Workbench, Fitted, list[Gate]]:
    """Try sign and unit slips of each channel and of the time, and exchanged channels, `workers` at a time.

    With `beside`, only slips of that channel are tried, beside the offset that it has already.
    """
    trials: list[Trial] = []
    # beside an offset there is a working point, which a run from rest would first have to come to
    sizes = _sizes(bench, plain.residual if beside else _from_rest(bench))
    lost = plain.cost > 1  # a size says nothing where a simulator has left its working range
    factors = (*FACTORS, FAHRENHEIT, 1 / FAHRENHEIT) if beside else FACTORS
    for i, name in enumerate(bench.simulator.output_names):
        trials.append((name, "sign", -1.0, scaled("y", i, -1.0)))
        trials += [(name, "unit", f, scaled("y", i, f)) for f in factors if lost or _near(f * sizes[i])]
    for i, name in enumerate(bench.simulator.inputs):
        trials.append((name, "sign", -1.0, scaled("u", i, -1.0)))
        trials += [(name, "unit", f, scaled("u", i, f)) for f in factors if lost or any(_near(v / f) for v in sizes)]
    names = bench.simulator.output_names
    for f in FACTORS if len(names) > 1 else ():
        if lost or all(_near(f * size) for size in sizes):
            trials.append((", ".join(names), "unit", f, scaled("y", list(range(len(names))), f)))
    if beside:
        return _best_slip(bench, plain, [t for t in trials if t[0] == beside], workers, " and an offset")
    for kind, names in (("y", bench.simulator.output_names), ("u", bench.simulator.inputs)):
        for i, j in combinations(range(len(names)), 2) if plain.cost > STRAINED else ():
            trials.append((f"{names[i]}, {names[j]}", "exchange", [names[i], names[j]], exchanged(kind, i, j)))
    hopeless = plain.cost > (STRAINED if plain.at_bounds > MOST_AT_BOUNDS else HOPELESS)
    for factor in (1e-3, 1e3, 60.0, 1 / 60) if hopeless else ():
        trials.append(("time", "time-unit", factor, slower_by(factor)))
    return _best_slip(bench, plain, trials, workers)


def _best_slip(
    bench: Workbench, plain: Fitted, trials: Sequence[Trial], workers: int, more: str = ""
) -> tuple[Workbench, Fitted, list[Gate]]:
    """Take the trial after which the simulator follows best, if that is far better than without."""
    best, found = plain, None
    channels = (*bench.simulator.inputs, *bench.simulator.output_names)

    def tried(trial: Trial) -> tuple[Workbench, Fitted | None]:
        other: Workbench = changed(bench, trial[3])
        same: Fitted | None = plain
        if trial[1] == "time-unit":
            try:
                other, same = Workbench.of(bench.simulator, other.recordings, bench.hold, bench.engine), None
            except InputError:
                return other, None
        near = refit(other, solver=GLANCE, within=plain.cost, same=same)
        return other, None if near is None else refit(other, near, same=near)

    for trial, (other, result) in zip(trials, side_by_side(tried, trials, workers), strict=True):
        bent = trial[1] == "time-unit" and result is not None and result.at_bounds > MOST_AT_BOUNDS
        # for a linear simulator, a unit of all outputs is one of its input
        clearly = SEVERAL if trial[1] == "unit" and trial[0] not in channels else 1.0
        if result is not None and result.cost < clearly * best.cost and not bent:
            best, found = result, (*trial, other)
    if found is None or best.cost > CURED * plain.cost or best.cost > 0.3:
        return bench, plain, []
    name, finding, value, change, other = found
    if finding == "sign":
        words = f"{name} has the wrong sign{more}"
    elif finding == "exchange":
        words = f"{value[0]} and {value[1]} are exchanged"
    else:
        what, be = (name, "are" if name not in channels else "is") if finding == "unit" else ("the time", "is")
        words = f"{what} {be} off by a factor of {1 / value:.4g}{more}, as from a wrong unit"
    sentence = (
        f"In the recordings {words}: with it corrected the refitted simulator's error falls from "
        f"{np.sqrt(plain.cost):.3g} to {np.sqrt(best.cost):.3g} of the outputs' deviation."
    )
    left = best.cost / plain.cost
    return other, best, [Gate(name, finding, value, sentence, True, True, change, left=left)]


def _sizes(bench: Workbench, errors: Sequence[np.ndarray]) -> np.ndarray:
    """Compute the size of each measured output over the simulated one's; nan where the simulation diverges."""
    with np.errstate(all="ignore"):
        y = [e + r.y for e, r in zip(errors, bench.recordings, strict=True)]
        return np.asarray(bench.scale / np.std(np.concatenate(y), axis=0))


def _from_rest(bench: Workbench) -> list[np.ndarray]:
    """Compute the errors of the simulator at the user's values, run from rest."""
    model = bench.model(bench.simulator)
    engine = make_engine(model, bench.engine)
    start, n = model.parameters.start, model.n_state
    with np.errstate(all="ignore"):
        return [engine.simulate(model.drive(r), start, np.zeros(n))[0] - r.y for r in bench.recordings]


def _near(ratio: float) -> bool:
    return not np.isfinite(ratio) or ratio == 0 or 1 / NEAR < ratio < NEAR
