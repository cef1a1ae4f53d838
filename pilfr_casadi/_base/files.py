"""Atomic writing of files, their JSON, and SHA-256 digests that reveal later changes.

A digest reveals damage and changes by accident or by hand. It is not a signature: anyone who changes a file on purpose
can write a new digest into it.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import secrets
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file atomically: at any moment either the old or the complete new content is there.

    The content goes to a temporary file in the same folder, is forced to disk, and is renamed in one step. On any
    failure the temporary file is removed and an existing file stays as it is. InputError is raised if the folder does
    not exist or is not writable.
    """
    target = Path(os.path.realpath(path_text(path, "file")))
    data = content.encode() if isinstance(content, str) else content
    try:
        if target.is_dir():
            raise InputError(f"{short(path)} is a folder; give the name of a file in it.")
        partial = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.tmp")
        handle = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, target)
        except BaseException:
            with contextlib.suppress(OSError):
                partial.unlink()
            raise
    except OSError as error:
        if error.errno == errno.ENOENT and not target.parent.is_dir():
            raise InputError(
                f"The folder {target.parent} does not exist; make it first or give another path."
            ) from error
        raise InputError(f"{short(path)} cannot be written ({error.strerror or error}); give another path.") from error
    with contextlib.suppress(OSError):  # force the new name to disk too, where the system allows it
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return target


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """Make a folder, and the folders above it, unless it exists; raise InputError if that fails."""
    target = Path(path_text(folder, "folder"))
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {short(folder)} cannot be made ({error.strerror}); give another one.") from error
    return target


def json_text(content: Any) -> str:
    """Format a table of standard JSON types as the text of a file, one entry a line."""
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Format rows as the text of a CSV file; numbers with all digits."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def digest(content: Any) -> str:
    """Return the SHA-256 of bytes, or of a table in canonical form: sorted keys, numbers to the last digit."""
    data = content if isinstance(content, bytes) else json.dumps(content, sort_keys=True, allow_nan=False).encode()
    return hashlib.sha256(data).hexdigest()


def ordered_digest(content: dict[str, Any]) -> str:
    """Return the SHA-256 of a table whose order has a meaning, such as the order of a model's variables."""
    return digest(json.dumps(content, allow_nan=False).encode())


def path_text(path: Any, kind: str) -> str:
    """Return a path as text; refuse anything else."""
    try:
        name = os.fspath(path)
    except TypeError:
        name = None
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(
            f"{short(repr(path))} was given as the name of a {kind}; give a text that is not empty, or a Path."
        )
    return name


def short(path: Any) -> str:
    """Shorten a path for a message."""
    text = str(path)
    return text if len(text) <= 200 else f"{text[:100]}...{text[-60:]}"


def to_json(value: Any, infinite: str | None = None) -> Any:
    """Convert a value to types of standard JSON; +inf becomes `infinite`, other non-finite numbers None."""
    if isinstance(value, Mapping):
        return {str(k): to_json(v, infinite) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(v, infinite) for v in value]
    if isinstance(value, np.ndarray):
        return to_json(value.tolist(), infinite)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else infinite if value > 0 else None
    return value


def with_nan(content: Any) -> Any:
    """Replace null of JSON by nan."""
    if isinstance(content, Mapping):
        return {k: with_nan(v) for k, v in content.items()}
    return np.nan if content is None else content
