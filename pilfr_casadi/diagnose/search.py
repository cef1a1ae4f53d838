"""From a refitted simulator to the effects it lacks: one pass for each, then a look back at the first.

A second effect is looked for where the first leaves more than a few per cent of the excess and a flexible force could
explain it. It is accepted at another port when it removes most of what is left; friction and a curve of position may
share a port, when the second removes nearly all. What was accepted is looked at again (`review`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from ..laws import Law
from ..simulators import Placed
from .candidate import Candidate, heads, judged, polish
from .choice import Choice, choose
from .every_sensor import every_sensor
from .exchange import exchange
from .explain import explain
from .first_effect import led_out, offset_beside, wrongly_held
from .flexible import explainable
from .floor import Floor, effective_size, white_part
from .gates import Gate
from .imitated import imitated
from .kinship import complements
from .linearise import linearised
from .pairs import two_at_once
from .passed_over import passed_over
from .review import look_back, prefer_what_leaves_nothing, put_more_finely
from .screen import Scored, screen
from .second_effect import believed, mends
from .stages import Stages
from .verdict import HINT, LITTLE, MAINLY, UNSURE, confidence, explains, left_open
from .workbench import THOROUGH, Fitted, Workbench

ROOM = 12.0  # nats by which a law has to improve on the refit to be believed
FEWEST = 100.0  # effective samples that a comparison is made on at least
MORE, LOUD = 0.03, 3.0  # share of the excess, or times the noise, that has to be left to look for a second effect
SEEN = 2.5e-5  # mean square error below which what is more than noise is not worth a second effect
NEARLY = 0.05  # share of the excess that a law leaves behind which others are not worth many starts
POLISHED = 4  # candidates fitted to everything before one is chosen
NEAR, NEAR_KNEE = 1.5, 3.0  # times the best error of those
NOTHING = 0.01  # below this share nothing is explained

Seen = tuple[list[Scored], np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Pass:
    """One search for an effect."""

    choice: Choice | None
    candidates: tuple[Candidate, ...]
    scored: tuple[Scored, ...]
    before: tuple[float, float]
    accepted: bool
    samples: float = FEWEST


@dataclass(eq=False)
class Search:
    """The state of a search; `run` fills it.

    Attributes
    ----------
    base : Fitted
        The simulator with the effects accepted so far.
    open_before, open_after : dict
        Share of the residual that a flexible force explains, by port, without and with the effects.
    hold_said : bool
        Whether somebody said what inputs do between samples; else each effect is a new chance to tell.
    stand_in_error : float
        NRMSE by which the simulator misses what it stands for; the floor holds it too.
    may_be_led : bool
        Whether the refit may have stayed in a local minimum that a law leads out of.
    led_to : dict
        Values that the simulator alone is far better at, where a law has led there; the search has ended then.
    gates : tuple of Gate
        What was found of the recordings on the way.
    misheld : float
        By how much the error falls, with the effects in place, where inputs do the other thing between samples.
    """

    bench: Workbench
    without: Fitted
    floor: Floor
    laws: Sequence[type[Law]]
    workers: int
    say: Stages
    hold_said: bool = True
    misheld: float = 1.0
    stand_in_error: float = 0.0
    may_be_led: bool = True
    led_to: Mapping[str, np.ndarray] = field(default_factory=dict)
    base: Fitted = field(init=False)
    gates: tuple[Gate, ...] = ()
    passes: list[Pass] = field(default_factory=list)
    open_before: dict[str, float] = field(default_factory=dict)
    open_after: dict[str, float] = field(default_factory=dict)
    times: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def floor2(self) -> float:
        """Mean square of the noise in units of the outputs' variance."""
        return float(np.mean((self.floor.deviation / self.bench.scale) ** 2))

    @property
    def accepted(self) -> list[Choice]:
        """The effects accepted so far."""
        return [p.choice for p in self.passes if p.accepted and p.choice is not None]

    def begin(self, stage: str) -> float:
        """Report that a stage begins; return the time in s, for `timed`."""
        self.say(stage, 0, 1, self.base.cost**0.5)
        return time.perf_counter()

    def timed(self, stage: str, began: float, told: bool = False) -> None:
        """Report that a stage is done and add the seconds since `began` to it; end the search if a fit was interrupted.

        Raises
        ------
        KeyboardInterrupt
            If a fit was interrupted, which returns its best so far and goes no further with that.
        """
        self.times[stage] = self.times.get(stage, 0.0) + time.perf_counter() - began
        if not told:  # the stage has not reported its own end
            self.say(stage, 1, 1, self.base.cost**0.5)
        if self.bench.struck:
            raise KeyboardInterrupt

    def flexible(self, fitted: Fitted) -> dict[str, float]:
        """Share of a fit's residual that a flexible force explains, by port."""
        began = self.begin("flexible")
        found = explainable(self.bench, fitted)
        self.timed("flexible", began)
        return found

    def run(self, effects: int) -> Search:
        """Look for effects, one after the other; an interrupt ends the search with what there is."""
        self.base = self.without
        try:
            self._run(effects)
            every_sensor(self)
        except KeyboardInterrupt:
            self.interrupted = True
        return self

    def _run(self, effects: int) -> None:
        linearised(self.bench, self.without)  # what both of the next look at
        with ThreadPoolExecutor(1) as other:
            looked = other.submit(self.screened)
            self.open_before = self.open_after = self.flexible(self.without)
            seen = looked.result()
        for number in range(effects):
            if number:
                if not self.much():
                    break
                seen = self.screened()
                if max([*self.open_after.values(), *(s.share for s in seen[0])], default=0.0) < HINT:
                    break
            found = self.pass_(number, seen)
            self.passes.append(found)
            if not found.accepted:
                break
            assert found.choice is not None
            before, passes = self.base, self.passes[:-1]
            self.base = found.choice.winner.fitted
            if not number and led_out(self):
                return
            prefer_what_leaves_nothing(self)
            put_more_finely(self)
            if number:
                look_back(self)
                exchange(self)
                if mends(self, before):
                    self.base, self.passes = before, [*passes, replace(found, accepted=False)]
                    break
            if wrongly_held(self):
                return
            if not number:
                offset_beside(self)
            self.open_after = self.flexible(self.base)
        if effects > 1 and self.unsure():
            two_at_once(self)

    def unsure(self) -> bool:
        """Whether something is left that a force explains, and what is named does not explain it or is not sure."""
        if self.certainty() > UNSURE or not self.much():
            return False
        return max(self.open_after.values(), default=0.0) > HINT

    def certainty(self) -> float:
        """Confidence of the least sure name; nothing where nothing is named, or what is named does not explain."""
        if not self.accepted or not explains(self.accepted, *left_open(self)):
            return 0.0
        return min(confidence(c, self) for c in self.accepted)

    def much(self) -> bool:
        """Whether enough is left to look further."""
        excess, still = left_open(self)
        much = excess > MORE or self.base.cost > max(LOUD**2 * self.floor2, SEEN)
        return much or (excess > LITTLE and still > MAINLY)

    def screened(self) -> Seen:
        """Every law at every port beside the effects so far, scored."""
        began = self.begin("screen")
        seen = screen(self.bench, self.base, self.laws, self.floor.deviation, self.workers)
        self.timed("screen", began)
        return seen

    def pass_(self, number: int, seen: Seen) -> Pass:
        """Fit what the screen lets through, and choose; `number` effects were accepted before."""
        scored, gain = seen
        scored = [s for s in scored if all(e.port != s.port or complements(e.law, s.law) for e in self.found())]
        most = max((s.share for s in scored), default=0.0)
        nothing = max(most, max(self.open_after.values(), default=0.0)) < NOTHING and self.base.cost < 0.0025
        before = (self.base.cost, self.base.cost)
        if nothing or not scored:
            return Pass(None, (), tuple(scored), before, False)
        began = time.perf_counter()
        candidates = self._explained(number, scored, gain)
        self.say("imitations", 0, 1)
        missed = [*passed_over(candidates, scored), *imitated(self.bench, candidates, scored)]
        self.say("imitations", 1, 1)
        if missed:
            more = self._explained(number, missed, gain, "more fits")
            candidates = sorted([*candidates, *more], key=lambda c: c.error)
        self.timed("fits", began, told=True)
        began = self.begin("choice")
        best = candidates[0].error
        # what coarse steps, and knees that steps are too coarse for, cost is not to decide
        near = [
            c
            for c in candidates[:POLISHED]
            if c.error < (NEAR_KNEE if c.knee else NEAR) * best or self.bench.too_coarse(c.fitted)
        ]
        with ThreadPoolExecutor(self.workers) as pool:
            bare = pool.submit(self.errors_on_parts, self.base)
            kept = [*pool.map(lambda c: polish(self.bench, c), near), *(c for c in candidates if c not in near)]
            before = bare.result()
        self._lower_floor([c.fitted for c in candidates[:5]])
        # a law may have become the one that it refines
        kept = list({(c.port, type(c.law)): c for c in sorted(kept, key=lambda c: -c.error)}.values())[::-1]
        samples = self.effective_samples(kept)
        choice = choose(kept, before, self.floor2, samples)
        while choice is not None and not np.isfinite(choice.winner.full):  # what does not hold on everything is out
            done = polish(self.bench, choice.winner)
            kept = sorted((done if c is choice.winner else c for c in kept), key=lambda c: c.error)
            choice = choose(kept, before, self.floor2, samples)
        accepted = choice is not None and choice.gain > ROOM
        if accepted and number:  # what is not fitted has to improve as well
            assert choice is not None
            accepted = believed(self, choice, before[1], number)
        self.timed("choice", began)
        return Pass(choice, tuple(kept), tuple(scored), before, accepted, samples)

    def found(self) -> Sequence[Placed]:
        """What stands in the ports so far."""
        return self.base.simulator.elements[len(self.bench.simulator.elements) :]

    def _explained(
        self, number: int, scored: Sequence[Scored], gain: np.ndarray | None, stage: str = "fits"
    ) -> list[Candidate]:
        """Full fits, smallest error first."""
        enough = float(np.sqrt(self.floor2 + NEARLY * max(self.base.cost - self.floor2, 0.0)))
        stage += ", second effect" if number else ""
        return explain(
            self.bench, scored, self.base, gain, self.workers, enough, lambda i, n, e: self.say(stage, i, n, e)
        )

    def effective_samples(self, candidates: Sequence[Candidate]) -> float:
        """Effective samples of the best candidate's residual."""
        best = min(candidates, key=lambda c: c.error, default=None)
        return max(effective_size(best.fitted.residual if best else self.base.residual), FEWEST)

    def errors_on_parts(self, fitted: Fitted) -> tuple[float, float]:
        """Fit a simulator to the first parts only; mean square errors on those parts and on the rest."""
        part = self.bench.on(heads(self.bench.recordings))
        return judged(
            self.bench, part.fit(fitted.simulator, [fitted.values, {}], states=fitted.initial, solver=THOROUGH)
        )

    def _lower_floor(self, fits: Sequence[Fitted]) -> None:
        if self.floor.source == "estimated":
            known = self.stand_in_error * self.bench.scale
            found = [self.floor.deviation, *(np.hypot(white_part(f.residual), known) for f in fits)]
            self.floor = Floor(np.min(found, axis=0), "estimated")

    def polished(self, candidate: Candidate) -> Candidate | None:
        """A candidate fitted to everything; None where it does not hold there."""
        done = candidate if np.isfinite(candidate.full) else polish(self.bench, candidate)
        return done if np.isfinite(done.full) else None
