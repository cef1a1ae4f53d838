"""Where a structure says that its element is: what its fixed blocks leave open of the signal z.

In `x⁺ = A x + B_u u + B_w w`, `y = C_y x + D_yu u + D_yw w`, `z = C_z x + D_zu u` a Hammerstein model has `B_u = 0` and
`D_zu = I`, a Wiener model `C_y = 0` and `D_yw = I`. There nothing is to be drawn of where the element begins.
"""

from __future__ import annotations

import numpy as np

from .pilfr import PILFR


def direction_fixed(structure: PILFR) -> bool:
    """Whether the structure leaves no direction of z to draw: it is fixed, or that of the output (Wiener)."""
    return {"C_z", "D_zu"} <= set(fixed_whole(structure)) or read_through(structure)


def read_through(structure: PILFR) -> bool:
    """Whether the output is read through the element alone (Wiener)."""
    return is_zero(structure, "C_y") and is_identity(structure, "D_yw")


def driven_through(structure: PILFR) -> bool:
    """Whether the input reaches the dynamics through the element alone (Hammerstein)."""
    return is_zero(structure, "B_u") and is_identity(structure, "D_zu")


def places(structure: PILFR) -> tuple[str, ...]:
    """Where the element is in the first starts; one place where the structure says it. In all others it is anywhere."""
    return ("output",) if direction_fixed(structure) else ("output", "input")


def is_zero(structure: PILFR, name: str) -> bool:
    """Whether a block is held at zero."""
    return name in structure.fixed and not np.any(structure.fixed[name])


def is_identity(structure: PILFR, name: str) -> bool:
    """Whether a block between channels is held at the identity."""
    given, eye = structure.fixed.get(name, np.nan), np.eye(structure.n_w)
    return np.shape(given) in ((), eye.shape) and np.array_equal(np.broadcast_to(given, eye.shape), eye)


def fixed_whole(structure: PILFR) -> list[str]:
    """Blocks that are fixed to the last entry."""
    return [k for k, v in structure.fixed.items() if not np.any(np.isnan(np.asarray(v, dtype=float)))]
