"""Describe what moves a machine in recordings: reversals, amplitudes and rests at ports, and a single frequency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .detectability import SMALL_SHARE, live_ports, port_units
from .fits.linearise import Probe, Run
from .fits.workbench import Workbench

SMALLEST_SWING = SMALL_SHARE / 2  # of a reversal, as a share of the travel: an amplitude a tenth of the largest
LEAST_SAMPLES = 10  # least length of a signal whose single frequency is reported, and of a rest


@dataclass(frozen=True)
class Excitation:
    """Motion of a port's local coordinate.

    Attributes
    ----------
    travel : float
        Largest minus smallest value, in `unit`.
    reversals : int
        Turning points with swings of at least a twentieth of the travel on both sides.
    amplitudes : int
        Distinct amplitudes of nine tenths of the swings between reversals, or of all without such a swing; amplitudes
        closer than a tenth of the largest count once.
    rests : int
        Stretches in which the coordinate stays within a twentieth of the travel for longer than twice the time that a
        typical swing takes in motion.
    """

    port: str
    travel: float
    unit: str
    reversals: int
    amplitudes: int
    rests: int


def excitations(bench: Workbench, probe: Probe, runs: Sequence[Run]) -> Iterator[Excitation]:
    """Count reversals, distinct amplitudes and rests of every live port's local coordinate along the refitted run."""
    for port in live_ports(bench.simulator):
        signals = [r.z[:, probe.ports.index(port.name)] for r in runs]
        travel = float(np.ptp(np.concatenate(signals)))
        least = SMALLEST_SWING * travel
        reversals, rests, swings = 0, 0, list[float]()
        for z in signals if travel > 0 else ():
            turns = _turning_points(z, least)
            reversals += max(len(turns) - 2, 0)
            longest = max(2 * _time_in_motion(z, turns), LEAST_SAMPLES) if turns[1:] else SMALL_SHARE * len(z)
            resting = _rests(z, least, longest)
            rests += len(resting)
            # a recording cuts its first and last swing short, unless it rests there
            first, last = (not any(a <= end < b for a, b in resting) for end in (0, len(z) - 1))
            whole = turns[first : len(turns) - last] if len(turns) > 3 else turns
            swings += np.abs(np.diff(z[whole])).tolist()
        unit = port.across_unit or port_units(port, bench.recordings[0])[1]
        yield Excitation(port.name, travel, unit, reversals, _count_distinct(np.array(swings)), rests)


def single_frequency(runs: Sequence[np.ndarray], dt: float) -> float:
    """Find the only frequency, Hz, of a signal in all recordings (M,); 0 if it has several or none.

    A sine, with a level, has to leave at most a tenth of the signal's deviation in each recording.
    """
    found = [_sine(u, dt) for u in runs if np.ptp(u) > 0 and len(u) >= LEAST_SAMPLES]
    alike = bool(found) and max(f for f, _ in found) - min(f for f, _ in found) <= SMALL_SHARE * found[0][0]
    return found[0][0] if alike and max(left for _, left in found) <= SMALL_SHARE else 0.0


def _sine(u: np.ndarray, dt: float) -> tuple[float, float]:
    """Fit a sine of a period at least, and a level; return its frequency, Hz, and the share of the deviation left."""
    from scipy.optimize import minimize_scalar
    from scipy.signal import periodogram

    t, deviation = dt * np.arange(len(u)), np.std(u)

    def left(f: float) -> float:
        basis = np.column_stack([np.ones(len(t)), np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)])
        return float(np.std(u - basis @ np.linalg.lstsq(basis, u)[0]) / deviation)

    frequencies, power = periodogram(u, 1 / dt)
    peak, width = float(frequencies[np.argmax(power)]), 1 / (dt * len(u))
    best = minimize_scalar(left, bounds=(max(peak - width, width), min(peak + width, 0.5 / dt)), method="bounded")
    return float(best.x), float(best.fun)


def _turning_points(z: np.ndarray, least: float) -> list[int]:
    """Find the turning points of z (M,) between swings of at least `least`, the first and the last included."""
    turns, extreme, direction = [0], 0, 0.0
    for k, value in enumerate(z.tolist()):
        if direction == 0:
            if abs(value - z[0]) >= least:
                direction, extreme = np.sign(value - z[0]), k
        elif direction * (value - z[extreme]) >= 0:
            extreme = k
        elif direction * (z[extreme] - value) >= least:
            turns.append(extreme)
            direction, extreme = -direction, k
    return [*turns, extreme] if extreme > turns[-1] else turns


def _count_distinct(swings: np.ndarray) -> int:
    """Count the distinct sizes of nine tenths of the swings; sizes within a tenth of the largest count once."""
    if not len(swings):
        return 0
    left, counts = np.sort(swings)[::-1], list[int]()
    apart = SMALL_SHARE * float(left[0])
    while len(left):
        own = left > left[0] - apart
        counts.append(int(np.sum(own)))
        left = left[~own]
    share = np.cumsum(sorted(counts, reverse=True)) / sum(counts)
    return int(np.searchsorted(share, 1 - SMALL_SHARE - 1e-9) + 1)


def _time_in_motion(z: np.ndarray, turns: Sequence[int]) -> float:
    """Compute how many samples the median swing of z (M,) takes at the speed with which half of all travel is done."""
    speeds = np.sort(np.abs(np.diff(z)))
    half = np.searchsorted(np.cumsum(speeds), np.sum(speeds) / 2)
    return float(np.median(np.abs(np.diff(z[list(turns)]))) / max(speeds[half], 1e-300))


def _rests(z: np.ndarray, least: float, samples: float) -> list[tuple[int, int]]:
    """Find the stretches of more than `samples` samples in which z stays within `least`: first sample and end."""
    found, begin, low, high = list[tuple[int, int]](), 0, z[0], z[0]
    for k, value in enumerate(z):
        low, high = min(low, value), max(high, value)
        if high - low > least or k == len(z) - 1:
            end = k if high - low > least else k + 1
            found += [(begin, end)] if end - begin > samples else []
            begin, low, high = k, value, value
    return found
