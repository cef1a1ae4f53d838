"""Smooth steps, for solvers that need derivatives everywhere, with a bound on the error.

Every max, min and |·| of a step becomes smooth,

    max(a, b) -> (a + b + sqrt((a - b)² + eps²)) / 2,   min(a, b) = -max(-a, -b),   |a| = max(a, -a),

each off by at most eps/2: max and |·| upwards, min downwards. sign(a) becomes the slope of the rounded |a|. A play
`max(z - r, min(z + r, q))` and a stop are off by at most eps/2 per step, because the errors of max and min have
opposite signs; a generalized play, whose upper curve is itself a max, by at most eps. In a PI-LFR model (Krikelis et
al. 2024, Eq. 15-16) with plays or stops an output is off by at most `|D_yw| Σ_j w_j eps/2`, a state by
`|B_w| Σ_j w_j eps/2`. The general bound follows by interval arithmetic: each value of the step is enclosed together
with its rounded twin, and each rounding widens the interval by eps/2 (Moore, Kearfott & Cloud 2009, ch. 2).

The bound holds for one step from the same x and u. Over many steps a rounded play creeps towards its signal, by about
eps²/4d per sample at the distance d from its edges, and so loses its memory: use it over the horizon of a controller,
not for a long simulation. (`models.fmax` rounds within a narrow band instead. It keeps the memory of long records, as a
fit needs, but its second derivative jumps, which Newton-type solvers cannot handle.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError

Interval = tuple[float, float]
EVERYTHING = (-math.inf, math.inf)
_NAMES = {getattr(ca, k): k[3:] for k in sorted(dir(ca)) if k.startswith("OP_")}
_RISING: dict[str, Callable[[float], float]] = {
    "EXP": np.exp,
    "LOG": np.log,
    "SQRT": np.sqrt,
    "TANH": np.tanh,
    "SINH": np.sinh,
    "ATAN": np.arctan,
    "ASINH": np.arcsinh,
    "ASIN": np.arcsin,
    "ATANH": np.arctanh,
    "EXPM1": np.expm1,
    "LOG1P": np.log1p,
    "FLOOR": np.floor,
    "CEIL": np.ceil,
    "ERF": math.erf,
    "TWICE": lambda a: 2 * a,
    "ASSIGN": lambda a: a,
}


def smooth_kinks(function: ca.Function, eps: float) -> ca.Function:
    """Round every max, min, |·| and sign of a function of scalar expressions by eps."""
    arguments = [ca.SX.sym(name, int(function.numel_in(i))) for i, name in enumerate(function.name_in())]
    entries = [ca.vertsplit(a) if a.numel() else [] for a in arguments]

    def apply(op: str, code: int, a: Any, b: Any = None) -> Any:
        if op in ("FMAX", "FMIN"):
            side = 1 if op == "FMAX" else -1
            return (a + b + side * ca.sqrt((a - b) ** 2 + eps**2)) / 2
        if op == "FABS":
            return ca.sqrt(a**2 + eps**2 / 4)
        if op == "SIGN":
            return a / ca.sqrt(a**2 + eps**2 / 4)
        return ca.SX.unary(code, a) if b is None else ca.SX.binary(code, a, b)

    results = [ca.vertcat(ca.SX(0, 1), *row) for row in _evaluate(function, entries, apply, ca.SX)]
    return ca.Function(function.name(), arguments, results, function.name_in(), function.name_out())


def enclose(function: ca.Function, eps: float, *arguments: Sequence[Interval]) -> list[list[Interval]]:
    """Enclose every result of a function of scalar expressions, rounded by eps or not, in an interval."""

    def apply(op: str, code: int, a: Interval, b: Interval | None = None) -> Interval:
        with np.errstate(all="ignore"):
            try:
                low, high = _enclose_unary(op, a, eps) if b is None else _enclose_binary(op, a, b, eps)
            except OverflowError:
                return EVERYTHING
        return EVERYTHING if math.isnan(low) or math.isnan(high) else (float(low), float(high))

    return _evaluate(function, list(arguments), apply, lambda value: (float(value), float(value)))


def _evaluate(
    function: ca.Function, arguments: list[Any], apply: Callable[..., Any], constant: Callable[..., Any]
) -> Any:
    """Run a function's instructions on other values; treat `a > b ? a : b` as a max, its opposite as a min.

    CasADi writes such a choice as a sum of two terms, which is recognised because equal expressions get equal numbers.
    """
    numbers: dict[Any, int] = {}  # (operation, numbers of its arguments) -> number
    nodes: list[Any] = []
    values: list[Any] = []
    registers: dict[int, int] = {}
    results = [[constant(0.0)] * int(function.numel_out(i)) for i in range(function.n_out())]

    def number_node(node: Any, value: Callable[[], Any]) -> int:
        if node not in numbers:
            numbers[node] = len(nodes)
            values.append(value())
            nodes.append(node)
        return numbers[node]

    for k in range(function.n_instructions()):
        code, read, written = (getattr(function, f"instruction_{w}")(k) for w in ("id", "input", "output"))
        op = _NAMES[code]
        if op == "OUTPUT":
            results[written[0]][written[1]] = values[registers[read[0]]]
            continue
        if op == "INPUT":
            found = number_node((op, *read), partial(arguments[read[0]].__getitem__, read[1]))
        elif op == "CONST":
            number = function.instruction_constant(k)
            found = number_node((op, number), partial(constant, number))
        elif len(read) not in (1, 2) or len(written) != 1:
            raise InputError(
                f"The equations hold the operation {op.lower()!r}, which has no smooth form here; leave it out."
            )
        else:
            node: Any = (op, *(registers[r] for r in read))
            node = _recognise_choice(nodes, node) or node
            parts = (values[i] for i in node[1:])
            found = number_node(node, partial(apply, node[0], getattr(ca, f"OP_{node[0]}"), *parts))
        registers[written[0]] = found
    return results


def _recognise_choice(nodes: list[Any], node: Any) -> Any:
    """Return (FMAX or FMIN, a, b) if the node is such a choice; else None."""
    if node[0] == "ADD":
        one, two = (_split_choice(nodes, nodes[part]) for part in node[1:])
        if one is None or two is None or one[0] != two[0] or one[1] == two[1]:
            return None
        sides: Any = (one[2], two[2]) if one[1] else (two[2], one[2])
    else:
        one = _split_choice(nodes, node)
        if one is None:
            return None
        zero = next((i for i in nodes[one[0]][1:] if nodes[i] == ("CONST", 0.0)), None)
        sides = (one[2], zero) if one[1] else (zero, one[2])
    low, high = nodes[one[0]][1:]
    if sides == (high, low):
        return ("FMAX", high, low)
    return ("FMIN", low, high) if sides == (low, high) else None


def _split_choice(nodes: list[Any], node: Any) -> tuple[int, bool, int] | None:
    """Split `comparison ? value : 0` into (comparison, whether it must be true, value)."""
    if node[0] != "IF_ELSE_ZERO":
        return None
    condition, yes = node[1], True
    if nodes[condition][0] == "NOT":
        condition, yes = nodes[condition][1], False
    return (condition, yes, node[2]) if nodes[condition][0] in ("LT", "LE") else None


def _enclose_unary(op: str, a: Interval, eps: float) -> Interval:
    low, high = a
    if op in _RISING:
        return _RISING[op](low), _RISING[op](high)
    size = (0.0 if low <= 0 <= high else min(abs(low), abs(high))), max(abs(low), abs(high))
    if op == "NEG":
        return -high, -low
    if op == "FABS":
        return size[0], size[1] + eps / 2
    if op == "SQ":
        return size[0] ** 2, size[1] ** 2
    if op == "COSH":
        return np.cosh(size[0]), np.cosh(size[1])
    if op == "SIGN":
        ends = [(np.sign(v), v / math.hypot(v, eps / 2) if v or eps else 0.0) for v in a]
        return min(ends[0]), max(ends[1])
    if op in ("SIN", "COS"):
        middle, half = (low + high) / 2, (high - low) / 2
        value = np.sin(middle) if op == "SIN" else np.cos(middle)
        return max(value - half, -1.0), min(value + half, 1.0)
    if op == "ACOS":
        return np.arccos(high), np.arccos(low)
    if op == "INV":
        return _enclose_binary("DIV", (1.0, 1.0), a, eps)
    if op == "NOT":
        return float(low == high == 0), float(low == 0)
    raise InputError(f"No error bound is known behind the operation {op.lower()!r}; leave it out.")


def _enclose_binary(op: str, a: Interval, b: Interval, eps: float) -> Interval:
    if op == "ADD":
        return a[0] + b[0], a[1] + b[1]
    if op == "SUB":
        return a[0] - b[1], a[1] - b[0]
    if op == "FMAX":
        return max(a[0], b[0]), max(a[1], b[1]) + eps / 2
    if op == "FMIN":
        return min(a[0], b[0]) - eps / 2, min(a[1], b[1])
    if op == "IF_ELSE_ZERO":
        sure = a[0] > 0 or a[1] < 0
        return b if sure else (0.0, 0.0) if a == (0.0, 0.0) else (min(b[0], 0.0), max(b[1], 0.0))
    if op in ("LT", "LE"):
        first, second = (a[1] < b[0], a[0] < b[1]) if op == "LT" else (a[1] <= b[0], a[0] <= b[1])
        return float(first), float(second)
    if op in ("EQ", "NE"):
        same, apart = a == b and a[0] == a[1], a[1] < b[0] or b[1] < a[0]
        return (float(same), float(not apart)) if op == "EQ" else (float(apart), float(not same))
    if op in ("AND", "OR"):
        join = min if op == "AND" else max
        return join(_enclose_truth(a)[0], _enclose_truth(b)[0]), join(_enclose_truth(a)[1], _enclose_truth(b)[1])
    if op == "DIV" and b[0] <= 0 <= b[1]:
        return EVERYTHING
    if op in ("POW", "CONSTPOW") and a[0] < 0:
        return _enclose_power(a, b)
    known: dict[str, Callable[[Any, Any], Any]] = {
        "MUL": lambda x, y: x * y if x and y else 0.0,
        "DIV": np.divide,
        "POW": np.power,
        "CONSTPOW": np.power,
    }
    if op not in known:
        raise InputError(f"No error bound is known behind the operation {op.lower()!r}; leave it out.")
    corners = [known[op](np.float64(x), np.float64(y)) for x in a for y in b]
    return (math.nan, math.nan) if np.any(np.isnan(corners)) else (min(corners), max(corners))


def _enclose_power(a: Interval, b: Interval) -> Interval:
    """Enclose a power of a base that may be negative: known for whole exponents."""
    n = b[0]
    if b[0] != b[1] or n != round(n) or (n < 0 and a[0] <= 0 <= a[1]):
        return EVERYTHING
    ends = [np.power(np.float64(v), n) for v in a]
    return (0.0 if a[0] <= 0 <= a[1] and n % 2 == 0 else min(ends)), max(ends)


def _enclose_truth(a: Interval) -> Interval:
    return float(a[0] > 0 or a[1] < 0), float(a != (0.0, 0.0))
