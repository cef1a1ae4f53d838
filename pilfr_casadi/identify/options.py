"""What a fit was asked with, which holds for fits made from it too.

That are a bound on spectral radii, constraints, the noise that priors are weighed against, and weights of recordings.

A model file has no code in it, hence no constraints: it tells their names, and of spectral radii the bound. What only
its name is known of has to be given again, or given up, rather than be left out unnoticed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import InputError, is_number, listed
from ..data import Recording, as_recordings, fingerprint
from ..models import PILFR
from ..optimise import Constraint, Limit, checked_weights, stability_limits

RADIUS = "spectral radius"


@dataclass(frozen=True, eq=False)
class Asked:
    """What `fit` was asked with.

    Attributes
    ----------
    stable : bool or float
        As for `fit`.
    constraints : tuple of Constraint
    lost : tuple of str
        Names of constraints that held the fit before it went through a file.
    noise : float or None
        What priors are weighed against, relative to the output's deviation; None where it is estimated.
    weights : mapping or None
        How much each recording counts, by its `fingerprint`; None where all count the same.
    """

    stable: bool | float = True
    constraints: tuple[Constraint, ...] = ()
    lost: tuple[str, ...] = ()
    noise: float | None = None
    weights: Mapping[str, float] | None = None

    def but(
        self,
        stable: bool | float | None = None,
        constraints: Any = None,
        noise: float | str | None = None,
        weights: Any = None,
        train: Any = (),
    ) -> Asked:
        """The same, but for what is given; None is not given. Weights are those of the recordings `train`.

        Raises
        ------
        InputError
            If what is given are no constraints, no noise or no weights of those recordings, or no constraints are given
            and those of the fit are lost.
        """
        if noise is not None and noise != "estimate" and not (is_number(noise) and 0 < noise < np.inf):
            raise InputError(f"noise = {noise!r} was given; give a number above zero, or 'estimate'.")
        if constraints is None and self.lost:
            raise InputError(
                f"The fit was held by constraints that its file cannot hold ({listed(self.lost)}); give them again as "
                "constraints=, or constraints=() to do without."
            )
        return Asked(
            self.stable if stable is None else stable,
            self.constraints if constraints is None else constraint_list(constraints),
            noise=self.noise if noise is None else None if noise == "estimate" else float(noise),
            weights=self.weights if weights is None else weights_by_recording(weights, train),
        )

    def weights_of(self, recordings: Sequence[Recording]) -> np.ndarray | None:
        """The weight of each recording, or None.

        Raises
        ------
        InputError
            If there are weights, but none for one of them.
        """
        if self.weights is None:
            return None
        prints = [fingerprint(r) for r in recordings]
        for r, name in zip(recordings, prints, strict=True):
            if name not in self.weights:
                raise InputError(
                    f"The fit was made with weights of its recordings, and {r.label} is none of them; give weights=, "
                    "one for each recording."
                )
        return np.array([self.weights[name] for name in prints])

    def limits(self, structure: PILFR | None) -> tuple[Constraint, ...]:
        """All of it as constraints, those on spectral radii first."""
        return (*(stability_limits(structure, self.stable) if structure else ()), *self.constraints)


def weights_by_recording(weights: Any, train: Any) -> dict[str, float]:
    """The weights of recordings by their fingerprints; of one that is given twice their root mean square."""
    recordings, sums = as_recordings(train), dict[str, list[float]]()
    for r, weight in zip(recordings, checked_weights(weights, len(recordings)), strict=True):
        sums.setdefault(fingerprint(r), []).append(float(weight))
    return {name: float(np.sqrt(np.mean(np.square(some)))) for name, some in sums.items()}


def asked_by(limits: Sequence[Limit], structure: PILFR | None, **more: Any) -> Asked:
    """What can be told from the limits that a file names, and what `more` it says."""
    names = dict.fromkeys(limit.name.partition("[")[0] for limit in limits if limit.kind == "constraint")
    radii = [limit.upper for limit in limits if limit.name.startswith(f"{RADIUS} <= ")]
    lost = tuple(name for name in names if not name.startswith(RADIUS))
    return Asked(min(radii) if radii else structure is None or not structure.nx, lost=lost, **more)


def constraint_list(given: Constraint | Sequence[Constraint]) -> tuple[Constraint, ...]:
    """One constraint, or several, as several."""
    if isinstance(given, Constraint):
        return (given,)
    if not isinstance(given, Sequence) or not all(isinstance(c, Constraint) for c in given):
        raise InputError(f"constraints = {given!r} was given; give a Constraint, or a list of them.")
    return tuple(given)
