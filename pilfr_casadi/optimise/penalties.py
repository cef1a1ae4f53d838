"""Terms that are added to the simulation error: priors of parameters and initial states, and L1 penalties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .._base import InputError
from ..engine import Engine
from ..models import ParameterSet

Array = np.ndarray
# model error assumed when an initial state is estimated, as a share of the outputs' deviation; model errors change
# slowly, so samples are not independent; calibrated on fits of the rig (problems.initial_state)
STATE_NOISE = 0.2
STATE_SAMPLES = 256  # states of a run from which second moments are computed
STILL_STATE = 1e-3  # least deviation of a state (or memory), relative to the largest deviation of a state (memory)
LEAST_CORRELATION_VARIANCE = 1e-6  # added to the diagonal of the correlation matrix


def check_penalised(name: str, parameters: ParameterSet) -> None:
    """Refuse an L1 penalty on an unknown name or a parameter that may be negative."""
    if np.any(parameters.lower[parameters.position(name)] < 0):
        raise InputError(f"An L1 penalty on {name!r} needs a lower bound of zero or more; bound it or use a prior.")


class Penalties:
    """Quadratic and L1 terms that are added to the simulation error.

    `l1` holds the weight of an L1 penalty by name, `noise` is the standard deviation of the noise relative to the
    output's, `residuals` and `size` count the residuals and the variables: the free parameters come first, then the
    estimated initial states. `states` holds the first variable, the prior precision (n_state, n_state) and the prior
    mean (n_state,) of each initial state that has a prior.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        l1: Mapping[str, float],
        noise: float,
        residuals: int,
        size: int,
        states: Sequence[tuple[int, Array, Array]] = (),
    ) -> None:
        self.states = tuple((slice(at, at + len(mean)), square / residuals, mean) for at, square, mean in states)
        weight, mean, slope = (np.zeros(parameters.size) for _ in range(3))
        for name, strength in l1.items():
            check_penalised(name, parameters)
            slope[parameters.position(name)] = strength
        for name, p in parameters.items():
            if p.prior is not None:
                where = parameters.position(name)
                mean[where], std = (
                    np.broadcast_to(np.asarray(part, dtype=float), p.value.shape).ravel(order="F") for part in p.prior
                )
                weight[where] = noise**2 / std**2 / residuals
        pad = np.zeros(size - int(parameters.free.sum()))
        self.weight, self.mean, self.slope = (np.concatenate([a[parameters.free], pad]) for a in (weight, mean, slope))

    def value(self, theta: Array) -> float:
        """Sum all terms."""
        value = float(0.5 * self.weight @ (theta - self.mean) ** 2 + self.slope @ theta)
        for part, square, mean in self.states:
            value += 0.5 * float((theta[part] - mean) @ square @ (theta[part] - mean))
        return value

    def gradient(self, theta: Array) -> Array:
        """Compute the gradient of `value`, shape (n,)."""
        slope = np.asarray(self.weight * (theta - self.mean) + self.slope)
        for part, square, mean in self.states:
            slope[part] += square @ (theta[part] - mean)
        return slope

    @property
    def hessian(self) -> Array:
        """Hessian of `value`, shape (n, n)."""
        out = np.diag(self.weight)
        for part, square, _ in self.states:
            out[part, part] += square
        return out


def state_precision(engine: Engine, drive: Array, p: Array, n_x: int, n_s: int) -> Array | None:
    """Compute the prior precision (n_state, n_state) of an initial state with memory, in units of the outputs.

    The prior is `N(0, S)`; see `state_covariance`. It is weighed against errors of `STATE_NOISE` per sample. None
    where that is None.
    """
    covariance = state_covariance(engine, drive, p, n_x, n_s)
    return None if covariance is None else STATE_NOISE**2 * np.linalg.inv(covariance)


def state_covariance(engine: Engine, drive: Array, p: Array, n_x: int, n_s: int) -> Array | None:
    """Compute the prior covariance S (n_state, n_state) of an initial state with memory.

    S holds the second moments of the states in a run from rest on the same inputs. So an operator that this run does
    not move begins at rest, and states and memories are correlated as they are in motion. None if the run diverges, or
    if there is no input: the motion then comes from the initial state alone, and a run from rest has no scale.
    """
    if not drive.shape[1]:
        return None
    state, found = np.zeros(n_x + n_s), []
    with np.errstate(over="ignore", invalid="ignore"):
        rows = engine.linear.substeps  # of each sample
        samples = drive.reshape(-1, rows, drive.shape[1])
        for piece in np.array_split(samples, min(STATE_SAMPLES, len(samples))):
            piece = piece.reshape(-1, drive.shape[1])
            state = engine.simulate(piece, p, state)[1]
            found.append(state)
        moments = np.transpose(found) @ np.array(found) / len(found)
    if not np.all(np.isfinite(moments)):
        return None
    size = np.sqrt(np.diag(moments))
    for group in (slice(0, n_x), slice(n_x, None)):  # states, and memories
        largest = np.max(size[group], initial=0.0)
        size[group] = np.maximum(size[group], STILL_STATE * largest) if largest > 0 else 1.0
    together = moments / size / size[:, None] + LEAST_CORRELATION_VARIANCE * np.eye(len(size))
    return np.asarray(together * size * size[:, None])
