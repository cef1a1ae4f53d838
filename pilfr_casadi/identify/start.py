r"""Start values of a PI-LFR's element, given a linear approximation.

`paper_start` is Krikelis et al. (2024), Eq. 22-24. `grid_start` spreads the thresholds over the range that z visits
instead of drawing them from `U(0, R)`, because idle or identical thresholds hardly separate again; z is a random
direction, or the linear model's output or input. `regrid` smooths the density of fitted weights and places the
thresholds anew, each for an equal share of `density^0.4` (knots of a good piecewise-linear approximation of the loading
curve); it continues the density's tail beyond the visited range, where the data say nothing. `network_start` is for
elements without memory.

`envelope_start` starts generalized plays. Between its envelopes such a play keeps its value (Krikelis et al. 2024, Eq.
7), so the values `v` seen at one `z` fill the interval from the lower to the upper envelope: the outline of the cloud
`(z, v)` estimates both. The answer `v` is the output where the output is read through the element. Where the input
passes the element, `v` is the input with which the linear model would have given the measured output,

    V = U + G^H (G G^H + λ I)⁻¹ (Y - G U),

with the linear model's response G at each frequency; λ damps frequencies that G hardly passes. The networks of Eq. 14
are then fitted to the outline by non-negative least squares, with the neurons spread over the range of z. Envelopes
that begin as straight lines (or, as in Sec. 5.3, at random) rarely bend to those of a saturating loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..data import Recording
from ..linear import resolvent
from ..models import (
    PILFR,
    Element,
    GeneralizedPlay,
    PrandtlIshlinskii,
    StaticNetwork,
    direction_fixed,
    driven_through,
    fixed_whole,
    is_zero,
    neurons_over,
    or_one,
    read_through,
    weight_density,
)

Blocks = dict[str, np.ndarray]
LINEAR = ("A", "B_u", "C_y", "D_yu", "y_0")
# deviation of the signals of neurons of slope one at the start: of 1, 0.3, 0.1 and 0.03 the one of the least training
# error over two records of the two-mass rig and two sizes; no test had a part in it
FLAT = 0.1


def simulate_states(blocks: Mapping[str, np.ndarray], u: np.ndarray) -> np.ndarray:
    """States (M, nx) of the linear part driven by u (M, n_u), from zero."""
    a, b = blocks["A"], u @ blocks["B_u"].T
    out, x = np.empty((len(u), len(a))), np.zeros(len(a))
    for k in range(len(u)):
        out[k] = x
        x = a @ x + b[k]
    return out


def unit_states(
    blocks: Mapping[str, np.ndarray], inputs: list[np.ndarray], free: bool = True
) -> tuple[Blocks, list[np.ndarray]]:
    """Scale each state to unit variance (Sec. 5.3), if free; returns the blocks, and the states of each recording."""
    states = [simulate_states(blocks, u) for u in inputs]
    if not free:
        return dict(blocks), states
    spread = np.sqrt(np.mean(np.concatenate(states) ** 2, axis=0))
    spread = np.where(spread > 0, spread, 1.0)
    scaled = dict(blocks)
    scaled["A"] = blocks["A"] * spread / spread[:, None]
    scaled["B_u"] = blocks["B_u"] / spread[:, None]
    scaled["C_y"] = blocks["C_y"] * spread
    return scaled, [x / spread for x in states]


def paper_start(
    structure: PILFR,
    linear: Mapping[str, np.ndarray],
    inputs: list[np.ndarray],
    states: list[np.ndarray],
    rng: np.random.Generator,
    spread: float = 0.1,
) -> Blocks:
    """Start of Eq. 22-24: `C_z, D_zu ~ U(-1, 1)`, `w ~ U(0, 1/N)`, `r ~ U(0, R)`, R = `spread`, `B_w = D_yw = 0`.

    Where the structure leaves no direction of z to draw, thresholds are in units of z's deviation: z then has the units
    of an input or output, in which all of them could lie beyond it. Where the output is read through the element alone
    (Wiener), z is the linear model's output: against any other the weights, which are not negative, fall to zero, where
    nothing else has a slope.
    """
    element = _layer(structure)
    shape = (element.channels, element.n)
    blocks = _directions(element, linear, rng)
    blocks["w"], blocks["r"] = rng.uniform(0, 1 / element.n, shape), rng.uniform(0, spread, shape)
    if direction_fixed(structure):
        blocks |= _between(structure, linear, blocks)
        blocks["r"] *= or_one(np.std(_signal(inputs, states, blocks), axis=0))[:, None]
    return blocks


def _directions(element: Element, linear: Mapping[str, np.ndarray], rng: np.random.Generator) -> Blocks:
    """The linear blocks with a random direction of z, Eq. 22 and 23."""
    blocks = {name: linear[name] for name in LINEAR}
    for name, of in (("C_z", 0), ("D_zu", 1)):
        blocks[name] = rng.uniform(-1, 1, (element.channels, linear["B_u"].shape[of]))
    return blocks


def grid_start(
    structure: PILFR,
    linear: Mapping[str, np.ndarray],
    inputs: list[np.ndarray],
    states: list[np.ndarray],
    rng: np.random.Generator,
    place: str = "random",
) -> Blocks:
    """A direction of z of unit deviation, thresholds on a grid over its range, equal weights.

    Places of the element, of which the last two stand for the commonest structures (backlash or friction in what drives
    a linear system, or in what it drives):

    - "random": a random direction in states and inputs, each in units of its deviation; `B_w = D_yw = 0`; where the
      structure leaves no direction to draw, random thresholds in place of the grid;
    - "output": z is the linear model's output, half of which is read through the element;
    - "input": z is the input, half of which reaches the linear model through the element.

    Where `structure` fixes blocks such that the input reaches the dynamics only through the element (Hammerstein), or
    the output is read only through it (Wiener), the linear blocks move to the other side of the element. Where it fixes
    others, "output" and "input" give the direction of z alone.
    """
    element = _layer(structure)
    blocks, z = _placed(structure, element, linear, inputs, states, rng, place)
    widest = np.max(np.abs(z), axis=0)
    grid = np.tile(np.arange(element.n) / element.n, (element.channels, 1))
    if place == "random" and direction_fixed(structure):
        grid[:, 1:] = np.sort(rng.uniform(size=(element.channels, element.n - 1)), axis=1)
    blocks["r"] = 0.9 * widest[:, None] * grid
    blocks["w"] = np.full((element.channels, element.n), 1.0 / element.n)
    return blocks


def network_start(
    structure: PILFR,
    linear: Mapping[str, np.ndarray],
    inputs: list[np.ndarray],
    states: list[np.ndarray],
    rng: np.random.Generator,
) -> Blocks:
    """Random directions of z of unit deviation, neurons that bend somewhere in its range, `B_w = D_yw = 0`.

    As in Schoukens (2021), the network does nothing at first: the model begins as the linear one. Where slopes are held
    at one, z has the deviation `FLAT`: neurons that are nearly linear at first end in better minima.
    """
    element = structure.element
    if not isinstance(element, StaticNetwork):
        raise TypeError("these start values are made for a static network")
    blocks, z = _placed(structure, element, linear, inputs, states, rng, "random")
    if "slope" in structure.fixed and not {"C_z", "D_zu"} & set(structure.fixed):
        blocks, z = blocks | {k: FLAT * blocks[k] for k in ("C_z", "D_zu")}, FLAT * z
    return blocks | neurons_over(structure, element, z, rng)


def _placed(
    structure: PILFR,
    element: Element,
    linear: Mapping[str, np.ndarray],
    inputs: list[np.ndarray],
    states: list[np.ndarray],
    rng: np.random.Generator,
    place: str,
) -> tuple[Blocks, np.ndarray]:
    """The linear blocks with the element at its place (see `grid_start`), and the signal z (M, channels)."""
    blocks = _directions(element, linear, rng)
    fixed, n_u = fixed_whole(structure), linear["B_u"].shape[1]
    blocks["D_zu"] = blocks["D_zu"] / or_one(np.std(np.concatenate(inputs), axis=0))
    at_output, at_input = (np.arange(element.channels) % n for n in (len(linear["C_y"]), n_u))
    if place == "output":
        blocks["C_z"], blocks["D_zu"] = linear["C_y"][at_output], linear["D_yu"][at_output]
    elif place == "input" and not is_zero(structure, "D_zu"):
        blocks["C_z"], blocks["D_zu"] = np.zeros_like(blocks["C_z"]), np.eye(n_u)[at_input]
    if driven_through(structure):
        blocks["B_w"], blocks["D_yw"] = linear["B_u"], linear["D_yu"]
    blocks |= _between(structure, linear, blocks)
    z = _signal(inputs, states, blocks)
    size = or_one(np.std(z, axis=0))
    if all(is_zero(structure, k) for k in ("C_z", "D_zu", "D_yw") if k in fixed):
        blocks["C_z"], blocks["D_zu"], z = blocks["C_z"] / size[:, None], blocks["D_zu"] / size[:, None], z / size
    if place != "random" and not {*blocks, "w", "r"} & set(fixed) and not {"B_w", "D_yw"} & set(structure.fixed):
        blocks |= _halved(linear, size, at_output if place == "output" else at_input, place == "output")
    return blocks, z


def _signal(inputs: list[np.ndarray], states: list[np.ndarray], blocks: Blocks) -> np.ndarray:
    """The signal z (M, channels) of all recordings."""
    return np.concatenate(states) @ blocks["C_z"].T + np.concatenate(inputs) @ blocks["D_zu"].T


def _between(structure: PILFR, linear: Mapping[str, np.ndarray], blocks: Blocks) -> Blocks:
    """Blocks that the structure dictates: those fixed, and for a Wiener model z = the linear model's output."""
    out = {"C_z": linear["C_y"], "D_zu": linear["D_yu"]} if read_through(structure) else {}
    held = {k: np.asarray(structure.fixed[k], dtype=float) for k in fixed_whole(structure) if k in blocks}
    return out | {k: np.broadcast_to(v, blocks[k].shape) for k, v in held.items()}


def _halved(linear: Mapping[str, np.ndarray], size: np.ndarray, at: np.ndarray, output: bool) -> Blocks:
    """Split the path of output or input `at[i]` in two: half direct, half through channel i of the element."""
    b, c, d = linear["B_u"], linear["C_y"], linear["D_yu"]
    through = np.zeros((len(at), len(c) if output else b.shape[1]))
    through[np.arange(len(at)), at] = size
    carried = np.count_nonzero(through, axis=0)
    through *= 0.5 / np.maximum(carried, 1)
    left = np.where(carried > 0, 0.5, 1.0)
    if output:
        return {"D_yw": through.T, "C_y": c * left[:, None], "D_yu": d * left[:, None]}
    return {"B_w": b @ through.T, "D_yw": d @ through.T, "B_u": b * left, "D_yu": d * left}


def _layer(structure: PILFR) -> PrandtlIshlinskii:
    element = structure.element
    if not isinstance(element, PrandtlIshlinskii):
        raise TypeError("start values are made for a Prandtl-Ishlinskii element")
    return element


def is_density(w: np.ndarray) -> bool:
    """Whether weights (N,) are a density: whether any of them is above zero."""
    return bool(np.sum(w) > 0)


def regrid(
    r: np.ndarray,
    w: np.ndarray,
    reach: float,
    *,
    beyond: float = 1.3,
    smooth: float = 1 / 12,
    count: int | None = None,
    spacing: float = 0.4,
) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds and weights of one channel placed anew along the smoothed density.

    Parameters
    ----------
    r, w : array, shape (N,)
        Fitted thresholds and weights.
    reach : float
        Largest |z| visited.
    beyond : float
        How far the thresholds may reach, in units of `reach`; the tail is extrapolated log-linearly, never rising.
    smooth : float
        Kernel width in units of `reach`.
    count : int, optional
        How many there are to be, N by default.
    spacing : float
        There are as many thresholds to a length as this power of the density: 0 for an even grid.

    Returns
    -------
    r, w : array, shape (N,) or (count,)
        New thresholds (ascending) and the weights that the density gives them.
    """
    grid = np.linspace(0.0, beyond * reach, 600)
    d = weight_density(r, w, grid, smooth * reach)
    if d.max() <= 1e-200 * np.sum(w):  # all of them rest far beyond what is visited: evenly
        d = np.full_like(grid, np.sum(w) / grid[-1])
    tail = (grid >= 0.4 * reach) & (grid <= 0.85 * reach)
    log_d = np.log(d + 1e-6 * d.max())
    slope = min(float(np.polyfit(grid[tail], log_d[tail], 1)[0]), 0.0)
    out = grid > 0.85 * reach
    d[out] = np.exp(np.mean(log_d[tail]) + slope * (grid[out] - np.mean(grid[tail])))
    share = _integral(d**spacing, grid)
    edges = np.interp(np.linspace(0, 1, (count or len(r)) + 1), share / share[-1], grid)
    mass = np.diff(np.interp(edges, grid, _integral(d, grid)))
    moment = np.diff(np.interp(edges, grid, _integral(d * grid, grid)))
    return moment / np.maximum(mass, 1e-300), mass


def _integral(f: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(x))])


def regrid_channels(
    structure: PILFR, values: Mapping[str, np.ndarray], z: np.ndarray, beyond: float = 1.3
) -> dict[str, Any]:
    """The values with every channel's thresholds and weights placed anew; z (M, n_w) is the fitted model's signal."""
    reaches = [threshold_range(structure, values, z_i, i) for i, z_i in enumerate(z.T)]
    rows = [
        regrid(r, w, most, beyond=beyond) if is_density(w) and most > 0 else (r, w)
        for r, w, most in zip(values["r"], values["w"], reaches, strict=True)
    ]
    return {**values, "r": np.array([r for r, _ in rows]), "w": np.array([w for _, w in rows])}


Array = np.ndarray
BINS = 40
INSIDE = 0.03  # share of the samples at one z that an envelope leaves outside
DAMPING = 0.05  # of the inverse of the linear model, in units of its largest gain
LEAST = 0.01  # share of the curve's height that each neuron has at least, so that none begins without a slope


def has_networks(structure: PILFR) -> bool:
    """Whether the element is a layer of generalized plays between networks."""
    element = structure.element
    operator = element.operator if isinstance(element, PrandtlIshlinskii) else None
    return isinstance(operator, GeneralizedPlay) and operator.networks


def threshold_range(structure: PILFR, values: Mapping[str, Array], z: Array, channel: int) -> float:
    """The threshold at which a channel's operators would rest over z (M,): its size, or half of its envelopes'.

    A generalized play rests when its lower curve `γ_l - r` is below its upper one `γ_r + r` at every two values of z.
    """
    if not has_networks(structure):
        return float(np.max(np.abs(z)))
    assert isinstance(structure.element, PrandtlIshlinskii)
    operator, ends = structure.element.operator, np.array([np.max(z), np.min(z)])
    low, high = (operator.envelope(side, end, values, channel) for side, end in zip("lr", ends, strict=True))
    return max(float(low - high) / 2, 0.0)


def envelope_start(
    structure: PILFR,
    linear: Mapping[str, Array],
    values: Mapping[str, Array],
    recordings: Sequence[Recording],
    states: Sequence[Array],
    place: str,
) -> Blocks:
    """Start values with envelopes, thresholds and weights from the loops of z and what the element should answer.

    Parameters
    ----------
    structure : PILFR
        With networks as envelopes.
    linear : mapping
        Blocks of the linear model.
    values : mapping
        Start values that say what z is, from `grid_start`.
    recordings : sequence of Recording
        What is to be fitted.
    states : sequence of array, (M, nx)
        The linear model's states over each recording.
    place : {"input", "output", "random"}
        Where the element acts; at "random" the output is read through it too.

    Returns
    -------
    dict
        `values` as they are where the structure fixes other blocks than those of a Hammerstein or Wiener model.
    """
    element = structure.element
    assert isinstance(element, PrandtlIshlinskii)
    fixed = set(structure.fixed) - {"y_0", "A"}
    before = {"B_u", "D_zu"} <= fixed or (not fixed and place == "input")
    if fixed and not before and not {"C_y", "D_yw"} <= fixed:
        return dict(values)
    z = np.concatenate(
        [(x @ values["C_z"].T + r.u @ values["D_zu"].T)[r.skip :] for r, x in zip(recordings, states, strict=True)]
    )
    found = dict(values)
    channels = np.arange(element.channels)
    n_u, n_y = linear["B_u"].shape[1], len(linear["C_y"])
    at = channels % (n_u if before else n_y)
    if before:
        v = np.concatenate([deconvolve_inputs(linear, r, x)[r.skip :] for r, x in zip(recordings, states, strict=True)])
    else:
        v = np.concatenate([r.y[r.skip :] for r in recordings])
    centre, size = np.mean(v, axis=0), np.std(v, axis=0)
    size = np.where(size > 0, size, 1.0)
    if fixed:
        centre, size = np.zeros_like(centre), np.ones_like(size)
    else:
        through = np.zeros((len(size), element.channels))
        through[at, channels] = (size / np.maximum(np.bincount(at, minlength=len(size)), 1))[at]
        left = np.bincount(at, minlength=len(size)) == 0
        found |= _through(linear, through, left, before)
        if not before:
            found["y_0"] = np.where(left, linear["y_0"], centre)
        else:
            found["y_0"] = linear["y_0"] + _gain(linear) @ np.where(left, 0.0, centre)
    for i in channels:
        target = (v[:, at[i]] - centre[at[i]]) / size[at[i]]
        if not fixed and z[:, i] @ target < 0:  # envelopes rise, so z has to rise with the answer
            z[:, i] *= -1
            found |= {name: np.where((channels == i)[:, None], -found[name], found[name]) for name in ("C_z", "D_zu")}
        own = channel_start(element, z[:, i], target)
        for name, row in own.items():
            found[name] = np.array(found.get(name, np.zeros((element.channels, row.size))), dtype=float)
            found[name][i] = row
    return found


def _through(linear: Mapping[str, Array], through: Array, left: Array, before: bool) -> Blocks:
    """Linear blocks of which channel i carries whole inputs or outputs, `through` (n, channels); others `left`."""
    b, c, d = linear["B_u"], linear["C_y"], linear["D_yu"]
    if before:
        return {"B_w": b @ through, "D_yw": d @ through, "B_u": b * left, "D_yu": d * left}
    return {"D_yw": through, "C_y": c * left[:, None], "D_yu": d * left[:, None]}


def _gain(linear: Mapping[str, Array]) -> Array:
    """Static gain (n_y, n_u), 0 for an integrator."""
    a = linear["A"]
    if len(a) and np.max(np.abs(np.linalg.eigvals(a))) > 0.9999:
        return np.zeros_like(linear["D_yu"])
    return linear["C_y"] @ np.linalg.solve(np.eye(len(a)) - a, linear["B_u"]) + linear["D_yu"]


def deconvolve_inputs(linear: Mapping[str, Array], recording: Recording, states: Array) -> Array:
    """Inputs (M, n_u) with which the linear model would have given the measured outputs, damped where it hardly can."""
    u, y = recording.u, recording.y
    error = np.fft.rfft(y - states @ linear["C_y"].T - u @ linear["D_yu"].T - linear["y_0"], axis=0)
    z = np.exp(2j * np.pi * np.arange(len(error)) / len(u))
    g = resolvent(linear["A"], linear["C_y"], z) @ linear["B_u"] + linear["D_yu"]
    g = np.where(np.isfinite(g), g, 0.0)
    conjugate = g.conj().transpose(0, 2, 1)
    damped = g @ conjugate + (DAMPING * np.max(np.abs(g))) ** 2 * np.eye(g.shape[1])
    more = conjugate @ np.linalg.solve(damped, error[:, :, None])
    return u + np.fft.irfft(more[:, :, 0], len(u), axis=0)


def channel_start(element: PrandtlIshlinskii, z: Array, v: Array) -> Blocks:
    """Envelopes, thresholds and weights (a row each) of one channel from its signal z (M,) and its answer v (M,)."""
    at, low, high = loop_outline(z, v)
    n, operator = element.n, element.operator
    widest = float(np.max(high - low)) / 2
    r = 0.9 * widest * np.arange(n) / n
    inner = float(np.mean(r))
    rows = {"r": r, "w": np.full(n, 1.0 / n)}
    for side, curve in (("l", low + inner), ("r", high - inner)):
        rows |= {f"gamma_{side}_{k}": row for k, row in fit_envelope(at, curve, operator.neurons).items()}
    return rows


def loop_outline(z: Array, v: Array) -> tuple[Array, Array, Array]:
    """Where v (M,) lies over z (M,): bins' centres, and a lower and an upper curve (bins,), neither falling.

    Loops that run the wrong way round have no width.
    """
    edges = np.linspace(np.quantile(z, 0.002), np.quantile(z, 0.998), BINS + 1)
    centres, bins = (edges[1:] + edges[:-1]) / 2, np.clip(np.searchsorted(edges, z) - 1, 0, BINS - 1)
    low, high, turn = np.full(BINS, np.nan), np.full(BINS, np.nan), 0.0
    rising = np.gradient(z) > 0
    for k in range(BINS):
        here = bins == k
        if np.count_nonzero(here) >= 8:
            low[k], high[k] = np.quantile(v[here], [INSIDE, 1 - INSIDE])
            if np.any(here & rising) and np.any(here & ~rising):
                turn += float(np.mean(v[here & ~rising]) - np.mean(v[here & rising]))
    seen = ~np.isnan(low)
    if not np.any(seen):
        return centres, np.zeros(BINS), np.zeros(BINS)
    low, high = (np.interp(centres, centres[seen], c[seen]) for c in (low, high))
    if turn < 0:
        low = high = (low + high) / 2
    return centres, _rising(low), _rising(high)


def _rising(curve: Array) -> Array:
    """A curve that does not fall, between the smallest above and the largest below."""
    return (np.maximum.accumulate(curve) + np.minimum.accumulate(curve[::-1])[::-1]) / 2


def fit_envelope(z: Array, curve: Array, neurons: int) -> Blocks:
    """Parameters `c, a0, a, b, d` (a row each) of the envelope network nearest to a curve (G,) over z (G,)."""
    from scipy.optimize import nnls

    span = float(z[-1] - z[0]) or 1.0
    knots = z[0] + span * (np.arange(neurons) + 0.5) / max(neurons, 1)
    b = np.full(neurons, 2.0 * max(neurons, 1) / span)
    d = -b * knots
    columns = np.column_stack([np.ones_like(z), -np.ones_like(z), z, np.tanh(z[:, None] * b + d)])
    (up, down, a0, *a), _ = nnls(columns, curve)
    least = LEAST * float(np.ptp(curve)) / max(neurons, 1)
    return {"c": np.array([up - down]), "a0": np.array([a0]), "a": np.maximum(a, least), "b": b, "d": d}
