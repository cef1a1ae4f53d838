"""Start values: from a linear approximation to a PI-LFR worth optimising.

`paper_start` is Krikelis et al. (2024), Eq. 22-24. `grid_start` keeps its random direction of z, in units that do not
matter, or takes the linear model's output or input for z, and spreads the thresholds over the range that z visits,
instead of drawing them from `U(0, R)`: idle or identical thresholds hardly separate again. `regrid` takes a fitted
element, smooths its density of weights, and places the thresholds anew so that each stands for an equal share of
`density^0.4` (the knots of a good piecewise-linear approximation of the loading curve). It continues the tail of the
density beyond the visited range, where data alone says nothing. `network_start` is for elements without memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..models import (
    PILFR,
    Element,
    PrandtlIshlinskii,
    StaticNetwork,
    direction_fixed,
    driven_through,
    fixed_whole,
    is_zero,
    neurons_over,
    or_one,
    read_through,
)
from .envelopes import reach

Blocks = dict[str, np.ndarray]
LINEAR = ("A", "B_u", "C_y", "D_yu", "y_0")
# deviation of the signals of neurons of slope one at the start: of 1, 0.3, 0.1 and 0.03 the one of the least training
# error over two records of the two-mass rig and two sizes; no test had a part in it
FLAT = 0.1


def states_of(blocks: Mapping[str, np.ndarray], u: np.ndarray) -> np.ndarray:
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
    states = [states_of(blocks, u) for u in inputs]
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
    """What the structure says of the blocks: z is the linear model's output where that is read through the element."""
    out = {"C_z": linear["C_y"], "D_zu": linear["D_yu"]} if read_through(structure) else {}
    held = {k: np.asarray(structure.fixed[k], dtype=float) for k in fixed_whole(structure) if k in blocks}
    return out | {k: np.broadcast_to(v, blocks[k].shape) for k, v in held.items()}


def _halved(linear: Mapping[str, np.ndarray], size: np.ndarray, at: np.ndarray, output: bool) -> Blocks:
    """Linear blocks of which one half passes the element: channel i carries output or input `at[i]`, over `size`."""
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


def density(r: np.ndarray, w: np.ndarray, grid: np.ndarray, width: float) -> np.ndarray:
    """Density of weights (N,) over thresholds (N,) on a grid (G,): Gaussian kernels, mirrored at zero."""
    kernels = sum(np.exp(-0.5 * ((grid[:, None] - sign * r) / width) ** 2) for sign in (1, -1))
    return np.asarray(kernels @ w) / (width * np.sqrt(2 * np.pi))


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
    d = density(r, w, grid, smooth * reach)
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


def regridded(structure: PILFR, values: Mapping[str, np.ndarray], z: np.ndarray, beyond: float = 1.3) -> dict[str, Any]:
    """The values with every channel's thresholds and weights placed anew; z (M, n_w) is the fitted model's signal."""
    reaches = [reach(structure, values, z_i, i) for i, z_i in enumerate(z.T)]
    rows = [
        regrid(r, w, most, beyond=beyond) if is_density(w) and most > 0 else (r, w)
        for r, w, most in zip(values["r"], values["w"], reaches, strict=True)
    ]
    return {**values, "r": np.array([r for r, _ in rows]), "w": np.array([w for _, w in rows])}
