"""The folder of a run: the manifest, the models and tables, and which jobs are complete.

The manifest states what was computed, from which inputs and with which versions, and the SHA-256 of every file. It
carries its own digest, so an edited manifest is noticed; the digests of the files do the same for models and tables. It
holds no times: every file in the folder but `times.json` has the same bytes in every execution of a run on one machine.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, digest, listed, make_folder, write_atomically
from ..identify import load
from ..models import Model
from .jobs import (
    BAD_ENDS,
    FAILED,
    LOST,
    TIMED_OUT,
    Outcome,
    Recordings,
    RunJob,
    error_of,
    file_digest,
    scored_files,
    versions,
)
from .schema import Run
from .summary import Score, results_table

FORMAT, VERSION, MANIFEST = "pilfr_casadi run", 1, "manifest.json"
TABLE, PAGE, MODEL, TIMES, JOBS, LOCK = "results.csv", "report.html", "model.json", "times.json", "jobs", ".lock"
SUMMARY, PICTURE = "summary.csv", "spread.png"  # of a campaign
OWN = (MANIFEST, TABLE, PAGE, MODEL, SUMMARY, PICTURE, TIMES, JOBS)
TABLE_PAUSE = 1.0  # seconds between two tables of a running campaign
ADVICE = "restore it, or give --overwrite to compute everything again"


def check_own(folder: Path, file: Path, overwrite: bool) -> None:
    """Refuse a folder that holds the run file, or files that no run wrote."""
    target = os.path.realpath(folder)
    if target in map(str, Path(os.path.realpath(file)).parents):
        raise InputError(f"The folder {folder} holds the run file {file.name}; give the results another folder.")
    if not os.path.isdir(target):
        return
    try:
        found = sorted(name for name in os.listdir(target) if name != LOCK and not _is_half_written(name))
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give another one.") from None
    if MANIFEST in found:
        return
    foreign = [name for name in found if name not in OWN]
    if foreign:
        raise InputError(
            f"{folder} holds {listed(foreign, 3)} and no manifest of a run; give an empty or a new folder as --out."
        )
    if found and not overwrite:
        raise InputError(f"{folder} holds {found[0]} but no manifest of a run; give another --out, or --overwrite.")


def _is_half_written(name: str) -> bool:
    """Tell whether a file is the half-written file of a run, by the names that `write_atomically` gives."""
    return re.fullmatch(rf"\.({'|'.join(map(re.escape, OWN))})\.[0-9a-f]{{8}}\.tmp", name) is not None


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs, and remove half-written files."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError):  # on systems without such locks
            import fcntl

            try:
                lock = stack.enter_context((folder / LOCK).open("w"))
            except OSError as error:
                raise InputError(f"The folder {folder} cannot be written ({error.strerror}); give another.") from None
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(f"Another run is at work in {folder}; wait for it, or give another --out.") from None
        for path in (*folder.iterdir(), *folder.glob(f"{JOBS}/*/.*")):
            if _is_half_written(path.name):
                path.unlink(missing_ok=True)
        yield


def read_times(folder: Path) -> dict[str, float]:
    """Read the seconds that each job took, as far as they are known."""
    try:
        found = json.loads((folder / TIMES).read_text(encoding="utf-8"))
        return {str(job): float(seconds) for job, seconds in found.items()}
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return {}


class Manifest:
    """The manifest in a folder, rewritten atomically after every step."""

    def __init__(self, folder: Path, content: dict[str, Any] | None = None) -> None:
        tables: dict[str, Any] = {key: {} for key in ("jobs", "scores", "files", "inputs")}
        self.folder = folder
        self.content = content or {"format": FORMAT, "version": VERSION, **tables}

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read the manifest of an earlier run, or start an empty one; refuse one that was changed."""
        path = folder / MANIFEST
        if not path.exists():
            return cls(folder)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise InputError(f"{path} is not a manifest of a run; {ADVICE}.")
        if content.get("format") != FORMAT or content.get("version") != VERSION:
            raise InputError(f"{path} is not a manifest that this release writes; {ADVICE}.")
        if content.pop("sha256", None) != digest(content):
            raise InputError(f"{path} was changed after the run wrote it; {ADVICE}.")
        return cls(folder, content)

    def write(self) -> None:
        """Write it, with its digest."""
        content = {**self.content, "sha256": digest(self.content)}
        text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
        write_atomically(self.folder / MANIFEST, text + "\n")

    def holds(self, name: str) -> bool:
        """Tell whether a file of the run is there; refuse one that was changed."""
        path = self.folder / name
        if name not in self.content["files"] or not path.is_file():
            return False
        # if a run ended after writing a file and before the manifest, the manifest announced the file beforehand
        expected = self.content["files"][name], self.content.get("writing", {}).get(name)
        if file_digest(path) not in expected:
            raise InputError(
                f"{path} was changed after the run wrote it; restore it, remove it, or give --overwrite to compute "
                "everything again."
            )
        return True

    def put(self, name: str, content: str | bytes) -> None:
        """Write a file of the run and its digest in the manifest, unless both are up to date."""
        data = content.encode() if isinstance(content, str) else content
        if self.content["files"].get(name) != digest(data) or not self.holds(name):
            self.put_all({name: data})

    def put_all(self, contents: Mapping[str, bytes], jobs: Mapping[str, Any] | None = None) -> None:
        """Announce files in the manifest, write them, then record their digests and the entries of their jobs."""
        found = {name: digest(data) for name, data in contents.items()}
        if contents:
            self.content["writing"] = found
            self.write()
        for name, data in contents.items():
            make_folder((self.folder / name).parent)
            write_atomically(self.folder / name, data)
        self.content["files"] |= found
        self.content["jobs"] |= jobs or {}
        self.write()


class Store:
    """The results of a run on disk, read and written; files that were changed afterwards are refused."""

    def __init__(
        self, path: Path, run: Run, inputs: Mapping[str, str], recordings: Recordings, overwrite: bool, campaign: bool
    ) -> None:
        self.path, self.run, self.inputs, self.recordings, self.campaign = path, run, inputs, recordings, campaign
        self.manifest = Manifest(path) if overwrite else Manifest.read(path)
        for name in (TABLE, MODEL, PAGE, SUMMARY, PICTURE):
            self.manifest.holds(name)
        if campaign:
            _refuse_other_versions(self.manifest)
        described = {"file": run.file.name, "said": run.plain_tables}
        self.manifest.content |= {"run": described, "versions": versions(), "inputs": dict(inputs)}
        self.manifest.write()
        self.written = -np.inf

    @property
    def entries(self) -> dict[str, Any]:
        """The entries of the jobs in the manifest."""
        entries: dict[str, Any] = self.manifest.content["jobs"]
        return entries

    def complete(self, job: RunJob) -> bool:
        """Tell whether a job is finished with the same inputs, and its model is unchanged on disk."""
        entry = self.entries.get(job.id, {})
        if entry.get("key") != job.key or entry["status"] == LOST:
            return False
        if entry["status"] == TIMED_OUT:  # tried again with more time
            return self.campaign and self.run.time_limit is not None and self.run.time_limit <= entry["time_limit"]
        if entry["status"] == FAILED:
            return self.campaign
        return not self.has_model(job) or self.manifest.holds(job.model_file)

    def ended_well(self, job: RunJob) -> bool:
        """Tell whether a job gave a model that meets its constraints."""
        return self.entries[job.id]["status"] not in BAD_ENDS

    def has_model(self, job: RunJob) -> bool:
        """Tell whether the folder has a model of a job."""
        return job.fold is None and self.ended_well(job)

    def record(self, batch: Sequence[tuple[RunJob, Outcome]]) -> None:
        """Write the models of finished jobs, then their entries in the manifest."""
        entries = {job.id: {**job.parameters, "key": job.key, **found.entry} for job, found in batch}
        models = {job.model_file: found.model.encode() for job, found in batch if found.model is not None}
        for job, found in batch:
            for name, error in found.errors.items():
                self.manifest.content["scores"][self._score_key(digest(models[job.model_file]), name)] = error
        times = read_times(self.path) | {job.id: round(found.seconds, 3) for job, found in batch}
        write_atomically(self.path / TIMES, json.dumps(times, indent=1, sort_keys=True) + "\n")
        self.manifest.put_all(models, entries)

    def scores(self, jobs: Sequence[RunJob], last: bool = False) -> list[Score]:
        """Return the errors of the jobs' models, computed where the manifest lacks them; `last` drops other entries."""
        out, used, known = [], set(), self.manifest.content["scores"]
        for job in (j for j in jobs if self.ended_well(j)):
            if job.fold is not None:
                entry, name = self.entries[job.id], f"fold {job.fold}"
                out += [Score(job.id, "train", name, entry["train"]), Score(job.id, "held", name, entry["held"])]
                continue
            fit = None
            for role, name, recording in scored_files(self.run, self.recordings):
                key = self._score_key(self.manifest.content["files"][job.model_file], name)
                if key not in known:
                    fit = fit or self.load(job)
                    known[key] = error_of(replace(fit, engine=self.run.engine), recording)
                used.add(key)
                out.append(Score(job.id, role, name, np.nan if known[key] is None else float(known[key])))
        if last:
            self.manifest.content["scores"] = {key: error for key, error in known.items() if key in used}
        return out

    def load(self, job: RunJob) -> Any:
        """Load the model of a job."""
        own = self.run.cells[job.cell].model
        return load(self.path / job.model_file, model=own if isinstance(own, Model) else None)

    def _score_key(self, model: str, name: str) -> str:
        reading = {k: str(v) for k, v in self.run.reading.items()}
        return digest({"model": model, "data": self.inputs[name], "reading": reading})

    def write_table(self, jobs: Sequence[RunJob], last: bool = False) -> None:
        """Write the errors so far while a campaign runs, at most once per `TABLE_PAUSE` unless it is the last table."""
        if not self.campaign or (not last and time.monotonic() < self.written + TABLE_PAUSE) or not jobs:
            return
        self.manifest.put(TABLE, results_table(self.scores(jobs), jobs, self.entries, ""))
        self.written = time.monotonic()


def _refuse_other_versions(manifest: Manifest) -> None:
    """Refuse to mix results of different versions in one campaign, which compares its results."""
    before, now = manifest.content.get("versions", {}), versions()
    for name in now:
        if manifest.content["jobs"] and before.get(name) != now[name]:
            raise InputError(
                f"{manifest.folder / MANIFEST} has results of {name} {before.get(name)}, and this is {now[name]}; give "
                "another --out, or --overwrite to compute everything again."
            )
