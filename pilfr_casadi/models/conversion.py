"""Rewrite a PI-LFR with plays as one with stops, or the other way round, with the same outputs.

`P_r[z] + S_r[z] = z`, Krikelis et al. (2024), Eq. 8, so with the sums of weights `s_i = Σ_j w_ij` of the channels

    w_play = diag(s) z - w_stop,   z = C_z x + D_zu u,

and the part `diag(s) z` joins the linear blocks (Sec. 4.1 states the equivalence):

    A  += B_w diag(s) C_z,     B_u  += B_w diag(s) D_zu,    B_w  -> -B_w,
    C_y += D_yw diag(s) C_z,   D_yu += D_yw diag(s) D_zu,   D_yw -> -D_yw.

The same formulas lead back: they are an involution. Weights, thresholds and initial states are unchanged, because the
memory of the stop in `operators` is its play state `z - v`, the same number as the memory of the play. Rounded
operators (`eps > 0`) convert exactly too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError
from .elements import PrandtlIshlinskii
from .operators import Play, Stop
from .pilfr import PILFR, is_zero, with_port_gain

Array = np.ndarray
# each block that takes up a slope (in the order of `with_port_gain`), and the two blocks whose product it takes up
SLOPES = {"A": ("B_w", "C_z"), "B_u": ("B_w", "D_zu"), "C_y": ("D_yw", "C_z"), "D_yu": ("D_yw", "D_zu")}
MIRRORED = ("B_w", "D_yw")


def complement(values: Mapping[str, Any]) -> dict[str, Array]:
    """Convert the blocks and weights of a PI-LFR from plays to stops or back; further names are passed on."""
    out = {name: np.array(value, dtype=float) for name, value in values.items()}
    out |= dict(zip(SLOPES, with_port_gain(out, np.diag(out["w"].sum(axis=1))), strict=True))
    for name in MIRRORED:
        out[name] = -out[name]
    return out


def to_stops(structure: PILFR, values: Mapping[str, Any]) -> tuple[PILFR, dict[str, Array]]:
    """Replace plays by stops; a structure with stops is returned unchanged.

    Fixed values, bounds and priors remain where the conversion does not touch them, and are mirrored for `B_w` and
    `D_yw`. A block that takes up the slope (`A, B_u, C_y, D_yu`) becomes free, because its restriction would be another
    one in the new form. Thus a Hammerstein model with plays has a free `B_u` when written with stops.

    Parameters
    ----------
    structure : PILFR
    values : mapping
        Values of its blocks and of the element by name.

    Raises
    ------
    InputError
        If the element is not a Prandtl-Ishlinskii layer of plays or stops.
    """
    return _convert(structure, values, Stop())


def to_plays(structure: PILFR, values: Mapping[str, Any]) -> tuple[PILFR, dict[str, Array]]:
    """Replace stops by plays; see `to_stops`."""
    return _convert(structure, values, Play())


def _convert(structure: PILFR, values: Mapping[str, Any], operator: Play | Stop) -> tuple[PILFR, dict[str, Array]]:
    element = structure.element
    if not isinstance(element, PrandtlIshlinskii) or not isinstance(element.operator, Play | Stop):
        raise InputError(
            f"The element {element!r} was given to convert; give a Prandtl-Ishlinskii element of plays or stops."
        )
    if type(element.operator) is type(operator):
        return structure, {name: np.array(value, dtype=float) for name, value in values.items()}
    touched = {block for block, factors in SLOPES.items() if not any(is_zero(structure, f) for f in factors)}
    fixed = {k: -np.asarray(v) if k in MIRRORED else v for k, v in structure.fixed.items() if k not in touched}
    bounds = {k: _mirror(v) if k in MIRRORED else v for k, v in structure.bounds.items() if k not in touched}
    priors = {
        k: (-np.asarray(v[0]), v[1]) if k in MIRRORED else v for k, v in structure.priors.items() if k not in touched
    }
    layer = replace(element, operator=operator)
    return replace(structure, element=layer, fixed=fixed, bounds=bounds, priors=priors), complement(values)


def _mirror(bounds: tuple[Any, Any]) -> tuple[Any, Any]:
    return -np.asarray(bounds[1], dtype=float), -np.asarray(bounds[0], dtype=float)
