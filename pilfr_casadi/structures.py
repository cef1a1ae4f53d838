"""A PI-LFR structure from names and numbers, as the command line and run files give them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .elements import PrandtlIshlinskii
from .lfr import PILFR, hammerstein, wiener
from .operators import GeneralizedPlay, Play, Stop

STRUCTURES = ("lfr", "hammerstein", "wiener")
OPERATORS: dict[str, Any] = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}


def named_structure(
    nx: int,
    *,
    structure: str = "lfr",
    operator: str = "play",
    operators: int = 20,
    channels: int = 1,
    neurons: int | None = None,
    offset: bool = True,
    fixed: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
) -> PILFR:
    """The structure; without operators it is linear.

    Raises
    ------
    InputError
        As for `PILFR` and `PrandtlIshlinskii`.
    """
    kind = OPERATORS[operator] if neurons is None else GeneralizedPlay(neurons)
    element = PrandtlIshlinskii(kind, operators, channels) if operators else None
    if structure == "lfr" or element is None:
        base = PILFR(nx, element)
    else:
        base = {"hammerstein": hammerstein, "wiener": wiener}[structure](nx, element)
    return PILFR(nx, element, {**base.fixed, **(fixed or {})}, bounds or {}, priors or {}, offset)
