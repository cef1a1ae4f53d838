"""The diagnosis, step by step: gates, floor and refit, screen, fits, choice, a second pass, and the proof."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._base import InputError, Progress, listed, one_blas_thread, processors, whole
from ..data import HOLDS, Recording, as_recordings, check_for_identification
from ..identify import match_channels
from ..laws import CATALOGUE, SCALABLE, Law, readable_unit, scaled
from ..simulators import as_simulator
from .candidate import Candidate
from .choice import Choice
from .conclusion import Conclusion, concluded
from .experiment import next_experiment, placebo
from .first_effect import let_idle_offsets_go
from .mismatch_map import mismatch
from .offset import as_it_came_out
from .other_hold import doubted, otherwise_held
from .preparation import Prepared
from .proof import deviations, mean_nrmse, parameter_table, test_errors
from .result import Diagnosis, Effect
from .search import Pass, Search
from .search_start import Asked, prepared_search
from .stages import Stages
from .surrogates import told_of_surrogate
from .tones import tones
from .verdict import UNSURE, confidence
from .workbench import Fitted


@one_blas_thread
def run_diagnosis(
    simulator: Any,
    train: Recording | Sequence[Recording],
    *,
    test: Recording | Sequence[Recording] | None,
    hold: str | None,
    laws: Sequence[type[Law]] | None,
    effects: int,
    limits: Mapping[str, float] | None,
    workers: int | None,
    engine: str,
    stand_in_error: float,
    progress: Progress | None,
) -> Diagnosis:
    """Carry out `diagnose`, whose parameters these are."""
    began = time.perf_counter()
    workers = min(processors(), 4) if workers is None else whole(workers, "workers", 1)
    effects = whole(effects, "effects", 0)
    if hold not in HOLDS:
        raise InputError(f"hold={hold!r} was given; use 'zero', 'linear' or None.")
    say = Stages(progress or (lambda stage, done, total, best: None))
    simulator = as_simulator(simulator, as_recordings(train))
    recordings = check_for_identification([match_channels(simulator, r) for r in as_recordings(train)], 20)
    tests = tuple(match_channels(simulator, r) for r in as_recordings(test)) if test is not None else ()
    _check_apart(recordings, tests)
    for r in tests:
        if abs(r.dt / recordings[0].dt - 1) > 1e-4:
            raise InputError(
                f"The test recording's step is {r.dt:g} s, the training's {recordings[0].dt:g} s; resample it."
            )
    for name, most in (limits or {}).items():
        if name not in simulator.inputs:
            raise InputError(
                f"A limit was given for {name!r}, which is no input; there are {listed(simulator.inputs)}."
            )
        if not most > 0:
            raise InputError(f"The limit of {name} is {most!r}; give the largest amplitude allowed, a positive number.")
    laws = CATALOGUE if laws is None else tuple(laws)
    for law in laws:
        if not (isinstance(law, type) and issubclass(law, Law)):
            raise InputError(f"laws holds {law!r}; give classes of laws, such as pilfr.laws.CoulombFriction.")
    laws = (*laws, *(scaled(law, by) for law in SCALABLE if law in laws for by in simulator.idle_inputs))
    asked = Asked(simulator, recordings, laws, hold, engine, workers, effects, stand_in_error, say)
    ready, search = prepared_search(asked)
    if not asked.hold_said and doubted(search):
        first, ended = search, time.perf_counter()
        ready, search = otherwise_held(asked, ready, search)
        search.times["the other hold"] = time.perf_counter() - ended if search is first else ended - began
    let_idle_offsets_go(search)
    began_conclusion = search.begin("conclusion")
    found = concluded(search, (*ready.gates, *search.gates, *tones(search.bench, search.base)))
    search.times["conclusion"] = time.perf_counter() - began_conclusion
    say("conclusion", 1, 1)
    say("proof", 0, 1)
    return _build_diagnosis(asked, ready, search, found, tests, limits, began)


def _build_diagnosis(
    asked: Asked,
    ready: Prepared,
    search: Search,
    found: Conclusion,
    tests: tuple[Recording, ...],
    limits: Mapping[str, float] | None,
    began: float,
) -> Diagnosis:
    """Put the search's conclusion and its proof into a Diagnosis."""
    proving = time.perf_counter()
    bench, without, after = search.bench, search.without, found.fitted
    std = deviations(bench, after)
    errors = {
        "train": {"nominal": ready.nominal, "before": mean_nrmse(bench, without), "after": mean_nrmse(bench, after)},
        "test": test_errors(bench, tests, found.gates, asked.simulator, without, after) if tests else None,
    }
    effects = tuple(_effect(search, choice, after, std) for choice in found.named)
    sure = min((e.confidence for e in effects), default=0) > UNSURE
    settled = found.verdict in ("complete", "recording-fault") or sure
    experiment = _next(search, found.named, limits)
    now = time.perf_counter()
    asked.say("proof", 1, 1)
    return Diagnosis(
        verdict=found.verdict,
        sentence=found.sentence,
        effects=effects,
        candidates=tuple(_row(c, p) for p in search.passes for c in p.candidates),
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
        evidence={"search": search, "without": without, "after": after},
        substeps=after.model.substeps,
        let_go=found.let_go,
        correction=found.correction,
    )


def _effect(search: Search, choice: Choice, fitted: Fitted, std: dict[str, np.ndarray]) -> Effect:
    winner, bench = choice.winner, search.bench
    own, unrelated = placebo(bench, search.without, winner.port, winner.law)
    element = next(e for e in fitted.simulator.elements if e.port == winner.port and type(e.law) is type(winner.law))
    port = bench.simulator.port(winner.port)
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
        port=winner.port,
        law=winner.law.id,
        confidence=confidence(choice, search),
        sentence=winner.law.sentence,
        equation=winner.law.equation,
        parameters=shown,
        indistinguishable=(*([choice.common] if choice.common else []), *(c.name for c in choice.alike)),
        form=winner.law.form,
        placebo={"own": own, "unrelated": unrelated},
    )


def _next(search: Search, told: Sequence[Choice], limits: Mapping[str, float] | None) -> dict[str, Any] | None:
    """The experiment that would separate the first tie, where there is one."""
    for choice in told:
        if choice.common:
            sentence = "These inputs do not separate them; look up how the sensors are filtered and sampled."
            return {"between": [list(choice.winner.name), list(choice.common)], "sentence": sentence}
        if choice.alike:
            one, other = choice.winner, choice.alike[0]
            best = next_experiment(search.bench, one.fitted, other.fitted, search.floor.deviation, limits)
            names = [[c.port, c.law.id] for c in (one, other)]
            if best is not None:
                return {"between": names, **best}
            sentence = "No sine or triangle within the allowed amplitude separates them beyond the noise."
            return {"between": names, "sentence": sentence}
    return None


def _row(c: Candidate, step: Pass) -> dict[str, Any]:
    n = step.samples
    return {
        "port": c.port,
        "law": c.law.id,
        "form": c.law.form,
        "nrmse_train": c.head**0.5,
        "nrmse_validation": c.tail**0.5,
        "delta_bic": n * np.log(c.head / step.before[0]) + c.size * np.log(n),
    }


def _check_apart(train: Sequence[Recording], tests: Sequence[Recording]) -> None:
    for r in train:
        for t in tests:
            if len(r) == len(t) and np.array_equal(r.u, t.u) and np.array_equal(r.y, t.y):
                raise InputError("A test recording equals a training recording; give data the fit has not seen.")
