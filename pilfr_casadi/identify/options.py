"""`FitOptions`: the options of `fit` that also hold for fits made from its result.

These are the bound on spectral radii, the constraints, the noise that priors are weighed against, and the weights of
recordings. A model file holds no code, hence no constraints: it holds their names, and the bound on spectral radii. A
constraint known only by name must be supplied again or dropped explicitly.
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

RADIUS = "spectral radius"  # how the names of bounds on spectral radii begin


@dataclass(frozen=True, eq=False)
class FitOptions:
    """Options that a fit passes on to fits made from it.

    Attributes
    ----------
    stable : bool or float
        As for `fit`.
    constraints : tuple of Constraint
    lost : tuple of str
        Names of constraints that the fit had before it was written to a file.
    noise : float or None
        Noise that priors are weighed against, relative to the output's deviation; None to estimate it.
    weights : mapping or None
        Weight of each recording by its `fingerprint`; None for equal weights.
    """

    stable: bool | float = True
    constraints: tuple[Constraint, ...] = ()
    lost: tuple[str, ...] = ()
    noise: float | None = None
    weights: Mapping[str, float] | None = None

    def updated(
        self,
        stable: bool | float | None = None,
        constraints: Any = None,
        noise: float | str | None = None,
        weights: Any = None,
        train: Any = (),
    ) -> FitOptions:
        """Return the options with some replaced; None keeps the present one. `weights` belong to recordings `train`.

        Raises
        ------
        InputError
            If a constraint, the noise or the weights are unfit, or constraints were lost in a file and none are given.
        """
        if noise is not None and noise != "estimate" and not (is_number(noise) and 0 < noise < np.inf):
            raise InputError(f"noise = {noise!r} was given; give a number above zero, or 'estimate'.")
        if constraints is None and self.lost:
            raise InputError(
                f"The fit was held by constraints that its file cannot hold ({listed(self.lost)}); give them again as "
                "constraints=, or constraints=() to do without."
            )
        return FitOptions(
            self.stable if stable is None else stable,
            self.constraints if constraints is None else _constraint_list(constraints),
            noise=self.noise if noise is None else None if noise == "estimate" else float(noise),
            weights=self.weights if weights is None else _weights_by_recording(weights, train),
        )

    def weights_of(self, recordings: Sequence[Recording]) -> np.ndarray | None:
        """Weight of each recording, or None.

        Raises
        ------
        InputError
            If there are weights, but none for one of the recordings.
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

    def all_constraints(self, structure: PILFR | None) -> tuple[Constraint, ...]:
        """Bounds on spectral radii, then the other constraints."""
        return (*(stability_limits(structure, self.stable) if structure else ()), *self.constraints)


def _weights_by_recording(weights: Any, train: Any) -> dict[str, float]:
    """Weights by the recordings' fingerprints; a recording given twice gets the root mean square of both."""
    recordings, sums = as_recordings(train), dict[str, list[float]]()
    for r, weight in zip(recordings, checked_weights(weights, len(recordings)), strict=True):
        sums.setdefault(fingerprint(r), []).append(float(weight))
    return {name: float(np.sqrt(np.mean(np.square(some)))) for name, some in sums.items()}


def options_from_limits(limits: Sequence[Limit], structure: PILFR | None, **more: Any) -> FitOptions:
    """Recover the options from the limits in a model file; `more` are options that the file states."""
    names = dict.fromkeys(limit.name.partition("[")[0] for limit in limits if limit.kind == "constraint")
    radii = [limit.upper for limit in limits if limit.name.startswith(f"{RADIUS} <= ")]
    lost = tuple(name for name in names if not name.startswith(RADIUS))
    return FitOptions(min(radii) if radii else structure is None or not structure.nx, lost=lost, **more)


def _constraint_list(given: Constraint | Sequence[Constraint]) -> tuple[Constraint, ...]:
    """Return one constraint, or several, as a tuple."""
    if isinstance(given, Constraint):
        return (given,)
    if not isinstance(given, Sequence) or not all(isinstance(c, Constraint) for c in given):
        raise InputError(f"constraints = {given!r} was given; give a Constraint, or a list of them.")
    return tuple(given)
