"""The diagnosis, step by step: gates, floor and refit, screen, fits, choice, a second pass, and the proof."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..recording import check_for_identification
from ..gauss_newton import GaussNewton
from ..laws import CATALOGUE, Law, readable_unit
from ..recording import InputError, Recording, as_recordings
from ..simulator import Simulator
from ..threads import one_blas_thread
from .explain import Candidate, explain, judged, polish
from .flexible import explainable
from .floor import Floor, effective_size, measured_floor, white_part
from .gates import Gate, choose_hold, wrong_scale
from .result import Diagnosis, Effect
from .screen import screen
from .verdict import Choice, choose, confidence
from .workbench import THOROUGH, Fitted, Workbench, arranged

Progress = Callable[[str, int, int, float], None]
ROOM = 12.0  # nats by which a law has to improve on the refit to be believed
ENOUGH = 0.35  # share of the excess that a named law may leave


@one_blas_thread
def diagnose(
    simulator: Simulator,
    train: Recording | Sequence[Recording],
    *,
    test: Recording | Sequence[Recording] | None = None,
    hold: str | None = None,
    laws: Sequence[type[Law]] = CATALOGUE,
    effects: int = 2,
    workers: int | None = None,
    engine: str = "auto",
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what a simulator leaves out, from recordings of the machine.

    Parameters
    ----------
    simulator : Simulator
        The simulator, with nominal parameters, bounds and ports.
    train : Recording or sequence of Recording
        What is fitted and chosen on.
    test : Recording or sequence of Recording, optional
        Reported on; never used to fit or to choose.
    hold : {"zero", "linear"}, optional
        What inputs do between samples, where neither recordings nor simulator say.
    laws : sequence of Law classes
        The catalogue.
    effects : int
        Most effects looked for.
    workers : int, optional
        Fits run side by side, by default one a processor, at most four.
    progress : callable
        Called with (stage, done, total, smallest error so far).

    Returns
    -------
    Diagnosis

    Raises
    ------
    InputError
        If simulator and recordings do not fit each other.
    """
    began = time.perf_counter()
    workers = workers or min(os.cpu_count() or 1, 4)
    say = progress or (lambda stage, done, total, best: None)
    recordings = check_for_identification([arranged(simulator, r) for r in as_recordings(train)], 20)
    tests = tuple(arranged(simulator, r) for r in as_recordings(test)) if test is not None else ()
    _check_apart(recordings, tests)
    times: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        times[stage] = times.get(stage, 0.0) + time.perf_counter() - clock
        clock = time.perf_counter()

    say("refit", 0, 1, np.inf)
    hold, gates = choose_hold(simulator, recordings, hold, engine)
    bench = Workbench.of(simulator, recordings, hold, engine)
    nominal = bench_errors(bench, simulator)
    without = bench.fit(simulator, solver=THOROUGH)
    lap("refit")
    if without.cost > 0.06:
        bench, without, more = wrong_scale(bench, without)
        gates += more
        without = bench.fit(bench.simulator, [without.values], solver=THOROUGH)
        lap("gates")
    measured = measured_floor(bench.recordings)
    noise = measured.deviation if measured else white_part(without.residual)
    say("screen", 0, 1, without.cost**0.5)
    steps: list[_Pass] = []
    base = without
    for number in range(max(effects, 1)):
        scored, signs, gain = screen(bench, base, laws, noise)
        lap("screen")
        if number:
            scored = [s for s in scored if s.port != steps[0].choice.winner.port]
        candidates = explain(
            bench, scored, base, signs, gain, workers, lambda i, n, e: say(f"fits {number + 1}", i, n, e)
        )
        lap("fits")
        judged_base = judged_on_head(bench, base)
        if not measured:
            rest = [white_part(c.fitted.residual) for c in candidates[:5]] + [noise]
            noise = np.min(rest, axis=0)
        floor2 = float(np.mean((noise / bench.scale) ** 2))
        candidates = [c if c.error > 2 * candidates[0].error or i > 3 else polish(bench, c) for i, c in enumerate(candidates)]
        best = min(candidates, key=lambda c: c.error, default=None)
        n = effective_size(best.fitted.residual if best else base.residual)
        choice = choose(candidates, judged_base, floor2, max(n, 30.0))
        lap("choice")
        if choice is None or choice.gain < ROOM:
            if not steps:
                steps.append(_Pass(choice, tuple(candidates), scored, judged_base, False)) if choice else None
            break
        if number and choice.remains > ENOUGH:
            break
        steps.append(_Pass(choice, tuple(candidates), scored, judged_base, True))
        base = choice.winner.fitted if np.isfinite(choice.winner.full) else polish(bench, choice.winner).fitted
        if base.cost < 1.05 * floor2 or choice.remains < 0.02:
            break
    open_before, open_after = explainable(bench, without), explainable(bench, base)
    lap("flexible")
    accepted = [s for s in steps if s.accepted]
    verdict, sentence = _verdict(accepted, without, noise, bench, gates)
    named = [_effect(bench, s, base) for s in accepted] if verdict == "missing-physics" else []
    found = base
    if verdict != "missing-physics":
        base = without
    errors = {
        "train": {"nominal": nominal, "before": _nrmse(bench, without), "after": _nrmse(bench, base)},
        "test": _test_errors(bench, tests, simulator, without, base) if tests else None,
    }
    floor = measured or Floor(noise, "estimated")
    lap("proof")
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        effects=tuple(named),
        candidates=tuple(_row(c, s) for s in steps for c in s.candidates),
        gates=tuple(gates),
        mismatch={"sentence": ""},
        parameters=_parameters(simulator, without, base),
        errors=errors,
        floor={"nrmse": floor.nrmse(bench.scale), "source": floor.source},
        corrected=base.corrected(),
        refitted=without.corrected(),
        hold=hold,
        train=bench.recordings,
        test=tests,
        seconds=time.perf_counter() - began,
        times=times,
        evidence={
            "passes": tuple(steps),
            "open_before": open_before,
            "open_after": open_after,
            "without": without,
            "base": found,
            "noise": noise / bench.scale,
            "measured": measured is not None,
        },
    )


@dataclass(frozen=True, eq=False)
class _Pass:
    choice: Choice
    candidates: tuple[Candidate, ...]
    scored: Any
    before: tuple[float, float]
    accepted: bool


def judged_on_head(bench: Workbench, fitted: Fitted) -> tuple[float, float]:
    """Errors of a simulator fitted to the first part only, on both parts."""
    from .explain import heads

    part = bench.on(heads(bench.recordings))
    return judged(bench, part.fit(fitted.simulator, [fitted.values, {}], solver=THOROUGH))


def _verdict(
    accepted: Sequence[_Pass], without: Fitted, noise: np.ndarray, bench: Workbench, gates: Sequence[Gate]
) -> tuple[str, str]:
    faults = [g for g in gates if g.fault]
    floor2 = float(np.mean((noise / bench.scale) ** 2))
    if not accepted:
        if faults:
            return "recording-fault", faults[0].sentence
        if without.cost < 2.0 * floor2:
            return "complete", "Nothing is missing: the refitted simulator follows the recordings down to the noise."
        return "unexplained", "Something is missing, and no law of the catalogue explains it."
    first = accepted[0].choice
    left = accepted[-1].choice.winner.error ** 2
    share = (left - floor2) / max(float(np.sqrt(np.prod(accepted[0].before))) - floor2, 1e-300)
    if share > ENOUGH:
        return (
            "unexplained",
            f"Something is missing, most likely at {first.winner.port}, and no law of the catalogue explains it.",
        )
    words = " and ".join(f"{s.choice.winner.law.id.replace('_', ' ')} at {s.choice.winner.port}" for s in accepted)
    return "missing-physics", f"The simulator leaves out {words}."


def _effect(bench: Workbench, step: _Pass, fitted: Fitted) -> Effect:
    winner, choice = step.choice.winner, step.choice
    element = next(
        e for e in fitted.simulator.elements if e.port == winner.port and type(e.law) is type(winner.law)
    )
    port = bench.simulator.port(winner.port)
    values = {k: v for k, v in fitted.values.items() if k.startswith(element.prefix)}
    shown: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        unit = readable_unit(element.law.units[name.removeprefix(element.prefix)], port.unit, port.across_unit)
        flat = np.ravel(value)
        for i, v in enumerate(flat):
            label = name.removeprefix(element.prefix) + (f"[{i}]" if len(flat) > 1 else "")
            shown[label] = {"value": float(v), "std": None, "unit": unit}
    return Effect(
        port=winner.port,
        law=winner.law.id,
        confidence=confidence(choice),
        sentence=winner.law.sentence,
        equation=winner.law.equation,
        parameters=shown,
        indistinguishable=tuple(c.name for c in choice.alike),
        form=winner.law.form,
    )


def _row(c: Candidate, step: _Pass) -> dict[str, Any]:
    n = 1000.0
    return {
        "port": c.port,
        "law": c.law.id,
        "form": c.law.form,
        "nrmse_train": c.head**0.5,
        "nrmse_validation": c.tail**0.5,
        "delta_bic": n * np.log(c.head / step.before[0]) + c.size * np.log(n),
    }


def _nrmse(bench: Workbench, fitted: Fitted) -> float:
    out = []
    for e, r in zip(fitted.residual, bench.recordings, strict=True):
        out.append(np.mean(np.sqrt(np.mean(e[r.skip :] ** 2, axis=0)) / np.std(r.y[r.skip :], axis=0)))
    return float(np.mean(out))


def bench_errors(bench: Workbench, simulator: Simulator) -> float:
    """NRMSE at given parameters, initial states fitted; infinite where the simulation diverges."""
    held = simulator.with_parameters({k: replace(p, fixed=True) for k, p in simulator.parameters.items()})
    try:
        if all(isinstance(r.initial, str) and r.initial != "estimate" for r in bench.recordings):
            return _nrmse(bench, _plain(bench, held))
        return _nrmse(bench, bench.fit(held, solver=GaussNewton(max_iterations=20)))
    except (InputError, ValueError):
        return np.inf


def _plain(bench: Workbench, simulator: Simulator) -> Fitted:
    model = bench.model(simulator)
    from ..compiled import make_engine

    engine = make_engine(model, bench.engine)
    freed = model.with_parameters(model.parameters.change(**{k: {"fixed": False} for k in model.parameters}))
    problem = bench.problem(freed, engine)
    values = {k: p.value for k, p in model.parameters.items()}
    return bench.result(simulator, values, problem.first_states(problem.start), engine, model)


def _test_errors(
    bench: Workbench, tests: Sequence[Recording], simulator: Simulator, without: Fitted, after: Fitted
) -> dict[str, float]:
    out = {}
    for name, one in (("nominal", simulator), ("before", without.corrected()), ("after", after.corrected())):
        out[name] = bench_errors(bench.on(tests), one)
    return out


def _parameters(simulator: Simulator, without: Fitted, after: Fitted) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "nominal": p.value,
            "refit_without": without.values[name],
            "refit_with": after.values[name],
            "std": None,
            "unit": p.unit,
        }
        for name, p in simulator.parameters.items()
    }


def _check_apart(train: Sequence[Recording], tests: Sequence[Recording]) -> None:
    for r in train:
        for t in tests:
            if len(r) == len(t) and np.array_equal(r.u, t.u) and np.array_equal(r.y, t.y):
                raise InputError("A test recording equals a training recording; give data the fit has not seen.")
