"""
Plays and stops
===============

Hysteresis models consist of these operators. A play follows its input behind a gap; a stop is the remainder, like a
spring behind a slider. A weighted sum of plays draws nested loops.
"""

import numpy as np

import pilfr_casadi as pilfr

t = np.linspace(0.0, 4 * np.pi, 800)
z = (1.0 - 0.06 * t) * np.sin(t)


def run_play(r):
    """Run a play along z, from empty memory."""
    out, memory = np.zeros(len(z)), 0.0
    for k, value in enumerate(z):
        out[k] = memory = float(pilfr.play(value, memory, r))
    return out


thresholds, weights = np.array([0.1, 0.2, 0.35, 0.5]), np.array([0.4, 0.3, 0.2, 0.1])
plays = np.array([run_play(r) for r in thresholds])
curves = {
    "play": (z, plays[2]),
    "stop": (z, z - plays[2]),
    "sum of plays": (z, weights @ plays),
}
loops = pilfr.plots.loops(curves, "input z", "output w")
assert np.allclose(np.abs(z - plays[2]).max(), 0.35)  # a stop never exceeds its threshold
