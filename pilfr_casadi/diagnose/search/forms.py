"""Fits of laws beside a hypothesis, kept and noted as a move, and fits of the law that was added in other forms.

Other forms of a law are finer ones, a strength that varies with a signal, and a place before the other laws of its
signal. A parameter of the simulator that varies may in turn stand for a law whose parameters are constant.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from ..._base import side_by_side
from ...laws import (
    LINEAR,
    SCALABLE,
    VARIATIONS,
    Law,
    Local,
    VaryingParameter,
    constant,
    heated,
    likely_profiles,
    related_forms,
    scheduled,
    unit_forces,
    varying,
)
from ...simulators import PARAMETER, Placed, in_series, kind_of
from ..faults.gates import EQUAL_RATIO
from ..fits.evidence import FAR_RATIO, NEAR_RATIO
from ..fits.force_recovery import forces_of_change, signals_along
from ..fits.linearise import port_signals
from ..fits.screen import HUGE, Pair, Scored, fit_shapes, orthonormal, project_off, screen, start_values, usable
from ..fits.workbench import DIVERGED, FEW, Workbench
from .hypotheses import Hypotheses
from .pairs import complements
from .trials import Effort, Key, Trial, place_law, select_pairs

T = TypeVar("T")
R = TypeVar("R")

MOST_CONVERGED = 5  # trials of a move that are fitted to convergence at most
# mean square of an earlier fit, over that of a law, from which a form that is so related to the law is fitted again
REFIT_RATIO = {"finer": EQUAL_RATIO, "plainer": NEAR_RATIO**2 * EQUAL_RATIO, "other": np.inf}
MATCHED_SAMPLES = 4000  # approximate number of samples on which a law is matched to a force


@dataclass(frozen=True, eq=False)
class Move:
    """One move of the search: its parent hypothesis, the screen's scores, and the trials, best first."""

    parent: Trial
    scored: tuple[Scored, ...]
    trials: tuple[Trial, ...]


@dataclass(eq=False, repr=False)
class Forms(Hypotheses):
    """Hypotheses, and the moves from one to others by fits of further laws or of other forms."""

    moves: list[Move] = field(default_factory=list)  # the moves, in their order

    @property
    def moves_by_parent(self) -> list[Move]:
        """The moves, those from one hypothesis together, with the best fit of each trial once, smallest error first."""
        found = dict[Key, tuple[Trial, dict[Key, Trial]]]()
        for move in self.moves:
            own = found.setdefault(move.parent.key, (move.parent, {}))[1]
            own |= {t.key: self.memo.get(t.key, t) for t in move.trials}
        ranked = ((parent, sorted(trials.values(), key=lambda t: t.error)) for parent, trials in found.values())
        return [Move(parent, (), tuple(trials)) for parent, trials in ranked if trials]

    def addable(self, parent: Trial) -> tuple[list[Scored], np.ndarray | None]:
        """Return what was screened beside a hypothesis and may stand beside its laws, and the observer's gain."""
        scored, observer_gain = self.screened(parent)
        return [s for s in scored if may_stand_beside(parent.laws, s.port, s.law)], observer_gain

    def fit_selected(self, parent: Trial, scored: Sequence[Scored], effort: Effort) -> list[Trial]:
        """Fit the pairs of port and law that are worth it beside a hypothesis, the smallest error first."""
        began = time.perf_counter()
        stage = f"fits, effect {len(parent.laws) + 1}" if parent.laws else "fits"
        pairs = select_pairs(scored, effort.few)
        trials, tried = self.fits.fit_pairs(parent, pairs, effort, partial(self.say, stage))
        if not parent.laws:
            self.tried, self.selected = self.tried + tried, self.selected + len(pairs)
        self.times["fits"] = self.times.get("fits", 0.0) + time.perf_counter() - began
        for trial in trials[:FEW] if self.interrupted else ():
            self.keep(trial)
        self.bench.interrupt.raise_pending()
        return trials

    def record(self, parent: Trial, scored: Sequence[Scored], trials: Sequence[Trial]) -> None:
        """Keep the trials of a move, and note the move."""
        self.keep_all(trials)
        self.moves.append(Move(parent, tuple(scored), tuple(trials)))

    def try_beside(self, base: Trial, entries: Sequence[Scored], observer_gain: np.ndarray | None = None) -> None:
        """Fit a few pairs beside a hypothesis, none far behind one whose error is at the noise, and note the move."""
        effort = Effort(observer_gain, float(np.sqrt(self.floor2)), few=True)
        self.record(base, entries, self.fit_selected(base, entries, effort))

    def keep_all(self, trials: Sequence[Trial]) -> None:
        """Keep trials, and fit those that may win to convergence."""
        for trial in trials:
            self.keep(trial)
        kept = {t.key: self.memo[t.key] for t in trials}.values()
        ranked = sorted(kept, key=self.optimistic_evidence, reverse=True)
        most = min(NEAR_RATIO * ranked[0].error if ranked else np.inf, FAR_RATIO * self.best.error)
        # after the time of the search, the rest is for the comparison with the refit
        count = MOST_CONVERGED if time.perf_counter() < self.until else 1
        # where a brief fit follows the part that it was made to, the rest may only lack convergence
        near = [t for t in ranked[:count] if not t.thorough and min(t.mean_square, t.part_mean_square) < most**2]
        converged = self.on_workers(self.fits.converge, near)
        converged += filter(None, self.on_workers(self._reorder, converged))
        for trial in converged:
            self.keep(trial)
        # finer steps are slow, and bring no hypothesis that is far behind to the front
        least = min([t.error for t in (*converged, self.best)])
        near = [t for t in converged if t.error < NEAR_RATIO * least]
        for trial in self.on_workers(self.fits.refine_knee, near):
            self.keep(trial)

    def _reorder(self, trial: Trial) -> Trial | None:
        """Fit a hypothesis with its added law before the others of the same signal.

        A curve behind a lag is not a lag behind a curve (Wiener and Hammerstein models). Only linear laws commute.
        """
        added, laws = trial.element, [e for e in trial.laws if e is not trial.element]
        first = next(e for e in trial.laws if e.port == added.port)
        if first is added or not in_series(added.port) or (is_filter(added.law) and is_filter(first.law)):
            return None
        laws.insert(laws.index(first), added)
        found = self.run_laws(laws, trial).with_added(trial.pair)
        return self.fits.converge(found) if found.mean_square < DIVERGED else None

    def _best_with_one_more(self, parent: Trial) -> Trial | None:
        """Return the best hypothesis if it has one law more than a parent, with that as the added one."""
        best = self.best
        added = best.key - parent.key
        return best.with_added(*added) if len(added) == 1 and parent.key < best.key else None

    def refine_added(self, parent: Trial) -> None:
        """Fit the best law of a move in related forms; then schedule the strength of the best law that allows it."""
        best = self._best_with_one_more(parent)
        if best is not None:
            self.fit_related_forms(best)
        self._vary_strength()
        best = self._best_with_one_more(parent)
        by = (best.law.scheduled_by or best.law.scaled_by) if best is not None else ""
        if best is not None and by and "parallel" in best.law.places and self.may_go_on():
            kind = constant(type(best.law))
            self.fit_forms(best, [scheduled(kind, by, p) for p in likely_profiles(kind) if p != best.law.profile])
        self.replace_variation(parent)

    def fit_related_forms(self, trial: Trial) -> None:
        """Fit a hypothesis with its added law in each form that extends it, and as its base class, the plainer law.

        A form that was fitted before is fitted again if that fit was in a wrong minimum: it contains the law and
        follows worse, or it is the plainer law and far worse.
        """
        port, others, kinds = self.bench.simulator.port(trial.port), trial.key - {trial.pair}, []
        for kind, relation in related_forms(type(trial.law), self.laws).items():
            known = self.memo.get(others | {(trial.port, kind)})
            if port.admits(kind) and (known is None or known.mean_square > REFIT_RATIO[relation] * trial.mean_square):
                kinds.append(kind)
        self.fit_forms(trial, kinds)

    def _vary_strength(self) -> None:
        """Let the strength of the likeliest law of the last move that may vary do so, with every signal.

        With the signal found, its other forms may be the physics. A linear law was screened with every signal.
        """
        may_vary = [kind for kind in SCALABLE if kind.id not in LINEAR]
        added = [t for t in self.moves[-1].trials if constant(type(t.law)) in may_vary]
        kept = [self.memo[t.key].with_added(t.pair) for t in added]  # perhaps found before in another order
        # a force that varies with a signal is in no flexible force, so that its rest may have passed for noise
        if not kept or not self.can_improve(self.best, self.least_floor) or not self.may_go_on():
            return
        likeliest = max(kept, key=self.optimistic_evidence)
        forms = [t for t in kept if t.law.id == likeliest.law.id and t is not likeliest]
        entry = self._entry(likeliest)
        self._vary([likeliest], ("z", *entry.local.inputs) if entry else ())
        if self.best.laws and self.best.law.scheduled_by:
            self._vary(forms, (self.best.law.scheduled_by,))

    def _vary(self, trials: Sequence[Trial], signals: Sequence[str]) -> None:
        """Fit hypotheses with the strength of their added law varying with each signal."""
        for trial in trials:
            kind = constant(type(trial.law))
            self.fit_forms(trial, [scheduled(kind, by, likely_profiles(kind)[0]) for by in signals])

    def _entry(self, trial: Trial) -> Scored | None:
        """Return how the added law of a trial, or another with the same sense, was first screened at its port.

        None if none was there: the hypothesis comes from another search.
        """
        there = [s for move in self.moves for s in move.scored if s.port == trial.port]
        return min(there, key=lambda s: s.law.dissipative != trial.law.dissipative, default=None)

    def _sense(self, port: str, kind: type[Law]) -> int:
        """Return the sign of a law's strengths with which it was screened at a port; 0 if it was not, or has none."""
        return next((s.sense for move in self.moves for s in move.scored if s.pair == (port, kind)), 0)

    def fit_forms(self, trial: Trial, kinds: Sequence[Any]) -> None:
        """Fit a hypothesis with its added law in other forms, which start from its values and oppose motion alike.

        The law keeps its place, because laws of one signal act one after the other.
        """
        entry, base, law = self._entry(trial), trial.fitted, trial.law
        if entry is None or not kinds:
            return
        if law.dissipative and not entry.sense:
            total = sum(np.sum(trial.own[name]) for name in law.strength if name not in law.signed)
            entry = replace(entry, sense=int(np.sign(total)))
        index = base.simulator.elements.index(trial.element)
        bare = base.simulator.without_element(index)

        def fit(kind: Any) -> Trial | None:
            starts = list(kind.finer_starts(trial.law.at(trial.own), entry.local))
            sense = entry.sense if law.dissipative else self._sense(trial.port, constant(kind))
            placed = [place_law(bare, replace(entry, law=kind(), sense=sense), own, index) for own in starts]
            values = [{**base.values, **named} for _, named in placed]
            found = self.fits.fit(placed[0][0], values, len(trial.laws), states=base.begin)
            return found and found.with_added((trial.port, kind))

        found = self.on_workers(fit, [kind for kind in kinds if usable(kind(), entry.local)])
        self.keep_all([t for t in found if t is not None])

    def vary_parameters(self, base: Trial) -> None:
        """Let parameters of the simulator vary with a signal beside a hypothesis: fit those that explain most."""
        formulas_leave = self.may_leave()  # no machine follows one exactly
        known = self.findings[base.key]
        if VaryingParameter not in self.laws or self.best.mean_square < formulas_leave or known.varied:
            return
        known.varied = True
        signals = ("t", *self.bench.simulator.inputs, *self.bench.simulator.states)
        laws = [varying(by, profile) for by in dict.fromkeys(signals) for profile in VARIATIONS[:2]]
        laws += [heated(by) for by in dict.fromkeys(signals[1:])]
        with self.stage("varying parameters"):
            scored, observer_gain = screen(self.bench, base.fitted, laws, self.floor.deviation, self.workers)
            self.note_alternatives(scored)
        best = list(dict.fromkeys((s.port, s.law.form) for s in scored))[:FEW]
        taken = {e.port for e in base.laws}
        entries = [s for s in scored if (s.port, s.law.form) in best and s.port not in taken]
        if not entries:
            return
        self.try_beside(base, entries, observer_gain)
        self.replace_variation(base)
        found = self.best
        if found.laws and kind_of(found.port) == PARAMETER and found.law.scheduled_by:
            self._curve(base, [s for s in entries if s.pair == found.pair], observer_gain)

    def replace_variation(self, base: Trial) -> None:
        """Fit laws with constant parameters whose force is like that of the law that the best hypothesis lets vary."""
        best = self.best
        known = self.findings[best.key]
        if known.replaced or not best.laws or best.key - base.key != {best.pair} or base.key - best.key:
            return
        if not best.law.scheduled_by or not self.may_go_on():
            return
        known.replaced = True
        entries = in_place_of_variation(self.bench, best, self.addable(base)[0])
        if entries:
            self.try_beside(base, entries)

    def _curve(self, base: Trial, entries: Sequence[Scored], observer_gain: np.ndarray | None) -> None:
        """Let the parameter that varies in the best hypothesis follow a curve of higher degree."""
        best = self.best
        # what the curve misses is in no force at a port, so that it may have passed for noise
        if not (self.can_improve(best, self.least_floor) and self.may_go_on()):
            return
        law: Any = varying(best.law.scheduled_by, VARIATIONS[-1])()
        finer = [replace(s, law=law, starts=(law.starts_as(best.law, best.own),)) for s in entries]
        self.note_alternatives(finer)
        self.try_beside(base, finer, observer_gain)

    def on_workers(self, fit: Callable[[T], R], tasks: Iterable[T]) -> list[R]:
        """Carry out fits on the workers, in order; an interrupt of one ends all."""
        return side_by_side(fit, tasks, self.workers, self.bench.interrupt)


def is_filter(law: Law) -> bool:
    """Tell whether a law of a signal is a lag, a mode or a delay."""
    return bool(law.order or law.shifts)


def may_stand_beside(laws: Sequence[Placed], port: str, law: Law) -> bool:
    """Tell whether a law at a port may be a further effect beside some laws."""
    return all(e.port != port or complements(e.law, law) for e in laws)


def in_place_of_variation(bench: Workbench, best: Trial, scored: Sequence[Scored]) -> list[Scored]:
    """Select laws with constant parameters, no more of them, whose force is most like that of a law that varies.

    The added law of the best hypothesis varies with a signal. If it is a parameter, its change acts at some ports as a
    force: a stiffness that varies with its own deflection is a stiffening spring. The laws start at their values there,
    and everything else where the best hypothesis has it.
    """
    fitted, most = best.fitted, best.law.size(best.own)
    force = signals_along(bench, fitted, fitted.simulator.elements.index(best.element))[2]
    varied = kind_of(best.port) == PARAMETER
    forces = forces_of_change(bench, fitted, best.port, force) if varied else {best.port: force}
    local = {port: port_signals(bench, fitted, port) for port in forces}
    # also excludes nan, for example from the root of a negative number
    bounded = {k for k, v in local.items() if np.all(np.abs([v.z, v.dz, forces[k]]) < HUGE)}
    found = dict[Pair, tuple[float, Scored]]()
    for s in (s for s in scored if s.port in bounded and s.law.size(s.starts[0]) <= most):
        if not (s.pair in found or s.law.flexible or s.law.scheduled_by or s.law.scaled_by):
            left, start = _match_force(s.law, local[s.port], forces[s.port])
            found[s.pair] = left, replace(s, starts=(start, *s.starts), beside=fitted.values)
    ranked = sorted((f for f in found.values() if f[0] < 1), key=lambda f: f[0])
    return [entry for _, entry in ranked[:FEW]]


@np.errstate(over="ignore", invalid="ignore")
def _match_force(law: Law, local: Local, force: np.ndarray) -> tuple[float, dict[str, Any]]:
    """Compute the share of a force that a law leaves, beside gains of the signal and its rate, and its start values."""
    shapes = list(law.shapes(local))
    every = max(len(force) // MATCHED_SAMPLES, 1)
    base = orthonormal(np.column_stack([np.ones_like(local.z), local.z, local.dz])[::every])
    target = project_off(force[::every], base)
    best, start = np.inf, dict[str, Any]()
    columns = np.moveaxis(unit_forces(law, local, shapes)[::every], 1, 0)
    for k, strengths, fit in fit_shapes((project_off(a, base) for a in columns), target):
        if not law.strength and strengths[0] <= 0:  # the simulator's gain may scale the force, but not change its sign
            continue
        left = float(np.sum((target - fit) ** 2)) / max(float(target @ target), 1e-300)
        if left < best:
            best, start = left, start_values(law, shapes[k], strengths)
    return best, start
