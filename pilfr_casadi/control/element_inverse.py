"""The exact inverse of a Prandtl-Ishlinskii element.

For plays with `0 = r_0 < r_1 < ... < r_n` and weights `w_0 > 0` (the linear part), all partial sums positive, Krejčí &
Kuhnen (2001), IEE Proc. Control Theory Appl. 148, give the inverse in closed form:

    r'_i = Σ_{j≤i} w_j (r_i - r_j),   w'_0 = 1 / w_0,
    w'_i = -w_i / ((w_0 + ... + w_i) (w_0 + ... + w_{i-1})),
    q'_i = Σ_{j≤i} w_j q_i + Σ_{j>i} w_j q_j.

r' are the values of the virgin loading curve at the kinks, w' the changes of slope of its inverse function. The
memories q' follow from the memories of the plays at the moment when play i slipped last. Stops become plays by
`S_r[z] = z - P_r[z]`: `Σ w_j S_rj = (Σ w_j) z - Σ w_j P_rj`. A sum of stops alone saturates and has no inverse; with a
parallel spring of stiffness `gain`, the inverse exists. If all partial sums are negative, the output falls as the input
rises. The formulas then hold with -r' for r', because plays are odd: `P_r[-z] = -P_r[z]` with the negative memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..models import Play, Stop, play

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Inverse:
    """The inverse of `gain z + Σ w_j H_rj[z]`, a sum of plays; the first has the threshold 0.

    Attributes
    ----------
    step : casadi.Function
        `(memory, wanted) -> (memory_next, u)`: the u that gives the wanted value.
    r, w : array, shape (n + 1,)
        Thresholds (in units of the element's output) and weights, for a `PrandtlIshlinskii(Play, n + 1)`.
    """

    step: ca.Function
    r: Array
    w: Array
    _sorted: tuple[Array, Array, Array]

    def __str__(self) -> str:
        r = ", ".join(f"{v:.4g}" for v in self.r)
        w = ", ".join(f"{v:.4g}" for v in self.w)
        return f"inverse element of {len(self.r)} plays, from a wanted value to u\nthresholds: {r}\nweights: {w}"

    __repr__ = __str__

    def memory(self, s: Array | None = None) -> Array:
        """Convert the element's memory s, (n,), zero by default, to the memory of the inverse.

        s holds the states of the plays (also for stops) in the order of the given thresholds. Some input must be able
        to reach it.
        """
        order, _, w = self._sorted
        q = np.zeros(len(order)) if s is None else numbers(s, "The memory").ravel()
        if len(q) != len(order):
            raise InputError(f"{len(q)} memories were given for {len(order)} operators; give one each.")
        q = np.concatenate([[0.0], q[order]])
        q_inverse = np.cumsum(w) * q + np.sum(w * q) - np.cumsum(w * q)
        q_inverse[0] = 0.0  # a play of threshold 0 has no memory
        return np.asarray(q_inverse)


def inverse_element(r: Any, w: Any, *, gain: float = 0.0, operator: Any = Play, name: str = "inverse") -> Inverse:
    """Invert one channel of a Prandtl-Ishlinskii element, `v = gain z + Σ w_j H_rj[z]`.

    Parameters
    ----------
    r, w : array, shape (n,)
        Thresholds (not negative, any order) and weights of the operators.
    gain : float
        Linear part; it adds to the weights of operators with threshold 0.
    operator : Play or Stop
        Kind of the operators.
    name : str
        Name of the CasADi Function.

    Raises
    ------
    InputError
        If the element has no inverse: its slope right after a reversal, or along its loading curve, is zero or
        changes sign.
    """
    kind = operator() if isinstance(operator, type) else operator
    r, w = numbers(r, "The thresholds").ravel(), numbers(w, "The weights").ravel()
    gain = float(numbers(gain, "gain", ()))
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise InputError(f"The function name {name!r} cannot be used; give letters, digits and single underscores.")
    if not isinstance(kind, Play | Stop):
        raise InputError(f"The inverse of {operator!r} is not known in closed form; give Play or Stop.")
    if len(r) != len(w):
        raise InputError(f"{len(r)} thresholds and {len(w)} weights were given; give one weight for each threshold.")
    if np.any(r < 0):
        raise InputError(f"A threshold is {np.min(r):.4g}; thresholds are half-widths, give zero or more.")
    if isinstance(kind, Stop):
        gain, w = gain + float(np.sum(w)), -w
    order = np.argsort(r, kind="stable")
    r, w = np.concatenate([[0.0], r[order]]), np.concatenate([[float(gain)], w[order]])
    slope = np.cumsum(w)
    first = int(np.sum(r == 0))  # operators without width belong to the linear part
    sign = 1.0 if slope[first - 1] > 0 else -1.0
    if np.any(sign * slope[first - 1 :] <= 1e-12 * np.max(np.abs(slope))):
        raise InputError(
            f"This element has no inverse: its slope is {slope[first - 1]:.4g} right after a reversal and "
            f"{slope[-1]:.4g} once everything slips, and all slopes must be above zero, or all below; add a linear "
            "part with gain=."
        )
    w_inverse = np.zeros(len(r))
    w_inverse[0] = 1 / slope[first - 1]
    w_inverse[first:] = -w[first:] / (slope[first:] * slope[first - 1 : -1])
    r_inverse = sign * np.array([np.sum(w[: i + 1] * (r[i] - r[: i + 1])) for i in range(len(r))])
    q, v = ca.SX.sym("memory", len(r)), ca.SX.sym("wanted")
    q_next = ca.vertcat(*[play(v, q[i], r_inverse[i]) for i in range(len(r))])
    names = ["memory", "wanted"], ["memory_next", "u"]
    step = ca.Function(name, [q, v], [q_next, ca.dot(ca.DM(w_inverse), q_next)], *names)
    return Inverse(step, r_inverse, w_inverse, (order, r, w))
