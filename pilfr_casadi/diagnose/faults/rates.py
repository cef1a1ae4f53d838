"""Recorded rates that do not belong to the recorded coordinate of a port.

A port may take its coordinate z and its rate v from two inputs, such as a position and a speed; or two outputs are
recorded of which one is, by the simulator's equations, the derivative of the other. Drives often log a speed
that is filtered: with a lag of first order, τ dv/dt + v = dz/dt. Integrated, this is z = ∫v dt + τ v + const, which is
linear in τ and needs no derivative of a noisy z. A factor g of the rate (another unit, another sign) is found in the
same regression, z = g (∫v dt + τ v) + const + drift t. A rate that is only delayed loses no amplitude, which
looks like a factor in a narrow band; so a factor is told only if it is the same with a delay in place of the lag.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ..._base import in_words
from ...data import Recording
from ...simulators import evaluate_at_random_points, stack
from ..fits.evidence import BETTER_RATIO, FAR_RATIO
from ..fits.workbench import Workbench
from .gates import Gate
from .timing import TimeShift, minimise

ROUNDING = 1e-9  # share of a coordinate that is no motion


def find_wrong_rates(bench: Workbench) -> list[Gate]:
    """Note each port whose recorded rate is late, or of another size, compared with its recorded coordinate."""
    found = list[Gate]()
    for rate, coordinate, runs in _recorded_pairs(bench):
        late, factor = _compare(runs)
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


def _recorded_pairs(bench: Workbench) -> Iterator[tuple[str, str, list[Recording]]]:
    """Generate each recorded rate and its recorded coordinate: their names, and runs with outputs z, ∫v dt and v.

    Recorded are outputs, and what ports read from inputs alone. An input counts as a rate only if a port reads it as
    its rate: otherwise it is a command, which the machine may follow late.
    """
    from scipy.integrate import cumulative_trapezoid

    simulator, recordings = bench.simulator, bench.recordings
    x, u, p, t = simulator.symbols()
    moving, slope = stack(x, u), ca.SX.sym("slope", len(simulator.inputs))
    flow = ca.SX.zeros(len(simulator.states)) if simulator.discrete else simulator.derivatives(x, u, p, t)

    def at_points(value: Any) -> np.ndarray:
        known = ca.vertcat(moving, slope, stack(p), t)
        return evaluate_at_random_points(ca.Function("rate", [known], [value]))[0]

    # name -> the rate by the simulator's equations, at random points, and the recorded signal of each recording
    coordinates, rates = (dict[str, tuple[np.ndarray, list[np.ndarray]]]() for _ in range(2))
    for i, (name, y) in enumerate(simulator.measured(x, u, p, t).items()):
        recorded = [r.y[:, i] for r in recordings]
        coordinates[name] = at_points(ca.jtimes(y, moving, ca.vertcat(flow, slope))), recorded
        rates[name] = at_points(y), recorded
    for port in (port for port in simulator.all_ports() if port.rate is not None):
        rate = simulator.rate(port, x, u, p, t)
        for signals, value in ((coordinates, simulator.across(port, x, u, p, t)), (rates, rate)):
            name = in_words([symbol.name() for symbol in ca.symvar(value)])
            if name and not ca.depends_on(value, ca.vertcat(stack(x, p), t)):
                of_inputs = ca.Function("signal", [stack(u)], [value])
                signals.setdefault(name, (at_points(rate), [of_inputs(r.u.T).full().ravel() for r in recordings]))
    for coordinate, (by_equations, zs) in coordinates.items():
        for name, (there, vs) in rates.items():
            if name != coordinate and np.any(there) and np.allclose(by_equations, there, rtol=1e-9, atol=0):
                both = zip(recordings, zs, vs, strict=True)
                columns = [(r, [z, cumulative_trapezoid(v, dx=r.dt, initial=0), v]) for r, z, v in both]
                yield name, coordinate, [Recording(r.u, np.column_stack(y), r.dt) for r, y in columns]


def _compare(runs: Sequence[Recording]) -> tuple[float, float]:
    """Compute by how many seconds rates are late, and their factor; (0, 1) if they belong to their coordinates."""
    from scipy.signal import detrend

    z, integral, rate = np.concatenate([detrend(r.y, axis=0) for r in runs]).T
    if np.linalg.norm(z) < ROUNDING * np.linalg.norm(np.concatenate([r.y[:, 0] for r in runs])):  # only a drift
        return 0.0, 1.0
    (g, c), *_ = np.linalg.lstsq(np.column_stack([integral, rate]), z)
    as_given, corrected = np.linalg.norm(z - integral), np.linalg.norm(z - g * integral - c * rate)
    if not (corrected < np.linalg.norm(z) / FAR_RATIO and as_given > FAR_RATIO * corrected and g):
        return 0.0, 1.0
    late, factor = float(c / g), float(1 / g)
    if _is_one(factor):
        return late, factor

    def read(delay: float) -> tuple[np.ndarray, np.ndarray]:
        moved = [TimeShift("rate", "alignment", delay, columns=(1,)).read(r) for r in runs]
        return tuple(np.concatenate([detrend(r.y[r.skip :, :2], axis=0) for r in moved]).T)

    def left(delay: float) -> float:
        z, integral = read(delay)
        return float(1 - (z @ integral) ** 2 / max((z @ z) * (integral @ integral), 1e-300))

    half = max(r.t[-1] for r in runs) / 2  # so that much of the longest recording is left
    delay, _ = minimise(left, *sorted((0.0, float(np.clip(late, -half, half)))))
    z, integral = read(delay)
    delayed_factor = float(integral @ integral / (z @ integral))
    if _is_one(delayed_factor / factor):
        return late, factor
    return delay if _is_one(delayed_factor) else late, 1.0


def _is_one(factor: float) -> bool:
    return 1 / BETTER_RATIO < factor < BETTER_RATIO
