"""The one scale on which all hypotheses of a diagnosis are compared: log evidence.

With v the mean square error of a fitted hypothesis, in units of the outputs' variance, n effective samples, λ the
eigenvalues of the Fisher information of one sample on the laws' parameters, these in units of their prior widths, and p
the prior probability,

    log Z = -n/2 log v - 1/2 Σ log(1 + n λ / v) + log p.

This is Laplace's approximation (MacKay 1992) with unknown noise variance. The simulator's own parameters and the
initial states are projected out of the information first. A model of a machine is never exact, and its error is not
independent from sample to sample; so samples do not count in full. With m the share of the error that is model error,
N samples, and n_0 the samples that a wholly wrong model is worth,

    n = n_0 N / (n_0 + m N)

(the coarsened posterior of Miller & Dunson 2019).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..laws import Law
from ..simulators import Placed
from .workbench import Fitted, Workbench

EXACT = 8.0  # samples that a model whose error is no noise at all is worth
LEAST_WRONG = 0.05  # share of the error that is never taken for noise
MORE = np.log(0.5)  # log prior probability of one effect more
FLEXIBLE = ("hysteresis", "static_curve", "extra_mode", "stribeck_friction", "periodic_force", "drift")
IMITATES = np.log(0.2)  # log prior probability of a flexible law, which can imitate others, beside that of another
DOUBTFUL = np.log(0.01)  # log prior probability of values at which a law is hardly what its name says


@dataclass(frozen=True)
class Sample:
    """What the recordings are worth: the mean square of the noise, in the outputs' variance, and their samples."""

    noise2: float
    count: float

    def effective(self, v: float) -> float:
        """Effective samples n, where the best hypothesis leaves the mean square error v."""
        wrong = float(np.clip(1 - self.noise2 / max(v, 1e-300), LEAST_WRONG, 1.0))
        return EXACT * self.count / (EXACT + wrong * self.count)


def information(bench: Workbench, fitted: Fitted, laws: Sequence[Placed]) -> np.ndarray:
    """Compute the eigenvalues λ of what a sample tells of the laws' parameters, in units of their prior widths.

    The prior width of a strength is what moves the outputs by their deviation; that of a shape parameter comes from its
    bounds, logarithmic where these span more than a decade.
    """
    parameters = fitted.model.parameters
    own = np.zeros(parameters.size, dtype=bool)
    for e in laws:
        for name in e.law.parameters():
            own[parameters.position(f"{e.prefix}{name}")] = True
    model = fitted.model.with_parameters(parameters.at(fitted.vector))
    problem = bench.problem(model, fitted.engine)
    own = own[problem.free]
    if not own.any():
        return np.zeros(0)
    theta, n_free = problem.start.copy(), problem.n_free
    states = [s for p, s in zip(problem._placed, fitted.initial, strict=True) if p.first is not None]
    theta[n_free:] = np.concatenate(states) if states else theta[n_free:]
    with np.errstate(all="ignore"):
        hessian = np.nan_to_num(problem.normal(theta)[2], nan=np.inf)
    if not np.all(np.isfinite(hessian)):  # a run at the edge of divergence has no derivatives
        return np.full(int(own.sum()), np.inf)
    laws_at = np.flatnonzero(np.append(own, np.zeros(len(theta) - n_free, dtype=bool)))
    rest = np.setdiff1d(np.arange(len(theta)), laws_at)
    width = _widths(fitted, laws, problem.free, np.diag(hessian)[:n_free])[laws_at]
    with np.errstate(all="ignore"):
        block = hessian[np.ix_(laws_at, laws_at)] * np.outer(width, width)
        size = np.sqrt(np.maximum(np.diag(hessian)[rest], 1e-300))
        across = hessian[np.ix_(rest, laws_at)] * width / size[:, None]
        inner = hessian[np.ix_(rest, rest)] / np.outer(size, size)
        block = block - across.T @ np.linalg.pinv(inner, rcond=1e-10, hermitian=True) @ across
    if not np.all(np.isfinite(block)):
        return np.full(int(own.sum()), np.inf)
    return np.maximum(np.linalg.eigvalsh(block), 0.0)


def _widths(fitted: Fitted, laws: Sequence[Placed], free: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Prior width of each free parameter; that of parameters of the simulator is not used."""
    parameters, values = fitted.model.parameters, fitted.vector
    low, high = parameters.lower, parameters.upper
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = (low > 0) & (high > 10 * low)
        spread = np.where(decades, np.abs(values) * np.log(high / low), high - low) / np.sqrt(12)
    width = np.where(np.isfinite(spread) & (spread > 0), spread, np.maximum(np.abs(values), 1e-300))
    of_unit = np.zeros(parameters.size)
    of_unit[free] = 1 / np.sqrt(np.maximum(square, 1e-300))
    for e in laws:
        for name in e.law.strength:
            where = parameters.position(f"{e.prefix}{name}")
            width[where] = of_unit[where]
    return np.asarray(width[free])


def log_prior(laws: Sequence[Placed], alternatives: Mapping[str, Sequence[Law]], doubtful: bool = False) -> float:
    """Log prior probability of laws in ports: all ports are alike, in a port all laws, and in a law all its forms.

    One law in several sensors, as of a logger's filters, counts once. `alternatives` are the laws that may stand in
    each port; `doubtful` says that a law is hardly what its name says.
    """
    total = DOUBTFUL if doubtful else 0.0
    in_sensors = set[type[Law]]()
    for e in laws:
        if e.port.startswith("sensor:"):
            if type(e.law) in in_sensors:
                continue
            in_sensors.add(type(e.law))
        there = alternatives.get(e.port, ())
        forms = sum(law.id == e.law.id for law in there)
        total += MORE - np.log(max(len(alternatives), 1)) - np.log(max(len({law.id for law in there}), 1))
        total -= np.log(max(forms, 1))
        total += IMITATES if e.law.id in FLEXIBLE else 0.0
    return float(total)


def log_evidence(v: float, information: np.ndarray, prior: float, n: float) -> float:
    """Compute log Z from the mean square error v; see the head of this file."""
    if not np.isfinite(v):
        return -np.inf
    return float(-0.5 * n * np.log(v) - 0.5 * np.sum(np.log1p(n * information / v)) + prior)
