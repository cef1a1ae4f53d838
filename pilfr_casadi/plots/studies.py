"""Figures of data and studies: best linear approximation, loops at several frequencies, operators, spread of fits.

Krikelis et al. (2024), Fig. 3 (operators), 7 (loops), 8 and 13 (best linear approximation), 11 (spread over starts).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._base import InputError
from ..linear import BLA
from ..models import Model, generalized_play, play, stop
from .canvas import (
    BLUE,
    FONT,
    GREEN,
    INK,
    ORANGE,
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


def best_linear_approximation(
    bla: BLA, model: Any = None, *, output: int = 0, input: int = 0, unit: str = "", ax: Axes | None = None
) -> Axes:
    """Draw magnitudes of the BLA and a model, their difference, and the estimate's deviations, as Fig. 8.

    Parameters
    ----------
    bla : BLA
        From `robust_bla` or `plain_bla`. Its deviations are those of the mean over realizations: a model whose error is
        the total deviation is as good as the data can show.
    model : Model, control.StateSpace or complex array (F, n_y, n_u), optional
        A linear model (without an element), or its response at `bla.frequency`.
    output, input : int
        Which pair of signals.
    unit : str
        Output unit per input unit.
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
    """Return the response `C (e^{jω dt} I - A)⁻¹ B + D` of a discrete-time linear model, (F, n_y, n_u), at (F,) Hz.

    Raises
    ------
    InputError
        If the model is not linear or its response has another shape.
    """
    if isinstance(model, Model):
        names = ("A", "B_u", "C_y", "D_yu")
        if model.element is not None or not set(names) <= set(model.parameters):
            raise InputError("A frequency response needs a linear model; give one without an element.")
        a, b, c, d = (model.parameters[name].value for name in names)
    elif all(hasattr(model, name) for name in "ABCD"):
        a, b, c, d = (np.asarray(getattr(model, name), dtype=float) for name in "ABCD")
    else:
        response = np.asarray(model)
        if response.ndim != 3 or len(response) != len(frequency):
            raise InputError(f"A response of shape {response.shape} was given; expected ({len(frequency)}, n_y, n_u).")
        return response
    shift = np.exp(2j * np.pi * np.asarray(frequency) * dt)[:, None, None] * np.eye(len(a))
    return c @ np.linalg.solve(shift - a, np.broadcast_to(b, (len(frequency), *b.shape))) + d


def loops(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]], x: str, y: str, *, title: str = "", ax: Axes | None = None
) -> Axes:
    """Draw loops of one signal over another, for example at several frequencies, dark to light, as Fig. 7.

    Parameters
    ----------
    curves : mapping
        Label to (x, y), each (M,).
    x, y : str
        Axis labels with units.
    """
    from matplotlib import colormaps

    ax = axes_or_new(ax)
    for k, (label, (horizontal, vertical)) in enumerate(curves.items()):
        colour = colormaps["viridis"](0.88 * k / max(len(curves) - 1, 1))
        ax.plot(
            horizontal, vertical, color=colour, linewidth=1.3, label=plain(label), rasterized=len(horizontal) > 2000
        )
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

    Parameters
    ----------
    errors : mapping
        Label of the group to its errors; infinite ones (no model, or one that ran away) are counted, not drawn.
    y, x, title : str
        Axis labels and title.
    published : mapping, optional
        Reference value by group, drawn as a diamond and called `source` in the legend.
    floor : float, optional
        Noise floor, drawn as a line.
    """
    ax = axes_or_new(ax)
    groups = [np.asarray(e, dtype=float).ravel() for e in errors.values()]
    finite = [g[np.isfinite(g)] for g in groups]
    ax.boxplot(
        finite,
        positions=range(len(groups)),
        widths=0.5,
        patch_artist=True,
        boxprops={"facecolor": "#D6E8F4", "edgecolor": BLUE},
        whiskerprops={"color": BLUE},
        capprops={"color": BLUE},
        medianprops={"color": VERMILLION, "linewidth": 2},
        flierprops={"marker": "x", "markeredgecolor": INK, "markersize": 5},
    )
    ax.plot([], [], color=VERMILLION, linewidth=2, label="median; box: quartiles")
    if published:
        at = {name: k for k, name in enumerate(errors)}
        ax.plot(
            [at[n] for n in published if n in at],
            [v for n, v in published.items() if n in at],
            "D",
            color=INK,
            markersize=6,
            label=plain(source),
        )
    noise_line(ax, floor or 0.0)
    ax.set_yscale("log")
    ax.set_xticks(range(len(groups)), [plain(name) for name in errors])
    if _crowded(errors):
        ax.set_xticks(range(len(groups)), [plain(", ".join(name.split("\n"))) for name in errors], rotation=90)
    lost = {k: len(group) - len(drawn) for k, (group, drawn) in enumerate(zip(groups, finite, strict=True))}
    if any(lost.values()):  # room above the boxes
        low, high = ax.get_ylim()
        most = max([*(float(np.max(g)) for g in finite if len(g)), *(published or {}).values(), low])
        ax.set_ylim(low, max(high, most * (most / low) ** 0.16))
    for k, n in lost.items():
        if n:
            at_top = ("data", "axes fraction")
            ax.annotate(f"{n}\nfailed", (k, 0.99), xycoords=at_top, ha="center", va="top", fontsize=9)
    return finish(ax, x, y, title, 3)


def _crowded(labels: Iterable[str]) -> bool:
    """Tell whether labels side by side, half an inch each, would overlap."""
    longest = [max(map(len, label.split("\n"))) for label in labels]
    return len(longest) > 3 and max(longest, default=0) > 6


def operators_demo(r: float = 1.0, amplitude: float = 4.0, samples: int = 2000) -> Figure:
    """Draw stop, play and generalized play of threshold r from zero memory, over a fading swing, as Fig. 3."""
    t = np.linspace(0.0, 1.0, samples)
    u = amplitude * (1 - 0.75 * t) * np.sin(6 * np.pi * t)

    def gamma_l(z: float) -> float:
        return z / 2 + (z / 4) ** 3

    def gamma_r(z: float) -> float:
        return gamma_l(z) - 0.1

    laws = {
        "stop": lambda z, q: (stop(z, q, r), play(z, q, r)),
        "play": lambda z, q: (play(z, q, r),) * 2,
        "generalized play": lambda z, q: (generalized_play(z, q, r, gamma_l, gamma_r),) * 2,
    }
    figure = new_figure(9.6, 3.4)
    for ax, (name, law) in zip(figure.subplots(1, 3), laws.items(), strict=True):
        q, v = 0.0, np.empty(samples)
        for k, z in enumerate(u):
            v[k], q = law(z, q)
        ax.plot(u, v, color=BLUE, linewidth=1.4)
        ax.plot(u[0], v[0], "o", color=VERMILLION, markersize=5, label="start")
        finish(ax, "input u", "output", f"{name}, r = {r:g}")
    return figure


def compared_spread(
    sets: Mapping[str, Mapping[str, Sequence[float]]],
    *,
    published: Mapping[str, Mapping[str, float]] | None = None,
    floor: float | None = None,
    source: str = "published",
    x: str = "",
    y: str = "NRMSE",
) -> Figure:
    """Draw box plots of several data sets on one scale, one `spread` each; keys are titles, then groups."""
    widest = max((len(groups) for groups in sets.values()), default=0)
    upright = max((len(label) for groups in sets.values() if _crowded(groups) for label in groups), default=0)
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
