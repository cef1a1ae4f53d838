"""The linear model from which a search for a PI-LFR begins.

`linear_model` (Krikelis et al. 2024, Sec. 5.3) is subspace identification refined by output error, least squares as in
Eq. 20 without an element. A solve without the bound on the spectral radius comes first, because an integrator lies on
the bound, which a solver hardly reaches from inside.

Identification finds the linear blocks up to a change of the states' basis, `x = T x'`. If a structure fixes entries of
`A`, `B_u` or `C_y` (physical sub-matrices), `find_nearest_basis` chooses the basis in which these entries come nearest
to the known values,

    minimise over T   Σ_known (T⁻¹ A T - A_k)² + (T⁻¹ B_u - B_k)² + (C_y T - C_k)²     (each over its block's size),

from several start bases, and the linear model is fitted again with these entries fixed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError, Progress
from ..data import SAME_STEP, Recording
from ..linear import (
    FrequencyProblem,
    change_basis,
    in_modal_coordinates,
    is_modal,
    robust_bla,
    states_from_rest,
    subspace_matrices,
)
from ..models import PILFR, Model, or_one
from ..optimise import Constraint, GaussNewton, Problem, Solution, Status, stability_limits
from .context import FitContext, report_iterations
from .result import with_solution

Array = np.ndarray
Blocks = dict[str, np.ndarray]
Values = Mapping[str, np.ndarray]
BLA_OPTION = "bla"  # value of `linear` for the best linear approximation
COORDINATES = ("A", "B_u", "C_y")  # blocks that depend on the basis of the states
START_BASES = 30  # start bases of the search for the nearest one


def linear_model(
    recordings: Sequence[Recording],
    structure: PILFR,
    *,
    engine: str = "auto",
    constraints: tuple[Constraint, ...] = (),
    progress: Progress | None = None,
    given: Any = None,
) -> tuple[Model, Problem, Solution]:
    """Fit a linear state-space model: subspace identification refined by output error, or the model `given`.

    The structure gives the order, whether there is an offset, and whether `A` is in modal coordinates; its element and
    its other fixed blocks are ignored. A model `given` for a search with an element is not refined: at the minimum of
    the linear error the slope of half of the parameters vanishes, and starts get stuck.
    """
    model = _linear_start(recordings, structure, given, progress)
    problem = Problem(model, recordings, engine=engine, constraints=constraints)
    if given is not None and structure.element is not None:
        cost = problem.cost(problem.start)
        status = Status.CONVERGED if np.isfinite(cost) else Status.DIVERGED_START
        return model, problem, Solution(problem.start, cost, status, 0, 0.0)
    solution = _refine(problem, progress)
    if progress and solution.status is not Status.INTERRUPTED:
        progress("linear model", 1, 1, float(np.mean(problem.nrmse(solution.theta))))
    return model, problem, solution


def _refine(problem: Problem, progress: Progress | None) -> Solution:
    """Minimise the output error, first without the constraints."""
    solver = GaussNewton(tolerance=1e-4)
    report = report_iterations(progress, "linear model", solver.max_iterations)
    if not problem.constraints:
        return solver.solve(problem, progress=report)
    free = Problem(problem.model, problem.recordings, engine=problem.engine)
    solutions = [solver.solve(free, progress=report)]
    if solutions[0].status is not Status.INTERRUPTED:
        solutions[0] = solver.solve(problem, solutions[0].theta, report)
    limits = problem.active_constraints(solutions[0].theta)
    if solutions[0].status is not Status.INTERRUPTED and np.any(limits):
        solutions.append(solver.solve(problem, progress=report))
    return min(solutions, key=lambda s: (s.status is Status.INFEASIBLE, s.cost))


def _linear_start(recordings: Sequence[Recording], structure: PILFR, given: Any, progress: Progress | None) -> Model:
    """Make the linear model before it is refined."""
    first = recordings[0]
    if given is None:
        # the relative error of the subspace method is not an NRMSE
        report = progress and (lambda stage, done, total, _: progress(stage, done, total, np.nan))
        a, b, c, d = subspace_matrices(recordings, structure.nx, offset=structure.offset, progress=report)
    elif isinstance(given, str) and given == BLA_OPTION:
        a, b, c, d = best_linear_matrices(recordings, structure.nx)
    else:
        a, b, c, d = state_space_matrices(given, structure.nx, first)
    offset = _offset(recordings, a, b, c, d) if structure.offset else np.zeros(first.n_y)
    blocks, form = {"A": a, "B_u": b, "C_y": c, "D_yu": d, "y_0": offset}, structure.linear()
    if is_modal(structure.fixed, structure.nx):
        blocks, form = in_modal_coordinates(blocks, tuple(recordings)), replace(form, fixed={"A": structure.fixed["A"]})
    return form.model_for(first, blocks)


def best_linear_matrices(recordings: Sequence[Recording], nx: int) -> tuple[Array, Array, Array, Array]:
    """Estimate the best linear approximation from periodic recordings; of order 0, the static gain about the means."""
    for r in recordings:
        if r.period is None:
            raise InputError(
                f"linear = 'bla' was given, and the period of {r.label} is not known; give periodic recordings with "
                "their period in samples, or leave it out."
            )
    if nx == 0:
        return subspace_matrices(recordings, nx, offset=True)
    return FrequencyProblem(robust_bla(recordings), True).identify(nx)


def state_space_matrices(given: Any, nx: int, recording: Recording) -> tuple[Array, Array, Array, Array]:
    """Return the matrices of a `control.StateSpace`, which must have the recording's sizes and step."""
    if not all(hasattr(given, name) for name in ("A", "B", "C", "D", "dt")):
        raise InputError(f"A {type(given).__name__} was given as linear model; give a control.StateSpace or 'bla'.")
    a, b, c, d = (np.asarray(getattr(given, name), dtype=float) for name in "ABCD")
    found, wanted = (len(a), b.shape[1], len(c)), (nx, recording.n_u, recording.n_y)
    if found != wanted:
        raise InputError(
            f"The linear model given has {found[0]} states, {found[1]} inputs and {found[2]} outputs; "
            f"expected {wanted[0]}, {wanted[1]} and {wanted[2]}."
        )
    stated = given.dt is not None and given.dt is not True  # 1.0 equals True
    if stated and abs(given.dt / recording.dt - 1) > SAME_STEP:
        raise InputError(f"The linear model's step is {given.dt} s, the recording's {recording.dt:g} s; resample it.")
    return a, b, c, d


def _offset(recordings: Sequence[Recording], a: Array, b: Array, c: Array, d: Array) -> Array:
    """Compute the mean output error (n_y,) of a linear model from rest."""
    errors = [(r.y - states_from_rest(a, b, r.u) @ c.T - r.u @ d.T)[r.skip :] for r in recordings]
    return np.asarray(np.mean(np.concatenate(errors), axis=0))


def known_entries(structure: PILFR) -> Blocks:
    """Return the fixed blocks that depend on the basis of the states (nan: free); blocks fixed at zero do not."""
    return {k: np.asarray(v) for k, v in structure.fixed.items() if k in COORDINATES and np.any(np.asarray(v) != 0)}


def transform_to_known_basis(structure: PILFR, linear: Model, context: FitContext) -> Model:
    """Fit the linear model again in the basis of the structure's known entries; without any, return it unchanged."""
    known = known_entries(structure)
    if not known or not structure.nx or (set(known) == {"A"} and is_modal(known, structure.nx)):
        return linear  # already in modal coordinates
    blocks = {k: p.value for k, p in linear.parameters.items()}
    spread = np.sqrt(np.mean(simulate_states(blocks, np.concatenate([r.u for r in context.recordings])) ** 2, axis=0))
    blocks = find_nearest_basis(change_basis(blocks, np.diag(or_one(spread))), known)
    form = replace(structure.linear(), fixed=known)
    model = form.model_for(linear, blocks)
    problem = replace(context, constraints=stability_limits(structure, context.options.stable)[:1]).problem(model)
    if not np.isfinite(problem.cost(problem.start)):
        return model
    return with_solution(model, problem, context.solve(problem, "linear model"))


def find_nearest_basis(blocks: Blocks, known: Values) -> Blocks:
    """Return the blocks in the basis in which they come nearest to the `known` entries (nan: unknown)."""
    from scipy.optimize import least_squares

    n = len(blocks["A"])
    want = {k: np.broadcast_to(np.asarray(v, dtype=float), blocks[k].shape) for k, v in known.items()}
    size = {k: max(float(np.sqrt(np.nanmean(v**2))), 1e-12) for k, v in want.items()}

    def residual(flat: Array) -> Array:
        t = flat.reshape(n, n)
        if not np.linalg.cond(t) < 1e10:
            return np.full(sum(int(np.sum(~np.isnan(v))) for v in want.values()), 1e6)
        found = change_basis(blocks, t)
        return np.concatenate([((found[k] - v) / size[k])[~np.isnan(v)] for k, v in want.items()])

    rng, best, least = np.random.default_rng(0), np.eye(n), np.inf
    for k in range(START_BASES):
        t = np.eye(n) if k == 0 else rng.standard_normal((n, n))
        for name, side in (("B_u", 1), ("C_y", -1)):  # known entries of `B_u` or `C_y` give the states' scale
            if name in want:
                norm = float(np.linalg.norm(change_basis(blocks, t)[name]))
                t = t * (norm / (size[name] * np.sqrt(want[name].size))) ** side if norm > 0 else t
                break
        result: Any = least_squares(residual, t.ravel(), x_scale="jac", max_nfev=200)
        if result.cost < least and np.linalg.cond(result.x.reshape(n, n)) < 1e8:
            best, least = result.x.reshape(n, n), float(result.cost)
        if least < 1e-10:
            break
    return change_basis(blocks, best)


def simulate_states(blocks: Values, u: Array) -> Array:
    """Simulate the states (M, nx) of the linear part driven by u (M, n_u), from zero."""
    a, b = blocks["A"], u @ blocks["B_u"].T
    out, x = np.empty((len(u), len(a))), np.zeros(len(a))
    for k in range(len(u)):
        out[k] = x
        x = a @ x + b[k]
    return out
