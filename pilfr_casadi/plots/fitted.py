"""Figures of a fit: time and spectrum of its residuals, the identified loop, loading curve and weights, convergence.

Krikelis et al. (2024), Fig. 9, 10, 14 (time and spectrum) and 15 (the identified loop).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..bla import output_spectra
from ..metrics import nrmse
from ..recording import InputError, Recording, as_recordings
from ..start import density
from .canvas import (
    BLUE,
    GREEN,
    GREY,
    INK,
    PURPLE,
    SKY,
    VERMILLION,
    axes_or_new,
    decibel,
    finish,
    limit_depth,
    line,
    new_figure,
    scaled,
    with_unit,
)

if TYPE_CHECKING:
    from ..fit import Fit

Curve = Callable[[np.ndarray], np.ndarray]


def plot_fit(
    fit: Fit, recordings: Recording | Sequence[Recording], *, steady: Sequence[Recording] | None = None
) -> Figure:
    """One figure: time and spectrum of every recording and output, then the loop, loading curve and weights of every channel.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    recordings : Recording or sequence of Recording
        What to simulate and compare.
    steady : sequence of Recording, optional
        Periodic recordings that noise and distortion levels are taken from; see `spectrum`.

    Returns
    -------
    matplotlib.figure.Figure
        Save it with `figure.savefig("fit.png")`.

    Raises
    ------
    InputError
        If a recording does not fit the model.
    """
    records = as_recordings(recordings)
    rows = [(r, i) for r in records for i in range(r.n_y)]
    channels = fit.model.n_w
    figure = new_figure(11.0, 3.4 * (len(rows) + channels + (not channels)))
    grid = figure.add_gridspec(len(rows) + max(channels, 1), 6)
    for k, (r, i) in enumerate(rows):
        time(fit, r, output=i, ax=figure.add_subplot(grid[k, :3]))
        spectrum(fit, r, output=i, steady=steady, ax=figure.add_subplot(grid[k, 3:]))
    for c in range(channels):
        row = len(rows) + c
        loop(fit, records[0], channel=c, ax=figure.add_subplot(grid[row, :2]))
        loading_curve(fit, records, channel=c, ax=figure.add_subplot(grid[row, 2:4]))
        weights(fit, records, channel=c, ax=figure.add_subplot(grid[row, 4:]))
    if not channels:
        convergence(fit, ax=figure.add_subplot(grid[len(rows), :]))
    return figure


def time(fit: Fit, recording: Recording, *, output: int = 0, ax: Axes | None = None) -> Axes:
    """Measured output with the residuals of the linear model and of the fit over time, as Fig. 9 (left)."""
    ax, t, y = axes_or_new(ax), recording.t, recording.y[:, output]
    size, unit = scaled(y, _unit(fit, recording, recording.outputs[output]))
    line(ax, t, y / size, "measured output", BLUE, linewidth=0.9)
    for label, residual, colour in _residuals(fit, recording, output):
        line(ax, t, residual / size, label, colour, linewidth=1.1)
    if recording.skip:
        ax.axvspan(0, recording.skip * recording.dt, color="#EEEEEE", label="not scored")
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(recording.outputs[output], unit), recording.name)


def traces(
    fit: Fit,
    recording: Recording,
    *,
    output: int = 0,
    between: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Measured and simulated output over a stretch of time, in s; by default some swings around the largest excursion."""
    ax, y = axes_or_new(ax), recording.y[:, output]
    begin, end = between or _busiest(y - np.mean(y), recording)
    part = slice(*np.clip(np.round(np.array([begin, end]) / recording.dt).astype(int), 0, len(y)))
    if part.stop - part.start < 2:
        raise InputError(
            f"From {begin:g} to {end:g} s there are no two samples; the recording lasts {len(y) * recording.dt:g} s."
        )
    size, unit = scaled(y[part], _unit(fit, recording, recording.outputs[output]))
    line(ax, recording.t[part], y[part] / size, "measured", BLUE, linewidth=3.2, alpha=0.55)
    if _compares(fit):
        line(
            ax,
            recording.t[part],
            linear_simulation(fit, recording)[part, output] / size,
            "linear model",
            VERMILLION,
            linewidth=1.2,
        )
    line(ax, recording.t[part], fit.simulate(recording)[part, output] / size, "this model", INK, linewidth=1.2)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(recording.outputs[output], unit), recording.name, 3)


def _busiest(y: np.ndarray, recording: Recording) -> tuple[float, float]:
    """Start and end of a stretch around the largest excursion that holds about eight crossings of zero."""
    crossings = np.flatnonzero(np.diff(np.signbit(y)))
    peak = int(np.argmax(np.abs(y)))
    before, after = crossings[crossings < peak][-4:], crossings[crossings >= peak][:5]
    short = min(len(y), 40)
    begin = int(before[0]) if len(before) else max(peak - short, 0)
    end = int(after[-1]) if len(after) else min(peak + short, len(y))
    return begin * recording.dt, max(end, begin + 2) * recording.dt


def remains(fit: Fit, recording: Recording, *, output: int = 0, ax: Axes | None = None) -> Axes:
    """What the fit leaves over, alone over time and in its own scale."""
    ax, residual = axes_or_new(ax), (fit.simulate(recording) - recording.y)[:, output]
    size, unit = scaled(residual, _unit(fit, recording, recording.outputs[output]))
    scored = residual[recording.skip :] / size
    line(
        ax,
        recording.t,
        residual / size,
        f"residual, this model (rms {np.sqrt(np.mean(scored**2)):.3g}{' ' + unit if unit else ''})",
        INK,
        linewidth=0.8,
    )
    if recording.skip:
        ax.axvspan(0, recording.skip * recording.dt, color="#EEEEEE", label="not scored")
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(f"simulated − measured {recording.outputs[output]}", unit), recording.name)


def output_over_input(
    fit: Fit, recording: Recording, *, input: int = 0, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Measured and simulated output over an input: the nested loops of a quasi-static device."""
    ax, u, name = axes_or_new(ax), recording.u[:, input], recording.outputs[output]
    size, unit = scaled(recording.y[:, output], _unit(fit, recording, name))
    ax.plot(u, recording.y[:, output] / size, color=BLUE, linewidth=2.6, alpha=0.5, label="measured", rasterized=True)
    ax.plot(u, fit.simulate(recording)[:, output] / size, color=INK, linewidth=0.8, label="this model", rasterized=True)
    across = recording.inputs[input]
    return finish(ax, with_unit(across, _unit(fit, recording, across)), with_unit(name, unit), recording.name)


def spectrum(
    fit: Fit,
    recording: Recording,
    *,
    output: int = 0,
    steady: Sequence[Recording] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Amplitude densities of output and residuals over frequency, with noise and total distortion where known, as Fig. 9 (right).

    All lines are densities (per root hertz) of the signals as recorded, so records of any length and levels from periods can be
    compared: a residual that lies on the noise line cannot be improved.

    Parameters
    ----------
    fit, recording, output
        Model, data and index of the output. A recording with a period is transformed period by period after its `skip`, any
        other in overlapping windowed stretches.
    steady : sequence of Recording, optional
        Periodic steady-state recordings of the same signals, one for each realization, that the noise level (from several
        periods) and the total distortion (noise and nonlinear distortion, from several realizations) are estimated from;
        by default `recording` itself, if it is periodic.
    ax : Axes, optional
        Where to draw.
    """
    ax = axes_or_new(ax)
    name = recording.outputs[output]
    curves: list[np.ndarray] = []
    for label, signal, colour in [
        ("measured output", recording.y[:, output], BLUE),
        *_residuals(fit, recording, output),
    ]:
        f, power = amplitude_density(signal, recording)
        curves.append(decibel(power))
        line(ax, f, curves[-1], label, colour, linewidth=1.1)
    periodic = steady if steady is not None else [recording] if recording.period else []
    for label, f_level, level, colour in _levels(periodic, output):
        curves.append(decibel(level))
        line(ax, f_level, curves[-1], label, colour, linewidth=1.4, linestyle="--" if colour == GREEN else ":")
    ax.set_xscale("log")
    limit_depth(ax, *curves)
    unit = _unit(fit, recording, name)
    return finish(ax, "frequency [Hz]", f"{name} [dB re {unit or '1'}/√Hz]", recording.name)


def amplitude_density(x: np.ndarray, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (F,) in Hz and one-sided power density (F,) of a signal (M,) sampled like the recording, zero frequency left out."""
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


def loop(fit: Fit, recording: Recording, *, channel: int = 0, bare: bool = False, ax: Axes | None = None) -> Axes:
    """The identified hysteresis: the element's output w over its input z along a recording, as Fig. 15.

    With `bare` the straight line through the origin that fits w best is taken off, so that the hysteresis alone is seen.
    """
    _check_channel(fit, channel)
    signals, index = fit.signals(recording), _index(fit, channel)
    z, w = (signals[key][:, channel] for key in "zw")
    what, title = f"w{index}", "identified loop"
    if bare:
        slope = float(z @ w / (z @ z)) if np.any(z) else 0.0
        w, what, title = w - slope * z, f"w{index} − {slope:.3g} z{index}", "identified loop without its slope"
    ax = axes_or_new(ax)
    ax.plot(z, w, color=BLUE, linewidth=0.7, rasterized=True)
    return finish(
        ax, f"z{index} (model scale)", f"{what} (model scale)", ", ".join(filter(None, (title, recording.name)))
    )


def loading_curve(
    fit: Fit,
    recordings: Recording | Sequence[Recording] | None = None,
    *,
    channel: int = 0,
    reference: Curve | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The element's response to z growing from rest (virgin curve); the range that the recordings visit is shaded.

    `reference` is a curve to compare with, from z (G,) to w (G,), in the scale of the model.
    """
    _check_channel(fit, channel)
    ax, reach, limit = axes_or_new(ax), _reach(fit, recordings, channel), _range(fit, recordings, channel)
    z = np.linspace(0.0, limit, 300)
    if reach:
        ax.axvspan(0, reach, color="#E8F1F7", linewidth=0, label="|z| in the recordings")
    ax.plot(z, virgin_curve(fit, z, channel), color=BLUE, linewidth=1.8, label="fitted")
    if reference is not None:
        ax.plot(z, reference(z), color=INK, linewidth=1.4, linestyle="--", label="reference")
    ax.margins(x=0)
    return finish(
        ax, f"z{_index(fit, channel)} (model scale)", f"w{_index(fit, channel)} (model scale)", "loading curve"
    )


def virgin_curve(fit: Fit, z: np.ndarray, channel: int = 0) -> np.ndarray:
    """w (G,) while one channel's z runs through the values given (G,), from empty memory."""
    model, p = fit.model, fit.model.parameters.start
    memory, out = np.zeros(model.n_s), np.empty(len(z))
    for k, value in enumerate(z):
        w, memory = model.memory(value * np.eye(model.n_w)[channel], memory, p)
        out[k] = w[channel]
    return out


def weights(
    fit: Fit,
    recordings: Recording | Sequence[Recording] | None = None,
    *,
    channel: int = 0,
    reference: Curve | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Weight over threshold of every operator, and the density of weights over thresholds that they stand for.

    `reference` is a density to compare with, from r (G,) to weight per unit of r (G,), in the scale of the model.
    """
    _check_channel(fit, channel)
    values = fit.parameters
    if not {"r", "w"} <= set(values):
        raise InputError(
            "The element has no thresholds r and weights w; only a Prandtl-Ishlinskii element has a density of weights."
        )
    ax = axes_or_new(ax)
    r, w = values["r"][channel], values["w"][channel]
    order, limit = np.argsort(r), _range(fit, recordings, channel)
    r, w = r[order], w[order]
    ax.vlines(r, 0, w, color=SKY, linewidth=1.5)
    errors = fit.errors.get("w")
    spread = None if errors is None else np.nan_to_num(errors[channel][order])
    ax.errorbar(r, w, yerr=spread, fmt="o", markersize=4, color=BLUE, elinewidth=1, label="weights w (left)")
    right = ax.twinx()
    grid = np.linspace(0.0, limit, 300)
    right.plot(grid, density(r, w, grid, limit / 12), color=VERMILLION, linewidth=1.8, label="smoothed density (right)")
    if reference is not None:
        right.plot(grid, reference(grid), color=INK, linestyle="--", linewidth=1.4, label="reference density (right)")
    finish(right, "", "density dw/dr").grid(False)
    right.get_legend().remove()
    right.spines["right"].set_visible(True)
    finish(
        ax, f"threshold r{_index(fit, channel)} (model scale)", "weight w", "weights over thresholds", 1, beside=right
    )
    right.set_ylim(bottom=0)
    ax.set_ylim(bottom=0)
    ax.set_xlim(-0.02 * limit, limit)
    return ax


def convergence(fit: Fit, *, ax: Axes | None = None) -> Axes:
    """Training error over iterations, of every start and of the solve that won."""
    ax = axes_or_new(ax)
    histories = [c.solution.history for c in fit.candidates if c.solution.history]
    for k, history in enumerate(histories):
        ax.plot(
            [h.number for h in history],
            _error(history),
            color=GREY,
            linewidth=0.9,
            alpha=0.7,
            label="starts" if k == 0 else None,
        )
    if fit.solution.history:
        ax.plot(
            [h.number for h in fit.solution.history],
            _error(fit.solution.history),
            color=VERMILLION,
            linewidth=2.0,
            label="last solve of the best",
        )
    ax.set_yscale("log")
    return finish(ax, "iteration", "training error √(2 · cost)", "convergence")


def _error(history: Iterable) -> np.ndarray:
    return np.sqrt(2 * np.maximum([h.cost for h in history], 0.0))


def _compares(fit: Fit) -> bool:
    """Whether there is a linear model beside the fit."""
    return fit.linear is not None and fit.model.n_w > 0


def _residuals(fit: Fit, recording: Recording, output: int) -> list[tuple[str, np.ndarray, str]]:
    """(label, residual, colour) of the linear model, where the fit has one, and of the fit."""
    if not 0 <= output < recording.n_y:
        raise InputError(f"Output {output} was asked for; the recording has {recording.n_y}, counted from 0.")
    out = [(*_named("this model", recording, fit.simulate(recording), output), INK)]
    if _compares(fit):
        out.insert(0, (*_named("linear", recording, linear_simulation(fit, recording), output), VERMILLION))
    return out


def _named(model: str, recording: Recording, simulated: np.ndarray, output: int) -> tuple[str, np.ndarray]:
    y, y_hat = recording.y[:, output], simulated[:, output]
    try:
        share = f" {100 * nrmse(y, y_hat, recording.skip):.3g} %"
    except InputError:  # a constant output has no relative error
        share = ""
    return f"residual, {model}{share}", y_hat - y


def linear_simulation(fit: Fit, recording: Recording) -> np.ndarray:
    """Outputs (M, n_y) of the linear model that the fit began with, from its own initial state.

    Raises
    ------
    InputError
        If the fit holds no linear model.
    """
    from dataclasses import replace

    if fit.linear is None:
        raise InputError("The fit holds no linear model to compare with.")
    given = not isinstance(recording.initial, str)
    return replace(fit, model=fit.linear, linear=None).simulate(
        recording.with_(initial="estimate") if given else recording
    )


def _levels(periodic: Sequence[Recording], output: int) -> list[tuple[str, np.ndarray, np.ndarray, str]]:
    """(label, frequency, power density, colour) of noise and total distortion, as in a single period."""
    if not periodic:
        return []
    levels = output_spectra(periodic)
    period = periodic[0].period or 2
    averaged = (len(periodic[0]) - periodic[0].skip) // period
    density_of = 2 * period * periodic[0].dt
    out = []
    if levels.var_noise is not None:
        out.append(("noise", levels.frequency, levels.var_noise[:, output] * averaged * density_of, GREEN))
    if levels.var_total is not None:
        noise = 0.0 if levels.var_noise is None else levels.var_noise[:, output] * (averaged - 1)
        out.append(
            ("noise and distortion", levels.frequency, (levels.var_total[:, output] + noise) * density_of, PURPLE)
        )
    return out


def _check_channel(fit: Fit, channel: int) -> None:
    if not 0 <= channel < fit.model.n_w:
        raise InputError(
            f"Channel {channel} of the element was asked for; the model has {fit.model.n_w}, counted from 0."
        )


def _index(fit: Fit, channel: int) -> str:
    return str(channel + 1) if fit.model.n_w > 1 else ""


def _reach(fit: Fit, recordings: Recording | Sequence[Recording] | None, channel: int) -> float:
    records = () if recordings is None else as_recordings(recordings)
    return max((float(np.nanmax(np.abs(fit.signals(r)["z"][:, channel]))) for r in records), default=0.0)


def _range(fit: Fit, recordings: Recording | Sequence[Recording] | None, channel: int) -> float:
    """Up to where an element is drawn: what is visited, and the thresholds where they lie not far beyond."""
    reach, r = _reach(fit, recordings, channel), fit.parameters.get("r")
    far = 0.0 if r is None else float(np.max(r[channel]))
    limit = 1.05 * (max(reach, min(far, 1.5 * reach)) if reach else far)
    return limit if limit > 0 and np.isfinite(limit) else 1.0


def _unit(fit: Fit, recording: Recording, name: str) -> str:
    return recording.units.get(name, fit.units.get(name, ""))
