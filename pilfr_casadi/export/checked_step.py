"""The step of an exported model as it is called from Python: a casadi.Function that refuses what does not fit it.

CasADi spreads one number over a whole state and takes what is missing as zero; a loop that lost its state would go on.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError


class CheckedStep(ca.Function):
    """`(x, u) -> (x_next, y)`, called with numbers or symbols of exactly these sizes, or with several columns of them.

    Raises
    ------
    InputError
        In a call, if x or u is missing or has another size.
    """

    def __call__(self, *given: Any, **named: Any) -> Any:
        """The function's values, after the check."""
        arguments = dict(zip(("x", "u"), given, strict=False)) | named
        if len(given) + len(named) != 2 or set(arguments) != {"x", "u"}:
            raise InputError(f"A step of {self.name()} needs x and u; give both, as in step(x, u).")
        for i, (name, what) in enumerate((("x", "state"), ("u", "input"))):
            size, shape = int(self.size1_in(i)), _shape(arguments[name])
            if not _fits(shape, size):
                count = f"the shape {shape}" if shape else "none" if shape is None else "one number"
                wanted = "1 entry" if size == 1 else f"{size} entries"
                raise InputError(f"The {what} {name} of a step of {self.name()} has {wanted}; {count} was given.")
        return super().__call__(*given, **named)


def _shape(value: Any) -> tuple[int, ...] | None:
    """None for what is no array of numbers or symbols."""
    if value is None:
        return None
    if isinstance(value, ca.DM | ca.SX | ca.MX):
        return tuple(value.shape)
    try:
        return np.asarray(value, dtype=float).shape
    except (TypeError, ValueError):
        return None


def _fits(shape: tuple[int, ...] | None, size: int) -> bool:
    if shape is None or len(shape) > 2:
        return False
    if shape == () or size == 0:
        return int(np.prod(shape)) == size
    return shape[0] == size or shape == (1, size)
