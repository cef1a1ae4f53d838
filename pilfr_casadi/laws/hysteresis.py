"""Rate-independent laws with memory: hysteresis in its forms, and backlash.

`SmoothHysteresis` is a Prandtl-Ishlinskii layer whose stops have thresholds `R q` of a smooth density of three numbers,

    w = k_h int_0^inf g(q) stop_{R q}[z] dq,  g(q) = a^a q^(a - 1) exp(-a q) / Gamma(a).

a = 1 is the (extended) Masing spring `k_h R (1 - exp(-z / R))` of Krikelis et al. (2024), Eq. 26 with n = 1; a large a
comes near to a single Jenkins element. The density follows Iwan (1966) and Segalman (2005).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .._base import InputError, whole
from ..models import Parameter, play
from .base import Law, Local, size_to_power

WIDEST_BEND = 5.0  # largest q_0 of a softening loop over half the travel; a wider one is a spring
STIFFEST = 5.0  # ratio q/q_0 from which a stiffening loop stiffens no further
PARTS = 4  # parts into which a step of a held signal is divided
THIN_LOOPS = 0.1  # ratio of the loops' width to the bend beside them, below which a fit is a curve without memory
DIRECT = 0.05  # ratio of the direct gain to the plays' total weight, below which they may be a mere backlash
EQUAL_THRESHOLDS = 0.15  # ratio of the thresholds' spread to their mean, below which the plays are one
NODES = 24  # stops that represent the smooth density
# edges of cells with equal shares of the curve of a = 1; each cell is one stop at its centre of gravity
_LOW = -2 * np.log(1 - np.arange(NODES) / NODES)
_MASS = np.append(-np.diff(np.exp(-_LOW)), np.exp(-_LOW[-1]))
_MOMENT = np.append(-np.diff((_LOW + 1) * np.exp(-_LOW)), (_LOW[-1] + 1) * np.exp(-_LOW[-1]))
Q = _MOMENT / _MASS  # centres of the cells
WIDTH = _MASS * np.exp(Q)  # widths of the cells, for the density exp(-q) at the centres


class _Hysteresis(Law):
    """The common part of forces with rate-independent hysteresis."""

    id = "hysteresis"
    flexible = True
    sentence = "rate-independent hysteresis: a force that depends on where the motion last turned round"
    turns = True
    dissipative = True


class StopHysteresis(_Hysteresis):
    """Rate-independent hysteresis: a Prandtl-Ishlinskii layer of stops (Krikelis et al. 2024, Eq. 16)."""

    form = "prandtl_ishlinskii"
    equation = "w = sum_i w_i stop_{r_i}[z]"
    source = "Krikelis et al. (2024), Eq. 2 and 16"
    units = {"w": "w/z", "r": "z"}
    n = memory = 6

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        following = [play(z, s[i], p["r"][i]) for i in range(self.n)]
        return sum(p["w"][i] * (z - q) for i, q in enumerate(following)), ca.vertcat(*following)

    def parameters(self) -> dict[str, Parameter]:
        """Parameters with start values and limits; weights and thresholds are vectors (n,)."""
        given = {"w": 0.0, "r": np.linspace(0.1, 1, self.n), **self.values}
        for name in ("w", "r"):
            if np.shape(given[name]) not in ((), (1,), (self.n,)):
                raise InputError(
                    f"The law {self.id!r} ({self.form}) has {self.n} values of {name}; {np.size(given[name])} were "
                    "given. Give one number for all, or one for each."
                )
        vectors = {name: np.broadcast_to(np.asarray(given[name], dtype=float), (self.n,)) for name in ("w", "r")}
        whole = self.at({**given, **vectors}, {"r": (0.0, np.inf), **self.limits})
        return super(StopHysteresis, whole).parameters()

    def size(self, values: Mapping[str, Any]) -> int:
        """Number of weights that matter, plus scalars, plus two for the place and spread of the thresholds."""
        weights = np.abs(values["w"])
        scalars = sum(1 for p in self.parameters().values() if p.size == 1)
        return int(np.sum(weights > 0.01 * np.max(weights))) + 2 + scalars

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield {"r": local.half * np.geomspace(0.03, 0.95, self.n)}
        yield {"r": local.half * np.geomspace(0.005, 0.5, self.n)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        # a stop that never slips is a spring, and a play that never moves is a constant
        return {"r": (1e-4 * local.half, 0.97 * local.half)}


class PlayHysteresis(StopHysteresis):
    """Hysteresis of an actuator or a sensor: plays added to the signal (Krikelis et al. 2024, Eq. 1 and 16)."""

    equation = "w = sum_i w_i play_{r_i}[u]"
    source = "Krikelis et al. (2024), Eq. 1 and 16"
    sentence = "rate-independent hysteresis: the output depends on where the signal last turned round"
    places = ("series",)
    rare: ClassVar[tuple[str, ...]] = ("thermal",)
    dissipative = False

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Plays side by side; r = 0 is a gain."""
        following = [play(z, s[i], p["r"][i]) for i in range(self.n)]
        return sum(p["w"][i] * q for i, q in enumerate(following)), ca.vertcat(*following)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield {"r": local.half * np.linspace(0.0, 0.9, self.n)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        # plays of positive weight lag behind the signal (Kuhnen 2003); the first weight is the gain
        return {**super().bounds(local), "w": (np.append(-1.0, np.zeros(self.n - 1)), np.inf)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether plays of about one threshold replace the whole signal, which is a backlash."""
        w, r = np.asarray(values["w"])[1:], np.asarray(values["r"])[1:]
        total = float(np.sum(w))
        if abs(1 + float(values["w"][0])) > DIRECT * total:
            return False
        mean = float(w @ r) / max(total, 1e-300)
        return bool(w @ np.abs(r - mean) < EQUAL_THRESHOLDS * mean * total)

    @classmethod
    def finer_starts(cls, found: Law, local: Local) -> Iterator[dict[str, Any]]:
        """Split each play but the first into two, a little apart."""
        w, r = np.asarray(found.values["w"]), np.asarray(found.values["r"])
        thresholds = np.concatenate([r[:1], 0.8 * r[1:], 1.2 * r[1:]])
        yield {**found.values, "w": np.concatenate([w[:1], w[1:] / 2, w[1:] / 2]), "r": thresholds}


class FinePlays(PlayHysteresis):
    """Hysteresis of an actuator or a sensor with more plays."""

    n = memory = 11


class GeneralizedHysteresis(PlayHysteresis):
    """Asymmetric hysteresis: plays of a bent signal (Al Janaideh, Rakheja & Su 2011)."""

    form = "generalized_play"
    equation = "w = sum_i w_i play_{r_i}[u + a_2 u^2 + a_3 u^3] + b_2 u^2"
    source = "Al Janaideh, Rakheja & Su (2011), IEEE/ASME Trans. Mechatronics 16(4); Krikelis et al. (2024), Eq. 14"
    units = {"w": "w/z", "b_2": "w/z^2", "r": "z", "a_2": "1/z", "a_3": "1/z^2"}
    defaults = {"a_2": 0.0, "a_3": 0.0}  # the signal is straight at first

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        bent = z + p["a_2"] * z**2 + p["a_3"] * z**3
        w, following = super().step(bent, s, p)
        return w + p["b_2"] * z**2, following

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        for bend in (-0.2, 0.0, 0.2):
            yield {"r": local.half * np.linspace(0.0, 0.9, self.n), "a_2": bend / local.reach, "a_3": 0.0}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        bend = {"a_2": (-0.4 / local.reach, 0.4 / local.reach), "a_3": (-0.2 / local.reach**2, 0.5 / local.reach**2)}
        return {**super().bounds(local), **bend}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether it is a backlash, or its loops are thin beside the memoryless part."""
        reach = self.parameters()["r"].bounds[1]
        wide = np.abs(values["w"]) * np.clip(np.minimum(values["r"], reach - values["r"]), 0.0, None)
        return super().doubtful(values) or bool(np.sum(wide) < THIN_LOOPS * np.max(reach) ** 2 * abs(values["b_2"]))


class FineGeneralized(GeneralizedHysteresis):
    """Asymmetric hysteresis with more plays."""

    n = memory = 11


class SmoothHysteresis(_Hysteresis):
    """Rate-independent hysteresis with rounded loops (Masing 1926; Iwan 1966; Segalman 2005)."""

    form = "prandtl_ishlinskii"
    equation = "w = k_h sum_i g_i stop_{R q_i}[z],  g_i ~ q_i^(a - 1) exp(-a q_i)"
    source = "Segalman (2005), J. Appl. Mech. 72(5); Krikelis et al. (2024), Eq. 26"
    units = {"k_h": "w/z", "R": "z", "a": ""}
    memory = NODES
    starts = {"R": ("half", 0.02, 0.06, 0.15, 0.4), "a": ("", 1.0)}
    ranges = {"R": ("half", 0.002, 2), "a": ("", 0.3, 12.0)}

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        share = [ca.exp((p["a"] - 1) * np.log(q) - p["a"] * q) * width for q, width in zip(Q, WIDTH, strict=True)]
        total = sum(share)
        following = [play(z, s[i], p["R"] * q) for i, q in enumerate(Q)]
        force = sum(g * (z - q) for g, q in zip(share, following, strict=True))
        return p["k_h"] * force / total, ca.vertcat(*following)

    @classmethod
    def finer_starts(cls, found: Law, local: Local) -> Iterator[dict[str, Any]]:
        """Start as stiff as the stops of given weights, with their thresholds spread in several ways."""
        for shape in cls().shapes(local):
            yield {**shape, "k_h": float(np.sum(found.values["w"]))}


class BoucWen(_Hysteresis):
    """Hysteresis by the Bouc-Wen equation (Bouc 1967; Wen 1976)."""

    form = "bouc_wen"
    equation = "w = k_h q,  dq/dt = dz/dt (1 - (1 - s + s sign(q dz/dt)) |q/q_0|^n)"
    source = "Wen (1976), J. Eng. Mech. 102(2); Ismail, Ikhouane & Rodellar (2009)"
    units = {"k_h": "w/z", "q_0": "z", "s": "", "n": ""}
    order = 1
    starts = {"q_0": ("half", 0.03, 0.1, 0.3, 0.8), "s": ("", 0.5, 0.8), "n": ("", 1.0)}
    ranges = {"q_0": ("half", 0.002, WIDEST_BEND), "s": ("", 0.3, 1.5), "n": ("", 0.5, 4.0)}

    def force(self, q: Any, p: Any) -> Any:
        return p.k_h * q

    def flow(self, dz: Any, q: Any, p: Any) -> Any:
        """Rate of the hysteretic displacement q, which exceeds q_0 only where a step is too long."""
        size = size_to_power(ca.fmin(ca.fabs(q / p["q_0"]), 1), p["n"], 1e-9)
        return dz * (1 - (1 - p["s"]) * size) - p["s"] * ca.fabs(dz) * ca.sign(q) * size


class StiffeningBoucWen(BoucWen):
    """Bouc-Wen hysteresis whose loops may stiffen: the force grows the more steeply, the further the motion goes.

    In `dq/dt = dz/dt - (β |dz/dt| q + γ dz/dt |q|) |q|^(n-1)` with γ <= 0, loops stiffen if β + γ < 0:
    q_0 = β^(-1/n), h = -γ/β. Beyond 5 q_0 they stiffen no further, so that the force stays finite.
    """

    form = "bouc_wen_stiffening"
    equation = f"w = k_h q,  dq/dt = dz/dt (1 + h x^n) - |dz/dt| sign(q) x^n,  x = min(|q/q_0|, {STIFFEST:g})"
    source = "Wen (1976), J. Eng. Mech. 102(2); Ikhouane & Rodellar (2007), Systems with Hysteresis"
    units = {"k_h": "w/z", "q_0": "z", "h": "", "n": ""}
    starts = {"q_0": ("half", 0.3, 1.0, 3.0), "h": ("", 0.5, 1.5), "n": ("", 1.0)}
    ranges = {"q_0": ("half", 0.2, 20), "h": ("", 0.0, 5.0), "n": ("", 0.5, 3.0)}

    def flow(self, dz: Any, q: Any, p: Any) -> Any:
        """Rate of the hysteretic displacement q, which could become infinite without a limit of x."""
        size = size_to_power(ca.fmin(ca.fabs(q / p["q_0"]), STIFFEST), p["n"], 1e-9)
        return dz * (1 + p["h"] * size) - ca.fabs(dz) * ca.sign(q) * size


class BoucWenActuator(BoucWen):
    """Bouc-Wen hysteresis of a signal that moves in steps: an actuator's held input, or a sensor."""

    equation = "w = b z + k_h q,  q+ = q + dz (1 - (1 - s + s sign(q dz)) |q/q_0|^n) at each step dz of z"
    units = {"b": "w/z", "k_h": "w/z", "q_0": "z", "s": "", "n": ""}
    places = ("series",)
    rare: ClassVar[tuple[str, ...]] = ("thermal",)
    dissipative = False
    order = 0
    memory = 2  # the last z, and the q that was reached there

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether its loops are thin beside the direct gain, so that it is a gain."""
        half = float(self.parameters()["q_0"].bounds[1]) / WIDEST_BEND
        gain = abs(1 + float(values["b"]) + float(values["k_h"]))
        return bool(abs(values["k_h"]) * min(float(values["q_0"]), half) < THIN_LOOPS**2 * gain * half)

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Integrate along the chord from the last z, in parts."""
        q, part = s[1], (z - s[0]) / PARTS
        for _ in range(PARTS):
            middle = q + self.flow(part, q, p) / 2
            q = q + self.flow(part, middle, p)
        return p["b"] * z + p["k_h"] * q, ca.vertcat(z, q)


class Backlash(Law):
    """Play between two parts (Nordin & Gutman 2002)."""

    id = "backlash"
    equation = "w = play_r[u] - u"
    source = "Nordin & Gutman (2002), Automatica 38(10)"
    sentence = "backlash: on every reversal the signal is lost until the play is taken up"
    units = {"r": "z"}
    places = ("series",)
    rare: ClassVar[tuple[str, ...]] = ("thermal",)
    turns = True
    memory = 1
    starts = {"r": ("half", 0.01, 0.03, 0.08, 0.18, 0.35, 0.6)}
    ranges = {"r": ("half", 0.001, 0.9)}

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        following = play(z, s, p["r"])
        return following - z, following


OPERATORS = ("stop", "play", "generalized_play")  # kinds of layers


def hysteresis_layer(kind: str, n: int, series: bool) -> type[StopHysteresis]:
    """Make the law of a Prandtl-Ishlinskii layer of n operators (Krikelis et al. 2024, Eq. 16).

    All weights and thresholds are at least zero. Some layers also have a linear term:

    | kind               | a force that opposes motion    | a signal that lags                                      |
    | ------------------ | ------------------------------ | ------------------------------------------------------- |
    | "stop"             | sum_i w_i stop_i[z]            | k_0 z - sum_i w_i stop_i[z]                             |
    | "play"             | k_0 z - sum_i w_i play_i[z]    | k_0 z + sum_i w_i play_i[z]                             |
    | "generalized_play" |                                | k_0 z + b_2 z^2 + sum_i w_i play_i[z + a_2 z^2 + a_3 z^3] |

    Because play + stop = z (Eq. 8), the first two rows differ only in the linear term.

    Parameters
    ----------
    kind : {"stop", "play", "generalized_play"}
        The operator.
    n : int
        Operators, one or more.
    series : bool
        Whether it acts on a signal, at an actuator or a sensor, rather than as a force inside the dynamics.

    Raises
    ------
    InputError
        If the kind is unknown, n is not a whole number above zero, or generalized plays are asked for as a force.
    """
    if kind not in OPERATORS:
        raise InputError(f"The kind of operators is {kind!r}; give {', '.join(map(repr, OPERATORS))}.")
    if kind == "generalized_play" and not series:
        raise InputError("Generalized plays act at an actuator or a sensor, not as a force; give 'stop' or 'play'.")
    return _layer(kind, whole(n, "n", 1), series)


@functools.cache  # the same class for the same arguments
def _layer(kind: str, operators: int, in_signal: bool) -> Any:
    bent, minus = kind == "generalized_play", kind == ("stop" if in_signal else "play")
    shown = f"{'stop' if kind == 'stop' else 'play'}_{{r_i}}[{'z + a_2 z^2 + a_3 z^3' if bent else 'z'}]"
    gain = {"k_0": "w/z"} if in_signal or kind == "play" else {}
    linear = ["k_0 z"] * bool(gain) + ["b_2 z^2"] * bent

    class Layer(StopHysteresis):
        form = "generalized_play" if bent else "prandtl_ishlinskii"
        equation = f"w = {' + '.join(linear)}{' - ' if minus else ' + ' if linear else ''}sum_i w_i {shown}"
        units = {
            "w": "w/z",
            **gain,
            **({"b_2": "w/z^2"} if bent else {}),
            "r": "z",
            **({"a_2": "1/z", "a_3": "1/z^2"} if bent else {}),
        }
        defaults = {"a_2": 0.0, "a_3": 0.0} if bent else {}
        signed = ("k_0", "b_2") if in_signal else ()
        places = ("series",) if in_signal else ("parallel",)
        dissipative = not in_signal
        n = memory = operators
        operator, sign = kind, -1 if minus else 1

        def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
            at = z + p["a_2"] * z**2 + p["a_3"] * z**3 if bent else z
            following = [play(at, s[i], p["r"][i]) for i in range(self.n)]
            total = sum(p["w"][i] * (at - q if kind == "stop" else q) for i, q in enumerate(following))
            w = (p["k_0"] * z if gain else 0) + (p["b_2"] * z**2 if bent else 0) + self.sign * total
            return w, ca.vertcat(*following)

        def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
            limits: dict[str, tuple[Any, Any]] = {"w": (0.0, np.inf), "r": (0.0, 0.97 * local.half)}
            if gain:
                limits["k_0"] = (-1.0 if in_signal else 0.0, np.inf)
            return {**GeneralizedHysteresis().bounds(local), **limits} if bent else limits

    Layer.__name__ = Layer.__qualname__ = f"Layer_{kind}_{operators}{'_series' if in_signal else ''}"
    Layer.__doc__ = f"A Prandtl-Ishlinskii layer of {operators} operators: {Layer.equation}."
    return Layer
