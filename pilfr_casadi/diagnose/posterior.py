"""The posterior of all answers, from the log evidences of all fitted hypotheses.

A hypothesis with laws has a probability in proportion to its evidence. The simulator alone claims that its whole error
is noise; so it is weighed with samples that count in full (`hypotheses.Hypotheses.optimistic_evidence`), and where that
noise may be slow, with its innovations (`hypotheses.Hypotheses.evidence_in_noise`).

The right law leaves little of the mismatch for a flexible force to explain. Let s be the share of the mismatch that the
law leaves and that a flexible force at some port would explain. The density of s is

    1 / (max(s, s_0) (1 + log(1 / s_0))), if the physics has no name: log-uniform above s_0,
    2 / (π s_0 (1 + (s / s_0)²)), if the law is the physics: half-Cauchy,

and the probability of a hypothesis is divided between a named and an unnamed answer in this ratio. s_0 is the share
that the formula of the right law may leave. A wrong law often drives a parameter of the simulator to a bound; then the
odds against the law rise by STRAINED_ODDS for each. The confidence of an effect is the probability that it is
included, that its law is the physics, and that its strength is not zero. An effect beside others is included if its
probability exceeds SURE (median probability model, Barbieri & Berger 2004).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..simulators import SENSOR, Placed, name_at_any, port_name
from .fits.evidence import (
    BETTER_RATIO,
    COLOURED_NOISE_RATIO,
    CONTENDING_NATS,
    DISTURBANCE_WEIGHT,
    DOUBTFUL_PRIOR,
    FORMULA_ERROR,
    INDISTINGUISHABLE_NATS,
    LEAST_MODEL_ERROR,
    LOUDEST_NOISE,
    MOST_INNOVATIONS,
    OUTSIDE_CATALOGUE,
    STRAINED_ODDS,
    SURE,
    cap_mismatch,
    significance,
)
from .fits.floor import ABOVE_NOISE, Floor, times_white
from .fits.workbench import Fitted
from .search.hypotheses import Hypotheses, likeliest_forms
from .search.trials import Name, Trial


@dataclass(frozen=True, eq=False)
class LikelyEffect:
    """An effect of the likeliest hypothesis."""

    element: Placed
    # probability that it is included, or the same law elsewhere if the recordings cannot tell the place
    confidence: float
    # port and law id of indistinguishable effects in its place -> the hypothesis, the likeliest first
    alike: dict[Name, Trial]
    # probability that this law or another of the catalogue acts at its port, or at one where it looks alike
    at_port: float

    @property
    def name(self) -> Name:
        """Port and law id."""
        return self.element.name

    def times(self, probability: float) -> LikelyEffect:
        """Weigh the effect by the probability of something else that it rests on."""
        return replace(self, confidence=probability * self.confidence, at_port=probability * self.at_port)

    @property
    def words(self) -> str:
        """Name it with every place where it would look the same: "delay at sensor:y (or actuator:u)"."""
        return name_at_any(*self.name, self.element.law.form, self.alike)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probabilities of the answers."""

    best: Trial  # the likeliest hypothesis
    # probability that the laws of the best hypothesis are the physics, given it; at most that of the surest of them
    named: float
    effects: tuple[LikelyEffect, ...]  # its laws, strongest first
    nothing: float  # probability of the simulator alone

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
        return replace(self, named=named, effects=tuple(e.times(ratio) for e in effects))

    def as_fitted(self, fitted: Fitted) -> Posterior:
        """Take the effects' laws as the corrected simulator has them, perhaps in another form."""
        there = {e.name: e for e in fitted.simulator.elements}
        return replace(self, effects=tuple(replace(e, element=there.get(e.name, e.element)) for e in self.effects))

    def acting(self, search: Hypotheses, trial: Trial) -> Posterior:
        """Weigh the effects by the probability that their strengths are not zero in a fit of the same laws."""
        acts = {e.name: _probability_not_zero(search, trial, e) for e in trial.effects}
        effects = tuple(e.times(acts[e.name]) for e in self.effects)
        return replace(self, named=max(acts.values()) * self.named, effects=effects)

    def against(self, odds: float) -> Posterior:
        """Weigh the effects against another explanation of given odds."""
        effects = tuple(e.times(1 / (1 + odds)) for e in self.effects)
        return replace(self, named=self.named / (1 + odds), effects=effects)


def hypotheses_named(search: Hypotheses, wanted: Collection[Name]) -> list[Trial]:
    """List the hypotheses whose effects have these ports and law ids; an effect may have several forms."""
    return [t for t in search.memo.values() if t.names == wanted]


def explainable_remainder(search: Hypotheses, trial: Trial, before: Trial | None = None) -> float:
    """Compute the share s of the mismatch that a hypothesis leaves and that a flexible force would explain.

    The mismatch is that of the refit, or of another hypothesis `before`. A remainder that no force at a port explains
    counts little: it may be a disturbance that acts beside the law. The noise is known only so well
    (LEAST_MODEL_ERROR), so that a mismatch below the noise hardly shows what explains it. What the law leaves on data
    that it was not fitted to counts in full: a flexible law may follow what it cannot predict. Beside other laws that
    does not count, because without the law the error there is larger as well.
    """
    share = float(np.clip(max(search.flexible(trial).values(), default=0.0), 0.0, 1.0))
    predicted = search.squares_elsewhere(trial) if before is None else trial.fitted.squares
    left, elsewhere = (
        share_left(search, trial.fitted, before, least=1 + LEAST_MODEL_ERROR, squares=squares)
        for squares in (trial.fitted.squares, predicted)
    )
    return left * (share + DISTURBANCE_WEIGHT * (1 - share)) + max(elsewhere - left, 0.0)


def share_left(
    search: Hypotheses,
    fitted: Fitted,
    before: Trial | None = None,
    floor: Floor | None = None,
    least: float = 0.0,
    squares: np.ndarray | None = None,
) -> float:
    """Compute the share that a fit leaves of a hypothesis' mean square error above the noise.

    The hypothesis is by default the refit, and the noise the floor. The estimated floor may contain physics that
    nothing explains; the white noise is a lower limit of the noise. `least` is the multiple of the noise below which no
    error counts. `squares` (n_y,) are the fit's mean square errors on other data, if these are meant.
    """

    def pooled(squares: np.ndarray) -> float:
        return float(np.mean(squares / fitted.balance))

    noise = pooled((floor or search.floor).squares(search.bench.scale))
    left = pooled(fitted.squares if squares is None else squares)
    most = pooled(cap_mismatch((before or search.root).fitted.squares))
    return float(np.clip((max(left, least * noise) - noise) / max(most - noise, 1e-300), 0.0, 1.0))


def share_named(s: float, odds: float = 1.0) -> float:
    """Compute the probability that a law which leaves the share s is the physics.

    `odds` is the likelihood ratio of the other observations, wrong law over right law (`_odds_against`).
    """
    law = (1 - OUTSIDE_CATALOGUE) * 2 / (np.pi * FORMULA_ERROR * (1 + (s / FORMULA_ERROR) ** 2))
    other = OUTSIDE_CATALOGUE / (max(s, FORMULA_ERROR) * (1 - np.log(FORMULA_ERROR)))
    return float(law / (law + other * odds))


def posterior(search: Hypotheses) -> Posterior:
    """Weigh all hypotheses of a search."""
    trials = list(search.memo.values())
    weights = _weights(search, trials)
    by_names: dict[frozenset[Name], float] = {}
    for t, w in zip(trials, weights, strict=True):
        by_names[t.names] = by_names.get(t.names, 0.0) + float(w)
    likeliest_names = max(by_names, key=lambda n: by_names[n])
    while True:
        best = _plainest(search, hypotheses_named(search, likeliest_names))
        if not likeliest_names:
            return Posterior(best, 0.0, (), by_names[likeliest_names])
        found = [_make_effect(search, best, e, by_names) for e in best.effects]
        least = min(found, key=lambda e: e.confidence)
        fewer = likeliest_names - {least.name}
        if least.confidence > SURE or fewer not in by_names or not fewer:
            break
        likeliest_names = fewer
    named = share_named(explainable_remainder(search, best), _odds_against(search, best, best.effects))
    found.sort(key=lambda e: -(_without(search, best, e) or search.root).mean_square)
    each = [_named_beside(search, best, e) for e in found]
    effects = _as_physics(found, each)
    answer = Posterior(best, min(named, max(each)), effects, by_names.get(frozenset(), 0.0))
    return answer.acting(search, best)


def _as_physics(strongest_first: Sequence[LikelyEffect], named: Sequence[float]) -> tuple[LikelyEffect, ...]:
    """Weigh each effect by the probability that its law is the physics, and that of larger effects at its port.

    Beside a large one of a wrong law, a small one only corrects that.
    """
    out = list[LikelyEffect]()
    for i, effect in enumerate(strongest_first):
        at_port = [p for e, p in zip(strongest_first[:i], named, strict=False) if e.element.port == effect.element.port]
        out.append(effect.times(min([named[i], *at_port])))
    return tuple(out)


def _named_beside(search: Hypotheses, best: Trial, effect: LikelyEffect) -> float:
    """Compute the probability that one law of a hypothesis is the physics, from what is left of its own mismatch.

    A small effect may only compensate an inexact formula of a large one. Its share is therefore judged on the error
    without it.
    """
    remainder = explainable_remainder(search, best, _without(search, best, effect))
    return share_named(remainder, _odds_against(search, best, [effect.element]))


def _odds_against(search: Hypotheses, trial: Trial, elements: Sequence[Placed]) -> float:
    """Compute how much likelier the fitted values are of wrong laws: at a bound, or where every law degenerates."""
    degenerate = all(search.doubtful(trial, e) for e in elements)
    strained = trial.fitted.strained(search.bench.simulator.parameters)
    return STRAINED_ODDS**strained * (float(np.exp(-DOUBTFUL_PRIOR)) if degenerate else 1.0)


def _probability_not_zero(search: Hypotheses, best: Trial, element: Placed) -> float:
    """Compute the probability that a law's strengths are not zero; the law's first state could imitate its force."""
    names = [f"{element.prefix}{name}" for name in element.law.strength]
    return significance(search.bench, best.fitted, names) if names else 1.0


def _without(search: Hypotheses, best: Trial, effect: LikelyEffect) -> Trial | None:
    """Return the hypothesis without one of several effects, if it was fitted."""
    others = best.names - {effect.name}
    fitted = hypotheses_named(search, others) if others else []
    return min(fitted, key=lambda t: t.mean_square, default=None)


def _plainest(search: Hypotheses, trials: Sequence[Trial]) -> Trial:
    """Choose the likeliest hypothesis, or one with fewer parameters that is about as likely and follows as well."""
    best = max(trials, key=search.evidence)
    least, most = search.evidence(best) - INDISTINGUISHABLE_NATS, BETTER_RATIO**2 * best.mean_square
    alike = (t for t in trials if search.evidence(t) >= least and t.mean_square <= most)
    return min(alike, key=lambda t: (t.size, -search.evidence(t)))


def _make_effect(
    search: Hypotheses, best: Trial, element: Placed, by_names: Mapping[frozenset[Name], float]
) -> LikelyEffect:
    """Make an effect, with its inclusion probability given that the physics is in the catalogue."""
    twins, law = indistinguishable(search, best, element), element.law.id
    ports = {element.port}
    for places, other in twins:
        ports |= set(places.split(" + ")) if other == law else set()
    included = sum(w for n, w in by_names.items() if n & {(port, law) for port in ports})
    at_port = sum(w for n, w in by_names.items() if ports & {port for port, _ in n})
    return LikelyEffect(element, included, twins, min(at_port, 1.0))


def _weights(search: Hypotheses, trials: Sequence[Trial]) -> np.ndarray:
    """Compute the probability of each hypothesis; the module docstring tells why the simulator alone has another scale.

    Laws claim only to be near the physics; they are weighed by samples that count as far as their error is noise.
    """
    tempered = np.array([search.evidence(t) for t in trials])
    alone = np.array([not t.names for t in trials])
    if _is_slow_noise(search):
        near = alone | (tempered > max(tempered[~alone], default=0.0) - CONTENDING_NATS)
        full = np.array([search.evidence_in_noise(t) if one else -np.inf for t, one in zip(trials, near, strict=True)])
    else:
        full = np.array([search.optimistic_evidence(t) for t in trials])
    nothing = float(np.sum(_shares(full)[alone]))
    weights = np.empty(len(trials))
    weights[alone] = nothing * _shares(full[alone])
    weights[~alone] = (1 - nothing) * _shares(tempered[~alone])
    return weights


def _shares(logs: np.ndarray) -> np.ndarray:
    """Normalise numbers, given by their logarithms, to a sum of one; equal shares if all of them are zero."""
    largest = logs.max(initial=-np.inf)
    found = np.exp(logs - largest) if np.isfinite(largest) else np.ones_like(logs)
    return np.asarray(found / found.sum())


def indistinguishable(search: Hypotheses, best: Trial, element: Placed) -> dict[Name, Trial]:
    """Find hypotheses, about as likely as the best, that have another effect in place of one of its effects.

    Its laws count in their likeliest form: in a correction they may have another one. The same law in every sensor is
    one effect, at "sensor:a + sensor:b".
    """
    own = element.name
    rest, out = best.names - {own}, dict[Name, Trial]()
    forms = likeliest_forms((best, *search.memo.values()), search.evidence)
    least = next(search.evidence(t) for t in forms if t.names == best.names) - INDISTINGUISHABLE_NATS
    # few samples count where all models are wrong, so that one which explains nothing may be about as likely; where the
    # effect is small, a law that explains half as much is another explanation
    nothing = min((t.mean_square for t in hypotheses_named(search, rest)), default=np.inf)
    most = max(nothing / BETTER_RATIO**2, (nothing * best.mean_square) ** 0.5)
    every = [port_name(SENSOR, name) for name in search.bench.simulator.output_names]
    for t in (t for t in forms if search.evidence(t) >= least and t.mean_square <= most):
        other = t.names - rest
        if not rest <= t.names or own in other or not other:
            continue
        if len(other) == 1 and len(t.names) == len(best.names):
            out.setdefault(next(iter(other)), t)
        elif other == {(port, element.law.id) for port in every}:
            out.setdefault((" + ".join(every), element.law.id), t)
    return out


def may_be_coloured_noise(search: Hypotheses, quiet: float = 1.0) -> bool:
    """Tell whether the refit's residual is small enough to be noise of any colour, if the machine does not drive it.

    `quiet` is the share of its rms that is left without steady tones. Measured noise has its colour already.
    """
    most = COLOURED_NOISE_RATIO if search.floor.source == "estimated" else ABOVE_NOISE
    return bool(np.max(search.root.fitted.squares) < LOUDEST_NOISE**2) and quiet * times_of_noise(search) < most


def _is_slow_noise(search: Hypotheses) -> bool:
    """Tell whether the refit's residual may be coloured noise, and no force explains most of its innovations."""
    small = may_be_coloured_noise(search) and not search.is_driven
    return small and search.innovation_share(search.root) < MOST_INNOVATIONS


def times_of_noise(search: Hypotheses) -> float:
    """Compute the ratio of the refit's error to the noise: measured, or the white noise in its residual."""
    if search.floor.source == "estimated":
        residuals = search.bench.scored(search.root.fitted.residual)
        return max(times_white(e / search.bench.scale) for e in residuals)
    return search.root.error / max(float(np.sqrt(search.floor2)), 1e-300)
