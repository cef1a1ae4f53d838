r"""Start values of generalized plays: envelopes from the loading curves that a recording shows.

Between its envelopes a generalized play keeps its value (Krikelis et al. 2024, Eq. 7), so the values `v` that are seen
at one `z` fill the interval from the lower to the upper one: the outline of the cloud `(z, v)` is a first estimate of
both. What the element should answer, `v`, is the output where the output is read through the element, and where the
input comes through it the linear model's input that the measured output stands for,

    V = U + G^H (G G^H + λ I)⁻¹ (Y - G U),

with the linear model's response G at each frequency; λ damps what G hardly passes. The networks of Eq. 14 are then
fitted to the outline by non-negative least squares, with the neurons spread over the range of z. Envelopes that begin
as straight lines (or, as in Sec. 5.3, at random) rarely bend to those of a saturating loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..data import Recording
from ..linear import resolvent
from ..models import PILFR, GeneralizedPlay, PrandtlIshlinskii

Array = np.ndarray
Blocks = dict[str, Array]
BINS = 40
INSIDE = 0.03  # share of the samples at one z that an envelope leaves outside
DAMPING = 0.05  # of the inverse of the linear model, in units of its largest gain
LEAST = 0.01  # share of the curve's height that each neuron has at least, so that none begins without a slope


def has_networks(structure: PILFR) -> bool:
    """Whether the element is a layer of generalized plays between networks."""
    element = structure.element
    operator = element.operator if isinstance(element, PrandtlIshlinskii) else None
    return isinstance(operator, GeneralizedPlay) and operator.networks


def reach(structure: PILFR, values: Mapping[str, Array], z: Array, channel: int) -> float:
    """The threshold at which a channel's operators would rest over z (M,): its size, or half of its envelopes'.

    A generalized play rests when its lower curve `γ_l - r` is below its upper one `γ_r + r` at every two values of z.
    """
    if not has_networks(structure):
        return float(np.max(np.abs(z)))
    assert isinstance(structure.element, PrandtlIshlinskii)
    operator, ends = structure.element.operator, np.array([np.max(z), np.min(z)])
    low, high = (operator.envelope(side, end, values, channel) for side, end in zip("lr", ends, strict=True))
    return max(float(low - high) / 2, 0.0)


def enveloped(
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
        v = np.concatenate([inputs_behind(linear, r, x)[r.skip :] for r, x in zip(recordings, states, strict=True)])
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


def inputs_behind(linear: Mapping[str, Array], recording: Recording, states: Array) -> Array:
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
    at, low, high = outline(z, v)
    n, operator = element.n, element.operator
    widest = float(np.max(high - low)) / 2
    r = 0.9 * widest * np.arange(n) / n
    inner = float(np.mean(r))
    rows = {"r": r, "w": np.full(n, 1.0 / n)}
    for side, curve in (("l", low + inner), ("r", high - inner)):
        rows |= {f"gamma_{side}_{k}": row for k, row in network(at, curve, operator.neurons).items()}
    return rows


def outline(z: Array, v: Array) -> tuple[Array, Array, Array]:
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


def network(z: Array, curve: Array, neurons: int) -> Blocks:
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
