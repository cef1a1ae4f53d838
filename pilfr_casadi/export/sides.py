"""The pieces of a step with kinks: each max, min and |·| told which side it is on.

    max(a, b) -> s a + (1 - s) b,  gap a - b;    min(a, b) -> s a + (1 - s) b,  gap b - a;    |a| -> (2 s - 1) a,  gap a

A side s is 1 where its gap is not negative, else 0. With the sides held a step has no kinks; its equations are those of
one piece, which ends where a gap changes its sign (Griewank 2013, on piecewise linear models).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from .smoothing import walk

KINKS = ("FMAX", "FMIN", "FABS")


def with_sides(function: ca.Function, *, held: bool) -> ca.Function:
    """`(x, u, s) -> (x_next, y, gaps)` of `(x, u) -> (x_next, y)`; sides not held are those of x and u, whatever s.

    Raises
    ------
    InputError
        If the function holds an operation that cannot be run on other values.
    """
    arguments = [ca.SX.sym(name, function.numel_in(i)) for i, name in enumerate(function.name_in())]
    sides: list[Any] = []
    gaps: list[Any] = []

    def apply(op: str, code: int, a: Any, b: Any = None) -> Any:
        if op in KINKS:
            sides.append(ca.SX.sym(f"s{len(sides)}"))
            gaps.append(a if op == "FABS" else a - b if op == "FMAX" else b - a)
            if held:
                return (2 * sides[-1] - 1) * a if op == "FABS" else sides[-1] * a + (1 - sides[-1]) * b
        return ca.SX.unary(code, a) if b is None else ca.SX.binary(code, a, b)

    found = walk(function, [ca.vertsplit(a) if a.numel() else [] for a in arguments], apply, ca.SX)
    none = ca.SX(0, 1)
    results = [ca.vertcat(none, *row) for row in (*found, gaps)]
    return ca.Function(function.name(), [*arguments, ca.vertcat(none, *sides)], results)
