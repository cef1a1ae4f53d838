"""The probability of every answer, from the log evidences of all fitted hypotheses.

A hypothesis with laws has a probability in proportion to its evidence. The simulator alone claims that its whole error
is noise; so it is weighed with samples that count in full (`search.Search.optimistic_evidence`).

The right law leaves little of the mismatch for a flexible force to explain. Let s be the share of the mismatch that the
law leaves and that a flexible force at some port would explain. The density of s is

    1 / (s log(1 / s_0)) for s from s_0 to 1, if the physics has no name: log-uniform,
    2 / (π s_0 (1 + (s / s_0)²)), if the law is the physics: half-Cauchy,

and the probability of a hypothesis is divided between a named and an unnamed answer in this ratio. s_0 is the share
that the formula of the right law may leave. The verdict is the likeliest of complete, missing physics and unexplained.
The confidence of an effect is the probability that it is included. An effect beside others is named if that exceeds one
half.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..simulators import Placed
from .search import FORMULA, Search
from .trials import Trial

OUTSIDE = 0.1  # prior probability that missing physics is in no law of the catalogue
DISTURBED = 0.2  # weight of a law's remainder that no force at a port explains
HALF = 0.5  # inclusion probability that an effect needs beside others (Barbieri & Berger 2004)
ALIKE = 3.0  # nats within which two hypotheses are indistinguishable
Name = tuple[str, str]  # port and law id


@dataclass(frozen=True, eq=False)
class Named:
    """An effect of the likeliest hypothesis.

    Attributes
    ----------
    confidence : float
        Probability that it is included, or the same law elsewhere if the recordings cannot tell the place.
    alike : dict
        Port and law id of indistinguishable effects in its place -> the hypothesis, the likeliest first.
    """

    element: Placed
    confidence: float
    alike: dict[Name, Trial]

    @property
    def name(self) -> Name:
        """Port and law id."""
        return self.element.port, self.element.law.id


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probabilities of the answers.

    Attributes
    ----------
    best : Trial
        The likeliest hypothesis.
    named : float
        Probability that the laws of the best hypothesis are the physics, given this hypothesis.
    effects : tuple of Named
        Its laws, strongest first.
    nothing : float
        Probability of the simulator alone.
    """

    best: Trial
    named: float
    effects: tuple[Named, ...]
    nothing: float

    @property
    def sure(self) -> float:
        """Confidence of the least sure effect; zero without effects."""
        return min((e.confidence for e in self.effects), default=0.0)

    def within(self, elements: Collection[Name], learned: float) -> Posterior:
        """Restrict the effects to those in the corrected simulator, beside a learned force of a share of the mismatch.

        Effects that predict other recordings worse than their replacement lose their names.
        """
        effects = [e for e in self.effects if e.name in elements]
        named = min(self.named, share_named(learned if effects else 1.0))
        ratio = named / max(self.named, 1e-300)
        return replace(self, named=named, effects=tuple(replace(e, confidence=ratio * e.confidence) for e in effects))


def names(trial: Trial) -> frozenset[Name]:
    """Return ports and law ids of a hypothesis; an offset is a finding about the recording, not an effect."""
    return frozenset((e.port, e.law.id) for e in trial.laws if e.law.id != "offset")


def explainable_remainder(search: Search, trial: Trial) -> float:
    """Compute the share s of the mismatch that a hypothesis leaves and that a flexible force would explain.

    A remainder that no force at a port explains counts little: it may be a disturbance that acts beside the law.
    """
    excess = max(search.root.whole - search.floor2, 1e-300)
    left = float(np.clip((trial.whole - search.floor2) / excess, 0.0, 1.0))
    share = float(np.clip(max(search.flexible(trial).values(), default=0.0), 0.0, 1.0))
    return left * (share + DISTURBED * (1 - share))


def share_named(s: float) -> float:
    """Compute the probability that a law which leaves the share s is the physics."""
    law = (1 - OUTSIDE) * 2 / (np.pi * FORMULA * (1 + (s / FORMULA) ** 2))
    other = OUTSIDE / (max(s, FORMULA) * np.log(1 / FORMULA))
    return float(law / (law + other))


def posterior(search: Search) -> Posterior:
    """Weigh all hypotheses of a search."""
    trials = list(search.memo.values())
    weights = _weights(search, trials)
    by_names: dict[frozenset[Name], float] = {}
    for t, w in zip(trials, weights, strict=True):
        by_names[names(t)] = by_names.get(names(t), 0.0) + float(w)
    said = max(by_names, key=lambda n: by_names[n])
    while True:
        best = max((t for t in trials if names(t) == said), key=search.evidence)
        if not said:
            return Posterior(best, 0.0, (), by_names[said])
        found = [_make_effect(search, best, e, by_names) for e in best.laws if e.law.id != "offset"]
        least = min(found, key=lambda e: e.confidence)
        fewer = said - {least.name}
        if least.confidence > HALF or fewer not in by_names or not fewer:
            break
        said = fewer
    named = share_named(explainable_remainder(search, best))
    effects = tuple(replace(e, confidence=named * e.confidence) for e in found)
    return Posterior(best, named, effects, by_names.get(frozenset(), 0.0))


def _make_effect(search: Search, best: Trial, element: Placed, by_names: Mapping[frozenset[Name], float]) -> Named:
    """Make an effect, with its inclusion probability given that the physics is in the catalogue."""
    twins = _indistinguishable(search, best, element)
    same = {
        (element.port, element.law.id),
        *(n for name in twins if name[1] == element.law.id for n in _single_effects(name)),
    }
    return Named(element, sum(w for n, w in by_names.items() if n & same), twins)


def _weights(search: Search, trials: Sequence[Trial]) -> np.ndarray:
    """Compute the probability of each hypothesis.

    The simulator alone claims that its whole error is noise, so samples count in full against it. Laws claim only to be
    near the physics; they are weighed by samples that count as far as their error is noise.
    """
    full, tempered = (np.array([of(t) for t in trials]) for of in (search.optimistic_evidence, search.evidence))
    alone = np.array([not names(t) for t in trials])
    nothing = float(np.sum(_shares(full)[alone]))
    weights = np.empty(len(trials))
    weights[alone] = nothing * _shares(full[alone])
    weights[~alone] = (1 - nothing) * _shares(tempered[~alone])
    return weights


def _shares(logs: np.ndarray) -> np.ndarray:
    """Normalise numbers, given by their logarithms, to a sum of one."""
    found = np.exp(logs - logs.max(initial=-np.inf)) if len(logs) else logs
    return np.asarray(found / max(found.sum(), 1e-300))


def _indistinguishable(search: Search, best: Trial, element: Placed) -> dict[Name, Trial]:
    """Find hypotheses, about as likely as the best, that have another effect in place of one of its effects.

    The same law in every sensor is one effect, at "sensor:a + sensor:b".
    """
    own = (element.port, element.law.id)
    rest, out = names(best) - {own}, dict[Name, Trial]()
    least = search.evidence(best) - ALIKE
    every = [f"sensor:{name}" for name in search.bench.simulator.output_names]
    for t in sorted(search.memo.values(), key=search.evidence, reverse=True):
        other = names(t) - rest
        if search.evidence(t) < least or not rest <= names(t) or own in other or not other:
            continue
        if len(other) == 1 and len(names(t)) == len(names(best)):
            out.setdefault(next(iter(other)), t)
        elif other == {(port, element.law.id) for port in every}:
            out.setdefault((" + ".join(every), element.law.id), t)
    return out


def _single_effects(name: Name) -> list[Name]:
    """Split an effect in several places into single effects."""
    return [(port, name[1]) for port in name[0].split(" + ")]
