r"""Start values of a PI-LFR: the element in a linear model (`linear_start`).

`paper_start` is Krikelis et al. (2024), Eq. 22-24. `grid_start` spreads the thresholds over the range of z instead of
drawing them from `U(0, R)`, because idle or identical thresholds hardly separate again; z is a random direction, or
the linear model's output or input. `network_start` is for elements without memory. `envelope_start` is for generalized
plays. Between its envelopes such a play keeps its value (Eq. 7), so the values `v` at one `z` fill the
interval from the lower to the upper envelope: the outline of the cloud `(z, v)` estimates both. If the element is at
the output, its answer `v` is the measured output. If it is at the input, `v` is the input with which the linear model
would have given the measured output,

    V = U + G^H (G G^H + λ I)⁻¹ (Y - G U),

with the linear model's response G at each frequency; λ damps frequencies that G hardly passes. The networks of Eq. 14
are then fitted to the outline by non-negative least squares, with the neurons spread over the range of z. Envelopes
that start as straight lines (or, as in Sec. 5.3, at random) rarely bend to the envelopes of a saturating loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Recording
from ..linear import resolvent, scale_states, spectral_radius
from ..models import (
    PILFR,
    Element,
    GeneralizedPlay,
    PrandtlIshlinskii,
    StaticNetwork,
    direction_fixed,
    fixed_blocks,
    is_hammerstein,
    is_wiener,
    is_zero,
    neurons_over,
    or_one,
)
from .linear_start import Blocks, Values, simulate_states

Array = np.ndarray
Signals = list[np.ndarray]  # one array (M, channels) for each recording
LINEAR = ("A", "B_u", "C_y", "D_yu", "y_0")
PAPER_RANGE = 0.1  # R of Eq. 24
# Deviation of the signals of neurons of slope one at the start. Among 1, 0.3, 0.1 and 0.03 this value gave the smallest
# training error over two records of the two-mass rig and two sizes; no test recording was used.
START_DEVIATION = 0.1
OUTLINE_BINS = 40  # bins of z for the outline of a loop
OUTLYING_SHARE = 0.03  # share of the samples at one z that lie outside each envelope
DAMPING = 0.05  # damping of the inverse of the linear model, in units of its largest gain
LEAST_SHARE = 0.01  # least total height of the neurons, as a share of the curve's, so that every neuron has a slope


def unit_states(blocks: Values, inputs: Signals, free: bool = True) -> tuple[Blocks, Signals]:
    """Scale each state to unit variance (Sec. 5.3), if free; return the blocks, and the states of each recording."""
    states = [simulate_states(blocks, u) for u in inputs]
    if not free:
        return dict(blocks), states
    spread = or_one(np.sqrt(np.mean(np.concatenate(states) ** 2, axis=0)))
    return scale_states(blocks, spread), [x / spread for x in states]


def paper_start(structure: PILFR, linear: Values, inputs: Signals, states: Signals, rng: np.random.Generator) -> Blocks:
    """Draw the start of Eq. 22-24: `C_z, D_zu ~ U(-1, 1)`, `w ~ U(0, 1/N)`, `r ~ U(0, R)`, `B_w = D_yw = 0`.

    R is 0.1. If the structure fixes the direction of z, thresholds are in units of z's deviation: z then has the units
    of an input or output, and thresholds of other units could all exceed it. For a Wiener model z is the linear model's
    output: with any other z the non-negative weights fall to zero, where no other parameter has a slope.
    """
    element = _pi_element(structure)
    shape = (element.channels, element.n)
    blocks = _directions(element, linear, rng)
    blocks["w"], blocks["r"] = rng.uniform(0, 1 / element.n, shape), rng.uniform(0, PAPER_RANGE, shape)
    if direction_fixed(structure):
        blocks |= _fixed_values(structure, linear, blocks)
        blocks["r"] *= or_one(np.std(_signal(inputs, states, blocks), axis=0))[:, None]
    return blocks


def grid_start(
    structure: PILFR, linear: Values, inputs: Signals, states: Signals, rng: np.random.Generator, place: str = "random"
) -> Blocks:
    """Choose a direction of z of unit deviation, thresholds on a grid over its range, and equal weights.

    Places of the element; the last two stand for the commonest structures, backlash or friction in the sensor or the
    actuator of a linear system:

    - "random": a random direction in states and inputs, each in units of its deviation; `B_w = D_yw = 0`; if the
      structure fixes the direction, random thresholds in place of the grid;
    - "output": z is the linear model's output, half of which passes through the element;
    - "input": z is the input, half of which passes through the element to the linear model.

    For Hammerstein and Wiener structures the linear blocks move to the other side of the element. With other fixed
    blocks, "output" and "input" give the direction of z alone.
    """
    element = _pi_element(structure)
    blocks, z = _place_element(structure, element, linear, inputs, states, rng, place)
    widest = np.max(np.abs(z), axis=0)
    grid = np.tile(np.arange(element.n) / element.n, (element.channels, 1))
    if place == "random" and direction_fixed(structure):
        grid[:, 1:] = np.sort(rng.uniform(size=(element.channels, element.n - 1)), axis=1)
    blocks["r"] = 0.9 * widest[:, None] * grid
    blocks["w"] = np.full((element.channels, element.n), 1.0 / element.n)
    return blocks


def network_start(
    structure: PILFR, linear: Values, inputs: Signals, states: Signals, rng: np.random.Generator
) -> Blocks:
    """Draw directions of z of unit deviation and neurons that bend in its range; `B_w = D_yw = 0`.

    As in Schoukens (2021), the network has no effect at first: the model starts as the linear one. If slopes are fixed
    at one, z has the deviation `START_DEVIATION`: neurons that start nearly linear reach better minima.
    """
    element = structure.element
    assert isinstance(element, StaticNetwork)
    blocks, z = _place_element(structure, element, linear, inputs, states, rng, "random")
    if "slope" in structure.fixed and not {"C_z", "D_zu"} & set(structure.fixed):
        blocks, z = blocks | {k: START_DEVIATION * blocks[k] for k in ("C_z", "D_zu")}, START_DEVIATION * z
    return blocks | neurons_over(structure, element, z, rng)


def _pi_element(structure: PILFR) -> PrandtlIshlinskii:
    assert isinstance(structure.element, PrandtlIshlinskii)
    return structure.element


def _directions(element: Element, linear: Values, rng: np.random.Generator) -> Blocks:
    """Add a random direction of z to the linear blocks, Eq. 22 and 23."""
    blocks = {name: linear[name] for name in LINEAR}
    for name, axis in (("C_z", 0), ("D_zu", 1)):  # of `B_u` (nx, n_u)
        blocks[name] = rng.uniform(-1, 1, (element.channels, linear["B_u"].shape[axis]))
    return blocks


def _place_element(
    structure: PILFR,
    element: Element,
    linear: Values,
    inputs: Signals,
    states: Signals,
    rng: np.random.Generator,
    place: str,
) -> tuple[Blocks, Array]:
    """Return the linear blocks with the element at its place (see `grid_start`), and the signal z (M, channels)."""
    blocks = _directions(element, linear, rng)
    fixed, n_u = fixed_blocks(structure), linear["B_u"].shape[1]
    blocks["D_zu"] = blocks["D_zu"] / or_one(np.std(np.concatenate(inputs), axis=0))
    at_output, at_input = (np.arange(element.channels) % n for n in (len(linear["C_y"]), n_u))
    if place == "output":
        blocks["C_z"], blocks["D_zu"] = linear["C_y"][at_output], linear["D_yu"][at_output]
    elif place == "input" and not is_zero(structure, "D_zu"):
        blocks["C_z"], blocks["D_zu"] = np.zeros_like(blocks["C_z"]), np.eye(n_u)[at_input]
    if is_hammerstein(structure):
        blocks["B_w"], blocks["D_yw"] = linear["B_u"], linear["D_yu"]
    blocks |= _fixed_values(structure, linear, blocks)
    z = _signal(inputs, states, blocks)
    size = or_one(np.std(z, axis=0))
    if all(is_zero(structure, k) for k in ("C_z", "D_zu", "D_yw") if k in fixed):
        blocks["C_z"], blocks["D_zu"], z = blocks["C_z"] / size[:, None], blocks["D_zu"] / size[:, None], z / size
    if place != "random" and not {*blocks, "w", "r"} & set(fixed) and not {"B_w", "D_yw"} & set(structure.fixed):
        blocks |= _split_path(linear, size, at_output if place == "output" else at_input, place == "output")
    return blocks, z


def _signal(inputs: Signals, states: Signals, blocks: Values) -> Array:
    """Compute the signal z (M, channels) of all recordings."""
    return np.concatenate(states) @ blocks["C_z"].T + np.concatenate(inputs) @ blocks["D_zu"].T


def _fixed_values(structure: PILFR, linear: Values, blocks: Blocks) -> Blocks:
    """Return the blocks that the structure fixes, and for a Wiener model z = the linear model's output."""
    out = {"C_z": linear["C_y"], "D_zu": linear["D_yu"]} if is_wiener(structure) else {}
    fixed = {k: np.asarray(structure.fixed[k], dtype=float) for k in fixed_blocks(structure) if k in blocks}
    return out | {k: np.broadcast_to(v, blocks[k].shape) for k, v in fixed.items()}


def _split_path(linear: Values, size: Array, at: Array, output: bool) -> Blocks:
    """Split the path of output or input `at[i]`: half stays direct, half passes through the element's channel i."""
    through = np.zeros((len(at), len(linear["C_y"]) if output else linear["B_u"].shape[1]))
    through[np.arange(len(at)), at] = size
    carried = np.count_nonzero(through, axis=0)
    through *= 0.5 / np.maximum(carried, 1)
    return _route(linear, through.T, np.where(carried > 0, 0.5, 1.0), not output)


def _route(linear: Values, through: Array, direct: Array, before: bool) -> Blocks:
    """Route inputs (`before`) or outputs by `through` (n, channels) to the element; the share `direct` bypasses it."""
    b, c, d = linear["B_u"], linear["C_y"], linear["D_yu"]
    if before:
        return {"B_w": b @ through, "D_yw": d @ through, "B_u": b * direct, "D_yu": d * direct}
    return {"D_yw": through, "C_y": c * direct[:, None], "D_yu": d * direct[:, None]}


def envelope_start(
    structure: PILFR,
    linear: Values,
    values: Values,
    recordings: Sequence[Recording],
    states: Sequence[Array],
    place: str,
) -> Blocks:
    """Choose envelopes, thresholds and weights of a generalized play from the loops of z and its answer.

    `values` (from `grid_start`) define z. They are returned unchanged if the structure fixes blocks that a Hammerstein
    or Wiener model leaves free. At `place` "random" the output is read through the element, as at "output".
    """
    element = _pi_element(structure)
    fixed = set(structure.fixed) - {"y_0", "A"}
    before = {"B_u", "D_zu"} <= fixed or (not fixed and place == "input")
    if fixed and not before and not {"C_y", "D_yw"} <= fixed:
        return dict(values)
    pairs = list(zip(recordings, states, strict=True))
    z = np.concatenate([(x @ values["C_z"].T + r.u @ values["D_zu"].T)[r.skip :] for r, x in pairs])
    v = np.concatenate([(deconvolve_inputs(linear, r, x) if before else r.y)[r.skip :] for r, x in pairs])
    blocks, channels = dict(values), np.arange(element.channels)
    at = channels % (linear["B_u"].shape[1] if before else len(linear["C_y"]))
    centre, size = np.mean(v, axis=0), or_one(np.std(v, axis=0))
    if fixed:
        centre, size = np.zeros_like(centre), np.ones_like(size)
    else:
        through = np.zeros((len(size), element.channels))
        through[at, channels] = (size / np.maximum(np.bincount(at, minlength=len(size)), 1))[at]
        direct = np.bincount(at, minlength=len(size)) == 0
        blocks |= _route(linear, through, direct, before)
        if not before:
            blocks["y_0"] = np.where(direct, linear["y_0"], centre)
        else:
            blocks["y_0"] = linear["y_0"] + _gain(linear) @ np.where(direct, 0.0, centre)
    for i in channels:
        target = (v[:, at[i]] - centre[at[i]]) / size[at[i]]
        if not fixed and z[:, i] @ target < 0:  # envelopes rise, so z has to rise with the answer
            z[:, i] *= -1
            blocks |= {
                name: np.where((channels == i)[:, None], -blocks[name], blocks[name]) for name in ("C_z", "D_zu")
            }
        for name, row in channel_start(element, z[:, i], target).items():
            blocks[name] = np.array(blocks.get(name, np.zeros((element.channels, row.size))), dtype=float)
            blocks[name][i] = row
    return blocks


def _gain(linear: Values) -> Array:
    """Compute the static gain (n_y, n_u); 0 for an integrator."""
    a = linear["A"]
    if spectral_radius(a) > 0.9999:
        return np.zeros_like(linear["D_yu"])
    return linear["C_y"] @ np.linalg.solve(np.eye(len(a)) - a, linear["B_u"]) + linear["D_yu"]


def deconvolve_inputs(linear: Values, recording: Recording, states: Array) -> Array:
    """Compute the inputs (M, n_u) for which the linear model gives the measured outputs: V of the module docstring."""
    u, y = recording.u, recording.y
    error = np.fft.rfft(y - states @ linear["C_y"].T - u @ linear["D_yu"].T - linear["y_0"], axis=0)
    z = np.exp(2j * np.pi * np.arange(len(error)) / len(u))
    g = resolvent(linear["A"], linear["C_y"], z) @ linear["B_u"] + linear["D_yu"]
    g = np.where(np.isfinite(g), g, 0.0)
    conjugate = g.conj().transpose(0, 2, 1)
    damped = g @ conjugate + (DAMPING * np.max(np.abs(g))) ** 2 * np.eye(g.shape[1])
    correction = conjugate @ np.linalg.solve(damped, error[:, :, None])
    return u + np.fft.irfft(correction[:, :, 0], len(u), axis=0)


def channel_start(element: PrandtlIshlinskii, z: Array, v: Array) -> Blocks:
    """Choose the envelopes, thresholds and weights of a channel by name from its signal z (M,) and answer v (M,)."""
    centres, low, high = loop_outline(z, v)
    n, operator = element.n, element.operator
    widest = float(np.max(high - low)) / 2
    r = 0.9 * widest * np.arange(n) / n
    inner = float(np.mean(r))
    rows = {"r": r, "w": np.full(n, 1.0 / n)}
    for side, curve in (("l", low + inner), ("r", high - inner)):
        rows |= {f"gamma_{side}_{k}": row for k, row in fit_envelope(centres, curve, operator.neurons).items()}
    return rows


def loop_outline(z: Array, v: Array) -> tuple[Array, Array, Array]:
    """Outline the cloud (z, v), both (M,): return centres of bins, and a rising lower and upper curve (bins,).

    A play lags behind z. Loops in the other direction, ahead of z, get no width.
    """
    edges = np.linspace(np.quantile(z, 0.002), np.quantile(z, 0.998), OUTLINE_BINS + 1)
    centres, bins = (edges[1:] + edges[:-1]) / 2, np.clip(np.searchsorted(edges, z) - 1, 0, OUTLINE_BINS - 1)
    low, high, turn = np.full(OUTLINE_BINS, np.nan), np.full(OUTLINE_BINS, np.nan), 0.0
    rising = np.gradient(z) > 0
    for k in range(OUTLINE_BINS):
        here = bins == k
        if np.count_nonzero(here) >= 8:
            low[k], high[k] = np.quantile(v[here], [OUTLYING_SHARE, 1 - OUTLYING_SHARE])
            if np.any(here & rising) and np.any(here & ~rising):
                turn += float(np.mean(v[here & ~rising]) - np.mean(v[here & rising]))
    seen = ~np.isnan(low)
    if not np.any(seen):
        return centres, np.zeros(OUTLINE_BINS), np.zeros(OUTLINE_BINS)
    low, high = (np.interp(centres, centres[seen], c[seen]) for c in (low, high))
    if turn < 0:
        low = high = (low + high) / 2
    return centres, _make_rising(low), _make_rising(high)


def _make_rising(curve: Array) -> Array:
    """Average the smallest rising curve above a curve and the largest rising curve below it."""
    return (np.maximum.accumulate(curve) + np.minimum.accumulate(curve[::-1])[::-1]) / 2


def fit_envelope(z: Array, curve: Array, neurons: int) -> Blocks:
    """Fit the parameters `c, a0, a, b, d` (one row per name) of an envelope network to a curve (G,) over z."""
    from scipy.optimize import nnls

    span = float(z[-1] - z[0]) or 1.0
    knots = z[0] + span * (np.arange(neurons) + 0.5) / max(neurons, 1)
    b = np.full(neurons, 2.0 * max(neurons, 1) / span)
    d = -b * knots
    columns = np.column_stack([np.ones_like(z), -np.ones_like(z), z, np.tanh(z[:, None] * b + d)])
    (up, down, a0, *a), _ = nnls(columns, curve)
    least = LEAST_SHARE * float(np.ptp(curve)) / max(neurons, 1)
    return {"c": np.array([up - down]), "a0": np.array([a0]), "a": np.maximum(a, least), "b": b, "d": d}


def has_networks(structure: PILFR) -> bool:
    """Tell whether the element is a layer of generalized plays between networks."""
    element = structure.element
    operator = element.operator if isinstance(element, PrandtlIshlinskii) else None
    return isinstance(operator, GeneralizedPlay) and operator.networks
