"""The pictures on the page of a fit: outputs, hysteresis, linear part (Krikelis et al. 2024, Figs. 8-11 and 15)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import plots
from .._base import InputError
from ..data import Recording
from ..identify import Fit
from ..linear import plain_bla, robust_bla
from .fit_tables import mode_tables
from .page import Block, Picture, Text

MOST = 4  # outputs drawn of each recording; tables have them all


def output_pictures(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
    """The outputs of recordings, measured and simulated."""
    out: list[Block] = []
    for r in recordings:
        for i in range(min(r.n_y, MOST)):
            out += _of_output(fit, r, i)
        if r.n_y > MOST:
            out.append(Text(f"The first {MOST} of {r.n_y} outputs are drawn; the table has them all."))
    return out


def _of_output(fit: Fit, r: Recording, i: int) -> list[Block]:
    """The pictures of one output; a quasi-static device is drawn over its input, any other over time."""
    name = f"{r.outputs[i]} in {r.name}"
    likeness = [abs(np.corrcoef(u, r.y[:, i])[0, 1]) if np.ptp(u) > 0 else 0.0 for u in r.u.T]
    j = int(np.argmax(likeness))
    if likeness[j] > 0.9:
        whole = Picture(
            plots.output_over_input(fit, r, input=j, output=i).figure,
            f"{name}, over {r.inputs[j]}.",
            f"Measured and simulated {name} over {r.inputs[j]}.",
        )
    else:
        whole = Picture(
            plots.time(fit, r, output=i).figure,
            f"{name}: the whole recording, and what the models leave over.",
            f"Output and residuals of {name} over time.",
        )
    return [
        Picture(
            plots.traces(fit, r, output=i).figure,
            f"{name}, measured and simulated, around the largest excursion.",
            f"Simulated over measured {name}.",
        ),
        whole,
        Picture(
            plots.remains(fit, r, output=i).figure,
            f"{name}: what this model leaves over, enlarged.",
            f"Residual of {name} over time.",
        ),
        Picture(
            plots.spectrum(fit, r, output=i).figure,
            f"{name}: output and residuals over frequency.",
            f"Amplitude densities of output and residuals of {name}.",
        ),
    ]


def curve(fit: Fit, recording: Recording) -> list[Block]:
    """What an element without memory does."""
    drawn = plots.loop(fit, recording).figure
    return [Picture(drawn, "The element has no memory: w is a curve over z.", "Curve of the element, w over z.")]


def hysteresis(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
    """Loops, loading curves and weights of every channel of the element."""
    intro = (
        "The element turns its local input z into w. Its scale is free (the linear part takes it up), "
        "so its shape counts, not its size."
    )
    out: list[Block] = [Text(intro)]
    for c in range(fit.model.n_w):
        of = f" of channel {c + 1}" if fit.model.n_w > 1 else ""
        out.append(
            Picture(
                plots.loop(fit, recordings[0], channel=c).figure,
                f"The identified loop{of}: w over z.",
                f"Hysteresis loop{of}, w over z.",
            )
        )
        out.append(
            Picture(
                plots.loading_curve(fit, recordings, channel=c).figure,
                f"Loading curve{of}: w while z grows from rest.",
                f"Loading curve{of}.",
            )
        )
        out.insert(
            -1,
            Picture(
                plots.loop(fit, recordings[0], channel=c, bare=True).figure,
                f"The same{of} without its mean slope: the hysteresis alone.",
                f"Hysteresis loop{of} without its slope.",
            ),
        )
        if {"r", "w"} <= set(fit.parameters):
            out.append(
                Picture(
                    plots.weights(fit, recordings, channel=c).figure,
                    f"Weights of the operators{of} over their thresholds, with standard errors where known.",
                    f"Weights{of} over thresholds.",
                )
            )
    return out


def linear_part(fit: Fit, train: Sequence[Recording]) -> list[Block]:
    """Modes, and the linear model of the start over what the training data say of it."""
    out = mode_tables(fit)
    linear = fit.linear if fit.linear is not None else fit.model if fit.model.element is None else None
    if linear is None or "A" not in linear.parameters:
        return out
    try:
        periodic = all(r.period for r in train)
        bla = robust_bla(train) if periodic else plain_bla(train)
    except InputError:
        return out
    for i in range(min(bla.n_y, 2)):
        for j in range(min(bla.n_u, 2)):
            if bla.var_total is not None and np.mean(bla.var_total[:, i, j] < np.abs(bla.G[:, i, j]) ** 2) < 0.5:
                continue  # the training data excites too few frequencies for this one
            units = [fit.units.get(n, "") for n in (fit.model.outputs[i], fit.model.inputs[j])]
            figure = plots.best_linear_approximation(
                bla, linear, output=i, input=j, unit="/".join(units) if all(units) else ""
            ).figure
            of = f"{fit.model.outputs[i]} over {fit.model.inputs[j]}"
            caption = f"Best linear approximation of {of} in the training data, and the linear model of the start."
            out.append(Picture(figure, caption, f"Frequency response, {of}."))
    return out
