"""Figures that compare a recording with a fit and its linear model: over time, over frequency, over an input.

Krikelis et al. (2024), Fig. 9, 10 and 14.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, cast

import numpy as np
from matplotlib.axes import Axes

from .._base import InputError
from ..data import Recording, name_with_unit, nrmse
from ..export import FittedModel
from ..linear import output_spectra
from ..models import Model
from ..optimise import Candidate, Solution
from .canvas import (
    BLUE,
    GREEN,
    INK,
    PURPLE,
    VERMILLION,
    axes_or_new,
    check_index,
    choose_scale,
    finish,
    line,
    mask_divergence,
    plain,
    scale_axis,
)
from .signals import draw_densities, find_largest_swings, finish_over_time


class PlottedFit(FittedModel, Protocol):
    """The interface of a `Fit` that figures use."""

    @property
    def linear(self) -> Model | None:
        """Linear model from which the search started."""

    @property
    def units(self) -> Mapping[str, str]:
        """Unit by name of an input or output."""

    @property
    def parameters(self) -> Mapping[str, np.ndarray]:
        """Fitted values by name."""

    @property
    def errors(self) -> Mapping[str, np.ndarray]:
        """Standard errors by parameter name."""

    @property
    def solution(self) -> Solution:
        """The final solve."""

    @property
    def candidates(self) -> Sequence[Candidate]:
        """The solves from all starts."""

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulated outputs, (M, n_y)."""

    def signals(self, recording: Recording) -> dict[str, np.ndarray]:
        """Simulated `y` (M, n_y) with the element's `z` and `w` (M, n_w)."""

    def scored_from(self, recording: Recording) -> int:
        """First sample that is scored."""

    def matched(self, recording: Recording) -> Recording:
        """The recording with the model's channels and units."""


def time(fit: PlottedFit, recording: Recording, *, output: int = 0, ax: Axes | None = None) -> Axes:
    """Draw the measured output with the residuals of the linear model and of the fit over time, as Fig. 9 (left)."""
    recording = as_scored(fit, recording)
    ax, t, y = axes_or_new(ax), recording.t, _select_signal(recording.y, output, "output")
    mean, span = float(np.mean(y[recording.skip :])), np.ptp(y[recording.skip :])
    level = mean if abs(mean) > span > 0 else 0.0  # subtracted, so that swings are visible next to residuals
    unit = _unit(fit, recording, recording.outputs[output])
    size, axis = scale_axis(recording.outputs[output], y - level, unit)
    measured = "measured output" + (f" less its mean {level:.6g} {unit}".rstrip() if level else "")
    line(ax, t, (y - level) / size, measured, BLUE, linewidth=0.9)
    for label, residual, colour in _residuals(fit, recording, output):
        shifted, note = _error_to_draw(residual, np.ptp(y), unit)
        line(ax, t, shifted / size, label + note, colour, linewidth=1.1)
    return finish_over_time(ax, recording, axis)


def traces(
    fit: PlottedFit,
    recording: Recording,
    *,
    output: int = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw measured and simulated output over a few swings around the largest."""
    recording = fit.matched(recording)
    ax, y = axes_or_new(ax), _select_signal(recording.y, output, "output")
    part = find_largest_swings(y - np.mean(y))
    unit = _unit(fit, recording, recording.outputs[output])
    size, label = scale_axis(recording.outputs[output], y[part], unit)
    line(ax, recording.t, y / size, "measured", BLUE, part=part, linewidth=3.2, alpha=0.55)
    for model, simulated, colour in _simulations(fit, recording):
        error, note = _error_to_draw(simulated[:, output] - y, np.ptp(y), unit)
        line(ax, recording.t, (y + error) / size, model + note, colour, part=part)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", label, recording.name, 3)


def remains(fit: PlottedFit, recording: Recording, *, output: int = 0, ax: Axes | None = None) -> Axes:
    """Draw only the residual of the fit over time, in its own scale."""
    recording = as_scored(fit, recording)
    ax, y = axes_or_new(ax), _select_signal(recording.y, output, "output")
    residual = mask_divergence(fit.simulate(recording)[:, output] - y, np.ptp(y))
    size, unit = choose_scale(residual[np.isfinite(residual)], _unit(fit, recording, recording.outputs[output]))
    rms = float(np.sqrt(np.mean((residual[recording.skip :] / size) ** 2)))
    times = "·" if unit.startswith("10") else " "  # such as 10⁻³ m
    label = f"residual, this model (rms {rms:.3g}{times}{unit}".rstrip() + ")"
    line(ax, recording.t, residual / size, label, INK, linewidth=0.8)
    return finish_over_time(ax, recording, name_with_unit(f"simulated − measured {recording.outputs[output]}", unit))


def output_over_input(
    fit: PlottedFit, recording: Recording, *, input: int = 0, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw measured and simulated output over an input: the nested loops of a quasi-static device (scored samples)."""
    recording = as_scored(fit, recording)
    ax, u, y = (
        axes_or_new(ax),
        _select_signal(recording.u, input, "input"),
        _select_signal(recording.y, output, "output"),
    )
    name, simulated = recording.outputs[output], fit.simulate(recording)[:, output]
    u, y, simulated = (column[recording.skip :] for column in (u, y, simulated))
    size, up = scale_axis(name, y, _unit(fit, recording, name))
    error, note = _error_to_draw(simulated - y, np.ptp(y), _unit(fit, recording, name))
    ax.plot(u, y / size, color=BLUE, linewidth=3.0, alpha=0.4, label="measured", rasterized=True)
    ax.plot(u, (y + error) / size, color=INK, linewidth=0.5, label=plain(f"this model{note}"), rasterized=True)
    across = recording.inputs[input]
    return finish(ax, name_with_unit(across, _unit(fit, recording, across)), up, recording.name)


def spectrum(
    fit: PlottedFit,
    recording: Recording,
    *,
    output: int = 0,
    steady: Sequence[Recording] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw amplitude densities of output and residuals, with noise and total distortion, as Fig. 9 (right).

    All lines are densities (per root hertz) of the recorded signals, so recordings of any length and levels from
    periods can be compared. A residual on the noise line cannot be improved.

    A recording with a period is transformed period by period after its `skip`, any other in overlapping windowed
    stretches. Levels come from `steady`: periodic steady-state recordings of the same signals with the same kind of
    input, one for each realization; by default `recording` itself, if it is periodic. Several periods give the noise
    level, several realizations the total distortion (noise and nonlinear distortion).
    """
    recording, steady = fit.matched(recording), None if steady is None else [fit.matched(r) for r in steady]
    y = _select_signal(recording.y, output, "output")
    signals = [("measured output", y, BLUE), *_residuals(fit, recording, output)]
    periodic = steady if steady is not None else [recording] if recording.period else []
    unit = _unit(fit, recording, recording.outputs[output])
    return draw_densities(recording, output, unit, signals, _estimate_levels(periodic, output), ax)


def _estimate_levels(periodic: Sequence[Recording], output: int) -> list[tuple[str, np.ndarray, np.ndarray, str]]:
    """Estimate noise and total distortion of a single period: (label, frequency, power density, colour) each."""
    if not periodic:
        return []
    try:
        levels = output_spectra(periodic)
    except InputError:  # too few periods or experiments for a level: leave the line out
        return []
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


def linear_simulation(fit: PlottedFit, recording: Recording) -> np.ndarray:
    """Simulate the linear model from which the fit started, with its own initial state: outputs (M, n_y)."""
    if fit.linear is None:
        raise InputError("The fit has no linear model to compare with; give the fit of a PI-LFR.")
    given = not isinstance(recording.initial, str)
    linear: PlottedFit = replace(cast(Any, fit), model=fit.linear, linear=None, initial={})
    return linear.simulate(recording.with_(initial="estimate") if given else recording)


def as_scored(fit: PlottedFit, recording: Recording) -> Recording:
    """Bring a recording into the fit's units, with `skip` after the samples that estimate its initial state."""
    recording = fit.matched(recording)
    try:
        return recording.with_(skip=fit.scored_from(recording))
    except InputError:  # the recording is too short to score any sample
        return recording


def _error_to_draw(error: np.ndarray, span: float, unit: str) -> tuple[np.ndarray, str]:
    """Mask where an error (M,) diverges, and subtract an offset beyond the measured span; also return a note on it."""
    error = mask_divergence(error, span)
    known = error[np.isfinite(error)]
    if not known.size or abs(np.mean(known)) <= span or np.ptp(known) > 3 * span or not span:
        return error, ""
    return error - np.mean(known), f", less {np.mean(known):.3g} {unit}".rstrip()


def compares_linear(fit: PlottedFit) -> bool:
    """Tell whether the fit has a linear model to compare with."""
    return fit.linear is not None and fit.model.n_w > 0


def _select_signal(values: np.ndarray, index: int, role: str) -> np.ndarray:
    check_index(index, values.shape[1], role)
    return values[:, index]


def _residuals(fit: PlottedFit, recording: Recording, output: int) -> list[tuple[str, np.ndarray, str]]:
    """List (label with relative error, residual, colour) of the linear model, if the fit has one, and the fit."""
    y, out = recording.y[:, output], []
    for model, simulated, colour in _simulations(fit, recording):
        y_hat = simulated[:, output]
        try:
            error = f" {100 * nrmse(y, y_hat, recording.skip):.3g} %"
        except InputError:  # a constant output has no relative error
            error = ""
        out.append((f"residual, {model}{error}", y_hat - y, colour))
    return out


def _simulations(fit: PlottedFit, recording: Recording) -> list[tuple[str, np.ndarray, str]]:
    """List (label, outputs, colour) of the linear model, if the fit has one, and of the fit."""
    out = [("this model", fit.simulate(recording), INK)]
    if compares_linear(fit):
        out.insert(0, ("linear model", linear_simulation(fit, recording), VERMILLION))
    return out


def _unit(fit: PlottedFit, recording: Recording, name: str) -> str:
    return recording.units.get(name, fit.units.get(name, ""))
