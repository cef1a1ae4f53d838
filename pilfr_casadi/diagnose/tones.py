"""Steady tones in what a fit leaves, which no input holds: mains hum, a fan, an unbalanced motor.

A tone is a line of the residual's spectrum far above those around it, whose amplitude and phase stay over the record
and which is neither in an input nor a harmonic or a mixture of an input's few lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ..data import Recording
from .gates import Gate
from .workbench import Fitted, Workbench

FEWEST, SLOWEST = 256, 10  # samples, and periods in the record, that a tone is told from
FAR, IN_INPUT = 50.0, 10.0  # times the lines around, in the residual and in an input
AROUND, OWN = 30, 3  # lines on either side that are compared with, and that belong to the tone
SHARE = 0.05  # of the residual's power
STEADY = 0.5  # of the amplitude by which a quarter's may differ
LINES, STRONG, ORDER = 3, 0.01, 7  # an input that has no more, of that power over its strongest, mixes them
SPARSE, HARMONICS = 16, 60  # lines of the record that lie between an input's harmonics at least, and their number


def tones(bench: Workbench, fitted: Fitted) -> list[Gate]:
    """A note for each output in whose residual, in every recording, the same tone stands."""
    found = []
    for i, name in enumerate(bench.simulator.output_names):
        pairs = zip(fitted.residual, bench.recordings, strict=True)
        each = [tone(e[r.skip :, i], r) for e, r in pairs if len(r) - r.skip >= FEWEST]
        told = [t for t in each if t is not None]
        longest = max((len(r) for r in bench.recordings), default=0) * bench.dt
        if not told or len(told) < len(each) or np.ptp([f for f, _ in told]) > 2 / longest:
            continue
        f, amplitude = float(np.mean([f for f, _ in told])), float(np.mean([a for _, a in told]))
        unit = bench.recordings[0].units.get(name, "")
        sentence = (
            f"{name} holds a steady tone of {f:.4g} Hz, amplitude {amplitude:.3g}{f' {unit}' if unit else ''}, that is "
            "in no input, as from mains hum or a fan: shield or filter it, or record what causes it."
        )
        share = amplitude**2 / 2 / bench.scale[i] ** 2 / len(bench.scale) / fitted.cost
        found.append(Gate(name, "tone", f, sentence, False, left=1 - min(share, 1.0)))
    return found


def tone(e: np.ndarray, r: Recording) -> tuple[float, float] | None:
    """Frequency, Hz, and amplitude of the tone in the residual of one output, or None."""
    n, e = len(e), e - np.mean(e)
    power = _power(e)
    k = SLOWEST + int(np.argmax(power[SLOWEST:-OWN]))
    if power[k] < FAR * _around(power, k):
        return None
    f = _refined(e, k)
    whole = _wave(e, f, slice(None))
    quarters = [_wave(e, f, slice(q * n // 4, (q + 1) * n // 4)) for q in range(4)]
    unsteady = max(abs(q - whole) for q in quarters) > STEADY * abs(whole)
    if unsteady or abs(whole) ** 2 / 2 < SHARE * float(np.mean(e**2)):
        return None
    return None if any(_from(u, f, r) for u in r.u[r.skip :].T) else (f / r.dt, abs(whole))


def _power(v: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.fft.rfft((v - np.mean(v)) * np.hanning(len(v)))) ** 2)


def _around(power: np.ndarray, k: int) -> float:
    """Median of the lines around line k."""
    near = np.arange(max(k - AROUND, 1), min(k + AROUND + 1, len(power)))
    return float(np.median(power[near[np.abs(near - k) > OWN]]))


def _wave(e: np.ndarray, f: float, part: slice) -> complex:
    """Amplitude and phase of the frequency f, a share of the sampling rate, in a part of e, by least squares."""
    angle = 2 * np.pi * f * np.arange(len(e))[part]
    a, b, _ = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))]), e[part])[0]
    return complex(a, -b)


def _refined(e: np.ndarray, k: int) -> float:
    """The frequency near line k of the strongest wave, as a share of the sampling rate."""
    from scipy.optimize import minimize_scalar

    ends = (k - 1) / len(e), (k + 1) / len(e)
    found = minimize_scalar(lambda f: -abs(_wave(e, f, slice(None))), bounds=ends, options={"xatol": 1e-3 / len(e)})
    return float(found.x)


def _from(u: np.ndarray, f: float, r: Recording) -> bool:
    """Whether an input holds the frequency, or its few lines or its period make it in something nonlinear."""
    n, power = len(u), _power(u)
    k = round(f * n)
    if np.max(power[max(k - 1, 0) : k + 2]) > IN_INPUT * _around(power, k):
        return True
    if r.period and abs(f * r.period - round(f * r.period)) * n < r.period:
        return True
    peaks = [j for j in range(2, len(power) - 2) if power[j] == max(power[max(j - OWN, 0) : j + OWN + 1])]
    strong = [j for j in peaks if power[j] > STRONG * np.max(power)]
    lines = [_refined(u, j) for j in strong[: LINES + 1]]
    made = _mixed(lines) if 0 < len(lines) <= LINES else list[float]()
    if lines and lines[0] * n > SPARSE and all(abs(v / lines[0] - round(v / lines[0])) < 0.05 for v in lines):
        made += [m * lines[0] for m in range(1, HARMONICS)]
    return any(abs(_folded(v) - f) * n < 2 for v in made)


def _mixed(lines: Sequence[float]) -> list[float]:
    """Mixtures of a few lines."""
    orders = [c for c in itertools.product(range(-ORDER, ORDER + 1), repeat=len(lines)) if sum(map(abs, c)) <= ORDER]
    return [abs(sum(a * f for a, f in zip(c, lines, strict=True))) for c in orders]


def _folded(f: float) -> float:
    """Where a frequency above half the sampling rate appears."""
    return abs(f - round(f))
