"""Errors on training and test recordings, and the parameters, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..compiled import make_engine
from ..gauss_newton import GaussNewton
from ..parameters import ParameterSet
from ..recording import InputError, Recording
from ..simulator import Simulator
from .gates import Gate
from .workbench import Fitted, Workbench


def nrmse(bench: Workbench, fitted: Fitted) -> float:
    """NRMSE averaged over outputs and recordings."""
    out = []
    for e, r in zip(fitted.residual, bench.recordings, strict=True):
        out.append(np.mean(np.sqrt(np.mean(e[r.skip :] ** 2, axis=0)) / np.std(r.y[r.skip :], axis=0)))
    return float(np.mean(out))


def errors_of(bench: Workbench, simulator: Simulator) -> float:
    """NRMSE at given parameters; infinite where the simulation diverges.

    Initial states that are to be estimated are fitted to the first part of each recording, which is not scored then.
    """
    held = simulator.with_parameters({k: replace(p, fixed=True) for k, p in simulator.parameters.items()})
    model = bench.model(held)
    engine = make_engine(model, bench.engine)
    vector, errors = model.parameters.start, []
    for r in bench.recordings:
        first, state = r.skip, None
        if isinstance(r.initial, str) and r.initial == "estimate":
            used = min(max(10 * model.n_x, 50), len(r) // 3)
            head = r.slice(0, max(used, 2)).with_(skip=0)
            try:
                problem = bench.problem(model, engine, [head])
                with np.errstate(all="ignore"):
                    state = GaussNewton(max_iterations=30).solve(problem).theta
            except (InputError, RuntimeError):
                state = np.zeros(model.n_x)
            first = max(first, used)
        elif isinstance(r.initial, str) and r.initial == "periodic":
            state, drive = np.zeros(model.n_x), model.drive(r)[: (r.period or len(r)) * model.substeps]
            with np.errstate(all="ignore"):
                for _ in range(60):
                    state = engine.simulate(drive, vector, state)[1]
        elif isinstance(r.initial, str):
            state = np.zeros(model.n_x)
        else:
            given = np.asarray(r.initial, dtype=float).ravel()
            state = np.concatenate([given, np.zeros(model.n_x - len(given))])
        with np.errstate(all="ignore"):
            y = engine.simulate(model.drive(r), vector, state)[0]
            e = np.sqrt(np.mean((y - r.y)[first:] ** 2, axis=0)) / np.std(r.y[first:], axis=0)
        errors.append(float(np.mean(e)))
    value = float(np.mean(errors))
    return value if np.isfinite(value) else np.inf


def test_errors(
    bench: Workbench,
    tests: Sequence[Recording],
    gates: Sequence[Gate],
    simulator: Simulator,
    without: Simulator,
    after: Simulator,
) -> dict[str, float]:
    """As recorded for the nominal simulator; what the gates put right is put right here too for the others."""
    out = {"nominal": errors_of(bench.on(tests), simulator)}
    for g in gates:
        if g.change is not None:
            tests = [g.change(r) for r in tests]
    for name, one in (("before", without), ("after", after)):
        out[name] = errors_of(bench.on(tests), one)
    return out


def deviations(bench: Workbench, fitted: Fitted) -> dict[str, np.ndarray]:
    """Standard errors of free parameters, from the residual and its correlation time; nan where held or at a bound."""
    from .floor import effective_size

    free = fitted.model.with_parameters(fitted.model.parameters.at(fitted.vector))
    problem = bench.problem(free, fitted.engine)
    n_free = int(problem.free.sum())
    theta = problem.start.copy()
    states = [s for p, s in zip(problem._parts, fitted.initial, strict=True) if p.first is not None]
    theta[n_free:] = np.concatenate(states) if states else theta[n_free:]
    _, _, hessian = problem.normal(theta)
    inside = (theta > problem.lower) & (theta < problem.upper)
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    out = np.full(problem.size, np.nan)
    keep = np.flatnonzero(inside & (np.diag(hessian) > 0))
    if len(keep):
        scaled = hessian[np.ix_(keep, keep)] / np.outer(size[keep], size[keep])
        covariance = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True)
        n = max(effective_size(fitted.residual), 10.0)
        out[keep] = np.sqrt(np.maximum(np.diag(covariance), 0) * fitted.cost / n) / size[keep]
    full = np.full(free.parameters.size, np.nan)
    full[problem.free] = out[:n_free]
    return free.parameters.unpack(full)


def parameter_table(
    simulator: Simulator, without: Fitted, after: Fitted, std: dict[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Nominal, refitted without and with the effects, for diagnosis.json."""
    out = {}
    for name, p in ParameterSet(dict(simulator.parameters)).items():
        error = np.asarray(std.get(name, np.nan))
        out[name] = {
            "nominal": p.value,
            "refit_without": without.values[name],
            "refit_with": after.values[name],
            "std": None if np.all(np.isnan(error)) else error,
            "unit": p.unit,
        }
    return out
