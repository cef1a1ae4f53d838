"""`Solution`, the result of every solver: the best point, and a status whose value is a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from .._base import InputError, is_number, positive, whole
from ..models import Model
from .constraints import FEASIBILITY_TOLERANCE, RadiusExcess
from .problem import Problem


class Status(Enum):
    """Status of a solve; the value is the sentence shown to the user."""

    CONVERGED = "Converged: no admissible step improves the fit noticeably."
    SMALL_STEP = "Converged: the last steps were too small to matter."
    STOPPED_EARLY = "Stopped early: the error on the data held back was smallest here."
    MAX_ITERATIONS = "Not converged: the iteration limit was reached; the best point so far is returned."
    TIME_LIMIT = "Not converged: the time limit was reached; the best point so far is returned."
    INTERRUPTED = "Not converged: interrupted; the best point so far is returned."
    DIVERGED_START = "Failed: the simulation diverges at the start values; start from a stable model."
    DIVERGES = "Failed: the model diverges on the training recordings; bound its spectral radius, or free parameters."
    INFEASIBLE = "Failed: the constraints cannot be met from this start; loosen them or start elsewhere."
    RESTORED = "Not converged: the exact bounds are met only by scaling the model; loosen them or start elsewhere."
    SOLVER_FAILED = "Not converged: the solver stopped early; the best point so far is returned."

    @property
    def converged(self) -> bool:
        """Whether the solve ended at a minimum, or at the best point on data held back."""
        return self in (Status.CONVERGED, Status.SMALL_STEP, Status.STOPPED_EARLY)

    @property
    def advice(self) -> str:
        """One sentence of advice; empty where the status already gives it or none is needed."""
        return ADVICE.get(self, "")


ADVICE = {
    Status.MAX_ITERATIONS: "Judge it by its error on a test recording; to go on, give a solver more iterations, as in "
    "solver=GaussNewton(max_iterations=1000).",
    Status.TIME_LIMIT: "Judge it by its error on a test recording; to go on, give more time.",
    Status.SOLVER_FAILED: "Judge it by its error on a test recording; to go on, fit again from it or from more starts.",
}


@dataclass(frozen=True)
class Iteration:
    """One line of a solver's history."""

    number: int
    cost: float
    seconds: float
    step: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class Solution:
    """A solver's result.

    Attributes
    ----------
    theta : numpy.ndarray
        Variables, shape (n,), inside their bounds.
    cost : float
        Objective there.
    violation : float
        Largest violation of the general constraints (0 where they hold).
    multipliers : numpy.ndarray
        Multipliers of the bounds (n,), then of the general constraints (n_g,); positive at an upper limit.
    """

    theta: np.ndarray
    cost: float
    status: Status
    iterations: int
    seconds: float
    violation: float = 0.0
    multipliers: np.ndarray = field(default_factory=lambda: np.zeros(0))
    history: tuple[Iteration, ...] = ()
    message: str = ""


@dataclass(frozen=True, eq=False)
class Candidate:
    """The result of one start: `drawn` tells whether it depends on the seed, `nrmse` is the mean over recordings."""

    seed: int
    model: Model
    theta: np.ndarray
    error: float
    solution: Solution
    note: str = ""
    drawn: bool = True
    nrmse: float = np.nan


IterationCallback = Callable[[Iteration], None]


AT_RADIUS = 1e-3  # share of a bound within which a radius counts as lying at it
ACTIVE_MULTIPLIER = 1e-3  # multiplier of log ρ, relative to the objective, above which its bound counts as active


@dataclass(frozen=True)
class Limit:
    """General constraint, or active bound, at a solution.

    Attributes
    ----------
    name : str
        The constraint's or the variable's name.
    kind : str
        "constraint" or "bound".
    value, lower, upper : float
        Value of the expression and its limits (infinite where there is none). For a bound on a spectral radius, the
        radius computed from the eigenvalues of the result, and its bound.
    multiplier : float
        Decrease of the objective per unit by which the limit moves outwards; 0 if the limit is not active, nan if the
        solver gave none or ended at a kink of the error, where no such rate exists.
    active : bool
        Whether the value is at a limit.
    met : bool
        False where the limit is violated beyond tolerance.
    """

    name: str
    kind: str
    value: float
    lower: float
    upper: float
    multiplier: float
    active: bool
    met: bool = True

    def __str__(self) -> str:
        if not self.met:
            short = max(self.lower - self.value, self.value - self.upper)
            return f"{self.name}: NOT MET, off by {short:.3g}"
        cost = f", multiplier {self.multiplier:.3g}" if np.isfinite(self.multiplier) else ""
        return f"{self.name}: {self.value:.9g}, {f'active{cost}' if self.active else 'not active'}"


def describe_unknown_multipliers(limits: Sequence[Limit], status: Status) -> str:
    """Explain why multipliers of active constraints are unknown; empty where they are known."""
    names = [
        limit.name for limit in limits if limit.kind == "constraint" and limit.active and np.isnan(limit.multiplier)
    ]
    if not names:
        return ""
    why = (
        "the solver ended in very small steps, as at a kink of the error, where the rate differs on both sides"
        if status is Status.SMALL_STEP
        else "the point was not reached by a step of a solver"
    )
    return f"multipliers are not known ({', '.join(names)}): {why}"


def limits_of(problem: Problem, solution: Solution) -> tuple[Limit, ...]:
    """Return all general constraints and the active bounds at a solution."""
    theta, n = solution.theta, problem.size
    known = len(solution.multipliers) == n + len(problem.g_lower)
    size = np.abs(solution.multipliers) if known else np.full(n + len(problem.g_lower), np.nan)
    out: list[Limit] = []
    if len(problem.g_lower):
        g, low, high = problem.constraint(theta), problem.g_lower, problem.g_upper
        unit = np.maximum(problem.constraint_units(theta), 1e-300)
        met = problem.excess(theta) <= FEASIBILITY_TOLERANCE * unit
        # a solver may stop a little short of an active limit
        near = (size[n:] > 0) & (np.minimum(g - low, high - g) <= 10 * FEASIBILITY_TOLERANCE * unit)
        active = problem.active_constraints(theta) | near
        checks = [c.check for c, k in zip(problem.constraints, problem.g_sizes, strict=True) for _ in range(k)]
        values = problem.values(theta)
        for i, (name, check) in enumerate(zip(problem.g_labels, checks, strict=True)):
            if isinstance(check, RadiusExcess):
                pushes = not known or bool(size[n + i] > ACTIVE_MULTIPLIER * solution.cost)
                out.append(_radius_limit(name, check, values, float(size[n + i]), pushes))
                continue
            numbers = float(g[i]), float(low[i]), float(high[i]), float(size[n + i] if active[i] else 0.0)
            out.append(Limit(name, "constraint", *numbers, active=bool(active[i]), met=bool(met[i])))
    at = (theta == problem.lower) | (theta == problem.upper)
    for i in map(int, np.flatnonzero(at)):
        numbers = float(theta[i]), float(problem.lower[i]), float(problem.upper[i]), float(size[i])
        out.append(Limit(str(problem.labels[i]), "bound", *numbers, active=True))
    return tuple(out)


def _radius_limit(name: str, check: RadiusExcess, values: Mapping[str, Any], force: float, pushes: bool) -> Limit:
    """Describe a bound on a spectral radius; `force` is the multiplier of its logarithm, `pushes` whether it counts."""
    excess, bound = check(values), check.radius
    active = -excess <= AT_RADIUS * bound and (pushes or -excess <= 10 * FEASIBILITY_TOLERANCE * bound)
    multiplier = force / bound if active else 0.0
    return Limit(name, "constraint", excess + bound, -np.inf, bound, multiplier, active, met=excess <= 0)


def check_solver_options(solver: Any) -> None:
    """Refuse options of a solver that are no numbers, or below zero."""
    for name in ("max_iterations", "patience"):
        whole(getattr(solver, name), name, 0)
    for name in ("tolerance", "damping"):
        positive(getattr(solver, name), name, zero=True)
    if not is_number(solver.time_limit) or np.isnan(solver.time_limit):  # it may be negative: then no time is left
        raise InputError(f"time_limit={solver.time_limit!r} was given; give a number of seconds.")
