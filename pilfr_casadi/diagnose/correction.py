"""The corrected simulator: the candidate that best predicts data it was not fitted to, with or without a named law.

If the named answer is not sure, or leaves error above the noise, several candidates compete on held-out parts of the
training recordings (`cross_validation`): the refitted simulator, the laws that the search has fitted, and a learned
force alone or beside them. The score is the held-out error plus the spread of predictions for other inputs
(`evidence.spread`), which is large if many parameters are hardly determined. The smallest score wins. Test recordings
are never used.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from .._base import InputError
from ..laws import CATALOGUE, display_name
from ..simulators import Placed
from .cross_validation import HeldOut
from .learned import Learned, LearnedForce, candidates, describe_learned
from .posterior import Posterior, explainable_remainder
from .search import FORMULA, Search
from .trials import Trial
from .verdict import SURE
from .workbench import Fitted

TRIED = 3  # hypotheses with laws that compete if no law is named
PORTS = 3  # ports at which an element is learned: those where a flexible force explains most
JUDGED = 2  # learned elements that are compared on held-out blocks: those with the smallest fit error
# fitted, without its learned element, and a function that computes the held-out errors
_Competitor = tuple[Fitted, Fitted, Callable[[], HeldOut]]


@dataclass(frozen=True, eq=False)
class Correction:
    """The elements of the corrected simulator that the refit does not have, and its prediction errors.

    Attributes
    ----------
    elements : tuple of (port, law, form)
        The added elements; empty if the refit predicts as well.
    shares : dict
        `named`, `learned`, `left`: shares of the refit's mean square error above the noise on the training recordings.
        Named laws remove the first, the learned element beside them the second; the third remains.
    learned : tuple of Learned
        The learned elements.
    before, after : float
        Rms error on held-out blocks of the refit and of the corrected simulator, in units of the outputs' deviation;
        nan if nothing was compared.
    """

    elements: tuple[tuple[str, str, str], ...]
    shares: dict[str, float]
    learned: tuple[Learned, ...] = ()
    before: float = np.nan
    after: float = np.nan

    @property
    def words(self) -> str:
        """The elements in words, such as "Coulomb friction at seal and a learned force at seal"."""
        names = []
        for port, law, form in self.elements:
            name = "a learned force" if law == LearnedForce.id else display_name(law)
            names.append(f"{name}{f' ({display_name(form)})' if form else ''} at {port}")
        return " and ".join(names)

    @property
    def sentence(self) -> str:
        """Say what is named, what is learned, what is left, and how much better the simulator predicts."""
        named, learned, left = (f"{100 * self.shares[k]:.3g} %" for k in ("named", "learned", "left"))
        shares = (
            f"Of the mismatch above the noise, named laws explain {named}, a learned force {learned}; {left} is left."
        )
        if not self.elements:
            return (
                "The corrected simulator is the refitted one: nothing that was tried is expected to predict other "
                "recordings better."
            )
        if not np.isfinite(self.after):
            return shares
        return (
            f"The corrected simulator has {self.words}. On parts of the training recordings that it was not fitted to, "
            f"its error is {100 * self.after:.3g} % of the outputs' deviation; that of the refit is "
            f"{100 * self.before:.3g} %. {shares}"
        )

    def to_dict(self) -> dict[str, Any] | None:
        """Return the key "description" of diagnosis.json; None if nothing was compared or nothing is better."""
        if not self.elements or not np.isfinite(self.after):
            return None
        return {
            "elements": [{"port": port, "law": law, "form": form} for port, law, form in self.elements],
            "held_out": {"before": self.before, "after": self.after},
            "sentence": self.sentence,
        }


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A fitted simulator, the one without its learned element, and its errors on held-out blocks."""

    fitted: Fitted
    named: Fitted
    held_out: HeldOut


def find_correction(search: Search, answer: Posterior, named: bool = False) -> tuple[Correction, Fitted]:
    """Choose the corrected simulator from the candidates that can be tried before the deadline.

    With `named`, the answer names its effects. If a learned element at another port predicts as well without them, the
    correction omits them. Learned elements at their own ports would only imitate them, and are not tried.
    """
    best_laws = answer.best
    if named and answer.sure > SURE and explainable_remainder(search, best_laws) < FORMULA:
        return named_correction(search, best_laws.fitted), best_laws.fitted
    found: list[_Hypothesis] = []
    for fitted, named_only, predict in _competitors(search, best_laws if named else None):
        least = min((h.held_out.mean_square for h in found), default=np.inf)
        if fitted.cost < least:  # held-out error is never below the fit error
            found.append(_Hypothesis(fitted, named_only, predict()))
        if time.perf_counter() > search.deadline:
            break
    if not found:
        return named_correction(search, best_laws.fitted), best_laws.fitted
    best = min(found, key=lambda h: h.held_out.expected)
    shares = _shares(search, best.named, best.fitted)
    learned: tuple[Learned, ...] = ()
    if best.fitted is not best.named:
        learned = (
            describe_learned(search.bench, best.fitted, shares["learned"], dict.fromkeys((*CATALOGUE, *search.laws))),
        )
    refit = next((h.held_out.error for h in found if h.fitted is search.root.fitted), np.inf)
    return Correction(_elements(search, best.fitted), shares, learned, refit, best.held_out.error), best.fitted


def _competitors(search: Search, named: Trial | None) -> Iterator[_Competitor]:
    """Generate the candidates: the refit, the named or likeliest laws, other laws, and learned elements."""
    ranked = sorted(
        (t for t in search.memo.values() if _may_recur(search, t)), key=search.optimistic_evidence, reverse=True
    )
    others = [t for i, t in enumerate(t for t in ranked if t.laws) if i < TRIED or t.key in search.held_out]
    first = named or next(iter(others), search.root)
    for trial in {t.key: t for t in (search.root, first, *others)}.values():
        yield from _trial_competitor(search, trial)
    if first.laws:
        yield from _learned_competitors(search, search.memo[first.key])
    yield from _learned_competitors(search, search.root, {e.port for e in named.laws} if named else set())


def named_correction(search: Search, fitted: Fitted) -> Correction:
    """Describe a simulator without a learned element, which was not compared with others."""
    return Correction(_elements(search, fitted), _shares(search, fitted, fitted))


def _trial_competitor(search: Search, trial: Trial) -> Iterator[_Competitor]:
    """Generate the candidate of a trial, if it can be simulated."""
    with suppress(InputError):
        trial = search.thorough(trial)
        if np.isfinite(trial.whole):
            yield trial.fitted, trial.fitted, partial(search.predicts, trial)


def _may_recur(search: Search, trial: Trial) -> bool:
    """Tell whether a hypothesis may hold for another recording; a trend in time within one recording may not."""
    return len(search.bench.recordings) > 1 or not any("t" in e.law.reads() for e in trial.laws)


def _learned_competitors(search: Search, base: Trial, taken: Collection[str] = ()) -> Iterator[_Competitor]:
    """Generate learned elements beside a trial, at the free ports where a flexible force explains most."""
    shares = search.flexible(base)
    ports = [name for name in sorted(shares, key=lambda name: -shares[name]) if name not in taken][:PORTS]
    with suppress(InputError, np.linalg.LinAlgError):
        inputs, part = search.bench.simulator.inputs, search.fits.part
        for fitted in candidates(search.bench, part, base.fitted, ports, inputs, search.workers)[:JUDGED]:
            yield fitted, base.fitted, partial(search.predict, fitted, _own_elements(search, fitted))


def _shares(search: Search, named: Fitted, whole: Fitted) -> dict[str, float]:
    """Compute the shares of the refit's mean square error above the noise; all are zero if there is none."""
    excess = search.root.whole - search.floor2
    if not excess > 0:
        return {"named": 0.0, "learned": 0.0, "left": 0.0}
    after = [float(np.clip((f.cost - search.floor2) / excess, 0.0, 1.0)) for f in (named, whole)]
    left = min(after)
    return {"named": 1 - after[0], "learned": after[0] - left, "left": left}


def _elements(search: Search, fitted: Fitted) -> tuple[tuple[str, str, str], ...]:
    """Return port, law and form of the elements that the diagnosis has added."""
    return tuple((e.port, e.law.id, e.law.form) for e in _own_elements(search, fitted))


def _own_elements(search: Search, fitted: Fitted) -> Sequence[Placed]:
    """Return the elements that the diagnosis has added."""
    return fitted.simulator.elements[len(search.bench.simulator.elements) :]
