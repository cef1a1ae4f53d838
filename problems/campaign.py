"""A hundred starts on a cluster that loses a worker and its driver, against the same starts one after the other.

    python -m problems.campaign                  25 of the paper's starts for each of N = 5, 10, 15, 20
    python -m problems.campaign --starts 100     box plots as Fig. 11 of Krikelis et al. (2024): 400 jobs
    python -m problems.campaign --start plain    solved and no more; else each start is re-gridded too

The same run file is executed one job after the other, by two processes, and on a Dask cluster of four workers of which
one is killed (SIGKILL) when a third of the jobs are done; when half of them are, the driver is killed, and resumed. All
three must give the same bytes. The box plot beside the published quartiles is `fig11_starts.png`. The
training record is not periodic, so starts begin at the linear model of least output error, where plain ones stay more
often (`problems.table2 --linear output-error`); Fig. 11 from the best linear approximation, as in the paper, is
`problems.table2 --figures`.
"""

from __future__ import annotations

import argparse
import csv
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pilfr_casadi as pilfr
from pilfr_casadi.cli.demo import FLOOR, PUBLISHED, SETS

from .masing_data import benchmark

TEXT = """seeds = {{ first = 0, count = {starts} }}
report = false

[data]
inputs = "u"
outputs = "x2"
initial = "zero"
train = "train.csv"
test = ["multisine.csv", "sweep.csv"]

[model]
nx = 5

[grid]
operators = {operators}

[solver]
start = "{start}"
starts = 1
"""


def prepare(folder: Path, seed: int, start: str, starts: int, operators: Sequence[int]) -> Path:
    """Write the recordings and the run file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, r in benchmark(seed).records.items():
        rows = (f"{t:.9g},{u!r},{y!r}" for t, u, y in zip(r.t, r.u[:, 0].tolist(), r.y[:, 0].tolist(), strict=True))
        (folder / f"{name}.csv").write_text("t,u,x2\n" + "\n".join(rows) + "\n")
    path = folder / "starts.toml"
    path.write_text(TEXT.format(start=start, starts=starts, operators=list(operators)))
    return path


def timed(path: Path, out: Path, workers: int) -> tuple[float, float]:
    """Seconds, and processor seconds, that a whole campaign takes, from nothing."""
    began, before = time.perf_counter(), sum(os.times()[:4])
    pilfr.campaign(path, out=out, workers=workers, overwrite=True)
    return time.perf_counter() - began, sum(os.times()[:4]) - before


def on_a_cluster(path: Path, out: Path, jobs: int, workers: int = 4) -> tuple[float, list[str]]:
    """Seconds, and what was killed when: one worker after a third of the jobs, the driver after half of them."""
    from distributed import LocalCluster

    shutil.rmtree(out, ignore_errors=True)
    began, said = time.perf_counter(), []
    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": ":0", "silence_logs": logging.ERROR}
    with LocalCluster(workers, **options) as cluster:
        command = [sys.executable, "-m", "pilfr_casadi", "campaign", str(path), "--out", str(out)]
        command += ["--dask", cluster.scheduler_address]
        driver = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _wait(out, jobs // 3, driver)
        os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        said.append(f"a worker killed at {_done(out)} jobs")
        _wait(out, jobs // 2, driver)
        driver.kill()
        driver.wait()
        said.append(f"the driver killed at {_done(out)} jobs and resumed")
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began, said


def _done(out: Path) -> int:
    return len(list(out.glob("jobs/*/model.json")))


def _wait(out: Path, jobs: int, driver: subprocess.Popen[bytes]) -> None:
    while _done(out) < jobs:
        if driver.poll() is not None:
            raise SystemExit(f"The driver ended by itself with status {driver.returncode}.")
        time.sleep(0.05)


def contents(out: Path) -> dict[str, bytes]:
    """Every model and the table of errors."""
    paths = [*out.glob("jobs/*/model.json"), out / "results.csv", out / "summary.csv"]
    return {str(p.relative_to(out)): p.read_bytes() for p in paths}


def rows(out: Path) -> list[dict[str, str]]:
    """The table of errors."""
    with (out / "results.csv").open() as file:
        return list(csv.DictReader(file))


def draw(out: Path, target: Path) -> None:
    """Fig. 11: errors of all starts by number of operators, with the published lower quartiles."""
    from pilfr_casadi.plots import compared_spread

    errors: dict[str, dict[str, list[float]]] = {name: {} for name in SETS}
    for row in rows(out):  # a start without a model has one row and no recording
        for name in [row["recording"].removesuffix(".csv")] if row["recording"] else SETS:
            errors[name].setdefault(f"N={row['operators']}", []).append(float(row["nrmse"]))
    published = {name: {r.removeprefix("PI-LFR "): PUBLISHED[r][k] for r in PUBLISHED} for k, name in enumerate(SETS)}
    figure = compared_spread(
        errors, published=published, floor=FLOOR, source="published 25th percentile", x="operators"
    )
    figure.savefig(target, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=100, help="record (default 100)")
    parser.add_argument("--starts", type=int, default=25, help="starts of each row (default 25)")
    parser.add_argument("--start", choices=("paper", "plain"), default="paper", help="with or without re-gridding")
    parser.add_argument("--operators", type=int, nargs="+", default=[5, 10, 15, 20], metavar="N")
    parser.add_argument("--out", type=Path, default=Path("runs/campaign"))
    options = parser.parse_args(arguments)
    path = prepare(options.out, options.seed, options.start, options.starts, options.operators)
    jobs = options.starts * len(options.operators)
    places = {name: options.out / name for name in ("serial", "two", "dask")}
    serial, used = timed(path, places["serial"], 1)
    print(f"{jobs} jobs, one after the other: {serial:.0f} s", flush=True)
    seconds, more = timed(path, places["two"], 2)
    gain = f"{serial / seconds:.2f} times as fast, {more / used:.2f} times the processor time"
    print(f"two processes: {seconds:.0f} s, {gain}", flush=True)
    seconds, said = on_a_cluster(path, places["dask"], jobs)
    print(f"Dask, four workers: {seconds:.0f} s; {', '.join(said)}", flush=True)
    expected = contents(places["serial"])
    for name in ("two", "dask"):
        found = contents(places[name])
        different = sum(found.get(k) != v for k, v in expected.items())
        seen = [(r["job"], r["recording"]) for r in rows(places[name])]
        lost, doubled = jobs - len({job for job, _ in seen}), len(seen) - len(set(seen))
        print(f"{name:<5} results lost {lost}, doubled {doubled}; files that differ from the serial ones {different}")
    with (places["dask"] / "summary.csv").open() as file:
        for r in csv.DictReader(file):
            quartiles = "  ".join(f"{float(r[k]):.4f}" for k in ("lower_quartile", "median", "upper_quartile"))
            print(f"N = {r['operators']:<3} {r['recording']:<14} {quartiles}   failed {float(r['failure_rate']):.0%}")
    draw(places["dask"], options.out / "fig11_starts.png")
    print(f"box plot: {options.out / 'fig11_starts.png'}")


if __name__ == "__main__":
    main()
