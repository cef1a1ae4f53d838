"""Table 3 and Figs. 13-15 of Krikelis et al. (2024), Sec. 7, on a stand-in and on a real piezo stack.

    python -m problems.table3                                     14 minutes of processor time
    python -m problems.table3 --coupling 0.02 --rows nx=15        rows whose name has this, of another platform

The paper's recordings are confidential. `problems.piezo_platform` measures a documented platform the same way: ten
multisines of 8192 samples at 10 kHz, five steady periods each, 0-3000 Hz for the linear analysis and 0-800 Hz for the
models, nine to train and one to test, averaged over the periods. The noise is the paper's share of the output, the
other figures are of their own, so rows are to be compared within a column; its hysteresis is a sum of plays, which a
PI-LFR can represent.

Every row goes the same way: starts and polish on the first realization, then all nine; networks with at most 50 and 8
iterations and the others at most 200, from one start each, a NOE stops early on the second realization. State matrices
are in modal coordinates (`pilfr_casadi.modal`), the same model class with a tenth of the work. Test error over the
noise floor, with 8 and 15 states or lags, the row of each kind with the smaller training error:

    LTI 3.12, 1.52   NOE 4.32, 3.77   SS-NN 3.20, 1.02   PI-Hammerstein 2.18, 1.03   PI-LFR 1.84, 1.00

The order is the paper's but for two kinds. SS-NN with 15 states come before PI-Hammerstein because the displacement
acts back on the charge: with `--coupling 0.02`, where it hardly does, PI-Hammerstein with 20 plays has 1.005
and SS-NN with 10 neurons 1.04. NOE are worse than the linear model, which what begins as a NARX does not reach.

The real stack is that of `problems.piezo_stack`: its record of growing and shrinking amplitude, first half to train,
second half to test (its memory is that of the first half, which is run before it); at 1 Hz there is no room for more
than two states.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Fit, fit
from pilfr_casadi.linear import modal
from pilfr_casadi.models import NOE, PILFR, Lagged, Play, PrandtlIshlinskii, hammerstein, ssnn
from pilfr_casadi.optimise import GaussNewton

from .measured_data import measured
from .piezo_platform import Platform, measure
from .piezo_stack import recordings as stack_recordings

EXPLORED = 1  # realizations on which starts are tried
LIMITED = (50, 8)  # iterations of networks
SLOWEST = (
    0.9997  # spectral radius: a lag of 0.3 s; slower ones look constant in a period, and settle over dozens of them
)
PUBLISHED_FLOOR = 0.0884


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    model : PILFR, or anything else that `fit` takes
        What is fitted.
    published : tuple of float, optional
        NRMSE on training and test in the paper.
    iterations : tuple of int, optional
        Most iterations of the solver on the realizations that are explored, and on all; by default as many as it takes.
    """

    model: Any
    published: tuple[float, float] | None = None
    iterations: tuple[int, int] | None = None


def lti(nx: int) -> PILFR:
    """A linear model."""
    return PILFR(nx, None, {"A": modal(nx)})


def pi_lfr(nx: int, n: int) -> PILFR:
    """A PI-LFR with n plays."""
    return PILFR(nx, PrandtlIshlinskii(Play, n), {"A": modal(nx)})


def pi_hammerstein(nx: int, n: int) -> PILFR:
    """A PI-Hammerstein model with n plays."""
    form = hammerstein(nx, PrandtlIshlinskii(Play, n))
    return PILFR(nx, form.element, {**form.fixed, "A": modal(nx)})


def ss_nn(nx: int, n: int) -> PILFR:
    """An SS-NN with n neurons for the states and n for the output."""
    form = ssnn(nx, n)
    return PILFR(nx, form.element, {**form.fixed, "A": modal(nx)})


def rows() -> dict[str, Row]:
    """The rows of Table 3, and a linear model of the larger order beside them."""
    published = {
        ("NOE", 8, 10): (0.1719, 0.1713),
        ("NOE", 8, 20): (0.2229, 0.2256),
        ("NOE", 15, 10): (0.1590, 0.1612),
        ("NOE", 15, 20): (0.1610, 0.1645),
        ("SS-NN", 8, 10): (0.1891, 0.1891),
        ("SS-NN", 8, 20): (0.1905, 0.1914),
        ("SS-NN", 15, 10): (0.1148, 0.1155),
        ("SS-NN", 15, 20): (0.1181, 0.1289),
        ("PI-Hamm", 8, 10): (0.1820, 0.1860),
        ("PI-Hamm", 8, 20): (0.1827, 0.1863),
        ("PI-Hamm", 15, 10): (0.1060, 0.1072),
        ("PI-Hamm", 15, 20): (0.1073, 0.1098),
        ("PI-LFR", 8, 10): (0.1862, 0.1871),
        ("PI-LFR", 8, 20): (0.1856, 0.1868),
        ("PI-LFR", 15, 10): (0.1056, 0.1052),
        ("PI-LFR", 15, 20): (0.1057, 0.1044),
    }
    build: dict[str, Any] = {"NOE": NOE, "SS-NN": ss_nn, "PI-Hamm": pi_hammerstein, "PI-LFR": pi_lfr}
    size, most = {"NOE": "lags={} n={}", "SS-NN": "nx={} n={}"}, {"NOE": LIMITED, "SS-NN": LIMITED}
    found = {"LTI nx=8": Row(lti(8), (0.2104, 0.2084)), "LTI nx=15": Row(lti(15))}
    for (kind, nx, n), errors in published.items():
        name = f"{kind} {size.get(kind, 'nx={} N={}').format(nx, n)}"
        found[name] = Row(build[kind](nx, n), errors, most.get(kind))
    return found


def stack_rows() -> dict[str, Row]:
    """The same kinds of models for the real stack."""
    found = {f"LTI nx={nx}": Row(lti(nx)) for nx in (1, 2)}
    for name, build in (("PI-Hamm", pi_hammerstein), ("PI-LFR", pi_lfr)):
        found |= {f"{name} nx={nx} N={n}": Row(build(nx, n)) for nx in (1, 2) for n in (10, 20)}
    return found


def identify(row: Row, train: Sequence[Recording], explored: int = EXPLORED, **options: Any) -> Fit:
    """The fit of a row to the training recordings, started on the first few; its `seconds` are processor time."""
    began = time.process_time()
    first, last = (GaussNewton(max_iterations=n, tolerance=1e-4) for n in row.iterations or (200, 200))
    if isinstance(row.model, PILFR) and row.model.element is None:
        return replace(fit(row.model, train, **options), seconds=time.process_time() - began)
    if isinstance(row.model, Lagged):  # one realization more, to stop early; its state is the past
        explored, options = explored + 1, {**options, "stable": False}
    found = fit(row.model, train[:explored], solver=first, **options)
    found = fit(found, train, solver=last, **options) if len(train) > explored else found
    return replace(found, seconds=time.process_time() - began)


def table(
    wanted: Mapping[str, Row],
    train: Sequence[Recording],
    test: Recording,
    floor: float | None,
    executor: Executor,
    **options: Any,
) -> dict[str, Fit]:
    """Fit every row and print its NRMSE, next to the noise floor and the published one."""
    print(f"{'NRMSE':<20}{'train':>9}{'test':>9}{'test/floor':>12}   published         processor")
    jobs = {name: executor.submit(identify, row, train, **options) for name, row in wanted.items()}
    fits: dict[str, Fit] = {}
    for name, job in jobs.items():
        fits[name] = one = job.result()
        a, b = one.nrmse(train), one.nrmse(test)
        share = f"{b / floor:12.3f}" if floor else " " * 12
        published = wanted[name].published
        reference = "({:.4f} {:.4f})".format(*published) if published else " " * 15
        print(f"{name:<20}{a:9.4f}{b:9.4f}{share} {reference} {one.seconds:6.1f} s", flush=True)
    return fits


def by_training(fits: Mapping[str, Fit], train: Sequence[Recording], test: Recording, floor: float) -> str:
    """Of each kind and order the row of the smallest training error, with its test error over the noise floor."""
    best: dict[str, tuple[float, str]] = {}
    for name, one in fits.items():
        kind = name.rsplit(" ", 1)[0] if "=" in name.rsplit(" ", 2)[-2] else name
        best[kind] = min(best.get(kind, (np.inf, "")), (one.nrmse(train), name))
    return "chosen by training error, test/floor: " + ", ".join(
        f"{name} {fits[name].nrmse(test) / floor:.3f}" for _, name in best.values()
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables and draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="recordings (default 0)")
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rows", nargs="+", default=None, metavar="TEXT", help="only rows whose name has one of these")
    parser.add_argument("--coupling", type=float, help="how much the displacement acts back on the charge")
    parser.add_argument("--out", type=Path, default=Path("runs/table3"), help="folder for the figures")
    parser.add_argument("--no-figures", action="store_true")
    options = parser.parse_args(arguments)
    began, folder = time.perf_counter(), measured("piezo_dbo")
    platform = Platform() if options.coupling is None else Platform(coupling=options.coupling)
    wanted = {n: row for n, row in rows().items() if options.rows is None or any(text in n for text in options.rows)}
    if not wanted:
        parser.error(f"no row has {' or '.join(options.rows)} in its name")
    with ProcessPoolExecutor(options.workers) as pool:
        wide = None if options.rows else pool.submit(measure, 3000.0, options.seed, platform=platform)
        data = measure(800.0, options.seed, platform=platform)
        averaged, floor = data.averaged(), data.floor()
        print(f"stand-in for the piezo platform, noise floor {floor:.4f} (published {PUBLISHED_FLOOR})")
        fits = table(wanted, averaged[:-1], averaged[-1], floor, pool, starts=options.starts, stable=SLOWEST)
        print(by_training(fits, averaged[:-1], averaged[-1], floor))
        if options.rows is not None:
            return
        if folder is None:
            print("the recordings of the real piezo stack are not here (see problems.piezo_stack)")
        else:
            stack = stack_recordings(folder)
            half = len(stack["first half"])
            print("real piezo stack, first half -> second half of the varying amplitude")
            table(stack_rows(), [stack["first half"]], stack["varying"].with_(skip=half), None, pool, starts=4)
        print(f"{time.perf_counter() - began:.0f} s in all")
    if wide is not None and not options.no_figures:
        from .table3_figures import draw

        print(f"figures: {draw(wide.result(), data, fits, options.out)}")


if __name__ == "__main__":
    main()
