"""Hysteretic models of the fine steering mirror and where they begin: at the linear family of `fsm_linear`.

Every element acts on the force of the actuators (`B_w` begins at `B_u`), driven by signals `z = C_z x + D_zu u` inside
the loop. What depends on the level in `fsm_linear` now depends on the signals' own past.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pilfr_casadi.models import CREST, PILFR, Combined, Envelope, Part, Play, PrandtlIshlinskii, Products, Stop, stop

from .fsm_linear import U_UNIT, Y_UNIT, Levels, in_modes

Array = np.ndarray
Values = dict[str, Any]
KNEE, STEEP = 2.5, 6.0  # κ(a) = STEEP (a - 1) / (a + KNEE) is -1, 0, 0.75 at the amplitudes 0.5, 1, 1.5
LOUDEST = 2.5  # amplitude, next to that at the middle level, beyond which an envelope grows no further
PLAYS = (0.1, 0.3, 0.7, 1.4)  # thresholds next to the signal's deviation at the middle level
STOPS = (0.3, 0.8, 1.6, 3.0)
INPUT = 2.0  # deviation of an input at the middle level, in tenths of a volt


def loop_closed_at(family: Levels, theta: Array, kappa: Array) -> Values:
    """Blocks of the linear family with κ closed in, in modal form again, `C_z` and `D_z` beside them."""
    v = family.unpack(theta)
    own, through = v["C_z"], v["D_z"]
    force, direct = v["B"] * kappa, v["D"] * kappa
    mask, A, B, C, C_z = in_modes(v["A"] + force @ own, v["B"] + force @ through, v["C"] + direct @ own, own)
    return {"mask": mask, "A": A, "B": B, "C": C, "D": v["D"] + direct @ through, "C_z": C_z, "D_z": through}


def in_volts(v: Values, paths: Array, C_z: Array, D_z: Array) -> Values:
    """Blocks of a PI-LFR in V and m; `paths` (3, n_w) says which channel acts where which actuator does."""
    return {
        "A": v["A"],
        "B_u": v["B"] / U_UNIT,
        "B_w": v["B"] @ paths,
        "C_y": v["C"] * Y_UNIT,
        "D_yu": v["D"] * Y_UNIT / U_UNIT,
        "D_yw": v["D"] @ paths * Y_UNIT,
        "C_z": C_z,
        "D_zu": D_z / U_UNIT,
    }


def known(mask: Array, n_w: int, inputs: slice) -> Values:
    """Fixed entries: A outside its blocks, channels that are the inputs alone."""
    n = len(mask)
    fixed = {
        "A": np.where(mask, np.nan, 0.0),
        "C_z": np.full((n_w, n), np.nan),
        "D_zu": np.full((n_w, 3), np.nan),
        "B_w": np.full((n, n_w), np.nan),
        "D_yw": np.full((3, n_w), np.nan),
    }
    fixed["C_z"][inputs], fixed["D_zu"][inputs] = 0.0, np.eye(3) / (INPUT * U_UNIT)
    return fixed


def pure(family: Levels, theta: Array, signals: list[Array]) -> tuple[PILFR, Values]:
    """A PI-LFR: stops on the signals that the level acts through (channels 0-2) and on the inputs (3-5).

    `signals` : z of each level (samples, 3), from which the weights are found that stand for κ of the level.
    """
    from scipy.optimize import nnls

    size = np.std(signals[1], axis=0)
    thresholds = np.outer(size, STOPS)
    kappa = np.array([-np.ones(3), np.zeros(3), family.unpack(theta)["kappa"]])
    weights, outer = np.zeros((3, len(STOPS))), np.zeros(3)
    for i in range(3):
        matrix = np.array([[*(-_gain(z[:, i], r) for r in thresholds[i]), 1.0] for z in signals])
        ridge = 0.02 * np.eye(len(STOPS) + 1)
        found = nnls(np.vstack([matrix, ridge]), np.concatenate([kappa[:, i], np.zeros(len(ridge))]))[0]
        weights[i], outer[i] = found[:-1], found[-1]
    v = loop_closed_at(family, theta, outer)
    n = len(v["A"])
    C_z, D_z = np.vstack([v["C_z"], np.zeros((3, n))]), np.vstack([v["D_z"], np.eye(3) / INPUT])
    values = in_volts(v, np.hstack([-np.eye(3), np.eye(3)]), C_z, D_z)
    values |= {"w": np.vstack([weights + 1e-3, np.full((3, len(STOPS)), 0.01)])}
    values |= {"r": np.vstack([thresholds, np.tile(STOPS, (3, 1))])}
    element = PrandtlIshlinskii(Stop, len(STOPS), 6)
    return PILFR(n, element, known(v["mask"], 6, slice(3, 6)), offset=False), values


def combined(family: Levels, theta: Array, signals: list[Array], deviation: Array) -> tuple[PILFR, Values]:
    """Envelopes on the signals that the level acts through, envelopes and products of the outputs, plays at the inputs.

    Channels: z 0-2 the signals that the level acts through, 3-5 begin as the outputs, 6-8 are the inputs; w 0-2 and 6-8
    begin as forces of the actuators, 3-5 are a second way for products, and that of the second envelopes. `deviation` :
    that of the outputs at the middle level, µm.
    """
    v = loop_closed_at(family, theta, np.full(3, -STEEP / KNEE))
    gain = STEEP * (1 + 1 / KNEE)  # κ(a) = -STEEP/KNEE + gain a/(a + KNEE)
    size = gain * np.std(signals[1], axis=0)
    parts = (
        Part("envelope", Envelope(3), (0, 1, 2)),
        Part("products", Products(3, (2, 3)), (3, 4, 5), (0, 1, 2)),
        Part("further", Products(3, (2, 3)), (3, 4, 5)),
        Part("second", Envelope(3), (3, 4, 5)),
        Part("input", PrandtlIshlinskii(Play, len(PLAYS), 3), (6, 7, 8)),
    )
    n = len(v["A"])
    C_z = np.vstack([gain * v["C_z"], v["C"] / deviation[:, None], np.zeros((3, n))])
    D_z = np.vstack([gain * v["D_z"], v["D"] / deviation[:, None], np.eye(3) / INPUT])
    values = in_volts(v, np.hstack([np.eye(3), np.zeros((3, 3)), np.eye(3)]), C_z, D_z)
    terms = parts[1].element.terms
    further = np.zeros((3, len(terms)))
    for i in range(3):
        further[i, terms.index((i, i))] = 0.15
    values |= {
        "envelope_rate": np.full(3, 1e-3),
        "envelope_knee": KNEE * size,
        "envelope_reach": CREST * LOUDEST * size,
        "products_reach": np.full(3, 6.0),
        "further_reach": np.full(3, 6.0),
        "second_rate": np.full(3, 1e-3),
        "second_knee": np.full(3, KNEE),
        "second_reach": np.full(3, CREST * LOUDEST),
        "further_gain": further,
        "input_w": np.full((3, len(PLAYS)), 0.01),
        "input_r": np.tile(PLAYS, (3, 1)),
    }
    fixed = known(v["mask"], 9, slice(6, 9))
    bounds = {"envelope_rate": (1e-4, 0.1), "second_rate": (1e-4, 0.1)}
    reaches = {name: values[name] for name in values if name.endswith("_reach")}
    return PILFR(n, Combined(parts), {**fixed, **reaches}, bounds, offset=False), values


def envelope_alone(structure: PILFR, values: Values) -> tuple[PILFR, Values]:
    """The combined model with the first envelopes alone: the difference is what the rest is worth."""
    n = structure.nx
    silent = {name: np.zeros_like(values[name]) for name in ("further_gain", "input_w")}
    silent |= {name: values[name] for name in ("second_rate", "second_knee", "input_r")}
    silent |= {"products_gain": np.zeros_like(values["further_gain"])}
    blocks = {name: np.array(structure.fixed[name], dtype=float) for name in ("B_w", "D_yw", "C_z", "D_zu")}
    blocks["B_w"][:, 3:], blocks["D_yw"][:, 3:] = 0.0, 0.0
    blocks["C_z"][3:6], blocks["D_zu"][3:6] = np.zeros((3, n)), np.zeros((3, 3))
    fixed = {**structure.fixed, **silent, **blocks}
    return replace(structure, fixed=fixed), {k: v for k, v in values.items() if k not in silent}


def _gain(z: Array, r: float) -> float:
    """Share of a signal that a stop of threshold r passes on, in phase, in steady state."""
    q, out = 0.0, np.empty(2 * len(z))
    for k, now in enumerate(np.concatenate([z, z])):
        out[k] = stop(now, q, r)
        q = now - out[k]
    return float(out[len(z) :] @ z / (z @ z))
