"""Modal coordinates: a state matrix of 2 × 2 blocks on the diagonal, for linear parts of high order.

A full state matrix has n_x² entries of which a change of basis x = T x' makes all but 2 n_x superfluous. Every
diagonalizable A is similar to one of blocks, a pair of poles in each (and one pole alone where n_x is odd): complex
ones, or any two real ones, since a block is free in all its four entries. The model class stays the same (but for
defective A), while sensitivities cost a tenth at 15 states. The model of Krikelis et al. (2024), Eq. 15, with

    fixed={"A": modal(15)}

is identified in these coordinates from the linear model on (Sec. 5.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base import InputError
from ..data import Recording
from .statespace import propagate

Array = np.ndarray
DEFECTIVE = 1e10  # condition number of the eigenvectors above which A counts as defective


def modal(nx: int) -> Array:
    """What is known of `A` in modal coordinates: nan (free) in 2 × 2 blocks on the diagonal, zero elsewhere.

    Parameters
    ----------
    nx : int
        Number of states.

    Returns
    -------
    array, shape (nx, nx)
        For `PILFR(nx, element, fixed={"A": modal(nx)})`.

    Raises
    ------
    InputError
        If nx is no whole number above zero.
    """
    if isinstance(nx, bool) or not isinstance(nx, int | np.integer) or nx < 1:
        raise InputError(f"Modal coordinates of {nx!r} states were asked for; give a whole number above zero.")
    block = np.arange(nx) // 2
    return np.where(block[:, None] == block, np.nan, 0.0)


def is_modal(fixed: Mapping[str, Any], nx: int) -> bool:
    """Whether what a structure fixes says that `A` is in modal coordinates."""
    given = np.asarray(fixed.get("A", 0.0), dtype=float)
    return nx > 0 and given.shape == (nx, nx) and np.array_equal(given, modal(nx), equal_nan=True)


def modal_basis(a: Array) -> Array:
    """Basis T (nx, nx) in which `T⁻¹ A T` has 2 × 2 blocks on the diagonal: complex poles first, each kind by its size.

    Raises
    ------
    InputError
        If A is defective.
    """
    values, vectors = np.linalg.eig(a)
    scale = np.max(np.abs(values), initial=1e-300)
    columns: list[Array] = []
    upper = np.flatnonzero(values.imag > 1e-12 * scale)
    for k in upper[np.argsort(np.angle(values[upper]))]:
        columns += [vectors[:, k].real, vectors[:, k].imag]
    real = np.flatnonzero(np.abs(values.imag) <= 1e-12 * scale)
    columns += [vectors[:, k].real for k in real[np.argsort(values[real].real)]]
    basis = np.column_stack(columns)
    if not np.linalg.cond(basis) < DEFECTIVE:
        raise InputError("The linear model has equal poles that modal coordinates cannot hold; leave A free.")
    return basis


def in_modal_coordinates(blocks: Mapping[str, Array], recordings: tuple[Recording, ...]) -> dict[str, Array]:
    """Linear blocks `A`, `B_u`, `C_y` in modal coordinates, the states of unit deviation over the recordings."""
    t = modal_basis(blocks["A"])
    back = np.linalg.inv(t)
    a, b = back @ blocks["A"] @ t, back @ blocks["B_u"]
    a = np.where(np.isnan(modal(len(a))), a, 0.0)
    states = [propagate(a.T, (r.u @ b.T)[None], np.zeros((1, len(a))))[0][0] for r in recordings]
    spread = np.sqrt(np.mean(np.concatenate(states) ** 2, axis=0))
    spread = np.where(spread > 0, spread, 1.0)
    return {**blocks, "A": a * spread / spread[:, None], "B_u": b / spread[:, None], "C_y": blocks["C_y"] @ t * spread}
