"""Excitations, noise and recording faults of the concealed cases.

The border between a fault and physics: a delay of up to 3 samples is the law `delay` (a converter, a zero-order hold,
a transport lag have this size and need not be whole samples); a shift by 5 or more whole samples, or an output that
comes before its input, is how loggers are mis-started, and a fault. Clipping is sharp and applied after the noise
(tops exactly flat); the law `saturation` is rounded and lies before the noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Array = np.ndarray
FAULTS = ("sign", "unit", "clipped", "alignment", "clock", "time-unit")
RARE_FAULTS = ("zero", "offset", "exchange", "gap", "stale", "hold")  # of the stress sets alone
NOISES = {"white": 0.5, "coloured": 0.25, "quantised": 0.25}
QUIETEST, LOUDEST = 10 ** (-70 / 20), 10 ** (-40 / 20)  # noise of 70 and 40 dB below the signal
FEWEST_SHIFT = 5  # whole samples


class Fault(NamedTuple):
    """What is wrong with the recordings, and the channels of which naming any is right."""

    kind: str
    channels: frozenset[str]
    column: int
    is_input: bool
    size: float
    other: int = 0  # the column it is exchanged with
    seed: int = 0  # of what is drawn for each recording


def excitation(
    rng: np.random.Generator, kind: str, m: int, dt: float, low: float, high: float, period: int = 0
) -> Array:
    """A signal (m,) of standard deviation 1 between two frequencies, Hz; `period` in samples for a multisine."""
    t, n = np.arange(m) * dt, period or m
    if kind == "sweep":
        half = m * dt / 2
        phase = np.where(
            t < half, low * t + (high - low) * t**2 / (2 * half), high * t - (high - low) * (t - half) ** 2 / (2 * half)
        )
        phase = np.where(t < half, phase, phase - (high - low) * half / 2 + (high - low) * half / 2)
        u = np.sin(2 * np.pi * phase + 0.3)
    elif kind == "steps":
        hold = max(1, round(0.35 / (high * dt)))
        levels = np.repeat(rng.uniform(-1, 1, m // hold + 2), hold)[: m + hold]
        u = np.convolve(levels, np.hanning(hold + 2) / np.hanning(hold + 2).sum(), "same")[:m]
    else:
        bins = np.arange(max(1, int(np.ceil(low * n * dt))), max(3, int(high * n * dt)) + 1)
        amplitude = np.ones(len(bins)) if kind == "multisine" else rng.rayleigh(size=len(bins))
        spectrum = np.zeros(n // 2 + 1, complex)
        spectrum[bins] = amplitude * np.exp(2j * np.pi * rng.random(len(bins)))
        u = np.fft.irfft(spectrum, n)
        u = np.tile(u, -(-m // n))[:m]
    u = u - u.mean() if kind != "multisine" else u
    return u / u.std()


def noise(rng: np.random.Generator, kind: str, y: Array, level: Array, pole: float = 0.0) -> Array:
    """Outputs with noise of standard deviation `level` (n_y,); a pole makes it AR(1), stationary from the start."""
    if pole:
        from scipy.signal import lfilter

        first = pole * rng.standard_normal((1, y.shape[1])) / np.sqrt(1 - pole**2)
        e = lfilter([1.0], [1.0, -pole], rng.standard_normal(y.shape), axis=0, zi=first)[0]
        return y + level * e * np.sqrt(1 - pole**2)
    if kind == "white":
        return y + level * rng.standard_normal(y.shape)
    if kind == "coloured":
        from scipy.signal import lfilter

        pole = rng.uniform(0.8, 0.97)
        e = lfilter([1.0], [1.0, -pole], rng.standard_normal((len(y) + 300, y.shape[1])), axis=0)[300:]
        return y + level * e * np.sqrt(1 - pole**2)
    step = np.sqrt(12) * level * 0.95
    dithered = y + 0.3 * level * rng.standard_normal(y.shape)
    return np.round(dithered / step) * step


def draw_fault(
    rng: np.random.Generator,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    linear: bool,
    dynamic: bool,
    kind: str = "",
    side: str = "",
) -> Fault:
    """Draw a fault; a wrong unit of time only where something moves in time. `side` is "input", "output" or drawn."""
    if kind in RARE_FAULTS:
        return _draw_rare(rng, inputs, outputs, linear, kind, side == "input")
    kind = kind or str(rng.choice([f for f in FAULTS if dynamic or f != "time-unit"]))
    single = len(inputs) == len(outputs) == 1
    is_input = kind in ("sign", "unit", "clipped") and rng.random() < 0.4
    is_input = side == "input" if side else is_input
    names = inputs if is_input else outputs
    column = int(rng.integers(len(names)))
    channels = {names[column]}
    size = 0.0
    if kind in ("sign", "unit") and single and linear:  # y -> -y and u -> -u are one and the same here
        channels = {*inputs, *outputs}
    if kind == "unit":
        size = float(rng.choice([1e3, 1e-3, 180 / np.pi, np.pi / 180]))
    if kind == "clipped":
        size = float(rng.uniform(0.55, 0.8))
    if kind == "alignment":
        size = float(rng.integers(FEWEST_SHIFT, 40) * rng.choice([-1, 1]))
        if len(inputs if is_input else outputs) == 1:
            channels |= {*inputs, "time", *(outputs if is_input else ())}
    if kind == "clock":
        size = float(rng.uniform(1e-3, 5e-3) * rng.choice([-1, 1]))
        channels |= {*inputs, "time"}
    if kind == "time-unit":
        size, channels = float(rng.choice([1e3, 1e-3])), {"time"}
    return Fault(kind, frozenset(channels), column, is_input, size)


def _draw_rare(
    rng: np.random.Generator, inputs: tuple[str, ...], outputs: tuple[str, ...], linear: bool, kind: str, is_input: bool
) -> Fault:
    """A fault of `RARE_FAULTS`; an exchange needs two channels of the side."""
    names = inputs if is_input else outputs
    column = int(rng.integers(len(names)))
    channels, size, other = {names[column]}, 0.0, 0
    if kind in ("zero", "offset"):
        size = float(rng.uniform(0.15, 0.6) * rng.choice([-1, 1]))
        if len(inputs) == len(outputs) == 1 and linear:  # in steady state the one is the other times the gain
            channels = {*inputs, *outputs}
    elif kind == "exchange":
        column, other = (int(i) for i in rng.choice(len(names), 2, replace=False))
        channels = {names[column], names[other]}
    elif kind == "gap":
        size, channels = float(rng.integers(15, 150)), {*inputs, *outputs, "time"}
    elif kind == "stale":
        size = float(rng.uniform(0.04, 0.2))
    else:  # hold
        channels = {*inputs, "time", *(outputs if len(outputs) == 1 else ())}
    return Fault(kind, frozenset(channels), column, is_input, size, other, int(rng.integers(2**31)))


def spoil_clean(fault: Fault | None, u: Array, y: Array) -> tuple[Array, Array]:
    """Faults that lie before the noise: alignment, clock."""
    if fault is None:
        return u, y
    if fault.kind == "alignment":
        n, u, y = abs(int(fault.size)), np.array(u), np.array(y)
        a = u if fault.is_input else y
        a[:, fault.column] = np.roll(a[:, fault.column], int(fault.size))
        return u[n:-n], y[n:-n]
    if fault.kind == "clock":
        from scipy.interpolate import CubicSpline

        k = np.arange(len(y))
        at = k * (1 + fault.size)
        inside = at <= k[-1]
        return u[inside], CubicSpline(k, y)(at[inside])
    return u, y


def spoil(fault: Fault | None, u: Array, y: Array, tops: tuple[Array, Array], record: int = 0) -> tuple[Array, Array]:
    """Faults that lie after the noise; sizes are shares of `tops`, the largest |u| and |y|.

    An offset differs from recording to recording, a zero does not; samples are missing in the first recording alone.
    """
    if fault is None or fault.kind not in ("sign", "unit", "clipped", *RARE_FAULTS):
        return u, y
    u, y = np.array(u), np.array(y)
    rng = np.random.default_rng([fault.seed, record])
    if fault.kind == "gap" and record == 0:
        begin = int(rng.uniform(0.3, 0.7) * len(y))
        kept = np.r_[0:begin, begin + int(fault.size) : len(y)]
        return u[kept], y[kept]
    a, i = (u, fault.column) if fault.is_input else (y, fault.column)
    if fault.kind == "sign":
        a[:, i] *= -1
    elif fault.kind == "unit":
        a[:, i] *= fault.size
    elif fault.kind in ("zero", "offset"):
        share = fault.size * (rng.choice([-1, 1]) * rng.uniform(0.5, 1.5) if fault.kind == "offset" else 1.0)
        a[:, i] += share * tops[0 if fault.is_input else 1][i]
    elif fault.kind == "exchange":
        a[:, [i, fault.other]] = a[:, [fault.other, i]]
    elif fault.kind == "stale":
        fresh = rng.random(len(a)) >= fault.size
        fresh[0] = True
        a[:, i] = a[np.maximum.accumulate(np.where(fresh, np.arange(len(a)), 0)), i]
    elif fault.kind == "clipped":
        limit = fault.size * tops[0 if fault.is_input else 1][i]
        a[:, i] = np.clip(a[:, i], -limit, limit)
    return u, y
