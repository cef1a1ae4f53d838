"""Tables of a run file, and the checks that turn every surprise in them into one plain sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from .._base import InputError

KINDS = {
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    list: "a list",
    dict: "a table",
}


class Table:
    """One table: every key is taken once, what is left at the end is unknown."""

    def __init__(self, file: Path, name: str, content: Any) -> None:
        self.file, self.name = file, name
        if not isinstance(content, Mapping):
            raise InputError(f"{file}: {name or 'the run'} is {shown(content)}; give a table.")
        self.content = dict(content)
        self.known: list[str] = []

    def fail(self, what: str) -> NoReturn:
        """Raise the one sentence."""
        raise InputError(f"{self.file}: {what}.")

    def where(self, key: str) -> str:
        """How a key is called in sentences."""
        return f"'{key}' in [{self.name}]" if self.name else f"'{key}'"

    def has(self, key: str) -> bool:
        """Whether a key is given."""
        return key in self.content

    def any(self, key: str, default: Any = None) -> Any:
        """Whatever is given."""
        self.known.append(key)
        return self.content.pop(key, default)

    def take(self, key: str, kind: type, default: Any = None) -> Any:
        """A value of one kind; whole numbers are numbers too."""
        value = self.any(key, default)
        if value is default:
            return value
        fits = isinstance(value, (int, float) if kind is float else kind) and (
            kind is bool or not isinstance(value, bool)
        )
        if not fits:
            self.fail(f"{self.where(key)} is {shown(value)}; give {KINDS[kind]}")
        return value

    def number(self, key: str, default: float | None = None, least: float = -math.inf, whole: bool = False) -> Any:
        """A number of at least `least`."""
        value = self.take(key, int if whole else float, default)
        if value is not None and value is not default and not (value >= least and value < math.inf):
            self.fail(f"{self.where(key)} is {value}; give {least:g} or more")
        return value

    def choice(self, key: str, choices: tuple[str, ...], default: str | None) -> Any:
        """One of some texts."""
        value = self.take(key, str, default)
        if value is not default and value not in choices:
            self.fail(f"{self.where(key)} is {value!r}; give {', '.join(repr(c) for c in choices)}")
        return value

    def names(self, key: str, required: bool = False) -> tuple[str, ...]:
        """A text, or a list of texts, none of them empty."""
        if key not in self.content and required:
            self.fail(f"{self.where(key)} is missing; give a name, or a list of names")
        value = self.any(key, [])
        given = [value] if isinstance(value, str | Path) else value
        if not isinstance(given, list | tuple) or not all(isinstance(v, str | Path) and str(v).strip() for v in given):
            self.fail(f"{self.where(key)} is {shown(value)}; give a name, or a list of names")
        if required and not given:
            self.fail(f"{self.where(key)} is empty; give at least one name")
        return tuple(str(v) for v in given)

    def table(self, key: str) -> Table:
        """A table inside, empty where it is not given."""
        return Table(self.file, f"{self.name}.{key}" if self.name else key, self.any(key, {}))

    def done(self) -> None:
        """Refuse what has not been taken."""
        if self.content:
            extra = next(iter(self.content))
            place = f"[{self.name}]" if self.name else "the run"
            self.fail(f"{place} has an unknown key {extra!r}; known are {', '.join(self.known)}")


def shown(value: Any) -> str:
    """A value in a sentence."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def as_plain(value: Any) -> tuple[Any, bool]:
    """A value as JSON knows it, objects by a mark; and whether there are any."""
    if isinstance(value, Mapping):
        parts = {str(k): as_plain(v) for k, v in sorted(value.items(), key=lambda kv: str(kv[0]))}
        return {k: v for k, (v, _) in parts.items()}, any(o for _, o in parts.values())
    if isinstance(value, list | tuple | range):
        items = [as_plain(v) for v in value]
        return [v for v, _ in items], any(o for _, o in items)
    if isinstance(value, float):
        return repr(value), False  # inf and nan too
    if value is None or isinstance(value, bool | int | str):
        return value, False
    return f"object {type(value).__name__}", True
