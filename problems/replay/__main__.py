"""Replay fixed cases and compare every answer with the banked one (`python -m problems.replay`).

The bank holds the answers of an earlier commit, one JSON line per case, in one file per suite beside this program:

    cases      120 concealed cases, balanced over rigs, laws, two effects, outside, faults and nothing missing
    bank       400 of them (`problems.bank`), only where the suite is named
    machines   the recordings of real machines, and the paper's rig without its spring
    table2     Table 2 in its short form
    accuracy   the default identification on a fresh record of the paper's rig
    zoo        both solvers on every problem of the zoo
    exports    one step of an exported model in each form, sample by sample
    speed      ratios of times within one run; reported, never compared

Compared are verdict, ports and laws of a diagnosis, and every printed digit of the other suites. Confidence, errors
and seconds of a diagnosis are shown where they differ, and do not fail the replay.

    python -m problems.replay                        replay everything and compare; exit status 1 on a difference
    python -m problems.replay cases --every 10       every tenth concealed case
    python -m problems.replay --record               write the bank anew
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from .suites import ON_REQUEST, SUITES, differences, drifts, keys, paired, timed

FOLDER = Path(__file__).parent


def banked(suite: str) -> dict[str, dict[str, Any]]:
    """Answers in the bank, by key."""
    path = FOLDER / f"{suite}.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["key"]: row for row in map(json.loads, lines)}


def record(suite: str, rows: dict[str, dict[str, Any]]) -> None:
    """Write the bank of one suite, in the order of its keys."""
    text = "".join(json.dumps(rows[key], allow_nan=False) + "\n" for key in keys(suite) if key in rows)
    (FOLDER / f"{suite}.jsonl").write_text(text, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Replay, print what differs, and return the number of suites that differ as an exit status of 0 or 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "suites", nargs="*", choices=[*SUITES, []], help="suites to replay; all but the bank by default"
    )
    parser.add_argument("--record", action="store_true", help="write the bank instead of comparing with it")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th key of each suite")
    parser.add_argument("--only", nargs="+", default=None, metavar="KEY", help="only these keys")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    different, compared, pairs = [], 0, list[tuple[dict[str, Any], dict[str, Any]]]()
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        for suite in options.suites or [s for s in SUITES if s not in ON_REQUEST]:
            old = banked(suite)
            wanted = [k for k in keys(suite)[:: options.every] if options.only is None or k in options.only]
            if options.record:  # what is there already stays: delete the file to begin anew
                wanted = [k for k in wanted if k not in old]
            tasks = {pool.submit(timed, suite, key): key for key in wanted}
            for task in as_completed(tasks):
                key, row = tasks[task], task.result()
                if row is None:
                    print(f"{suite:9} {key:24} not here", flush=True)
                    continue
                if options.record:
                    old[key] = row
                    record(suite, old)
                    print(f"{suite:9} {key:24} {row['seconds']:7.1f} s  recorded", flush=True)
                    continue
                if key not in old:
                    print(f"{suite:9} {key:24} {row['seconds']:7.1f} s  not in the bank", flush=True)
                    continue
                compared += 1
                pairs.append((old[key], row))
                found = differences(suite, old[key], row)
                different += [f"{suite} {key}: {text}" for text in found]
                words = "; ".join(found) or "same"
                slight = "; ".join(drifts(suite, old[key], row))
                pace = f"{row['seconds']:7.1f} s (bank {old[key]['seconds']:.1f} s)"
                print(f"{suite:9} {key:24} {pace}  {words}{f'  [{slight}]' if slight else ''}", flush=True)
    if options.record:
        return 0
    print(f"\n{compared} compared, {len(different)} different")
    print("\n".join(different))
    print(paired(pairs), end="")
    return 1 if different or not compared else 0


if __name__ == "__main__":
    sys.exit(main())
