"""The folder of a study: the names of its files, its lock, and its manifest.

The manifest lists the jobs, the inputs, the versions, and the SHA-256 of every file. It includes its own digest, which
reveals an edited manifest, as the digests of the files reveal edited models and tables. It has no times: on one
machine, every execution of a run writes the same bytes to all files except `times.json`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._base import InputError, digest, listed, make_folder, read_bytes, write_atomically
from .executor import LOST, TIMED_OUT, Batch, versions
from .jobs import MODEL

VERSION, MANIFEST = 1, "manifest.json"
TABLE, PAGE, TIMES, JOBS, LOCK = "results.csv", "report.html", "times.json", "jobs", ".lock"
SUMMARY, PICTURE = "summary.csv", "spread.png"  # of a campaign
ADVICE = "restore it, or give --overwrite to compute everything again"


@dataclass(frozen=True)
class Layout:
    """The layout of a folder of results: the kind of study, and the names of its files and of its jobs' files.

    `source` names the kind of file that describes the study, for messages.
    """

    kind: str
    source: str
    files: tuple[str, ...]
    job_files: tuple[str, ...]

    @property
    def format(self) -> str:
        """Name of the format in the manifest."""
        return f"pilfr_casadi {self.kind}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all files and folders that the study writes."""
        return (MANIFEST, *self.files, TIMES, JOBS)

    def is_half_written(self, name: str) -> bool:
        """Tell whether a file has the name of a temporary file of `write_atomically`."""
        names = "|".join(map(re.escape, (*self.names, *self.job_files)))
        return re.fullmatch(rf"\.({names})\.[0-9a-f]{{8}}\.tmp", name) is not None


RUN = Layout("run", "run file", (TABLE, MODEL, PAGE, SUMMARY, PICTURE), (MODEL,))


def check_own(folder: Path, file: Path | None, overwrite: bool, layout: Layout = RUN) -> None:
    """Refuse a folder that contains the file of the study, or files that no such study wrote."""
    target, kind = os.path.realpath(folder), layout.kind
    if file is not None and target in map(str, Path(os.path.realpath(file)).parents):
        raise InputError(f"The folder {folder} holds the {layout.source} {file.name}; give the results another folder.")
    if not os.path.isdir(target):
        return
    try:
        found = sorted(name for name in os.listdir(target) if name != LOCK and not layout.is_half_written(name))
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give another one.") from None
    if MANIFEST in found:
        return
    foreign = [name for name in found if name not in layout.names]
    if foreign:
        raise InputError(
            f"{folder} holds {listed(foreign, 3)} and no manifest of a {kind}; give an empty or a new folder as --out."
        )
    if found and not overwrite:
        raise InputError(f"{folder} holds {found[0]} but no manifest of a {kind}; give another --out, or --overwrite.")


@contextlib.contextmanager
def lock_folder(folder: Path, layout: Layout = RUN) -> Iterator[None]:
    """Lock a folder against other processes, and remove temporary files of an interrupted one."""
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
                raise InputError(
                    f"Another {layout.kind} is at work in {folder}; wait for it, or give another --out."
                ) from None
        for path in (*folder.iterdir(), *folder.glob("*/*/.*")):
            if layout.is_half_written(path.name):
                path.unlink(missing_ok=True)
        yield


def read_times(folder: Path) -> dict[str, float]:
    """Read the computing time of each job in seconds, as far as it is known."""
    try:
        found = json.loads((folder / TIMES).read_text(encoding="utf-8"))
        return {str(job): float(seconds) for job, seconds in found.items()}
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return {}


class Manifest:
    """The manifest of a folder, rewritten atomically after every change."""

    def __init__(self, folder: Path, content: dict[str, Any] | None = None, layout: Layout = RUN) -> None:
        tables: dict[str, Any] = {key: {} for key in ("jobs", "scores", "files", "inputs")}
        self.folder, self.layout = folder, layout
        self.content = content or {"format": layout.format, "version": VERSION, **tables}

    @classmethod
    def read(cls, folder: Path, layout: Layout = RUN) -> Manifest:
        """Read the manifest of an earlier study, or start an empty one; refuse an edited manifest."""
        path, kind = folder / MANIFEST, layout.kind
        if not path.exists():
            return cls(folder, layout=layout)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise InputError(f"{path} is not a manifest of a {kind}; {ADVICE}.")
        if content.get("format") != layout.format or content.get("version") != VERSION:
            raise InputError(f"{path} is not a manifest that this release writes; {ADVICE}.")
        if content.pop("sha256", None) != digest(content):
            raise InputError(f"{path} was changed after the {kind} wrote it; {ADVICE}.")
        return cls(folder, content, layout)

    @property
    def entries(self) -> dict[str, Any]:
        """The entries of finished jobs, by id."""
        entries: dict[str, Any] = self.content["jobs"]
        return entries

    def is_settled(self, job: Any, time_limit: float | None) -> bool:
        """Tell whether a job ended with the same inputs, its worker was not lost, and more time, s, would not help."""
        entry = self.entries.get(job.id, {})
        if entry.get("key") != job.key or entry["status"] == LOST:
            return False
        return entry["status"] != TIMED_OUT or (time_limit is not None and time_limit <= entry["time_limit"])

    def write(self) -> None:
        """Write the manifest with its digest."""
        content = {**self.content, "sha256": digest(self.content)}
        text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
        write_atomically(self.folder / MANIFEST, text + "\n")

    def holds(self, name: str) -> bool:
        """Tell whether a file of the study exists; refuse an edited file."""
        path = self.folder / name
        if name not in self.content["files"] or not path.is_file():
            return False
        # the manifest announces a file before it is written, because a run may end between the two
        expected = self.content["files"][name], self.content.get("writing", {}).get(name)
        if digest(read_bytes(path)) not in expected:
            raise InputError(
                f"{path} was changed after the {self.layout.kind} wrote it; restore it, remove it, or give "
                "--overwrite to compute everything again."
            )
        return True

    def put(self, contents: Mapping[str, str | bytes]) -> None:
        """Write files of the study and their digests in the manifest, except those that are up to date."""
        data = {name: text.encode() if isinstance(text, str) else text for name, text in contents.items()}
        known = self.content["files"]
        self.put_all({k: d for k, d in data.items() if known.get(k) != digest(d) or not self.holds(k)})

    def put_all(self, contents: Mapping[str, bytes], jobs: Mapping[str, Any] | None = None) -> None:
        """Announce files in the manifest, write them, then record their digests and the entries of the jobs."""
        found = {name: digest(data) for name, data in contents.items()}
        if not contents and not jobs:
            return
        if contents:
            self.content["writing"] = found
            self.write()
        for name, data in contents.items():
            make_folder((self.folder / name).parent)
            write_atomically(self.folder / name, data)
        self.content["files"] |= found
        self.content["jobs"] |= jobs or {}
        self.write()

    def record(self, batch: Batch) -> None:
        """Write the times and files of finished jobs, then their entries."""
        times = read_times(self.folder) | {job.id: round(found.seconds, 3) for job, found in batch}
        write_atomically(self.folder / TIMES, json.dumps(times, indent=1, sort_keys=True) + "\n")
        files = {f"{JOBS}/{job.id}/{name}": text for job, found in batch for name, text in found.files.items()}
        data = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
        self.put_all(data, {job.id: {**job.parameters, "key": job.key, **found.entry} for job, found in batch})


def refuse_other_versions(manifest: Manifest) -> None:
    """Refuse to mix results of different versions, because a study compares its results."""
    before, now = manifest.content.get("versions", {}), versions()
    for name in now:
        if manifest.entries and before.get(name) != now[name]:
            raise InputError(
                f"{manifest.folder / MANIFEST} has results of {name} {before.get(name)}, and this is {now[name]}; give "
                "another --out, or --overwrite to compute everything again."
            )
