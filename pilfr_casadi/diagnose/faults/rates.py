"""Recorded rates that do not belong to the recorded coordinate of a port.

A port may take its coordinate z and its rate v from two inputs, such as a position and a speed; or two outputs are
recorded of which one is, by the simulator's equations, the derivative of the other. Drives often log a speed
that is filtered: with a lag of first order, τ dv/dt + v = dz/dt. Integrated, this is z = ∫v dt + τ v + const, which is
linear in τ and needs no derivative of a noisy z. A factor g of the rate (another unit, another sign) is found in the
same regression, z = g (∫v dt + τ v) + const + drift t. A rate that is only delayed loses no amplitude, which
looks like a factor in a narrow band; so a factor is found only if a delay alone does not do as well.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from ..._base import in_words
from ...simulators import SENSOR, calls_external, port_name, signals
from ..fits.evidence import BETTER_RATIO, FAR_RATIO
from ..fits.workbench import Workbench
from .gates import Gate

N_ARGUMENTS, INPUTS = 5, 1  # arguments of `signals`, and the number of the inputs among them
POINTS = 3  # random points at which two expressions are compared


def find_wrong_rates(bench: Workbench) -> list[Gate]:
    """Note each port whose recorded rate is late, or of another size, compared with its recorded coordinate."""
    found = list[Gate]()
    for rate, coordinate, z, v in _recorded_pairs(bench):
        late, factor = _compare(z, v, bench.dt)
        words = []
        if not _is_one(factor):
            words.append(f"is {factor:.3g} times the derivative of {coordinate}, as from another unit or sign")
        if abs(late) > bench.dt:
            when = "late, as from a filter" if late > 0 else "early"
            words.append(f"{'comes' if words else f'follows the derivative of {coordinate}'} {abs(late):.3g} s {when}")
        if words:
            instead = f"compute it as the derivative of {coordinate}"
            if rate in bench.simulator.output_names:
                instead = f"leave {rate} out of the simulator's outputs"
            sentence = (
                f"{rate} {in_words(words)}. Laws that depend on the rate, such as friction, may then go unnamed or get "
                f"wrong names: {instead}."
            )
            found.append(Gate(rate, "rate", late, sentence, corrected=False))
    return found


def _recorded_pairs(bench: Workbench) -> Iterator[tuple[str, str, list[np.ndarray], list[np.ndarray]]]:
    """Generate each recorded rate and its recorded coordinate: their names, and both signals in all recordings."""
    found = dict[tuple[str, str], tuple[list[np.ndarray], list[np.ndarray]]]()
    for rate, coordinate, z, v in (*_pairs_of_inputs(bench), *_pairs_of_outputs(bench)):
        found.setdefault((rate, coordinate), (z, v))
    for names, both in found.items():
        yield *names, *both


def _pairs_of_inputs(bench: Workbench) -> Iterator[tuple[str, str, list[np.ndarray], list[np.ndarray]]]:
    """Generate the ports whose coordinate and rate are functions of inputs alone."""
    simulator, evaluate = bench.simulator, signals(bench.simulator)
    read = [[np.array(evaluate.jac_sparsity(out, i), dtype=bool) for i in range(N_ARGUMENTS)] for out in (0, 1)]
    rest = [np.zeros(evaluate.size_in(i)) for i in range(N_ARGUMENTS) if i != INPUTS]
    for k, port in enumerate(simulator.all_ports()):
        coordinate, rate = (in_words([simulator.inputs[i] for i in np.flatnonzero(each[INPUTS][k])]) for each in read)
        others = any(np.any(one[k]) for each in read for i, one in enumerate(each) if i != INPUTS)
        if port.rate is None or others or not coordinate or not rate or coordinate == rate:
            continue
        runs = [evaluate.map(len(r))(rest[0], r.u.T, *rest[1:])[:2] for r in bench.recordings]
        yield rate, coordinate, *([np.array(run[i])[k] for run in runs] for i in (0, 1))  # type: ignore[misc]


def _pairs_of_outputs(bench: Workbench) -> Iterator[tuple[str, str, list[np.ndarray], list[np.ndarray]]]:
    """Generate the outputs whose derivative, by the simulator's equations, is another output, or an input.

    An input counts only if a port reads it as its rate: otherwise it is a command, which the machine may follow late.
    """
    simulator, evaluate = bench.simulator, signals(bench.simulator)
    points = _points(bench, evaluate)
    if not points:
        return
    values = [evaluate(*point)[:2] for point in points]
    z, dz = (np.column_stack([np.array(value[i]) for value in values]) for i in (0, 1))
    ports = simulator.all_ports()
    rows = {name: [port.name for port in ports].index(port_name(SENSOR, name)) for name in simulator.output_names}
    read = np.array(evaluate.jac_sparsity(1, INPUTS), dtype=bool)[[port.rate is not None for port in ports]]
    recorded = {
        name: (np.array([np.ravel(point[INPUTS])[i] for point in points]), [r.u[:, i] for r in bench.recordings])
        for i, name in enumerate(simulator.inputs)
        if np.any(read[:, i])
    }
    for i, name in enumerate(simulator.output_names):
        recorded[name] = z[rows[name]], [r.y[:, i] for r in bench.recordings]
    for coordinate, row in rows.items():
        for rate, (there, runs) in recorded.items():
            if rate != coordinate and np.any(there) and np.allclose(dz[row], there, rtol=1e-9, atol=0):
                yield rate, coordinate, recorded[coordinate][1], runs


def _points(bench: Workbench, evaluate: ca.Function) -> list[list[np.ndarray]]:
    """Return points at which two expressions are compared: the arguments of `signals`.

    They are random; but another program, which may fail there, is called where the refitted run has been.
    """
    rng, sizes = np.random.default_rng(0), [evaluate.size_in(i) for i in range(N_ARGUMENTS)]
    points = [[rng.uniform(0.5, 1.5, size) for size in sizes] for _ in range(POINTS)]
    if not calls_external(evaluate):
        return points
    states, inputs = bench.typical or (np.zeros((0, 0)), np.zeros((0, 0)))
    finite = np.flatnonzero(np.all(np.isfinite(np.hstack([states, inputs])), axis=1))
    p = bench.simulator.parameter_set.start[: sizes[-1][0]]
    times = [np.array([[r.start]]) for r in bench.recordings[:1]]
    picked = finite[np.linspace(0, len(finite) - 1, POINTS + 2).astype(int)[1:-1]] if len(finite) else []
    return [[states[k], inputs[k], points[0][2], *times, p] for k in picked]


def _compare(z: list[np.ndarray], v: list[np.ndarray], dt: float) -> tuple[float, float]:
    """Compute by how many seconds rates v are late, and their factor; (0, 1) if they belong to coordinates z."""
    columns = [np.concatenate([np.zeros(1), np.cumsum((one[1:] + one[:-1]) / 2) * dt]) for one in v]
    path, integral, rate = (np.concatenate([_apart(one) for one in each]) for each in (z, columns, v))
    (g, c), *_ = np.linalg.lstsq(np.column_stack([integral, rate]), path)
    as_given, corrected = np.linalg.norm(path - integral), np.linalg.norm(path - g * integral - c * rate)
    if not (corrected < np.linalg.norm(path) / FAR_RATIO and as_given > FAR_RATIO * corrected and g):
        return 0.0, 1.0
    late, factor = float(c / g), float(1 / g)
    if not _is_one(factor):
        delay, own, left = _compare_delayed(z, columns, dt, late)
        if _is_one(own) and left < FAR_RATIO * corrected / np.sqrt(len(path)):
            return delay, own
    return late, factor


def _compare_delayed(
    z: list[np.ndarray], integrals: list[np.ndarray], dt: float, latest: float
) -> tuple[float, float, float]:
    """Compute the delay of a rate, up to the latest, its factor, and the rms error that they leave of coordinates z."""
    from scipy.interpolate import CubicSpline
    from scipy.optimize import minimize_scalar

    curves = [CubicSpline(np.arange(len(one)) * dt, one) for one in integrals]

    def fit(delay: float) -> tuple[float, float]:
        paths, moved = list[np.ndarray](), list[np.ndarray]()
        for one, curve in zip(z, curves, strict=True):
            at = curve.x + delay
            known = (at >= 0) & (at <= curve.x[-1])
            paths.append(_apart(one[known]))
            moved.append(_apart(curve(at[known])))
        path, integral = np.concatenate(paths), np.concatenate(moved)
        if not integral @ integral:
            return np.inf, np.inf
        g = float(integral @ path / (integral @ integral))
        return g, float(np.linalg.norm(path - g * integral) / np.sqrt(len(path)))

    half = dt * max(map(len, z)) / 2  # so that much of the longest recording is left
    bounds = max(min(latest, 0.0), -half), min(max(latest, 0.0), half)
    found = minimize_scalar(lambda delay: fit(delay)[1], bounds=bounds, method="bounded")
    g, left = fit(found.x)
    return float(found.x), 1 / g if g else np.inf, left


def _apart(values: np.ndarray) -> np.ndarray:
    """Return a signal in a recording without its mean and its drift."""
    basis = np.linalg.qr(np.column_stack([np.ones(len(values)), np.linspace(-1.0, 1.0, len(values))]))[0]
    return np.asarray(values - basis @ (basis.T @ values))


def _is_one(factor: float) -> bool:
    return 1 / BETTER_RATIO < factor < BETTER_RATIO
