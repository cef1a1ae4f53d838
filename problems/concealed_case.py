"""One concealed case from one seed: a rig, what it hides, recordings with noise, and the expected answer.

Shares of the kinds are `KINDS`. The noise is fitted to the effect, not the effect to the noise: a linearised refit
gives what the effect leaves, and the noise is drawn 3 to 100 times below it, between 40 and 70 dB below the signal.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording

from . import concealed_noise as dull
from .concealed_draw import USUAL, Draw, Plan, Unsuited
from .concealed_series import STATED
from .concealed_table import Pair, equivalents
from .concealed_truth import Effect, Motion, Plant

Array = np.ndarray
KINDS = {"one": 0.55, "two": 0.12, "none": 0.15, "outside": 0.08, "fault": 0.10}
VERDICTS = {"one": "missing-physics", "two": "missing-physics", "none": "complete", "outside": "unexplained"}
VERDICTS |= {"fault": "recording-fault", "three": "missing-physics", "value": "complete", "load": "recording-fault"}
NAMEABLE = ("one", "two", "three")


RUNS_AWAY = 1e9  # in the units of the outputs
OVERWHELMING = 0.6  # error of the refit of which no law is asked to make sense


@dataclass(frozen=True)
class Finding:
    """A finding about a channel (a gate of the answer); any of the kinds at any of the channels is right."""

    kinds: frozenset[str]
    channels: frozenset[str]
    needed: bool = True  # else it may be there beside the effects


FINDINGS = {  # kinds of faults, as the generator and as answers call them
    "clipped": ("clipping",),
    "alignment": ("alignment", "shift"),
    "zero": ("zero", "offset"),
    "offset": ("zero", "offset"),
    "hold": ("hold", "alignment", "shift"),  # the two holds are half a sample apart
}


@dataclass(frozen=True, eq=False)
class Case:
    """A concealed case; `accepted` has one set of (port, law) pairs for each effect.

    Besides `verdict`, those of `also` are right. `findings` are faults, loads and ports that are to be told, and
    `parameters` values of which naming any is right.
    """

    seed: int
    name: str
    simulator: Any
    source: str
    train: tuple[Recording, ...]
    test: Recording
    truth: tuple[dict[str, str], ...]
    verdict: str
    accepted: tuple[frozenset[Pair], ...]
    channels: frozenset[str]
    tags: frozenset[str]
    floor: float
    refit: float
    details: dict[str, Any] = field(default_factory=dict)
    also: frozenset[str] = frozenset()
    findings: tuple[Finding, ...] = ()
    parameters: frozenset[str] = frozenset()


def case(seed: int) -> Case:
    """Draw a case; the same seed gives the same case.

    Raises
    ------
    RuntimeError
        If no draw of this seed can be used.
    """
    return planned(seed, kind_of_seed(seed))


def kind_of_seed(seed: int) -> str:
    """Kind of a concealed case, which its seed alone decides."""
    return str(np.random.default_rng([seed, 1]).choice(list(KINDS), p=list(KINDS.values())))


def planned(seed: int, kind: str, plan: Plan = USUAL, attempts: int = 40) -> Case:
    """Draw a case of a kind, as a plan wishes."""
    for attempt in range(attempts):
        try:
            return _Draw(np.random.default_rng([seed, 2, attempt]), seed, kind, plan=plan).case()
        except (Unsuited, FloatingPointError, np.linalg.LinAlgError, RuntimeError):
            continue
    raise RuntimeError(f"no case could be drawn from seed {seed}")


class _Draw(Draw):
    """One attempt at a case."""

    same: frozenset[str] = frozenset()  # parameters of which naming any is right

    def case(self) -> Case:
        """The whole case."""
        rng, rig = self.rng, self.rig
        items = self.inputs()
        effects, alone = self._effects(items[0])
        fault, fault_tags = None, set()
        if self.kind == "fault":
            fault = dull.draw_fault(
                rng, rig.inputs, rig.outputs, rig.linear_plant, bool(rig.states), self.plan.fault, self.plan.side
            )
            fault_tags = {f"fault:{fault.kind}"}
        if self.plan.value:
            fault_tags = {f"value:{self._mislead()}"}
        plant = Plant(self.module, self.names, effects)
        motions = [self.run(plant, item) for item in items]
        if max(float(np.max(np.abs(m.y))) for m in motions) > RUNS_AWAY:
            raise Unsuited
        tops = (np.abs(items[0][1]).max(axis=0), np.abs(motions[0].y).max(axis=0))
        left, low, high = self._visible(items[0], motions[0], effects, alone, fault, tops)
        relative = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        noise = str(rng.choice(list(dull.NOISES), p=list(dull.NOISES.values())))
        said = self.hold if rng.random() < 0.6 or rig.hold else None
        said = self._other_hold() if fault and fault.kind == "hold" else said
        level = relative * motions[0].y[items[0][2] :].std(axis=0)
        if self.plan.noisy:
            least, most = np.log(self.plan.noisy)
            level[int(rng.integers(len(level)))] *= float(np.exp(rng.uniform(least, most))) / relative
        records, floor = [], 0.0
        for i, (item, motion) in enumerate(zip(items, motions, strict=True)):
            _, u, warm, period = item
            u, clean = dull.spoil_clean(fault, u[warm:], motion.y[warm:])
            y = dull.noise(rng, noise, clean, level, self.plan.pole)
            floor = float(np.mean(np.sqrt(np.mean((y - clean) ** 2, axis=0)) / y.std(axis=0)))
            u, y = dull.spoil(fault, u, y, tops, i)
            moved = fault is not None and fault.kind in ("alignment", "clock")
            start = "estimate" if warm or moved or not rig.states else "zero"
            start, period = (start, None) if moved else ("periodic" if period else start, period)
            step = self.dt * (fault.size if fault and fault.kind == "time-unit" else 1.0)
            records.append(
                Recording(
                    u,
                    y,
                    step,
                    rig.inputs,
                    rig.outputs,
                    period=period,
                    initial=start,
                    hold=said,
                    name="test" if i == len(items) - 1 else f"train{i + 1}",
                )
            )
        noise = f"pole={self.plan.pole}" if self.plan.pole else noise
        return self._finish(effects, fault, records, motions, noise, said, floor, left, relative, fault_tags)

    def _effects(self, item: Any) -> tuple[tuple[Effect, ...], list[float]]:
        """The hidden effects, and what a refit leaves of each alone."""
        if self.kind not in NAMEABLE and self.kind != "outside":
            return (), []
        bare = self.run(self.plant, item)
        found = [self.effect(port, law, bare, item) for port, law in self.pairs()]
        effects = tuple(effect for effect, _ in found)
        if any(e.law in ("drift", "creep", "outside") for e in effects) and self.start == "periodic":
            raise Unsuited
        return effects, [left for _, left in found]

    def _visible(
        self,
        item: Any,
        motion: Motion,
        effects: tuple[Effect, ...],
        alone: list[float],
        fault: dull.Fault | None,
        tops: tuple[Array, Array],
    ) -> tuple[float, float, float]:
        """What a refit leaves, and the range of the noise over the signal behind which it shows."""
        left, low, high = float("nan"), dull.QUIETEST, self.plan.loudest
        least, most = self.plan.visible
        u, y = item[1][item[2] :], motion.y[item[2] :]
        if effects:
            left = self.left(u, y)
            weakest = left
            if self.kind == "two":
                weakest = min(left, *alone)
            if self.kind == "three":
                weakest = min(left, *(self._beside(item, motion, effects, e) for e in effects))
            if max(alone) > 6 * min(alone) or left > OVERWHELMING:
                raise Unsuited
            low, high = max(low, left / most), min(high, weakest / least)
        elif self.plan.value:
            left = self.left(u, y, steps=20)
            self.same = self._same_value(u, y, left)
            low, high = max(low, left / most), min(high, left / least)
        elif self.plan.fault:
            u, y = dull.spoil(fault, *dull.spoil_clean(fault, u, y), tops)
            left = self.left(u, y, hold=self._other_hold() if self.plan.fault == "hold" else "", steps=20)
            high = min(high, left / least)
        if low > high:
            raise Unsuited
        return left, low, high

    def _beside(self, item: Any, motion: Motion, effects: tuple[Effect, ...], one: Effect) -> float:
        """What a refit with all effects but one in place leaves, from rest and with their true strengths."""
        others = Plant(self.module, self.names, tuple(e for e in effects if e is not one))
        return self.left(item[1], motion.y, others)

    def _same_value(self, u: Array, y: Array, left: float) -> frozenset[str]:
        """The wrong value, and the held parameters that do as well in its place."""
        found = set(self.told)
        for name, (*_, fixed) in self.rig.parameters.items():
            if fixed and name not in self.told:
                value = self.values[name]
                self.told[name] = (value, 0.2 * value, 5 * value)
                if self.left(u, y, steps=20) < 0.1 * left:
                    found.add(name)
                del self.told[name]
        return frozenset(found)

    def _other_hold(self) -> str:
        return "linear" if self.hold == "zero" else "zero"

    def _mislead(self) -> str:
        """Hold a parameter 10 to 40 % off, or leave its true value out of its bounds; the parameter's name."""
        rng, rig = self.rng, self.rig
        fixed = [n for n, (*_, f) in rig.parameters.items() if f]
        free = [n for n, (*_, f) in rig.parameters.items() if not f]
        held = self.plan.value == "fixed"
        name = str(rng.choice(fixed if held and fixed and rng.random() < 0.6 else free))
        value, up = self.values[name], rng.random() < 0.5
        if held:
            off = rng.uniform(0.1, 0.4) * (1 if up else -1)
            self.told[name] = float(f"{value * (1 + off):.4g}"), None, None
        else:  # an engineer's guess, and a range about it that is too narrow
            start = value * rng.uniform(1.8, 4.0) ** (1 if up else -1)
            reach = rng.uniform(1.2, 1.5)
            low, high = sorted((start * reach, start / reach))
            self.told[name] = float(f"{start:.4g}"), float(f"{low:.4g}"), float(f"{high:.4g}")
        return name

    def _finish(
        self,
        effects: tuple[Effect, ...],
        fault: dull.Fault | None,
        records: list[Recording],
        motions: list[Motion],
        noise: str,
        said: str | None,
        floor: float,
        left: float,
        relative: float,
        tags: set[str],
    ) -> Case:
        rig, handed = self.rig, dict(self.rig.bare) if self.bare else {}
        declared = {n: t for n, t in rig.ports.items() if not self.plan.undeclared or n != effects[0].port}
        source = replace(rig, ports=declared).source(self._start_values(), not self.bare)
        z = [motions[0].z.get(e.port) for e in effects]
        nameable = self.kind in NAMEABLE
        stated = tuple(
            frozenset({(handed.get(e.port, e.port), STATED[e.variant])}) for e in effects if e.variant in STATED
        )
        tags |= {self.kind, rig.name, noise, self.start, f"n_in={len(rig.inputs)}", f"n_out={len(rig.outputs)}"}
        tags |= {f"hold={said}", f"records={len(records) - 1}", "bare" if self.bare else "ports"}
        tags |= {t for e in effects for t in (e.law, f"{e.law}:{e.variant}")}
        text = "+".join(f"{e.law}" for e in effects) or (fault.kind if fault else "nothing")
        return Case(
            self.seed,
            f"{self.seed:04d}-{rig.name}-{text}",
            rig.module(source)["simulator"],
            source,
            tuple(records[:-1]),
            records[-1],
            tuple({"port": handed.get(e.port, e.port), "law": e.law} for e in effects) if nameable else (),
            VERDICTS[self.kind],
            tuple(equivalents(rig, e, zz, handed, relative) for e, zz in zip(effects, z, strict=True))
            if nameable
            else stated,
            fault.channels if fault else frozenset(),
            frozenset(tags),
            floor,
            left,
            {
                "true": self.values,
                "effects": [f"{handed.get(e.port, e.port)}: {e.law} ({e.variant})" for e in effects],
                "fault": fault,
                "noise": relative,
                "hold": self.hold,
                "hidden": effects,
                "into": {e.port: tuple(self._into(e.port)) for e in effects if ":" not in e.port},
            },
            findings=(Finding(frozenset(FINDINGS.get(fault.kind, (fault.kind,))), fault.channels),) if fault else (),
            parameters=self.same,
            also=frozenset({"missing-physics"}) if stated else frozenset(),
        )

    def _start_values(self) -> dict[str, str]:
        """`Parameter(...)` texts: off by up to 30 %, inside bounds a designer would give."""
        rng, reach = self.rng, self.rng.uniform(0.0, 0.3)
        out = {}
        for name, (_, _, unit, fixed) in self.rig.parameters.items():
            value = self.values[name]
            if name in self.told:
                start, low, high = self.told[name]
                rest = "fixed=True" if low is None else f"bounds=({low!r}, {high!r})"
                out[name] = f'Parameter({start!r}, unit="{unit}", {rest})'
                continue
            if fixed:
                out[name] = f'Parameter({value!r}, unit="{unit}", fixed=True)'
                continue
            start = float(f"{value * (1 + rng.uniform(-reach, reach)):.4g}")
            low, high = float(f"{0.2 * start:.2g}"), float(f"{5 * start:.2g}")
            out[name] = f'Parameter({start!r}, unit="{unit}", bounds=({low!r}, {high!r}))'
        return out
