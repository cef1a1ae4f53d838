"""The manifest of a run: what was computed from what, with which versions, and the SHA-256 of every file.

It carries its own digest, so that a manifest that something else has written to is not taken for one of a run's; the
digests of the files tell in the same way of models and tables that were changed afterwards. No time is in it: the same
run writes the same bytes.
"""

from __future__ import annotations

import contextlib
import json
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .._base import InputError
from ..export import digest, write_atomically

FORMAT, VERSION, NAME = "pilfr_casadi run", 1, "manifest.json"


def file_digest(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        return digest(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its name and permissions.") from None


def versions() -> dict[str, str]:
    """What the numbers of a run depend on besides its inputs."""
    import casadi
    import numpy
    import scipy

    from .._base import __version__

    return {
        "pilfr_casadi": __version__,
        "casadi": casadi.__version__,
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


class Manifest:
    """The manifest in a folder, written anew, atomically, after every step."""

    def __init__(self, folder: Path, content: dict[str, Any]) -> None:
        self.folder, self.content = folder, content

    @classmethod
    def found(cls, folder: Path) -> Manifest | None:
        """The manifest of an earlier run, None where there is none.

        Raises
        ------
        InputError
            If it is damaged, of another version, or was changed after the run wrote it.
        """
        path = folder / NAME
        if not path.exists():
            return None
        advice = "restore it, or give --overwrite to compute everything again"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise InputError(f"{path} is not a manifest of a run; {advice}.")
        if content.get("format") != FORMAT or content.get("version") != VERSION:
            raise InputError(f"{path} is not a manifest that this release writes; {advice}.")
        said = content.pop("sha256", None)
        if said != digest(content):
            raise InputError(f"{path} was changed after the run wrote it; {advice}.")
        tables = [content.get(k) for k in ("jobs", "scores", "files", "inputs")]
        if not all(isinstance(t, dict) for t in tables):
            raise InputError(f"{path} is not a manifest that this release writes; {advice}.")
        return cls(folder, content)

    @classmethod
    def fresh(cls, folder: Path) -> Manifest:
        """An empty one."""
        tables: dict[str, Any] = {key: {} for key in ("jobs", "scores", "files", "inputs")}
        return cls(folder, {"format": FORMAT, "version": VERSION, **tables})

    def write(self) -> None:
        """Write it, with its digest."""
        content = {**self.content, "sha256": digest(self.content)}
        text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
        write_atomically(self.folder / NAME, text + "\n")

    def holds(self, name: str) -> bool:
        """Whether a file of the run is there, as the run wrote it; False where it is missing.

        Raises
        ------
        InputError
            If it was changed.
        """
        path = self.folder / name
        if name not in self.content["files"] or not path.is_file():
            return False
        # a run that ended between a file and its manifest has said before what it was about to write
        expected = self.content["files"][name], self.content.get("writing", {}).get(name)
        if file_digest(path) not in expected:
            raise InputError(
                f"{path} was changed after the run wrote it; restore it, remove it, or give --overwrite to compute "
                "everything again."
            )
        return True

    def put(self, name: str, content: str | bytes) -> None:
        """Write a file of the run and note its digest, in the manifest too where it has changed."""
        data = content.encode() if isinstance(content, str) else content
        if self.content["files"].get(name) != digest(data) or not self.holds(name):
            self.put_all({name: data})

    def put_all(self, contents: Mapping[str, str | bytes], jobs: Mapping[str, Any] | None = None) -> None:
        """Write files of the run, then the manifest with their digests, and with what is known of the jobs they end."""
        data = {name: c.encode() if isinstance(c, str) else c for name, c in contents.items()}
        found = {name: digest(content) for name, content in data.items()}
        if data:
            self.content["writing"] = found
            self.write()
        for name, content in data.items():
            target = self.folder / name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"The folder {target.parent} cannot be made ({error.strerror}); give another."
                ) from None
            write_atomically(target, content)
        self.content["files"] |= found
        self.content["jobs"] |= jobs or {}
        self.write()


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, however that ends.

    Raises
    ------
    InputError
        If another one is at work there.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"Another run is at work in {folder}; wait for it, or give another --out.") from None
        yield
