r"""A linear model in the coordinates of which some numbers are known beforehand: physical sub-matrices.

Identification finds the linear blocks up to a change of the states' basis, `x = T x'`. Where a structure fixes entries
of `A`, `B_u` or `C_y`, the basis is sought in which these entries come nearest to what is known,

    minimise over T   Σ_known (T⁻¹ A T - A_k)² + (T⁻¹ B_u - B_k)² + (C_y T - C_k)²     (each over its block's size),

from several bases, and the linear model is then fitted with the entries at their values: the start of everything else
(Krikelis et al. 2024, Sec. 5.3, starts from a linear model in any basis).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..linear import is_modal
from ..models import PILFR, Model
from ..optimise import stability_limits
from .job import Job
from .outcome import with_solution
from .start import states_of

COORDINATES = ("A", "B_u", "C_y")
STARTS = 30
Blocks = dict[str, np.ndarray]


def known_entries(structure: PILFR) -> dict[str, np.ndarray]:
    """What is known in the states' coordinates: fixed blocks with numbers (nan: free), those fixed at zero left out."""
    return {k: np.asarray(v) for k, v in structure.fixed.items() if k in COORDINATES and np.any(np.asarray(v) != 0)}


def in_known_coordinates(structure: PILFR, linear: Model, job: Job) -> Model:
    """The linear model in the basis in which what the structure knows holds; as it is where nothing is known."""
    known = known_entries(structure)
    if not known or not structure.nx or (set(known) == {"A"} and is_modal(known, structure.nx)):
        return linear  # which is in modal coordinates already
    blocks = {k: p.value for k, p in linear.parameters.items()}
    blocks = nearest_basis(_scaled(blocks, np.concatenate([r.u for r in job.recordings])), known)
    alone = replace(structure.linear(), fixed=known)
    model = alone.model(linear.n_u, linear.n_y, blocks, inputs=linear.inputs, outputs=linear.outputs)
    problem = replace(job, limits=stability_limits(structure, job.asked.stable)[:1]).problem(model)
    if not np.isfinite(problem.cost(problem.start)):
        return model
    return with_solution(model, problem, job.solve(problem, "linear model"))


def _scaled(blocks: Blocks, u: np.ndarray) -> Blocks:
    """States of unit deviation, from which the search for a basis begins."""
    spread = np.sqrt(np.mean(states_of(blocks, u) ** 2, axis=0))
    return changed_basis(blocks, np.diag(np.where(spread > 0, spread, 1.0)))


def changed_basis(blocks: Mapping[str, np.ndarray], t: np.ndarray) -> Blocks:
    """The blocks with `x = T x'`."""
    back = np.linalg.inv(t)
    return {
        **blocks,
        "A": back @ blocks["A"] @ t,
        "B_u": back @ blocks["B_u"],
        "C_y": blocks["C_y"] @ t,
    }


def nearest_basis(blocks: Blocks, known: Mapping[str, np.ndarray], seed: int = 0) -> Blocks:
    """The blocks in the basis in which their known entries (nan: unknown) come nearest to what is known.

    Parameters
    ----------
    blocks : mapping
        `A` (nx, nx), `B_u` (nx, n_u), `C_y` (n_y, nx); others are left as they are.
    known : mapping
        Known entries by block, scalars or arrays of its shape.
    seed : int
        Of the bases that the search starts from.
    """
    from scipy.optimize import least_squares

    n = len(blocks["A"])
    want = {k: np.broadcast_to(np.asarray(v, dtype=float), blocks[k].shape) for k, v in known.items()}
    size = {k: max(float(np.sqrt(np.nanmean(v**2))), 1e-12) for k, v in want.items()}

    def left(flat: np.ndarray) -> np.ndarray:
        t = flat.reshape(n, n)
        if not np.linalg.cond(t) < 1e10:
            return np.full(sum(int(np.sum(~np.isnan(v))) for v in want.values()), 1e6)
        found = changed_basis(blocks, t)
        return np.concatenate([((found[k] - v) / size[k])[~np.isnan(v)] for k, v in want.items()])

    rng, best, least = np.random.default_rng(seed), np.eye(n), np.inf
    for k in range(STARTS):
        t = np.eye(n) if k == 0 else rng.standard_normal((n, n))
        for name, side in (("B_u", 1), ("C_y", -1)):  # the known size of inputs and outputs tells the states' scale
            if name in want:
                norm = float(np.linalg.norm(changed_basis(blocks, t)[name]))
                t = t * (norm / (size[name] * np.sqrt(want[name].size))) ** side if norm > 0 else t
                break
        result: Any = least_squares(left, t.ravel(), x_scale="jac", max_nfev=200)
        if result.cost < least and np.linalg.cond(result.x.reshape(n, n)) < 1e8:
            best, least = result.x.reshape(n, n), float(result.cost)
        if least < 1e-10:
            break
    return changed_basis(blocks, best)
