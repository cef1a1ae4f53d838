"""A model file as tables whose every surprise is one plain sentence."""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from .._base import InputError
from .files import ordered_digest, path_text, short
from .saving import FORMAT, VERSION

WITHOUT_DIGEST = 1  # the version of the format that had none
Built = TypeVar("Built")
LARGEST = 200_000_000  # bytes; a model with 500 states takes 20 million


class ModelFile:
    """The tables of a model file, and the checks that turn every surprise into one sentence."""

    def __init__(self, path: str | os.PathLike[str], given: bool = False) -> None:
        self.path, self.given = path_text(path, "model file"), given
        content = self._parse()
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            self.fail(f"is not a model file (its format is not {FORMAT!r}); give a file that `save` wrote")
        version = content.get("version")
        if type(version) is not int or version not in (WITHOUT_DIGEST, VERSION):
            self.fail(
                f"has version {json.dumps(version)[:20]} of the model format and this release reads versions "
                f"{WITHOUT_DIGEST} and {VERSION}; save the model again with this release, or use the release that "
                "wrote it"
            )
        said = content.pop("sha256", None)
        if said != ordered_digest(content) and (version == VERSION or said is not None):
            self.fail(
                "was changed after it was written (its content does not have the SHA-256 that it was written with); "
                "restore it, or save the model again"
            )
        if said is None:
            warnings.warn(
                f"The file {short(self.path)} carries no digest (it has version {version} of the model format), so "
                "changes made to it after it was written cannot be noticed; save the model again to give it one.",
                stacklevel=3,
            )
        self.content: dict[str, Any] = content

    def fail(self, what: str) -> NoReturn:
        """Raise the one sentence."""
        raise InputError(f"The file {short(self.path)} {' '.join(what.split())}.")

    def damaged(self, what: str) -> NoReturn:
        """Raise the sentence for content that `save` never writes, or writes for another model than the one `given`."""
        if self.given:
            self.fail(f"does not fit the model given: {what}; give the model it was saved from")
        self.fail(f"is damaged: {what}; save the model again")

    def build(self, make: Callable[..., Built], *parts: Any) -> Built:
        """What is made of checked parts of the file; where they do not go together, the file is damaged."""
        try:
            return make(*parts)
        except InputError as error:
            self.damaged(str(error).rstrip("."))

    def _parse(self) -> Any:
        try:
            size = os.stat(self.path).st_size
            if size > LARGEST:
                self.fail(f"has {size / 1e6:.0f} MB, which no model file has; give a file that `save` wrote")
            text = Path(self.path).read_text(encoding="utf-8-sig")
        except FileNotFoundError:
            self.fail("does not exist; check the path")
        except IsADirectoryError:
            self.fail("is a folder; give the model file in it")
        except UnicodeDecodeError:
            self.fail("is not a model file (it is not text); give a file that `save` wrote")
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            self.fail(
                f"cannot be read ({getattr(error, 'strerror', None) or error}); check the path and the permissions"
            )
        try:
            return json.loads(
                text,
                parse_constant=self._no_constant,
                parse_float=self._finite,
                object_pairs_hook=self._no_twin,
            )
        except json.JSONDecodeError as error:
            if not text.strip():
                self.fail("is empty; it may have been cut off while being copied: copy or save it again")
            if error.pos >= len(text.rstrip()) - 1 or "Unterminated" in error.msg:
                self.fail("is incomplete, its end is missing; copy or save it again")
            self.fail(f"is not valid JSON (line {error.lineno}, column {error.colno}); give a file that `save` wrote")
        except InputError:
            raise
        except (ValueError, RecursionError, MemoryError):
            self.fail("is not a model file (its JSON cannot be used); give a file that `save` wrote")

    def _no_constant(self, name: str) -> NoReturn:
        self.damaged(f"it holds {name}, which is not a number")

    def _finite(self, text: str) -> float:
        number = float(text)
        return number if math.isfinite(number) else self.damaged(f"it holds {text[:20]}, which is not a finite number")

    def _no_twin(self, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            keys = [key for key, _ in pairs]
            self.damaged(f"it has the key {next(k for k in keys if keys.count(k) > 1)[:40]!r} twice in one table")
        return content

    def table(self, parent: Any, key: str) -> dict[str, Any]:
        """A table inside a table."""
        return self.entry(parent, key, dict, "a table")

    def rows(self, parent: Any, key: str) -> list[Any]:
        """A list inside a table."""
        return self.entry(parent, key, list, "a list")

    def text(self, parent: Any, key: str) -> str:
        """A text inside a table."""
        return self.entry(parent, key, str, "a text")

    def entry(self, parent: Any, key: str, kind: type, called: str) -> Any:
        """An entry of a table, of one kind."""
        if not isinstance(parent, dict) or key not in parent:
            self.damaged(f"{key!r} is missing")
        if not isinstance(parent[key], kind) or (kind is int and isinstance(parent[key], bool)):
            self.damaged(f"{key!r} is not {called}")
        return parent[key]

    def count(self, parent: Any, key: str) -> int:
        """A whole number, zero or more."""
        value = self.entry(parent, key, int, "a whole number")
        if value < 0:
            self.damaged(f"{key!r} is negative")
        return int(value)

    def number(self, parent: Any, key: str, missing: float | None = None) -> float:
        """A finite number; where it is null, `missing`."""
        if not isinstance(parent, dict) or key not in parent:
            self.damaged(f"{key!r} is missing")
        return float(self.array(parent[key], (), key, missing))

    def array(self, value: Any, shape: tuple[int, ...] | None, where: str, missing: float | None = None) -> np.ndarray:
        """Nested lists of finite numbers as an array of a shape (any where None).

        Where `missing` is given, null becomes it and "inf" becomes infinite.
        """
        numbers = list(self._numbers(value, where, missing))
        if shape is not None and len(numbers) == math.prod(shape) == 0:
            return np.zeros(shape)
        found = _shape(value)
        if (shape is not None and found != shape) or math.prod(found) != len(numbers):
            expected = "" if shape is None else f", expected {shape}"
            self.damaged(f"{where} has {len(numbers)} numbers in the shape {found}{expected}")
        return np.array(numbers, dtype=float).reshape(found)

    def _numbers(self, value: Any, where: str, missing: float | None, depth: int = 0) -> Any:
        if isinstance(value, list) and depth < 3:
            for item in value:
                yield from self._numbers(item, where, missing, depth + 1)
        elif value is None and missing is not None:
            yield missing
        elif value == "inf" and missing is not None:
            yield math.inf
        elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
            shown = "a list or a table" if isinstance(value, list | dict) else json.dumps(value)[:20]
            self.damaged(f"{where} holds {shown}, which is not a finite number")
        else:
            yield float(value)


def _shape(value: Any) -> tuple[int, ...]:
    """Shape of nested lists; -1 where their lengths differ."""
    if not isinstance(value, list):
        return ()
    inner = {_shape(item) for item in value}
    return (len(value), *(inner.pop() if len(inner) == 1 else (-1,) if inner else ()))
