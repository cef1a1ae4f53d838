"""Gauge freedoms of a PI-LFR: directions in its parameters that change no output.

The outputs of a PI-LFR do not change under

- any change of the basis of the states, `x = T x'` (n_x² directions);
- a scaling of a port's signal, `(C_z, D_zu, r)_i -> α (...)` with `(B_w, D_yw)_i -> (...)/α`, memory included. The
  generalized play has two here: the scale of z, which the envelopes take up, and that of the operators' output;
- a scaling of the weights, `w_i -> μ w_i` with `(B_w, D_yw)_i -> (...)/μ`;
- for a play with `r_ij = 0` (it passes z on), a shift of `w_ij` that the linear blocks take up;
- for a static network, the scalings of its signals, `slope_i -> slope_i/α` and `gain_i -> μ gain_i`;
- for generalized plays, a shift of all `r_i` against the two envelopes, and a shift of the output that `y_0`, the
  envelopes and the initial state compensate.

Each comes with an affine change of the initial states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from .elements import PrandtlIshlinskii, StaticNetwork
from .operators import GeneralizedPlay, Play
from .pilfr import PILFR

Array = np.ndarray
Generator = tuple[dict[str, Array], Callable[[Array], Array]]
# powers of the scales of z and of the output in the parameters of an envelope (Eq. 14)
ENVELOPE = {"c": (0, 1), "a0": (-1, 1), "a": (0, 1), "b": (-1, 0), "d": (0, 0)}


def generators(structure: PILFR, values: Mapping[str, Array]) -> Iterator[Generator]:
    """Generate the tangents of the gauge orbit at `values`: the change of each block, and of the state with memory."""
    nx = structure.nx
    element = structure.element
    for k in range(nx * nx):
        e = np.zeros((nx, nx))
        e.flat[k] = 1.0
        change = {name: -e @ values[name] for name in ("B_u", "B_w")}
        change |= {name: values[name] @ e for name in ("C_y", "C_z")} | {"A": values["A"] @ e - e @ values["A"]}
        yield change, partial(_change_of_basis, e)
    if isinstance(element, PrandtlIshlinskii):
        for channel in range(element.channels):
            yield from _scale_channel(element, values, channel, nx)
            if isinstance(element.operator, Play):
                yield from _shift_weight(element, values, channel)
            if isinstance(element.operator, GeneralizedPlay) and element.operator.networks:
                yield from _shift_offset(element, values, channel, nx)
    if isinstance(element, StaticNetwork):
        for channel in range(element.channels):
            here = (np.arange(element.channels) == channel) * 1.0
            into = {name: values[name] * here[:, None] for name in ("C_z", "D_zu")}
            yield {**into, "slope": -values["slope"] * here[:, None]}, np.zeros_like
            out = {name: -values[name] * here for name in ("B_w", "D_yw")}
            yield {**out, "gain": values["gain"] * here[:, None]}, np.zeros_like


def _change_of_basis(e: Array, state: Array) -> Array:
    return np.concatenate([-e @ state[: len(e)], np.zeros(len(state) - len(e))])


def _scale_channel(
    element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int, nx: int
) -> Iterator[Generator]:
    """Scale one channel, in powers of the scales of z, of the operators' output and of the weights."""
    here = np.arange(element.channels) == channel
    memory = np.concatenate([np.zeros(nx), np.repeat(here, element.n)])
    general = isinstance(element.operator, GeneralizedPlay)
    rounded = element.rounded and bool(np.any(values["eps"] > 0))
    scalings = [(1, 1, 0), (0, 0, 1)] if not general else [(0, 0, 1)]
    if general and element.operator.networks:
        scalings = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    for of_z, of_v, of_w in scalings:
        if of_v and rounded:
            continue
        powers = {"C_z": of_z, "D_zu": of_z, "r": of_v, "w": of_w}
        if general and not of_w:
            powers |= {f"gamma_{side}_{k}": p * of_z + q * of_v for side in "lr" for k, (p, q) in ENVELOPE.items()}
        change = {name: power * values[name] * here[:, None] for name, power in powers.items()}
        change |= {name: -(of_v + of_w) * values[name] * here for name in ("B_w", "D_yw")}
        yield change, partial(np.multiply, of_v * memory)


def _shift_weight(element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int) -> Iterator[Generator]:
    """Shift the weight of a play with r = 0, which passes z on, to the linear blocks."""
    b, d = values["B_w"][:, [channel]], values["D_yw"][:, [channel]]
    c, e = values["C_z"][[channel]], values["D_zu"][[channel]]
    if element.rounded and np.any(values["eps"] > 0):
        return
    for j in np.flatnonzero(values["r"][channel] == 0):
        weight = np.zeros(values["w"].shape)
        weight[channel, j] = 1.0
        yield {"w": weight, "A": -b @ c, "B_u": -b @ e, "C_y": -d @ c, "D_yu": -d @ e}, np.zeros_like


def _shift_offset(
    element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int, nx: int
) -> Iterator[Generator]:
    """Shift thresholds against the envelopes, and the output's offset against the blocks that follow it."""
    here = (np.arange(element.channels) == channel)[:, None] * 1.0
    yield {"r": here * np.ones(values["r"].shape), "gamma_l_c": here, "gamma_r_c": -here}, np.zeros_like
    to_state = np.eye(nx) - values["A"]
    if nx and not np.linalg.cond(to_state) < 1e10:
        return
    total = values["w"][channel].sum()
    state = np.linalg.solve(to_state, values["B_w"][:, channel] * total)
    z = (values["C_z"] @ state)[:, None]
    change = {"y_0": -values["C_y"] @ state - values["D_yw"][:, channel] * total}
    for side in "lr":
        change[f"gamma_{side}_c"] = here - values[f"gamma_{side}_a0"] * z
        change[f"gamma_{side}_d"] = -values[f"gamma_{side}_b"] * z
    shift = np.concatenate([state, np.repeat(here.ravel(), element.n)])
    yield change, lambda _: shift
