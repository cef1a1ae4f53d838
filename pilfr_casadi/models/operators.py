"""Stop, play and generalized play: exact one-step hysteresis operators.

Each operator has one memory state `q`, the play state, and maps `(z, q, r)` to `(v, q_next)`:

- play, Krikelis et al. (2024), Eq. 5 and 11: `v = q_next = max(z - r, min(z + r, q))`;
- stop, Eq. 3 and 9 in the clip form `v = min(r, max(-r, z - q))`, `q_next = z - v`. The memory is the play state
  `q = z(k-1) - v(k-1)`, which makes `play + stop = z` (Eq. 8) an identity and needs no division by r;
- generalized play, Eq. 7 and 13: `v = q_next = max(gl - r, min(hi, q))`, `gl = γ_l(z)`, `gr = γ_r(z)`.

The generalized play is a play only where `γ_l(z) - r <= γ_r(z) + r`. This is met by construction: the upper curve is
`hi = max(gr + r, gl - r)`, which is `γ_r + r` wherever the condition holds; elsewhere the loop has no width.

All operators take numbers, NumPy arrays and CasADi symbols. The derivative at a kink is the one of the sticking side.
`eps > 0` rounds min and max over a band of half-width eps. The rounding has compact support: nothing changes outside
the band, so no memory leaks, whereas softplus would lose memory at every step. One rounded min, max or step of an
operator is off by at most eps/4. In the band a rounded play creeps sample by sample. So over a record it is off by at
most eps, and it is rate independent only outside the band.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, is_whole
from .parameters import Parameter, ParameterSet, check_size

_TINY = 1e-300
_SYMBOLIC = (ca.SX, ca.MX, ca.DM)


def fmax(a: Any, b: Any, eps: Any = 0.0) -> Any:
    """Compute max(a, b), rounded over |a - b| < eps by `(eps - |a - b|)₊² / 4 eps`; numbers, arrays or symbols.

    Without rounding the derivative at a tie is the derivative of `b`.
    """
    symbolic = isinstance(a, _SYMBOLIC) or isinstance(b, _SYMBOLIC)
    # casadi's own fmax halves the derivative at a tie, which is wrong for a threshold resting on its bound r = 0
    top = ca.if_else(a > b, a, b) if symbolic else np.maximum(a, b)
    if not isinstance(eps, _SYMBOLIC) and np.all(np.asarray(eps) == 0):
        return top
    if symbolic or isinstance(eps, _SYMBOLIC):
        return top + ca.fmax(0, eps - ca.fabs(a - b)) ** 2 / (4 * ca.fmax(eps, _TINY))
    return top + np.maximum(0, eps - np.abs(a - b)) ** 2 / (4 * np.maximum(eps, _TINY))


def fmin(a: Any, b: Any, eps: Any = 0.0) -> Any:
    """Compute min(a, b), rounded as in `fmax`; without rounding the derivative at a tie is the derivative of `b`."""
    return -fmax(-a, -b, eps)


def play(z: Any, q: Any, r: Any, eps: Any = 0.0) -> Any:
    """Step a play (backlash) of half-width r: the new play state `max(z - r, min(z + r, q))`, Eq. 5."""
    return fmax(z - r, fmin(z + r, q, eps), eps)


def stop(z: Any, q: Any, r: Any, eps: Any = 0.0) -> Any:
    """Step a stop of threshold r, `z - play(z, q, r)`: the clip `min(r, max(-r, z - q))` of Eq. 3 and 9."""
    if isinstance(eps, _SYMBOLIC) or np.any(np.asarray(eps) != 0):
        return z - play(z, q, r, eps)
    return fmin(r, fmax(-r, z - q))


def generalized_play(
    z: Any, q: Any, r: Any, gamma_l: Callable[[Any], Any], gamma_r: Callable[[Any], Any], eps: Any = 0.0
) -> Any:
    """Step a generalized play between `γ_l(z) - r` (below) and `γ_r(z) + r` (above), Eq. 7; always well posed."""
    low = gamma_l(z) - r
    high = fmax(gamma_r(z) + r, low)
    return fmax(low, fmin(high, q, eps), eps)


@dataclass(frozen=True)
class Play:
    """The play operator, Eq. 5; `v = q_next`."""

    name = "play"

    def step(self, z: Any, q: Any, r: Any, p: Any, eps: Any = 0.0) -> tuple[Any, Any]:
        """Compute one step: (output, next memory); z is a scalar or has the shape of q and r."""
        v = play(z, q, r, eps)
        return v, v


@dataclass(frozen=True)
class Stop:
    """The stop operator, Eq. 3 and 9; the memory is the play state `z - v`."""

    name = "stop"

    def step(self, z: Any, q: Any, r: Any, p: Any, eps: Any = 0.0) -> tuple[Any, Any]:
        """Compute one step: (output, next memory)."""
        v = stop(z, q, r, eps)
        return v, z - v


@dataclass(frozen=True)
class GeneralizedPlay:
    """The generalized play, Eq. 7 and 13, with envelopes that are small networks (Eq. 14) or any user expression.

    Parameters
    ----------
    neurons : int
        Neurons of each envelope network `γ(z) = c + a_0 z + Σ a_j tanh(b_j z + d_j)`. `a_0, a, b ≥ 0` are bounds of the
        fit, so the envelopes are non-decreasing by construction.
    gamma_l, gamma_r : callables, optional
        Expressions `γ(z, p)` of the signal and the parameters by name, in place of the networks; non-decreasing in z.
    extra : ParameterSet, optional
        Parameters that the user's expressions read.

    Raises
    ------
    InputError
        If the number of neurons is negative or not whole.
    """

    neurons: int = 3
    gamma_l: Callable[[Any, Any], Any] | None = None
    gamma_r: Callable[[Any, Any], Any] | None = None
    extra: ParameterSet | None = None
    name = "generalized_play"

    def __post_init__(self) -> None:
        if not is_whole(self.neurons, 0):
            raise InputError(f"An envelope has {self.neurons!r} neurons; give a whole number, 0 or more.")
        check_size("A generalized play", 6 * int(self.neurons))

    @property
    def networks(self) -> bool:
        """Whether both envelopes are networks."""
        return self.gamma_l is None and self.gamma_r is None

    def parameters(self, channels: int) -> ParameterSet:
        """Make the envelope parameters, one row per channel; envelopes start near the identity, with small neurons."""
        entries: dict[str, Parameter] = dict(self.extra or {})
        for side, own in (("l", self.gamma_l), ("r", self.gamma_r)):
            if own is not None:
                continue
            shape, positive = (channels, self.neurons), (0.0, np.inf)
            entries[f"gamma_{side}_c"] = Parameter(np.zeros((channels, 1)))
            entries[f"gamma_{side}_a0"] = Parameter(np.ones((channels, 1)), bounds=positive)
            entries[f"gamma_{side}_a"] = Parameter(np.full(shape, 0.01), bounds=positive)
            entries[f"gamma_{side}_b"] = Parameter(np.ones(shape), bounds=positive)
            entries[f"gamma_{side}_d"] = Parameter(-np.tile(np.linspace(-1.0, 1.0, self.neurons), (channels, 1)))
        return ParameterSet(entries)

    def envelope(self, side: str, z: Any, p: Any, channel: int = 0) -> Any:
        """Evaluate γ_l or γ_r at z; `side` is "l" or "r", p maps names to values or symbols."""
        own = self.gamma_l if side == "l" else self.gamma_r
        if own is not None:
            return own(z, p)
        c, a0, a, b, d = (p[f"gamma_{side}_{k}"] for k in ("c", "a0", "a", "b", "d"))
        out = c[channel, 0] + a0[channel, 0] * z
        tanh = ca.tanh if isinstance(z, _SYMBOLIC) or isinstance(a, _SYMBOLIC) else np.tanh
        for j in range(self.neurons):
            out = out + a[channel, j] * tanh(b[channel, j] * z + d[channel, j])
        return out

    def far_slope(self, side: str, p: Any) -> Any:
        """Return the slope of γ_l or γ_r where its neurons saturate, `a_0` of each channel: (channels, 1)."""
        return p[f"gamma_{side}_a0"]

    def steepest(self, side: str, p: Any) -> np.ndarray:
        """Compute the largest slope of the network γ_l or γ_r for numbers p, each channel: (channels,)."""
        a0, a, b, d = (np.asarray(p[f"gamma_{side}_{k}"], dtype=float) for k in ("a0", "a", "b", "d"))
        out = []
        for i in range(len(a0)):
            at = [(np.linspace(-2, 2, 81) - shift) / rate for rate, shift in zip(b[i], d[i], strict=True) if rate > 0]
            z = np.concatenate([np.zeros(1), *at])[:, None]
            out.append(
                a0[i, 0] + np.max(np.sum(a[i] * b[i] / np.cosh(np.clip(b[i] * z + d[i], -300, 300)) ** 2, axis=1))
            )
        return np.array(out)

    def step(self, z: Any, q: Any, r: Any, p: Any, eps: Any = 0.0, channel: int = 0) -> tuple[Any, Any]:
        """Compute one step: (output, next memory)."""
        low, high = (partial(self.envelope, side, p=p, channel=channel) for side in "lr")
        v = generalized_play(z, q, r, low, high, eps)
        return v, v
