"""What a fit was asked to hold: a bound on spectral radii and constraints, which fits made from it hold too.

A model file has no code in it, hence no constraints: it tells their names, and of spectral radii the bound. What only
its name is known of has to be given again, or given up, rather than be left out unnoticed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .constraints import Constraint
from .lfr import PILFR
from .limits import Limit
from .recording import InputError, listed
from .stability import stability_limits

RADIUS = "spectral radius"


@dataclass(frozen=True, eq=False)
class Asked:
    """What `fit` was asked to hold.

    Attributes
    ----------
    stable : bool or float
        As for `fit`.
    constraints : tuple of Constraint
    lost : tuple of str
        Names of constraints that held the fit before it went through a file.
    """

    stable: bool | float = True
    constraints: tuple[Constraint, ...] = ()
    lost: tuple[str, ...] = ()

    def but(self, stable: bool | float | None = None, constraints: Any = None) -> Asked:
        """The same, but for what is given; None is not given.

        Raises
        ------
        InputError
            If what is given are no constraints, or none are given and those of the fit are lost.
        """
        if constraints is None and self.lost:
            raise InputError(
                f"The fit was held by constraints that its file cannot hold ({listed(self.lost)}); give them again as "
                "constraints=, or constraints=() to do without."
            )
        return Asked(
            self.stable if stable is None else stable,
            self.constraints if constraints is None else constraint_list(constraints),
        )

    def limits(self, structure: PILFR | None) -> tuple[Constraint, ...]:
        """All of it as constraints, those on spectral radii first."""
        return (*(stability_limits(structure, self.stable) if structure else ()), *self.constraints)


def asked_by(limits: Sequence[Limit], structure: PILFR | None) -> Asked:
    """What can be told from the limits that a file names."""
    names = dict.fromkeys(limit.name.partition("[")[0] for limit in limits if limit.kind == "constraint")
    radii = [limit.upper for limit in limits if limit.name.startswith(f"{RADIUS} <= ")]
    lost = tuple(name for name in names if not name.startswith(RADIUS))
    return Asked(min(radii) if radii else structure is None or not structure.nx, lost=lost)


def constraint_list(given: Constraint | Sequence[Constraint]) -> tuple[Constraint, ...]:
    """One constraint, or several, as several."""
    if isinstance(given, Constraint):
        return (given,)
    if not isinstance(given, Sequence) or not all(isinstance(c, Constraint) for c in given):
        raise InputError(f"constraints = {given!r} was given; give a Constraint, or a list of them.")
    return tuple(given)
