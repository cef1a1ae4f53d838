"""Concealed cases on which `diagnose` has to find the physics that was left out of a simulator.

`case(seed)` draws a rig, what it hides, and its recordings; `score` judges a diagnosis. Truths are simulated apart from
the package, but a third to two thirds of them lie exactly in a family of the catalogue. Results are reported on seeds
that nobody has seen, from the default first seed on; `problems.stress` has what these cases leave out.

    python -m problems.concealed --cases 200 --workers 2
    python -m problems.concealed --export DIR --cases 5 --first-seed 0      (files for the command line)
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import pilfr_casadi
from pilfr_casadi.data import Recording

from .concealed_case import KINDS, Case, case
from .concealed_score import Score, line, score, summary

__all__ = ["KINDS", "Case", "Score", "case", "export", "run_one", "score", "summary"]


def run_one(seed: int) -> Score:
    """Diagnose one case and judge the answer; a crash is an answer that is wrong."""
    return judged(case(seed))


def judged(hidden: Case) -> Score:
    """Diagnose a case that was drawn, and judge the answer."""
    began = time.perf_counter()
    try:
        diagnosis = pilfr_casadi.diagnose(hidden.simulator, hidden.train, test=hidden.test, workers=1)
        answer, crash = diagnosis.to_dict(), ""
    except Exception as error:
        text = " ".join(str(error).split())
        answer, crash = {}, f"{type(error).__name__}: {text[:160]}"
    return score(hidden, answer, time.perf_counter() - began, crash)


def scored(path: Path) -> dict[int, Score]:
    """What a file of `--out` has, by seed; a last line that was cut off in the middle is taken out of it."""
    whole = path.read_text(encoding="utf-8").rpartition("\n") if path.exists() else ("", "", "")
    if whole[2]:
        path.write_text("".join(whole[:2]), encoding="utf-8")
    found = [json.loads(text) for text in whole[0].split("\n")] if whole[0] else []
    if any(s.pop("code") != code() for s in found):
        sys.exit(f"{path} has results of other code than this; give another file, or go back to that commit.")
    return {s["seed"]: Score(**s) for s in found}


@cache
def code() -> str:
    """A digest of the package's files and of the cases': results of different code do not make one score."""
    here = Path(__file__).parent
    files = [*Path(pilfr_casadi.__file__).parent.rglob("*.py"), *here.glob("concealed*.py"), *here.glob("stress*.py")]
    return hashlib.sha256(b"".join(f.read_bytes() for f in sorted(files))).hexdigest()[:16]


def _write(path: Path, r: Recording) -> None:
    table = np.column_stack([np.arange(len(r)) * r.dt, r.u, r.y])
    head = ",".join(["t", *r.inputs, *r.outputs])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.12g")


def export(hidden: Case, folder: Path) -> None:
    """Write a case in the contract's formats: simulator.py, train*.csv, test.csv; the answer apart, in truth.json."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "simulator.py").write_text(hidden.source, encoding="utf-8")
    for r in (*hidden.train, hidden.test):
        _write(folder / f"{r.name}.csv", r)
    answer = {
        "verdict": hidden.verdict,
        "truth": list(hidden.truth),
        "accepted": [sorted(map(list, pairs)) for pairs in hidden.accepted],
        "channels": sorted(hidden.channels),
        "floor": hidden.floor,
        "hold": hidden.test.hold,
        "initial": hidden.train[0].initial,
        "period": hidden.train[0].period,
        "tags": sorted(hidden.tags),
        "details": hidden.details["effects"],
    }
    (folder / "truth.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark, or write its files."""
    parser = argparse.ArgumentParser(prog="python -m problems.concealed", description="Concealed cases.")
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=5256)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="results go here as they come; what is there is not run again")
    parser.add_argument("--only", default="", help="cases with this tag: a rig, a law, a kind, a noise")
    parser.add_argument("--export", type=Path, help="write the cases here instead of running them")
    parser.add_argument("--list", action="store_true", help="print the cases instead of running them")
    a = parser.parse_args(arguments)
    code()  # as it is now: it may be edited while cases run
    seeds = list(range(a.first_seed, a.first_seed + a.cases))
    if a.only or a.export or a.list:
        kept = []
        for seed in seeds:
            hidden = case(seed)
            if a.only and a.only not in hidden.tags:
                continue
            kept.append(seed)
            if a.export:
                export(hidden, a.export / hidden.name)
            if a.list:
                print(
                    f"{hidden.name:46} {hidden.verdict:16} {hidden.details['effects']} {sorted(hidden.tags)}",
                    flush=True,
                )
        seeds = kept
    if a.export or a.list:
        return
    if not seeds:
        sys.exit("No case has that tag; see --list.")
    print("\n" + summary(answered(seeds, run_one, a.out, a.workers)))


def answered(seeds: Sequence[int], run: Callable[[int], Score], out: Path | None, workers: int) -> list[Score]:
    """Scores of all seeds, in their order; what the file `out` has is not run again, and what comes is put there."""
    done = scored(out) if out else {}
    scores = [done[seed] for seed in seeds if seed in done]
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    try:
        for task in as_completed([pool.submit(run, seed) for seed in seeds if seed not in done]):
            scores.append(task.result())
            if out:
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"code": code(), **asdict(scores[-1])}, default=lambda v: v.item()) + "\n")
            print(f"[{len(scores):3d}/{len(seeds)}] {line(scores[-1])}", flush=True)
    finally:  # an end in the middle begins no further case
        pool.shutdown(cancel_futures=True)
    return sorted(scores, key=lambda s: s.seed)


if __name__ == "__main__":
    main()
