"""The simulation-error problem: Krikelis et al. (2024), Eq. 20, over any number of recordings.

    minimise  1/2 mean(e²) + 1/2 Σ ((θ_i - m_i) / s_i)² v/R + l1 Σ |w|      e = (y_hat(θ) - y) / σ_y,
    subject to  lower <= θ <= upper,  lower_g <= g(θ) <= upper_g.

θ stacks the model's free parameters and, for each recording whose initial state is estimated, that state with the
element's memory. The mean runs over all R scored samples and outputs; `v` is the noise variance that the priors are
weighed against. Derivatives come from the sensitivity recursion; `normal` accumulates `JᵀJ` and `Jᵀe` over stretches
of the record, so memory does not grow with its length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..data import Recording, as_recordings
from ..engine import Engine, VirtualMachine, make_engine
from ..models import Model, Neighbours, ParameterSet, check_size
from .constraints import Constraint, Rows, check_gain


@dataclass(frozen=True)
class Part:
    """Recording with its place in the problem.

    Attributes
    ----------
    recording : Recording
        Its data.
    first : int or None
        The first of its variables, where its initial state is estimated.
    state : array, (n_state,)
        State at its first sample, before any periods that are run before.
    drive, warm_up : array
        Its inputs, and those of the periods run before it.
    scale : array, (n_y,)
        Divisors of the residuals.
    steady : bool
        Whether it begins at the fixed point of its period.
    """

    recording: Recording
    first: int | None
    state: np.ndarray
    drive: np.ndarray
    warm_up: np.ndarray
    scale: np.ndarray
    steady: bool = False


def lay_out(
    model: Model,
    recordings: Sequence[Recording],
    engine: Engine,
    at: int,
    periods: int | None,
    scales: Sequence[np.ndarray],
) -> Iterator[Part]:
    """Lay out each recording with its first state, which is a variable from index `at` on where it is estimated."""
    n_state = model.n_x + model.n_s
    for r, scale in zip(recordings, scales, strict=True):
        zero, drive = np.zeros(n_state), model.drive(r)
        nothing = drive[:0]
        if isinstance(r.initial, str):
            if r.begins == "zero":
                yield Part(r, None, zero, drive, nothing, scale)
            elif r.begins == "estimate":
                yield Part(r, at, zero, drive, nothing, scale)
                at += n_state
            else:
                if r.period is None:
                    raise InputError(
                        "A recording in periodic steady state needs its period in samples; give `period=`."
                    )
                one = drive[: r.period * model.substeps]
                warm_up = _periods_before(model, engine, one, periods)
                yield Part(r, None, zero, drive, warm_up, scale, periods is None)
        else:
            given = np.asarray(r.initial, dtype=float).ravel()
            if given.size not in (len(model.states), n_state):
                raise InputError(
                    f"An initial state of {given.size} numbers was given; expected {len(model.states)} or {n_state}."
                )
            yield Part(r, None, np.concatenate([given, zero[given.size :]]), drive, nothing, scale)


def _periods_before(model: Model, engine: Engine, one: np.ndarray, periods: int | None) -> np.ndarray:
    """Return the inputs of the periods before a recording: as many as the start model takes to settle, 2 to 50."""
    state = np.zeros(model.n_x + model.n_s)
    for count in range(1, 51 if periods is None else 1):
        before, state = state, engine.simulate(one, model.parameters.start, state)[1]
        if not np.all(np.isfinite(state)):
            break
        periods = max(count, 2)
        if np.max(np.abs(state - before), initial=0.0) <= 1e-6 * np.max(np.abs(state), initial=0.0):
            break
    return np.tile(one, (periods or 2, 1))


def checked_weights(given: Sequence[float] | np.ndarray | None, count: int) -> np.ndarray:
    """Return one weight above zero for each recording; ones where none are given."""
    weights = numbers(np.ones(count) if given is None else given, "A weight of a recording").ravel()
    if len(weights) != count or not np.all(weights > 0):
        raise InputError(
            f"{len(weights)} weights from {weights.min(initial=np.inf):g} were given for {count} recordings; give one "
            "above zero for each."
        )
    return weights


def output_scale(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the standard deviation of each output over all recordings, (n_y,)."""
    return np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)


class Penalties:
    """Quadratic and L1 terms that are added to the simulation error.

    Parameters
    ----------
    parameters : ParameterSet
        With their priors.
    l1 : mapping
        Weight of an L1 penalty by name.
    noise : float
        Standard deviation of the noise relative to the output's.
    residuals, size : int
        Number of residuals, and of variables: the free parameters come first, then the estimated initial states.
    states : sequence of (int, array)
        First variable and prior precision (n_state, n_state) of each initial state that has a prior around rest.

    Raises
    ------
    InputError
        If a parameter under an L1 penalty may be negative.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        l1: Mapping[str, float],
        noise: float,
        residuals: int,
        size: int,
        states: Sequence[tuple[int, np.ndarray]] = (),
    ) -> None:
        self.states = tuple((slice(at, at + len(square)), square / residuals) for at, square in states)
        weight, mean, slope = (np.zeros(parameters.size) for _ in range(3))
        for name, strength in l1.items():
            where = parameters.position(name)
            if np.any(parameters.lower[where] < 0):
                raise InputError(
                    f"An L1 penalty on {name!r} needs a lower bound of zero or more; bound it or use a prior."
                )
            slope[where] = strength
        for name, p in parameters.items():
            if p.prior is not None:
                where = parameters.position(name)
                mean[where] = np.broadcast_to(np.asarray(p.prior[0], dtype=float), p.value.shape).ravel(order="F")
                std = np.broadcast_to(np.asarray(p.prior[1], dtype=float), p.value.shape).ravel(order="F")
                weight[where] = noise**2 / std**2 / residuals
        pad = np.zeros(size - int(parameters.free.sum()))
        self.weight, self.mean, self.slope = (np.concatenate([a[parameters.free], pad]) for a in (weight, mean, slope))

    def value(self, theta: np.ndarray) -> float:
        """Sum of all terms."""
        value = float(0.5 * self.weight @ (theta - self.mean) ** 2 + self.slope @ theta)
        for part, square in self.states:
            value += 0.5 * float(theta[part] @ square @ theta[part])
        return value

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """Gradient of `value`, shape (n,)."""
        slope = np.asarray(self.weight * (theta - self.mean) + self.slope)
        for part, square in self.states:
            slope[part] += square @ theta[part]
        return slope

    @property
    def hessian(self) -> np.ndarray:
        """Hessian of `value`, shape (n, n)."""
        out = np.diag(self.weight)
        for part, square in self.states:
            out[part, part] += square
        return out


def state_precision(engine: Engine, drive: np.ndarray, p: np.ndarray, n_x: int, n_s: int) -> np.ndarray | None:
    """Prior precision (n_state, n_state) of an initial state with memory around rest, in units of the outputs.

    The state is taken from `N(0, S)` with the second moments S of the states that a run from rest on the same inputs
    passes through: an operator that such a run does not move begins at rest, and states and memories go together as
    they do in motion. The prior is weighed against errors of `STATE_NOISE` a sample.

    None where the run diverges, which says nothing.
    """
    state, found = np.zeros(n_x + n_s), []
    with np.errstate(over="ignore", invalid="ignore"):
        for piece in np.array_split(drive, min(STATE_SAMPLES, len(drive))):
            state = engine.simulate(piece, p, state)[1]
            found.append(state)
        moments = np.transpose(found) @ np.array(found) / len(found)
    if not np.all(np.isfinite(moments)):
        return None
    size = np.sqrt(np.diag(moments))
    for group in (slice(0, n_x), slice(n_x, None)):  # states, and memories
        largest = np.max(size[group], initial=0.0)
        size[group] = np.maximum(size[group], STILL_STATE * largest) if largest > 0 else 1.0
    together = moments / size / size[:, None] + CORRELATED * np.eye(len(size))
    return np.asarray(STATE_NOISE**2 * np.linalg.inv(together) / size / size[:, None])


# share of the outputs' deviation that a fitted model is trusted to: its errors change slowly, so the samples of a
# beginning are not independent; calibrated on fits of the rig, begun at rest and in motion (problems.initial_state)
STATE_NOISE = 0.2
STATE_SAMPLES = 256  # states along a run whose second moments are taken
STILL_STATE = 1e-3  # deviation of a state that does not move, next to the largest of its kind
CORRELATED = 1e-6  # variance left to each direction of the correlation matrix
Array = np.ndarray
SETTLED = 1e-10  # change over a period, relative to the largest entry of the state, that counts as none
NEARLY = 1e-6  # the same change, accepted when the periods run out
MOST, WAIT = 200, 10  # periods run at most; periods between two Newton steps
CHUNK = 512  # samples of a period whose slopes are kept in memory at a time


def settled(engine: Engine, period: Array, p: Array, state: Array, tolerance: float = SETTLED) -> Array:
    """Find the state at the beginning of a steady period; not finite where none is reached.

    Periods are run from the given state; for slow poles, where that takes long, Newton's rule on `x = Φ(x)` helps.
    A period does not determine the memory of operators that never slip in it: that keeps its given value.
    """
    change, size = np.inf, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, MOST + 1):
            before, state = state, engine.simulate(period, p, state)[1]
            change, size = np.max(np.abs(state - before), initial=0.0), np.max(np.abs(state), initial=1e-300)
            if not np.isfinite(change) or change <= tolerance * size:
                return state
            if k % WAIT == 0:
                state = _leap(engine, period, p, state)
    return state if change <= NEARLY * size else np.full_like(state, np.nan)


def _leap(engine: Engine, period: Array, p: Array, state: Array) -> Array:
    """Take one Newton step towards the fixed point of a period if that brings it nearer, else run one period."""
    after, slope = state, np.eye(len(state))
    rows = CHUNK * engine.linear.substeps
    for a in range(0, len(period), rows):
        _, _, after, slope = engine.sensitivity(period[a : a + rows], p, after, slope, np.full(len(p), -1))
    if not np.all(np.isfinite(slope)):
        return after
    try:
        there = state + steady_slope(np.hstack([(after - state)[:, None], slope]), 1)[:, 0]
    except np.linalg.LinAlgError:
        return after
    behind = engine.simulate(period, p, there)[1]
    return there if np.max(np.abs(behind - there)) < np.max(np.abs(after - state)) else after


def steady_slope(after: Array, n: int) -> Array:
    """`(I - Φ_x)^-1 Φ_θ` from the slope behind one period, columns of θ (n) first: shape (n_state, n).

    Memory that nothing moves in a whole period stays where it is: it has no slope.
    """
    size = len(after)
    matrix, right = np.eye(size) - after[:, n:], after[:, :n].copy()
    still = np.max(np.abs(matrix), axis=1, initial=0.0) <= 1e-12
    matrix[still, still], right[still] = 1.0, 0.0
    return np.linalg.solve(matrix, right) if size else right


@dataclass
class Pass:
    """Run of one recording with derivatives.

    Parameters
    ----------
    seed : array, (n_state, n_c)
        Slope of the first state.
    """

    engine: Engine
    part: Part
    p: Array
    columns: Array
    state: Array
    seed: Array
    length: int
    after_period: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def stretches(self, substeps: int) -> Iterator[tuple[Array, Array]]:
        """Residuals (R_b,) and their Jacobian (R_b, n_c), behind the periods that are run before the recording."""
        part, r, n = self.part, self.part.recording, substeps
        state, seed = self.state, self.seed
        if not part.steady:
            for a in range(0, len(part.warm_up), self.length * n):
                rows = part.warm_up[a : a + self.length * n]
                _, _, state, seed = self.engine.sensitivity(rows, self.p, state, seed, self.columns)
        a, period = 0, r.period or len(r)
        while a < len(r):
            b = min(a + self.length, len(r), period if a < period else len(r))
            y, jac, state, seed = self.engine.sensitivity(part.drive[a * n : b * n], self.p, state, seed, self.columns)
            if b == period:
                self.after_period = seed.copy()
            cut = min(max(r.skip - a, 0), b - a)
            e = ((y - r.y[a:b]) / part.scale)[cut:].ravel()
            jac /= part.scale[:, None]
            yield e, jac[cut:].reshape(e.size, jac.shape[2])
            a = b


def sums(run: Pass, substeps: int) -> tuple[float, Array, Array]:
    """Accumulate `e'e`, `J'e` and `J'J` over a recording, for the columns of the seed."""
    n_c = run.seed.shape[1]
    value, gradient, hessian = 0.0, np.zeros(n_c), np.zeros((n_c, n_c))
    for e, jac in run.stretches(substeps):
        value += float(e @ e)
        gradient += e @ jac
        hessian += jac.T @ jac
    return value, gradient, hessian


def steady_sums(run: Pass, substeps: int, n: int) -> tuple[float, Array, Array]:
    """`sums` over a recording in periodic steady state for the n columns of θ; the seed is `[0 I]`."""
    value, gradient, hessian = sums(run, substeps)
    if not np.all(np.isfinite(run.after_period)):
        return np.inf, np.full(n, np.nan), np.full((n, n), np.nan)
    total = np.vstack([np.eye(n), steady_slope(run.after_period, n)])
    return value, total.T @ gradient, total.T @ hessian @ total


STRETCH = 2_000_000  # entries of the Jacobian kept in memory at a time (16 MB)


class Problem:
    """Minimise the simulation error of a closed model over recordings.

    Parameters
    ----------
    model : Model
        Closed model; its parameters give start, bounds and what is fixed.
    recordings : Recording or sequence of Recording
        Data, with their initial states.
    engine : {"auto", "c", "vm"}
        How the model is run.
    constraints : sequence of Constraint
        Further constraints on the named parameters.
    l1 : dict
        Weight of the absolute sum of non-negative parameters by name, for example `{"w": 1e-4}`.
    noise : float
        Standard deviation of the noise relative to the output's, against which priors are weighed.
    periods : int, optional
        Periods run before a recording in periodic steady state; by default the state is the fixed point of a period.
    weights : sequence of float, optional
        One a recording: its residuals are multiplied by it (see `periods.noise_weights`). The mean stays one over R.
    threads : int
        Recordings that are run at a time, where the engine is compiled; the numbers are the same.

    Raises
    ------
    InputError
        If model and recordings do not fit each other, or nothing is left to estimate.
    """

    def __init__(
        self,
        model: Model,
        recordings: Recording | Sequence[Recording],
        *,
        engine: str | Engine = "auto",
        constraints: Sequence[Constraint] = (),
        l1: dict[str, float] | None = None,
        noise: float = 1.0,
        periods: int | None = None,
        scale: np.ndarray | None = None,
        weights: Sequence[float] | np.ndarray | None = None,
        threads: int = 1,
    ) -> None:
        self.model = model
        self.recordings = as_recordings(recordings)
        self.engine = make_engine(model, engine) if isinstance(engine, str) else engine
        self.constraints = tuple(constraints)
        check_gain(self.constraints, model.element)
        parameters = model.parameters
        self._base = parameters.start
        self.free = parameters.free
        n_free = int(self.free.sum())
        for r in self.recordings:
            if r.n_u != len(model.inputs) or r.n_y != model.n_y:
                raise InputError(
                    f"The recording has {r.n_u} inputs and {r.n_y} outputs, "
                    f"the model {len(model.inputs)} and {model.n_y}; they must match."
                )
        self.scale = output_scale(self.recordings) if scale is None else np.asarray(scale, dtype=float)
        self.weights = checked_weights(weights, len(self.recordings))
        self.threads = 1 if isinstance(self.engine, VirtualMachine) else threads
        scales = [self.scale / weight for weight in self.weights]
        self._parts = list(lay_out(model, self.recordings, self.engine, n_free, periods, scales))
        self._residuals = sum((len(p.recording) - p.recording.skip) * model.n_y for p in self._parts)
        n_state = model.n_x + model.n_s
        n_initial = sum(n_state for p in self._parts if p.first is not None)
        self.labels = tuple(np.array(parameters.labels, dtype=object)[self.free]) + tuple(
            f"initial[{i}].{k}" for i, p in enumerate(self._parts) if p.first is not None for k in range(n_state)
        )
        unbounded = np.full(n_initial, np.inf)
        self.lower = np.concatenate([parameters.lower[self.free], -unbounded])
        self.upper = np.concatenate([parameters.upper[self.free], unbounded])
        states = [p.state for p in self._parts if p.first is not None]
        self.start = np.concatenate([parameters.start[self.free], *states])
        if self.size == 0:
            raise InputError("Every parameter is fixed and no initial state is estimated; free at least one parameter.")
        check_size("A problem", self.size)
        self._columns = np.where(self.free, np.cumsum(self.free) - 1, -1)
        self.noise = noise
        self.l1 = dict(l1 or {})
        self.penalties = Penalties(parameters, self.l1, noise, self._residuals, self.size)
        self.rows = Rows(self.constraints, parameters)
        self.g_lower, self.g_upper, self.g_labels = self.rows.lower, self.rows.upper, self.rows.labels
        self.g_sizes = self.rows.sizes

    @property
    def size(self) -> int:
        """Number of variables."""
        return len(self.start)

    @property
    def residuals(self) -> int:
        """Number of scored residuals R."""
        return self._residuals

    def parameters(self, theta: np.ndarray) -> np.ndarray:
        """The model's full parameter vector (n_p,) at θ."""
        p = self._base.copy()
        p[self.free] = theta[: int(self.free.sum())]
        return p

    def initial_states(self, theta: np.ndarray) -> list[np.ndarray]:
        """State with memory from which each recording is run (before any warm-up periods)."""
        n = self.model.n_x + self.model.n_s
        return [p.state if p.first is None else theta[p.first : p.first + n] for p in self._parts]

    def first_states(self, theta: np.ndarray) -> list[np.ndarray]:
        """State with memory at each recording's first sample, the warm-up periods behind it."""
        p = self.parameters(theta)

        def first(pair: tuple[Part, np.ndarray]) -> np.ndarray:
            part, state = pair
            if part.steady:
                one = part.drive[: (part.recording.period or 1) * self.model.substeps]
                return settled(self.engine, one, p, state)
            return self.engine.simulate(part.warm_up, p, state)[1] if len(part.warm_up) else state

        return self._each(first, list(zip(self._parts, self.initial_states(theta), strict=True)))

    def _each(self, function: Any, items: Sequence[Any]) -> list[Any]:
        """Map the function over the items, a few at a time."""
        if self.threads == 1 or len(items) == 1:
            return [function(item) for item in items]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(function, items))

    def simulate(self, theta: np.ndarray) -> list[np.ndarray]:
        """Simulate all recordings: outputs, one (M, n_y) array each."""
        p, states = self.parameters(theta), self.first_states(theta)
        pairs = [(part.drive, state) for part, state in zip(self._parts, states, strict=True)]
        return self._each(lambda pair: self.engine.simulate(pair[0], p, pair[1])[0], pairs)

    def residual(self, theta: np.ndarray) -> np.ndarray:
        """Normalised residuals `(y_hat - y) / σ_y` of all scored samples, shape (R,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            pairs = zip(self._parts, self.simulate(theta), strict=True)
            return np.concatenate([((y - p.recording.y) / p.scale)[p.recording.skip :].ravel() for p, y in pairs])

    def cost(self, theta: np.ndarray) -> float:
        """Return the objective; infinite where the simulation diverges."""
        e = self.residual(theta)
        with np.errstate(over="ignore", invalid="ignore"):
            value = 0.5 * float(e @ e) / self._residuals + self.penalties.value(theta)
        return value if np.isfinite(value) else np.inf

    def _pass(self, part: Part, theta: np.ndarray, state: np.ndarray, slopes: np.ndarray | None = None) -> Pass:
        """A run with derivatives by the free parameters and, without `slopes` of a steady state, by the first state."""
        n_free, n_state = int(self.free.sum()), self.model.n_x + self.model.n_s
        if slopes is None:
            wide = part.first is not None or part.steady
            slopes = np.hstack([np.zeros((n_state, n_free)), np.eye(n_state)[:, : n_state * wide]])
        length = max(1, STRETCH // max(1, slopes.shape[1] * self.model.n_y))
        return Pass(self.engine, part, self.parameters(theta), self._columns, state, slopes, length)

    def _places(self, part: Part) -> np.ndarray:
        """Variables that the columns of a recording's Jacobian belong to."""
        shared = np.arange(int(self.free.sum()))
        if part.first is None:
            return shared
        return np.concatenate([shared, part.first + np.arange(self.model.n_x + self.model.n_s)])

    def stretches(self, theta: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Residuals (R_b,), their Jacobian (R_b, n_c) and its columns in θ, stretch by stretch of each recording."""
        n = self.model.substeps
        for part, state in zip(self._parts, self._begin(theta), strict=True):
            run = self._pass(part, theta, state)
            if part.steady:
                for _ in run.stretches(n):
                    if run.after_period.size:
                        break
                slopes = steady_slope(run.after_period, int(self.free.sum()))
                run = self._pass(part, theta, state, slopes)
            for e, jac in run.stretches(n):
                yield e, jac, self._places(part)

    def _begin(self, theta: np.ndarray) -> list[np.ndarray]:
        """State from which each recording is run with derivatives: in steady state its first, else before warm-up."""
        if not any(part.steady for part in self._parts):
            return self.initial_states(theta)
        pairs = zip(self._parts, self.initial_states(theta), self.first_states(theta), strict=True)
        return [settled_state if part.steady else state for part, state, settled_state in pairs]

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Jacobian of `residual`, shape (R, size)."""
        out, at = np.zeros((self._residuals, self.size)), 0
        for e, jac, columns in self.stretches(theta):
            out[at : at + e.size, columns] = jac
            at += e.size
        return out

    def normal(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the objective, its gradient and Gauss-Newton Hessian at θ."""
        n_free, n = int(self.free.sum()), self.model.substeps

        def of(pair: tuple[Part, np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
            with np.errstate(over="ignore", invalid="ignore"):  # a diverging simulation gives an infinite value
                run = self._pass(pair[0], theta, pair[1])
                return steady_sums(run, n, n_free) if pair[0].steady else sums(run, n)

        value, gradient, hessian = 0.0, np.zeros(self.size), np.zeros((self.size, self.size))
        found = self._each(of, list(zip(self._parts, self._begin(theta), strict=True)))
        with np.errstate(over="ignore", invalid="ignore"):
            for part, (more, slope, square) in zip(self._parts, found, strict=True):
                columns = self._places(part)
                value += more
                gradient[columns] += slope
                hessian[np.ix_(columns, columns)] += square
        m = self._residuals
        gradient = gradient / m + self.penalties.gradient(theta)
        return 0.5 * value / m + self.penalties.value(theta), gradient, hessian / m + self.penalties.hessian

    def constraint(self, theta: np.ndarray) -> np.ndarray:
        """Return the values g(θ) of the general constraints."""
        return self.rows.values(self.parameters(theta))

    def constraint_jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Jacobian of `constraint`, shape (n_g, size)."""
        jac = np.zeros((len(self.g_lower), self.size))
        if len(jac):
            jac[:, : int(self.free.sum())] = self.rows.slope(self.parameters(theta))[:, self.free]
        return jac

    def constraint_units(self, theta: np.ndarray, squares: np.ndarray | None = None) -> np.ndarray:
        """Return a change of each general constraint that counts, shape (n_g,): as given, else from its variables.

        The largest change that one variable brings about which moves by its size (`magnitude`) or, where that is zero,
        by what changes the outputs by their own size, `squares` (size,) being the diagonal of the Gauss-Newton Hessian.
        Zero where the constraint has no slope.
        """
        size = Neighbours(self.labels).sizes(theta)
        still = np.ones(self.size) if squares is None else 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))
        change = np.abs(self.constraint_jacobian(theta)) * np.where(size > 0, size, still)
        return self.rows.units_from(np.max(change, axis=1, initial=0.0))

    def active_constraints(self, theta: np.ndarray, tolerance: float = 1e-7) -> np.ndarray:
        """Which general constraints are at a limit, or beyond, up to a share of their unit: (n_g,), bool."""
        if not len(self.g_lower):
            return np.zeros(0, dtype=bool)
        g, unit = self.constraint(theta), self.constraint_units(theta)
        slack = tolerance * np.where(unit > 0, unit, 1.0)
        return (g >= self.g_upper - slack) | (g <= self.g_lower + slack)

    def to_nlp(self) -> Horizon:
        """The problem written out over the horizon as CasADi expressions, to add costs and constraints of one's own.

        Returns
        -------
        Horizon
            What `casadi.nlpsol` takes (`x, f, g`, bounds, start), with residual, simulated outputs and named
            parameters.
        """
        return to_nlp(self)

    def nrmse(self, theta: np.ndarray) -> list[float]:
        """NRMSE of each recording (Eq. 27, averaged over outputs); a resting output counts next to all recordings'."""
        out = []
        for part, y in zip(self._parts, self.simulate(theta), strict=True):
            measured = part.recording.y[part.recording.skip :]
            error, spread = y[part.recording.skip :] - measured, np.std(measured, axis=0)
            rests = spread <= 1e-14 * np.max(np.abs(measured), axis=0)
            size = np.where(rests, self.scale, spread)
            out.append(float(np.mean(np.sqrt(np.mean(error**2, axis=0)) / size)))
        return out


@dataclass(frozen=True, eq=False)
class Horizon:
    """A problem as CasADi expressions of its variables θ, in the words of `casadi.nlpsol`.

    Attributes
    ----------
    x : casadi.MX
        Variables θ, shape (n,), laid out as `Problem.labels`.
    f : casadi.MX
        Cost, equal to `Problem.cost`.
    g : casadi.MX
        General constraints, shape (n_g,).
    x0, lbx, ubx : array, shape (n,)
        Start and bounds of θ.
    lbg, ubg : array, shape (n_g,)
        Bounds of g.
    residual : casadi.MX
        Normalised residuals of the scored samples, shape (R,).
    simulated : tuple of casadi.MX
        Simulated outputs of each recording, one column a sample, shape (n_y, M), in the recording's units.
    initial : tuple of casadi.MX
        State with the element's memory before each recording; where it is periodic, before the periods that the start
        model takes to settle, which are written out before it.
    parameters : mapping of str to casadi.MX
        The model's parameters by name, fixed ones as numbers.
    """

    x: ca.MX
    f: ca.MX
    g: ca.MX
    x0: np.ndarray
    lbx: np.ndarray
    ubx: np.ndarray
    lbg: np.ndarray
    ubg: np.ndarray
    residual: ca.MX
    simulated: tuple[ca.MX, ...]
    initial: tuple[ca.MX, ...]
    parameters: Mapping[str, ca.MX]


def to_nlp(problem: Problem) -> Horizon:
    """Write a problem out over the horizon; see `Horizon` and `Problem.to_nlp`."""
    model = problem.model
    theta = ca.MX.sym("theta", problem.size)
    n_free, n_state = int(problem.free.sum()), model.n_x + model.n_s
    p = ca.MX(ca.DM(problem.parameters(problem.start)))
    if n_free:
        p[np.flatnonzero(problem.free).tolist()] = theta[:n_free]
    simulated, residual, initial = [], [], []
    for part in problem._parts:
        state = ca.MX(ca.DM(part.state)) if part.first is None else theta[part.first : part.first + n_state]
        r = part.recording
        u = np.concatenate([part.warm_up, part.drive])
        _, y = model.closed.mapaccum("run", len(u))(state, u.T, ca.repmat(p, 1, len(u)))
        y = y[:, len(part.warm_up) :: model.substeps]
        initial.append(state)
        simulated.append(y)
        residual.append(ca.vec(((y - r.y.T) / np.tile(part.scale[:, None], (1, len(r))))[:, r.skip :]))
    e = ca.vertcat(*residual)
    prior = 0.5 * ca.dot(problem.penalties.weight, (theta - problem.penalties.mean) ** 2)
    return Horizon(
        x=theta,
        f=0.5 * ca.sumsqr(e) / problem.residuals + prior + ca.dot(problem.penalties.slope, theta),
        g=problem.rows.function(p),
        x0=problem.start,
        lbx=problem.lower,
        ubx=problem.upper,
        lbg=problem.g_lower,
        ubg=problem.g_upper,
        residual=e,
        simulated=tuple(simulated),
        initial=tuple(initial),
        parameters=model.parameters.symbols(p),
    )
