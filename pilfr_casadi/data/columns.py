"""Columns of a table: their names with or without a unit in brackets, the time, and samples that are missing."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._base import InputError, listed

Array = np.ndarray

TIME_NAMES = ("t", "t_s", "time")
WITH_UNIT = re.compile(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*")  # such as "force [N]" or "speed (rad/s)"
_IN_SECONDS = re.compile(r"(?:t|time)\s*[\[(]\s*(?:s|sec|secs|seconds?)\s*[\])]", re.IGNORECASE)
_UNITS = r"ns|us|µs|μs|ms|min|h|d|nanoseconds?|microseconds?|milliseconds?|minutes?|hours?|days?"
_OTHER_UNIT = re.compile(rf"(?:t|time)[\s_\-\[(]+({_UNITS})[\])]?", re.IGNORECASE)
_IN_OTHER_UNIT = re.compile(rf".*[\[(]\s*({_UNITS})\s*[\])]", re.IGNORECASE)  # of a column that is chosen as the time
ONE_STEP = "bring all channels to one step with resample=STEP"


def find_column(column: str, names: Sequence[str]) -> str:
    """Return a file's name of a column, which may have a unit in brackets; `column` itself if there is none."""
    return by_name_without_unit(names).get(column, column)


def by_name_without_unit(names: Sequence[str]) -> dict[str, str]:
    """Map each name to itself, and its part before the brackets to it if no other name has the same part."""
    bare = [parts.group(1) for name in names if (parts := WITH_UNIT.fullmatch(name))]
    counts, short = Counter(bare), dict(zip(bare, filter(WITH_UNIT.fullmatch, names), strict=True))
    return {name: full for name, full in short.items() if counts[name] == 1} | {name: name for name in names}


def name_with_unit(name: str, unit: str) -> str:
    """Return `name [unit]`, or the name alone if the unit is unknown."""
    return f"{name} [{unit}]" if unit else name


def unit_in_brackets(column: str) -> str:
    """Return the unit in brackets after the name of a column; empty if there is none."""
    parts = WITH_UNIT.fullmatch(column)
    return (parts.group(2) or parts.group(3) or "").strip() if parts else ""


def is_time(column: str) -> bool:
    """Tell whether a column holds the time in seconds by its name, which may have the unit in brackets.

    >>> is_time("t"), is_time("Time [s]"), is_time("time (ms)"), is_time("T")
    (True, True, False, False)
    """
    return column in TIME_NAMES or bool(_IN_SECONDS.fullmatch(column.strip()))


def find_time_column(names: Sequence[str], chosen: str | None, source: str) -> str | None:
    """Return the time column among the names: the chosen one, or one that `is_time`; None if there is none."""
    found = [chosen] if chosen is not None else [*dict.fromkeys(name for name in names if is_time(name))]
    if not found:
        return None
    if len(found) > 1:
        raise InputError(
            f"{source} has several time columns ({', '.join(found)}); choose one, as in columns={{'t': '{found[0]}'}}."
        )
    found[0] = find_column(found[0], names)
    if found[0] not in names:
        raise InputError(f"{source} has no column {found[0]!r} for the time; its columns are {listed(names)}.")
    refuse_other_unit(found, source)
    refuse_other_unit(found, source, _IN_OTHER_UNIT)
    return found[0]


def refuse_other_unit(names: Sequence[str], source: str, pattern: re.Pattern[str] = _OTHER_UNIT) -> None:
    """Refuse a name such as ``t_ms`` or ``Time [min]``, which states a unit other than seconds."""
    for name in names:
        unit = pattern.fullmatch(name.strip())
        if unit:
            raise InputError(
                f"{source}: column {name!r} is named as time in {unit.group(1)}, but time must be in seconds; "
                "convert it and name it t_s, or leave it out and state the step in seconds with dt=STEP."
            )


def present_samples(path: Path, name: str, t: Array, values: Array) -> tuple[Array, Array]:
    """Leave out the samples of a channel at which a value is missing."""
    there = ~np.isnan(values).any(axis=1)
    if np.count_nonzero(there) < 2:
        raise InputError(f"{path}: column {name!r} has {np.count_nonzero(there)} number(s); at least 2 are needed.")
    return t[there], values[there]


def refuse_slow_channels(path: Path, names: Sequence[str], parts: Sequence[Array]) -> None:
    """Refuse channels that usually miss samples between two others, rather than here and there."""
    for name, part in zip(names, parts, strict=False):
        there = np.flatnonzero(~np.isnan(part).any(axis=1))
        if len(there) > 1 and np.median(np.diff(there)) >= 2:
            raise InputError(
                f"{path}: column {name!r} has numbers in {len(there)} of {len(part)} rows, as a channel of a slower "
                f"rate; {ONE_STEP}."
            )
