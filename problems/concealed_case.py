"""One concealed case from one seed: a rig, what it hides, recordings with noise, and the expected answer.

Shares of the kinds are `KINDS`. The noise is fitted to the effect, not the effect to the noise: a linearised refit
gives what the effect leaves, and the noise is drawn 3 to 100 times below it, between 40 and 70 dB below the signal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording

from . import concealed_noise as dull
from .concealed_draw import LEAST, MOST, Draw, Unsuited
from .concealed_table import Pair, equivalents
from .concealed_truth import Effect, Motion, Plant, refit

Array = np.ndarray
KINDS = {"one": 0.55, "two": 0.12, "none": 0.15, "outside": 0.08, "fault": 0.10}
VERDICTS = {"one": "missing-physics", "two": "missing-physics", "none": "complete", "outside": "unexplained"}
VERDICTS["fault"] = "recording-fault"


RUNS_AWAY = 1e9  # in the units of the outputs


@dataclass(frozen=True, eq=False)
class Case:
    """A concealed case; `accepted` has one set of (port, law) pairs for each effect."""

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


def case(seed: int) -> Case:
    """Draw a case; the same seed gives the same case.

    Raises
    ------
    RuntimeError
        If no draw of this seed can be used.
    """
    kind = str(np.random.default_rng([seed, 1]).choice(list(KINDS), p=list(KINDS.values())))
    for attempt in range(40):
        try:
            return _Draw(np.random.default_rng([seed, 2, attempt]), seed, kind).case()
        except (Unsuited, FloatingPointError, np.linalg.LinAlgError, RuntimeError):
            continue
    raise RuntimeError(f"no case could be drawn from seed {seed}")


class _Draw(Draw):
    """One attempt at a case."""

    def case(self) -> Case:
        """The whole case."""
        rng, rig = self.rng, self.rig
        items = self.inputs()
        effects: list[Effect] = []
        alone: list[float] = []
        fault, fault_tags = None, set()
        if self.kind in ("one", "two", "outside"):
            bare = self.run(self.plant, items[0])
            for port, law in self.pairs():
                effect, left = self.effect(port, law, bare, items[0])
                effects.append(effect)
                alone.append(left)
            if any(e.law in ("drift", "creep", "outside") for e in effects) and self.start == "periodic":
                raise Unsuited
        if self.kind == "fault":
            fault = dull.draw_fault(rng, rig.inputs, rig.outputs, rig.linear_plant, bool(rig.states))
            fault_tags = {f"fault:{fault.kind}"}
        plant = Plant(self.module, self.names, effects)
        motions = [self.run(plant, item) for item in items]
        if max(float(np.max(np.abs(m.y))) for m in motions) > RUNS_AWAY:
            raise Unsuited
        left = float("nan")
        low, high = dull.QUIETEST, dull.LOUDEST
        if effects:
            free, lower, upper = self.bounds()
            w = items[0][2]
            left = refit(
                self.plant,
                self.p,
                free,
                items[0][1][w:],
                motions[0].y[w:],
                self.dt,
                self.hold,
                self.coarse,
                lower,
                upper,
            )
            weakest = min(left, *alone) if self.kind == "two" else left
            if max(alone) > 6 * min(alone) or left > 0.6:
                raise Unsuited
            low, high = max(low, left / MOST), min(high, weakest / LEAST)
            if low > high:
                raise Unsuited
        relative = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        noise = str(rng.choice(list(dull.NOISES), p=list(dull.NOISES.values())))
        said = self.hold if rng.random() < 0.6 or rig.hold else None
        level = relative * motions[0].y[items[0][2] :].std(axis=0)
        tops = (np.abs(items[0][1]).max(axis=0), np.abs(motions[0].y).max(axis=0))
        records, floor = [], 0.0
        for i, (item, motion) in enumerate(zip(items, motions, strict=True)):
            _, u, warm, period = item
            u, clean = dull.spoil_clean(fault, u[warm:], motion.y[warm:])
            y = dull.noise(rng, noise, clean, level)
            floor = float(np.mean(np.sqrt(np.mean((y - clean) ** 2, axis=0)) / y.std(axis=0)))
            u, y = dull.spoil(fault, u, y, tops)
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
        return self._finish(tuple(effects), fault, records, motions, noise, said, floor, left, relative, fault_tags)

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
        source = rig.source(self._start_values(), not self.bare)
        z = [motions[0].z.get(e.port) for e in effects]
        nameable = self.kind in ("one", "two")
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
            else (),
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
            },
        )

    def _start_values(self) -> dict[str, str]:
        """`Parameter(...)` texts: off by up to 30 %, inside bounds a designer would give."""
        rng, reach = self.rng, self.rng.uniform(0.0, 0.3)
        out = {}
        for name, (_, _, unit, fixed) in self.rig.parameters.items():
            value = self.values[name]
            if fixed:
                out[name] = f'Parameter({value!r}, unit="{unit}", fixed=True)'
                continue
            start = float(f"{value * (1 + rng.uniform(-reach, reach)):.4g}")
            low, high = float(f"{0.2 * start:.2g}"), float(f"{5 * start:.2g}")
            out[name] = f'Parameter({start!r}, unit="{unit}", bounds=({low!r}, {high!r}))'
        return out
