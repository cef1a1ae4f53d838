"""The values of options on the command line: names, pairs, numbers, bounds; one sentence for what they are not."""

from __future__ import annotations

from collections.abc import Sequence

from .._base import InputError


def name_list(text: str, option: str) -> tuple[str, ...]:
    """Names separated by commas.

    Raises
    ------
    InputError
        When there is none.
    """
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names:
        raise InputError(f"{option} {text!r} holds no name; write {option} NAME, or several separated by commas.")
    return names


def pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    """`NAME=VALUE` each.

    Raises
    ------
    InputError
        When one is not of this form, or a name is given twice.
    """
    out: dict[str, str] = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise InputError(f"{option} {text!r} was given; write {option} NAME=VALUE.")
        if name in out:
            raise InputError(f"{option} is given twice for {name}; leave one out.")
        out[name] = value
    return out


def number(text: str, option: str) -> float:
    """A number.

    Raises
    ------
    InputError
        When it is none.
    """
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} in {option} is not a number; write one like 0.5.") from None


def bounds(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """`NAME=LOW:HIGH` each; an end that is left out is infinite.

    Raises
    ------
    InputError
        When one is not of this form, or infeasible.
    """
    out = {}
    for name, value in pairs(texts, "--bound").items():
        low, sign, high = value.partition(":")
        if not sign:
            raise InputError(f"--bound {name}={value} was given; write --bound NAME=LOW:HIGH.")
        ends = [number(text, "--bound") if text else end for text, end in ((low, -float("inf")), (high, float("inf")))]
        if not ends[0] <= ends[1]:
            raise InputError(
                f"The bounds {value} of {name} are infeasible: the lower one exceeds the upper one; swap them."
            )
        out[name] = (ends[0], ends[1])
    return out
