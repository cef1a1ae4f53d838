"""Residual tests: what is left of simulations, against themselves and against the inputs.

See `data.correlation` for the theory.
"""

from __future__ import annotations

from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._base import InputError
from ..data import BAND, Recording, chance, correlation
from .canvas import INK, PALE_GREY, finish, line, new_figure
from .signals import SIMULATED_COLOURS, Simulated

SHARE = 8  # of the scored samples: the largest lag that they can show
LAGS = 100  # largest lag by default, in samples
FEWEST = 32  # scored samples, for a band that means something


def residual_tests(recording: Recording, simulated: Simulated, *, lags: int | None = None) -> Figure:
    """Draw correlations of residuals: with themselves, with every input, and with every input's square.

    Values beyond the grey band are chance in 1 of 100 cases. Correlation with an input at positive lags is dynamics
    that the model lacks; at negative lags, feedback from the output to the input. Correlation with the square is a
    nonlinearity that it lacks. A free-run residual may be correlated with itself: it holds the coloured noise. To pass
    is no proof: a missing odd law, such as friction, may show in neither; `diagnose` has sharper tests.

    Parameters
    ----------
    recording : Recording
        Samples before its `skip` are left out.
    simulated : list of (label, outputs)
        Outputs (M, n_y); simulations that diverge are not drawn.
    lags : int, optional
        Largest lag in samples; 100 by default, or an eighth of the samples.

    Raises
    ------
    InputError
        If the recording has too few scored samples for the lags.
    """
    r, first = recording, recording.skip
    most = LAGS if lags is None else lags
    most = min(most, (len(r) - first) // SHARE) if lags is None else most
    if len(r) - first < FEWEST:
        raise InputError(f"{r.label} has {len(r) - first} scored samples; residual tests need at least {FEWEST}.")
    figure = new_figure(11.0, 3.0 * r.n_y)
    axes = figure.subplots(r.n_y, 1 + 2 * r.n_u, squeeze=False)
    u = [(name, x[first:]) for name, x in zip(r.inputs, r.u.T, strict=True)]
    tested = [(name, x) for name, x in u] + [(f"{name}²", (x - np.mean(x)) ** 2) for name, x in u]
    drawn = [(label, y) for label, y in simulated if y is not None and np.all(np.isfinite(y))]
    for i, row in enumerate(axes):
        for ax in row:
            ax.axhspan(-BAND, BAND, color=PALE_GREY, linewidth=0)
            ax.axhline(0.0, color=INK, linewidth=0.6)
        for (label, y), colour in zip(drawn, cycle(SIMULATED_COLOURS), strict=False):
            e = y[first:, i] - r.y[first:, i]
            _draw(row[0], correlation(e, e, most)[most + 1 :] * np.sqrt(len(e)), 1, label, colour)
            for ax, (_, x) in zip(row[1:], tested, strict=True):
                if np.ptp(x) > 0:
                    _draw(ax, correlation(e, x, most) / chance(e, x, most), -most, label, colour)
        for ax, name in zip(row, ("itself", *(name for name, _ in tested)), strict=True):
            finish(ax, "lag [samples]", "correlation [deviations]", f"residual of {r.outputs[i]} with {name}", 1)
            ax.margins(x=0.01)
    return figure


def _draw(ax: Axes, values: np.ndarray, first: int, label: str, colour: str) -> None:
    """Draw correlations in standard deviations over lags; the label says the share beyond the band."""
    beyond = float(np.mean(np.abs(values) > BAND))
    line(ax, first + np.arange(len(values)), values, f"{label}: {100 * beyond:.0f} % beyond", colour)
