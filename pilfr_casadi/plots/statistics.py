"""Figures of many recordings or fits: best linear approximation, loops, spread of errors; tests of residuals.

Krikelis et al. (2024), Fig. 7 (loops), 8 and 13 (best linear approximation), 11 (spread over starts). For the theory of
residual tests see `data.correlation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._base import InputError
from ..data import BAND, Recording, chance, correlation
from ..linear import BLA, LinearPart
from ..models import Model
from .canvas import (
    BLUE,
    BOX,
    FONT,
    GREEN,
    INK,
    LOOP_COLOURS,
    MOST_POINTS,
    ORANGE,
    PALE_GREY,
    PURPLE,
    VERMILLION,
    axes_or_new,
    decibel,
    finish,
    limit_depth,
    line,
    new_figure,
    noise_line,
    plain,
)
from .signals import Simulated, assign_colours

LAG_SHARE = 8  # scored samples over the largest lag by default
DEFAULT_LAGS = 100  # largest lag by default, samples
FEWEST_SAMPLES = 32  # scored samples below which the band means nothing


def best_linear_approximation(
    bla: BLA, model: Any = None, *, output: int = 0, input: int = 0, unit: str = "", ax: Axes | None = None
) -> Axes:
    """Draw magnitudes of the BLA and a model, their difference, and the estimate's deviations, as Fig. 8.

    `model` is linear (a `Model` without an element, or a `control.StateSpace`), or a response at `bla.frequency`,
    (F, n_y, n_u). The deviations are those of the mean over realizations: the data cannot distinguish a model from the
    true system if its error is below the total deviation. `unit` is the output's unit per input unit.
    """
    ax = axes_or_new(ax)
    f, G = bla.frequency, bla.G[:, output, input]
    curves = [decibel(np.abs(G) ** 2)]
    line(ax, f, curves[0], "measured (BLA)", BLUE, linewidth=2.2)
    if model is not None:
        response = frequency_response(model, f, bla.dt)[:, output, input]
        curves += [decibel(np.abs(response) ** 2), decibel(np.abs(response - G) ** 2)]
        line(ax, f, curves[1], "linear model", VERMILLION, linestyle="--")
        line(ax, f, curves[2], "error of the linear model", ORANGE)
    for label, var, colour, style in (
        ("noise and distortion", bla.var_total, PURPLE, ":"),
        ("noise", bla.var_noise, GREEN, "--"),
    ):
        if var is not None:
            curves.append(decibel(var[:, output, input]))
            line(ax, f, curves[-1], f"deviation by {label}", colour, linestyle=style, linewidth=1.4)
    ax.set_xscale("log")
    limit_depth(ax, *curves)
    return finish(ax, "frequency [Hz]", f"magnitude [dB re 1 {unit}]" if unit else "magnitude [dB]", "")


def frequency_response(model: Any, frequency: np.ndarray, dt: float) -> np.ndarray:
    """Compute the response `C (e^{jω dt} I - A)⁻¹ B + D` of a discrete-time linear model, (F, n_y, n_u), at (F,) Hz."""
    if isinstance(model, Model):
        names = ("A", "B_u", "C_y", "D_yu")
        if model.element is not None or not set(names) <= set(model.parameters):
            raise InputError("The model is not linear; give a linear model, without an element.")
        a, b, c, d = (model.parameters[name].value for name in names)
    elif all(hasattr(model, name) for name in "ABCD"):
        a, b, c, d = (np.asarray(getattr(model, name), dtype=float) for name in "ABCD")
    else:
        response = np.asarray(model)
        if response.ndim != 3 or len(response) != len(frequency):
            raise InputError(f"A response of shape {response.shape} was given; expected ({len(frequency)}, n_y, n_u).")
        return response
    return LinearPart(a, b, c, d, dt).response(frequency)


def loops(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]], x: str, y: str, *, title: str = "", ax: Axes | None = None
) -> Axes:
    """Draw loops of one signal over another, for example at several frequencies, from dark to light, as Fig. 7.

    `curves` maps labels to (x, y), each (M,); `x` and `y` are axis labels with units.
    """
    from matplotlib import colormaps

    ax = axes_or_new(ax)
    for k, (label, (horizontal, vertical)) in enumerate(curves.items()):
        colour = colormaps[LOOP_COLOURS](0.88 * k / max(len(curves) - 1, 1))
        dense = len(horizontal) > MOST_POINTS
        ax.plot(horizontal, vertical, color=colour, linewidth=1.3, label=plain(label), rasterized=dense)
    return finish(ax, x, y, title, 3)


def spread(
    errors: Mapping[str, Sequence[float] | np.ndarray],
    y: str = "NRMSE",
    *,
    published: Mapping[str, float] | None = None,
    floor: float | None = None,
    source: str = "published",
    title: str = "",
    x: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw box plots of the errors of many fits, as Fig. 11: median, quartiles, whiskers to 1.5 box heights, crosses.

    `errors` maps the label of a group to its errors; the number of infinite errors (no model, or a diverging one) is
    written above the box. `published` maps a group to a reference value, drawn as a diamond with the label `source`.
    `floor` is the noise level, drawn as a line.
    """
    ax = axes_or_new(ax)
    groups = [np.asarray(e, dtype=float).ravel() for e in errors.values()]
    finite = [g[np.isfinite(g)] for g in groups]
    ax.boxplot(
        finite,
        positions=range(len(groups)),
        widths=0.5,
        patch_artist=True,
        boxprops={"facecolor": BOX, "edgecolor": BLUE},
        whiskerprops={"color": BLUE},
        capprops={"color": BLUE},
        medianprops={"color": VERMILLION, "linewidth": 2},
        flierprops={"marker": "x", "markeredgecolor": INK, "markersize": 5},
    )
    ax.plot([], [], color=VERMILLION, linewidth=2, label="median; box: quartiles")
    if published:
        at = {name: k for k, name in enumerate(errors)}
        known = {at[name]: value for name, value in published.items() if name in at}
        ax.plot(list(known), list(known.values()), "D", color=INK, markersize=6, label=plain(source))
    noise_line(ax, floor or 0.0)
    ax.set_yscale("log")
    ax.set_xticks(range(len(groups)), [plain(name) for name in errors])
    if _labels_overlap(errors):
        ax.set_xticks(range(len(groups)), [plain(", ".join(name.split("\n"))) for name in errors], rotation=90)
    failed = {k: len(group) - len(drawn) for k, (group, drawn) in enumerate(zip(groups, finite, strict=True))}
    if any(failed.values()):  # leave room above the boxes
        low, high = ax.get_ylim()
        top = max([*(float(np.max(g)) for g in finite if len(g)), *(published or {}).values(), low])
        ax.set_ylim(low, max(high, top * (top / low) ** 0.16))
    for k, n in failed.items():
        if n:
            at_top = ("data", "axes fraction")
            ax.annotate(f"{n}\nfailed", (k, 0.99), xycoords=at_top, ha="center", va="top", fontsize=9)
    return finish(ax, x, y, title, 3)


def _labels_overlap(labels: Iterable[str]) -> bool:
    """Tell whether adjacent labels, half an inch each, would overlap."""
    longest = [max(map(len, label.split("\n"))) for label in labels]
    return len(longest) > 3 and max(longest, default=0) > 6


def compared_spread(
    sets: Mapping[str, Mapping[str, Sequence[float]]],
    *,
    published: Mapping[str, Mapping[str, float]] | None = None,
    floor: float | None = None,
    source: str = "published",
    x: str = "",
    y: str = "NRMSE",
) -> Figure:
    """Draw one `spread` for each data set on a common scale; `sets` maps titles to groups of errors."""
    widest = max((len(groups) for groups in sets.values()), default=0)
    upright = max((len(label) for groups in sets.values() if _labels_overlap(groups) for label in groups), default=0)
    figure = new_figure(max(3.6, 0.5 * widest) * max(len(sets), 1) + 0.6, 4.0 + 0.08 * upright)
    first: Axes | None = None
    for k, (title, errors) in enumerate(sets.items()):
        ax = figure.add_subplot(1, len(sets), k + 1, sharey=first)
        reference = (published or {}).get(title)
        spread(errors, y if k == 0 else "", published=reference, floor=floor, source=source, title=title, x=x, ax=ax)
        first = first or ax
        if legend := ax.get_legend():
            legend.remove()
        ax.set_title(plain(title), fontsize=FONT + 0.5, loc="left")
    if first is not None:
        handles, labels = first.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=10)
    return figure


def residual_tests(recording: Recording, simulated: Simulated, *, lags: int | None = None) -> Figure:
    """Draw correlations of residuals: with themselves, with every input, and with every input's square.

    By chance, 1 of 100 values lies beyond the grey band. Correlation with an input at positive lags shows dynamics that
    the model lacks, at negative lags feedback from the output to the input. Correlation with the square shows a missing
    nonlinearity. A free-run residual may be correlated with itself, because it contains the coloured noise. A model
    that passes may still lack an odd law, such as friction; `diagnose` has sharper tests.

    Parameters
    ----------
    recording : Recording
        Samples before its `skip` are left out.
    simulated : list of (label, outputs)
        Outputs (M, n_y); simulations that diverge, or whose residual is constant, are not drawn.
    lags : int, optional
        Largest lag in samples; 100 by default, or an eighth of the samples.

    Raises
    ------
    InputError
        If the recording has too few scored samples.
    """
    r, first = recording, recording.skip
    most = min(DEFAULT_LAGS, (len(r) - first) // LAG_SHARE) if lags is None else lags
    if len(r) - first < FEWEST_SAMPLES:
        raise InputError(
            f"{r.label} has {len(r) - first} scored samples; residual tests need at least {FEWEST_SAMPLES}."
        )
    figure = new_figure(11.0, 3.0 * r.n_y)
    axes = figure.subplots(r.n_y, 1 + 2 * r.n_u, squeeze=False)
    u = [(name, x[first:]) for name, x in zip(r.inputs, r.u.T, strict=True)]
    tested = [(name, x) for name, x in u] + [(f"{name}²", (x - np.mean(x)) ** 2) for name, x in u]
    drawn = [(label, y) for label, y in simulated if y is not None and np.all(np.isfinite(y))]
    for i, row in enumerate(axes):
        for ax in row:
            ax.axhspan(-BAND, BAND, color=PALE_GREY, linewidth=0)
            ax.axhline(0.0, color=INK, linewidth=0.6)
        for label, y, colour in assign_colours(drawn):
            e = y[first:, i] - r.y[first:, i]
            if not np.ptp(e) > 0:
                continue  # an exact model, or one that is off by a constant, leaves nothing to correlate
            _draw_correlation(row[0], correlation(e, e, most)[most + 1 :] * np.sqrt(len(e)), 1, label, colour)
            for ax, (_, x) in zip(row[1:], tested, strict=True):
                if np.ptp(x) > 0:
                    _draw_correlation(ax, correlation(e, x, most) / chance(e, x, most), -most, label, colour)
        for ax, name in zip(row, ("itself", *(name for name, _ in tested)), strict=True):
            finish(ax, "lag [samples]", "correlation [deviations]", f"residual of {r.outputs[i]} with {name}", 1)
            ax.margins(x=0.01)
    return figure


def _draw_correlation(ax: Axes, values: np.ndarray, first: int, label: str, colour: str) -> None:
    """Draw correlations in standard deviations over lags; the label gives the share beyond the band."""
    beyond = float(np.mean(np.abs(values) > BAND))
    line(ax, first + np.arange(len(values)), values, f"{label}: {100 * beyond:.0f} % beyond", colour)
