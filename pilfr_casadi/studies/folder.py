"""The folder of a run's results: one of its own, so that nothing of anybody else's is written over.

Everything in it but `times.json` is the same to the last byte in every execution of a run on one machine; how long the
jobs took is different every time and lies apart.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

from .._base import InputError, listed
from ..export import write_atomically
from .manifest import NAME

TABLE, PAGE, MODEL, TIMES, JOBS, LOCK = "results.csv", "report.html", "model.json", "times.json", "jobs", ".lock"
SUMMARY, PICTURE = "summary.csv", "spread.png"  # of a campaign
OWN = (NAME, TABLE, PAGE, MODEL, SUMMARY, PICTURE, TIMES, JOBS)


def check_inside(file: Path, out: str) -> str | None:
    """What is wrong with a folder that a run file names, None where it is a folder below the file's own."""
    above = file.parent.resolve()
    try:
        inside = above in (above / out).resolve().parents
    except (OSError, RuntimeError, ValueError):
        inside = False
    if inside:
        return None
    return f"'out' is {out[:60]!r}, which is no folder below that of the run file; give one, or another with --out"


def check_own(folder: Path, file: Path, overwrite: bool) -> None:
    """Refuse a folder that holds the run file, or what is no run's.

    Raises
    ------
    InputError
        That says what was found there.
    """
    if folder.resolve() in file.resolve().parents:
        raise InputError(f"The folder {folder} holds the run file {file.name}; give results a folder of their own.")
    if not folder.is_dir():
        return
    found = sorted(p.name for p in folder.iterdir() if p.name != LOCK and not _half_written(p.name))
    if NAME in found:
        return
    foreign = [name for name in found if name not in OWN]
    if foreign:
        raise InputError(
            f"{folder} holds {listed(foreign, 3)} and no manifest of a run; give an empty or a new folder as --out."
        )
    if found and not overwrite:
        raise InputError(f"{folder} holds {found[0]} but no manifest of a run; give another --out, or --overwrite.")


def sweep(folder: Path) -> None:
    """Remove what a run that was killed has left half written; the folder's lock is held."""
    for path in (*folder.iterdir(), *folder.glob(f"{JOBS}/*/.*")):
        if _half_written(path.name):
            path.unlink(missing_ok=True)


def _half_written(name: str) -> bool:
    """Whether a file is the beginning of a run's file, as `write_atomically` calls it."""
    return re.fullmatch(rf"\.({'|'.join(map(re.escape, OWN))})\.[0-9a-f]{{8}}\.tmp", name) is not None


def read_times(folder: Path) -> dict[str, float]:
    """Seconds that each job took, as far as they are known."""
    try:
        found = json.loads((folder / TIMES).read_text(encoding="utf-8"))
        return {str(job): float(seconds) for job, seconds in found.items()}
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return {}


def note_times(folder: Path, seconds: Mapping[str, float]) -> None:
    """Add the seconds of some jobs to those of the others."""
    times = {**read_times(folder), **{job: round(value, 3) for job, value in seconds.items()}}
    write_atomically(folder / TIMES, json.dumps(times, indent=1, sort_keys=True) + "\n")
