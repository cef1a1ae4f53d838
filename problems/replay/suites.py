"""The suites of the replay: their keys, how each key is answered, and how two answers are compared."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pilfr_casadi as pilfr

from .. import accuracy, bank, concealed, concealed_score, masing_diagnosis, real_machines, speed, table2, zoo
from ..masing_data import benchmark

DIGITS = 10  # of exported steps
SHORT_TABLE = ["--rows", "LTI", "N=5, paper", "nx=5, n=5", "--starts", "2", "--network-starts", "1", "--workers", "1"]
ACCURACY = [(operators, seed) for operators in (20, 10) for seed in (0, 1)]
EXPORTS = ("casadi", "smooth", "control", "diagnosis")
FIRST_NAME = ("verdict_right", "port", "law", "both", "channel", "ratio")
MARKS = (*FIRST_NAME, "answer", "finding", "fault_kind", "wrong_fault", "sure_wrong", "certainties")
DIAGNOSES = ("cases", "bank", "machines")  # suites whose answers are diagnoses
ON_REQUEST = ("bank",)  # suites that take hours
Answer = dict[str, Any]
# Concealed cases whose answers have been looked at before, balanced over kinds, rigs and laws.
SEED_LIST = """
4330 4331 4332 4333 4334 4335 4336 4337 4338 4339 4340 4341 4342 4343 4344 4345 4346 4347 4349 4350
4351 4352 4353 4354 4355 4356 4357 4358 4359 4360 4361 4362 4363 4364 4366 4369 4371 4372 4373 4374
4375 4376 4377 4378 4380 4381 4383 4384 4385 4386 4388 4390 4392 4395 4396 4400 4401 4402 4403 4405
4408 4409 4411 4412 4415 4416 4417 4418 4419 4420 4421 4423 4426 4429 4431 4433 4437 4438 4441 4443
4444 4445 4448 4449 4450 4451 4455 4462 4464 4466 4468 4469 4471 4472 4474 4478 4480 4481 4482 4483
4485 4488 4490 4491 4500 4501 4504 4511 4519 4524 4532 4538 4539 4558 4562 4568 4571 4575 4579 4589
"""
SEEDS = tuple(int(seed) for seed in SEED_LIST.split())


def diagnosed(diagnosis: Any) -> Answer:
    """Verdict, effects, gates and errors of a diagnosis."""
    found = diagnosis.to_dict()
    return {
        "verdict": found["verdict"],
        "effects": [[e["port"], e["law"], round(e["confidence"], 4)] for e in found["effects"]],
        "gates": sorted([g["channel"], g["finding"]] for g in found["gates"]),
        "train": found["fit"]["train"],
        "test": found["fit"]["test"],
        "floor": found["fit"]["noise_floor"]["nrmse"],
    }


def _case(key: str) -> Answer:
    hidden = concealed.case(int(key))
    try:
        diagnosis = pilfr.diagnose(hidden.simulator, hidden.train, test=hidden.test, workers=1)
    except Exception as error:  # a crash is an answer too
        return {"verdict": f"crash: {type(error).__name__}", "effects": [], "gates": []}
    score = concealed.score(hidden, diagnosis.to_dict())
    marks = {k: getattr(score, k) for k in MARKS}
    return {"name": hidden.name, "least": hidden.floor, **diagnosed(diagnosis), "score": marks}


def _machine(key: str) -> Answer | None:
    found = real_machines.machine(key)
    return None if found is None else diagnosed(found.diagnose(workers=1))


def _table(key: str) -> Answer:
    text = printed(lambda: table2.main([*SHORT_TABLE, "--seed", key]))
    return {"lines": [re.sub(r" +[\d.]+ s$", "", line) for line in text.splitlines() if "minutes" not in line]}


def printed(action: Callable[[], Any]) -> str:
    """Standard output of an action."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        action()
    return said.getvalue()


def _accuracy(key: str) -> Answer:
    operators, seed = map(int, key.split("-"))
    return {"nrmse": [f"{e:.4f}" for e in accuracy.default_run(100, operators, seed)[0]]}


def _zoo(key: str) -> Answer:
    problem = zoo.CASES[key]().problem()
    out: Answer = {}
    for solver in (pilfr.GaussNewton(), pilfr.Ipopt()):
        found = solver.solve(problem)
        out[type(solver).__name__] = [f"{found.cost:.4e}", found.iterations]
    return out


def _export(key: str) -> Answer:
    if key == "diagnosis":
        simulator = masing_diagnosis.simulator()
        from pilfr_casadi.export import exported

        step, state = exported(simulator, dt=1 / 120, hold="zero").step, np.zeros(4)
        records = benchmark(0).records
    else:
        records = benchmark(0).records
        fit = pilfr.fit(accuracy.structure(5), records["train"], starts=2, seed=0)
        with tempfile.TemporaryDirectory() as folder:
            fit.save(Path(folder) / "model.json")
            loaded = pilfr.load(Path(folder) / "model.json")
        if key == "control":
            system = loaded.export().to_control()
            state = np.zeros(system.nstates)
            out = []
            for u in records["multisine"].u[:40]:
                out.append(float(np.ravel(system.output(0, state, u))[0]))
                state = np.ravel(system.dynamics(0, state, u))
            return {"y": [f"{v:.{DIGITS}e}" for v in out]}
        step = loaded.to_casadi() if key == "casadi" else loaded.export(smooth=1e-4).step
        state = np.zeros(step.size1_in(0))
    out = []
    for u in records["multisine"].u[:40]:
        state, y = step(state, u)
        out.append(float(np.ravel(y)[0]))
    return {"y": [f"{v:.{DIGITS}e}" for v in out]}


def _speed(key: str) -> Answer:
    return {"lines": printed(lambda: speed.main(["--quick"])).splitlines()}


SUITES: dict[str, tuple[tuple[str, ...], Callable[[str], Answer | None]]] = {
    "zoo": (tuple(zoo.CASES), _zoo),
    "table2": (("101",), _table),
    "accuracy": (tuple(f"{n}-{seed}" for n, seed in ACCURACY), _accuracy),
    "exports": (EXPORTS, _export),
    "machines": (real_machines.NAMES, _machine),
    "cases": (tuple(map(str, SEEDS)), _case),
    "bank": (tuple(map(str, bank.SEEDS)), _case),
    "speed": (("quick",), _speed),
}


def keys(suite: str) -> tuple[str, ...]:
    """Keys of a suite."""
    return SUITES[suite][0]


def answer(suite: str, key: str) -> Answer | None:
    """Answer of one key; None where third-party recordings are missing."""
    return SUITES[suite][1](key)


def timed(suite: str, key: str) -> Answer | None:
    """Answer of one key with its seconds; None where third-party recordings are missing."""
    began = time.perf_counter()
    found = answer(suite, key)
    return None if found is None else {"key": key, "seconds": round(time.perf_counter() - began, 2), **found}


def differences(suite: str, old: Answer, new: Answer) -> list[str]:
    """Differences that fail a replay."""
    if suite == "speed":
        return []
    if suite in DIAGNOSES:
        before, now = ({"verdict": a["verdict"], "effects": [e[:2] for e in a["effects"]]} for a in (old, new))
    else:
        before, now = ({k: v for k, v in a.items() if k not in ("key", "seconds")} for a in (old, new))
    return [f"{k} was {v}, is {now.get(k)}" for k, v in before.items() if now.get(k) != v]


def drifts(suite: str, old: Answer, new: Answer) -> list[str]:
    """Differences of a diagnosis that are reported only."""
    if suite not in DIAGNOSES or "train" not in old or "train" not in new:
        return []
    out = []
    for kind in ("train", "test"):
        for name, value in (old[kind] or {}).items():
            now = (new[kind] or {}).get(name)
            if value is not None and now is not None and abs(now - value) > 1e-3 * abs(value):
                out.append(f"{kind} {name} {value:.4g} -> {now:.4g}")
    for (port, law, was), (_, _, sure) in zip(old["effects"], new["effects"], strict=False):
        if abs(was - sure) > 0.005:
            out.append(f"{law} at {port} {was:.2f} -> {sure:.2f}")
    return out


def paired(answers: Sequence[tuple[Answer, Answer]]) -> str:
    """Table of right answers and seconds, of the bank and of now, on the same concealed cases; empty without any."""
    scored = [(old, new) for old, new in answers if "score" in old and "score" in new]
    if not scored:
        return ""
    lines = [f"{'':24}{'bank':>12}{'now':>12}"]
    for mark in FIRST_NAME[:4]:
        both = [(old["score"].get(mark), new["score"].get(mark)) for old, new in scored]
        known = [pair for pair in both if None not in pair]
        counts = [f"{sum(map(bool, one))} of {len(known)}" for one in zip(*known, strict=True)] or ["-", "-"]
        lines.append(f"{mark.replace('_', ' '):24}" + "".join(f"{c:>12}" for c in counts))
    for share, name in ((0.5, "median"), (0.9, "slowest tenth")):
        figures = [np.quantile([row["seconds"] for row in rows], share) for rows in zip(*scored, strict=True)]
        lines.append(f"{name + ', s':24}" + "".join(f"{f:12.1f}" for f in figures))
    sure = [p for _, new in scored for p in new["score"].get("certainties") or ()]
    if sure:
        lines.append(f"{'Brier score':24}{'':12}{concealed_score.brier(*np.array(sure, dtype=float).T):12.3f}")
    wrong = sum(bool(new["score"].get("sure_wrong")) for _, new in scored)
    lines.append(f"{'sure and wrong':24}{'':12}{wrong:12d}")
    return "\n".join(lines) + "\n"
