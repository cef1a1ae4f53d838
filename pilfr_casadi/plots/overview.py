"""One figure of a whole fit, and the convergence of its search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..data import Recording, as_recordings
from ..optimise import Iteration
from .canvas import GREY, VERMILLION, axes_or_new, finish, new_figure
from .element import loading_curve, loop, weights
from .signals import PlottedFit, spectrum, time


def plot_fit(
    fit: PlottedFit, recordings: Recording | Sequence[Recording], *, steady: Sequence[Recording] | None = None
) -> Figure:
    """Draw a fit in one figure: time and spectrum of every output, loop, loading curve and weights of every channel.

    Without hysteresis: convergence, beside the curve of an element of one channel.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    recordings : Recording or sequence of Recording
        Recordings to simulate and compare with.
    steady : sequence of Recording, optional
        Periodic recordings from which noise and distortion levels are estimated; see `spectrum`.

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
    channels, curve = fit.model.n_w if fit.model.n_s else 0, fit.model.n_w == 1 and not fit.model.n_s
    figure = new_figure(11.0, 3.4 * (len(rows) + channels + (not channels)))
    grid = figure.add_gridspec(len(rows) + max(channels, 1), 6)
    for k, (r, i) in enumerate(rows):
        time(fit, r, output=i, ax=figure.add_subplot(grid[k, :3]))
        spectrum(fit, r, output=i, steady=steady, ax=figure.add_subplot(grid[k, 3:]))
    for c in range(channels):
        row = len(rows) + c
        loop(fit, records[0], channel=c, ax=figure.add_subplot(grid[row, :2]))
        loading_curve(fit, records, channel=c, ax=figure.add_subplot(grid[row, 2:4]))
        if {"w", "r"} <= set(fit.parameters):
            weights(fit, records, channel=c, ax=figure.add_subplot(grid[row, 4:]))
    if not channels:
        convergence(fit, ax=figure.add_subplot(grid[len(rows), 2 * curve :]))
    if curve:
        loop(fit, records[0], ax=figure.add_subplot(grid[len(rows), :2]))
    return figure


def convergence(fit: PlottedFit, *, ax: Axes | None = None) -> Axes:
    """Draw the training error over iterations, of every start and of the winning solve."""
    ax = axes_or_new(ax)
    histories = [c.solution.history for c in fit.candidates if c.solution.history]
    for k, history in enumerate(histories):
        ax.plot(
            [h.number for h in history],
            _training_error(history),
            color=GREY,
            linewidth=0.9,
            alpha=0.7,
            label="starts" if k == 0 else None,
        )
    if fit.solution.history:
        ax.plot(
            [h.number for h in fit.solution.history],
            _training_error(fit.solution.history),
            color=VERMILLION,
            linewidth=2.0,
            label="last solve of the best",
        )
    ax.set_yscale("log")
    return finish(ax, "iteration", "training error √(2 · cost)", "convergence")


def _training_error(history: Sequence[Iteration]) -> np.ndarray:
    return np.sqrt(2 * np.maximum([h.cost for h in history], 0.0))
