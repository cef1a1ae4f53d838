"""Errors and parameters before and after the correction, the placebo test of a law, and where test data go beyond."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from .._base import in_words, percent
from ..data import Recording, nrmse
from ..engine import make_engine
from ..identify import run_free
from ..laws import Law
from ..models import Model
from ..optimise import StatePrior
from ..simulators import Simulator, discretise
from .faults.gates import Gate, edited, value_with_unit
from .fits.evidence import BEYOND_RANGE, NEW_DENSITY, NEW_SHARE
from .fits.floor import effective_size
from .fits.linearise import linearise_runs, simulate_states
from .fits.screen import RIDGES, Remainder, held_out
from .fits.workbench import Fitted, Workbench

PRIOR_SAMPLES = 20_000  # samples of the training runs at most, about, that a prior of initial states is taken from
LEAST_MOTION = 0.5  # deviation of an output's scored samples over that of all, below which it hardly moves
ROUNDED = 1e-6  # change of a channel, over its size, that counts as none
LONGEST_SEGMENT = 512  # samples from which a spectral density is computed


@dataclass(frozen=True)
class Comparison:
    """NRMSEs of models, averaged over recordings, and the recordings with the first sample that is scored in each.

    `unedited` is the error of the corrected simulator on test recordings as given, if edits were compared with that.
    """

    errors: dict[str, float]
    scored: tuple[tuple[Recording, int], ...]
    unedited: float = np.inf

    def find_resting(self) -> list[tuple[str, int]]:
        """List (name, first scored sample) of the recordings that hardly move from there on.

        Samples before served to estimate the initial state. Relative errors on the rest are large.
        """
        found = []
        for r, first in self.scored:
            whole, scored = (np.std(r.y[k:], axis=0) for k in (r.skip, first))
            found += [(r.name, first)] if np.any(scored < LEAST_MOTION * whole) else []
        return found

    def noise(self, deviation: np.ndarray, resting: np.ndarray) -> float:
        """Compute the NRMSE of noise with the deviations (n_y,); `resting` is the scale of an output that rests."""
        return float(np.mean([nrmse(r.y, r.y + deviation, first, resting) for r, first in self.scored]))


def errors_of(bench: Workbench, model: Model) -> float:
    """Compute the NRMSE of a model at its start values on all samples; see `compare_errors`."""
    return compare_errors(bench, {"": Started(model)}, whole=True).errors[""]


def compare_errors(bench: Workbench, models: Mapping[str, Started], *, whole: bool = False) -> Comparison:
    """Compute the errors of models at their start values on the same samples.

    Unknown initial states are estimated from rest and from the models' further initial states, with the models'
    priors, on a first part that is not scored; it is the longest that a model needs. With `whole` they are fitted
    to all samples, which are all scored; use it to compare errors on training recordings with fits. An error is
    infinite if the simulation diverges.
    """
    engines = {name: make_engine(one.model, bench.engine) for name, one in models.items()}
    errors: dict[str, list[float]] = {name: [] for name in models}
    scored = list[tuple[Recording, int]]()
    for r in bench.recordings:
        runs = {
            name: run_free(one.model, engines[name], r, one.starts, whole=whole, known=one.known)
            for name, one in models.items()
        }
        first = max((skip for _, skip in runs.values()), default=0)
        scored.append((r, first))
        for name, (y, _) in runs.items():
            finite = np.all(np.isfinite(y))
            errors[name].append(nrmse(r.y, y, skip=first, resting=bench.scale) if finite else np.inf)
    return Comparison({name: float(np.mean(each)) for name, each in errors.items()}, tuple(scored))


@dataclass(frozen=True, eq=False)
class Started:
    """A model with what is known of its initial state in a recording that it was not fitted to."""

    model: Model
    starts: Sequence[np.ndarray] = ()  # further initial states to try
    known: StatePrior | None = None

    @classmethod
    def of(cls, model: Model, fitted: Fitted, bench: Workbench | None = None) -> Started:
        """Take the first initial state of a fit, and the prior if its bench is given.

        From rest alone a search may end in a wrong minimum, for example beside a contact. A learned element is
        uncertain at rest, outside its range; with one, the initial states of all recordings are taken.
        """
        learned = any(e.law.id == "learned" for e in fitted.simulator.elements)
        starts = fitted.initial if learned else fitted.initial[:1]
        return cls(model, starts, None if bench is None else prior_of(bench, fitted))


@lru_cache(maxsize=4)
def prior_of(bench: Workbench, fitted: Fitted) -> StatePrior | None:
    """Return the prior of a further recording's initial state from a fit's runs; None if it has no state."""
    most = max(PRIOR_SAMPLES // len(bench.recordings), 2)
    runs = zip(bench.recordings, fitted.initial, strict=True)
    with np.errstate(all="ignore"):
        states = np.concatenate([simulate_states(fitted, r.slice(0, most), state) for r, state in runs])
    if not states.shape[1]:
        return None
    residuals = bench.scored(fitted.residual)
    errors = np.concatenate(residuals)
    return StatePrior.of(states, errors, max(len(errors) / effective_size(residuals), 1.0))


def test_errors(
    bench: Workbench, tests: Sequence[Recording], gates: Sequence[Gate], fits: Mapping[str, Fitted], given: Model
) -> Comparison:
    """Compute the errors of fits, on the sub-steps that they were fitted on, and of the `given` model as "nominal".

    The fits see the test recordings with the gates' edits, the given model as they are; so does the fit "after" once
    more (`unedited`). All are scored on the same samples, unless an edit changes these.
    """
    known = bench if any(r.begins == "estimate" for r in edited(tests, gates)) else None
    models = {name: Started.of(fitted.fitted_model, fitted, known) for name, fitted in fits.items()}
    nominal = {"nominal": Started(given)}
    if all(g.change is None for g in gates):
        return compare_errors(bench.on(tests), {**nominal, **models})
    found = compare_errors(bench.on(edited(tests, gates)), models)
    as_given = compare_errors(bench.on(tests), {**nominal, "after": models["after"]}).errors
    return replace(found, errors={**as_given, **found.errors}, unedited=as_given["after"])


def free_run_errors(
    bench: Workbench, recordings: Sequence[Recording], simulator: Simulator, without: Fitted, after: Fitted
) -> dict[str, float]:
    """Compute the NRMSEs without an observer, on corrected recordings."""
    models = {}
    for name, fitted in {"nominal": without, "before": without, "after": after}.items():
        one = simulator if name == "nominal" else fitted.corrected()
        free = discretise(replace(one, observer=None), bench.dt, bench.hold, fitted.model.substeps)
        models[name] = Started.of(free, fitted)
    return compare_errors(bench.on(recordings), models).errors


def parameter_table(
    simulator: Simulator, without: Fitted, after: Fitted, std: dict[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Make the table of values (nominal, refitted without and with the effects) for diagnosis.json."""
    out = {}
    for name, p in simulator.parameter_set.items():
        error = np.asarray(std.get(name, np.nan))
        out[name] = {
            "nominal": p.value,
            "refit_without": without.values[name],
            "refit_with": after.values[name],
            "std": None if np.all(np.isnan(error)) else error,
            "unit": p.unit,
        }
    return out


def placebo(bench: Workbench, fitted: Fitted, port: str, law: Law) -> tuple[float, float]:
    """Compute the held-out share of the residual that a law explains with its own signal, and with an unrelated one.

    The unrelated signal is the law's own force, shifted by half a recording: it has the same statistics but no relation
    to the residual.
    """
    rest = Remainder.of(bench, *linearise_runs(bench, fitted), [type(law)], at=port)
    if not rest.tasks:
        return 0.0, 0.0
    own, unrelated = (rest.columns(rest.tasks[0], shifted)[0] for shifted in (False, True))
    return held_out(own, rest.left, rest.odd, RIDGES), held_out(unrelated, rest.left, rest.odd, RIDGES)


# where the corrected simulator extrapolates


def range_note(bench: Workbench, tests: Sequence[Recording]) -> Iterator[Gate]:
    """Note the channels of the test recordings with values or frequencies that the training recordings do not have."""
    simulator, trained, words = bench.simulator, bench.recordings, list[str]()
    names = (*simulator.inputs, *simulator.output_names)
    both = (np.concatenate([np.hstack([r.u, r.y])[r.skip :] for r in each]) for each in (trained, tests))
    for i, value, limit in ranges_left(*both):
        reached, known = (value_with_unit(v, bench.unit_of(names[i])) for v in (value, limit))
        words.append(f"{names[i]} reaches {reached} ({known} in training)")
    for i, name in enumerate(simulator.inputs):
        before, now = ([r.u[r.skip :, i] for r in each] for each in (trained, tests))
        share = share_at_new_frequencies(before, now, bench.dt)
        if share > NEW_SHARE:
            words.append(f"{percent(share)} of {name} is at frequencies that it hardly has in training")
    if words:
        advice = "There the corrected simulator extrapolates; train it on recordings like these, too."
        sentence = f"The test recordings go beyond the training recordings: {in_words(words)}. {advice}"
        yield Gate("recordings", "test range", None, sentence, False)


def ranges_left(trained: np.ndarray, tested: np.ndarray) -> list[tuple[int, float, float]]:
    """Find channels that leave their trained range by more than a tenth: number, farthest value, limit of the range.

    Both signals have one column for each channel.
    """
    found = []
    for i, (known, signal) in enumerate(zip(trained.T, tested.T, strict=True)):
        low, high, least, most = (float(f(x)) for x in (known, signal) for f in (np.min, np.max))
        value, limit = (most, high) if most - high > low - least else (least, low)
        beyond = max(most - high, low - least)
        if beyond > max(BEYOND_RANGE * (high - low), ROUNDED * max(abs(low), abs(high))):
            found.append((i, value, limit))
    return found


def share_at_new_frequencies(trained: Sequence[np.ndarray], tested: Sequence[np.ndarray], dt: float) -> float:
    """Compute the share of a signal's variance at frequencies that have 100 times less of the trained one's variance.

    Each signal has one array (M,) for each recording.
    """
    from scipy.signal import welch

    if all(np.ptp(u) <= ROUNDED * np.max(np.abs(u)) for u in tested):
        return 0.0
    length = min(LONGEST_SEGMENT, *map(len, trained), *map(len, tested))
    known, now = (
        np.average([welch(u, 1 / dt, nperseg=length)[1] for u in signals], axis=0, weights=[len(u) for u in signals])
        for signals in (trained, tested)
    )
    known, now = (density / max(np.sum(density), 1e-300) for density in (known, now))
    return float(np.sum(now[known < NEW_DENSITY * now]))
