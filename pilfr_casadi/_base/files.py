"""Files that are never half written, their JSON, and SHA-256 digests by which later changes are noticed.

A digest finds damage and changes made by accident or by hand. It is no signature: whoever changes a file on purpose can
write a new digest into it.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file so that at any moment either the old or the whole new one is there.

    The content goes to a temporary file in the same folder, is forced to disk, and takes the name in one step. On any
    failure the temporary file is removed and an existing file is left untouched.

    Raises
    ------
    InputError
        If the folder does not exist or the file cannot be written there.
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
    """Make a folder where it does not exist.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    target = Path(path_text(folder, "folder"))
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {short(folder)} cannot be made ({error.strerror}); give another one.") from error
    return target


def digest(content: Any) -> str:
    """SHA-256 of bytes, or of a table in its one canonical form: sorted keys, numbers to the last digit."""
    data = content if isinstance(content, bytes) else json.dumps(content, sort_keys=True, allow_nan=False).encode()
    return hashlib.sha256(data).hexdigest()


def ordered_digest(content: dict[str, Any]) -> str:
    """SHA-256 of a table whose order carries meaning too, such as that of a model's variables."""
    return digest(json.dumps(content, allow_nan=False).encode())


def path_text(path: Any, kind: str) -> str:
    """Return a path as text, or refuse what is none."""
    try:
        name = os.fspath(path)
    except TypeError:
        name = None
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"{short(repr(path))} was given as the name of a {kind}; give a text or a Path, not empty.")
    return name


def short(path: Any) -> str:
    """Shorten a path for a message."""
    text = str(path)
    return text if len(text) <= 200 else f"{text[:100]}...{text[-60:]}"


def to_json(value: Any, infinite: str | None = None) -> Any:
    """Convert a value to the types of standard JSON; numbers that are not finite become None, infinity `infinite`."""
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
