"""Errors and parameters before and after the correction, the placebo test of a law, and the next experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from .._base import multiple
from ..data import Recording, nrmse
from ..engine import make_engine
from ..identify import run_free
from ..laws import Law
from ..models import Model
from ..optimise import StatePrior
from ..simulators import Simulator, discretise
from .faults.gates import Gate, edited, value_with_unit
from .fits.evidence import BETTER_RATIO
from .fits.floor import effective_size
from .fits.linearise import linearise_runs, simulate_states
from .fits.screen import RIDGES, Remainder, held_out
from .fits.workbench import Fitted, Workbench

PRIOR_SAMPLES = 20_000  # samples of the training runs at most, about, that a prior of initial states is taken from
AMPLITUDES = (0.1, 0.3, 1.0)  # amplitudes tried, as shares of the largest
SINES, TRIANGLES = 12, 5  # frequencies that are tried
LONGEST_EXPERIMENT = 3000  # longest simulated experiment, in samples
LEAST_MOTION = 0.5  # deviation of an output's scored samples over that of all, below which it hardly moves
VISIBLE_LEVEL = 0.1  # mean of an input over its amplitude, above which a sentence states it
VISIBLE_DIFFERENCE = 0.01  # difference of two answers over the noise, above which a recording shows it


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


def next_experiment(
    bench: Workbench,
    one: Fitted,
    other: Fitted,
    noise: np.ndarray,
    limits: Mapping[str, float] | None = None,
    rivals: str = "the two",
) -> dict[str, Any] | None:
    """Find the input that separates two fitted explanations, the `rivals`, best.

    `noise` (n_y,) is the deviation of the outputs' noise; `limits` are the largest amplitudes of inputs, by default
    such that they stay within their recorded range. Returns `input`, `waveform`, `level` (its mean), `amplitude`,
    `frequency` (Hz), `separation` (rms difference over the noise), `recorded` (the separation in the recordings) and
    `sentence`; None if nothing within the limits separates them better than the recordings do.
    """
    u = bench.stacked_inputs
    m = min(max(map(len, bench.recordings)), LONGEST_EXPERIMENT)
    rest = np.median(u, axis=0)
    best: dict[str, Any] | None = None
    swings = np.zeros(len(noise))

    def simulated(drive: np.ndarray) -> list[np.ndarray]:
        recording = bench.recordings[0].with_(
            u=drive, y=np.zeros((len(drive), len(noise))), initial="zero", period=None, skip=0
        )
        with np.errstate(all="ignore"):
            return [f.simulate(recording, np.zeros(f.model.n_state)) for f in (one, other)]

    def separation(y: Sequence[np.ndarray]) -> float:
        with np.errstate(all="ignore"):
            value = float(np.sqrt(np.mean(((y[0] - y[1]) / np.maximum(noise, 1e-300)) ** 2)))
        return value if np.isfinite(value) else 0.0

    for i, name in enumerate(bench.simulator.inputs):
        low, high = float(np.min(u[:, i])), float(np.max(u[:, i]))
        most = (limits or {}).get(name, (high - low) / 2)
        for waveform, f, wave in _waves(m, bench.dt):
            for share in AMPLITUDES:
                amplitude, drive = share * most, np.tile(rest, (m, 1))
                # near its usual value, but within what was recorded: many inputs, such as a heater's, have one sign
                least, largest = sorted((low + amplitude, high - amplitude))
                level = float(np.clip(rest[i], least, largest))
                drive[:, i] = level + amplitude * wave
                y = simulated(drive)
                value = separation(y)
                if best is None or value > BETTER_RATIO * best["separation"]:
                    best = {
                        "input": name,
                        "waveform": waveform,
                        "level": level,
                        "amplitude": amplitude,
                        "frequency": f,
                        "separation": value,
                    }
                    swings = np.max([np.ptp(one, axis=0) for one in y], axis=0)
    if best is None or best["separation"] < 1.0:
        return None
    recorded = max(separation(simulated(r.u[:m])) for r in bench.recordings)
    if best["separation"] < BETTER_RATIO * recorded:
        return None
    sentence = _describe_experiment(bench, best, recorded, rivals) + _describe_travel(bench, swings)
    return {**best, "recorded": recorded, "sentence": sentence}


def _waves(m: int, dt: float) -> Iterator[tuple[str, float, np.ndarray]]:
    """Generate the waveforms to try: name, frequency in Hz, and `m` samples of unit amplitude."""
    t = np.arange(m) * dt
    for f in np.geomspace(4 / (m * dt), 0.2 / dt, SINES).tolist():
        yield "sine", f, np.sin(2 * np.pi * f * t)
    for f in np.geomspace(2 / (m * dt), 0.02 / dt, TRIANGLES).tolist():
        yield "triangle", f, 2 / np.pi * np.arcsin(np.sin(2 * np.pi * f * t))


def _describe_experiment(bench: Workbench, best: Mapping[str, Any], recorded: float, rivals: str) -> str:
    """Describe an experiment; `recorded` is the separation in the recordings."""
    unit = bench.unit_of(best["input"])
    so_far = f"by {multiple(recorded)} times" if recorded > VISIBLE_DIFFERENCE else "not at all"
    about = abs(best["level"]) > VISIBLE_LEVEL * best["amplitude"]
    swing = value_with_unit(best["amplitude"], unit)
    level = f" about {value_with_unit(best['level'], unit)}" if about else ""
    return (
        f"A {best['waveform']} of {best['frequency']:.3g} Hz with amplitude {swing}{level} at "
        f"{best['input']} separates {rivals} best: their outputs then differ by {best['separation']:.3g} times the "
        f"noise (in these recordings {so_far})."
    )


def _describe_travel(bench: Workbench, swings: np.ndarray) -> str:
    """Warn of the output that would leave most the range over which it was recorded, if one would."""
    known = np.max([np.ptp(r.y, axis=0) for r in bench.recordings], axis=0)
    i = int(np.argmax(swings / np.maximum(known, 1e-300)))
    if not swings[i] > known[i]:
        return ""
    name = bench.simulator.output_names[i]
    unit = bench.unit_of(name)
    return (
        f" By the simulation {name} would vary over {value_with_unit(swings[i], unit)}; in these recordings it varies "
        f"over {value_with_unit(known[i], unit)}."
    )


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
