"""Accuracy of the default pipeline on fresh records of the Masing rig (`python -m problems.accuracy`).

Each run sees one training record and one seed; the two test records are looked at only to report. Targets: N = 20:
medians of 0.0045 / 0.0065 / 0.0080 (train / multisine / sweep) and no multisine above 0.02; N = 10: medians of 0.0070 /
0.0100 / 0.0100.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from pilfr_casadi.cli.demo import FLOOR, SETS, structure
from pilfr_casadi.identify import fit

from .masing_data import benchmark

FIRST_RECORD = 100
TARGETS = {20: (0.0045, 0.0065, 0.0080), 10: (0.0070, 0.0100, 0.0100)}


def default_run(record: int, n: int, seed: int) -> tuple[list[float], float]:
    """NRMSE on the three sets and seconds of one run of the default pipeline."""
    records = benchmark(record).records
    result = fit(structure(n), records["train"], seed=seed)
    return [result.nrmse(records[name]) for name in SETS], result.seconds


def _row(values: Sequence[float]) -> str:
    return " / ".join(f"{v:.4f}" for v in values)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=3, help=f"fresh records, from {FIRST_RECORD} on")
    parser.add_argument("--seeds", type=int, default=20, help="seeds a record")
    parser.add_argument("--operators", type=int, nargs="+", default=None, metavar="N")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    print(f"{options.records} records x {options.seeds} seeds; floor {FLOOR}; {' / '.join(SETS)}")
    for n in options.operators or (20, 10):
        jobs = [(FIRST_RECORD + r, n, s) for r in range(options.records) for s in range(options.seeds)]
        with ProcessPoolExecutor(options.workers) as pool:
            results = list(pool.map(default_run, *zip(*jobs, strict=True)))
        errors = np.array([e for e, _ in results])
        seconds = np.median([s for _, s in results])
        print(f"N = {n:<3} median {_row(np.median(errors, axis=0))}   target {_row(TARGETS.get(n, ()))}")
        for r in range(options.records):
            part = errors[r * options.seeds : (r + 1) * options.seeds]
            median, worst = np.median(part, axis=0), part.max(axis=0)
            print(f"        record {FIRST_RECORD + r}: median {_row(median)}   worst {_row(worst)}")
        print(f"        {seconds:.1f} s a run (median)", flush=True)


if __name__ == "__main__":
    main()
