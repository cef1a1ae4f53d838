"""The linear model that a PI-LFR begins with: subspace identification refined by output error.

Krikelis et al. (2024), Sec. 5.3: the best linear approximation, least squares as in Eq. 20 without an element. Limits
on the spectral radius are put on at the end of a solve without: an integrator lies on them, and on the way to it they
would be in the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError, Progress
from ..data import Recording
from ..linear import FrequencyProblem, in_modal_coordinates, is_modal, propagate, robust_bla, subspace_matrices
from ..models import PILFR, Model
from ..optimise import Constraint, GaussNewton, Problem, Solution, Status
from .told import iterations

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
        a, b, c, d = best_approximation(recordings, structure.nx)
    else:
        a, b, c, d = matrices_of(given, structure.nx, first)
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
    report = iterations(progress, "linear model", solver.max_iterations)
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


def best_approximation(recordings: Sequence[Recording], nx: int) -> tuple[Array, Array, Array, Array]:
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


def matrices_of(given: Any, nx: int, recording: Recording) -> tuple[Array, Array, Array, Array]:
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
