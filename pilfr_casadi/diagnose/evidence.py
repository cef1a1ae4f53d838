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

from .._base import InputError
from ..laws import Law
from ..optimise import Problem
from ..simulators import Placed
from .workbench import Fitted, Workbench

EXACT = 8.0  # samples that a model whose error is no noise at all is worth
LEAST_WRONG = 0.05  # share of the error that is never taken for noise
MORE = np.log(0.5)  # log prior probability of one effect more
FLEXIBLE = ("hysteresis", "static_curve", "extra_mode", "stribeck_friction", "periodic_force", "drift")
IMITATES = np.log(0.2)  # log prior probability of a flexible law, which can imitate others, beside that of another
SMALLER = 0.7  # factor on the inputs for which the spread of predictions is computed: well inside what was recorded
ALMOST_NOTHING = 1e-9  # precision of the prior of initial states, over what a sample tells of them
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
    """Compute the eigenvalues λ of what a sample tells of the laws' parameters, in units of their prior widths."""
    own = _of_laws(fitted, laws)
    problem, hessian = _hessian(bench, fitted)
    own = own[problem.free]
    if not own.any():
        return np.zeros(0)
    if not np.all(np.isfinite(hessian)):  # a run at the edge of divergence has no derivatives
        return np.full(int(own.sum()), np.inf)
    laws_at = np.flatnonzero(np.append(own, np.zeros(len(hessian) - len(own), dtype=bool)))
    rest = np.setdiff1d(np.arange(len(hessian)), laws_at)
    width = _widths(fitted, laws, problem.free, np.diag(hessian)[: len(own)])[laws_at]
    with np.errstate(all="ignore"):
        block = hessian[np.ix_(laws_at, laws_at)] * np.outer(width, width)
        size = np.sqrt(np.maximum(np.diag(hessian)[rest], 1e-300))
        across = hessian[np.ix_(rest, laws_at)] * width / size[:, None]
        inner = hessian[np.ix_(rest, rest)] / np.outer(size, size)
        block = block - across.T @ np.linalg.pinv(inner, rcond=1e-10, hermitian=True) @ across
    if not np.all(np.isfinite(block)):
        return np.full(int(own.sum()), np.inf)
    return np.maximum(np.linalg.eigvalsh(block), 0.0)


def spread(bench: Workbench, fitted: Fitted, laws: Sequence[Placed], v: float, n: float) -> float:
    """Compute the mean square by which predictions for other inputs are uncertain, in units of the outputs' variance.

    The other inputs are the recorded ones at SMALLER times their size. The parameters have the
    covariance (n H / v + P)^-1 of Laplace's approximation, with H the Fisher information of a sample and P the
    precision of the prior; with H' the information of a sample for the other inputs, it is tr(H' (n H / v + P)^-1).
    Parameters that the recordings hardly determine show here, and nowhere in a cross-validation on the same recordings:
    a curve of a pressure that had two levels, say.
    """
    problem, told = _hessian(bench, fitted)
    _, asked = _hessian(bench.on([r.with_(u=SMALLER * r.u) for r in bench.recordings]), fitted)
    free = int(problem.free.sum())
    if not free:
        return 0.0
    if not (np.all(np.isfinite(told)) and np.all(np.isfinite(asked))):
        return np.inf
    own = _widths(fitted, laws, problem.free, np.diag(told)[:free])
    width = np.concatenate([own, 1 / np.sqrt(np.maximum(np.diag(told)[free:], 1e-300))])
    prior = np.concatenate([np.ones(free), np.full(len(width) - free, ALMOST_NOTHING)])
    precision = n / v * told * np.outer(width, width) + np.diag(prior)
    covariance = np.linalg.pinv(precision, rcond=1e-14, hermitian=True)[:free, :free]
    found = float(np.sum(covariance * asked[:free, :free] * np.outer(own, own)))
    return found if np.isfinite(found) else np.inf


def _of_laws(fitted: Fitted, laws: Sequence[Placed]) -> np.ndarray:
    """Tell which parameters belong to the laws."""
    parameters = fitted.model.parameters
    own = np.zeros(parameters.size, dtype=bool)
    for e in laws:
        for name in e.law.parameters():
            own[parameters.position(f"{e.prefix}{name}")] = True
    return own


def _hessian(bench: Workbench, fitted: Fitted) -> tuple[Problem, np.ndarray]:
    """Compute the Fisher information of one sample on free parameters and initial states; it may be infinite."""
    model = fitted.model.with_parameters(fitted.model.parameters.at(fitted.vector))
    problem = bench.problem(model, fitted.engine)
    theta, n_free = problem.start.copy(), problem.n_free
    states = [s for r, s in zip(bench.recordings, fitted.initial, strict=True) if r.begins == "estimate"]
    theta[n_free:] = np.concatenate(states) if states else theta[n_free:]
    try:
        with np.errstate(all="ignore"):
            return problem, np.nan_to_num(problem.normal(theta)[2], nan=np.inf)
    except (InputError, RuntimeError):  # the run diverges
        return problem, np.full((len(theta), len(theta)), np.inf)


def _widths(fitted: Fitted, laws: Sequence[Placed], free: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Compute the prior width of each free parameter.

    The width of a strength is its own prior's, or else what moves the outputs by their deviation; that of other
    parameters comes from their bounds, logarithmic where these span more than a decade.
    """
    parameters, values = fitted.model.parameters, fitted.vector
    width = prior_width(np.maximum(np.abs(values), 1e-300), parameters.lower, parameters.upper)
    of_unit = np.zeros(parameters.size)
    of_unit[free] = 1 / np.sqrt(np.maximum(square, 1e-300))
    for e in laws:
        for name in e.law.strength:
            where = parameters.position(f"{e.prefix}{name}")
            own = e.law.parameters()[name].prior
            width[where] = of_unit[where] if own is None else np.ravel(own[1])
    return np.asarray(width[free])


def prior_width(size: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Compute the standard deviations of values (n,) of a size of which only the bounds are known.

    Between bounds they are uniform, in logarithms where these span more than a decade; without bounds it is the size.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = ((lower > 0) & (upper > 10 * lower)) | ((upper < 0) & (lower < 10 * upper))
        spread = np.where(decades, size * np.abs(np.log(upper / lower)), upper - lower) / np.sqrt(12)
    return np.where(np.isfinite(spread) & (spread > 0), spread, size)


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
