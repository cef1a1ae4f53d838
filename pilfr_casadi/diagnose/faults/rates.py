"""Recorded rates that do not belong to the recorded coordinate of a port.

A port may take its coordinate z and its rate v from two inputs, such as a position and a speed; or two outputs are
recorded of which one is, by the simulator's equations, the derivative of the other. Drives often log a speed
that is filtered: with a lag of first order, τ dv/dt + v = dz/dt. Integrated, this is z = ∫v dt + τ v + const, which is
linear in τ and needs no derivative of a noisy z. A factor g of the rate (another unit, another sign) is found in the
same regression, z = g (∫v dt + τ v) + const + drift t.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..._base import in_words
from ...simulators import SENSOR, port_name, signals
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
        if not 1 / BETTER_RATIO < factor < BETTER_RATIO:
            words.append(f"is {factor:.3g} times the derivative of {coordinate}, as from another unit or sign")
        if abs(late) > bench.dt:
            when = "late, as from a filter" if late > 0 else "early"
            words.append(f"{'comes' if words else f'follows the derivative of {coordinate}'} {abs(late):.3g} s {when}")
        if words:
            sentence = (
                f"{rate} {in_words(words)}. Laws that depend on the rate, such as friction, may then go unnamed or get "
                f"wrong names: take the rate from {coordinate} instead."
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
    """Generate the outputs whose derivative, by the simulator's equations, is another output or an input."""
    simulator, evaluate, rng = bench.simulator, signals(bench.simulator), np.random.default_rng(0)
    points = [[rng.uniform(0.5, 1.5, evaluate.size_in(i)) for i in range(N_ARGUMENTS)] for _ in range(POINTS)]
    values = [evaluate(*point)[:2] for point in points]
    z, dz = (np.column_stack([np.array(value[i]) for value in values]) for i in (0, 1))
    ports = [port.name for port in simulator.all_ports()]
    rows = {name: ports.index(port_name(SENSOR, name)) for name in simulator.output_names}
    inputs = np.column_stack([np.ravel(point[INPUTS]) for point in points])
    recorded = {name: (inputs[i], [r.u[:, i] for r in bench.recordings]) for i, name in enumerate(simulator.inputs)}
    for i, name in enumerate(simulator.output_names):
        recorded[name] = z[rows[name]], [r.y[:, i] for r in bench.recordings]
    for coordinate, row in rows.items():
        for rate, (there, runs) in recorded.items():
            if rate != coordinate and np.allclose(dz[row], there, rtol=1e-9):
                yield rate, coordinate, recorded[coordinate][1], runs


def _compare(z: list[np.ndarray], v: list[np.ndarray], dt: float) -> tuple[float, float]:
    """Compute by how many seconds rates v are late, and their factor; (0, 1) if they belong to coordinates z."""
    columns = [np.concatenate([np.zeros(1), np.cumsum((one[1:] + one[:-1]) / 2) * dt]) for one in v]

    def apart(one: np.ndarray) -> np.ndarray:  # without its mean and its drift in a recording
        t = np.linspace(-1.0, 1.0, len(one))
        basis = np.linalg.qr(np.column_stack([np.ones(len(one)), t]))[0]
        return np.asarray(one - basis @ (basis.T @ one))

    path, integral, rate = (np.concatenate([apart(one) for one in each]) for each in (z, columns, v))
    (g, c), *_ = np.linalg.lstsq(np.column_stack([integral, rate]), path)
    as_given, corrected = np.linalg.norm(path - integral), np.linalg.norm(path - g * integral - c * rate)
    followed = corrected < np.linalg.norm(path) / FAR_RATIO and as_given > FAR_RATIO * corrected
    return (float(c / g), float(1 / g)) if followed and g else (0.0, 1.0)
