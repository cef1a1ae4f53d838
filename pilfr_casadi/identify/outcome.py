"""What the solution of a problem amounts to: the model at its values, and the `Fit` with its standard errors."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from ..data import Recording, fingerprint
from ..models import PILFR, Model
from ..optimise import Problem, Solution, Status, limits_of, unbounded_sentence
from .gauge import standard_errors
from .multistart import PRIOR
from .open_memory import open_memory_sentence
from .options import Asked
from .reached_gain import reached_gain_sentence
from .result import Fit
from .search import Candidate

FAR = 1e3  # times the error of no output at all, from which a model diverges


def with_solution(model: Model, problem: Problem, solution: Solution) -> Model:
    """The model at the values of a solution."""
    return model.with_parameters(model.parameters.at(problem.parameters(solution.theta)))


def outcome(
    model: Model,
    structure: PILFR | None,
    problem: Problem,
    solution: Solution,
    began: float,
    recordings: tuple[Recording, ...],
    candidates: tuple[Candidate, ...] = (),
    linear: Model | None = None,
    note: str = "",
    linear_nrmse: tuple[float, ...] = (),
    engine: str = "auto",
    minimum: bool = True,
    asked: Asked | None = None,
) -> Fit:
    """The fit that a solution of a problem stands for; `began` is when its work began (`time.perf_counter`).

    Standard errors are those of a `minimum` of the simulation error; where it is none there are none.

    Where the search has put priors of its own (`PRIOR`) on weights and thresholds, neither the model nor the standard
    errors know of them. The note also says which memory a periodic steady state leaves open (`open_memory`), and
    which DC gain holds beyond the recordings alone (`reached_gain`).
    """
    fitted = with_solution(model, problem, solution)
    judged = problem
    if note == PRIOR:
        priors = structure.priors if structure else {}
        fitted = fitted.with_parameters(
            fitted.parameters.change(**{name: {"prior": priors.get(name)} for name in ("w", "r")})
        )
        names = ("constraints", "noise", "scale", "weights")
        options: dict[str, Any] = {name: getattr(problem, name) for name in names}
        judged = Problem(fitted, recordings, engine=problem.engine, **options)
    theta, errors = solution.theta, tuple(problem.nrmse(solution.theta))
    if solution.status.converged and not max(errors) < FAR * _of_nothing(problem):
        solution = replace(solution, status=Status.DIVERGES)
    values = problem.model.parameters.unpack(problem.parameters(theta))
    told = (
        note,
        open_memory_sentence(judged, theta),
        reached_gain_sentence(problem, theta),
        unbounded_sentence(structure, problem.constraints, values),
    )
    note = "; ".join(part for part in told if part)
    at_bound = [
        f"{label} = {value:g}"
        for label, value, low, high in zip(problem.labels, theta, problem.lower, problem.upper, strict=True)
        if value in (low, high)
    ]
    limits = limits_of(problem, solution)
    at_bound += [limit.name for limit in limits if limit.active and limit.kind == "constraint"]
    return Fit(
        model=fitted,
        structure=structure,
        dt=recordings[0].dt,
        solution=solution,
        train_nrmse=errors,
        initial={fingerprint(r): state for r, state in zip(recordings, problem.first_states(theta), strict=True)},
        labels=problem.labels,
        errors=standard_errors(judged, theta, structure) if minimum else {},
        active=tuple(at_bound),
        candidates=candidates,
        linear=linear,
        seconds=time.perf_counter() - began,
        units=dict(recordings[0].units),
        note=note,
        linear_nrmse=linear_nrmse,
        engine=engine,
        limits=limits,
        asked=asked or Asked(),
    )


def _of_nothing(problem: Problem) -> float:
    """The largest NRMSE of any output that a model without outputs has, at least 1."""
    return max(1.0, *(float(np.max(np.sqrt(np.mean(r.y**2, axis=0)) / problem.scale)) for r in problem.recordings))
