"""What the cases of the zoo are made of: the case with its answer, a simulator in NumPy, excitation, noise, start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording, multisine
from pilfr_casadi.identify import grid_start, unit_states
from pilfr_casadi.linear import subspace_matrices
from pilfr_casadi.models import PILFR, Model, direction_fixed
from pilfr_casadi.optimise import Problem

Blocks = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Case:
    """One problem with its answer.

    Attributes
    ----------
    model : Model
        Closed model at the values where every solver starts.
    recordings : tuple of Recording
        Training data.
    clean : tuple of array, (M, n_y)
        True outputs of each recording, without noise.
    truth : dict
        True parameters by name, where the model is of the truth's own form and they are unique.
    exact : bool
        Whether the model class holds the truth, so that a global minimum lies at or below `floor`.
    remark : str
        What keeps the fit above the floor, where it is not exact.
    """

    model: Model
    recordings: tuple[Recording, ...]
    clean: tuple[np.ndarray, ...]
    truth: Mapping[str, Any] = field(default_factory=dict)
    exact: bool = True
    remark: str = ""

    def problem(self, **options: Any) -> Problem:
        """The simulation-error problem; options go to `Problem`."""
        return Problem(self.model, self.recordings, **options)

    @property
    def floor(self) -> float:
        """Cost of the truth, `1/2 mean(noise² / σ_y²)`; the noise level."""
        scale = np.std(np.concatenate([r.y[r.skip :] for r in self.recordings]), axis=0)
        pairs = zip(self.recordings, self.clean, strict=True)
        noise = np.concatenate([((r.y - y) / scale)[r.skip :].ravel() for r, y in pairs])
        return float(0.5 * np.mean(noise**2))


def simulate_lfr(blocks: Blocks, u: np.ndarray, law: Callable[[Any, Any], Any]) -> np.ndarray:
    """Eq. 15 in NumPy from rest: `law(z, memory) -> (w, memory)` with memory None at first; returns y (M, n_y)."""
    b = blocks
    x, memory, y = np.zeros(len(b["A"])), None, np.empty((len(u), len(b["C_y"])))
    for k, u_k in enumerate(u):
        w, memory = law(b["C_z"] @ x + b["D_zu"] @ u_k, memory)
        y[k] = b["C_y"] @ x + b["D_yu"] @ u_k + b["D_yw"] @ w
        x = b["A"] @ x + b["B_u"] @ u_k + b["B_w"] @ w
    return y


def plays(w: np.ndarray, r: np.ndarray) -> Callable[[Any, Any], Any]:
    """Plays with weights and thresholds (n_w, N), each at rest first."""

    def law(z: np.ndarray, q: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        q = np.zeros_like(r) if q is None else q
        q = np.maximum(z[:, None] - r, np.minimum(z[:, None] + r, q))
        return np.sum(w * q, axis=1), q

    return law


def noisy(u: np.ndarray, y: np.ndarray, rng: np.random.Generator, level: float, dt: float = 0.01) -> Recording:
    """A recording from rest with white noise of `level` times each output's deviation."""
    noise = level * np.std(y, axis=0) * rng.standard_normal(y.shape)
    return Recording(u=u, y=y + noise, dt=dt, initial="zero", hold="zero")


def excitation(rng: np.random.Generator, n: int, n_u: int = 1, f_max: float = 5.0) -> np.ndarray:
    """Multisines of unit deviation under a slow envelope, which makes nested loops of many sizes, (n, n_u)."""
    envelope = 0.6 + 0.4 * np.sin(np.linspace(0.0, 3.0 * np.pi, n))
    return np.column_stack([envelope * multisine(n, f_max, 100.0, rng) for _ in range(n_u)])


def identified(structure: PILFR, record: Recording, rng: np.random.Generator) -> Model:
    """The start a user gets: an identified linear model, a random direction of z, thresholds on a grid, `B_w = 0`."""
    a, b, c, d = subspace_matrices([record], structure.nx)
    linear = {"A": a, "B_u": b, "C_y": c, "D_yu": d, "y_0": np.zeros(record.n_y)}
    scaled, states = unit_states(linear, [record.u])
    values = grid_start(structure, scaled, [record.u], states, rng)
    if direction_fixed(structure):  # then it is thresholds that are drawn
        values["r"] = grid_start(structure, scaled, [record.u], states, rng, "input")["r"]
    return structure.model(record.n_u, record.n_y, values, inputs=record.inputs, outputs=record.outputs)
