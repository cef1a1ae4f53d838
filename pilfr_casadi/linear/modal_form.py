"""Modal coordinates: a state matrix of 2 × 2 blocks on the diagonal, for linear parts of high order.

A full state matrix has n_x² entries, but a change of basis x = T x' leaves only 2 n_x of them free. Every
diagonalizable A is similar to a matrix of blocks with a pair of poles each (and a single pole if n_x is odd): a complex
pair, or any two real poles, since all four entries of a block are free. The model class stays the same (except for
defective A), while sensitivities cost a tenth at 15 states. With `fixed={"A": modal(15)}` the model of Krikelis et al.
(2024), Eq. 15, is identified in these coordinates from the linear model on (Sec. 5.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base import InputError, whole
from ..data import Recording
from .statespace import propagate

Array = np.ndarray
DEFECTIVE = 1e10  # condition number of the eigenvectors above which A counts as defective to rounding


def modal(nx: int) -> Array:
    """Return the pattern of `A` in modal coordinates: nan (free) in 2 × 2 blocks on the diagonal, zero elsewhere.

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
        If nx is not a whole number above zero.
    """
    block = np.arange(whole(nx, "the number of states nx", 1)) // 2
    return np.where(block[:, None] == block, np.nan, 0.0)


def is_modal(fixed: Mapping[str, Any], nx: int) -> bool:
    """Tell whether the fixed entries of a structure put `A` in modal coordinates."""
    given = np.asarray(fixed.get("A", 0.0), dtype=float)
    return nx > 0 and given.shape == (nx, nx) and np.array_equal(given, modal(nx), equal_nan=True)


def modal_basis(a: Array) -> Array:
    """Return a basis T (nx, nx) in which `T⁻¹ A T` has 2 × 2 blocks on the diagonal: complex poles first, sorted.

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
    """Transform `A`, `B_u`, `C_y` to modal coordinates, with states of unit rms over the recordings."""
    t = modal_basis(blocks["A"])
    back = np.linalg.inv(t)
    a, b = back @ blocks["A"] @ t, back @ blocks["B_u"]
    a = np.where(np.isnan(modal(len(a))), a, 0.0)
    states = [propagate(a.T, (r.u @ b.T)[None], np.zeros((1, len(a))))[0][0] for r in recordings]
    spread = np.sqrt(np.mean(np.concatenate(states) ** 2, axis=0))
    spread = np.where(spread > 0, spread, 1.0)
    return {**blocks, "A": a * spread / spread[:, None], "B_u": b / spread[:, None], "C_y": blocks["C_y"] @ t * spread}
