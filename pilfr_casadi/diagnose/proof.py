"""Errors and parameters before and after the correction, the placebo test of a law, and the next experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..data import Recording, nrmse
from ..engine import Engine, make_engine
from ..laws import Law
from ..models import Model
from ..optimise import first_state, samples_for_state
from ..simulators import Simulator
from .evidence import information_matrix
from .floor import effective_size
from .gates import Gate
from .linearise import linearised
from .remainder import Remainder, held_out
from .workbench import Fitted, Workbench


def mean_nrmse(bench: Workbench, fitted: Fitted) -> float:
    """Compute the NRMSE averaged over outputs and recordings."""
    pairs = zip(fitted.residual, bench.recordings, strict=True)
    return float(np.mean([nrmse(r.y, r.y + e, skip=r.skip) for e, r in pairs]))


def run_free(
    model: Model, engine: Engine, recording: Recording, starts: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, int]:
    """Simulate a model at its start values along a recording.

    An unknown initial state is fitted to the first part of the recording, starting from rest and from `starts`.

    Returns
    -------
    array, shape (M, n_y)
        Simulated outputs; not finite where the simulation diverges.
    int
        First scored sample: the part that the state is fitted to is left out.
    """
    estimated = recording.begins == "estimate" and model.n_state > 0
    used = min(samples_for_state(model), len(recording) // 3) if estimated else 0
    with np.errstate(all="ignore"):
        try:
            state = first_state(model, engine, recording, used or None, starts=starts)
            y = engine.simulate(model.drive(recording), model.parameters.start, state)[0]
        except (RuntimeError, FloatingPointError):  # a quadratic program of huge numbers
            y = np.full(recording.y.shape, np.nan)
    return np.asarray(y), max(recording.skip, used)


def errors_of(bench: Workbench, model: Model, starts: Sequence[np.ndarray] = ()) -> float:
    """Compute the NRMSE of a model at its start values, averaged over recordings; infinite if the simulation diverges.

    Unknown initial states are sought from rest and from `starts`.
    """
    engine = make_engine(model, bench.engine)
    errors = []
    for r in bench.recordings:
        y, skip = run_free(model, engine, r, starts)
        if not np.all(np.isfinite(y)):
            return np.inf
        errors.append(nrmse(r.y, y, skip=skip))
    return float(np.mean(errors))


def starts_of(fitted: Fitted) -> list[np.ndarray]:
    """Return further initial states to try, for learned elements that are uncertain at rest, out of their range."""
    learned = any(e.law.id == "learned" for e in fitted.simulator.elements)
    return fitted.initial if learned else []


def test_errors(
    bench: Workbench,
    tests: Sequence[Recording],
    gates: Sequence[Gate],
    simulator: Simulator,
    without: Fitted,
    after: Fitted,
) -> dict[str, float]:
    """Compute the NRMSE on test recordings: unedited for the nominal simulator, with the gates' edits for the others.

    Fits are judged on the sub-steps that they were fitted on.
    """
    out = {"nominal": errors_of(bench.on(tests), bench.on(tests).model(simulator))}
    for g in gates:
        if g.change is not None:
            tests = [g.change(r) for r in tests]
    for name, one in (("before", without), ("after", after)):
        out[name] = errors_of(
            bench.on(tests), one.model.with_parameters(one.model.parameters.at(one.vector)), starts_of(one)
        )
    return out


def deviations(bench: Workbench, fitted: Fitted) -> dict[str, np.ndarray]:
    """Compute standard errors from the residual and its correlation time; nan for fixed parameters and at bounds.

    Initial states are estimated together with the parameters.
    """
    problem, hessian = information_matrix(bench, fitted)
    full = np.full(fitted.model.parameters.size, np.nan)
    if np.all(np.isfinite(hessian)):  # a run at the edge of divergence has no derivatives
        inside = (problem.start > problem.lower) & (problem.start < problem.upper)
        keep = np.flatnonzero(inside & (np.diag(hessian) > 0))
        size = np.sqrt(np.maximum(np.diag(hessian)[keep], 1e-300))
        scaled = hessian[np.ix_(keep, keep)] / np.outer(size, size)
        inverse = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) / np.outer(size, size)
        variances = np.maximum(np.diag(inverse), 0) * fitted.cost / max(effective_size(fitted.residual), 10.0)
        own = keep < problem.n_free
        full[np.flatnonzero(problem.free)[keep[own]]] = np.sqrt(variances[own])
    return fitted.model.parameters.unpack(full)


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


SHARES = (0.1, 0.3, 1.0)  # amplitudes tried, as shares of the largest
SINES = 12  # frequencies of sines that are tried
MOST_SAMPLES = 3000  # longest simulated experiment, in samples


def next_experiment(
    bench: Workbench, one: Fitted, other: Fitted, noise: np.ndarray, limits: Mapping[str, float] | None = None
) -> dict[str, Any] | None:
    """Find the input that separates two fitted explanations best.

    Parameters
    ----------
    noise : array, shape (n_y,)
        Deviation of the outputs' noise.
    limits : mapping, optional
        Largest amplitude of each input; by default what was recorded.

    Returns
    -------
    dict or None
        `input`, `waveform`, `amplitude`, `frequency` (Hz), `separation` (rms difference over the noise), `recorded`
        (the separation in the recordings) and `sentence`; None if nothing within the limits separates them.
    """
    u = np.concatenate([r.u for r in bench.recordings])
    m, dt = min(max(map(len, bench.recordings)), MOST_SAMPLES), bench.dt
    t, rest = np.arange(m) * dt, np.median(u, axis=0)
    best: dict[str, Any] | None = None

    def separation(drive: np.ndarray) -> float:
        recording = bench.recordings[0].with_(
            u=drive, y=np.zeros((len(drive), len(noise))), initial="zero", period=None, skip=0
        )
        with np.errstate(all="ignore"):
            y = [
                f.engine.simulate(f.model.drive(recording), f.vector, np.zeros(f.model.n_state))[0]
                for f in (one, other)
            ]
            value = float(np.sqrt(np.mean(((y[0] - y[1]) / np.maximum(noise, 1e-300)) ** 2)))
        return value if np.isfinite(value) else 0.0

    recorded = max(separation(r.u[:m]) for r in bench.recordings)
    for i, name in enumerate(bench.simulator.inputs):
        most = (limits or {}).get(name, float(np.max(np.abs(u[:, i] - rest[i]))))
        trials = [("sine", f) for f in np.geomspace(4 / (m * dt), 0.2 / dt, SINES)]
        trials += [("triangle", f) for f in np.geomspace(2 / (m * dt), 0.02 / dt, 5)]
        for waveform, f in trials:
            wave = np.sin(2 * np.pi * f * t)
            if waveform == "triangle":
                wave = 2 / np.pi * np.arcsin(wave)
            for share in SHARES:
                drive = np.tile(rest, (m, 1))
                drive[:, i] += share * most * wave
                value = separation(drive)
                if best is None or value > 1.05 * best["separation"]:
                    best = {
                        "input": name,
                        "waveform": waveform,
                        "amplitude": share * most,
                        "frequency": float(f),
                        "separation": value,
                    }
    if best is None or best["separation"] < 1.0:
        return None
    unit = bench.recordings[0].units.get(best["input"], "")
    best["recorded"] = recorded
    best["sentence"] = (
        f"A {best['waveform']} of {best['frequency']:.3g} Hz with amplitude {best['amplitude']:.3g}"
        f"{' ' + unit if unit else ''} at {best['input']} separates them best: their outputs then differ by "
        f"{best['separation']:.3g} times the noise ({recorded:.3g} times in the recordings)."
    )
    return best


def placebo(bench: Workbench, fitted: Fitted, port: str, law: Law) -> tuple[float, float]:
    """Compute the held-out share of the residual that a law explains with its own signal, and with an unrelated one.

    The unrelated signal is the port's own, shifted by half a recording: it has the same statistics but no relation to
    the residual.
    """
    probe, runs = linearised(bench, fitted)
    shares = []
    for moved in (False, True):
        shifted = [
            replace(r, z=np.roll(r.z, len(r.z) // 2, axis=0), dz=np.roll(r.dz, len(r.dz) // 2, axis=0)) if moved else r
            for r in runs
        ]
        rest = Remainder.of(bench, probe, shifted, [type(law)], at=port)
        found = [held_out(rest.columns(task)[0], rest.left, rest.odd, (1e-6, 1e-3)) for task in rest.tasks]
        shares.append(found[0] if found else 0.0)
    return shares[0], shares[1]
