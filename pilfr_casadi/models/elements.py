"""Elements: laws with memory from a local signal z to an internal signal w.

An element is anything with `channels`, `memory`, `parameters()` and `step(z, s, p) -> (w, s_next)`; `close_loop` puts
it into a model's port. `PrandtlIshlinskii` is the layer of Krikelis et al. (2024), Eq. 16: `w_i(k) = Σ_j w_ij
H_rij[z_i](k)`. `StaticNetwork` is its counterpart without memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca
import numpy as np

from .._base import InputError
from .operators import GeneralizedPlay, Play, Stop
from .parameters import Parameter, ParameterSet

LAYER = ("w", "r")  # parameters of a Prandtl-Ishlinskii layer that have an entry for each operator


class Element(Protocol):
    """What `close_loop` needs of an element."""

    @property
    def channels(self) -> int:
        """Number of signals in and out, `n_z = n_w`."""

    @property
    def memory(self) -> int:
        """Number of memory states."""

    def parameters(self) -> ParameterSet:
        """The element's parameters with start values and bounds."""

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Symbolic step: z (channels, 1), s (memory, 1), p by name -> w (channels, 1), next s."""


@dataclass(frozen=True)
class PrandtlIshlinskii:
    """A layer of N hysteresis operators of one kind a channel, Eq. 16.

    Parameters
    ----------
    operator : Play, Stop or GeneralizedPlay (class or instance)
        The operator.
    n : int
        Operators a channel, N.
    channels : int
        Number of signals, each with weights `w[i, :] ≥ 0` and thresholds `r[i, :] ≥ 0` of its own.
    rounded : bool
        Round the kinks over a band of half-width `eps`, then a parameter, fixed at 0 until changed (see `operators`).
    """

    operator: Any = Play
    n: int = 10
    channels: int = 1
    rounded: bool = False
    kind: str = field(init=False, default="prandtl_ishlinskii")

    def __post_init__(self) -> None:
        operator = self.operator() if isinstance(self.operator, type) else self.operator
        if not isinstance(operator, Play | Stop | GeneralizedPlay):
            raise InputError(f"The operator {self.operator!r} is unknown; use Play, Stop or GeneralizedPlay.")
        _check_counts("A Prandtl-Ishlinskii element", n=self.n, channels=self.channels)
        object.__setattr__(self, "operator", operator)

    @property
    def memory(self) -> int:
        """One play state an operator."""
        return self.n * self.channels

    def parameters(self) -> ParameterSet:
        """`w`, `r` (channels, N), explicit bounds `≥ 0`, and the operator's own."""
        shape = (self.channels, self.n)
        grid = np.tile((np.arange(self.n) + 0.5) / self.n, (self.channels, 1))
        own = ParameterSet(
            {
                "w": Parameter(np.full(shape, 1.0 / self.n), bounds=(0.0, np.inf)),
                "r": Parameter(grid, bounds=(0.0, np.inf)),
            }
        )
        if self.rounded:
            own = own | {"eps": Parameter(0.0, bounds=(0.0, np.inf), fixed=True)}
        return own | self.operator.parameters(self.channels)

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One step; memory is stacked channel by channel."""
        eps = p["eps"] if self.rounded else 0.0
        w_out, s_out = [], []
        for i in range(self.channels):
            for j in range(self.n):
                q = s[i * self.n + j]
                more = {"channel": i} if isinstance(self.operator, GeneralizedPlay) else {}
                v, q_next = self.operator.step(z[i], q, p["r"][i, j], p, eps, **more)
                w_out.append(p["w"][i, j] * v)
                s_out.append(q_next)
        w = [sum(w_out[i * self.n + 1 : (i + 1) * self.n], w_out[i * self.n]) for i in range(self.channels)]
        return ca.vertcat(*w), ca.vertcat(*s_out)

    def slopes(self, p: Mapping[str, Any]) -> dict[str, Any]:
        """Slopes of w over z (channels, channels) in large motions, of stops in small ones, by what they belong to.

        `Σ w` of plays, which all slip then, and of stops, which all stick; of generalized plays that times the slope of
        each envelope network far out. None is known of envelopes of one's own.
        """
        full, operator = ca.sum2(p["w"]), self.operator
        if not isinstance(operator, GeneralizedPlay):
            return {"full slope": ca.diag(full)}
        sides = {"lower": "l", "upper": "r"} if operator.networks else {}
        return {f"{which} envelope far out": ca.diag(full * operator.far_slope(s, p)) for which, s in sides.items()}

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Largest |w| of each channel where |z| is at most `size` (channels,), from memory zero.

        A stop stays within its threshold whatever z does; a play follows z, and so does a generalized play, of which no
        bound is known here.
        """
        w, r, z = np.asarray(p["w"], dtype=float), np.asarray(p["r"], dtype=float), np.asarray(size, dtype=float)
        if isinstance(self.operator, GeneralizedPlay):
            return np.full(self.channels, np.inf)
        rest = np.asarray(p["eps"], dtype=float) / 4 if self.rounded else 0.0
        z = z[:, None]
        largest = np.minimum(r, 2 * z) if isinstance(self.operator, Stop) else np.maximum(z - r, 0.0)
        return np.asarray(np.sum(np.abs(w) * np.where(w != 0, largest + rest, 0.0), axis=1))


@dataclass(frozen=True)
class StaticNetwork:
    """A one-hidden-layer network a channel, without memory: `w_i = Σ_j gain_ij tanh(slope_ij z_i + bias_ij)`.

    In the port of a linear model it makes a nonlinear LFR (Schoukens and Tóth 2020); with one neuron a channel and the
    gains and slopes held at one it is a layer of neurons whose weights are the linear blocks (`baselines.ssnn`). It is
    bounded, so every simulation of an LFR with a stable `A` is.

    Parameters
    ----------
    hidden : int
        Neurons a channel.
    channels : int
        Number of signals, each with neurons of its own.

    Raises
    ------
    InputError
        If a number is not whole or less than one.
    """

    hidden: int = 10
    channels: int = 1
    kind: str = field(init=False, default="static_network")

    def __post_init__(self) -> None:
        _check_counts("A static network", hidden=self.hidden, channels=self.channels)

    @property
    def memory(self) -> int:
        """None."""
        return 0

    def parameters(self) -> ParameterSet:
        """`gain`, `slope`, `bias`, each (channels, hidden)."""
        shape = (self.channels, self.hidden)
        bias = np.tile(np.linspace(-1.0, 1.0, self.hidden) if self.hidden > 1 else np.zeros(1), (self.channels, 1))
        return ParameterSet(
            {"gain": Parameter(np.ones(shape)), "slope": Parameter(np.ones(shape)), "bias": Parameter(bias)}
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One step; s is empty."""
        neurons = ca.tanh(p["slope"] * ca.repmat(z, 1, self.hidden) + p["bias"])
        return ca.sum2(p["gain"] * neurons), s

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Largest |w| of each channel for any z, (channels,)."""
        return np.asarray(np.sum(np.abs(np.asarray(p["gain"], dtype=float)), axis=1))


def weight_density(r: np.ndarray, w: np.ndarray, grid: np.ndarray, width: float) -> np.ndarray:
    """Density of weights (N,) over thresholds (N,) on a grid (G,): Gaussian kernels, mirrored at zero."""
    kernels = sum(np.exp(-0.5 * ((grid[:, None] - sign * r) / width) ** 2) for sign in (1, -1))
    return np.asarray(kernels @ w) / (width * np.sqrt(2 * np.pi))


def _check_counts(what: str, **counts: Any) -> None:
    for count in counts.values():
        if (
            isinstance(count, bool)
            or not isinstance(count, int | float | np.number)
            or count < 1
            or int(count) != count
        ):
            names, given = " and ".join(f"{k} >= 1" for k in counts), " and ".join(map(repr, counts.values()))
            raise InputError(f"{what} needs whole numbers {names}; {given} were given.")
