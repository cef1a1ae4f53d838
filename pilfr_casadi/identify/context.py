"""`FitContext`: the recordings, solver and options of one fit, its solves, and its result with a note.

**A search begins at rest.** With a free initial state a search would improve the fit by initial memories that the
machine never had. A prior does not prevent this, because the units of states and memories are free too. So a search
begins at rest unless the recordings contradict it: unless freeing the state lowers the cost by more than the Bayesian
information criterion charges for the new variables (`FitContext.agrees_with_rest`).

**The note of a result** names two things that the recordings do not determine. First, an operator that never slips in a
periodic steady state keeps any memory: its row of the state's slope over a period is a row of the identity, every value
in an interval is a steady state, and the outputs differ by a constant. The fit uses the memory reached from rest.

Second, the gain of a `dc_gain` constraint applies after an infinite time, to motions so large that every play slips
(`slope` 1) or so small that every play sticks (0). A fit may meet it outside the data, by operators whose thresholds
exceed all motions, or by a slow pole. So the gain is computed a second time, over the samples of the longest recording
and without the operators that never slip (for small motions: with the operators that have no threshold),

    gain_M = C' (Σ_{k<M} A'^k) B' + D',   with the blocks of the constraint at S = diag(Σ_j w_ij), j slipping.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import Progress, deferred_interrupt
from ..data import Recording, as_recordings, check_for_identification, fingerprint
from ..models import LAYER, PILFR, Lagged, Model, PrandtlIshlinskii, Stop, with_port_gain
from ..optimise import (
    BOUND_STEP_SOLVER,
    Constraint,
    Gain,
    GaussNewton,
    Ipopt,
    IterationCallback,
    Problem,
    Solution,
    Status,
    describe_unbounded,
    limits_of,
    move_inside_exact,
    solve_within_radii,
    undetermined_memory,
)
from .result import DENSITY_PRIOR, Fit, FitOptions, with_solution
from .uncertainty import standard_errors

Stage = tuple[Model, Problem, Solution, str]  # model, problem, solution, note
Array = np.ndarray
BOUND_SOLVER = GaussNewton()  # solves at a bound on a spectral radius for solvers other than Gauss-Newton
DIVERGES = 1e3  # a fit counts as diverged from this multiple of the error of a model whose outputs are zero
NOISE_ROUNDS, NOISE_AGREES = 5, 0.05  # limit of noise estimates, and the relative change below which they stop
APART = 0.05  # difference of gains, relative to the largest wanted gain, that is reported


@dataclass(frozen=True, eq=False)
class FitContext:
    """The recordings, solver and options that every kind of fit shares.

    `constraints` include the bounds on spectral radii; `threads` is the number of recordings run at a time; `began` is
    the `time.perf_counter` at which the work began.
    """

    recordings: tuple[Recording, ...]
    solver: Any
    constraints: tuple[Constraint, ...] = ()
    l1: dict[str, float] = field(default_factory=dict)
    engine: str = "auto"
    progress: Progress | None = None
    threads: int = 1
    options: FitOptions = FitOptions()  # noqa: RUF009  (frozen)
    began: float = field(default_factory=time.perf_counter)

    @cached_property
    def weights(self) -> np.ndarray | None:
        """The weight of each recording, or None."""
        return self.options.weights_of(self.recordings)

    def problem(self, model: Model, noise: float = 1.0, **others: Any) -> Problem:
        """Make the simulation-error problem of a model; `others` replace options of `Problem`."""
        given: dict[str, Any] = {"constraints": self.constraints, "noise": self.options.noise or noise}
        given |= {"engine": self.engine, "weights": self.weights, **others}
        problem = Problem(model, self.recordings, **given)
        problem.threads = self.threads
        return problem

    def solve(self, problem: Problem, stage: str, start: np.ndarray | None = None) -> Solution:
        """Solve a problem inside its bounds on spectral radii; see `solve_within_bounds`."""
        if not isinstance(self.solver, GaussNewton | Ipopt):
            solution: Solution = self.solver.solve(problem, start)
            return solution
        bound_solver = self.solver if isinstance(self.solver, GaussNewton) else BOUND_SOLVER
        return solve_within_bounds(problem, start, self.solver, stage, self.progress, bound_solver)

    def iterate_noise(self, problem: Problem, solution: Solution) -> tuple[Problem, Solution]:
        """If there are priors, solve again with the noise set to the error reached, until the two agree."""
        priors = any(p.prior is not None and not np.all(p.fixed) for p in problem.model.parameters.values())
        for _ in range(NOISE_ROUNDS if priors and self.options.noise is None else 0):
            error = rms_error(problem, solution.theta)
            if abs(error / problem.noise - 1) < NOISE_AGREES or error == 0 or solution.status is Status.INTERRUPTED:
                break
            problem = self.problem(problem.model, error, l1=problem.l1, engine=problem.engine)
            solution = self.solve(problem, "solve", solution.theta)
        return problem, solution

    def at_rest(self) -> FitContext:
        """Return the context in which recordings with an estimated initial state begin at rest."""
        if not any(r.begins == "estimate" for r in self.recordings):
            return self
        recordings = [r.with_(initial="zero") if r.begins == "estimate" else r for r in self.recordings]
        return replace(self, recordings=tuple(recordings))

    def agrees_with_rest(self, problem: Problem, theta: np.ndarray, correlated: float = 1.0) -> bool:
        """Tell whether the recordings agree with a beginning at rest, given the solution θ of the problem from rest.

        A linearised step in the initial states alone predicts the largest decrease of the cost. `correlated` residuals
        count as one, because a model's errors change slowly. True also if θ already contains initial states.
        """
        if problem.size > problem.n_free or not any(r.begins == "estimate" for r in self.recordings):
            return True
        freed = self.problem(problem.model, engine=problem.engine, constraints=())
        n_free = freed.n_free
        _, gradient, hessian = freed.normal(np.concatenate([theta, freed.start[n_free:]]))
        cost = 0.5 * float(np.mean(problem.residual(theta) ** 2))
        if not np.isfinite(cost) or cost == 0:
            return True
        slope, curvature = gradient[n_free:], hessian[n_free:, n_free:]
        if not len(slope):
            return True
        decrease = 0.5 * float(slope @ np.linalg.lstsq(curvature, slope, rcond=None)[0])
        remaining = max(1 - decrease / cost, np.finfo(float).tiny)
        independent = max(freed.residuals / correlated, 2.0)
        return bool(-independent * np.log(remaining) < len(slope) * np.log(independent))

    def result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str = "", **fields: Any
    ) -> Fit:
        """Build the `Fit` of a solution; Ctrl-C waits until it is complete and shows in its status.

        `fields` are further fields of the `Fit`; `errors={}` skips the standard errors.
        """
        built: list[Fit] = []
        try:
            with deferred_interrupt():
                built.append(
                    self._result(model, structure, problem, move_inside_exact(problem, solution), note, fields)
                )
            if self.progress:
                self.progress("standard errors", 1, 1, float(np.mean(built[0].train_nrmse)))
        except KeyboardInterrupt:
            if not built:
                raise
            return replace(built[0], solution=replace(built[0].solution, status=Status.INTERRUPTED))
        return built[0]

    def _result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str, fields: Any
    ) -> Fit:
        """Build the `Fit`, with a note on quantities that the recordings do not determine.

        Priors that the search added to weights and thresholds (`DENSITY_PRIOR`) are removed from the model and its
        standard errors here.
        """
        fitted, judged, theta = with_solution(model, problem, solution), problem, solution.theta
        if note == DENSITY_PRIOR:
            fitted = without_density_prior(fitted, structure)
            names = ("engine", "constraints", "noise", "scale", "weights")
            options: dict[str, Any] = {name: getattr(problem, name) for name in names}
            judged = Problem(fitted, problem.recordings, **options)
        nrmse = tuple(problem.nrmse(theta))
        of_zero = [float(np.max(np.sqrt(np.mean(r.y**2, axis=0)) / problem.scale)) for r in problem.recordings]
        if solution.status.converged and not max(nrmse) < DIVERGES * max(1.0, *of_zero):
            solution = replace(solution, status=Status.DIVERGES)
        notes = (
            note,
            describe_open_memory(judged, theta),
            describe_reached_gain(problem, theta),
            describe_unbounded(structure, problem.constraints, problem.values(theta)),
        )
        bounds = zip(problem.labels, theta, problem.lower, problem.upper, strict=True)
        limits = limits_of(problem, solution)
        active = [f"{label} = {value:g}" for label, value, low, high in bounds if value in (low, high)]
        active += [limit.name for limit in limits if limit.active and limit.kind == "constraint"]
        states = zip(self.recordings, problem.first_states(theta), strict=True)
        if "errors" not in fields:
            fields = {**fields, "errors": standard_errors(judged, theta, structure)}
        return Fit(
            model=fitted,
            structure=structure,
            dt=self.recordings[0].dt,
            solution=solution,
            train_nrmse=nrmse,
            initial={fingerprint(r): state for r, state in states},
            labels=problem.labels,
            active=tuple(active),
            seconds=time.perf_counter() - self.began,
            units=dict(self.recordings[0].units),
            note="; ".join(part for part in notes if part),
            engine=self.engine,
            limits=limits,
            options=self.options,
            **fields,
        )


def without_density_prior(model: Model, structure: PILFR | None) -> Model:
    """Replace the priors that a search put on weights and thresholds by the structure's own, if it has any."""
    priors = structure.priors if structure else {}
    return model.with_parameters(model.parameters.change(**{name: {"prior": priors.get(name)} for name in LAYER}))


def solve_within_bounds(
    problem: Problem,
    start: np.ndarray | None,
    solver: Any,
    stage: str = "solve",
    progress: Progress | None = None,
    bound_solver: GaussNewton = BOUND_STEP_SOLVER,
    at_bound: bool = False,
) -> Solution:
    """Solve a problem inside exact bounds on spectral radii with any solver (`solve_within_radii`).

    The package's solvers report their steps under the name `stage` and pass their time limit on to `bound_solver`.
    """
    start = problem.start if start is None else start
    if not isinstance(solver, GaussNewton | Ipopt):
        return solve_within_radii(problem, start, solver.solve, bound_solver, at_bound)
    report = report_iterations(progress, stage, solver.max_iterations)
    bound_solver = replace(bound_solver, time_limit=solver.time_limit)
    return solve_within_radii(problem, start, lambda p, s: solver.solve(p, s, report), bound_solver, at_bound, report)


def report_iterations(progress: Progress | None, stage: str, most: int) -> IterationCallback | None:
    """Turn a progress function into a callback for a solver's iterations.

    A cost includes priors and weights of recordings, so it is no NRMSE, and the error reported is nan.
    """
    if progress is None:
        return None
    return lambda i: progress(stage, min(i.number, most), most, np.nan)


def context_of_fit(
    fit: Fit, train: Recording | Sequence[Recording], *, solver: Any, engine: str = "auto", **others: Any
) -> FitContext:
    """Make the context of a fit that continues an earlier one; `others` replace its `FitOptions`."""
    recordings = as_recordings(train)
    options = fit.options.updated(**others, train=recordings)
    return FitContext(recordings, solver, options.all_constraints(fit.structure), engine=engine, options=options)


def check_recordings(
    model: PILFR | Lagged | Model | Fit, train: Recording | Sequence[Recording]
) -> tuple[Recording, ...]:
    """Check that recordings fit each other and have enough samples for a model; return them as a tuple."""
    first = as_recordings(train)[0]
    if isinstance(model, Lagged):
        unknowns = model.unknowns(first.n_u, first.n_y)
    elif isinstance(model, PILFR):
        unknowns = max(int(model.model(first.n_u, first.n_y).parameters.free.sum()), 10 * model.nx)
    else:
        unknowns = int((model.model if isinstance(model, Fit) else model).parameters.free.sum())
    return check_for_identification(train, unknowns + 2)


def mark_interrupted(model: Model, problem: Problem, solution: Solution, note: str) -> Stage:
    """Return the stage with its solution marked as interrupted."""
    return model, problem, replace(solution, status=Status.INTERRUPTED), note


def rms_error(problem: Problem, theta: Array) -> float:
    """Compute the root mean square of the normalised residuals."""
    return float(np.sqrt(np.mean(problem.residual(theta) ** 2)))


def describe_open_memory(problem: Problem, theta: Array) -> str:
    """Name the recordings that do not determine some memories; empty if there are none."""
    counts = {}
    for k, (r, state) in enumerate(zip(problem.recordings, problem.first_states(theta), strict=True)):
        if r.begins == "periodic" and problem.model.n_s and np.all(np.isfinite(state)):
            period = problem.model.drive(r)[: (r.period or 1) * problem.model.substeps]
            open_memory = undetermined_memory(
                problem.engine, period, problem.parameters(theta), state, problem.model.n_x, problem.scale
            )
            counts[r.label if len(problem.recordings) == 1 or r.name else f"recording {k + 1}"] = len(open_memory)
    found = [f"{count} in {label}" for label, count in counts.items() if count]
    if not found:
        return ""
    return (
        f"operators that never slip in a steady period: {', '.join(found)}; their memory cannot be determined "
        "from the period; it shifts the outputs, and the value reached from rest was used"
    )


def describe_reached_gain(problem: Problem, theta: Array) -> str:
    """Name the gains that hold only beyond the recordings, and why; empty if there are none."""
    found = []
    values, moved = problem.values(theta), None
    samples = max(len(r) for r in problem.recordings)
    for c, rows in zip(problem.constraints, problem.g_slices, strict=True):
        if not isinstance(c.expression, Gain):
            continue
        if moved is None:
            moved = find_slipping(problem, theta, values)
        low, high = problem.g_lower[rows], problem.g_upper[rows]
        room = APART * float(np.max(np.abs(np.concatenate([low, high])), initial=0.0))
        limits = low - room, high + room
        whole, within, odd = channel_weights(problem.model.element, values, c.expression.slope, moved)
        if _is_outside(gain_over(values, whole, None), *limits):
            continue  # the limits report a gain that is not met at all
        reached = gain_over(values, within, samples)
        if not _is_outside(reached, *limits):
            continue
        by_range = _is_outside(gain_over(values, within, None), *limits)
        by_time = _is_outside(gain_over(values, whole, samples), *limits)
        why = []
        if odd and (by_range or not by_time):
            why.append(odd)
        if by_time or not by_range:
            why.append(f"the response takes more than the {samples} recorded samples to settle")
        shown = ", ".join(f"{g:.3g}" for g in reached)
        found.append(f"{c.name} holds only beyond the recordings: {' and '.join(why)}; within them it is {shown}")
    return "; ".join(found)


def _is_outside(gain: Array, low: Array, high: Array) -> bool:
    """Tell whether an entry of a gain lies outside its limits, or is nan."""
    return bool(np.any(~((low <= gain) & (gain <= high))))


def find_slipping(problem: Problem, theta: Array, values: Mapping[str, Array]) -> Array:
    """Find the operators that slip in some recording, (channels, N); none without an element."""
    element = problem.model.element
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros((0, 0), dtype=bool)
    r, n_x, p = values["r"], problem.model.n_x, problem.parameters(theta)
    moved = np.zeros(r.shape, dtype=bool)
    for recording, state in zip(problem.recordings, problem.first_states(theta), strict=True):
        z = problem.engine.simulate(problem.model.drive(recording), p, state, True)[2]
        q = state[n_x:].reshape(r.shape)
        for row in z:
            after = np.clip(q, row[:, None] - r, row[:, None] + r)
            moved |= after != q
            q = after
    return moved


def channel_weights(
    element: object, values: Mapping[str, Array], slope: float, moved: Array
) -> tuple[Array, Array, str]:
    """Sum each channel's weights (n_w,), of all operators and of those active in the recordings; describe the rest."""
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros(0), np.zeros(0), ""
    w, stops = values["w"], isinstance(element.operator, Stop)
    whole = slope * w.sum(axis=1)
    if slope not in (0.0, 1.0):
        return whole, whole, ""
    if (slope == 1.0) != stops:  # large motions
        odd, reason = ~moved, "never slip in them"
    else:
        odd, reason = values["r"] <= 0, "have no threshold below which they stick"
    odd = odd & (w > 0)
    active = odd if slope == 0.0 else ~odd
    return whole, (w * active).sum(axis=1), f"{int(odd.sum())} of {w.size} operators {reason}" if np.any(odd) else ""


def gain_over(values: Mapping[str, Array], weight: Array, samples: int | None) -> Array:
    """Compute the gain (n_y n_u,), row by row, for Σw of each channel, after `samples`, or in the limit if None."""
    a, b, c, d = (values[k] for k in ("A", "B_u", "C_y", "D_yu"))
    if len(weight):
        a, b, c, d = with_port_gain(values, np.diag(weight))
    n = len(a)
    with np.errstate(over="ignore", invalid="ignore"):
        if samples is None:
            state = np.linalg.lstsq(np.eye(n) - a, b, rcond=None)[0] if n else b
        else:
            step = np.block([[a, b], [np.zeros((b.shape[1], n)), np.eye(b.shape[1])]])
            state = np.linalg.matrix_power(step, samples)[:n, n:]
        return np.asarray(c @ state + d).ravel()
