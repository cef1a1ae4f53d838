"""The normal form of a PI-LFR: one point on each gauge orbit, so that equal models have equal numbers.

Channels first: z has unit standard deviation (or reach), the weights of a channel sum to one, its thresholds ascend,
and the largest entry of the impulse response from u to z is positive. A generalized play's output has a scale of its
own, such that the two envelopes rise by two on average over -1 <= z <= 1; its smallest threshold is zero. Where its
envelopes cross, `γ_l(z) - r > γ_r(z) + r`, the lower one counts, and the mirror image is another element: such a
channel keeps its sign. Channels ascend by their mean threshold.

Then the states, in the input-normal basis ordered by Hankel singular values (Moore 1981): driven by white u and w of
given standard deviations (w: one), they are uncorrelated with unit variance, and their energies in y and z are
uncorrelated too and descend. No entry of A exceeds one in this basis. Gramians are accumulated as square roots by
doubling, with QR in place of products, which is safe for high orders. For a spectral radius above 0.999 they are
those of A scaled down to it. The largest entry of each column of [C_y; C_z] is positive.

The form is unique where Hankel singular values, thresholds and mean thresholds differ from each other. Plays that
rest on `r = 0` are left as they are, although the linear blocks could take up their weight.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base import InputError
from .elements import PrandtlIshlinskii
from .gauge_orbit import ENVELOPE
from .operators import GeneralizedPlay
from .pilfr import PILFR

Array = np.ndarray
Values = dict[str, Array]
FASTEST = 0.999
GRID = np.linspace(-2.0, 2.0, 801)


def normalise(
    structure: PILFR,
    values: Mapping[str, Any],
    z: Array | None = None,
    *,
    u: Array | None = None,
    y: Array | None = None,
    by: str = "std",
) -> tuple[Values, Array]:
    """Values in the normal form, and the change of the state that goes with it.

    What the structure fixes at something else than zero stays: a freedom that would move it is not used.
    Bounds and priors are not looked at.

    Parameters
    ----------
    structure : PILFR
        Structure that the values belong to.
    values : mapping
        All parameters by name, such as `Fit.parameters`.
    z : array, shape (M, n_w)
        Signal of the model as given; needed where the structure has a Prandtl-Ishlinskii element.
    u, y : array, shape (M, n_u) and (M, n_y), optional
        Signals whose standard deviations are the units in which u and y count for the states; 1 where left out.
    by : {"std", "reach"}
        Make the standard deviation or the largest size of z one.

    Returns
    -------
    values : dict
        The normal form.
    change : array, shape (n_x + n_s, n_x + n_s)
        `new = change @ old` for a state with the element's memory, such as an initial state.

    Raises
    ------
    InputError
        If z is missing or does not move, kinks are rounded (`eps > 0`), or neither u nor w reaches some state.
    """
    if by not in ("std", "reach"):
        raise InputError(f"z was to be normalised by {by!r}; use 'std' or 'reach'.")
    out = {name: np.array(value, dtype=float) for name, value in values.items()}
    element, nx = structure.element, structure.nx
    change = np.eye(nx + (0 if element is None else element.memory))
    u_std, y_std = _spread(u, out["B_u"].shape[1]), _spread(y, out["C_y"].shape[0])
    if isinstance(element, PrandtlIshlinskii):
        size = _sizes(element, out, z, by)
        blocks = []
        for i in range(element.channels):
            reach = float(np.max(np.abs(np.asarray(z)[:, i])))
            scales = _scales(structure, element, out, i, float(size[i]), reach, u_std)
            _rescale(element, out, i, *scales)
            _lower_thresholds(structure, element, out, i)
            blocks.append(scales[0] * scales[2] * np.eye(element.n)[_sort(structure, element, out, i)])
        memory = np.zeros((element.channels, element.n, element.memory))
        for i, block in enumerate(blocks):
            memory[i, :, i * element.n : (i + 1) * element.n] = block
        change[nx:, nx:] = memory[_sort_channels(structure, element, out)].reshape(change[nx:, nx:].shape)
    if nx and not _held(structure, "A", "B_u", "B_w", "C_y", "C_z"):
        basis = _input_normal(out, u_std, y_std)
        inverse = np.linalg.inv(basis)
        for name in ("B_u", "B_w"):
            out[name] = inverse @ out[name]
        for name in ("C_y", "C_z"):
            out[name] = out[name] @ basis
        out["A"] = inverse @ out["A"] @ basis
        change[:nx, :nx] = inverse
    return out, change


def _held(structure: PILFR, *names: str) -> bool:
    """Whether one of the blocks is fixed at something else than zero."""
    return any(np.any(structure.fixed[name]) for name in names if name in structure.fixed)


def _spread(signal: Array | None, n: int) -> Array:
    if signal is None:
        return np.ones(n)
    std = np.std(np.asarray(signal, dtype=float).reshape(-1, n), axis=0)
    return np.where(std > 0, std, 1.0)


def _sizes(element: PrandtlIshlinskii, out: Values, z: Array | None, by: str) -> Array:
    if z is None or np.shape(z)[1:] != (element.channels,):
        given = "nothing" if z is None else f"an array of shape {np.shape(z)}"
        raise InputError(f"For the signal z {given} was given; expected an array of shape (M, {element.channels}).")
    if element.rounded and np.any(out["eps"] > 0):
        raise InputError("The kinks are rounded (eps > 0), which leaves no free scale; set eps to zero to normalise.")
    size = np.std(z, axis=0) if by == "std" else np.max(np.abs(z), axis=0)
    if not np.all(size > 0):
        raise InputError(f"The signal z of channel {int(np.argmin(size))} does not move; give one that does.")
    return np.asarray(size)


def _scales(
    structure: PILFR, element: PrandtlIshlinskii, out: Values, i: int, size: float, reach: float, u_std: Array
) -> tuple[float, float, float, float]:
    """Sign, and what z, the operators' output, and the weights of channel i are to be multiplied with."""
    operator = element.operator
    general = isinstance(operator, GeneralizedPlay)
    free = not general or operator.networks
    envelopes = tuple(name for name in out if name.startswith("gamma_")) if general else ()
    w_held, after_held = _held(structure, "w"), _held(structure, "B_w", "D_yw")
    v_free = free and not _held(structure, "r", *envelopes) and not (w_held and after_held)
    z_free = free and not _held(structure, "C_z", "D_zu", *envelopes) and (general or v_free)
    of_z = 1.0 / size if z_free else 1.0
    of_v = of_z
    if general:
        ends = [operator.envelope(side, end / of_z, out, i) for side in ("l", "r") for end in (1.0, -1.0)]
        rise = ends[0] - ends[1] + ends[2] - ends[3]
        of_v = 4.0 / rise if v_free and rise > 0 else 1.0
    total = out["w"][i].sum()
    of_w = 1.0 / of_v if after_held else 1.0 / total if total > 0 else 1.0
    mirrors = not (general and free and _crosses(operator, out, i, reach))
    down = z_free and v_free and not after_held and mirrors and _points_down(out, i, u_std)
    return (-1.0 if down else 1.0), of_z, of_v, (1.0 if w_held else of_w)


def _crosses(operator: GeneralizedPlay, out: Values, i: int, reach: float) -> bool:
    """Whether the envelopes of channel i, each its smallest threshold away, cross within twice the reach of z."""
    z, least = reach * GRID, out["r"][i].min()
    return bool(np.any(operator.envelope("l", z, out, i) - least > operator.envelope("r", z, out, i) + least))


def _points_down(out: Values, i: int, u_std: Array) -> bool:
    """Whether the largest entry of the impulse response from u to z of channel i is negative."""
    row, response = out["C_z"][i], [out["D_zu"][i] * u_std]
    a = _slowed(out["A"])
    for _ in range(2 * len(a)):
        response.append(row @ out["B_u"] * u_std)
        row = row @ a
    every = np.concatenate(response)
    return bool(every[np.argmax(np.abs(every))] < 0)


def _rescale(
    element: PrandtlIshlinskii, out: Values, i: int, sign: float, of_z: float, of_v: float, of_w: float
) -> None:
    """Move channel i along its gauge freedoms, in place."""
    for name in ("C_z", "D_zu"):
        out[name][i] *= sign * of_z
    for name in ("B_w", "D_yw"):
        out[name][:, i] /= sign * of_v * of_w
    out["r"][i] *= of_v
    out["w"][i] *= of_w
    if isinstance(element.operator, GeneralizedPlay) and element.operator.networks:
        old = {key: out[key][i].copy() for key in out if key.startswith("gamma_")}
        for side, other in (("l", "r"), ("r", "l")):
            for name, (p_z, p_v) in ENVELOPE.items():
                # the mirror image of an envelope, -γ(-z), has -c and -d for c and d, and is the other one
                mirrored = sign if name in ("c", "d") else 1.0
                source = old[f"gamma_{side if sign > 0 else other}_{name}"]
                out[f"gamma_{side}_{name}"][i] = mirrored * source * of_z**p_z * of_v**p_v


def _lower_thresholds(structure: PILFR, element: PrandtlIshlinskii, out: Values, i: int) -> None:
    """Give the smallest threshold of a generalized play to its envelopes, in place."""
    names = ("r", "gamma_l_c", "gamma_r_c")
    if not isinstance(element.operator, GeneralizedPlay) or not element.operator.networks:
        return
    if not set(names) & set(structure.fixed):
        least = out["r"][i].min()
        for name, sign in zip(names, (-1.0, -1.0, 1.0), strict=True):
            out[name][i] += sign * least


def _sort(structure: PILFR, element: PrandtlIshlinskii, out: Values, i: int) -> Array:
    """Sort operators of channel i by threshold, and neurons by bias, in place; returns the operators' order."""
    for side in ("l", "r"):
        names = [f"gamma_{side}_{name}" for name in ("a", "b", "d")]
        if all(name in out for name in names) and not _held(structure, *names):
            neurons = np.lexsort([out[name][i] for name in names])
            for name in names:
                out[name][i] = out[name][i][neurons]
    order = np.arange(element.n) if _held(structure, "r", "w") else np.lexsort((out["w"][i], out["r"][i]))
    for name in ("r", "w"):
        out[name][i] = out[name][i][order]
    return order


def _sort_channels(structure: PILFR, element: PrandtlIshlinskii, out: Values) -> Array:
    """Sort channels by their mean thresholds, in place; returns the order."""
    envelopes = [name for name in out if name.startswith("gamma_") and len(out[name]) == element.channels]
    rows, columns = ["C_z", "D_zu", "r", "w", *envelopes], ["B_w", "D_yw"]
    if _held(structure, *rows, *columns):
        return np.arange(element.channels)
    order = np.argsort(np.sum(out["w"] * out["r"], axis=1), kind="stable")
    for name in rows:
        out[name] = out[name][order]
    for name in columns:
        out[name] = out[name][:, order]
    return order


def _slowed(a: Array) -> Array:
    radius = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
    return a if radius <= FASTEST else a * (FASTEST / radius)


def _input_normal(out: Values, u_std: Array, y_std: Array) -> Array:
    """Basis T (columns) of the input-normal form, `x = T x_new`."""
    a = _slowed(out["A"])
    seen = np.concatenate([out["C_y"] / y_std[:, None], out["C_z"]])
    reach = _gramian_root(a, np.column_stack([out["B_u"] * u_std, out["B_w"]]))
    if not np.linalg.cond(reach) < 1e12:
        raise InputError("Neither u nor w reaches some state, so there is no normal form; choose a smaller nx.")
    _, _, turned = np.linalg.svd(_gramian_root(a.T, seen.T).T @ reach)
    basis = reach @ turned.T
    shown = seen @ basis
    largest = shown[np.argmax(np.abs(shown), axis=0), np.arange(len(a))]
    return np.asarray(basis * np.where(largest < 0, -1.0, 1.0))


def _gramian_root(a: Array, b: Array) -> Array:
    """Square root L (n, n) of the Gramian `L L' = Σ_k A^k B B' A'^k`, the number of terms doubled in each round."""
    n = len(a)
    root, power = b, a
    for _ in range(64):
        stacked = np.concatenate([root.T, (power @ root).T, np.zeros((n, n))])
        root = np.asarray(np.linalg.qr(stacked, mode="r")).T
        if np.linalg.norm(power) < 1e-16:
            break
        power = power @ power
    return np.asarray(root)
