"""The jobs of a run: independent identifications with ids that stay, and keys that say what each depends on.

The id of a job names what sets it apart from the others (`seed-0`). Its key is the SHA-256 of everything that its model
depends on: the contents of the recordings it reads, how they are read, model, solver, constraints, seed, versions. A
job whose key is known and whose model is there has been done.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

from ..fit import fit as identify
from ..fitted import Fit
from ..lfr import PILFR
from ..recording import Recording
from ..solution import Solution, Status
from ..sparse import prune, regularization_path
from .described import Run
from .manifest import digest, file_digest, versions


@dataclass(frozen=True, eq=False)
class RunJob:
    """One identification: what sets it apart, and what it depends on."""

    parameters: Mapping[str, Any]
    key: str

    @property
    def id(self) -> str:
        """A name that is the same in every execution of the run."""
        return "_".join(f"{name}-{value}" for name, value in self.parameters.items())

    @property
    def model_file(self) -> str:
        """Its model, below the folder of the run."""
        return f"jobs/{self.id}/model.json"


def input_digests(run: Run) -> dict[str, str]:
    """SHA-256 of every recording by its name in the run file."""
    return {name: file_digest(run.located(name)) for names in run.files.values() for name in names}


def jobs_of(run: Run, inputs: Mapping[str, str]) -> tuple[RunJob, ...]:
    """One job a seed.

    Parameters
    ----------
    run : Run
    inputs : mapping
        SHA-256 by file name, from `input_digests`.
    """
    read = run.files["train"] + (run.files["validation"] if run.path is not None else ())
    common = {
        "said": run.said,
        "program": file_digest(run.file) if run.own else None,
        "reading": {k: list(v) if isinstance(v, tuple) else v for k, v in run.reading.items()},
        "data": [[name, inputs[name]] for name in read],
        "engine": run.engine,
        "versions": versions(),
    }
    return tuple(RunJob({"seed": seed}, digest({**common, "seed": seed})) for seed in run.seeds)


def execute(
    run: Run,
    job: RunJob,
    recordings: Mapping[str, tuple[Recording, ...]],
    *,
    executor: Executor | None = None,
    progress: Callable[[str, int, int, float], None] | None = None,
) -> Fit:
    """Identify the model of a job: nothing but its training recordings and, for a path, the validation is looked at.

    Returns
    -------
    Fit
        Interrupted ones tell by their status.
    """
    options: dict[str, Any] = {
        "solver": run.solver,
        "stable": run.stable,
        "constraints": run.constraints,
        "engine": run.engine,
    }
    search = (
        {**run.search, "seed": int(job.parameters["seed"]), "executor": executor}
        if isinstance(run.model, PILFR)
        else {}
    )
    train = recordings["train"]
    l1 = {"w": run.l1} if run.l1 else None
    found = identify(run.model, train, **options, **search, l1=l1, progress=progress)
    if found.status is Status.INTERRUPTED:
        return found
    if l1 and run.prune and found.structure is not None:
        return prune(found, train, **options)
    if run.path is not None:
        return regularization_path(
            found,
            train,
            recordings["validation"],
            strengths=run.path or None,
            margin=run.margin,
            progress=progress,
            **options,
        ).fit
    return found


def timeless(fit: Fit) -> Fit:
    """The fit without the times it took, which no second execution would repeat."""
    return replace(
        fit,
        seconds=0.0,
        solution=_timeless(fit.solution),
        candidates=tuple(replace(c, solution=_timeless(c.solution)) for c in fit.candidates),
    )


def _timeless(solution: Solution) -> Solution:
    return replace(solution, seconds=0.0, history=tuple(replace(h, seconds=0.0) for h in solution.history))
