"""Speed: what a residual with its Jacobian, a start, a whole identification, a growing record, an exported step cost.

    python -m problems.speed            all tables, some minutes
    python -m problems.speed --quick    a small version, less than half a minute

The case is the paper's: the training record of `problems.masing` (M = 6144), five states, N = 20 plays, from a start of
the default pipeline. Every figure comes from a fresh process on one core, so that its peak memory is its own; ratios
are between figures of one run. Two ways to the same Jacobian stand for what CasADi offers by itself: `jacobian` of the
unrolled simulation (`naive`), and a scalar-expression step with automatic sensitivities (`sx`), both in its virtual
machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.engine import compiler

from .speed_pieces import PLAYS, Figures, structure

SEED = 100
ONE_THREAD = {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def prepare(folder: Path) -> None:
    """Write the case: training record, a start of the default pipeline, and a point on the way from it."""
    from pilfr_casadi.identify import grid_start, linear_model, unit_states
    from pilfr_casadi.optimise import GaussNewton, Problem

    from .masing_data import records

    form, train = structure(), records(SEED)["train"]
    model, problem, solution = linear_model([train], form)
    blocks, states = unit_states(model.parameters.unpack(problem.parameters(solution.theta)), [train.u])
    values = grid_start(form, blocks, [train.u], states, np.random.default_rng(SEED))
    _write(folder / "start.npz", train, values)
    model = form.model(1, 1, values)
    problem = Problem(model, train)
    # at the start itself B_w = 0: half of the Jacobian vanishes, and with it the work
    solution = GaussNewton(max_iterations=10).solve(problem)
    values = model.parameters.unpack(problem.parameters(solution.theta))
    _write(folder / "way.npz", train, values)


def _write(path: Path, record: Any, values: dict[str, np.ndarray]) -> None:
    arrays: dict[str, Any] = {"u": record.u, "y": record.y, **values}
    np.savez(path, **arrays)


def run(folder: Path, piece: str, *arguments: Any, env: Mapping[str, str] | None = None) -> Figures:
    """A piece in a fresh process on one core."""
    call = json.dumps([piece, str(folder), *arguments])
    command = [sys.executable, "-m", "problems.speed_pieces", call]
    environment = {**os.environ, **ONE_THREAD, **(env or {})}
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root, check=False)
    if done.returncode:
        raise RuntimeError(f"the piece {call} failed:\n{done.stderr}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def table_of_derivatives(folder: Path, samples: int = 6144, fewer: int = 6144) -> dict[str, Figures]:
    """Print and return the ways to a Jacobian; CasADi's own on fewer samples, their time scaled to all."""
    title = f"residual and Jacobian, M = {samples}, {PLAYS} plays"
    print(f"{title:<54}      time      memory   ratio   simulation alone")
    names = {
        "c": "compiled",
        "vm": "virtual machine",
        "sx": "scalar step, CasADi's AD",
        "naive": "jacobian of mapaccum",
    }
    if compiler() is None:
        del names["c"]
    ways: dict[str, Figures] = {}
    for way, name in names.items():
        part = samples if way in ("c", "vm") else fewer
        figures = run(folder, "derivatives", way, part)
        ways[way] = figures | {"seconds": figures["seconds"] * samples / part}
        alone = f"{1e3 * ways[way]['simulation']:9.2f} ms" if "simulation" in ways[way] else ""
        note = "" if part == samples else f" ({part} samples, time scaled)"
        ratio = ways[way]["seconds"] / next(iter(ways.values()))["seconds"]
        line = f"{1e3 * ways[way]['seconds']:8.1f} ms {ways[way]['memory']:8.0f} MB {ratio:7.1f}   {alone}"
        print(f"  {name + note:<52}{line}", flush=True)
    return ways


def table_of_starts(folder: Path, engines: Sequence[str] = ("c", "vm"), starts: int = 8) -> None:
    """Print the time of one start with and without a compiler, and of the default identification."""
    print("\none start to the end                                 time   iterations   training error")
    for engine in engines if compiler() else ("vm",):
        f = run(folder, "one_start", engine)
        name = "with a compiler" if engine == "c" else "without"
        print(f"  {name:<46}{f['seconds']:8.2f} s {f['iterations']:8d}      {f['error']:.5f}", flush=True)
    if starts:
        f = run(folder, "pipeline", starts)
        name = f"default identification, {starts} starts"
        print(f"  {name:<46}{f['seconds']:8.2f} s               {f['error']:.5f}", flush=True)


def table_of_growth(folder: Path, lengths: Sequence[int] = (6_000, 60_000, 600_000, 1_000_000)) -> list[Figures]:
    """Print and return how time and memory of a Gauss-Newton system grow with the record."""
    print("\nsamples       normal equations     per sample   peak memory   recording itself")
    rows = []
    for samples in lengths:
        f = run(folder, "growth", samples)
        rows.append({**f, "samples": samples})
        line = f"{samples:>9,d}   {f['seconds']:14.3f} s {1e6 * f['seconds'] / samples:11.2f} us {f['memory']:10.0f} MB"
        print(f"{line} {f['recording']:12.1f} MB", flush=True)
    return rows


def table_of_solvers(folder: Path, limit: int = 150) -> None:
    """Print scipy's least squares beside ours, all with the fastest engine there is."""
    print(f"\nsame problem, same start, bounds; scipy's trf is cut off after {limit} evaluations")
    print("                                                       time    ratio   Jacobians   training error")
    names = {"ours": "GaussNewton", "jacobian": "trf, our Jacobian", "differences": "trf, finite differences"}
    ours = least = 0.0
    for way, name in names.items():
        f = run(folder, "least_squares", way, limit)
        if way == "ours":
            ours, least = f["seconds"], f["error"]
        if f["ended"]:
            line = f"{f['seconds']:8.2f} s {f['seconds'] / ours:8.1f} {f['iterations']:8d}      {f['error']:.5f}"
        else:  # neither its time nor its ratio is that of a solution
            times = f["error"] / least if least else np.inf
            line = f"not done after {f['seconds']:.2f} s; its error is still {times:.3g} x that of GaussNewton"
        print(f"  {name:<46}{line}", flush=True)


def table_of_beginnings(folder: Path) -> Figures:
    """Print and return what comes before the first sample: imports, generating and building code, and the cache."""
    print("\nbefore the first sample")
    package, verb = run(folder, "imports", "package"), run(folder, "imports", "verb")
    figures = {"casadi": package["casadi"], "import": package["more"], "import of fit": verb["more"]}
    if compiler():
        with tempfile.TemporaryDirectory() as cache:
            first, later = (run(folder, "building", env={"XDG_CACHE_HOME": cache}) for _ in range(2))
        figures |= {"first compiled engine": first["seconds"], "the next process": later["seconds"]}
    for name, seconds in figures.items():
        print(f"  {name:<46}{1e3 * seconds:8.0f} ms")
    return figures


def table_of_export(folder: Path) -> Figures:
    """Print and return what one step of the exported model costs a controller."""
    print("\none step of the exported model                        time")
    figures = run(folder, "exported_step")
    for key, name in (("seconds", "its C, in a C program (-O2)"), ("function", "its CasADi function, from Python")):
        if key in figures:
            print(f"  {name:<46}{1e6 * figures[key]:8.2f} us", flush=True)
    return figures


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small version, less than half a minute")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        if options.quick:
            table_of_derivatives(folder, 2048, 128)
            table_of_starts(folder, ("c",), 0)
            table_of_growth(folder, (6_000, 60_000))
            table_of_solvers(folder, 5)
        else:
            table_of_derivatives(folder)
            table_of_starts(folder)
            table_of_growth(folder)
            table_of_solvers(folder)
        table_of_export(folder)
        table_of_beginnings(folder)


if __name__ == "__main__":
    main()
