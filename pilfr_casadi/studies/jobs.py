"""The jobs of a run: independent identifications with ids that stay, and keys that say what each depends on.

The id of a job names what sets it apart from the others (`seed-0`). Its key is the SHA-256 of everything that its model
depends on: the contents of the recordings it reads, how they are read, model, solver, constraints, seed, versions, and
in a cross-validation what its fold is fitted to and held out. A job whose key is known and whose model is there has
been done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress
from ..data import NOTHING_SENTENCE, Recording, explains_nothing, fingerprint
from ..export import digest, model_text
from ..identify import Fit, fit as identify, operators_used, prune, regularization_path
from ..models import Model
from ..optimise import Solution, Status
from .described import Run
from .folds import fold
from .manifest import file_digest, versions

Recordings = Mapping[str, tuple[Recording, ...]]
# how a job of a campaign may end besides a solver's status
FAILED, TIMED_OUT, LOST = "FAILED", "TIMED_OUT", "LOST"


@dataclass(frozen=True, eq=False)
class RunJob:
    """One identification: what sets it apart, what it depends on, and its place in the grid."""

    parameters: Mapping[str, Any]
    key: str
    cell: int = 0

    @property
    def id(self) -> str:
        """A name that is the same in every execution of the run."""
        return "_".join(f"{name}-{value}" for name, value in self.parameters.items())

    @property
    def fold(self) -> int | None:
        """Which part of the training it holds out; None where none."""
        return self.parameters.get("fold")

    @property
    def model_file(self) -> str:
        """Its model, below the folder of the run."""
        return f"jobs/{self.id}/model.json"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a job amounts to: its line of the manifest, the time it took, its model file, its NRMSE by recording."""

    entry: dict[str, Any]
    seconds: float = 0.0
    model: str | None = None
    errors: Mapping[str, float | None] = field(default_factory=dict)


Batch = list[tuple[RunJob, Outcome]]  # jobs that ended together


def input_digests(run: Run) -> dict[str, str]:
    """SHA-256 of every recording by its name in the run file."""
    return {name: file_digest(run.located(name)) for names in run.files.values() for name in names}


def jobs_of(run: Run, inputs: Mapping[str, str], train: Sequence[Recording] | None = None) -> tuple[RunJob, ...]:
    """One job a cell and seed.

    Parameters
    ----------
    run : Run
    inputs : mapping
        SHA-256 by file name, from `input_digests`.
    train : sequence of Recording, optional
        The training recordings; the jobs then are those of the cross-validation: one a cell, seed and fold, whose
        models hold one fold out.
    """
    read = run.files["train"] + (run.files["validation"] if run.path is not None else ())
    common = {
        "program": file_digest(run.file) if run.own else None,
        "reading": {k: list(v) if isinstance(v, tuple) else v for k, v in run.reading.items()},
        "data": [[name, inputs[name]] for name in read],
        "engine": run.engine,
        "versions": versions(),
    }
    dealt: dict[int | None, Any] = {None: {}}
    if train is not None:
        dealt = {k: {"fold": k, "dealt": _contents(fold(train, k, run.folds))} for k in range(run.folds)}
    jobs = []
    for number, cell in enumerate(run.cells):
        said = {"said": {**run.said, "grid": None, **cell.said}}
        for part, about in dealt.items():
            own = {} if part is None else {"fold": part}
            for seed in run.seeds:
                key = digest({**common, **said, "seed": seed, **about})
                jobs.append(RunJob({**cell.values, **own, "seed": seed}, key, number))
    return tuple(jobs)


def _contents(parts: Sequence[Sequence[Recording]]) -> list[list[tuple[str, int]]]:
    """What recordings of several roles hold, in short."""
    return [[(fingerprint(r), r.skip) for r in part] for part in parts]


def outcome(
    run: Run,
    recordings: Recordings,
    job: RunJob,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Do a job: identify its model and judge it.

    Raises
    ------
    InputError
        If the model cannot be identified.
    KeyboardInterrupt
        On Ctrl-C.
    """
    fit = timeless(found := _identified(run, recordings, job, executor, progress))
    if fit.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    missed = [str(limit) for limit in fit.limits if not limit.met]
    infeasible = fit.status is Status.INFEASIBLE
    nothing = explains_nothing(fit.train_nrmse)
    training = f"NRMSE on training {', '.join(f'{e:.4f}' for e in fit.train_nrmse)}."
    training += f" {NOTHING_SENTENCE}" if nothing else ""
    about = {
        "status": fit.status.name,
        "sentence": f"{fit.status.value} ({'; '.join(missed)})" if infeasible else f"{training} {fit.status.value}",
        "train": float(np.mean(fit.train_nrmse)),
        "operators_used": operators_used(fit),
        "explains_nothing": nothing,
    }
    if infeasible:
        return Outcome(about, found.seconds)
    if job.fold is not None:
        return Outcome({**about, "held": fit.nrmse(fold(recordings["train"], job.fold, run.folds)[1])}, found.seconds)
    pairs = ((name, r) for role, names in run.files.items() for name, r in zip(names, recordings[role], strict=True))
    errors = {name: error_of(fit, recording) for name, recording in pairs}
    return Outcome(about, found.seconds, model_text(fit.content()), errors)


def attempt(run: Run, recordings: Recordings, job: RunJob) -> Outcome:
    """A job of a campaign: `outcome`, where one that cannot be done is an outcome too."""
    try:
        return outcome(run, recordings, job)
    except Exception as error:
        if isinstance(error, InputError):
            return unfinished(FAILED, f"Failed: {error}", refused=True)
        return unfinished(FAILED, f"Failed: {type(error).__name__}: {error}")


def unfinished(status: str, sentence: str, **more: Any) -> Outcome:
    """The outcome of a job without a model."""
    return Outcome({"status": status, "sentence": sentence, "operators_used": "", **more})


def error_of(fit: Fit, recording: Recording) -> float | None:
    """NRMSE (Krikelis et al. 2024, Eq. 27) on a recording; None where it cannot be told."""
    try:
        error = fit.nrmse(recording)
    except InputError:
        return None
    return error if np.isfinite(error) else None


def _identified(
    run: Run, recordings: Recordings, job: RunJob, executor: Executor | None, progress: Progress | None
) -> Fit:
    """The model of a job: nothing but its training recordings and, for a path, the validation is looked at."""
    options: dict[str, Any] = {
        "solver": run.solver,
        "stable": run.stable,
        "constraints": run.constraints,
        "engine": run.engine,
    }
    cell = run.cells[job.cell]
    search = (
        {**cell.search, "seed": int(job.parameters["seed"]), "executor": executor}
        if not isinstance(cell.model, Model)
        else {}
    )
    train = recordings["train"] if job.fold is None else fold(recordings["train"], job.fold, run.folds)[0]
    l1 = {"w": run.l1} if run.l1 else None
    found = identify(cell.model, train, **options, **search, l1=l1, progress=progress)
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
