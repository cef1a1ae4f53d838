"""Fewer operators for a continuous density: spread anew over it, the weights held near it, all else fitted again.

Where a density of weights (Krikelis et al. 2024, Sec. 3) is continuous, which operators a penalty leaves is chance; how
many it leaves is not. Free weights of few operators follow the training recording and fail on another; a weak prior
(`multistart.PRIOR`) holds them to the density that many operators have found. Which way of spreading is best, a
recording that was not fitted has to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..data import Recording, as_recordings
from ..models import LAYER, PrandtlIshlinskii
from ..optimise import Status
from .job import following
from .multistart import POLISH, PRIOR, held_near
from .result import Fit
from .start import is_density, regrid

WAYS = tuple(
    (beyond, spacing) for beyond in (1.0, 1.15, 1.3) for spacing in (0.25, 0.4)
)  # to spread operators, `regrid`
SPREAD = 0.02  # relative deviation of the prior on weights that are spread over a density


def thinned(
    fit: Fit, train: Recording | Sequence[Recording], n: int, *, solver: Any = None, **options: Any
) -> tuple[Fit, ...]:
    """Fits with n operators a channel, spread in several ways over the density of weights that a fit had.

    What the fit was asked with holds, where nothing else is given (`job.following`).
    None where weights or thresholds are fixed, bounded or have a prior.
    """
    structure, recordings = fit.structure, as_recordings(train)
    bound = structure is None or set(LAYER) & {*structure.fixed, *structure.bounds, *structure.priors}
    if structure is None or bound or not isinstance(structure.element, PrandtlIshlinskii):
        return ()
    smaller, old = replace(structure, element=replace(structure.element, n=n)), fit.model
    z = np.concatenate([fit.signals(r)["z"] for r in recordings])
    reach = np.max(np.abs(z), axis=0)
    states = [fit.initial_state(r) for r in recordings if r.begins == "estimate"]
    states = [np.concatenate([s[: old.n_x], np.zeros(n * structure.element.channels)]) for s in states]
    found: list[Fit] = []
    for beyond, spacing in WAYS:
        job = following(replace(fit, structure=smaller), recordings, solver=solver or POLISH, **options)
        rows = [
            regrid(r, w, float(top), beyond=beyond, spacing=spacing, count=n)
            if is_density(w) and top > 0
            else (r[:n], w[:n])
            for r, w, top in zip(fit.parameters["r"], fit.parameters["w"], reach, strict=True)
        ]
        values = {**fit.parameters, "r": np.array([r for r, _ in rows]), "w": np.array([w for _, w in rows])}
        model = smaller.model(old.n_u, old.n_y, values, inputs=old.inputs, outputs=old.outputs)
        model = held_near(model, values, SPREAD)
        problem = job.problem(model, float(np.mean(fit.train_nrmse)))
        begin = np.concatenate([problem.start[: int(problem.free.sum())], *states])
        if not np.isfinite(problem.cost(begin)):
            continue
        again = job.result(model, smaller, problem, job.solve(problem, "solve", begin), note=PRIOR)
        found.append(replace(again, linear=fit.linear, linear_nrmse=fit.linear_nrmse))
        if again.status is Status.INTERRUPTED:
            break
    return tuple(found)
