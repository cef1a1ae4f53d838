"""An observer that finds hysteresis memory it has been told wrongly: extended against unscented Kalman filter.

    python -m problems.observer

The model of the two-mass rig is fitted to its training record. On the test record, filters are started in the middle
of the motion, once from the state that the simulation has there, and from memories that are wrong by their own size.
Printed is the one-step prediction error, wrong start over known start, after the output has made none, one and two
excursions (beyond its rms value on both sides), with the time a step; median and worst of the wrong starts.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import numpy as np

from pilfr_casadi.cli.demo import demo_recordings
from pilfr_casadi.control import ekf_step, kalman_filter
from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii

Array = np.ndarray
WINDOW = 400  # samples that are judged


def ukf_step(function: ca.Function, Q: Array, R: Array) -> ca.Function:
    """One step of the unscented Kalman filter, the 2 n cubature points of Arasaratnam & Haykin (2009)."""
    n, n_u, n_y = function.size1_in(0), function.size1_in(1), function.size1_out(1)
    sizes = (("x", (n,)), ("u", (n_u,)), ("y", (n_y,)), ("P", (n, n)))
    x, u, y, p = (ca.MX.sym(k, *size) for k, size in sizes)

    matrix = ca.SX.sym("P", n, n)
    triangle = ca.Function("triangle", [matrix], [ca.chol(matrix).T])

    def points(mean: ca.MX, covariance: ca.MX) -> ca.MX:
        root = np.sqrt(n) * triangle(covariance + 1e-9 * ca.DM(Q))
        return ca.repmat(mean, 1, 2 * n) + ca.horzcat(root, -root)

    both = function.map(2 * n)
    cloud = points(x, p)
    outputs = both(cloud, ca.repmat(u, 1, 2 * n))[1]
    predicted = ca.sum2(outputs) / (2 * n)
    dx, dy = cloud - ca.repmat(x, 1, 2 * n), outputs - ca.repmat(predicted, 1, 2 * n)
    innovation = dy @ dy.T / (2 * n) + R
    gain = ca.solve(innovation, dy @ dx.T / (2 * n)).T
    corrected = x + gain @ (y - predicted)
    cloud = points(corrected, p - gain @ innovation @ gain.T)
    following = both(cloud, ca.repmat(u, 1, 2 * n))[0]
    mean = ca.sum2(following) / (2 * n)
    spread = following - ca.repmat(mean, 1, 2 * n)
    covariance = spread @ spread.T / (2 * n) + Q
    return ca.Function("ukf", [x, p, u, y], [mean, (covariance + covariance.T) / 2, predicted])


def excursions(y: Array, n: int) -> int:
    """First sample by which y has been beyond its rms value n times on each side."""
    level, k = float(np.sqrt(np.mean(y**2))), 0
    for side in [1, -1] * n:
        k += int(np.argmax(side * y[k:] > level))
    return k


def ratios(seeds: int = 10, start: int = 500) -> dict[str, tuple[Array, float]]:
    """Filter -> (wrong over known prediction error after 0, 1, 2 excursions (seeds, 3), ms a step)."""
    records = demo_recordings()
    rig = fit(PILFR(5, PrandtlIshlinskii(Play, 10)), records["train"], starts=3)
    test, function, made = records["multisine"], rig.to_casadi(), kalman_filter(rig, records["train"])
    n_x, n = rig.model.n_x, len(made.x0)
    known = np.asarray(function.mapaccum("states", start)(np.zeros(n), test.u[:start].T)[0])[:, -1]
    u, y = test.u[start:], test.y[start:]
    at = [excursions(y[:, 0], k) for k in range(3)]
    out = {}
    kinds: dict[str, Callable[..., ca.Function]] = {"extended": ekf_step, "unscented": ukf_step}
    for name, kind in kinds.items():
        step = kind(function, made.Q, made.R)
        run = step.mapaccum("run", at[-1] + WINDOW, 2)
        m = at[-1] + WINDOW

        def errors(x0: Array, p0: Array, run: ca.Function = run, m: int = m) -> Array:
            predicted = np.asarray(run(x0, p0, u[:m].T, y[:m].T)[2]).T
            return np.array([np.sqrt(np.mean((predicted - y[:m])[k : k + WINDOW] ** 2)) for k in at])

        begin = time.perf_counter()
        reference, rows = errors(known, made.Q), []
        for seed in range(seeds):
            wrong = known.copy()
            wrong[n_x:] += made.spread[n_x:] * np.random.default_rng(seed).standard_normal(n - n_x)
            rows.append(errors(wrong, made.P0) / reference)
        out[name] = np.array(rows), 1e3 * (time.perf_counter() - begin) / (m * (seeds + 1))
    return out


def main() -> None:
    """Print the table."""
    print(f"{'filter':<12}{'after 0 excursions':>22}{'1':>18}{'2':>18}{'ms a step':>12}   wrong / known start")
    for name, (rows, cost) in ratios().items():
        cells = "".join(f"{np.median(c):>10.3f} / {np.max(c):5.3f}" for c in rows.T)
        print(f"{name:<12}{cells}{cost:>12.3f}   median / worst")


if __name__ == "__main__":
    main()
