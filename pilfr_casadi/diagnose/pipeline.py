"""The diagnosis, step by step; read `diagnose_in_steps` to see how an answer comes about."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, Stages, one_blas_thread, processors, whole
from ..data import Recording
from ..laws import Law, readable_unit
from ..simulators import Simulator
from .arguments import check_laws, check_limits, matched, matched_tests, with_scaled
from .blind_spots import BlindSpot
from .checkup import assess
from .correction import Correction, as_named, find_correction
from .experiment import next_experiment, placebo
from .gates import Gate, hold_note, said_hold
from .mismatch_map import mismatch
from .offset import Offset, as_it_came_out, offset_gates, without_idle_offsets
from .other_explanations import beyond_the_ports, held_value, varying
from .posterior import Named, names, posterior
from .preparation import CHECKS, Prepared, prepare
from .proof import deviations, mean_nrmse, parameter_table, test_errors
from .recording_faults import clipped_input
from .residual_spectrum import tones
from .result import Diagnosis, Effect
from .search import Search
from .surrogates import told_of_surrogate
from .trials import Trial
from .verdict import SURE, Verdict, judge
from .workbench import Fitted

FURTHER = 0.5  # share of the mean square that is left at most where a channel that seemed early is not
SEARCHING = 0.7  # of the time that is left, for the search; the rest is for the correction


@dataclass(frozen=True, eq=False)
class Asked:
    """What is diagnosed, and how; see `diagnose`."""

    simulator: Simulator
    recordings: Sequence[Recording]
    laws: Sequence[type[Law]]
    hold: str | None
    engine: str
    workers: int
    effects: float
    stand_in_error: float
    end: float
    say: Stages

    @property
    def hold_said(self) -> bool:
        """Whether somebody said what inputs do between samples."""
        return said_hold(self.simulator, self.recordings, self.hold) is not None


@dataclass(frozen=True, eq=False)
class Found:
    """What a search came to.

    Attributes
    ----------
    fitted : Fitted
        The simulator with what was found, or refitted where nothing was.
    effects : tuple of Named
        The effects that are named.
    correction : Correction
        What `fitted` consists of beside the refit.
    let_go : str
        The held parameter that does what a law was named for.
    """

    verdict: Verdict
    gates: tuple[Gate, ...]
    fitted: Fitted
    correction: Correction
    effects: tuple[Named, ...] = ()
    let_go: str = ""


@one_blas_thread
def diagnose_in_steps(
    simulator: Any,
    train: Recording | Sequence[Recording],
    *,
    test: Recording | Sequence[Recording] | None,
    hold: str | None,
    laws: Sequence[type[Law]] | None,
    effects: int | None,
    limits: Mapping[str, float] | None,
    workers: int | None,
    engine: str,
    stand_in_error: float,
    time_limit: float | None,
    progress: Progress | None,
) -> Diagnosis:
    """Carry out `diagnose`, whose parameters these are."""
    began = time.perf_counter()
    workers = min(processors(), 4) if workers is None else whole(workers, "workers", 1)
    most = np.inf if effects is None else whole(effects, "effects", 0)
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"time_limit={time_limit!r} was given; give seconds, a positive number.")
    say = Stages(progress or (lambda stage, done, total, best: None))
    simulator, recordings = matched(simulator, train, hold)
    tests = matched_tests(simulator, test, recordings)
    check_limits(simulator, limits)
    tried = with_scaled(check_laws(laws), simulator)
    end = np.inf if time_limit is None else began + float(time_limit)
    asked = Asked(simulator, recordings, tried, hold, engine, workers, most, stand_in_error, end, say)
    ready, search = _searched_both_holds(asked)
    ended = search.begin("conclusion")
    found = conclude(search, (*ready.gates, *search.gates))
    search.timed("conclusion", ended)
    return _build_diagnosis(asked, ready, search, found, tests, limits, began)


def conclude(search: Search, gates: Sequence[Gate]) -> Found:
    """Weigh all hypotheses, and look for a value that is held or an input that was clipped in place of a law."""
    answer, root = posterior(search), search.root.fitted
    gates, refit = (*gates, *tones(search.bench, answer.best.fitted)), as_named(search, root)
    verdict = judge(search, answer, gates)
    interrupted = search.interrupted
    unfinished = interrupted or search.out_of_time  # what comes below only adds to an answer that is there
    if verdict.kind in ("missing-physics", "unexplained") and not unfinished:
        held = held_value(search, answer)
        if held is not None:
            fitted = held.fitted
            return Found(Verdict("complete", held.sentence), gates, fitted, as_named(search, fitted), (), held.name)
        if verdict.kind == "unexplained" or answer.sure < SURE:
            left = answer.best.whole / search.root.whole if verdict.kind == "missing-physics" else 1.0
            lost = clipped_input(search.bench, root, left)
            if lost is not None:
                return Found(Verdict("recording-fault", lost.sentence), (*gates, lost), root, refit)
    if verdict.kind == "missing-physics":
        correction, fitted = find_correction(search, answer, named=True)
        kept = {(e.port, e.law.id, e.law.form) for e in answer.best.laws} <= set(correction.elements)
        answer = answer.beside_learned(correction.shares["learned"] if kept else 1.0)
        verdict = judge(search, answer, gates)
        if verdict.kind == "missing-physics":
            said = f"{verdict.sentence} {correction.sentence}" if correction.learned else verdict.sentence
            beside = offset_gates(answer.best.laws, answer.best.fitted.values)
            return Found(Verdict(verdict.kind, said), (*gates, *beside), fitted, correction, answer.effects)
    if verdict.kind == "unexplained" and not unfinished:
        gates = (*gates, *beyond_the_ports(search), *varying(search))
    if interrupted and verdict.kind != "recording-fault":
        sentence = (
            "The search was interrupted before it came to an answer; refitted, the simulator is off by "
            f"{mean_nrmse(search.bench, root):.3g} of the outputs' deviation."
        )
        return Found(Verdict(verdict.kind, sentence), gates, root, refit)
    if verdict.kind == "unexplained" and not search.interrupted:
        correction, fitted = find_correction(search, answer)
        return Found(Verdict(verdict.kind, f"{verdict.sentence} {correction.sentence}"), gates, fitted, correction)
    return Found(verdict, gates, root, refit)


def _searched_both_holds(asked: Asked) -> tuple[Prepared, Search]:
    """The search; where nobody said what inputs do between samples and it matters, the likelier of both holds."""
    ready, search = _searched(asked)
    if search.interrupted or not search.misheld():
        return ready, search
    hold = search.bench.otherwise_held().hold
    try:
        other, again = _searched(replace(asked, hold=hold, say=asked.say.under("other hold: ")))
    except InputError:  # it cannot be run so
        return ready, search.settled(asked.effects)
    if again.best.whole > search.best.whole or (again.interrupted and len(again.memo) < 2):
        search.interrupted = again.interrupted
        return ready, search.settled(asked.effects)
    ratio = float(np.sqrt(search.best.whole / max(again.best.whole, 1e-300)))
    return replace(other, gates=(*other.gates, hold_note(asked.simulator, hold, ratio))), again


def _searched(asked: Asked, early: bool = True) -> tuple[Prepared, Search]:
    """Preparation and search; both anew where a channel that seemed early was a sign of something else."""
    began = time.perf_counter()
    ready = prepare(
        asked.simulator, asked.recordings, asked.hold, asked.engine, asked.workers, (), early, say=asked.say
    )
    floor = ready.floor.beside(asked.stand_in_error * ready.bench.scale) if asked.stand_in_error else ready.floor
    search = Search(
        ready.bench,
        ready.without,
        floor,
        (*asked.laws, Offset),
        asked.workers,
        asked.say,
        hold_said=asked.hold_said,
        stand_in_error=asked.stand_in_error,
        until=began + SEARCHING * (asked.end - began),
        end=asked.end,
        times={CHECKS: time.perf_counter() - began},
    )
    search.run(asked.effects)
    seemed_early = any(g.finding == "alignment" and g.value < 0 for g in ready.gates)
    if early and seemed_early and not (search.interrupted or search.out_of_time) and search.room(search.best):
        other = _searched(asked, early=False)
        if other[1].best.whole < FURTHER * search.best.whole:
            return other
    return ready, search


def _build_diagnosis(
    asked: Asked,
    ready: Prepared,
    search: Search,
    found: Found,
    tests: tuple[Recording, ...],
    limits: Mapping[str, float] | None,
    began: float,
) -> Diagnosis:
    """Put the search's conclusion and its proof into a Diagnosis."""
    proving = time.perf_counter()
    asked.say("proof", 0, 1)
    bench, without, after = search.bench, search.root.fitted, found.fitted
    if found.effects and not np.isfinite(found.correction.after):  # else it is what has predicted best
        after = without_idle_offsets(bench, after)
    std = deviations(bench, after)
    errors = {
        "train": {"nominal": ready.nominal, "before": mean_nrmse(bench, without), "after": mean_nrmse(bench, after)},
        "test": test_errors(bench, tests, found.gates, asked.simulator, without, after) if tests else None,
    }
    effects = tuple(_effect(search, e, after, std) for e in found.effects)
    settled = found.verdict.kind in ("complete", "recording-fault") or (
        min((e.confidence for e in effects), default=0) > SURE
    )
    experiment = _next(search, found.effects, limits)
    asked.say("proof", 1, 1)
    now = time.perf_counter()
    return Diagnosis(
        verdict=found.verdict.kind,
        sentence=found.verdict.sentence,
        effects=effects,
        candidates=tuple(
            _row(search, search.memo.get(t.key, t), step.parent) for step in search.steps for t in step.trials
        ),
        gates=(
            *told_of_surrogate(asked.stand_in_error),
            *as_it_came_out(found.gates, after, std, bool(effects), settled),
        ),
        mismatch=mismatch(
            bench.recordings,
            without.residual,
            [e + r.y for e, r in zip(without.residual, bench.recordings, strict=True)],
            search.floor.deviation,
            bench.scale,
        ),
        parameters=parameter_table(asked.simulator, without, after, std),
        errors=errors,
        floor={"nrmse": search.floor.nrmse(bench.scale), "source": search.floor.source},
        corrected=after.corrected(),
        refitted=without.corrected(),
        hold=bench.hold,
        train=bench.recordings,
        test=tests,
        next_experiment=experiment,
        seconds=now - began,
        times={**search.times, "proof": now - proving},
        interrupted=search.interrupted,
        out_of_time=search.out_of_time,
        evidence={"search": search, "without": without, "after": after},
        substeps=after.model.substeps,
        let_go=found.let_go,
        correction=found.correction,
        blind_spots=_blind_spots(asked, search),
    )


def _blind_spots(asked: Asked, search: Search) -> tuple[BlindSpot, ...]:
    """What the recordings cannot reveal of the refitted simulator; nothing where that cannot be told."""
    bench = search.bench
    with suppress(InputError, np.linalg.LinAlgError):
        return assess(bench, search.root.fitted, bench.hold if asked.hold_said else "").blind_spots
    return ()


def _effect(search: Search, named: Named, fitted: Fitted, std: dict[str, np.ndarray]) -> Effect:
    bench, law = search.bench, named.element.law
    own, unrelated = placebo(bench, search.root.fitted, named.element.port, law)
    element = next(e for e in fitted.simulator.elements if e.port == named.element.port and type(e.law) is type(law))
    port = bench.simulator.port(element.port)
    w_unit, z_unit = port.unit, port.across_unit
    if port.series:  # what it is in series with
        channel = port.name.partition(":")[2]
        w_unit = z_unit = bench.recordings[0].units.get(channel) or f"[{channel}]"
    values = {k: v for k, v in fitted.values.items() if k.startswith(element.prefix)}
    shown: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        unit = readable_unit(element.law.units[name.removeprefix(element.prefix)], w_unit, z_unit)
        flat = np.ravel(value)
        for i, v in enumerate(flat):
            label = name.removeprefix(element.prefix) + (f"[{i}]" if len(flat) > 1 else "")
            error = float(np.ravel(std[name])[i])
            shown[label] = {"value": float(v), "std": error if np.isfinite(error) else None, "unit": unit}
    return Effect(
        port=element.port,
        law=law.id,
        confidence=named.confidence,
        sentence=law.sentence,
        equation=law.equation,
        parameters=shown,
        indistinguishable=tuple(named.alike),
        form=law.form,
        placebo={"own": own, "unrelated": unrelated},
    )


def _next(search: Search, effects: Sequence[Named], limits: Mapping[str, float] | None) -> dict[str, Any] | None:
    """The experiment that would separate the first tie, where there is one."""
    for effect in effects:
        if effect.alike:
            name, other = next(iter(effect.alike.items()))
            one = max((t for t in search.memo.values() if effect.name in names(t)), key=search.evidence)
            best = next_experiment(search.bench, one.fitted, other.fitted, search.floor.deviation, limits)
            tied = [list(effect.name), list(name)]
            if best is not None:
                return {"between": tied, **best}
            sentence = "No sine or triangle within the allowed amplitude separates them beyond the noise."
            return {"between": tied, "sentence": sentence}
    return None


def _row(search: Search, t: Trial, parent: Trial) -> dict[str, Any]:
    """A candidate as in diagnosis.json."""
    held_out = search.held_out.get(t.key)
    gain = search.evidence(t) - search.evidence(parent)
    return {
        "port": t.port,
        "law": t.law.id,
        "form": t.law.form,
        "nrmse_train": t.error,
        "nrmse_validation": held_out.error if held_out and np.isfinite(held_out.error) else None,
        "delta_bic": -2 * gain,
    }
