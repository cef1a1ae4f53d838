"""The jobs of a run: independent identifications with stable ids, and keys that reveal outdated results.

The id of a job states how it differs from the others (`seed-0`). Its key is the SHA-256 of everything that its model
depends on: the contents of the recordings it reads, how they are read, model, solver, constraints, seed, versions, and
in a cross-validation the samples that its fold fits and holds out. A job is finished if the manifest has its key and
the folder its model.

A cross-validation divides the training recordings into parts and holds each out once. With at least as many different
inputs as folds, whole recordings are assigned to the folds in turn, recordings of one input together. With fewer, every
recording is cut into one block per fold. The state after a cut is estimated; in a held-out block the samples used for
this are not scored (`Fit.scored_from`). A repeating input, as in steady periods, is not cut but refused, because the
other blocks contain the same input.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, digest, read_bytes
from ..data import NOTHING_SENTENCE, Recording, explains_nothing, fingerprint, group_by_input, repeats_itself
from ..export import model_text
from ..identify import Fit, fit as identify, operators_used, prune, regularization_path
from ..models import Model
from ..optimise import Solution, Status
from .executor import FAILED, LOST, TIMED_OUT, Outcome, versions
from .run_file import ROLES, Run

Recordings = Mapping[str, tuple[Recording, ...]]
WITHOUT_MODEL = (FAILED, TIMED_OUT, LOST, Status.INFEASIBLE.name)  # statuses of jobs without a model
MODEL = "model.json"
FEWEST_SAMPLES = 20  # per block of a cross-validation, to estimate its initial state


@dataclass(frozen=True, eq=False)
class RunJob:
    """One identification: its parameters, the key of everything it depends on, and its cell of the grid."""

    parameters: Mapping[str, Any]
    key: str
    cell: int = 0

    @property
    def id(self) -> str:
        """Name of the job, the same in every execution of the run."""
        return "_".join(f"{name}-{value}" for name, value in self.parameters.items())

    @property
    def fold(self) -> int | None:
        """Number of the held-out fold; None without cross-validation."""
        return self.parameters.get("fold")

    @property
    def model_file(self) -> str:
        """Path of the model file below the folder of the run."""
        return f"jobs/{self.id}/{MODEL}"


def input_digests(run: Run) -> dict[str, str]:
    """Return the SHA-256 of every recording, by its name in the run file."""
    return {name: digest(read_bytes(run.path_of(name))) for names in run.files.values() for name in names}


def jobs_of(run: Run, inputs: Mapping[str, str], train: Sequence[Recording] | None = None) -> tuple[RunJob, ...]:
    """List one job per cell and seed, or, given the training recordings, one per cell, fold and seed."""
    read = run.files["train"] + (run.files["validation"] if run.regularization.path else ())
    common = {
        "program": digest(read_bytes(run.file)) if run.own else None,
        "reading": {k: list(v) if isinstance(v, tuple) else v for k, v in run.reading.items()},
        "data": [[name, inputs[name]] for name in read],
        "engine": run.engine,
        "versions": versions(),
    }
    if train is None:
        folds: list[Any] = [({}, {})]
    else:
        parts = [fold(train, k, run.folds) for k in range(run.folds)]
        dealt = [[[(fingerprint(r), r.skip) for r in part] for part in both] for both in parts]
        folds = [({"fold": k}, {"fold": k, "dealt": own}) for k, own in enumerate(dealt)]
    return tuple(
        RunJob(
            {**cell.values, **name, "seed": seed},
            digest({**common, "said": {**run.plain_tables, "grid": None, **cell.plain_tables}, "seed": seed, **held}),
            number,
        )
        for number, cell in enumerate(run.cells)
        for name, held in folds
        for seed in run.seeds
    )


def fold(recordings: Sequence[Recording], k: int, folds: int) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """Return the fitted and the held-out recordings of fold k of `folds`.

    Recordings that are too short to be cut, and blocks with the same input as the other blocks, are refused.
    """
    groups = group_by_input(recordings)
    if len(groups) >= folds:
        out = {i for number, group in enumerate(groups) if number % folds == k for i in group}
        fitted = tuple(r for i, r in enumerate(recordings) if i not in out)
        return fitted, tuple(recordings[i] for i in sorted(out))
    train: list[Recording] = []
    held: list[Recording] = []
    for r in recordings:
        first, last = (r.skip + round(share * (len(r) - r.skip) / folds) for share in (k, k + 1))
        if last - first < FEWEST_SAMPLES:
            raise InputError(f"{r.label} has {len(r)} samples, too few for {folds} folds; give fewer folds.")
        if repeats_itself(r):
            fewer = f"folds = {len(groups)}, " if len(groups) > 1 else ""
            raise InputError(
                f"folds = {folds} was given and the input of {r.label} repeats, so a held-out block has the same "
                f"input as the fitted ones and proves nothing; give {fewer}other realizations, or validation data."
            )
        held.append(r.slice(first, last))
        if k > 0:
            train.append(r.slice(0, first))
        if k < folds - 1:
            train.append(r.slice(last))
    return tuple(train), tuple(held)


def execute_job(
    run: Run,
    recordings: Recordings,
    job: RunJob,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Identify the model of a job and compute its errors."""
    found = _identify(run, recordings, job, executor, progress)
    fit = _drop_times(found)
    if fit.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    nothing = explains_nothing(fit.train_nrmse)
    entry = {
        "status": fit.status.name,
        "train": float(np.mean(fit.train_nrmse)),
        "operators_used": operators_used(fit),
        "explains_nothing": nothing,
    }
    if fit.status is Status.INFEASIBLE:
        missed = "; ".join(str(limit) for limit in fit.limits if not limit.met)
        return Outcome({**entry, "sentence": f"{fit.status.value} ({missed})"}, found.seconds)
    errors = ", ".join(f"{e:.4f}" for e in fit.train_nrmse)
    entry["sentence"] = f"NRMSE on training {errors}. {NOTHING_SENTENCE + ' ' if nothing else ''}{fit.status.value}"
    if job.fold is not None:
        return Outcome({**entry, "held": fit.nrmse(fold(recordings["train"], job.fold, run.folds)[1])}, found.seconds)
    scores = {name: error_of(fit, recording) for _, name, recording in scored_files(run, recordings)}
    return Outcome(entry, found.seconds, {MODEL: model_text(fit.content())}, scores)


def scored_files(run: Run, recordings: Recordings) -> Iterator[tuple[str, str, Recording]]:
    """Yield the role, name and recording of every file of a run."""
    for role in ROLES:
        for name, recording in zip(run.files[role], recordings[role], strict=True):
            yield role, name, recording


def error_of(fit: Fit, recording: Recording) -> float | None:
    """Compute the NRMSE (Krikelis et al. 2024, Eq. 27) on a recording; None if it does not exist or is not finite."""
    try:
        error = fit.nrmse(recording)
    except InputError:
        return None
    return error if np.isfinite(error) else None


def _identify(
    run: Run, recordings: Recordings, job: RunJob, executor: Executor | None, progress: Progress | None
) -> Fit:
    """Identify the model of a job; a regularization path also uses the validation recordings."""
    options: dict[str, Any] = {
        "solver": run.solver,
        "stable": run.stable,
        "constraints": run.constraints,
        "engine": run.engine,
    }
    model, search = run.cells[job.cell].model, {}
    if not isinstance(model, Model):
        search = {**run.cells[job.cell].search, "seed": int(job.parameters["seed"]), "executor": executor}
    train = recordings["train"] if job.fold is None else fold(recordings["train"], job.fold, run.folds)[0]
    sparse = run.regularization
    l1 = {"w": sparse.l1} if sparse.l1 else None
    found = identify(model, train, **options, **search, l1=l1, progress=progress)
    if found.status is Status.INTERRUPTED:
        return found
    if l1 and sparse.prune is not False and found.structure is not None:
        return prune(found, train, **options)
    if sparse.path:
        options |= {"strengths": None if sparse.path is True else sparse.path, "margin": sparse.margin}
        return regularization_path(found, train, recordings["validation"], progress=progress, **options).fit
    return found


def _drop_times(fit: Fit) -> Fit:
    """Drop the computing times of a fit, which differ in every execution."""

    def timeless(solution: Solution) -> Solution:
        return replace(solution, seconds=0.0, history=tuple(replace(h, seconds=0.0) for h in solution.history))

    candidates = tuple(replace(c, solution=timeless(c.solution)) for c in fit.candidates)
    return replace(fit, seconds=0.0, solution=timeless(fit.solution), candidates=candidates)
