"""The ways to a fit: from values, to a linear model alone, and from starts; what they share stands in `job`.

A fit from values is that of an earlier fit, of a closed model of one's own, or of a structure with values by name.
`multistart` says how one from starts goes. Where an L1 penalty is asked for, a last solve follows (`penalty`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError, filled
from ..data import Recording
from ..models import PILFR, Model
from ..optimise import Problem, Solution, Status, beyond
from .job import Job, Stage, interrupted, penalised, rms_error
from .known_blocks import known_entries
from .multistart import KEEP, search_starts
from .penalty import check_penalty
from .result import Fit
from .search import Candidate


def at_values(structure: PILFR, first: Recording, values: Mapping[str, Any]) -> Model:
    """The model of a structure at values given by name, with a recording's names of inputs and outputs."""
    model = structure.model(first.n_u, first.n_y, inputs=first.inputs, outputs=first.outputs)
    unknown = sorted(set(values) - set(model.parameters))
    if unknown:
        raise InputError(
            f"The start has a value for {unknown[0]!r}, which the model lacks; it has {', '.join(model.parameters)}."
        )
    changes = {}
    for name, value in values.items():
        p = model.parameters[name]
        given = filled(value, f"The start of {name!r}", p.value.shape)
        changes[name] = {"value": np.where(p.fixed & (name in structure.fixed), p.value, np.clip(given, *p.bounds))}
    return model.with_parameters(model.parameters.change(**changes))


def from_values(model: Model, structure: PILFR | None, job: Job, earlier: Fit | None) -> Fit:
    """A closed model or an earlier fit, from its values, and from the initial states that the fit has or estimates."""
    if job.l1:
        check_penalty(job.l1, model.parameters, structure is not None and structure.element is None)
    options: dict[str, Any] = {"l1": {} if structure else job.l1}
    problem = job.problem(model, **options)
    if not np.isfinite(problem.cost(problem.start)):
        raise InputError("The simulation diverges at the start values; start from a stable model.")
    start = problem.start
    if earlier is not None:
        estimated = [r for r in job.recordings if r.begins == "estimate"]
        begin = np.concatenate([start[: int(problem.free.sum())], *(earlier.initial_state(r) for r in estimated)])
        start = begin if problem.cost(begin) < problem.cost(start) else start
    latest = model, problem, job.solve(problem, "solve", start), ""
    try:
        problem, solution = job.settled(problem, latest[2], "solve", **options)
        latest = model, problem, solution, ""
        if job.l1 and structure:
            latest = penalised(model, problem, solution, job, problem.noise)
    except KeyboardInterrupt:
        latest = interrupted(*latest)
    model, problem, solution, note = latest
    return job.result(model, structure, problem, solution, note=note)


def linear_only(structure: PILFR, fitted: Model, job: Job) -> Fit:
    """A linear model with the structure's bounds and fixed blocks, from the one without."""
    values = {k: p.value for k, p in fitted.parameters.items()}
    first = job.recordings[0]
    model = structure.model(first.n_u, first.n_y, values, inputs=fitted.inputs, outputs=fitted.outputs)
    problem = job.problem(model)
    latest = problem, job.solve(problem, "solve")
    try:
        latest = job.settled(*latest, "solve")
    except KeyboardInterrupt:
        latest = problem, replace(latest[1], status=Status.INTERRUPTED)
    return job.result(model, structure, *latest)


def from_starts(
    structure: PILFR,
    linear: Model,
    problem: Problem,
    solution: Solution,
    job: Job,
    starts: int,
    seed: int,
    start: str,
    executor: Executor | None,
) -> Fit:
    """A PI-LFR from many starts; `problem` and `solution` are those of the linear model."""
    blocks = {k: p.value for k, p in linear.parameters.items()}
    level, coordinates = rms_error(problem, solution), not known_entries(structure)
    told = job.progress if executor is None else None
    search = job.search(structure, blocks, start=start, level=level, coordinates=coordinates, progress=told)
    least: list[float] = [np.inf]

    def report(stage: str, found: list[Candidate], total: int) -> None:
        least.append(min([least[-1], *(c.error for c in found)]))
        if job.progress:
            job.progress(stage, len(found), total, least[-1] if np.isfinite(least[-1]) else np.nan)

    candidates, best, stopped = search_starts(search, starts, seed, executor, report)
    if best is None:
        ended = replace(solution, status=Status.INTERRUPTED)
        return job.result(linear, structure.linear(), problem, ended)
    compared: dict[str, Any] = {"linear": linear, "linear_nrmse": tuple(problem.nrmse(solution.theta))}
    model, note, l1 = best.model, best.note, job.l1 and not stopped
    if l1:  # the penalty and a prior towards a smooth density contradict each other
        asked = {name: {"prior": structure.priors.get(name)} for name in ("w", "r")}
        model, note = model.with_parameters(model.parameters.change(**asked)), ""
    problem = job.problem(model, best.error)
    latest = model, problem, best.solution, note
    try:
        if stopped:
            latest = interrupted(*latest)
        elif start == "grid" or beyond(problem, best.theta):
            latest = model, problem, job.solve(problem, "solve", best.theta), note
        model, problem, result, note = latest = _from_others(latest, candidates, job)
        if structure.priors and not stopped:
            problem, result = job.settled(problem, result, "solve")
            latest = model, problem, result, note
        if l1:
            latest = penalised(model, problem, latest[2], job, problem.noise)
    except KeyboardInterrupt:
        latest = interrupted(*latest)
    model, problem, result, note = latest
    return job.result(model, structure, problem, result, candidates=tuple(candidates), note=note, **compared)


def _from_others(latest: Stage, candidates: Sequence[Candidate], job: Job) -> Stage:
    """The same or, where its last solve misses the constraints, that from the best start which had met them."""
    usable = [c for c in candidates if c.solution.status is not Status.INFEASIBLE and np.isfinite(c.error)]
    for other in sorted(usable, key=lambda c: c.error)[:KEEP]:
        if latest[2].status is not Status.INFEASIBLE:
            break
        problem = job.problem(other.model, other.error)
        found = job.solve(problem, "solve", other.theta)
        if found.status is not Status.INFEASIBLE:
            return other.model, problem, found, other.note
    return latest
