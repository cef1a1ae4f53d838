"""Figures of a recording, and of any list of simulations beside it: over time and over frequency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..data import Recording
from .canvas import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PALE_GREY,
    PURPLE,
    SKY,
    VERMILLION,
    axes_or_new,
    decibel,
    finish,
    limit_depth,
    line,
    mask_divergence,
    new_figure,
    noise_band,
    scale_axis,
)


def find_largest_swings(y: np.ndarray) -> slice:
    """Find about eight swings around the largest excursion; ignore small ripple."""
    peak = int(np.argmax(np.abs(y)))
    large = np.flatnonzero(np.abs(y) >= 0.2 * np.abs(y[peak]))
    swings = large[1:][np.diff(np.signbit(y[large]))]
    before, after = swings[swings <= peak][-4:], swings[swings > peak][:4]
    begin = int(before[0]) if len(before) == 4 else 0
    end = int(after[-1]) if len(after) == 4 else len(y)
    return slice(begin, max(end, begin + 2))


def draw_densities(
    recording: Recording,
    output: int,
    unit: str,
    signals: Sequence[tuple[str, np.ndarray, Any]],
    levels: Sequence[tuple[str, np.ndarray, np.ndarray, str]],
    ax: Axes | None,
) -> Axes:
    """Draw amplitude densities of signals (label, (M,), colour) and levels (label, frequency, density, colour)."""
    ax = axes_or_new(ax)
    curves: list[np.ndarray] = []
    for label, signal, colour in signals:
        f, power = amplitude_density(signal, recording)
        curves.append(decibel(power))
        line(ax, f, curves[-1], label, colour, linewidth=1.1)
    for label, f, level, colour in levels:
        curves.append(decibel(level))
        line(ax, f, curves[-1], label, colour, linewidth=1.4, linestyle="--" if colour == GREEN else ":")
    ax.set_xscale("log")
    limit_depth(ax, *curves)
    name = recording.outputs[output]
    return finish(ax, "frequency [Hz]", f"{name} [dB re {unit or '1'}/√Hz]", recording.name)


def amplitude_density(x: np.ndarray, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Compute the one-sided power density of a signal (M,); return frequencies above zero, Hz, and density, (F,)."""
    x, period = x[recording.skip :], recording.period
    if not np.all(np.isfinite(x)):
        x = np.full(len(x), np.nan)
    if period:
        blocks = x[: len(x) // period * period].reshape(-1, period)
        power = np.mean(np.abs(np.fft.rfft(blocks, axis=1)) ** 2, axis=0) * 2 * recording.dt / period
        return np.fft.rfftfreq(period, recording.dt)[1:], power[1:]
    from scipy.signal import welch

    f, power = welch(x, 1 / recording.dt, nperseg=min(len(x), max(256, len(x) // 8)), detrend="constant")
    return f[1:], power[1:]


def finish_over_time(ax: Axes, recording: Recording, label: str) -> Axes:
    """Finish a figure over time, with a grey area over samples that are not scored."""
    if recording.skip:
        ax.axvspan(0, recording.skip * recording.dt, color=PALE_GREY, label="not scored")
    ax.margins(x=0.01)
    return finish(ax, "time [s]", label, recording.name)


def plot_recording(r: Recording) -> Figure:
    """Draw a recording: a row for each channel, over time on the left and as amplitude density on the right."""
    columns = [*zip(r.inputs, r.u.T, strict=True), *zip(r.outputs, r.y.T, strict=True)]
    figure = new_figure(11.0, 2.4 * len(columns))
    axes = figure.subplots(len(columns), 2, squeeze=False)
    for k, ((name, x), (left, right)) in enumerate(zip(columns, axes, strict=True)):
        unit, colour = r.units.get(name, ""), INK if k < r.n_u else BLUE
        size, up = scale_axis(name, x, unit)
        line(left, r.t, x / size, "input" if k < r.n_u else "output", colour, linewidth=0.9)
        finish_over_time(left, r.with_(name="" if k else r.name), up)
        f, power = amplitude_density(x, r)
        curve = decibel(power)
        line(right, f, curve, "", colour, linewidth=0.9)
        right.set_xscale("log")
        limit_depth(right, curve)
        finish(right, "frequency [Hz]", f"{name} [dB re {unit or '1'}/√Hz]", legend=False)
    return figure


DWARFED = 4.0  # times the range of the measured output from which another line would flatten it
MARGIN = 0.15  # of that range, around it
Simulated = list[tuple[str, np.ndarray | None]]  # (label, outputs (M, n_y)); None if the simulation diverges
SIMULATED_COLOURS = (ORANGE, INK, VERMILLION, PURPLE, SKY)  # repeated for further simulations


def assign_colours(simulated: Sequence[tuple[str, np.ndarray | None]]) -> Iterator[tuple[str, np.ndarray, str]]:
    """Yield label, outputs and colour of each simulation that does not diverge."""
    for (label, values), colour in zip(simulated, cycle(SIMULATED_COLOURS), strict=False):
        if values is not None:
            yield label, values, colour


def plot_comparison(r: Recording, simulated: Simulated, noise: np.ndarray | None = None) -> Any:
    """Draw a recording and simulations: a row per output, the largest swings on the left, residuals on the right.

    `noise` holds the standard deviation of each output's noise, shape (n_y,).
    """
    figure = new_figure(11.0, 3.4 * r.n_y)
    axes = figure.subplots(r.n_y, 2, squeeze=False)
    deviations = np.zeros(r.n_y) if noise is None else noise
    for i, (left, right) in enumerate(axes):
        unit = r.units.get(r.outputs[i], "")
        compared_traces(r, simulated, i, unit, ax=left)
        compared_residuals(r, simulated, i, unit, float(deviations[i]), ax=right)
    return figure


def compared_traces(
    r: Recording, simulated: Simulated, output: int = 0, unit: str = "", *, quiet: bool = False, ax: Axes | None = None
) -> Axes:
    """Draw measured output and simulations: a few swings around the largest, or a `quiet` stretch."""
    ax = axes_or_new(ax)
    y = r.y[:, output]
    part = find_largest_swings(y - np.mean(y))
    part = _find_quiet_stretch(y, part.stop - part.start, r.skip) if quiet else part
    size, up = scale_axis(r.outputs[output], y[part], unit)
    line(ax, r.t, y / size, "measured", BLUE, part=part, linewidth=4.0, alpha=0.45)
    drawn = [(label, mask_divergence(v[:, output], np.ptp(y)) / size, c) for label, v, c in assign_colours(simulated)]
    limits = _shared_range(y[part] / size, [y_hat[part] for _, y_hat, _ in drawn])
    for label, y_hat, colour in drawn:
        leaves = limits and np.any((y_hat[part] < limits[0]) | (y_hat[part] > limits[1]))
        line(ax, r.t, y_hat, f"{label} (leaves the picture)" if leaves else label, colour, part=part, linewidth=1.4)
    if limits:
        ax.set_ylim(*limits)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", up, r.name, 3)


def _shared_range(y: np.ndarray, simulated: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """Return the range of the measured output and of the nearest simulation, if another one dwarfs it; else None."""
    known = [y_hat[np.isfinite(y_hat)] for y_hat in simulated]
    known = [y_hat for y_hat in known if len(y_hat) == len(y)]
    if not known:
        return None
    near = np.concatenate([y, min(known, key=lambda y_hat: float(np.mean((y_hat - y) ** 2)))])
    span = float(np.ptp(near))
    if max(float(np.ptp(np.concatenate([near, y_hat]))) for y_hat in known) <= DWARFED * span:
        return None
    return float(np.min(near)) - MARGIN * span, float(np.max(near)) + MARGIN * span


def _find_quiet_stretch(y: np.ndarray, length: int, skip: int) -> slice:
    """Find a stretch with less motion than three quarters of all stretches."""
    length = min(length, max((len(y) - skip) // 6, 2))
    starts = np.arange(skip, len(y) - length + 1, max(length // 4, 1))
    motion = np.array([np.std(y[a : a + length]) for a in starts])
    a = int(starts[np.argsort(motion)[len(starts) // 4]])
    return slice(a, a + length)


def compared_residuals(
    r: Recording, simulated: Simulated, output: int, unit: str, floor: float, ax: Axes | None = None
) -> Axes:
    """Draw the residuals of simulations over the whole recording; `floor` is the noise's standard deviation."""
    ax = axes_or_new(ax)
    y = r.y[:, output]
    errors = [(label, mask_divergence(v[:, output] - y, np.ptp(y)), c) for label, v, c in assign_colours(simulated)]
    scaled = np.nan_to_num(errors[0][1]) if errors else y
    size, up = scale_axis(f"simulated − measured {r.outputs[output]}", scaled, unit)
    for label, e, colour in errors:
        line(ax, r.t, e / size, label, colour, linewidth=0.8)
    noise_band(ax, 2 * floor / size, "± 2 noise")
    ax.margins(x=0.01)
    return finish(ax, "time [s]", up, r.name, 3)


def compared_spectra(r: Recording, simulated: Simulated, output: int, unit: str, floor: float) -> Axes:
    """Draw amplitude densities of the output, of each residual, and of white noise of standard deviation `floor`."""
    y = r.y[:, output]
    signals = [("measured", y, BLUE)]
    signals += [(f"error {label}", v[:, output] - y, colour) for label, v, colour in assign_colours(simulated)]
    ends = amplitude_density(y, r)[0][[0, -1]]
    white = [("noise floor (white)", ends, np.full(2, 2 * r.dt * floor**2), GREEN)] if floor > 0 else []
    return draw_densities(r, output, unit, signals, white, None)
