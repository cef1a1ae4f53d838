"""Figures of linear parts: Bode diagram, poles and zeros."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..linear import BLA, LinearPart
from .canvas import BLUE, GREY, GRID, INK, ORANGE, VERMILLION, check_index, decibel, finish, line, new_figure, plain

COLOURS = (INK, VERMILLION, ORANGE)
FREQUENCIES = 600  # of a curve
DECADES = 3.5  # range of frequencies below the Nyquist frequency without a BLA
DAMPINGS = (0.1, 0.3, 0.5, 0.7, 0.9)  # damping ratios of the spirals behind the poles
MOST_NAMED = 6  # poles labelled with frequency and damping
MARGIN = 0.5  # room around the poles, over their extent
SMALLEST_EXTENT = 0.02  # of the picture, in the z-plane


def bode(
    parts: Mapping[str, LinearPart], bla: BLA | None = None, *, output: int = 0, input: int = 0, unit: str = ""
) -> Figure:
    """Draw magnitude and phase of linear models by name, with the measured best linear approximation if it is given.

    `unit` is the output's unit per input unit.
    """
    _check_signals(parts, output, input)
    figure = new_figure(6.2, 5.4)
    up, down = figure.subplots(2, 1, sharex=True)
    dt = next(iter(parts.values())).dt
    low = 0.5 / dt * 10.0**-DECADES if bla is None else float(bla.frequency[0])
    frequency = np.geomspace(low, 0.5 / dt, FREQUENCIES)
    if bla is not None:
        g = bla.G[:, output, input]
        line(up, bla.frequency, decibel(np.abs(g) ** 2), "measured (BLA)", BLUE, linewidth=2.6, alpha=0.6)
        line(down, bla.frequency, _phase(g), "", BLUE, linewidth=2.6, alpha=0.6)
    for (name, part), colour in zip(parts.items(), COLOURS, strict=False):
        response = part.response(frequency)[:, output, input]
        line(up, frequency, decibel(np.abs(response) ** 2), name, colour)
        line(down, frequency, _phase(response), "", colour)
    up.set_xscale("log")
    finish(up, "", f"magnitude [dB re 1 {unit}]" if unit else "magnitude [dB]", columns=3)
    finish(down, "frequency [Hz]", "phase [°]", legend=False)
    low, high = down.get_ylim()
    down.set_yticks(np.arange(90 * np.floor(low / 90), 90 * np.ceil(high / 90) + 1, 90))
    return figure


def _check_signals(parts: Mapping[str, LinearPart], output: int, input: int) -> None:
    n_y, n_u = next(iter(parts.values())).D.shape
    check_index(output, n_y, "output")
    check_index(input, n_u, "input")


def _phase(response: np.ndarray) -> np.ndarray:
    """Return the continuous phase in degrees."""
    return np.degrees(np.unwrap(np.angle(response)))


def pole_zero(parts: Mapping[str, LinearPart], *, output: int = 0, input: int = 0, ax: Axes | None = None) -> Axes:
    """Draw poles (crosses) and the zeros from one input to one output (circles) in the upper half of the z-plane.

    The unit circle is the limit of stability; grey spirals are lines of equal damping ratio. Labels give the frequency
    in Hz and the damping ratio of oscillating poles. Zeros far from the poles may lie outside the picture.
    """
    _check_signals(parts, output, input)
    ax = new_figure(6.2, 5.0).add_subplot() if ax is None else ax
    angle = np.linspace(0.0, np.pi, 300)
    ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=1.0)
    for damping in DAMPINGS:
        spiral = np.exp((-damping / np.sqrt(1 - damping**2) + 1j) * angle)
        ax.plot(spiral.real, spiral.imag, color=GRID, linewidth=0.8)
    points = [1.0 + 0.0j]
    for k, ((name, part), colour) in enumerate(zip(parts.items(), COLOURS, strict=False)):
        poles, zeros = (z[z.imag >= 0] for z in (part.poles, part.zeros(output, input)))
        points += [*poles]
        style: dict[str, Any] = {"color": colour, "markersize": 8, "markerfacecolor": "none"}
        ax.plot(poles.real, poles.imag, "x", markeredgewidth=1.8, label=plain(name), **style)
        ax.plot(zeros.real, zeros.imag, "o", **style)
        for pole in poles[(poles.imag > 0) & (np.abs(poles) > 0)][:MOST_NAMED]:
            rate = np.log(pole) / part.dt
            ax.annotate(
                f"{abs(rate) / (2 * np.pi):.3g} Hz, {100 * -rate.real / abs(rate):.2g} %",
                (pole.real, pole.imag),
                xytext=((7, 5), (-7, -11))[k % 2],
                textcoords="offset points",
                ha=("left", "right")[k % 2],
                color=colour,
                fontsize=8.5,
            )
    x, y = np.real(points), np.imag(points)
    extent = (1 + MARGIN) * max(np.ptp(x), np.max(y), SMALLEST_EXTENT)
    middle, height = (x.max() + x.min()) / 2, max(np.max(y) * (1 + MARGIN / 2), extent / 2)
    ax.set_xlim(middle - extent / 2, max(middle + extent / 2 - MARGIN / 4 * extent, x.max() + MARGIN / 4 * extent))
    ax.set_ylim(-0.06 * height, height)
    ax.set_aspect("equal")
    return finish(ax, "real part", "imaginary part", "z-plane: × poles, ○ zeros", 2)
