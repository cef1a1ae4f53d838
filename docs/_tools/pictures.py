"""Draw the pictures of the explanations."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from common import write_figure
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.posterior import share_named
from pilfr_casadi.plots import new_figure
from pilfr_casadi.plots.canvas import BLUE, FONT, GREY, INK, PALE_BLUE, PALE_GREY, SKY, VERMILLION, finish


def motion() -> np.ndarray:
    """A rise from rest, a major loop, and a minor loop inside it."""
    turns = [0, 1, -1, 1, -0.2, 0.5, -1]
    return np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(turns)])


def operate(z: np.ndarray, r: float, operator: Any = pilfr.play) -> np.ndarray:
    """Output of a play or a stop from rest."""
    q, out = 0.0, []
    for value in z:
        q = float(pilfr.play(value, q, r))
        out.append(q if operator is pilfr.play else value - q)
    return np.array(out)


def operators() -> Any:
    """Draw a play, a stop and a generalized play over the same motion."""
    figure, z = new_figure(8.2, 2.9), motion()
    axes = figure.subplots(1, 3)
    axes[0].plot(z, operate(z, 0.3), color=BLUE)
    axes[1].plot(z, operate(z, 0.3, pilfr.stop), color=BLUE)
    low, high, q, bent = np.tanh(2 * (z - 0.3)), np.tanh(3 * (z + 0.2)) * 1.1, 0.0, []
    for a, b in zip(low, np.maximum(low, high), strict=True):
        q = float(np.clip(q, a, b))
        bent.append(q)
    axes[2].plot(z, bent, color=BLUE)
    for ax, name in zip(axes, ("play", "stop", "generalized play"), strict=True):
        finish(ax, "input z", "output", name)
    return figure


def layers() -> Any:
    """Draw a sum of stops for growing numbers of operators, and the loading curve of the last."""
    figure, z = new_figure(8.2, 2.9), motion()
    axes = figure.subplots(1, 3)
    for ax, n in zip(axes, (1, 3, 20), strict=True):
        r = np.linspace(1 / n, 1, n) * 0.7 if n > 1 else np.array([0.3])
        w = 1 / n / np.sqrt(r)
        force = sum(wi * operate(z, ri, pilfr.stop) for wi, ri in zip(w, r, strict=True))
        ax.plot(z, force, color=BLUE)
        ax.plot(z[:200], force[:200], color=VERMILLION, linewidth=2)
        finish(ax, "z", "w", f"{n} stop{'s' if n > 1 else ''}")
    return figure


def box(ax: Axes, x: float, y: float, width: float, text: str, colour: str) -> None:
    """Draw a box with text around a centre."""
    ax.add_patch(
        FancyBboxPatch((x - width / 2, y - 0.28), width, 0.56, "round,pad=0.02", facecolor=colour, edgecolor=INK)
    )
    ax.text(x, y, text, ha="center", va="center", fontsize=FONT - 0.5)


def arrow(ax: Axes, *points: tuple[float, float], label: str = "", at: tuple[float, float] = (0, 0)) -> None:
    """Draw a line through points with an arrow at its end."""
    xs, ys = zip(*points[:-1], strict=True)
    ax.plot([*xs, points[-1][0]], [*ys, points[-1][1]], color=INK, linewidth=1.2, solid_capstyle="butt")
    head = FancyArrowPatch(points[-2], points[-1], arrowstyle="-|>", mutation_scale=11, color=INK, linewidth=1.2)
    ax.add_patch(head)
    ax.text(*at, label, ha="center", va="center", fontsize=FONT)


def loop(ax: Axes, below: str, above: str, title: str) -> None:
    """Draw a model closed by an element."""
    box(ax, 0, 0, 1.7, below, PALE_GREY)
    box(ax, 0, 1.05, 1.7, above, PALE_BLUE)
    arrow(ax, (-1.7, -0.1), (-0.87, -0.1), label="u", at=(-1.55, 0.05))
    arrow(ax, (0.87, -0.1), (1.7, -0.1), label="y", at=(1.55, 0.05))
    arrow(ax, (0.85, 0.15), (1.25, 0.15), (1.25, 1.05), (0.87, 1.05), label="z", at=(1.4, 0.6))
    arrow(ax, (-0.85, 1.05), (-1.25, 1.05), (-1.25, 0.15), (-0.87, 0.15), label="w", at=(-1.4, 0.6))
    ax.set(xlim=(-1.8, 1.8), ylim=(-0.45, 1.75), aspect="equal")
    ax.set_axis_off()
    ax.set_title(title, fontsize=FONT + 0.5)


def loops() -> Any:
    """Draw a PI-LFR and a simulator with a port as the same loop."""
    figure = new_figure(8.2, 2.9)
    left, right = figure.subplots(1, 2)
    loop(left, "linear model\nA, B, C, D", "plays or stops", "PI-LFR")
    loop(right, "your equations", "a law with memory", "simulator with a port")
    return figure


def hidden_effect() -> Any:
    """Draw what a refit does to a missing effect: a line through a friction loop."""
    t = np.linspace(0, 1, 400, endpoint=False)
    v = np.sin(2 * np.pi * t) + 0.5 * np.sin(6 * np.pi * t + 1)
    truth = 0.4 * v + np.tanh(v / 0.03)
    line = (v @ truth) / (v @ v) * v
    figure = new_figure(8.2, 2.9)
    left, right = figure.subplots(1, 2)
    order = np.argsort(v)
    left.plot(v[order], truth[order], color=BLUE, label="true force")
    left.plot(v[order], line[order], color=VERMILLION, label="damper, refitted")
    left.plot(v[order], 0.4 * v[order], color=GREY, label="true damper")
    finish(left, "speed", "force", columns=3)
    right.plot(t, truth - 0.4 * v, color=BLUE, label="missing")
    right.plot(t, truth - line, color=VERMILLION, label="left after the refit")
    finish(right, "time", "force")
    return figure


def confidence() -> Any:
    """Draw the probability that a law is the physics over the share that it leaves."""
    figure = new_figure(5.2, 3.0)
    ax = figure.subplots()
    share = np.geomspace(1e-4, 1, 300)
    ax.semilogx(share, [share_named(s) for s in share], color=BLUE)
    ax.axhline(0.5, color=SKY, linewidth=1)
    finish(ax, "share of the mismatch that a force could still explain", "probability that the name is right")
    return figure


def build() -> None:
    """Draw all pictures."""
    for draw in (operators, layers, loops, hidden_effect, confidence):
        write_figure(f"pictures/{draw.__name__}.svg", draw())
