"""Cases of the zoo made of linear blocks and hysteresis operators; the model class holds the truth in each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi.models import (
    PILFR,
    GeneralizedPlay,
    Parameter,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    close_loop,
    hammerstein,
    open_model,
    wiener,
)

from .zoo_case import Case, excitation, identified, noisy, plays, simulate_lfr


def lti(seed: int = 0) -> Case:
    """A resonance and a lag, two outputs, no element; the start is 10 % off in every entry."""
    rng = np.random.default_rng(seed)
    a, b = np.array([[0.95, 0.2, 0.0], [-0.2, 0.92, 0.0], [0.0, 0.1, 0.8]]), np.array([[0.1], [0.3], [0.2]])
    c, d = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.3]]), np.zeros((2, 1))
    none = {"C_z": np.zeros((0, 3)), "D_zu": np.zeros((0, 1)), "B_w": np.zeros((3, 0)), "D_yw": np.zeros((2, 0))}
    linear = {"A": a, "B_u": b, "C_y": c, "D_yu": d}
    u = 0.5 + excitation(rng, 1000, f_max=20.0)
    y = simulate_lfr(linear | none, u, lambda z, q: (z, q))
    start = {k: v * (1 + 0.1 * rng.uniform(-1, 1, v.shape)) for k, v in linear.items()}
    start["A"] = 0.95 * start["A"]
    return Case(PILFR(3).model(1, 2, start), (noisy(u, y, rng, 0.01),), (y,))


def backlash_loop(seed: int = 0) -> Case:
    """A servo that measures its load behind a backlash: `z` the motor, `w` the load, closed by the controller."""
    rng = np.random.default_rng(seed)
    gain, r = 0.3, 0.1
    blocks = {
        "A": np.array([[0.85, 0.0], [0.12, 1.0]]),
        "B_u": np.array([[gain], [0.0]]),
        "B_w": np.array([[-gain], [0.0]]),
        "C_y": np.zeros((1, 2)),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.ones((1, 1)),
        "C_z": np.array([[0.0, 1.0]]),
        "D_zu": np.zeros((1, 1)),
    }
    u = excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(np.ones((1, 1)), np.full((1, 1), r)))
    record = noisy(u, y, rng, 0.01)
    parameters = ParameterSet(
        {
            "lag": Parameter(0.7, bounds=(0.0, 0.999)),
            "gain": Parameter(0.2, bounds=(0.0, 10.0)),
        }
    )

    def step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
        return ca.vertcat(p["lag"] * x[0] + p["gain"] * (u - w), x[1] + 0.12 * x[0]), w

    servo = open_model(step, lambda x, u, p: x[1], parameters, n_x=2, n_u=1, n_w=1, states=("speed", "motor"))
    closed = close_loop(servo, PrandtlIshlinskii(Play, 1))
    values = closed.parameters.change(w={"value": np.ones((1, 1)), "fixed": True}, r={"value": np.zeros((1, 1))})
    truth = {"lag": 0.85, "gain": gain, "r": r}
    return Case(closed.with_parameters(values), (record,), (y,), truth)


def _layer(rng: np.random.Generator, n: int, reach: float, channels: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Weights and thresholds of a layer of plays, first threshold zero, (channels, n)."""
    r = reach * (np.arange(n) + rng.uniform(0.0, 0.3, (channels, n))) / n
    r[:, 0] = 0.0
    return rng.uniform(0.3, 1.0, (channels, n)) / n, r


def pi_hammerstein(seed: int = 3) -> Case:
    """An actuator with hysteresis before a resonance; three plays, fitted by three from a grid."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 3, 1.5)
    blocks = {
        "A": np.array([[0.9, 0.3], [-0.3, 0.9]]),
        "B_u": np.zeros((2, 1)),
        "B_w": np.array([[0.1], [0.3]]),
        "C_y": np.array([[1.0, 0.2]]),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.zeros((1, 1)),
        "C_z": np.zeros((1, 2)),
        "D_zu": np.ones((1, 1)),
    }
    u = excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = noisy(u, y, rng, 0.01)
    return Case(identified(hammerstein(2, PrandtlIshlinskii(Play, 3), offset=False), record, rng), (record,), (y,))


def pi_wiener(seed: int = 0) -> Case:
    """A resonance read through a sensor with hysteresis; six plays at known thresholds, two of them idle."""
    rng = np.random.default_rng(seed)
    r = np.array([[0.0, 0.1, 0.25, 0.5, 0.8, 1.2]])
    w = np.array([[0.3, 0.3, 0.0, 0.2, 0.3, 0.0]])
    blocks = {
        "A": np.array([[0.9, 0.3], [-0.3, 0.9]]),
        "B_u": np.array([[0.1], [0.3]]),
        "B_w": np.zeros((2, 1)),
        "C_y": np.zeros((1, 2)),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.ones((1, 1)),
        "C_z": np.array([[0.8, 0.2]]),
        "D_zu": np.zeros((1, 1)),
    }
    u = excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = noisy(u, y, rng, 0.01)
    structure = wiener(2, PrandtlIshlinskii(Play, 6), offset=False)
    structure = replace(structure, fixed={**structure.fixed, "r": r})
    return Case(identified(structure, record, rng), (record,), (y,), {"w": w})


def mimo_lfr(seed: int = 9) -> Case:
    """Two inputs, two outputs, two channels of hysteresis in feedback around two coupled resonances."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 2, 1.0, channels=2)
    a = np.zeros((4, 4))
    for i, (radius, angle) in enumerate(((0.93, 0.15), (0.9, 0.35))):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * turn
    a[0, 3] = 0.05
    blocks = {
        "A": a,
        "B_u": np.array([[0.05, 0.0], [0.2, 0.05], [0.0, 0.1], [0.05, 0.3]]),
        "B_w": np.array([[0.0, 0.0], [-0.12, 0.0], [0.0, 0.0], [0.0, -0.15]]),
        "C_y": np.array([[1.0, 0.0, 0.2, 0.0], [0.0, 0.1, 1.0, 0.0]]),
        "D_yu": np.zeros((2, 2)),
        "D_yw": np.zeros((2, 2)),
        "C_z": np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
        "D_zu": np.zeros((2, 2)),
    }
    u = excitation(rng, 1500, n_u=2)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = noisy(u, y, rng, 0.01)
    return Case(
        identified(PILFR(4, PrandtlIshlinskii(Play, 2, channels=2), offset=False), record, rng), (record,), (y,)
    )


def asymmetric(seed: int = 0) -> Case:
    """A static actuator whose loop bends on one side only: generalized plays between two unlike envelopes, Eq. 7."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 3, 0.8)
    truth = {"left": 0.5, "right": 0.1, "knee": 1.5, "shift": 0.4}

    def law(z: np.ndarray, q: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        q = np.zeros_like(r) if q is None else q
        bend = np.tanh(truth["knee"] * z - truth["shift"])[:, None]
        low = z[:, None] + truth["left"] * bend - r
        high = z[:, None] + truth["right"] * bend + r
        q = np.maximum(low, np.minimum(np.maximum(high, low), q))
        return np.sum(w * q, axis=1), q

    through = {"C_z": np.zeros((1, 0)), "D_zu": np.ones((1, 1)), "D_yw": np.ones((1, 1)), "D_yu": np.zeros((1, 1))}
    empty = {"A": np.zeros((0, 0)), "B_u": np.zeros((0, 1)), "B_w": np.zeros((0, 1)), "C_y": np.zeros((1, 0))}
    u = excitation(rng, 1000)
    y = simulate_lfr(through | empty, u, law)
    extra = ParameterSet(
        {
            "left": Parameter(0.2, bounds=(0.0, 2.0)),
            "right": Parameter(0.2, bounds=(0.0, 2.0)),
            "knee": Parameter(1.0, bounds=(0.1, 5.0)),
            "shift": Parameter(0.0, bounds=(-2.0, 2.0)),
        }
    )
    operator = GeneralizedPlay(
        gamma_l=lambda z, p: z + p["left"] * ca.tanh(p["knee"] * z - p["shift"]),
        gamma_r=lambda z, p: z + p["right"] * ca.tanh(p["knee"] * z - p["shift"]),
        extra=extra,
    )
    start = {"w": np.full((1, 3), 1 / 3), "r": np.array([[0.0, 0.3, 0.6]])}
    fixed = {"D_zu": 1.0, "D_yw": 1.0, "D_yu": 0.0}
    model = PILFR(0, PrandtlIshlinskii(operator, 3), fixed, offset=False).model(1, 1, start)
    return Case(model, (noisy(u, y, rng, 0.01),), (y,), truth | {"w": w, "r": r})
