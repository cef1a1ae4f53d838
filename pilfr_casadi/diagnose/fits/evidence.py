"""The one scale on which all hypotheses of a diagnosis are compared: log evidence, and errors on held-out data.

Let v be the mean square error of a fitted hypothesis in units of the outputs' variance, n the effective samples, λ the
eigenvalues of the Fisher information of one sample on the laws' parameters (in units of their prior widths), and p the
prior probability. Then

    log Z = -n/2 log v - 1/2 Σ log(1 + n λ / v) + log p.

This is Laplace's approximation (MacKay 1992) with unknown noise variance. The simulator's own parameters and the
initial states are projected out of the information first. A model of a machine is never exact, and its error is
correlated from sample to sample; so samples do not count in full. With m the share of the error that is model error, N
samples, and n_0 the number of samples that a wholly wrong model is worth,

    n = n_0 N / (n_0 + m N)

(the coarsened posterior of Miller & Dunson 2019).

Where models are wrong, v is an error on data that a model was not fitted to. Every recording is cut into blocks, and
the blocks are dealt to a few folds in turn. For each fold, a simulator is refitted to the other folds, starting at its
fitted values. Parameters with a prior, such as the weights of a learned force, start at its mean; the held-out samples
would otherwise decide what the others leave open. It is simulated through the held-out blocks, whose samples are not
scored. The state at the beginning of a block therefore needs no estimate: it follows from the inputs and the time
before. Neighbouring samples are correlated, and so whole blocks are held out (Burman, Chow & Nolan 1994, Biometrika
81(2)). Samples after a block still constrain a simulation that drifts, for example behind a free integrator. Therefore
the second half of every recording is also predicted, from a fit to the first half (Tashman 2000, Int. J. Forecasting
16(4)). The larger of both errors counts, plus the spread of predictions for other inputs (`spread`).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..._base import InputError, side_by_side
from ...data import group_by_input
from ...identify import solve_within_bounds
from ...laws import Law
from ...optimise import GaussNewton, Problem, Status
from ...simulators import MECHANICAL, PARAMETER, SENSOR, UNKNOWN, Placed, kind_of
from .floor import effective_size
from .linearise import simulate_states
from .workbench import DIVERGED, RUNAWAY, Fitted, Workbench

# The priors and thresholds on which every answer of a search rests. Elsewhere are those of the noise (`floor`,
# `coloured_noise`), of faults (`preparation`, and in `faults`: `gates`, `channels`, `offsets`, `timing`,
# `lost_samples`, `samples`, `tones`), of memory that a motion does not show (`force_recovery`), the memories of an
# observer (`prediction`), the bases of flexible forces (`flexible_forces`, `learned`), the accuracy of integration
# (`workbench`, `step_refinement`) and what recordings can reveal (`detectability`, `excitation`, `identifiability`).
# All other numbers limit the effort or keep numbers finite.

# Prior probabilities
EFFECT_PRIOR = np.log(0.5)  # log probability of each further effect: one more effect is as likely as not
FLEXIBLE_PRIOR = np.log(0.2)  # the same of a law that can imitate others, relative to a law that cannot
DOUBTFUL_PRIOR = np.log(0.01)  # the same of parameter values at which a law degenerates into another
# log odds of a law made for the port's domain against a general law, and of that against one that is rare there
DOMAIN_PRIOR = np.log(4.0)
OUTSIDE_CATALOGUE = 0.1  # probability that missing physics is in no law of the catalogue
STRAINED_ODDS = 10.0  # how much likelier a wrong law drives a parameter of the simulator to a bound than the right one
STATE_PRIOR = 1e-9  # precision of initial states relative to the information of a sample: hardly any prior

# Model error: no machine follows a formula exactly
FORMULA_ERROR = 1e-3  # share of a mismatch that the right explanation may leave: 3 % of its force
LEAST_FORMULA_ERROR = 1e-6  # share that the right explanation leaves in any case: a thousandth of its force
WRONG_MODEL_SAMPLES = 8.0  # effective samples of a model whose whole error is model error (n_0)
LEAST_MODEL_ERROR = 0.05  # least share of the error that counts as model error
LARGE_MODEL_ERROR = 0.2  # share of model error in the error above which models are judged on held-out blocks
# weight of the remainder that no force at a port explains; it may come from a disturbance
DISTURBANCE_WEIGHT = 0.2
INPUT_FACTOR = 0.7  # factor on the inputs' deviation for which the spread is computed: well inside their range
PERTURBATION = 1e-5  # of the inputs, over their deviation, by which a motion is tried: linear, and above rounding

# Comparison of hypotheses
SURE = 0.5  # probability above which an answer is stated: more likely than not; `studies` (fleets) use it as well
INDISTINGUISHABLE_NATS = 3.0  # nats within which two hypotheses are indistinguishable: odds of 20 (Kass & Raftery 1995)
CONTENDING_NATS = 8.0  # nats below the best within which a hypothesis may still win after more fits
BETTER_RATIO = 1.05  # ratio of rms errors from which one is better than another
NEAR_RATIO = 1.5  # ratio of rms errors within which one comes near another: more fits may reverse their order
FAR_RATIO = 3.0  # ratio of rms errors from which one is far behind another: more fits cannot reverse their order
CLEAR_ERRORS = 2.0  # standard errors of a paired difference from which it is clear: 1 in 40 by chance
AS_GIVEN_RATIO = 0.5  # largest ratio of mean squares of a search with channels as given to one with shifted channels

# Noise, by rms ratios to the noise and by shares of an output's deviation
AT_NOISE_RATIO = 1.15  # ratio to the noise that counts as at the noise
WHITE_NOISE_RATIO = 4.0  # largest ratio of an error that is noise to the estimated (white) noise
COLOURED_NOISE_RATIO = 20.0  # the same if no force explains it: that of first-order noise with a pole of 0.996
LOUDEST_NOISE = 0.05  # share of the deviation above which an error is not sensor noise
NEGLIGIBLE_ERROR = 0.01  # share of the deviation below which an error does not matter
EXPLAINED_NOISE = 0.01  # largest share of noise that a force may explain
EXPLAINED_QUIET_NOISE = 0.05  # the same of noise that does not matter, and of innovations
MOST_INNOVATIONS = 0.5  # share of a residual's innovations that a force explains from which it is no noise
LEAST_EXPLAINED = 0.1  # least share of a residual that a flexible force has to explain to count
# of the largest share that a force at a port explains: below it, the port of the closest law is not the likeliest place
OTHER_PORT_SHARE = 0.5

LEAST_KNOWN = 1e-12  # eigenvalue of the scaled information, over the largest, below which a combination is unknown
UNKNOWN_SHARE = 1e-6  # squared share of a parameter in an unknown combination; rounding gives far less

# Test recordings that go beyond the training recordings, where a correction extrapolates
BEYOND_RANGE = 0.1  # distance from a channel's trained range, over the range, that counts
NEW_DENSITY = 0.01  # trained over tested spectral density, both normalised, below which a frequency is new: 10 in size
NEW_SHARE = 0.5  # share of an input's variance at new frequencies that is reported: more than half

# Held-out data
FOLDS, ROUNDS = 4, 2  # folds, and blocks of a recording in each fold: eight blocks, spread over the recording
WARM_UP_SHARE = 0.5  # share of a block, at the start of a recording, that is never held out: it gives the initial state
# The fit to all blocks is near each of these fits; a fit that has not converged after so many steps is used as it is.
REFIT = GaussNewton(max_iterations=8, tolerance=1e-2, patience=2)


@dataclass(frozen=True)
class EffectiveSamples:
    """The number of samples that count in an evidence, which depends on how far the error is noise."""

    noise2: float  # mean square noise of the recordings, in units of the outputs' variance
    count: float  # samples of the recordings over the residual's correlation time

    def at(self, v: float) -> float:
        """Compute the effective samples n if the best hypothesis leaves the mean square error v."""
        wrong = float(np.clip(1 - self.noise2 / max(v, 1e-300), LEAST_MODEL_ERROR, 1.0))
        return WRONG_MODEL_SAMPLES * self.count / (WRONG_MODEL_SAMPLES + wrong * self.count)


def cap_mismatch(mismatch2: np.ndarray) -> np.ndarray:
    """Limit the mean squares of a mismatch (n_y,) to the outputs' variance: a free run can be off by any factor."""
    return np.minimum(mismatch2, 1.0)


def formula_tolerance(mismatch2: np.ndarray, noise2: np.ndarray) -> float:
    """Compute the mean square error that any law may leave: no machine follows a formula exactly.

    `mismatch2` and `noise2` are mean squares of the refit's residual and of the noise, (n_y,), in units of the outputs'
    variance.
    """
    return FORMULA_ERROR * max(float(np.mean(cap_mismatch(mismatch2) - noise2)), 0.0)


def all_sure(confidences: Iterable[float]) -> bool:
    """Tell whether all confidences are above SURE; False if there is none."""
    return min(confidences, default=0.0) > SURE


def information(bench: Workbench, fitted: Fitted, laws: Sequence[Placed]) -> np.ndarray:
    """Compute the eigenvalues λ of a sample's information on the laws' parameters, in units of their prior widths.

    One law in several sensors counts once, as in `log_prior`.
    """
    numbers = _number_parameters(fitted, laws)[fitted.model.parameters.free]
    laws_at = np.flatnonzero(numbers >= 0)
    # of one law in several sensors, each parameter is one
    shared = np.equal.outer(numbers[laws_at], np.unique(numbers[laws_at])).astype(float)
    if not laws_at.size:
        return np.zeros(0)
    problem, _, hessian = _hessian(bench, fitted)
    infinite = np.full(shared.shape[1], np.inf)
    if not np.all(np.isfinite(hessian)):  # a run at the edge of divergence has no derivatives
        return infinite
    width = _widths(fitted, laws, problem.free, np.diag(hessian)[: len(numbers)])[laws_at]
    with np.errstate(all="ignore"):
        width = np.array([min(width[column > 0]) for column in shared[:, np.argmax(shared, axis=1)].T])  # of its group
        block = shared.T @ _without_others(hessian, laws_at, width) @ shared
    return np.maximum(np.linalg.eigvalsh(block), 0.0) if np.all(np.isfinite(block)) else infinite


def _without_others(hessian: np.ndarray, kept: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Compute the information on `kept` variables, times their widths, that no change of the others can follow.

    It is not finite if the derivatives of the run overflow.
    """
    others = np.setdiff1d(np.arange(len(hessian)), kept)
    block = hessian[np.ix_(kept, kept)] * np.outer(width, width)
    size = np.sqrt(np.maximum(np.diag(hessian)[others], 1e-300))
    across = hessian[np.ix_(others, kept)] * width / size[:, None]
    inner = hessian[np.ix_(others, others)] / np.outer(size, size)
    if not np.all(np.isfinite(inner)):
        return np.full_like(block, np.inf)
    return np.asarray(block - across.T @ np.linalg.pinv(inner, rcond=1e-10, hermitian=True) @ across)


def spread(bench: Workbench, fitted: Fitted, laws: Sequence[Placed], v: float, n: float) -> float:
    """Compute the mean square uncertainty of predictions for other inputs, in units of the outputs' variance.

    The other inputs are the recorded ones, their deviation from the mean times INPUT_FACTOR. The parameters have the
    covariance (n H / v + P)^-1 of Laplace's approximation, with H the Fisher information of a sample and P the
    precision of the prior. With H' the information of a sample for the other inputs, the spread is
    tr(H' (n H / v + P)^-1). The simulator's initial states are among the parameters, because the two may make up for
    each other; they count alike for all hypotheses. The states in which laws begin, such as the past of a delay, are
    projected out of H and H': a further recording has others, and each recording would count them anew. The spread
    reveals parameters that the recordings hardly determine, such as a curve of a pressure that had two levels; a
    cross-validation on the same recordings cannot.

    A motion near an unstable one, such as a pendulum's near its upper rest, amplifies any small change. If the motion
    for the other inputs amplifies more than the recorded one, that is a matter of those inputs, and the spread is
    divided by it.
    """
    if not np.any(fitted.model.parameters.free):
        return 0.0
    problem, _, recorded = _hessian(bench, fitted)
    mean = np.mean(bench.stacked_inputs, axis=0)
    smaller = [r.with_(u=mean + INPUT_FACTOR * (r.u - mean)) for r in bench.recordings]
    there, begun = bench.on(smaller), _shrink_initial_states(bench, fitted)
    *_, other = _hessian(there, begun)
    free = int(problem.free.sum())
    if not (np.all(np.isfinite(recorded)) and np.all(np.isfinite(other))):
        return np.inf
    own = _own_states(fitted, len(recorded) - free)
    # an initial state that the recordings do not reveal is a matter of the next recording
    felt = np.diag(recorded)[free:] > STATE_PRIOR * np.diag(other)[free:]
    kept = np.concatenate([np.arange(free), free + np.flatnonzero(own & felt)])
    width = np.concatenate(
        [
            _widths(fitted, laws, problem.free, np.diag(recorded)[:free]),
            1 / np.sqrt(np.maximum(np.diag(recorded)[kept[free:]], 1e-300)),
        ]
    )
    prior = np.concatenate([np.ones(free), np.full(len(kept) - free, STATE_PRIOR)])
    with np.errstate(all="ignore"):
        recorded, other = (_without_others(hessian, kept, width) for hessian in (recorded, other))
        precision = n / v * recorded + np.diag(prior)
    if not np.all(np.isfinite(precision)):  # a parameter that the recordings hardly feel
        return np.inf
    covariance = np.linalg.pinv(precision, rcond=1e-14, hermitian=True)
    found = float(np.sum(covariance * other))
    if not np.isfinite(found):
        return np.inf
    as_recorded, now = _amplification(bench, fitted), _amplification(there, begun)
    return found / max(now / as_recorded, 1.0) if 0 < as_recorded < np.inf and now < np.inf else found


def _shrink_initial_states(bench: Workbench, fitted: Fitted) -> Fitted:
    """Return a fit whose estimated initial states are nearer to each run's mean state by INPUT_FACTOR.

    With the recorded state, a motion that inputs and state cancel as recorded, such as a hardly damped vibration, would
    appear for smaller inputs, and with it an uncertainty of its parameters that no recording has.
    """
    initial = []
    for r, state in zip(bench.recordings, fitted.initial, strict=True):
        mean = np.mean(simulate_states(fitted, r, state), axis=0) if r.begins == "estimate" else state
        initial.append(mean + INPUT_FACTOR * (state - mean) if np.all(np.isfinite(mean)) else state)
    return replace(fitted, initial=initial)


def _own_states(fitted: Fitted, count: int) -> np.ndarray:
    """Mark which of the unknown numbers of all initial states, (count,), are of the simulator's own states."""
    basis = fitted.model.initial_basis
    own = np.any(basis[: len(fitted.simulator.states)] != 0, axis=0)
    return np.tile(own, count // max(len(own), 1))


def runs_away(bench: Workbench, fitted: Fitted, refitted: Fitted) -> bool:
    """Tell whether a simulator runs away where an input stays at an end of its range, and the refitted one does not.

    The recordings may visit that level for so short a time that they do not show it, as with a stiffness that varies
    with an input and is negative there. Such a simulator predicts nothing for other inputs. It grows exponentially: far
    more from the first half of a recording's duration to the second than what drifts or turns at a constant force.
    """
    if bench.simulator.observer is not None:
        return False
    k = int(np.argmax([len(r) for r in bench.recordings]))
    r, inputs = bench.recordings[k], bench.stacked_inputs
    rest, ends = np.mean(inputs, axis=0), (np.min(inputs, axis=0), np.max(inputs, axis=0))

    def reach(one: Fitted, u: np.ndarray) -> tuple[float, float]:
        held = r.with_(u=np.tile(u, (len(r), 1)))
        with np.errstate(all="ignore"):
            y = one.simulate(held, one.initial[k])
            off = np.max(np.abs(y - np.mean(r.y, axis=0)) / bench.scale, axis=1)
            return float(np.max(off[: len(r) // 2])), float(np.max(off))

    for i, end in itertools.product(range(len(rest)), ends):
        u = np.where(np.arange(len(rest)) == i, end, rest)
        early, late = reach(fitted, u)
        if not late <= RUNAWAY * max(early, reach(refitted, u)[1], 1.0):
            return True
    return False


def _amplification(bench: Workbench, fitted: Fitted) -> float:
    """Compute the mean square change of the outputs by a small perturbation, over that of the inputs."""
    rng, size = np.random.default_rng(0), PERTURBATION * np.std(bench.stacked_inputs, axis=0)
    perturbed = bench.on([r.with_(u=r.u + size * rng.standard_normal(r.u.shape)) for r in bench.recordings])
    try:
        with np.errstate(all="ignore"):
            runs = [problem.simulate(theta) for problem, theta in (b.problem_at(fitted) for b in (bench, perturbed))]
            moved = np.concatenate([(y - x) / bench.scale for x, y in zip(*runs, strict=True)])
    except (InputError, RuntimeError):  # a run diverges
        return np.inf
    return float(np.mean(moved**2) / max(np.sum(size**2), 1e-300))


def _number_parameters(fitted: Fitted, laws: Sequence[Placed]) -> np.ndarray:
    """Number the laws' parameters, with -1 for all others; the same law has the same numbers in all sensors."""
    parameters = fitted.model.parameters
    numbers, first = np.full(parameters.size, -1), dict[tuple[object, str, int], slice]()
    for e in laws:
        one = type(e.law) if kind_of(e.port) == SENSOR else e.prefix
        for name in e.law.parameters():
            where = parameters.position(f"{e.prefix}{name}")
            same = first.setdefault((one, name, where.stop - where.start), where)
            numbers[where] = np.arange(same.start, same.stop)
    return numbers


def _hessian(bench: Workbench, fitted: Fitted) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Compute the Fisher information of one sample on free parameters and initial states; it may be infinite.

    Also returns the simulation-error problem and its variables at the fitted values.
    """
    problem, theta = bench.problem_at(fitted)
    try:
        with np.errstate(all="ignore"):
            return problem, theta, np.nan_to_num(problem.normal(theta)[2], nan=np.inf)
    except (InputError, RuntimeError):  # the run diverges
        return problem, theta, np.full((len(theta), len(theta)), np.inf)


def standard_errors(bench: Workbench, fitted: Fitted) -> dict[str, np.ndarray]:
    """Compute standard errors from the residual and its correlation time; nan for fixed parameters and at bounds.

    Initial states are estimated together with the parameters. Parameters that can be identified only together, such as
    the damping of a law beside the simulator's own, have none either.
    """
    full = np.full(fitted.model.parameters.size, np.nan)
    places, root = _covariance_root(bench, fitted)
    full[places] = np.sqrt(np.sum(root**2, axis=1))
    return fitted.model.parameters.unpack(full)


def significance(bench: Workbench, fitted: Fitted, names: Iterable[str]) -> float:
    """Compute the confidence at which not all of some parameters are zero, by Wald's test; 1 if it is unknown.

    It is unknown for parameters that can be identified only together with others, and at bounds.
    """
    from scipy.special import gammainc

    own, (places, root) = fitted.model.parameters, _covariance_root(bench, fitted)
    wanted = np.concatenate([np.arange(own.size)[own.position(name)] for name in names])
    rows = np.isin(places, wanted)
    if not np.any(rows) or not np.all(np.isfinite(root[rows])):
        return 1.0
    away = np.linalg.pinv(root[rows]) @ fitted.vector[places[rows]]
    return float(gammainc(np.sum(rows) / 2, away @ away / 2))


def _covariance_root(bench: Workbench, fitted: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Return places in the parameter vector, (k,), and a root of their covariance, (k, r), with nan where unknown."""
    if not np.any(fitted.model.parameters.free):
        return np.zeros(0, dtype=int), np.zeros((0, 0))
    problem, theta, hessian = _hessian(bench, fitted)
    inside, diagonal = (theta > problem.lower) & (theta < problem.upper), np.diag(hessian)
    kept = np.flatnonzero(inside & np.isfinite(diagonal) & (diagonal > 0))
    size = np.sqrt(np.maximum(diagonal[kept], 1e-300))
    values, vectors = np.linalg.eigh(hessian[np.ix_(kept, kept)] / np.outer(size, size))
    known = values > LEAST_KNOWN * values[-1:]
    root = vectors[:, known] / np.sqrt(values[known])
    root[np.sum(vectors[:, ~known] ** 2, axis=1) > UNKNOWN_SHARE] = np.nan
    own, n = kept < problem.n_free, max(effective_size(bench.scored(fitted.residual)), 10.0)
    return np.flatnonzero(problem.free)[kept[own]], root[own] * np.sqrt(fitted.cost / n) / size[own][:, None]


def _widths(fitted: Fitted, laws: Sequence[Placed], free: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Compute the prior width of each free parameter, from its bounds (`prior_width`) unless it is a strength of a law.

    The width of a strength is that of its own prior, or else the value that moves the outputs by their deviation.
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
    """Compute the prior standard deviations of values (n,) from their sizes and their bounds alone.

    The prior is uniform between the bounds, in logarithms if these span more than a decade. Without bounds the
    deviation is the size.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = ((lower > 0) & (upper > 10 * lower)) | ((upper < 0) & (lower < 10 * upper))
        spread = np.where(decades, size * np.abs(np.log(upper / lower)), upper - lower) / np.sqrt(12)
    return np.where(np.isfinite(spread) & (spread > 0), spread, size)


def log_prior(
    laws: Sequence[Placed],
    alternatives: Mapping[str, Sequence[Law]],
    doubtful: bool = False,
    domains: Mapping[str, str] | None = None,
) -> float:
    """Compute the log prior probability of laws: all ports are alike, in a port all laws, and in a law all its forms.

    The parameters, which nobody declared as ports, count as one port together. At a port of a known domain (`domains`)
    the laws of that domain are likelier than general ones, and these than laws that are rare there; so are laws that
    are rare at sensors. One law in several sensors, such as a logger's filters, counts once. `alternatives` are the
    laws allowed in each port; `doubtful` tells that a law degenerates at its fitted values.
    """
    total = DOUBTFUL_PRIOR if doubtful else 0.0
    in_sensors = set[type[Law]]()
    parameters = sum(kind_of(port) == PARAMETER for port in alternatives)
    ports = max(len(alternatives) - parameters + min(parameters, 1), 1)
    for e in laws:
        if kind_of(e.port) == SENSOR:
            if type(e.law) in in_sensors:
                continue
            in_sensors.add(type(e.law))
        there = alternatives.get(e.port, ())
        forms = sum(law.id == e.law.id for law in there)
        total += EFFECT_PRIOR - np.log(ports) - np.log(max(forms, 1))
        total -= np.log(max(parameters, 1)) if kind_of(e.port) == PARAMETER else 0.0
        domain = (domains or {}).get(e.port, UNKNOWN)
        total += _log_share(e.law.id, there, domain)
        total -= DOMAIN_PRIOR if {domain, kind_of(e.port)} & set(e.law.rare) else 0.0
        total += FLEXIBLE_PRIOR if e.law.flexible else 0.0
    return float(total)


def log_prior_of_states(bench: Workbench, fitted: Fitted) -> float:
    """Compute the log prior density of the estimated states in which laws begin, relative to the largest.

    The machine was at work before, with signals like the recorded ones or others. The prior is therefore a multivariate
    Cauchy density, for its heavy tails, with the covariance of `Problem.state_priors`. States are counted from rest.
    """
    own, total = len(bench.simulator.states), 0.0
    if fitted.model.n_x == own or all(r.begins != "estimate" for r in bench.recordings):
        return total
    problem, theta = bench.problem_at(fitted)
    for state, covariance in problem.state_priors(theta, own):
        total -= 0.5 * (1 + len(state)) * np.log1p(float(state @ np.linalg.solve(covariance, state)))
    return total


def _log_share(law: str, there: Sequence[Law], domain: str) -> float:
    """Compute the log probability of a law by its id among the laws allowed in a port of some domain.

    At a mechanical port the general laws are at home as well.
    """
    own = {other.id for other in there if domain in other.domains} if domain != MECHANICAL else set[str]()
    total = sum(np.exp(DOMAIN_PRIOR) if name in own else 1.0 for name in {other.id for other in there})
    return float((DOMAIN_PRIOR if law in own else 0.0) - np.log(max(total, 1.0)))


def log_evidence(v: float, information: np.ndarray | None, prior: float, n: float) -> float:
    """Compute log Z from the mean square error v; see the module docstring."""
    if not np.isfinite(v):
        return -np.inf
    return float(-0.5 * n * np.log(v) - log_occam(v, information, n) + prior)


def log_occam(v: float, information: np.ndarray | None, n: float) -> float:
    """Compute what a law's parameters cost: the log ratio of prior to posterior widths, if the information is known."""
    return 0.0 if information is None else float(0.5 * np.sum(np.log1p(n * information / v)))


@dataclass(frozen=True)
class HeldOut:
    """Mean square errors of a simulator on data that it was not fitted to, outputs in units of their deviation."""

    blocks: float  # on held-out blocks; infinite if the simulation diverges
    ahead: float  # the same on the second halves
    squares: np.ndarray  # (n_y,), the larger of the two, of each output
    each: np.ndarray = field(default_factory=lambda: np.zeros(0))  # on each held-out block, in the order of the blocks
    sizes: np.ndarray = field(default_factory=lambda: np.ones(1))  # samples of each block; one number if all are alike

    def clearly_above(self, other: HeldOut) -> bool:
        """Tell whether the errors on the blocks are larger by more than CLEAR_ERRORS, paired, in logarithms.

        Blocks count by their samples: those of a short recording may have one each. A block in which everything fails,
        such as one with an event that nothing describes, counts like any other. But a law may act in few blocks, as a
        stop that is seldom met: errors that are nowhere smaller, and far larger in all, are clearly above as well.
        """
        if self.each.shape != other.each.shape or len(self.each) < 2:
            return True
        with np.errstate(all="ignore"):
            ratios = np.log(self.each / other.each)
        if not np.all(np.isfinite(ratios)):
            return True
        nowhere_smaller = np.min(ratios) > -2 * np.log(BETTER_RATIO)
        far = nowhere_smaller and self.blocks > FAR_RATIO**2 * other.blocks
        weights = self.sizes * np.ones_like(ratios)
        weights /= np.sum(weights)
        mean = weights @ ratios
        error = np.linalg.norm(weights * (ratios - mean)) * np.sqrt(len(ratios) / (len(ratios) - 1))
        return bool(far or mean > CLEAR_ERRORS * error)

    @property
    def mean_square(self) -> float:
        """Mean square error, outputs weighted by their noise."""
        return max(self.blocks, self.ahead)

    @property
    def rms(self) -> float:
        """Rms error, all outputs alike, as reports state it."""
        return float(np.sqrt(np.mean(self.squares)))


@dataclass(frozen=True)
class ExpectedError:
    """The error that is expected on other recordings: that on held-out data, plus the spread for other inputs."""

    held_out: HeldOut
    spread: float  # mean square uncertainty of predictions for other inputs; see `evidence.spread`

    @property
    def mean_square(self) -> float:
        """Mean square error by which models are chosen, outputs weighted by their noise."""
        return self.held_out.mean_square + self.spread

    @property
    def rms(self) -> float:
        """Rms error, all outputs alike."""
        return float(np.hypot(self.held_out.rms, np.sqrt(self.spread)))


def blocks_of(bench: Workbench) -> list[np.ndarray]:
    """Return the number of each sample's block, (M,) for each recording; -1 for samples in no block."""
    out = []
    for r in bench.recordings:
        warm_up = int(WARM_UP_SHARE * (len(r) - r.skip) / (FOLDS * ROUNDS)) if r.begins == "estimate" else 0
        numbers, begin = np.full(len(r), -1), r.skip + warm_up
        numbers[begin:] = np.arange(len(r) - begin) * FOLDS * ROUNDS // max(len(r) - begin, 1)
        out.append(numbers)
    return out


def held_out_errors(bench: Workbench, fitted: Fitted, workers: int = 1) -> HeldOut:
    """Refit without each fold of blocks and without second halves; return the errors on the omitted parts.

    Recordings of other inputs lose other blocks, and their second halves in turn: courses may be alike, such as
    discharges from full to empty, so that the same states would be left out of all. The errors are infinite if the run
    diverges or the time is over.
    """
    blocks, groups = blocks_of(bench), group_by_input(bench.recordings)
    group = {k: g for g, members in enumerate(groups) for k in members}
    shift = {k: g * FOLDS // min(len(groups), FOLDS) for k, g in group.items()}
    folds = [[(b >= 0) & ((b + shift[k]) % FOLDS == fold) for k, b in enumerate(blocks)] for fold in range(FOLDS)]
    parts, half = min(len(groups), 2), FOLDS * ROUNDS // 2
    later = [[(b >= half) & (group[k] % parts == part) for k, b in enumerate(blocks)] for part in range(parts)]
    found = side_by_side(lambda left: _sum_of_squares(bench, fitted, left), [*folds, *later], workers)
    squares, second = found[:FOLDS], np.sum(found[FOLDS:], axis=0)
    scored, ahead = (max(sum(int(np.sum(b >= first)) for b in blocks), 1) for first in (0, half))
    of_blocks = np.sum(squares, axis=0)
    both = np.sum(of_blocks, axis=0) / scored, np.sum(second, axis=0) / ahead
    pooled = bench.pool(both[0]), bench.pool(both[1])
    sizes = np.concatenate([np.bincount(b[b >= 0], minlength=FOLDS * ROUNDS) for b in blocks])
    each = np.array([bench.pool(one / n) for one, n in zip(of_blocks, sizes, strict=True) if n])
    return HeldOut(*pooled, both[int(pooled[1] > pooled[0])], each, sizes[sizes > 0])


def _at_prior_means(fitted: Fitted) -> Fitted:
    """Set the free parameters that have a prior to its mean."""
    means = {k: p.prior[0] for k, p in fitted.model.parameters.items() if p.prior is not None and not np.all(p.fixed)}
    values = {k: np.where(fitted.model.parameters[k].fixed, fitted.values[k], mean) for k, mean in means.items()}
    return replace(fitted, values={**fitted.values, **values})


def _sum_of_squares(bench: Workbench, fitted: Fitted, left: Sequence[np.ndarray]) -> np.ndarray:
    """Refit without scoring the samples in `left`; return each output's sum of squares there, by block (B, n_y).

    It is infinite if the run diverges or the time is over: a refit that is cut short has not left the samples out.
    """
    count = FOLDS * ROUNDS
    infinite = np.full((count * len(left), len(bench.scale)), np.inf)
    residual: Sequence[np.ndarray] = fitted.residual
    if np.any(fitted.model.parameters.free) or any(r.begins == "estimate" for r in bench.recordings):
        seconds = bench.deadline - time.perf_counter()
        if seconds <= 0:
            return infinite
        problem, theta = bench.problem_at(_at_prior_means(fitted), [~mask for mask in left])
        try:
            with np.errstate(all="ignore"):
                found = solve_within_bounds(problem, theta, replace(REFIT, time_limit=seconds))
                simulated = problem.simulate(found.theta)
        except (InputError, RuntimeError, FloatingPointError, np.linalg.LinAlgError):
            return infinite
        if found.status in (Status.TIME_LIMIT, Status.INTERRUPTED):
            return infinite
        residual = [y - r.y for y, r in zip(simulated, bench.recordings, strict=True)]
    with np.errstate(over="ignore", invalid="ignore"):
        found_there = list[np.ndarray]()
        for e, here, number in zip(residual, left, blocks_of(bench), strict=True):
            squares = (e / bench.scale) ** 2
            found_there += [np.sum(squares[here & (number == k)], axis=0) for k in range(count)]
        total = np.array(found_there)
    return total if np.sum(total) < DIVERGED else infinite
