"""What holds a solution: its constraints and active bounds, each with its value and its multiplier.

The multiplier of a limit is the rate at which the objective (Krikelis et al. 2024, Eq. 20, half the mean squared error
over the output's deviation) would fall if the limit were moved outwards: it says what a constraint costs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .constraints import TOLERATED, BeyondRadius
from .problem import Problem
from .solution import Solution, Status

AT_RADIUS = 1e-3  # share of a bound by which a radius that it holds may lie inside
FELT = 1e-3  # multiplier next to the logarithm of a radius, in units of the objective, from which a bound holds it


@dataclass(frozen=True)
class Limit:
    """A general constraint, or a bound that is active, at a solution.

    Attributes
    ----------
    name : str
        The constraint's or the variable's name.
    kind : str
        "constraint" or "bound".
    value, lower, upper : float
        The expression's value and its limits; infinite where there is none. Of a bound on a spectral radius the radius
        itself, by the eigenvalues of the result, and what it is to be at most.
    multiplier : float
        Fall of the objective for each unit that the limit is moved outwards; 0 where it is not active, nan where the
        solver gave none, or ended at a kink of the error, where there is no such rate.
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


def unknown_multipliers(limits: Sequence[Limit], status: Status) -> str:
    """That multipliers of active constraints are not known, empty where they are."""
    names = [
        limit.name for limit in limits if limit.kind == "constraint" and limit.active and np.isnan(limit.multiplier)
    ]
    if not names:
        return ""
    why = "no step of a solver has led to this point"
    if status is Status.SMALL_STEP:
        why = "the solver ended in steps too small to matter, as at a kink of the error, where no rate holds on both "
        why += "sides"
    return f"multipliers are not known ({', '.join(names)}): {why}"


def limits_of(problem: Problem, solution: Solution) -> tuple[Limit, ...]:
    """All general constraints and the bounds that are active, as they are at a solution."""
    theta, n = solution.theta, problem.size
    known = len(solution.multipliers) == n + len(problem.g_lower)
    size = np.abs(solution.multipliers) if known else np.full(n + len(problem.g_lower), np.nan)
    out: list[Limit] = []
    if len(problem.g_lower):
        g, low, high = problem.constraint(theta), problem.g_lower, problem.g_upper
        unit = np.maximum(problem.constraint_units(theta), 1e-300)
        met = np.maximum(low - g, g - high) <= TOLERATED * unit
        # a solver may stop a little short of a limit that holds it
        near = (size[n:] > 0) & (np.minimum(g - low, high - g) <= 10 * TOLERATED * unit)
        active = problem.active_constraints(theta) | near
        checks = [c.check for c, k in zip(problem.constraints, problem.g_sizes, strict=True) for _ in range(k)]
        values = problem.model.parameters.unpack(problem.parameters(theta))
        for i, (name, check) in enumerate(zip(problem.g_labels, checks, strict=True)):
            if isinstance(check, BeyondRadius):
                felt = not known or bool(size[n + i] > FELT * solution.cost)
                out.append(_radius(name, check, values, float(size[n + i]), felt))
                continue
            numbers = float(g[i]), float(low[i]), float(high[i]), float(size[n + i] if active[i] else 0.0)
            out.append(Limit(name, "constraint", *numbers, active=bool(active[i]), met=bool(met[i])))
    at = (theta == problem.lower) | (theta == problem.upper)
    for i in map(int, np.flatnonzero(at)):
        numbers = float(theta[i]), float(problem.lower[i]), float(problem.upper[i]), float(size[i])
        out.append(Limit(str(problem.labels[i]), "bound", *numbers, active=True))
    return tuple(out)


def _radius(name: str, check: BeyondRadius, values: Mapping[str, Any], force: float, felt: bool) -> Limit:
    """A bound on a spectral radius; `force` is its multiplier next to the logarithm, `felt` if that counts."""
    excess, bound = check(values), check.radius
    active = -excess <= AT_RADIUS * bound and (felt or -excess <= 10 * TOLERATED * bound)
    multiplier = force / bound if active else 0.0
    return Limit(name, "constraint", excess + bound, -np.inf, bound, multiplier, active, met=excess <= 0)
