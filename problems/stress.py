"""Diagnose the stress sets, cases of the kinds that the concealed ones leave out, and judge the answers.

    python -m problems.stress                              every set
    python -m problems.stress slow-noise weak --workers 2  some of them
    python -m problems.stress faults --only gap            cases with a tag: a rig, a law, a fault, a pole
    python -m problems.stress --list                       the cases and what they hold, without diagnoses
    python -m problems.stress --out stress.jsonl           results go there as they come; what is there is not run again

`stress_sets` says what each set is, `concealed_score` how an answer is judged.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .concealed import answered, code, judged
from .concealed_case import Case
from .concealed_score import Score, brier, every_effect, log_loss, summary
from .stress_sets import case, seeds, set_of, sets

__all__ = ["case", "report", "run_one", "seeds", "sets"]


def run_one(seed: int) -> Score:
    """Diagnose one case and judge the answer."""
    return judged(case(seed))


def held(hidden: Case) -> str:
    """One line about a case: what it holds, the refit's error over the noise, the noise floor, and what is accepted."""
    parts = [*hidden.details["effects"], *(t for t in sorted(hidden.tags) if t.startswith(("fault:", "value:")))]
    parts += sorted(t for t in hidden.tags if t.startswith("pole="))
    times = hidden.refit / hidden.details["noise"]
    numbers = f"refit {times:6.1f} x noise, floor {hidden.floor:.2g}"
    return f"{hidden.name:52} {hidden.verdict:16} {numbers}  {'; '.join(parts) or 'nothing'}"


def report(scores: Sequence[Score]) -> str:
    """Rows of every set, answers by tag, and the summary of all."""
    out = []
    for name in sets():
        of = [s for s in scores if set_of(s.seed) == name]
        if not of:
            continue
        out += ["", f"{name} ({len(of)} cases)", *every_effect(of)]
        pairs = np.array([p for s in of for p in s.certainties], dtype=float).reshape(-1, 2).T
        if pairs.size:
            out.append(f"{'Brier score, log loss':34}{brier(*pairs):8.3f}{len(pairs[0]):7d}  {log_loss(*pairs):.3f}")
        tags = sorted({t for s in of for t in s.tags if t.startswith(("pole=", "fault:", "load"))})
        for tag in tags:
            answers = [s.answer for s in of if tag in s.tags]
            out.append(f"    {tag:30}{sum(answers):4d} of {len(answers)} answers right")
    return "\n".join([*out, "", "all sets", summary(scores)])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the sets, or list them."""
    summary_line, _, _ = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(prog="python -m problems.stress", description=summary_line)
    parser.add_argument("sets", nargs="*", choices=[*sets(), []], help="sets to run; all by default")
    parser.add_argument("--list", action="store_true", help="print the cases instead of running them")
    parser.add_argument("--only", default="", help="cases with this tag: a rig, a law, a fault, a pole")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="results go here as they come; what is there is not run again")
    a = parser.parse_args(arguments)
    code()  # as it is now: it may be edited while cases run
    wanted = seeds(a.sets)
    if a.only or a.list:
        kept = []
        for seed in wanted:
            hidden = case(seed)
            if not a.only or any(a.only in (tag, tag.partition(":")[2]) for tag in hidden.tags):
                kept.append(seed)
                if a.list:
                    print(held(hidden), flush=True)
        wanted = kept
    if a.list:
        return
    if not wanted:
        sys.exit("No case has that tag; see --list.")
    print(report(answered(wanted, run_one, a.out, a.workers)))


if __name__ == "__main__":
    main()
