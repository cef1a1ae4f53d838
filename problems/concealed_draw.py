"""The draws behind a concealed case: rig, sampling, inputs, and effects strong enough to show behind a refit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from . import concealed_noise as dull
from .concealed_effects import PARALLEL, Draft, Scale
from .concealed_rig import Rig
from .concealed_rigs_more import RIGS, places
from .concealed_series import SERIES, outside
from .concealed_truth import Effect, Motion, Plant, pick, refit, simulate

Array = np.ndarray
LEAST, MOST = 3.3, 90.0  # refit's error over the noise
TRIES = 12
SAME = 0.9  # correlation beyond which two coordinates move alike


class Unsuited(Exception):
    """This draw cannot be used; the next is tried."""


@dataclass(frozen=True)
class Plan:
    """Wishes for a draw; the defaults are those of the concealed cases.

    Parameters
    ----------
    rigs : tuple of str
        Names of the rigs to draw from; empty for all.
    visible : tuple of float
        Least and largest error of the refit over the noise.
    target : tuple of float
        Range of the refit's NRMSE that the strength of an effect is set for.
    loudest : float
        Largest noise over the signal.
    noisy : tuple of float
        Range of the noise over the signal of one output of several; empty if all are as noisy.
    pole : float
        Pole of AR(1) noise; 0 draws the kind of noise.
    start : str
        How the recordings start; empty draws it.
    pairs : callable, optional
        Gives (port, law) of every hidden effect from the draw.
    drafts : mapping
        law -> maker of an effect from (draw, port, scale), before the makers of the concealed cases.
    value : {"", "fixed", "bounds"}
        A parameter held at a wrong value, or bounds that leave out the true value.
    fault, side : str
        Kind of fault, and "input" or "output"; empty draws them.
    undeclared : bool
        The user declares every port but the one with the effect.
    """

    rigs: tuple[str, ...] = ()
    visible: tuple[float, float] = (LEAST, MOST)
    target: tuple[float, float] = (0.01, 0.2)
    loudest: float = dull.LOUDEST
    noisy: tuple[float, float] | tuple[()] = ()
    pole: float = 0.0
    start: str = ""
    pairs: Callable[[Draw], list[tuple[str, str]]] | None = None
    drafts: Mapping[str, Callable[[Draw, str, Scale], Draft]] = field(default_factory=dict)
    value: str = ""
    fault: str = ""
    side: str = ""
    undeclared: bool = False


USUAL = Plan()


class Draw:
    """One attempt: rig, true values, sampling, inputs, and hidden effects with their strengths."""

    def __init__(
        self, rng: np.random.Generator, seed: int, kind: str, rig: Rig | None = None, plan: Plan = USUAL
    ) -> None:
        self.rng, self.seed, self.kind, self.plan = rng, seed, kind, plan
        self.told: dict[str, tuple[float, float | None, float | None]] = {}  # start and bounds; no bounds where held
        rigs = [r for r in RIGS.values() if r.states or kind != "two"]
        rigs = [r for r in rigs if not plan.rigs or r.name in plan.rigs]
        self.rig = rig = rig or rigs[int(rng.integers(len(rigs)))]
        self.values = {
            n: float(f"{np.exp(rng.uniform(np.log(a), np.log(b))):.4g}") for n, (a, b, _, _) in rig.parameters.items()
        }
        self.p = np.array(list(self.values.values()))
        self.names = {"states": rig.states, "inputs": rig.inputs, "outputs": rig.outputs}
        self.names["parameters"] = tuple(rig.parameters)
        self.bare = bool(rig.bare) and rng.random() < 0.3 and not plan.undeclared
        self.module = rig.module(rig.source({n: f"Parameter({v!r})" for n, v in self.values.items()}))
        self.module["PORTS"] = self.module["simulator"].ports
        self.plant = Plant(self.module, self.names, ())
        self.hold = rig.hold or str(rng.choice(["zero", "linear"]))
        self._times()
        self.levels = 1 + int(rng.integers(3))
        self.start = str(rng.choice(["zero", "estimate", "periodic"], p=[0.4, 0.35, 0.25]))
        self.start = plan.start or self.start
        if self.start == "periodic" and (rig.integrator or not rig.states):
            self.start = "estimate"

    def _times(self) -> None:
        """Step and length from the plant's eigenvalues."""
        rng, rig = self.rng, self.rig
        eigenvalues = np.array([2 * np.pi * 2.0])
        if rig.states:
            x = ca.SX.sym("x", len(rig.states))
            u, p = ca.SX.sym("u", len(rig.inputs)), ca.SX(ca.DM(self.p))
            f = self.plant._evaluate(x, ca.SX(0, 1), u, u, ca.SX(0), ca.SX(0), p)[0]
            jacobian = ca.Function("a", [x, u], [ca.densify(ca.jacobian(f, x))])
            a = np.asarray(jacobian(np.zeros(len(rig.states)), np.zeros(len(rig.inputs))))
            eigenvalues = np.linalg.eigvals(a)
        swing = np.abs(eigenvalues[np.abs(eigenvalues.imag) > 1e-6 * np.abs(eigenvalues)])
        real = np.abs(eigenvalues[np.abs(eigenvalues) > 1e-6])
        slowest = swing.min() if len(swing) else np.exp(np.log(real).mean())
        self.frequency = float(slowest / (2 * np.pi))
        top = float(np.abs(eigenvalues).max() / (2 * np.pi))
        fs = max(self.frequency * rng.uniform(25, 45), top * rng.uniform(10, 14) if rig.states else 0)
        self.dt = 1 / float(round(float(np.clip(fs, 200, 2000))))
        self.m = int(rng.choice([3000, 3500, 4000, 5000, 6000]))
        if self.m * self.dt * self.frequency < 12:
            self.m = 8000
        self.fine = max(6, int(np.ceil(2 * np.pi * top * self.dt / 0.07)))
        self.coarse = max(1, int(np.ceil(2 * np.pi * top * self.dt / 0.35)))
        self.band = self.frequency * rng.uniform(*rig.band)
        if len(swing) > 2 and rng.random() < 0.7:
            self.band = max(self.band, 1.1 * float(np.unique(np.round(swing, 6))[1]) / (2 * np.pi))
        self.band = min(self.band, 0.2 / self.dt)

    def _input(self, kind: str, level: float, start: str) -> tuple[Array, int, int | None]:
        """Inputs with a warm-up (M + W, n_u), W, and the period."""
        rng, m, period = self.rng, self.m, None
        warm = 0
        if start == "estimate":
            warm = m // 5
        if start == "periodic":
            period = m // int(rng.choice([2, 3, 4]))
            m = self.m // period * period
            warm = period * max(1, int(np.ceil(0.5 * self.m / period)))
            kind = "multisine"
        low = (0.25 if self.rig.integrator else 0.04) * self.frequency
        columns = [
            force * level * dull.excitation(rng, kind, m + warm, self.dt, low, self.band, period or 0)
            for force in self.rig.force
        ]
        return np.stack(columns, axis=1), warm, period

    def inputs(self) -> list[tuple[str, Array, int, int | None]]:
        """Training inputs, largest first, then the test's."""
        kinds = ["multisine", "noise", "sweep", "steps"][: 3 if self.rig.integrator else 4]
        amount = {1: [1.0], 2: [1.0, 0.5], 3: [1.0, 0.6, 0.35]}[self.levels]
        if self.levels > 1:
            self.m = min(self.m, 4000 if self.m < 8000 else 8000)
        out = []
        first = self.rng.permutation(kinds)
        for i, level in enumerate(amount):
            kind = "multisine" if self.start == "periodic" else str(first[0 if i < 2 else 1])
            out.append((kind, *self._input(kind, level, self.start)))
        other = [k for k in kinds if k != out[0][0]]
        kind = str(self.rng.choice(other))
        start = "zero" if self.start == "periodic" else self.start
        out.append((kind, *self._input(kind, float(self.rng.uniform(0.6, 0.95)), start)))
        return out

    def run(self, plant: Plant, item: tuple[str, Array, int, int | None]) -> Motion:
        """Truth over a whole input."""
        shape = dull.excitation(
            np.random.default_rng([self.seed, 3]),
            "noise",
            len(item[1]),
            self.dt,
            0.05 * self.frequency,
            2 * self.frequency,
        )
        return simulate(plant, self.p, item[1], self.dt, self.hold, self.fine, None, shape)

    def scale(self, port: str, bare: Motion, u: Array) -> Scale:
        """Size of the local signals at a port."""
        force = 1.0
        if port.startswith("actuator:"):
            z = u[:, self.rig.inputs.index(port.split(":")[1])]
            dz = np.gradient(z, self.dt)
        elif port.startswith("sensor:"):
            z = bare.y[:, self.rig.outputs.index(port.split(":")[1])]
            dz = np.gradient(z, self.dt)
        else:
            z, dz = bare.z[port], bare.dz[port]
            state, factor = next(iter(self._into(port).items()))
            force = 0.3 * float(bare.derivative[:, self.rig.states.index(state)].std()) / abs(factor)
        return Scale(
            float(z.std()),
            float(np.max(np.abs(z))),
            float(dz.std()),
            force,
            self.frequency,
            self.dt,
            len(u) * self.dt,
            self.fine,
        )

    def _into(self, port: str) -> dict[str, float]:
        return dict(pick(self.plant.ports[port].into, p=SimpleNamespace(**self.values)))

    def draft(self, port: str, law: str, scale: Scale, bare: Motion) -> Draft:
        """An effect without its strength."""
        series = ":" in port
        if law in self.plan.drafts:
            return self.plan.drafts[law](self, port, scale)
        if law == "outside":
            others = [] if series else self.apart(port, bare)
            return outside(self.rng, scale, series, str(self.rng.choice(others)) if others else None)
        return (SERIES if series else PARALLEL)[law](self.rng, scale)

    def apart(self, port: str, bare: Motion) -> list[str]:
        """States that do not move as a port's own coordinate does: with one that does, a product is its square."""
        own = [np.corrcoef(x, bare.z[port])[0, 1] for x in np.cumsum(bare.derivative, axis=0).T]
        return [name for name, r in zip(self.rig.states, own, strict=True) if abs(r) < SAME]

    def pairs(self) -> list[tuple[str, str]]:
        """Where this case hides something: (port, law) of each effect."""
        rng, found = self.rng, places(self.rig)
        if self.plan.pairs is not None:
            return self.plan.pairs(self)
        if self.kind == "outside":
            ports = sorted({p for p, _ in found if ":" not in p}) or sorted({p for p, _ in found})
            return [(str(rng.choice(ports)), "outside")]
        ports = sorted({p for p, _ in found})
        weights = np.array([1.0 if ":" not in p else 0.35 for p in ports])
        first = str(rng.choice(ports, p=weights / weights.sum()))
        out = [first]
        if self.kind == "two":
            inner = [p for p in ports if p != first and (":" in first) <= (":" not in p)]
            if not inner:
                raise Unsuited
            out.append(str(rng.choice(inner)))
        return [(port, str(rng.choice([law for p, law in found if p == port]))) for port in out]

    def bounds(self) -> tuple[Array, Array, Array]:
        """Which parameters are free, and their bounds."""
        free = np.array([not f for *_, f in self.rig.parameters.values()])
        lower, upper = 0.2 * self.p, 5.0 * self.p
        for i, name in enumerate(self.rig.parameters):
            if name in self.told:
                _, low, high = self.told[name]
                free[i] = low is not None
                lower[i], upper[i] = (low, high) if low is not None and high is not None else (lower[i], upper[i])
        return free, lower, upper

    def left(self, u: Array, y: Array, plant: Plant | None = None, hold: str = "", steps: int = 4) -> float:
        """NRMSE that a refit of the free parameters inside the user's bounds leaves; from the plant by default."""
        free, lower, upper = self.bounds()
        p = self.p.copy()
        for i, name in enumerate(self.rig.parameters):
            if name in self.told:
                p[i] = np.clip(p[i], lower[i], upper[i]) if free[i] else self.told[name][0]
        return refit(plant or self.plant, p, free, u, y, self.dt, hold or self.hold, self.coarse, lower, upper, steps)

    def effect(self, port: str, law: str, bare: Motion, item: Any) -> tuple[Effect, float]:
        """An effect with a strength that its refit leaves visible, and that refit's NRMSE."""
        scale = self.scale(port, bare, item[1])
        draft, strength = self.draft(port, law, scale, bare), 0.0
        strength, warm = draft.start, item[2]
        low, high = self.plan.target
        target = float(np.exp(self.rng.uniform(np.log(low), np.log(high))))
        for attempt in range(TRIES):
            effect = Effect(port, law, draft.variant, **draft.make(strength))
            try:
                y = self.run(Plant(self.module, self.names, (effect,)), item).y
            except FloatingPointError:
                strength *= 0.3
                continue
            size = float(np.mean((y - bare.y)[warm:].std(axis=0) / bare.y[warm:].std(axis=0)))
            if size > 0.9 and attempt < TRIES - 1:
                strength *= 0.4
                continue
            left = self.left(item[1][warm:], y[warm:])
            if not 0.5 * target < left < 2 * target and attempt < 4:
                factor = float(np.clip(target / max(left, 1e-9), 0.2, 6.0))
                if min(strength * factor, draft.most) != strength:
                    strength = min(strength * factor, draft.most)
                    continue
            if self.plan.visible[0] * dull.QUIETEST < left < 0.5:
                return effect, left
            raise Unsuited
        raise Unsuited
