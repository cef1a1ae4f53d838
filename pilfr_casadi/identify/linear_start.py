r"""The linear model that a PI-LFR begins with: subspace identification refined by output error.

Krikelis et al. (2024), Sec. 5.3: the best linear approximation, by least squares as in Eq. 20 without an element. The
bound on the spectral radius is added after a solve without it: an integrator ends on the bound, which would otherwise
obstruct its way there.

Identification finds the linear blocks up to a change of the states' basis, `x = T x'`. Where a structure fixes entries
of `A`, `B_u` or `C_y` (physical sub-matrices), the basis is chosen in which these entries come nearest to the known
values,

    minimise over T   Σ_known (T⁻¹ A T - A_k)² + (T⁻¹ B_u - B_k)² + (C_y T - C_k)²     (each over its block's size),

from several start bases, and the linear model is fitted again with the entries at their values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError, Progress
from ..data import Recording
from ..linear import FrequencyProblem, in_modal_coordinates, is_modal, propagate, robust_bla, subspace_matrices
from ..models import PILFR, Model
from ..optimise import Constraint, GaussNewton, Problem, Solution, Status, stability_limits
from .context import FitContext, report_iterations
from .result import with_solution
from .start import simulate_states

Array = np.ndarray
BLA = "bla"


def linear_model(
    recordings: Sequence[Recording],
    structure: PILFR,
    *,
    engine: str = "auto",
    constraints: tuple[Constraint, ...] = (),
    progress: Progress | None = None,
    given: Any = None,
) -> tuple[Model, Problem, Solution]:
    """A linear state-space model: subspace identification refined by output error, or one that is given.

    Parameters
    ----------
    recordings : sequence of Recording
        Training data.
    structure : PILFR
        Gives the order, whether there is an offset, and whether `A` is in modal coordinates (`modal`); its element and
        what else it fixes are left aside.
    engine, constraints
        As for `Problem`.
    given : control.StateSpace or "bla"
        A linear model in discrete time to take in place of the subspace's, or the best linear approximation. In the
        search for an element it stays as it is: at the minimum of the linear error the slope of half of the parameters
        has vanished, and starts get stuck.
    progress : callable
        Called with ("subspace" or "linear model", done, total, smallest error so far).

    Returns
    -------
    Model, Problem, Solution
        The model at its start, the problem and its solution.

    Raises
    ------
    InputError
        If the recordings are too short for the order, the model given does not fit them, or there is no best linear
        approximation because they are not periodic.
    """
    first, solver = recordings[0], GaussNewton(tolerance=1e-4)
    if given is None:
        a, b, c, d = subspace_matrices(recordings, structure.nx, offset=structure.offset, progress=progress)
    elif isinstance(given, str) and given == BLA:
        a, b, c, d = best_linear_matrices(recordings, structure.nx)
    else:
        a, b, c, d = state_space_matrices(given, structure.nx, first)
    offset = _offset(recordings, a, b, c, d) if structure.offset else np.zeros(first.n_y)
    blocks, form = {"A": a, "B_u": b, "C_y": c, "D_yu": d, "y_0": offset}, structure.linear()
    if is_modal(structure.fixed, structure.nx):
        blocks, form = in_modal_coordinates(blocks, tuple(recordings)), replace(form, fixed={"A": structure.fixed["A"]})
    model = form.model(first.n_u, first.n_y, blocks, inputs=first.inputs, outputs=first.outputs)
    problem = Problem(model, recordings, engine=engine, constraints=constraints)
    if given is not None and structure.element is not None:
        cost = problem.cost(problem.start)
        status = Status.CONVERGED if np.isfinite(cost) else Status.DIVERGED_START
        return model, problem, Solution(problem.start, cost, status, 0, 0.0)
    report = report_iterations(progress, "linear model", solver.max_iterations)
    if not constraints:
        return model, problem, solver.solve(problem, progress=report)
    free = Problem(model, recordings, engine=problem.engine)
    found = [solver.solve(free, progress=report)]
    if found[0].status is not Status.INTERRUPTED:
        found[0] = solver.solve(problem, found[0].theta, report)
    limits = problem.active_constraints(found[0].theta)
    if found[0].status is not Status.INTERRUPTED and np.any(limits):
        found.append(solver.solve(problem, progress=report))
    return model, problem, min(found, key=lambda s: (s.status is Status.INFEASIBLE, s.cost))


def best_linear_matrices(recordings: Sequence[Recording], nx: int) -> tuple[Array, Array, Array, Array]:
    """The matrices of the best linear approximation from periodic recordings, Krikelis et al. (2024), Sec. 5.3.

    Of order 0 it is the static gain of least squares about the means.

    Raises
    ------
    InputError
        If the period of a recording is not known, or as `robust_bla` and `frequency_subspace`.
    """
    for r in recordings:
        if r.period is None:
            raise InputError(
                f"linear = 'bla' was given, and the period of {r.label} is not known; give periodic recordings with "
                "their period in samples, or leave it out."
            )
    if nx == 0:
        return subspace_matrices(recordings, nx, offset=True)
    model = FrequencyProblem(robust_bla(recordings), True).solve([nx], None)[0]
    return model.A, model.B, model.C, model.D


def state_space_matrices(given: Any, nx: int, recording: Recording) -> tuple[Array, Array, Array, Array]:
    """The matrices of a `control.StateSpace` that is to begin with.

    Raises
    ------
    InputError
        If it is none, or has other sizes or another step than wanted.
    """
    if not all(hasattr(given, name) for name in ("A", "B", "C", "D", "dt")):
        raise InputError(f"A {type(given).__name__} was given as linear model; give a control.StateSpace or 'bla'.")
    a, b, c, d = (np.asarray(getattr(given, name), dtype=float) for name in "ABCD")
    found, wanted = (len(a), b.shape[1], len(c)), (nx, recording.n_u, recording.n_y)
    if found != wanted:
        raise InputError(
            f"The linear model given has {found[0]} states, {found[1]} inputs and {found[2]} outputs; "
            f"expected {wanted[0]}, {wanted[1]} and {wanted[2]}."
        )
    if given.dt not in (None, True) and not np.isclose(float(given.dt), recording.dt, rtol=1e-4):
        raise InputError(
            f"The linear model's step is {given.dt} s, the recording's {recording.dt:g} s; sample it anew."
        )
    return a, b, c, d


def _offset(recordings: Sequence[Recording], a: Array, b: Array, c: Array, d: Array) -> Array:
    """The mean (n_y,) of what a linear model leaves of the outputs, from rest."""
    left = []
    for r in recordings:
        states = propagate(a.T, (r.u @ b.T)[None], np.zeros((1, len(a))))[0][0] if len(a) else np.zeros((len(r), 0))
        left.append((r.y - states @ c.T - r.u @ d.T)[r.skip :])
    return np.asarray(np.mean(np.concatenate(left), axis=0))


COORDINATES = ("A", "B_u", "C_y")
STARTS = 30
Blocks = dict[str, np.ndarray]


def known_entries(structure: PILFR) -> dict[str, np.ndarray]:
    """What is known in the states' coordinates: fixed blocks with numbers (nan: free), those fixed at zero left out."""
    return {k: np.asarray(v) for k, v in structure.fixed.items() if k in COORDINATES and np.any(np.asarray(v) != 0)}


def transform_to_known_basis(structure: PILFR, linear: Model, context: FitContext) -> Model:
    """The linear model in the basis in which what the structure knows holds; as it is where nothing is known."""
    known = known_entries(structure)
    if not known or not structure.nx or (set(known) == {"A"} and is_modal(known, structure.nx)):
        return linear  # which is in modal coordinates already
    blocks = {k: p.value for k, p in linear.parameters.items()}
    blocks = find_nearest_basis(_scaled(blocks, np.concatenate([r.u for r in context.recordings])), known)
    alone = replace(structure.linear(), fixed=known)
    model = alone.model(linear.n_u, linear.n_y, blocks, inputs=linear.inputs, outputs=linear.outputs)
    problem = replace(context, constraints=stability_limits(structure, context.options.stable)[:1]).problem(model)
    if not np.isfinite(problem.cost(problem.start)):
        return model
    return with_solution(model, problem, context.solve(problem, "linear model"))


def _scaled(blocks: Blocks, u: np.ndarray) -> Blocks:
    """States of unit deviation, from which the search for a basis begins."""
    spread = np.sqrt(np.mean(simulate_states(blocks, u) ** 2, axis=0))
    return change_basis(blocks, np.diag(np.where(spread > 0, spread, 1.0)))


def change_basis(blocks: Mapping[str, np.ndarray], t: np.ndarray) -> Blocks:
    """The blocks with `x = T x'`."""
    back = np.linalg.inv(t)
    return {
        **blocks,
        "A": back @ blocks["A"] @ t,
        "B_u": back @ blocks["B_u"],
        "C_y": blocks["C_y"] @ t,
    }


def find_nearest_basis(blocks: Blocks, known: Mapping[str, np.ndarray], seed: int = 0) -> Blocks:
    """The blocks in the basis in which their known entries (nan: unknown) come nearest to what is known.

    Parameters
    ----------
    blocks : mapping
        `A` (nx, nx), `B_u` (nx, n_u), `C_y` (n_y, nx); others are left as they are.
    known : mapping
        Known entries by block, scalars or arrays of its shape.
    seed : int
        Of the bases that the search starts from.
    """
    from scipy.optimize import least_squares

    n = len(blocks["A"])
    want = {k: np.broadcast_to(np.asarray(v, dtype=float), blocks[k].shape) for k, v in known.items()}
    size = {k: max(float(np.sqrt(np.nanmean(v**2))), 1e-12) for k, v in want.items()}

    def left(flat: np.ndarray) -> np.ndarray:
        t = flat.reshape(n, n)
        if not np.linalg.cond(t) < 1e10:
            return np.full(sum(int(np.sum(~np.isnan(v))) for v in want.values()), 1e6)
        found = change_basis(blocks, t)
        return np.concatenate([((found[k] - v) / size[k])[~np.isnan(v)] for k, v in want.items()])

    rng, best, least = np.random.default_rng(seed), np.eye(n), np.inf
    for k in range(STARTS):
        t = np.eye(n) if k == 0 else rng.standard_normal((n, n))
        for name, side in (("B_u", 1), ("C_y", -1)):  # the known size of inputs and outputs tells the states' scale
            if name in want:
                norm = float(np.linalg.norm(change_basis(blocks, t)[name]))
                t = t * (norm / (size[name] * np.sqrt(want[name].size))) ** side if norm > 0 else t
                break
        result: Any = least_squares(left, t.ravel(), x_scale="jac", max_nfev=200)
        if result.cost < least and np.linalg.cond(result.x.reshape(n, n)) < 1e8:
            best, least = result.x.reshape(n, n), float(result.cost)
        if least < 1e-10:
            break
    return change_basis(blocks, best)
