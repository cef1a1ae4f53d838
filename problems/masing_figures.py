"""Figs. 3, 7, 8, 9, 10 and 11 of Krikelis et al. (2024), drawn from our own records and fits, and what it says of them.

Each claim of the paper that has a number, or can be given one, stands beside the number found here (`Claim`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pilfr_casadi import plots
from pilfr_casadi.cli.demo import FLOOR, PUBLISHED, SETS
from pilfr_casadi.identify import Fit
from pilfr_casadi.linear import BLA, frequency_subspace, robust_bla
from pilfr_casadi.models import generalized_play, play, stop
from pilfr_casadi.plots.canvas import BLUE, VERMILLION, finish

from .masing_data import FS, Benchmark, benchmark

FREQUENCIES = (0.5, 1.5, 3.0, 6.0, 12.0, 24.0)  # Hz, Fig. 7
LOW = 5.0  # Hz: "low frequencies" of Sec. 6.3
KINDS = {"fig11_starts": "paper's start", "fig11_regridded": "re-gridded"}


class Result(Protocol):
    """What the figures show of a row of the table."""

    @property
    def row(self) -> Any:
        """The row, with its name."""

    @property
    def errors(self) -> np.ndarray:
        """Errors of its starts on the three records: (starts, 3)."""

    @property
    def fit(self) -> Fit:
        """The best fit."""

    def percentile(self, share: float) -> np.ndarray:
        """A percentile of each column of the errors."""


@dataclass(frozen=True)
class Claim:
    """What the paper says about a figure, and what is found here."""

    figure: str
    what: str
    paper: str
    here: str

    def __str__(self) -> str:
        return f"{self.figure:<9} {self.what:<64} {self.paper:<38} {self.here}"


def _cycle(data: Benchmark, f: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of mass 1 in m and spring force in N for the cycle of the sweep around a frequency."""
    motion = data.truth["sweep"]
    middle, half = int((f - 0.1) / 1.17 * FS), max(int(0.6 * FS / f), 6)
    part = slice(max(middle - half, 0), middle + half)
    return motion.x1[part], motion.k_H[part]


def loop_width(x: np.ndarray, force: np.ndarray) -> float:
    """Largest difference of displacement between crossings of zero force, in the unit of x."""
    at = np.flatnonzero(force[:-1] * force[1:] < 0)
    crossings = x[at] - force[at] * (x[at + 1] - x[at]) / (force[at + 1] - force[at])
    return float(np.ptp(crossings)) if len(crossings) > 1 else 0.0


def _of_loops(data: Benchmark) -> list[Claim]:
    grid = np.arange(1.0, 29.0, 0.25)
    widths = np.array([loop_width(*_cycle(data, f)) for f in grid])
    widest, high = float(grid[np.argmax(widths)]), float(np.max(widths[grid >= 12]) / np.max(widths))
    return [
        Claim("Fig. 7", "frequency of the widest loop", "approximately 3 Hz", f"{widest:g} Hz"),
        Claim("Fig. 7", "width above 12 Hz over the widest", "almost insignificant", f"{100 * high:.1f} %"),
    ]


def _draw_operators(r: float = 1.0, amplitude: float = 4.0, samples: int = 2000) -> Any:
    """Draw stop, play and generalized play of threshold r from zero memory, over a fading swing, as Fig. 3."""
    t = np.linspace(0.0, 1.0, samples)
    u = amplitude * (1 - 0.75 * t) * np.sin(6 * np.pi * t)

    def gamma_l(z: float) -> float:
        return z / 2 + (z / 4) ** 3

    def gamma_r(z: float) -> float:
        return gamma_l(z) - 0.1

    laws = {
        "stop": lambda z, q: (stop(z, q, r), play(z, q, r)),
        "play": lambda z, q: (play(z, q, r),) * 2,
        "generalized play": lambda z, q: (generalized_play(z, q, r, gamma_l, gamma_r),) * 2,
    }
    figure = plots.new_figure(9.6, 3.4)
    for ax, (name, law) in zip(figure.subplots(1, 3), laws.items(), strict=True):
        q, v = 0.0, np.empty(samples)
        for k, z in enumerate(u):
            v[k], q = law(z, q)
        ax.plot(u, v, color=BLUE, linewidth=1.4)
        ax.plot(u[0], v[0], "o", color=VERMILLION, markersize=5, label="start")
        finish(ax, "input u", "output", f"{name}, r = {r:g}")
    return figure


def _of_operators() -> list[Claim]:
    q, worst = 0.0, 0.0
    for u in 4 * np.sin(np.linspace(0, 20, 500)):
        v = stop(u, q, 1.0)
        q = play(u, q, 1.0)
        worst = max(worst, abs(v + q - u))
    return [Claim("Fig. 3", "play + stop − u, r = 1", "0 (Eq. 8)", f"{worst:.0e} at most")]


def _of_linear_models(bla: BLA) -> list[Claim]:
    f, G, var = bla.frequency, bla.G[:, 0, 0], bla.var_total
    assert var is not None
    errors = {n: np.abs(plots.frequency_response(frequency_subspace(bla, n), f, bla.dt)[:, 0, 0] - G) for n in (4, 5)}
    ratio = float(np.sqrt(np.mean(errors[5] ** 2 / var[:, 0, 0])))
    low = [float(np.sqrt(np.mean(errors[n][f < LOW] ** 2 / np.abs(G[f < LOW]) ** 2))) for n in (4, 5)]
    return [
        Claim("Fig. 8", "error of order 5 over the total distortion, rms", "matching (1)", f"{ratio:.2f}"),
        Claim(
            "Fig. 8",
            f"relative error below {LOW:g} Hz, order 4 and 5",
            "lower with order 5",
            f"{100 * low[0]:.1f} % and {100 * low[1]:.1f} %",
        ),
    ]


def _of_tests(best: Fit, data: Benchmark) -> list[Claim]:
    out, published = [], (PUBLISHED["LTI"], PUBLISHED["PI-LFR N=20"])
    for figure, name in (("Fig. 9", "multisine"), ("Fig. 10", "sweep")):
        paper = [row[SETS.index(name)] for row in published]
        record = data.records[name]
        linear = plots.linear_simulation(best, record)
        of_linear = float(np.sqrt(np.mean((linear - record.y) ** 2)) / np.std(record.y))
        here = f"{of_linear:.4f} and {best.nrmse(record):.4f}"
        what = f"NRMSE on the {name}, linear and PI-LFR N = 20"
        out.append(Claim(figure, what, f"{paper[0]:.4f} and {paper[1]:.4f}", here))
    train = data.records["train"]
    left = (best.simulate(train) - train.y)[:, 0]
    noise = float(np.std(np.diff(left, 3)) / np.sqrt(20) / np.std(train.y))
    return [*out, Claim("Fig. 9", "standard deviation of the noise, estimated", "0.0033", f"{noise:.4f}")]


def _of_starts(found: Mapping[str, Result]) -> list[Claim]:
    out = []
    for result in found.values():
        name = result.row.name
        if not any(name.endswith(kind) for kind in KINDS.values()):
            continue
        quartiles = result.percentile(25), result.percentile(75)
        cells = ", ".join(f"{a:.4f} to {b:.4f}" for a, b in zip(*quartiles, strict=True))
        published = ", ".join(f"{p:.4f}" for p in PUBLISHED[result.row.published])
        out.append(Claim("Fig. 11", f"quartiles, {name}", f"25 %: {published}", cells))
    return out


def draw(seed: int, found: Mapping[str, Result], folder: Path) -> str:
    """Write the figures as PNG into a folder, and say what the paper reports beside what they show.

    Parameters
    ----------
    seed : int
        The record.
    found : mapping
        Name of a row of the table to its result; Figs. 9 and 10 need the default fit with N = 20.
    folder : Path
        Made where it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = benchmark(seed)
    bla = robust_bla(data.steady)
    loops = {f"{f:g} Hz": (1e3 * x, force) for f in FREQUENCIES for x, force in [_cycle(data, f)]}
    figures: dict[str, Any] = {
        "fig03_operators": _draw_operators(),
        "fig07_loops": plots.loops(
            loops, "displacement of mass 1 [mm]", "spring force [N]", title="sweep, truth"
        ).figure,
        "fig08_linear": plots.best_linear_approximation(bla, frequency_subspace(bla, 5), unit="m/N").figure,
    }
    claims = [*_of_operators(), *_of_loops(data), *_of_linear_models(bla)]
    if "PI-LFR N=20, default fit" in found:
        best = found["PI-LFR N=20, default fit"].fit
        figures["fig09_multisine"] = plots.plot_fit(best, data.records["multisine"], steady=data.steady)
        figures["fig10_sweep"] = plots.plot_fit(best, data.records["sweep"])
        claims += _of_tests(best, data)
    for name, kind in KINDS.items():
        rows = {r.row.published.removeprefix("PI-LFR "): r for r in found.values() if r.row.name.endswith(kind)}
        if rows:
            groups = {s: {k: r.errors[:, i].tolist() for k, r in rows.items()} for i, s in enumerate(SETS)}
            published = {s: {k: PUBLISHED[r.row.published][i] for k, r in rows.items()} for i, s in enumerate(SETS)}
            x = f"operators ({len(next(iter(rows.values())).errors)} starts each, {kind})"
            figures[name] = plots.compared_spread(
                groups, published=published, floor=FLOOR, source="published 25th percentile", x=x
            )
    claims += _of_starts(found)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
    head = f"figures in {folder}\n{'figure':<9} {'what':<64} {'Krikelis et al. (2024)':<38} here"
    return "\n".join([head, *map(str, claims)])
