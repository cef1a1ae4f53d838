"""Draw sketches of the gallery's machines, with the missing physics in red."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from common import write_figure
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle

from pilfr_casadi.plots import new_figure
from pilfr_casadi.plots.canvas import FONT, INK, PALE_BLUE, PALE_GREY, SKY, VERMILLION

LINE = 1.6


def _line(ax: Axes, x: Sequence[float], y: Sequence[float], colour: str = INK) -> None:
    ax.plot(x, y, color=colour, linewidth=LINE, solid_capstyle="round", solid_joinstyle="round")


def _box(ax: Axes, x: float, y: float, width: float, height: float, text: str = "") -> None:
    """Draw a body from its lower left corner."""
    ax.add_patch(Rectangle((x, y), width, height, facecolor=PALE_BLUE, edgecolor=INK, linewidth=LINE))
    ax.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=FONT + 2)


def _ground(ax: Axes, x0: float, x1: float, y: float, *, below: bool = True) -> None:
    """Draw a fixed surface with hatching below or above it."""
    _line(ax, [x0, x1], [y, y])
    step = -0.12 if below else 0.12
    for x in np.arange(x0 + 0.12, x1 + 0.01, 0.16):
        ax.plot([x, x - 0.12], [y, y + step], color=INK, linewidth=0.8)


def _wall(ax: Axes, x: float, y0: float, y1: float) -> None:
    """Draw a fixed wall with hatching to its left."""
    _line(ax, [x, x], [y0, y1])
    for y in np.arange(y0, y1 - 0.05, 0.16):
        ax.plot([x, x - 0.12], [y + 0.12, y], color=INK, linewidth=0.8)


def _spring(ax: Axes, x0: float, x1: float, y: float, colour: str = INK) -> None:
    ends, turns = 0.15 * (x1 - x0), 8
    zigzag = np.linspace(x0 + ends, x1 - ends, turns + 1)
    x = [x0, x0 + ends, *(zigzag[:-1] + np.diff(zigzag) / 2), x1 - ends, x1]
    _line(ax, x, [y, y, *(y + 0.13 * (-1.0) ** np.arange(turns)), y, y], colour)


def _damper(ax: Axes, x0: float, x1: float, y: float) -> None:
    middle = (x0 + x1) / 2
    _line(ax, [x0, middle - 0.12], [y, y])
    _line(ax, [middle + 0.2, middle - 0.12, middle - 0.12, middle + 0.2], [y + 0.13, y + 0.13, y - 0.13, y - 0.13])
    _line(ax, [middle + 0.06, middle + 0.06], [y - 0.09, y + 0.09])
    _line(ax, [middle + 0.06, x1], [y, y])


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], bend: float = 0.0) -> None:
    curve = f"arc3,rad={bend}"
    arrow = FancyArrowPatch(start, end, arrowstyle="-|>", connectionstyle=curve, mutation_scale=14, color=INK)
    arrow.set_linewidth(LINE)
    ax.add_patch(arrow)


def _label(ax: Axes, x: float, y: float, text: str, colour: str = INK) -> None:
    ax.text(x, y, text, ha="center", va="center", fontsize=FONT + 1, color=colour)


def slide(ax: Axes) -> None:
    """A carriage on a guide, held by a spring and a damper."""
    _wall(ax, 0.2, 0.45, 1.75)
    _spring(ax, 0.2, 1.5, 1.4)
    _damper(ax, 0.2, 1.5, 0.9)
    _box(ax, 1.5, 0.6, 1.1, 1.1, "2 kg")
    _arrow(ax, (2.6, 1.15), (3.4, 1.15))
    _label(ax, 3.2, 1.4, "force")
    _ground(ax, 0.9, 3.4, 0.45)
    ax.add_patch(Rectangle((1.55, 0.47), 1.0, 0.12, facecolor=VERMILLION, edgecolor="none"))
    _label(ax, 2.05, 0.12, "friction", VERMILLION)


def tank(ax: Axes) -> None:
    """A tank that a pump fills and an orifice empties."""
    ax.add_patch(Rectangle((1.3, 0.5), 1.4, 0.8, facecolor=SKY, alpha=0.5, edgecolor="none"))
    _line(ax, [1.3, 1.3, 2.7, 2.7], [1.8, 0.5, 0.5, 1.8])
    _line(ax, [2.7, 3.1], [0.55, 0.55])
    _line(ax, [2.7, 3.1], [0.7, 0.7])
    _arrow(ax, (3.05, 0.62), (3.5, 0.62))
    _arrow(ax, (2.0, 0.5), (2.0, 1.3))
    _label(ax, 2.32, 0.95, "level")
    ax.add_patch(Circle((0.6, 1.1), 0.33, facecolor=PALE_GREY, edgecolor=VERMILLION, linewidth=2 * LINE))
    _label(ax, 0.6, 1.1, "pump")
    _line(ax, [0.6, 0.6, 1.6], [1.43, 1.95, 1.95])
    _arrow(ax, (1.6, 1.95), (1.6, 1.4))
    _label(ax, 0.6, 0.5, "dead zone", VERMILLION)
    _label(ax, 0.6, 0.22, "of its voltage", VERMILLION)


def arm(ax: Axes) -> None:
    """An arm that hangs in a bearing."""
    _ground(ax, 1.1, 2.5, 1.85, below=False)
    for colour, width in ((INK, 7.0), (PALE_BLUE, 4.5)):
        ax.plot([1.8, 2.65], [1.7, 0.55], color=colour, linewidth=width, solid_capstyle="round")
    ax.add_patch(Circle((1.8, 1.7), 0.13, facecolor="white", edgecolor=VERMILLION, linewidth=2 * LINE, zorder=3))
    ax.plot([1.8, 1.8], [1.5, 0.4], color=INK, linewidth=0.8, linestyle="--")
    _arrow(ax, (1.8, 0.75), (2.38, 0.85), 0.2)
    _label(ax, 2.05, 0.55, "angle")
    _arrow(ax, (1.45, 1.55), (2.0, 1.35), 0.6)
    _label(ax, 1.35, 1.3, "torque")
    _label(ax, 2.45, 1.6, "friction", VERMILLION)
    _label(ax, 1.8, 0.12, "gravity as a sine", VERMILLION)


def gear(ax: Axes) -> None:
    """Two toothed wheels with play between their teeth."""
    for x, y, r, teeth, text, turn in ((1.05, 1.1, 0.55, 10, "servo", 0.0), (2.55, 1.1, 0.83, 15, "table", np.pi / 15)):
        angle = np.linspace(0, 2 * np.pi, 40 * teeth)
        radius = r + 0.09 * np.tanh(4 * np.cos(teeth * (angle - turn)))
        ring = np.column_stack((x + radius * np.cos(angle), y + radius * np.sin(angle)))
        ax.add_patch(Polygon(ring, facecolor=PALE_BLUE, edgecolor=INK, linewidth=LINE))
        _label(ax, x, y, text)
    ax.add_patch(Circle((1.67, 1.1), 0.17, facecolor="none", edgecolor=VERMILLION, linewidth=2 * LINE, zorder=3))
    _label(ax, 1.3, 0.12, "play between the teeth", VERMILLION)
    _arrow(ax, (0.65, 1.75), (1.4, 1.75), -0.4)


def two_masses(ax: Axes) -> None:
    """Two masses on a mount, with a joint between them."""
    _wall(ax, 0.15, 0.45, 1.75)
    _spring(ax, 0.15, 0.95, 1.3)
    _damper(ax, 0.15, 0.95, 0.85)
    _box(ax, 0.95, 0.6, 0.75, 0.95, "motor")
    _spring(ax, 1.7, 2.55, 1.3, VERMILLION)
    _damper(ax, 1.7, 2.55, 0.85)
    _box(ax, 2.55, 0.6, 0.75, 0.95, "load")
    _arrow(ax, (0.95, 1.75), (1.7, 1.75))
    _label(ax, 2.05, 1.75, "force")
    _ground(ax, 0.6, 3.5, 0.45)
    _label(ax, 2.1, 0.12, "microslip", VERMILLION)


MACHINES: tuple[Callable[[Axes], None], ...] = (slide, tank, arm, gear, two_masses)


def build() -> None:
    """Draw all sketches."""
    for draw in MACHINES:
        figure = new_figure(4.0, 2.8)
        ax = figure.add_subplot()
        draw(ax)
        ax.set(xlim=(0, 3.6), ylim=(0, 2.4), aspect="equal")
        ax.set_axis_off()
        write_figure(f"pictures/sketch_{draw.__name__}.svg", figure)
