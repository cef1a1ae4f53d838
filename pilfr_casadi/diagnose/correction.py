"""The corrected simulator: the candidate that best predicts data it was not fitted to, with or without a named law.

If the named answer is not sure, or leaves error above the noise, several candidates compete on held-out parts of the
training recordings (`evidence`): the refitted simulator; the named laws, all of them and the sure ones alone; all
likely hypotheses that have the sure names; and a learned force, alone or beside laws. The correction grows by further
laws as long as that predicts better (`_grow`). The score is the held-out error plus the spread of predictions for other
inputs (`evidence.spread`), which is large if many parameters are hardly determined.
The smallest score wins, unless a candidate with fewer laws, but every sure one, is not clearly worse on the same blocks
(`_choose`). Candidates are cross-validated in the order of their fit error plus spread, until that exceeds the smallest
score; those that the search has cross-validated already count as well. When time runs out first, the hypothesis with
the smallest fit error plus spread is used if the refit is more than NEAR_RATIO worse. Test recordings are never used.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, in_words, percent
from ..laws import CATALOGUE
from ..simulators import name_at
from .fits.evidence import FORMULA_ERROR, NEAR_RATIO, SURE, ExpectedError, held_out_errors, runs_away
from .fits.floor import Floor
from .fits.workbench import FEW, Fitted
from .posterior import Posterior, explainable_remainder, hypotheses_named, share_left
from .search.hypotheses import likeliest
from .search.learned import Learned, LearnedForce, describe_learned, refit_learned
from .search.moves import Search
from .search.trials import Name, Trial


@dataclass(frozen=True, eq=False)
class Correction:
    """The elements of the corrected simulator that the refit does not have, and its prediction errors."""

    elements: tuple[tuple[str, str, str], ...]  # port, law and form of each; empty if the refit predicts as well
    # `named`, `learned`, `left`: shares of the refit's mean square error above the noise on the training recordings.
    # Named laws remove the first, the learned element beside them the second; the third remains.
    shares: dict[str, float]
    learned: tuple[Learned, ...] = ()
    # rms error of the refit on held-out blocks, in units of the outputs' deviation; nan if nothing was compared
    before: float = np.nan
    after: float = np.nan  # the same of the corrected simulator
    closest: Trial | None = None  # the hypothesis with its named laws, if it was chosen among others
    late: bool = False  # whether there was no time left to compare it with others
    offsets: str = ""  # words for the offsets that the refit has, as in "the offset of u"

    @property
    def words(self) -> str:
        """The elements in words, such as "Coulomb friction at seal and a learned force at seal"."""
        names = []
        for port, law, form in self.elements:
            learned = "a learned force" + (f" ({form})" if form else "") + f" at {port}"
            names.append(learned if law == LearnedForce.id else name_at(port, law, form))
        return in_words(names)

    @property
    def sentence(self) -> str:
        """State the elements, the shares that they explain, and how much better the simulator predicts."""
        named, learned, left = (percent(self.shares[k]) for k in ("named", "learned", "left"))
        shares = (
            f"Of the mismatch above the noise, named laws explain {named}, a learned force {learned}; {left} is left."
        )
        if not self.elements:
            why = "nothing that was tried is expected to predict further recordings better"
            late = "there was no time left to compare it with others"
            still = f"has only {self.offsets}" if self.offsets else "is still the refitted one"
            return f"The corrected simulator {still}: {why if np.isfinite(self.after) else late}."
        if self.late:
            return (
                f"The corrected simulator has {self.words}, with which it follows the training recordings far better. "
                f"There was no time left to test this on parts that it was not fitted to. {shares}"
            )
        if not np.isfinite(self.after):
            return shares
        return (
            f"The corrected simulator has {self.words}. On parts of the training recordings that it was not fitted to, "
            f"its error is {percent(self.after)} of the outputs' deviation; that of the refit "
            f"{f'with {self.offsets} ' if self.offsets else ''}is {percent(self.before)}. {shares}"
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
class _Candidate:
    """A fitted simulator, the hypothesis whose named laws it has, and its spread for other inputs (mean square)."""

    fitted: Fitted
    base: Trial
    spread: float

    @classmethod
    def of(cls, search: Search, base: Trial, learned: Fitted | None = None) -> _Candidate:
        """Make the candidate of a hypothesis, or of its fit with a learned force beside it."""
        fitted = learned or base.fitted
        return cls(fitted, base, search.spread(fitted))

    @property
    def has_learned(self) -> bool:
        """Whether a learned force stands beside the hypothesis."""
        return self.fitted is not self.base.fitted

    @property
    def elements(self) -> int:
        """Number of its laws, and of learned forces."""
        return len(self.base.laws) + self.has_learned

    @property
    def least(self) -> float:
        """Least expected mean square error: held-out error is hardly ever below the fit error."""
        return self.fitted.cost + self.spread


_Validated = tuple[_Candidate, ExpectedError]


def find_named_correction(search: Search, answer: Posterior) -> tuple[Correction, Fitted]:
    """Choose the corrected simulator if the answer names its effects: with them, or with what predicts better.

    Further laws may stand beside the sure names, as beside a correction that has no name.
    If a learned element at another port predicts better without them, the correction omits them. A learned element at
    the port of a named effect would only imitate it, and is not tried. After an interrupt, and where the time ends
    before a comparison, the named laws stay.
    """
    best = answer.best
    # sure names may leave nothing that a force at a port could explain
    if search.interrupted or (answer.sure > SURE and explainable_remainder(search, best) < FORMULA_ERROR):
        return uncompared_correction(search, best.fitted), best.fitted
    refit, sure = _cross_validate(search, [_Candidate.of(search, search.root)]), _sure_names(answer)
    candidates = [_Candidate.of(search, t) for t in _named_hypotheses(search, answer)]
    validated = _compare(search, candidates, refit, candidates[0])
    if not validated:
        stays = candidates[0].base
        return replace(uncompared_correction(search, stays.fitted), closest=stays), stays.fitted
    known = {c.base.names for c in candidates}  # of these laws, the forms are chosen
    more = [t for t in _likely_hypotheses(search, sure) if t.names not in known]
    validated = _grow(search, _cross_validate(search, _polish(search, more), validated), sure)
    chosen = _choose(validated, sure)[0].base
    learned = _learned_candidates(search, search.memo[(chosen if chosen.laws else best).key])
    learned += _learned_candidates(search, search.root, taken={e.port for e in best.laws})
    validated = _cross_validate(search, learned, validated)
    return _describe_chosen(search, _choose(validated, sure), validated[0], search.floor)


def find_unnamed_correction(search: Search) -> tuple[Correction, Fitted]:
    """Choose the corrected simulator if nothing has a name.

    Where the time ends before a comparison, a hypothesis that is far better than the refit corrects. The floor may
    contain error that no law explains, so that shares are relative to the least noise.
    """
    refit = _cross_validate(search, [_Candidate.of(search, search.root)])
    candidates = _polish(search, _likely_hypotheses(search))
    validated = _compare(search, candidates, refit)
    if not validated:
        stays = _far_better(search, candidates)
        late = uncompared_correction(search, stays.fitted, search.least_floor)
        return replace(late, late=True, closest=stays), stays.fitted
    validated = _grow(search, validated)
    chosen = _choose(validated)[0].base
    learned = _learned_candidates(search, search.memo[chosen.key]) if chosen.laws else []
    learned += _learned_candidates(search, search.root)
    validated = _cross_validate(search, learned, validated)
    return _describe_chosen(search, _choose(validated), validated[0], search.least_floor)


def _grow(search: Search, validated: list[_Validated], sure: frozenset[Name] = frozenset()) -> list[_Validated]:
    """Add laws to the correction as long as that predicts better.

    Few samples count for a model that is wrong throughout, so that no second law is worth its prior; on data that were
    left out it may be clearly better. The search did not look beyond such a correction.
    """
    while (chosen := _choose(validated, sure)[0].base).laws and len(chosen.effects) < search.most_effects:
        if search.expanded(chosen) or not search.may_go_on():
            break
        search.add(chosen)
        more = [t for t in search.memo.values() if t.names > chosen.names and len(t.effects) == len(chosen.effects) + 1]
        best = sorted((t for t in more if _may_recur(search, t)), key=lambda t: t.mean_square)[:FEW]
        validated = _cross_validate(search, _polish(search, best), validated)
    return validated


def _describe_chosen(search: Search, chosen: _Validated, refit: _Validated, floor: Floor) -> tuple[Correction, Fitted]:
    """Describe the chosen candidate beside the refit."""
    candidate, expected = chosen
    fitted, base = candidate.fitted, candidate.base
    shares = _shares(search, base.fitted, fitted, floor)
    learned: tuple[Learned, ...] = ()
    if candidate.has_learned:
        laws = dict.fromkeys((*CATALOGUE, *search.laws))
        learned = (describe_learned(search.bench, fitted, shares["learned"], laws),)
    before, after = refit[1].held_out.rms, expected.held_out.rms
    described = _describe(search, fitted, shares)
    return replace(described, learned=learned, before=before, after=after, closest=base), fitted


def _cross_validate(
    search: Search, candidates: Sequence[_Candidate], validated: Sequence[_Validated] = ()
) -> list[_Validated]:
    """Cross-validate further candidates, the most promising first, as long as they can be best and there is time."""
    out = list(validated)
    for c in sorted(candidates, key=lambda c: c.least):
        least = min((e.mean_square for _, e in out), default=np.inf)
        if search.past_deadline:
            break
        known = not c.has_learned and search.findings[c.base.key].held_out is not None
        if out and c.least >= least and not known:
            continue
        found = held_out_errors(search.bench, c.fitted, search.workers) if c.has_learned else search.held_out(c.base)
        if np.isfinite(found.rms) or not search.past_deadline:  # otherwise the time was over before it was known
            out.append((c, ExpectedError(found, c.spread if c.has_learned else search.spread_of(c.base))))
    return out


def _compare(
    search: Search, candidates: Sequence[_Candidate], refit: list[_Validated], wanted: _Candidate | None = None
) -> list[_Validated]:
    """Cross-validate candidates beside the refit; empty if the time ended before any of them, or a wanted one, was.

    A wanted candidate that cannot be best need not be cross-validated.
    """
    validated = _cross_validate(search, candidates, refit)
    least = min((e.mean_square for _, e in validated), default=np.inf)
    left_out = wanted is not None and wanted.least < least and all(c is not wanted for c, _ in validated)
    return [] if search.past_deadline and (len(validated) < 2 or left_out) else validated


def _far_better(search: Search, candidates: Sequence[_Candidate]) -> Trial:
    """Return the hypothesis with the least expected error if the refit is not near it, else the refit."""
    best = min(candidates, key=lambda c: c.least, default=None)
    near = best is None or NEAR_RATIO**2 * best.least > search.root.mean_square
    return search.root if best is None or near else best.base


def _choose(validated: Sequence[_Validated], sure: frozenset[Name] = frozenset()) -> _Validated:
    """Choose the candidate with the smallest expected error on other recordings, or one with fewer laws.

    The smallest of many errors is small by chance as well. So a candidate with fewer laws, and all those whose names
    are sure, is chosen if its errors on the held-out blocks are not clearly larger (`HeldOut.clearly_above`); of those
    with the fewest, the best. None of them has more laws than another one, such as the refit, and a larger expected
    error as well: on the blocks alone it may look good, and fail on the second halves.
    """
    best = min(validated, key=lambda p: p[1].mean_square)
    fewer = [p for p in validated if p[0].elements < best[0].elements and sure <= p[0].base.names]
    plainer = [
        p
        for p in fewer
        if not p[1].held_out.clearly_above(best[1].held_out)
        and not any(q[0].elements < p[0].elements and q[1].mean_square <= p[1].mean_square for q in fewer)
    ]
    return min(plainer, key=lambda p: (p[0].elements, p[1].mean_square), default=best)


def _named_hypotheses(search: Search, answer: Posterior) -> list[Trial]:
    """List the likeliest hypothesis, and the one without the effects whose names are not certain."""
    sure = _sure_names(answer)
    fewer = hypotheses_named(search, sure) if sure else []
    tried = {t.key: t for t in (answer.best, *sorted(fewer, key=lambda t: t.mean_square)[:1])}
    return [search.thorough(t) for t in tried.values()]


def _sure_names(answer: Posterior) -> frozenset[Name]:
    return frozenset(e.name for e in answer.effects if e.confidence > SURE)


def _likely_hypotheses(search: Search, sure: frozenset[Name] = frozenset()) -> list[Trial]:
    """List the likeliest hypotheses with the sure names and laws that may recur; of those not polished, only a few."""
    recurring = [t for t in search.memo.values() if sure <= t.names and _may_recur(search, t)]
    likely = sorted(likeliest(recurring, search.optimistic_evidence), key=search.evidence, reverse=True)
    return [t for i, t in enumerate(t for t in likely if t.laws) if t.thorough or i < FEW]


def _polish(search: Search, trials: Sequence[Trial]) -> list[_Candidate]:
    """Make candidates of hypotheses, fitted to convergence.

    Hypotheses that run away at a held input are left out, though their laws may be right where the recordings are.
    """
    found = list[Trial]()
    for trial in trials:
        with suppress(InputError):
            found.append(search.thorough(trial))
    finite = (t for t in found if np.isfinite(t.mean_square))
    return [_Candidate.of(search, t) for t in finite if not runs_away(search.bench, t.fitted, search.without)]


def _learned_candidates(search: Search, base: Trial, taken: Collection[str] = ()) -> list[_Candidate]:
    """Make the candidate with the best learned force beside a trial at a port that is not taken, if there is one.

    If an input scales a part of it, so that it has twice as many weights, the best found without that competes as well.
    After the deadline no further force is fitted.
    """
    if search.past_deadline:
        return []
    free = [f for f in search.learned(base) if f.simulator.elements[-1].port not in taken]
    plain = [f for f in free if not f.simulator.elements[-1].law.factor]
    out = list[_Candidate]()
    for found in dict.fromkeys((*free[:1], *plain[:1])):
        with suppress(InputError):  # it diverges
            out.append(_Candidate.of(search, base, refit_learned(search.bench, found)))
    return out


def uncompared_correction(search: Search, fitted: Fitted, floor: Floor | None = None) -> Correction:
    """Describe a simulator without a learned element, which was not compared with others."""
    return _describe(search, fitted, _shares(search, fitted, fitted, floor or search.floor))


def _may_recur(search: Search, trial: Trial) -> bool:
    """Tell whether a hypothesis may hold for another recording; a trend in time within one recording may not."""
    return len(search.bench.recordings) > 1 or not any("t" in e.law.reads() for e in trial.laws)


def _shares(search: Search, named: Fitted, whole: Fitted, floor: Floor) -> dict[str, float]:
    """Compute the shares of the refit's mean square error above the noise; all are zero if there is none."""
    if not search.root.mean_square > search.bench.pool(floor.squares(search.bench.scale)):
        return {"named": 0.0, "learned": 0.0, "left": 0.0}
    beside_names, left = (share_left(search, f, floor=floor) for f in (named, whole))
    left = min(beside_names, left)
    return {"named": 1 - beside_names, "learned": beside_names - left, "left": left}


def _describe(search: Search, fitted: Fitted, shares: dict[str, float]) -> Correction:
    """Describe a simulator by the elements that the diagnosis has added."""
    elements = tuple((e.port, e.law.id, e.law.form) for e in search.added_laws(fitted))
    return Correction(elements, shares, offsets=search.offsets)
