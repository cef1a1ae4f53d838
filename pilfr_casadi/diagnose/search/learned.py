"""A learned element: a flexible force of a port's local signals, for physics that no law of the catalogue names.

    w = sum_j (c_j + d_j u~) phi_j(z, dz/dt, stops of z)

The features phi_j are stops of z with fixed thresholds and their powers (loops), low powers of z and |z| (curves), and
curves of dz/dt (friction), some of them times z; at a port that has no position, curves of the speed. u~ is an input of
the simulator, standardised, where one scales the force. The force is linear in its weights c and d, which are fitted
together with the simulator's own parameters in simulation error. They start from the linear solution of the projected
sensitivities (`screen`), with a ridge prior on the size of the force; held-out blocks choose its strength. This is the
discrepancy of Kennedy & O'Hagan (2001, J. R. Statist. Soc. B 63), placed inside the loop.

Outside the range of z, dz/dt and u in the training recordings, the signals are saturated: the force changes a little
further and then stays constant. The saturation has a nonzero slope everywhere, so an unknown initial state can be
estimated from outside the range.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..._base import InputError, side_by_side
from ...laws import POSITION_GAINS, SCALABLE, Law, Local, display_name, likely_profiles, scaled, scheduled, unit_forces
from ...models import Parameter, play
from ..fits.flexible_forces import KNEES, SPEED_CURVES, speed_curves
from ..fits.force_recovery import signals_along
from ..fits.linearise import linearise_runs, loudest_stretch, port_signals
from ..fits.screen import Remainder, Task, fit_shapes, held_out_rest, lengths, ridge_solution, start_values, usable
from ..fits.workbench import COMPARED_SAMPLES, FEW, Fitted, Workbench

STOPS = 8  # number of stops
# thresholds over half the range of z: from presliding to a stop that slips in every large motion and so forgets its
# start
THRESHOLDS = np.geomspace(0.02, 0.7, STOPS)
POWERS = 3  # highest power of each stop: odd ones for symmetric loops, the even one for one-sided forces
EXTENSION = 0.5  # largest extension of a signal beyond its range, over half the range
FIT_EXTENSION = 5.0  # the same during the fit, because the refit's run may be a poor guess of the range
# ridge strengths tried, relative to the mean square response to a force of unit size
WEIGHT_RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
START_SHARES = (1.0, 0.3, 0.0)  # fractions of the linear solution from which a fit may start
SAME_SIGNAL = 0.99  # correlation with z or dz/dt above which an input counts as that signal and scales nothing


class _Learned(Law):
    """The common part of learned forces: linear in their weights, with features of fixed scales."""

    id = "learned"
    source = "Kennedy & O'Hagan (2001), J. R. Statist. Soc. B 63(3)"
    strength: ClassVar[tuple[str, ...]] = ("c",)
    factor: ClassVar[str] = ""  # input that scales a part of the force
    features: ClassVar[int]  # their number
    of_speed: ClassVar[bool] = False  # whether it stands at a port that has no position
    listed = False

    def weigh(self, phi: Sequence[Any], p: Any, u: Any) -> Any:
        """Sum the features with their weights."""
        w = sum(p["c"][j] * f for j, f in enumerate(phi))
        if self.factor and u is not None:
            scale = (_saturate(u[self.factor], p["u_low"], p["u_high"], p["u_room"]) - p["u_0"]) / p["u_s"]
            w += scale * sum(p["c"][len(phi) + j] * f for j, f in enumerate(phi))
        return w

    def parameters(self) -> dict[str, Parameter]:
        """Return the weights with their prior, free if the recordings move them, and the fixed scales."""
        given = {**dict.fromkeys(self.units, 1.0), **self.defaults, "c": 0.0, **self.values}
        shape = (self.features * (2 if self.factor else 1),)
        c, std = (np.broadcast_to(np.asarray(given[name], dtype=float), shape) for name in ("c", "std"))
        felt = std > 0
        weights = Parameter(np.where(felt, c, 0.0), "w", fixed=~felt, prior=(0.0, np.where(felt, std, 1.0)))
        scales = {k: unit for k, unit in self.units.items() if k not in ("c", "std")}
        return {"c": weights, **{k: Parameter(float(given[k]), unit, fixed=True) for k, unit in scales.items()}}


class LearnedForce(_Learned):
    """A force of z, dz/dt and memory."""

    equation = "w = sum_j c_j phi_j(z, dz/dt, stops of z)"
    sentence = "a learned force of the local coordinate, its rate and its turning points"
    # weights with their prior deviations; centre, reach and half the range of z, largest speed, mean and deviation of
    # the scaling input; ends of the ranges seen, and the extension beyond them
    units: ClassVar[Mapping[str, str]] = {
        "c": "w", "std": "w", "z_0": "z", "z_s": "z", "z_h": "z", "v_s": "z/s", "u_0": "", "u_s": "",
        "z_low": "z", "z_high": "z", "v_low": "z/s", "v_high": "z/s", "u_low": "", "u_high": "",
        "z_room": "z", "v_room": "z/s", "u_room": "",
    }  # fmt: skip
    strength: ClassVar[tuple[str, ...]] = ("c",)
    defaults: ClassVar[Mapping[str, Any]] = {"z_0": 0.0, "u_0": 0.0, "z_low": -1.0, "v_low": -1.0, "u_low": -1.0}
    places = ("parallel", "series")
    features = 5 + STOPS * POWERS + 4 + 2 * len(KNEES)
    follows = memory = STOPS

    @classmethod
    def reads(cls) -> set[str]:
        """Return {"z"}; the curves of dz/dt vanish if dz/dt is always zero."""
        return {"z"}

    def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0, u: Any = None) -> tuple[Any, Any]:
        """Compute the force and the next memory."""
        z = _saturate(z, p["z_low"], p["z_high"], p["z_room"])
        v = _saturate(dz, p["v_low"], p["v_high"], p["v_room"]) / p["v_s"]
        x = (z - p["z_0"]) / p["z_s"]
        following = [play(z, s[i], r * p["z_h"]) for i, r in enumerate(THRESHOLDS)]
        phi = [1.0, x, ca.fabs(x), x**2, x**3]
        for q, r in zip(following, THRESHOLDS, strict=True):
            phi += [((z - q) / (r * p["z_h"])) ** power for power in range(1, POWERS + 1)]
        phi += [v, v * ca.fabs(v), x * v, x**2 * v]
        for knee in KNEES:
            curve = v / (ca.fabs(v) + knee)
            phi += [curve, x * curve]
        return self.weigh(phi, p, u), ca.vertcat(*following)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the scales of the signals along recordings; |z| bends at zero if z takes both signs."""
        both = min(-local.low, local.high) > 0.1 * local.half
        centre = 0.0 if both else local.middle
        speed = local.speed if np.any(local.dz) else 1.0
        scales = {"z_0": centre, "z_s": max(local.high - centre, centre - local.low), "z_h": local.half, "v_s": speed}
        yield {**scales, **_ranges(FIT_EXTENSION, z=local.z, v=local.dz)}


class LearnedForceOfSpeed(_Learned):
    """A force of the speed alone, at a port that has no position."""

    equation = "w = sum_j c_j phi_j(dz/dt)"
    sentence = "a learned force of the speed"
    units: ClassVar[Mapping[str, str]] = {
        name: unit for name, unit in LearnedForce.units.items() if not name.startswith("z_")
    }
    strength: ClassVar[tuple[str, ...]] = ("c",)
    defaults: ClassVar[Mapping[str, Any]] = {"u_0": 0.0, "v_low": -1.0, "u_low": -1.0}
    features = 1 + SPEED_CURVES
    of_speed = True

    def force(self, dz: Any, p: Any) -> Any:
        """Compute the force."""
        return self.force_with(dz, p, None)

    def force_with(self, dz: Any, p: Any, u: Any) -> Any:
        """Compute the force of which an input scales a part."""
        v = _saturate(dz, p["v_low"], p["v_high"], p["v_room"]) / p["v_s"]
        return self.weigh([1.0, *speed_curves(v)], p, u)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the scale and the range of the speed along recordings."""
        yield {"v_s": (1 + EXTENSION) * float(np.max(np.abs(local.dz))), **_ranges(EXTENSION, v=local.dz)}

    def why_not(self, local: Local) -> str:
        """Say that the port has a position; `LearnedForce` is for those."""
        return "" if local.is_speed else "the port has a position"


def _saturate(x: Any, low: Any, high: Any, room: Any) -> Any:
    """Follow x from low to high; outside, approach low - room and high + room with a nonzero slope."""
    above, below = ca.fmax(x - high, 0), ca.fmax(low - x, 0)
    return ca.fmin(ca.fmax(x, low), high) + room * above / (room + above) - room * below / (room + below)


def _ranges(room: float, **signals: np.ndarray) -> dict[str, float]:
    """Return the range of each signal, and its extension beyond the range."""
    out: dict[str, float] = {}
    for name, values in signals.items():
        low, high = float(np.min(values)), float(np.max(values))
        out |= {f"{name}_low": low, f"{name}_high": high, f"{name}_room": room * (high - low) / 2 or 1.0}
    return out


@functools.cache  # the same class for the same input
def learned_force(factor: str = "", of_speed: bool = False) -> type[_Learned]:
    """Make the class of learned forces, or of those of a speed; the input `factor`, if any, scales a part of it."""
    kind = LearnedForceOfSpeed if of_speed else LearnedForce
    if not factor:
        return kind
    own = {
        "factor": factor,
        "form": f"scaled by {factor}",
        "equation": kind.equation.replace("c_j phi_j", f"(c_j + d_j {factor}~) phi_j"),
        "sentence": f"{kind.sentence}; {factor} scales a part of it",
        "__doc__": kind.__doc__,
        **({"force": LearnedForceOfSpeed.force_with} if of_speed else {}),
    }
    return type(f"{kind.__name__}ScaledBy_{factor}", (kind,), own)


@dataclass(frozen=True, eq=False)
class Start:
    """A learned element from the linear problem: the law at its start values, and the share that it explains.

    It is a share of the residual's power on blocks that the weights were not fitted to.
    """

    port: str
    law: _Learned
    share: float


def linear_starts(bench: Workbench, base: Fitted, port_names: Sequence[str]) -> list[Start]:
    """Solve the linear problem at each port, also with each input that may scale the force; best first."""
    bench = bench.balanced(base)
    probe, runs = linearise_runs(bench, base)
    rest = Remainder.of(bench, probe, runs, (LearnedForce, LearnedForceOfSpeed))
    samples = sum(len(r) - r.skip for r in bench.recordings) * len(bench.scale)
    out = []
    for task in rest.tasks:
        if task.port.name not in port_names:
            continue
        for factor in ("", *(name for name in task.local.inputs if _may_scale(task, name))):
            # where z may be a speed or another quantity, both kinds are admitted
            both = (_solve_weights(rest, task, law, shape, factor, samples) for law, (shape,) in task.pairs)
            out.append(max(both, key=lambda s: s.share))
    return sorted(out, key=lambda s: -s.share)


def _may_scale(task: Task, name: str) -> bool:
    """Tell whether a signal may scale the force at a port: it varies, and is neither the time nor z or its rate."""
    u, local = task.local.inputs[name], task.local
    if task.port.series or name == "t" or not np.ptp(u) > 0:
        return False
    own = [v for v in (local.z, local.dz) if np.ptp(v) > 0]
    return not any(abs(np.corrcoef(u, v)[0, 1]) > SAME_SIGNAL for v in own)


def _solve_weights(rest: Remainder, task: Task, law: Law, shape: dict[str, Any], factor: str, samples: int) -> Start:
    """Fit the weights to the projected residual by ridge regression; its strength is chosen on held-out blocks.

    `samples` is the number of scored samples, more than are used here; the prior counts once.
    """
    scales, kind = dict(shape), learned_force(factor, isinstance(law, LearnedForceOfSpeed))
    columns = unit_forces(law, task.part, [shape]).reshape(len(task.part.z), -1)
    if factor:
        u, whole = task.part.inputs[factor], task.local.inputs[factor]
        scales |= {"u_0": float(np.mean(whole)), "u_s": float(np.std(whole)), **_ranges(EXTENSION, u=whole)}
        columns = np.hstack([columns, columns * ((u - scales["u_0"]) / scales["u_s"])[:, None]])
    phi, size = rest.response(task.index, columns)
    felt, weights, std = lengths(phi) > 0, np.zeros(len(size)), np.zeros(len(size))
    if not np.any(felt):
        return Start(task.port.name, kind({**scales, "std": 0.0}), 0.0)
    phi, unit = phi[:, felt], float(np.mean(lengths(phi[:, felt]) ** 2))
    rests = {ridge: held_out_rest(phi, rest.left, rest.odd, unit * ridge) for ridge in WEIGHT_RIDGES}
    wrong, ridge = min((float(np.sum(e**2)), ridge) for ridge, e in rests.items())
    weights[felt] = -ridge_solution(phi, rest.left, unit * ridge) / size[felt]
    std[felt] = 1 / (size[felt] * np.sqrt(unit * ridge * samples / len(rest.left)))
    found = kind({**scales, "c": weights, "std": std})
    return Start(task.port.name, found, 1 - wrong / max(float(rest.left @ rest.left), 1e-300))


def learn_forces(bench: Workbench, base: Fitted, port_names: Sequence[str], workers: int = 1) -> list[Fitted]:
    """Fit a learned element at each of some ports, on top of a fitted simulator, which may already have elements.

    The best few by the linear solution are fitted, to as much of the recordings as is needed to choose; see
    `refit_learned`. The fits are returned with the smallest error first, and the learned element as the last of each.
    Fits that diverge are left out.
    """
    starts = [s for s in linear_starts(bench, base, port_names) if s.share > 0]
    found = side_by_side(lambda start: _fit_element(bench, base, start), starts[:FEW], workers, bench.interrupt)
    return sorted((f for f in found if f is not None), key=lambda f: f.cost)


def _fit_element(bench: Workbench, base: Fitted, start: Start) -> Fitted | None:
    """Fit a learned element together with the simulator's own parameters; None if every start diverges."""
    placed = base.simulator.with_element(start.port, start.law)
    compiled = bench.compile(placed)
    name = f"{placed.elements[-1].prefix}c"
    starts = [{**base.values, name: share * np.asarray(start.law.values["c"])} for share in START_SHARES]
    best = bench.by_cost(compiled, starts, base.initial)[0]
    try:
        return bench.fit(placed, [best], states=base.initial, like=compiled)
    except InputError:
        return None


def refit_learned(bench: Workbench, found: Fitted) -> Fitted:
    """Fit a learned element to all samples, and set the ranges outside of which its signals are saturated.

    Raises
    ------
    InputError
        If the simulation diverges.
    """
    placed, element = found.simulator, found.simulator.elements[-1]
    fitted = bench.fit(placed, [found.values], states=found.initial, like=found)
    z, dz, _ = signals_along(bench, fitted)
    ranges = _ranges(EXTENSION, z=z, v=dz)
    seen = {f"{element.prefix}{k}": np.array(v) for k, v in ranges.items() if k in element.law.units}
    return replace(bench.rerun(fitted, {**fitted.values, **seen}), status=fitted.status)


@dataclass(frozen=True, eq=False)
class NearLaw:
    """A named law close to the learned force.

    Attributes
    ----------
    kind : Law
        The law.
    start : dict
        Its values nearest to the learned force.
    error : float
        Rms error of its force over the learned force's deviation.
    force : array, shape (M,)
        Its force; nan for samples that were not compared.
    """

    kind: Law
    start: dict[str, Any]
    error: float
    force: np.ndarray = field(repr=False)

    @property
    def law(self) -> str:
        """Id of the law."""
        return self.kind.id

    @property
    def form(self) -> str:
        """Form of the law."""
        return self.kind.form

    def to_dict(self) -> dict[str, Any]:
        """Return the content for diagnosis.json."""
        return {"law": self.law, "form": self.form, "error": self.error}


@dataclass(frozen=True, eq=False)
class Learned:
    """A learned element of the corrected simulator.

    Attributes
    ----------
    port, factor : str
        Its port, and the input that scales a part of it, if any.
    share : float
        Share of the refit's error above the noise that it explains in addition to the named laws.
    z, dz, force : array, shape (M,)
        Local coordinate, rate and force along the training recordings.
    nearest : tuple of NearLaw
        Laws of the catalogue closest to the force, best first.
    """

    port: str
    factor: str
    share: float
    z: np.ndarray = field(repr=False)
    dz: np.ndarray = field(repr=False)
    force: np.ndarray = field(repr=False)
    nearest: tuple[NearLaw, ...] = field(default=())

    @property
    def sentence(self) -> str:
        """Describe its port, the range on which it holds, and the nearest laws."""
        by = f", a part of it scaled by {self.factor}" if self.factor else ""
        names = ", ".join(f"{display_name(n.law)} (off by {100 * n.error:.2g} %)" for n in self.nearest)
        near = f" The nearest laws are {names}." if names else ""
        z, dz = (f"{np.min(v):.4g} to {np.max(v):.4g}" for v in (self.z, self.dz))
        where = (
            f"the local coordinate is from {dz}"
            if np.array_equal(self.z, self.dz)
            else f"z is from {z} and dz/dt from {dz}"
        )
        return (
            f"A learned force acts at {self.port}{by}. It holds where {where}, as in the training recordings, and is "
            f"saturated beyond.{near}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the content for diagnosis.json."""
        return {
            "port": self.port,
            "factor": self.factor,
            "share": self.share,
            "sentence": self.sentence,
            "nearest": [n.to_dict() for n in self.nearest],
            "range": {"z": [np.min(self.z), np.max(self.z)], "dz": [np.min(self.dz), np.max(self.dz)]},
        }


def describe_learned(bench: Workbench, fitted: Fitted, share: float, laws: Collection[type[Law]]) -> Learned:
    """Describe the last element of a fitted simulator, a learned one, with the nearest laws."""
    element = fitted.simulator.elements[-1]
    nearest = nearest_to_learned(bench, fitted, laws)
    return Learned(element.port, element.law.factor, share, *signals_along(bench, fitted), nearest)


def nearest_to_learned(bench: Workbench, fitted: Fitted, laws: Collection[type[Law]]) -> tuple[NearLaw, ...]:
    """Find the laws nearest to the last element of a fitted simulator, a learned one.

    Their strengths may vary with the input that scales the learned force, or with the local coordinate. The gain of the
    input may vary with the local coordinate.
    """
    element = fitted.simulator.elements[-1]
    z, dz, force = signals_along(bench, fitted)
    local = replace(bench.local(z, dz), inputs=port_signals(bench, fitted, element.port).inputs)
    port = bench.simulator.port(element.port)
    tried = [law for law in laws if port.admits(law)]
    for law in SCALABLE if "parallel" in port.kinds else ():
        signals = [element.law.factor] * bool(element.law.factor) + ["z"] * law.dissipative
        tried += [scheduled(law, by, likely_profiles(law)[0]) for by in signals if law in laws and port.admits(law)]
    gains = POSITION_GAINS if element.law.factor else ()
    tried += [scaled(law, element.law.factor) for law in gains if law in laws and port.admits(law)]
    return nearest_laws(local, force, tried)


def nearest_laws(local: Local, force: np.ndarray, laws: Sequence[type[Law]]) -> tuple[NearLaw, ...]:
    """Find the laws nearest to a force along z and dz/dt: strengths by least squares, shapes on their grids.

    A constant is free, because the zero of z is arbitrary. Of several forms of a law, the best one counts. Of long
    recordings the stretches are compared in which the force varies most.
    """
    most = max(COMPARED_SAMPLES // len(local.lengths), 1)
    power, ends = (force - np.mean(force)) ** 2, np.cumsum((0, *local.lengths))
    windows = [loudest_stretch(power[a:b], most, 0) for a, b in pairwise(ends)]
    kept = np.concatenate([np.arange(a + w.start, a + w.stop) for a, w in zip(ends[:-1], windows, strict=True)])
    part = Local(
        local.z[kept], local.dz[kept], local.dt, tuple(w.stop - w.start for w in windows),
        inputs={k: v[kept] for k, v in local.inputs.items()},
        from_zero=tuple(z and not w.start for z, w in zip(local.from_zero, windows, strict=False)),
    )  # fmt: skip
    centred = force[kept] - np.mean(force[kept])
    deviation = max(float(np.std(force[kept])), 1e-300)
    best: dict[str, NearLaw] = {}
    for law in (kind() for kind in laws):
        shapes = list(law.shapes(local)) if usable(law, local) else []
        columns = unit_forces(law, part, shapes) if shapes else np.zeros((len(kept), 0, 1))
        made = (a - a.mean(axis=0) for a in np.moveaxis(columns, 1, 0))
        for k, strengths, fit in fit_shapes(made, centred):
            error = float(np.sqrt(np.mean((centred - fit) ** 2))) / deviation
            if error < (best[law.id].error if law.id in best else 1.0):
                whole = np.full(len(force), np.nan)
                whole[kept] = fit + np.mean(force[kept])
                best[law.id] = NearLaw(law, start_values(law, shapes[k], strengths), error, whole)
    return tuple(sorted(best.values(), key=lambda n: n.error)[:FEW])
