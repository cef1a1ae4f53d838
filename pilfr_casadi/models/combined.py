"""Elements combined in one: each reads some channels of the port and adds to some, in parallel or side by side.

    w[writes_k] += element_k(z[reads_k])

so that plays at the inputs, products and an envelope in the feedback share one loop (Krikelis et al. 2024, Eq. 15-17,
with another element in the place of Eq. 16).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, whole
from .elements import Element
from .parameters import ParameterSet


@dataclass(frozen=True)
class Part:
    """An element inside a `Combined`.

    Parameters
    ----------
    name : str
        Its parameters are called `name_parameter`.
    element : Element
        What is computed.
    reads, writes : tuple of int
        Channels of the port that its signals come from, and to which its output is added, as many as it has channels;
        `writes` left out, those that it reads.

    Raises
    ------
    InputError
        If the name is none, or the channels are not as many as the element has, or one is listed twice in `writes`.
    """

    name: str
    element: Any
    reads: tuple[int, ...]
    writes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise InputError(f"A part of an element is called {self.name!r}; give a name of letters, digits and _.")
        if isinstance(self.element, type) or not all(
            hasattr(self.element, name) for name in ("channels", "memory", "parameters", "step")
        ):
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
    """Elements that act together on the channels of one port.

    Parameters
    ----------
    parts : sequence of Part
        What is combined.
    channels : int, optional
        Channels of the port; by default one more than the largest that a part reads or writes.

    Raises
    ------
    InputError
        If there is no part, a name comes twice, or a part reads or writes a channel that is not there.
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
        """Those of all parts, under `name_parameter`."""
        return ParameterSet(
            {f"{part.name}_{k}": p for part in self.parts for k, p in part.element.parameters().items()}
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One step: the sum of what the parts write, and their next memory."""
        w: list[Any] = [0] * self.channels
        following, at = [], 0
        for part in self.parts:
            memory = s[at : at + part.element.memory]
            at += part.element.memory
            signals = ca.vertcat(*(z[i] for i in part.reads))
            out, after = part.element.step(signals, memory, _Own(p, part))
            for k, i in enumerate(part.writes):
                w[i] = w[i] + out[k]
            following.append(after)
        return ca.vertcat(*w), ca.vertcat(*following)

    def slopes(self, p: Mapping[str, Any]) -> dict[str, Any]:
        """Slopes of w over z (channels, channels) of all parts together, as of each alone; bounded parts add none."""
        known = [(part, element_slopes(part.element, _Own(p, part))) for part in self.parts]
        names = max((tuple(slopes) for _, slopes in known), key=len)
        out = {}
        for k, name in enumerate(names):
            total: Any = ca.DM(self.channels, self.channels)
            for part, slopes in known:
                if slopes:
                    own = list(slopes.values())[min(k, len(slopes) - 1)]
                    total = total + _placed(self.channels, part.writes) @ own @ _placed(self.channels, part.reads).T
            out[name] = total
        return out

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Largest |w| of each channel where |z| is at most `size`, (channels,); infinite where a part is unbounded."""
        out = np.zeros(self.channels)
        for part in self.parts:
            out[list(part.writes)] += element_bound(part.element, _Own(p, part), np.asarray(size)[list(part.reads)])
        return out


class _Own(Mapping[str, Any]):
    """The parameters of one part by their own names."""

    def __init__(self, p: Mapping[str, Any], part: Part) -> None:
        self._p, self._names = p, tuple(part.element.parameters())
        self._prefix = part.name

    def __getitem__(self, name: str) -> Any:
        return self._p[f"{self._prefix}_{name}"]

    def __iter__(self) -> Any:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def element_bound(element: Element, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
    """Largest |w| of each channel of an element whose signals are at most `size`, (channels,); infinite if unknown."""
    bound = getattr(element, "bound", None)
    return np.full(element.channels, np.inf) if bound is None else np.asarray(bound(p, size), dtype=float)


def element_slopes(element: Element, p: Mapping[str, Any]) -> dict[str, Any]:
    """Slopes of an element, (channels, channels) each, by what they are the slopes of; none where none is known."""
    slopes = getattr(element, "slopes", None)
    return {} if slopes is None else dict(slopes(p))


def unknown_slope(element: Element, p: Mapping[str, Any]) -> bool:
    """Whether an element of the named numbers p may grow with its signals and how steeply is not known."""
    if isinstance(element, Combined):
        return any(unknown_slope(part.element, _Own(p, part)) for part in element.parts)
    bounded = bool(np.all(np.isfinite(element_bound(element, p, np.full(element.channels, np.inf)))))
    return not bounded and not element_slopes(element, p)


def _placed(channels: int, at: tuple[int, ...]) -> ca.DM:
    """A matrix (channels, k) of zeros and ones that puts k signals where they belong."""
    return ca.DM(np.eye(channels)[:, list(at)])
