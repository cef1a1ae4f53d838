r"""Elements: maps with memory from a local signal z to an internal signal w.

An element is anything with `channels`, `memory`, `parameters()` and `step(z, s, p) -> (w, s_next)`; `close_loop` puts
it into a model's port (Krikelis et al. 2024, Eq. 15-17, with `n_z = n_w = channels`):

- `PrandtlIshlinskii`, the layer of Eq. 16: `w_i(k) = Σ_j w_ij H_rij[z_i](k)`;
- `StaticNetwork`, its counterpart without memory: `w_i = Σ_j gain_ij tanh(slope_ij z_i + bias_ij)`;
- `Products`, a polynomial of several signals: `w_i = Σ_m g_im φ_m(clip(z, ±ρ))` with `φ_m = z_j z_k …`;
- `Envelope`, a gain that a slow amplitude schedules: `e⁺ = min(e + κ (z² - e), c²)`, `a = √e⁺`,
  `w = a / (a + b) clip(z, ±ρ)`;
- `Combined`, several of these in one port: `w[writes_k] += element_k(z[reads_k])`.

An element may also have `slopes(p)`, its slopes in large motions, and `bound(p, size)`, its largest output.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from math import prod
from typing import Any, Protocol

import casadi as ca
import numpy as np

from .._base import InputError, whole
from .operators import GeneralizedPlay, Play, Stop, fmax, fmin
from .parameters import Parameter, ParameterSet, check_size

LAYER = ("w", "r")  # parameters of a Prandtl-Ishlinskii layer that have an entry for each operator
CREST = 3.0  # ratio of the largest z to the largest amplitude of an envelope
SMALL = 1e-6  # share of the knee's square added to an envelope's mean square, so that its root has a slope at rest


class Element(Protocol):
    """The attributes that `close_loop` needs of an element."""

    @property
    def channels(self) -> int:
        """Number of signals in and out, `n_z = n_w`."""

    @property
    def memory(self) -> int:
        """Number of memory states."""

    def parameters(self) -> ParameterSet:
        """Make the element's parameters with start values and bounds."""

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one symbolic step: z (channels, 1), s (memory, 1), p by name -> w (channels, 1), next s."""


def is_element(thing: Any) -> bool:
    """Tell whether an object has the attributes of an `Element`; a class is no element."""
    needed = ("channels", "memory", "parameters", "step")
    return not isinstance(thing, type) and all(hasattr(thing, name) for name in needed)


@dataclass(frozen=True)
class PrandtlIshlinskii:
    """A layer of N hysteresis operators of one kind for each channel (Krikelis et al. 2024, Eq. 16).

    Parameters
    ----------
    operator : Play, Stop or GeneralizedPlay (class or instance)
        The operator.
    n : int
        Operators of each channel, N.
    channels : int
        Number of signals, each with weights `w[i, :] ≥ 0` and thresholds `r[i, :] ≥ 0` of its own.
    rounded : bool
        Round the kinks over a band of half-width `eps`, then a parameter, fixed at 0 until changed (see `operators`).

    Raises
    ------
    InputError
        If the operator is unknown, or a number is not whole or less than one.

    Examples
    --------
    >>> from pilfr_casadi import Play
    >>> element = PrandtlIshlinskii(Play, 20)
    >>> element.memory, list(element.parameters())
    (20, ['w', 'r'])
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
        """One play state for each operator."""
        return self.n * self.channels

    def parameters(self) -> ParameterSet:
        """Make `w` and `r` (channels, N), both `≥ 0`, and the operator's own parameters."""
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
        if isinstance(self.operator, GeneralizedPlay):
            own = own | self.operator.parameters(self.channels)
        return own

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one step; the memory is stacked channel by channel."""
        eps = p["eps"] if self.rounded else 0.0
        w, s_next = [], []
        for i in range(self.channels):
            more = {"channel": i} if isinstance(self.operator, GeneralizedPlay) else {}
            weighted = []
            for j in range(self.n):
                v, q_next = self.operator.step(z[i], s[i * self.n + j], p["r"][i, j], p, eps, **more)
                weighted.append(p["w"][i, j] * v)
                s_next.append(q_next)
            w.append(sum(weighted[1:], weighted[0]))
        return ca.vertcat(*w), ca.vertcat(*s_next)

    def slopes(self, p: Mapping[str, Any]) -> dict[str, Any]:
        """Compute the slopes of w over z (channels, channels) in large motions (for stops in small ones), by name.

        The slope is `Σ w`: in large motions all plays slip, in small ones all stops stick. For generalized plays it is
        multiplied by the slope of each envelope network far out; the slope of user-defined envelopes is unknown.
        """
        full, operator = ca.sum2(p["w"]), self.operator
        if not isinstance(operator, GeneralizedPlay):
            return {"full slope": ca.diag(full)}
        sides = {"lower": "l", "upper": "r"} if operator.networks else {}
        return {f"{name} envelope far out": ca.diag(full * operator.far_slope(s, p)) for name, s in sides.items()}

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Compute the largest |w| of each channel where |z| is at most `size` (channels,), from memory zero.

        A stop stays within its threshold for any z; a play follows z. The bound of a generalized play is unknown.
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
    """A network with one hidden layer for each channel, without memory.

    In the port of a linear model it makes a nonlinear LFR (Schoukens and Tóth 2020). With one neuron a channel, and
    gains and slopes fixed at one, it is a layer of neurons whose weights are the linear blocks (`ssnn`). Its output is
    bounded, so every simulation of an LFR with a stable `A` is bounded too.

    Parameters
    ----------
    hidden : int
        Neurons of each channel.
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
    memory = 0

    def __post_init__(self) -> None:
        _check_counts("A static network", hidden=self.hidden, channels=self.channels)

    def parameters(self) -> ParameterSet:
        """Make `gain`, `slope` and `bias`, each (channels, hidden)."""
        shape = (self.channels, self.hidden)
        bias = np.tile(np.linspace(-1.0, 1.0, self.hidden) if self.hidden > 1 else np.zeros(1), (self.channels, 1))
        return ParameterSet(
            {"gain": Parameter(np.ones(shape)), "slope": Parameter(np.ones(shape)), "bias": Parameter(bias)}
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one step; s is empty."""
        neurons = ca.tanh(p["slope"] * ca.repmat(z, 1, self.hidden) + p["bias"])
        return ca.sum2(p["gain"] * neurons), s

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Compute the largest |w| of each channel for any z, (channels,)."""
        return np.asarray(np.sum(np.abs(np.asarray(p["gain"], dtype=float)), axis=1))


@dataclass(frozen=True)
class Products:
    """All products of the channels of the given degrees, mixed into as many channels by `gain`.

    Squares and cubes are included. In the port of a linear model they are the polynomial feedback of a nonlinear LFR.

    Parameters
    ----------
    channels : int
        Number of signals in and out.
    degrees : tuple of int
        Degrees of the products, such as (2, 3). Parameters: `gain` (channels, terms), terms in the order of `terms`,
        and `reach` ρ (channels,), fixed, in units of z, which limits w.

    Raises
    ------
    InputError
        If a number is not whole, or there is no degree.
    """

    channels: int = 1
    degrees: tuple[int, ...] = (2, 3)
    kind: str = field(init=False, default="products")
    memory = 0

    def __post_init__(self) -> None:
        whole(self.channels, "The number of channels of products", 1)
        if not isinstance(self.degrees, tuple | list) or not self.degrees:
            raise InputError(f"The degrees of products are {self.degrees!r}; give whole numbers, such as (2, 3).")
        for degree in self.degrees:
            whole(degree, "A degree of products", 2)
        object.__setattr__(self, "degrees", tuple(sorted({int(d) for d in self.degrees})))

    @property
    def terms(self) -> tuple[tuple[int, ...], ...]:
        """Channels that each product multiplies."""
        return tuple(t for d in self.degrees for t in combinations_with_replacement(range(self.channels), d))

    def parameters(self) -> ParameterSet:
        """Make `gain` (channels, terms), zero at first, and `reach` (channels,)."""
        return ParameterSet(
            {
                "gain": Parameter(np.zeros((self.channels, len(self.terms)))),
                "reach": Parameter(np.full(self.channels, 1e3), bounds=(0.0, np.inf), fixed=True),
            }
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one step: w (channels, 1), and no memory."""
        inside = [fmax(fmin(z[i], p["reach"][i]), -p["reach"][i]) for i in range(self.channels)]
        products = [prod(inside[i] for i in term) for term in self.terms]
        w = [sum(p["gain"][i, m] * value for m, value in enumerate(products)) for i in range(self.channels)]
        return ca.vertcat(*w), s

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Compute the largest |w| of each channel where |z| is at most `size`, (channels,); finite for any z."""
        reach = np.minimum(np.asarray(p["reach"], dtype=float), size)
        largest = np.array([prod(reach[i] for i in term) for term in self.terms])
        return np.asarray(np.abs(np.asarray(p["gain"], dtype=float)) @ largest)


@dataclass(frozen=True)
class Envelope:
    """A gain on each channel that its own slow amplitude schedules.

    The amplitude `a` is the root mean square of z over the last 1/κ samples. Through `B_w` and `C_z` of a PI-LFR it
    makes a stiffness fall (or rise) with the amplitude of vibration and hardly changes the damping, as in structures
    whose resonances move with the level (slow dynamics, amplitude-dependent modulus). Play and stop
    operators do the same within a period, but then dissipate in proportion.

    `ρ` (`reach`) and `c = ρ / 3` limit w. Start values from data lie beyond the visited range of z, so that the limits
    matter only to a bound on the response.

    Parameters
    ----------
    channels : int
        Number of signals. Parameters of each channel: `rate` κ (per sample), `knee` b > 0 (unit of z: the amplitude of
        half the gain), `reach` ρ (unit of z, fixed).

    Raises
    ------
    InputError
        If the number is not whole and above zero.
    """

    channels: int = 1
    kind: str = field(init=False, default="envelope")

    def __post_init__(self) -> None:
        whole(self.channels, "An envelope's number of channels", 1)

    @property
    def memory(self) -> int:
        """One mean square for each channel."""
        return self.channels

    def parameters(self) -> ParameterSet:
        """Make `rate`, `knee` and `reach`, each (channels,)."""
        one = np.ones(self.channels)
        return ParameterSet(
            {
                "rate": Parameter(1e-2 * one, bounds=(1e-6, 1.0)),
                "knee": Parameter(one, bounds=(1e-6, np.inf)),
                "reach": Parameter(1e3 * one, bounds=(0.0, np.inf), fixed=True),
            }
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one step: w (channels, 1) and the next mean squares."""
        w, s_next = [], []
        for i in range(self.channels):
            rate, knee, reach = p["rate"][i], p["knee"][i], p["reach"][i]
            e = fmin(s[i] + rate * (z[i] ** 2 - s[i]), (reach / CREST) ** 2)
            a = ca.sqrt(e + SMALL * knee**2)
            w.append(fmax(fmin(z[i], reach), -reach) * a / (a + knee))
            s_next.append(e)
        return ca.vertcat(*w), ca.vertcat(*s_next)

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Compute the largest |w| of each channel where |z| is at most `size`, (channels,); finite for any z."""
        reach, knee = (np.asarray(p[name], dtype=float) for name in ("reach", "knee"))
        a = np.sqrt(np.minimum(reach / CREST, size) ** 2 + SMALL * knee**2)
        return np.asarray(np.minimum(reach, size) * a / (a + knee))


@dataclass(frozen=True)
class Part:
    """An element inside a `Combined`.

    Parameters
    ----------
    name : str
        Prefix of its parameters: `name_parameter`.
    element : Element
        The element itself.
    reads, writes : tuple of int
        Channels of the port that its signals come from, and to which its output is added, as many as it has channels;
        `writes` defaults to `reads`.

    Raises
    ------
    InputError
        If the name is not an identifier, the number of channels differs from the element's, or `writes` lists one
        twice.
    """

    name: str
    element: Any
    reads: tuple[int, ...]
    writes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise InputError(f"A part of an element is called {self.name!r}; give a name of letters, digits and _.")
        if not is_element(self.element):
            raise InputError(f"The part {self.name!r} is {self.element!r}; give an element, such as Envelope(3).")
        for key in ("reads", "writes"):
            given = getattr(self, key)
            if isinstance(given, str) or not isinstance(given, Sequence):
                raise InputError(f"The part {self.name!r} {key} {given!r}; give a tuple of channels, such as (0, 1).")
            for channel in given:
                whole(channel, f"A channel that the part {self.name!r} {key}", 0)
            object.__setattr__(self, key, tuple(int(c) for c in given) or self.reads)
            if len(getattr(self, key)) != self.element.channels:
                raise InputError(
                    f"The part {self.name!r} {key} {len(getattr(self, key))} channels and its element has "
                    f"{self.element.channels}; give as many."
                )
        if len(set(self.writes)) < len(self.writes):
            raise InputError(f"The part {self.name!r} writes {self.writes}; give each channel once.")


@dataclass(frozen=True)
class Combined:
    """Elements that act together on the channels of one port, in parallel or side by side.

    Parameters
    ----------
    parts : sequence of Part
        The elements, each with the channels that it reads and writes.
    channels : int, optional
        Channels of the port; by default one more than the largest that a part reads or writes.

    Raises
    ------
    InputError
        If there is no part, a name comes twice, or a part reads or writes a channel that does not exist.
    """

    parts: tuple[Part, ...]
    channels: int = 0
    kind: str = field(init=False, default="combined")

    def __post_init__(self) -> None:
        try:
            parts = tuple(self.parts)
        except TypeError:
            parts = ()
        if not parts or not all(isinstance(part, Part) for part in parts):
            raise InputError(f"Combined was given {self.parts!r}; give a list of Part(name, element, reads, writes).")
        names = [part.name for part in parts]
        if len(set(names)) < len(names):
            raise InputError(f"The parts are called {', '.join(names)}; give each a name of its own.")
        last = max(max((*part.reads, *part.writes)) for part in parts)
        channels = whole(self.channels, "The number of channels of combined elements", 0) or last + 1
        if last >= channels:
            raise InputError(f"A part reads or writes channel {last} of {channels}, from 0 on; give more channels.")
        object.__setattr__(self, "parts", parts)
        object.__setattr__(self, "channels", channels)

    @property
    def memory(self) -> int:
        """Memory states of all parts, one part after the other."""
        return sum(part.element.memory for part in self.parts)

    def parameters(self) -> ParameterSet:
        """Make the parameters of all parts, under `name_parameter`."""
        return ParameterSet(
            {f"{part.name}_{k}": p for part in self.parts for k, p in part.element.parameters().items()}
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Compute one step: the sum of the parts' outputs, and their next memory."""
        w: list[Any] = [0] * self.channels
        s_next, begin = [], 0
        for part in self.parts:
            memory = s[begin : begin + part.element.memory]
            begin += part.element.memory
            out, memory_next = part.element.step(ca.vertcat(*(z[i] for i in part.reads)), memory, _PartValues(p, part))
            for k, i in enumerate(part.writes):
                w[i] = w[i] + out[k]
            s_next.append(memory_next)
        return ca.vertcat(*w), ca.vertcat(*s_next)

    def slopes(self, p: Mapping[str, Any]) -> dict[str, Any]:
        """Add up the slopes of w over z (channels, channels) of all parts; bounded parts have none."""
        known = [(part, element_slopes(part.element, _PartValues(p, part))) for part in self.parts]
        names = max((tuple(slopes) for _, slopes in known), key=len)
        out = {}
        for k, name in enumerate(names):
            total: Any = ca.DM(self.channels, self.channels)
            for part, slopes in known:
                if slopes:
                    own = list(slopes.values())[min(k, len(slopes) - 1)]
                    total = total + self._selector(part.writes) @ own @ self._selector(part.reads).T
            out[name] = total
        return out

    def _selector(self, channels: tuple[int, ...]) -> ca.DM:
        """Make the matrix (channels, k) of zeros and ones that puts k signals into their channels."""
        return ca.DM(np.eye(self.channels)[:, list(channels)])

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Bound |w| of each channel where |z| is at most `size`, (channels,); infinite where a part is unbounded."""
        out = np.zeros(self.channels)
        for part in self.parts:
            own = _PartValues(p, part)
            out[list(part.writes)] += element_bound(part.element, own, np.asarray(size)[list(part.reads)])
        return out


class _PartValues(Mapping[str, Any]):
    """The values of one part by its own parameter names."""

    def __init__(self, p: Mapping[str, Any], part: Part) -> None:
        self._p, self._part = p, part

    def __getitem__(self, name: str) -> Any:
        return self._p[f"{self._part.name}_{name}"]

    def __iter__(self) -> Iterator[str]:
        return iter(self._part.element.parameters())  # on demand: building the parameters at every step is slow

    def __len__(self) -> int:
        return len(self._part.element.parameters())


def weight_density(r: np.ndarray, w: np.ndarray, grid: np.ndarray, width: float) -> np.ndarray:
    """Smooth the weights (N,) over their thresholds (N,) into a density on a grid (G,): Gaussians, mirrored at zero."""
    kernels = sum(np.exp(-0.5 * ((grid[:, None] - sign * r) / width) ** 2) for sign in (1, -1))
    return np.asarray(kernels @ w) / (width * np.sqrt(2 * np.pi))


def element_bound(element: Element, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
    """Bound |w| of each channel for signals of at most `size`, (channels,); infinite where no bound is known."""
    bound = getattr(element, "bound", None)
    return np.full(element.channels, np.inf) if bound is None else np.asarray(bound(p, size), dtype=float)


def element_slopes(element: Element, p: Mapping[str, Any]) -> dict[str, Any]:
    """Return the slopes of an element by name, (channels, channels) each; empty where none is known."""
    slopes = getattr(element, "slopes", None)
    return {} if slopes is None else dict(slopes(p))


def unknown_slope(element: Element, p: Mapping[str, Any]) -> bool:
    """Tell whether an element with values p may grow with its signals, and its slope is unknown."""
    if isinstance(element, Combined):
        return any(unknown_slope(part.element, _PartValues(p, part)) for part in element.parts)
    bounded = bool(np.all(np.isfinite(element_bound(element, p, np.full(element.channels, np.inf)))))
    return not bounded and not element_slopes(element, p)


def _check_counts(owner: str, **counts: Any) -> None:
    """Refuse counts that are not whole numbers above zero, or whose product is too large for a fit."""
    owned = f"{owner[0].lower()}{owner[1:]}"
    check_size(owner, prod(whole(count, f"{name} of {owned}", 1) for name, count in counts.items()))
