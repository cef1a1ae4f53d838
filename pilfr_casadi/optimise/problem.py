"""The simulation-error problem: Krikelis et al. (2024), Eq. 20, over any number of recordings.

    minimise  1/2 mean(e²) + 1/2 Σ ((θ_i - m_i) / s_i)² v/R + l1 Σ |w|      e = (y_hat(θ) - y) / σ_y,
    subject to  lower <= θ <= upper,  lower_g <= g(θ) <= upper_g.

θ stacks the model's free parameters and, for each recording whose initial state is estimated, that state with the
element's memory, entries that begin alike once (`Model.begin_alike`). The mean runs over all R scored samples and
outputs; `v` is the noise variance that the priors are weighed against. Derivatives come from the sensitivity recursion;
`normal` accumulates `JᵀJ` and `Jᵀe` over stretches of the record, so memory does not grow with its length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from .._base import InputError, numbers, side_by_side
from ..data import Recording, as_recordings, nrmse
from ..engine import Engine, VirtualMachine, make_engine
from ..models import Model, Neighbours, check_size, or_one
from .constraints import Constraint, Rows, check_gain
from .penalties import Penalties, state_covariance
from .steady_state import NEARLY_STEADY, steady_slope, steady_state

Array = np.ndarray
T = TypeVar("T")
MOST_WRITTEN_PERIODS = 50  # most periods that `to_nlp` writes out before a recording in steady state
AT_LIMIT = 1e-7  # distance from a limit, in units of a constraint, up to which the constraint is active
STRETCH_ENTRIES = 2_000_000  # entries of the Jacobian kept in memory at a time (16 MB)


@dataclass(frozen=True)
class PlacedRecording:
    """Recording with its place in the problem.

    `first` is the index of its first variable, or None unless its initial state is estimated; `state` (n_state,) its
    first state; `drive` its inputs; `scale` (n_y,) the divisors of its residuals; `scored` the mask of the samples that
    count, None for all. `steady` tells whether it begins in the steady state of its period, of `period` drive rows.
    """

    recording: Recording
    first: int | None
    state: Array
    drive: Array
    scale: Array
    steady: bool
    period: int
    scored: Array | None = None

    @property
    def count(self) -> int:
        """Number of scored samples."""
        skip = self.recording.skip
        return len(self.recording) - skip if self.scored is None else int(np.sum(self.scored[skip:]))

    def rows(self, a: int, b: int) -> slice | Array:
        """Select the scored samples among those from a to b; indices count from a."""
        cut = min(max(self.recording.skip - a, 0), b - a)
        return slice(cut, b - a) if self.scored is None else cut + np.flatnonzero(self.scored[a + cut : b])


def place_recordings(
    model: Model, recordings: Sequence[Recording], at: int, scales: Sequence[Array]
) -> Iterator[PlacedRecording]:
    """Place each recording in the problem; an estimated first state takes the variables from index `at` on."""
    for r, scale in zip(recordings, scales, strict=True):
        steady, estimated = r.begins == "periodic", r.begins == "estimate"
        if steady and r.period is None:
            raise InputError("A recording in periodic steady state needs its period in samples; give `period=`.")
        period = (r.period or len(r)) * model.substeps
        yield PlacedRecording(r, at if estimated else None, model.first_state(r), model.drive(r), scale, steady, period)
        at += estimated * model.initial_basis.shape[1]


def check_weights(given: Sequence[float] | Array | None, count: int) -> Array:
    """Return one weight above zero for each recording; ones where none are given."""
    weights = numbers(np.ones(count) if given is None else given, "A weight of a recording").ravel()
    if len(weights) != count or not np.all(weights > 0):
        raise InputError(
            f"{len(weights)} weights from {weights.min(initial=np.inf):g} were given for {count} recordings; give one "
            "above zero for each."
        )
    return weights


class Problem:
    """Minimise the simulation error of a closed model over recordings.

    Parameters
    ----------
    model : Model
        Closed model; its parameters give the start, the bounds and the fixed entries.
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
    scale : array, (n_y,), optional
        Divisors of the residuals; by default the outputs' standard deviations over all recordings.
    weights : sequence of float, optional
        One per recording, which multiplies its residuals (see `periods.noise_weights`). The mean still divides by R.
    scored : sequence of bool array (M,), optional
        One per recording: the samples after `skip` whose errors count. All samples are simulated.

    Attributes
    ----------
    threads : int
        Recordings run at a time if the engine is compiled (default 1); the numbers do not depend on it.

    Raises
    ------
    InputError
        If model and recordings do not fit each other, or the problem has no variable.
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
        scale: Array | None = None,
        weights: Sequence[float] | Array | None = None,
        scored: Sequence[Array] | None = None,
    ) -> None:
        self.model, parameters = model, model.parameters
        self.recordings = as_recordings(recordings)
        self.engine = make_engine(model, engine) if isinstance(engine, str) else engine
        self.threads = 1
        check_gain(constraints, model.element)
        self._base, self.free, self.n_free = parameters.start, parameters.free, int(parameters.free.sum())
        for r in self.recordings:
            if r.n_u != len(model.inputs) or r.n_y != model.n_y:
                raise InputError(
                    f"The recording has {r.n_u} inputs and {r.n_y} outputs, "
                    f"the model {len(model.inputs)} and {model.n_y}; they must match."
                )
        own = np.std(np.concatenate([r.y[r.skip :] for r in self.recordings]), axis=0)
        self.scale = own if scale is None else np.asarray(scale, dtype=float)
        self.weights = check_weights(weights, len(self.recordings))
        scales = [self.scale / weight for weight in self.weights]
        self._placed = list(place_recordings(model, self.recordings, self.n_free, scales))
        if scored is not None:
            self._placed = [replace(p, scored=keep) for p, keep in zip(self._placed, scored, strict=True)]
        self.residuals = sum(p.count for p in self._placed) * model.n_y  # number of scored residuals R
        self._basis = model.initial_basis
        states = [model.initial_unknowns(p.state) for p in self._placed if p.first is not None]
        self.labels = tuple(np.array(parameters.labels, dtype=object)[self.free]) + tuple(
            f"initial[{i}].{k}"
            for i, p in enumerate(self._placed)
            if p.first is not None
            for k in range(self._basis.shape[1])
        )
        unbounded = np.full(self._basis.shape[1] * len(states), np.inf)
        self.lower = np.concatenate([parameters.lower[self.free], -unbounded])
        self.upper = np.concatenate([parameters.upper[self.free], unbounded])
        self.start = np.concatenate([parameters.start[self.free], *states])
        if self.size == 0:
            raise InputError("Every parameter is fixed and no initial state is estimated; free at least one parameter.")
        check_size("A problem", self.size)
        self._columns = np.where(self.free, np.cumsum(self.free) - 1, -1)
        self.l1, self.noise = dict(l1 or {}), noise
        self.penalties = Penalties(parameters, self.l1, noise, self.residuals, self.size)
        self._constrain(tuple(constraints))

    def _constrain(self, constraints: tuple[Constraint, ...]) -> None:
        """Set the constraints, with the names, limits and entries of their rows in g."""
        self.constraints = constraints
        self.rows = Rows(constraints, self.model.parameters)
        self.g_lower, self.g_upper, self.g_labels = self.rows.lower, self.rows.upper, self.rows.labels
        self.g_sizes = self.rows.sizes
        self.g_slices = [slice(a, b) for a, b in pairwise(np.cumsum([0, *self.g_sizes]))]
        self.g_exact = np.repeat([c.exact for c in constraints], self.g_sizes).astype(bool)

    def with_constraints(self, constraints: Sequence[Constraint]) -> Problem:
        """Return the same problem under other constraints."""
        other = copy(self)
        other._constrain(tuple(constraints))
        return other

    def state_priors(self, theta: Array, own: int) -> list[tuple[Array, Array]]:
        """Compute each estimated initial state beyond its first `own` entries, from rest, and its prior covariance.

        See `state_covariance`. Memories of operators are left out: an operator cannot hold more than its signal has
        given it. So are states whose run from rest at the parameters in θ diverges.
        """
        p, n_x, n = self.parameters(theta), self.model.n_x, self.model.n_state
        out = []
        for part, state in zip(self._placed, self.initial_states(theta), strict=True):
            covariance = None if part.first is None else state_covariance(self.engine, part.drive, p, n_x, n - n_x)
            if covariance is not None:
                moved = state - self.model.rest_at(state[:own], part.recording.u[0], p)
                out.append((moved[own:n_x], covariance[own:n_x, own:n_x]))
        return out

    @property
    def size(self) -> int:
        """Number of variables."""
        return len(self.start)

    def variables(self, free: Array, states: Sequence[Array]) -> Array:
        """Return θ from the free parameters and each recording's initial state; known states are ignored."""
        own = zip(self._placed, states, strict=True)
        unknown = (self.model.initial_unknowns(state) for part, state in own if part.first is not None)
        return np.concatenate([free, *unknown])

    def parameters(self, theta: Array) -> Array:
        """Return the model's full parameter vector (n_p,) at θ."""
        p = self._base.copy()
        p[self.free] = theta[: self.n_free]
        return p

    def values(self, theta: Array) -> dict[str, Array]:
        """Return the model's parameters at θ by name."""
        return self.model.parameters.unpack(self.parameters(theta))

    def initial_states(self, theta: Array) -> list[Array]:
        """Return the initial state with memory of each recording.

        For a recording in steady state it is the state from which periods are run until they repeat.
        """
        n = self._basis.shape[1]
        return [p.state if p.first is None else self._basis @ theta[p.first : p.first + n] for p in self._placed]

    def first_states(self, theta: Array) -> list[Array]:
        """Return the state with memory at each recording's first sample."""
        p = self.parameters(theta)

        def first(part: PlacedRecording, state: Array) -> Array:
            return steady_state(self.engine, part.drive[: part.period], p, state) if part.steady else state

        return self._map(first, self._placed, self.initial_states(theta))

    def _map(self, function: Callable[..., T], *items: Sequence[Any]) -> list[T]:
        """Map the function over the items, a few at a time."""
        if self.threads == 1 or len(items[0]) == 1 or isinstance(self.engine, VirtualMachine):
            return list(map(function, *items))
        return side_by_side(lambda arguments: function(*arguments), zip(*items, strict=True), self.threads)

    def simulate(self, theta: Array) -> list[Array]:
        """Simulate the outputs of all recordings, one (M, n_y) array per recording."""
        p = self.parameters(theta)
        drives = [part.drive for part in self._placed]
        return self._map(lambda u, x: self.engine.simulate(u, p, x)[0], drives, self.first_states(theta))

    def residual(self, theta: Array) -> Array:
        """Compute the normalised residuals `(y_hat - y) / σ_y` of all scored samples, shape (R,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            pairs = zip(self._placed, self.simulate(theta), strict=True)
            return np.concatenate([((y - p.recording.y) / p.scale)[p.rows(0, len(y))].ravel() for p, y in pairs])

    def cost(self, theta: Array) -> float:
        """Return the objective; infinite where the simulation diverges."""
        e = self.residual(theta)
        with np.errstate(over="ignore", invalid="ignore"):
            value = 0.5 * float(e @ e) / self.residuals + self.penalties.value(theta)
        return value if np.isfinite(value) else np.inf

    def _first_slope(self, part: PlacedRecording) -> Array:
        """Return the slope of a recording's first state by the free parameters and, if it is unknown, by itself."""
        n_state = self.model.n_state
        own = np.eye(n_state) if part.steady else self._basis if part.first is not None else np.zeros((n_state, 0))
        return np.hstack([np.zeros((n_state, self.n_free)), own])

    def _run(
        self, part: PlacedRecording, theta: Array, state: Array, slope: Array
    ) -> Iterator[tuple[Array, Array, Array | None]]:
        """Run one recording: yield residuals (R_b,), their Jacobian (R_b, n_c) and the state's slope after a period.

        The run begins at a state with its slope (n_state, n_c). Except after the first period the last item is None.
        """
        r, n, p = part.recording, self.model.substeps, self.parameters(theta)
        length = max(1, STRETCH_ENTRIES // max(1, slope.shape[1] * self.model.n_y))
        a, period = 0, part.period // n
        while a < len(r):
            b = min(a + length, len(r), period if a < period else len(r))
            y, jac, state, slope = self.engine.sensitivity(part.drive[a * n : b * n], p, state, slope, self._columns)
            rows = part.rows(a, b)
            e = ((y - r.y[a:b]) / part.scale)[rows].ravel()
            jac /= part.scale[:, None]
            yield e, jac[rows].reshape(e.size, jac.shape[2]), slope if b == period else None
            a = b

    def _variables(self, part: PlacedRecording) -> Array:
        """Return the variables that the columns of a recording's Jacobian belong to."""
        shared = np.arange(self.n_free)
        return shared if part.first is None else np.append(shared, part.first + np.arange(self._basis.shape[1]))

    def stretches(self, theta: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Yield residuals (R_b,), their Jacobian (R_b, n_c) and its columns in θ for each stretch of each recording."""
        for part, state in zip(self._placed, self.first_states(theta), strict=True):
            slope = self._first_slope(part)
            if part.steady:
                run = self._run(part, theta, state, slope)
                slope = steady_slope(next(after for *_, after in run if after is not None), self.n_free)
            for e, jac, _ in self._run(part, theta, state, slope):
                yield e, jac, self._variables(part)

    def jacobian(self, theta: Array) -> Array:
        """Compute the Jacobian of `residual`, shape (R, size)."""
        out, at = np.zeros((self.residuals, self.size)), 0
        for e, jac, columns in self.stretches(theta):
            out[at : at + e.size, columns] = jac
            at += e.size
        return out

    def _accumulate(self, part: PlacedRecording, theta: Array, state: Array) -> tuple[float, Array, Array]:
        """Accumulate `e'e`, `J'e` and `J'J` over a recording."""
        slope, n = self._first_slope(part), self.n_free
        n_c, after = slope.shape[1], slope
        value, gradient, hessian = 0.0, np.zeros(n_c), np.zeros((n_c, n_c))
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging simulation gives an infinite value
            for e, jac, slope_after in self._run(part, theta, state, slope):
                value += float(e @ e)
                gradient += e @ jac
                hessian += jac.T @ jac
                after = after if slope_after is None else slope_after
            if not part.steady:
                return value, gradient, hessian
            if not np.all(np.isfinite(after)):
                return np.inf, np.full(n, np.nan), np.full((n, n), np.nan)
            total = np.vstack([np.eye(n), steady_slope(after, n)])
            return value, total.T @ gradient, total.T @ hessian @ total

    def normal(self, theta: Array) -> tuple[float, Array, Array]:
        """Return the objective, its gradient and Gauss-Newton Hessian at θ."""
        value, gradient, hessian = 0.0, np.zeros(self.size), np.zeros((self.size, self.size))
        found = self._map(lambda part, x: self._accumulate(part, theta, x), self._placed, self.first_states(theta))
        with np.errstate(over="ignore", invalid="ignore"):
            for part, (more, slope, square) in zip(self._placed, found, strict=True):
                columns = self._variables(part)
                value += more
                gradient[columns] += slope
                hessian[np.ix_(columns, columns)] += square
        m = self.residuals
        gradient = gradient / m + self.penalties.gradient(theta)
        return 0.5 * value / m + self.penalties.value(theta), gradient, hessian / m + self.penalties.hessian

    def constraint(self, theta: Array) -> Array:
        """Return the values g(θ) of the general constraints."""
        return self.rows.values(self.parameters(theta))

    def excess(self, theta: Array) -> Array:
        """Return how far each general constraint lies outside its limits, (n_g,); negative inside."""
        g = self.constraint(theta)
        return np.asarray(np.maximum(self.g_lower - g, g - self.g_upper))

    def constraint_jacobian(self, theta: Array) -> Array:
        """Compute the Jacobian of `constraint`, shape (n_g, size)."""
        jac = np.zeros((len(self.g_lower), self.size))
        if len(jac):
            jac[:, : self.n_free] = self.rows.slope(self.parameters(theta))[:, self.free]
        return jac

    def constraint_units(self, theta: Array, squares: Array | None = None) -> Array:
        """Return the unit in which the violation of each general constraint is judged, shape (n_g,).

        By default it is the largest change that one variable causes when it moves by its size (`Neighbours`). A
        variable of size zero moves by the step that changes the outputs by their own size, according to `squares`
        (size,), the diagonal of the Gauss-Newton Hessian. The unit is zero if the constraint has no slope.
        """
        size = Neighbours(self.labels).sizes(theta)
        still = np.ones(self.size) if squares is None else 1.0 / np.sqrt(or_one(squares))
        change = np.abs(self.constraint_jacobian(theta)) * np.where(size > 0, size, still)
        return self.rows.units_from(np.max(change, axis=1, initial=0.0))

    def active_constraints(self, theta: Array) -> Array:
        """Tell which general constraints are at or beyond a limit, within `AT_LIMIT` of their unit: (n_g,), bool."""
        g, unit = self.constraint(theta), self.constraint_units(theta)
        slack = AT_LIMIT * or_one(unit)
        return (g >= self.g_upper - slack) | (g <= self.g_lower + slack)

    def nrmse(self, theta: Array) -> list[float]:
        """Compute the NRMSE of each recording (Eq. 27, averaged over outputs).

        An output that rests in a recording is scaled by its deviation over all recordings.
        """
        pairs = zip(self.recordings, self.simulate(theta), strict=True)
        return [nrmse(r.y, y, r.skip, self.scale) for r, y in pairs]

    def to_nlp(self) -> Horizon:
        """Write the problem as CasADi expressions over the whole horizon; you can add costs and constraints to them.

        A recording in periodic steady state follows as many periods as the start model needs to settle.

        Returns
        -------
        Horizon
            Arguments of `casadi.nlpsol` (`x, f, g`, bounds, start), with residual, simulated outputs and named
            parameters.
        """
        model, theta = self.model, ca.MX.sym("theta", self.size)
        p = ca.MX(ca.DM(model.parameters.start))
        if self.n_free:
            p[np.flatnonzero(self.free).tolist()] = theta[: self.n_free]
        simulated, residual, initial = [], [], []
        for part in self._placed:
            first, r = part.first, part.recording
            unknown = slice(first, (first or 0) + self._basis.shape[1])
            state = ca.MX(ca.DM(part.state)) if first is None else ca.DM(self._basis) @ theta[unknown]
            warm_up = np.tile(part.drive[: part.period], (self._periods_before(part), 1))
            u = np.concatenate([warm_up, part.drive])
            _, y = model.closed.mapaccum("run", len(u))(state, u.T, ca.repmat(p, 1, len(u)))
            y = y[:, len(warm_up) :: model.substeps]
            initial.append(state)
            simulated.append(y)
            scored = np.arange(len(r))[part.rows(0, len(r))].tolist()
            residual.append(ca.vec(((y - r.y.T) / np.tile(part.scale[:, None], (1, len(r))))[:, scored]))
        e, penalties = ca.vertcat(*residual), self.penalties
        prior = 0.5 * ca.dot(penalties.weight, (theta - penalties.mean) ** 2) + ca.dot(penalties.slope, theta)
        for own, square, mean in penalties.states:
            prior += 0.5 * ca.bilin(ca.DM(square), theta[own] - mean, theta[own] - mean)
        return Horizon(
            x=theta,
            f=0.5 * ca.sumsqr(e) / self.residuals + prior,
            g=self.rows.function(p),
            x0=self.start,
            lbx=self.lower,
            ubx=self.upper,
            lbg=self.g_lower,
            ubg=self.g_upper,
            residual=e,
            simulated=tuple(simulated),
            initial=tuple(initial),
            parameters=model.parameters.symbols(p),
        )

    def _periods_before(self, part: PlacedRecording) -> int:
        """Return the number of periods until the start model settles, before a recording in steady state."""
        if not part.steady:
            return 0
        p, state = self.model.parameters.start, part.state
        for count in range(1, MOST_WRITTEN_PERIODS + 1):
            before, state = state, self.engine.simulate(part.drive[: part.period], p, state)[1]
            if not np.max(np.abs(state - before), initial=0.0) > NEARLY_STEADY * np.max(np.abs(state), initial=0.0):
                return max(count, 2)
        return MOST_WRITTEN_PERIODS


@dataclass(frozen=True, eq=False)
class Horizon:
    """A problem as CasADi expressions of its variables θ, with the names of `casadi.nlpsol`.

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
        Simulated outputs of each recording, one column per sample, shape (n_y, M), in the recording's units.
    initial : tuple of casadi.MX
        State with the element's memory before each recording, and before the periods of a periodic one.
    parameters : mapping of str to casadi.MX
        The model's parameters by name, fixed ones as numbers.
    """

    x: ca.MX
    f: ca.MX
    g: ca.MX
    x0: Array
    lbx: Array
    ubx: Array
    lbg: Array
    ubg: Array
    residual: ca.MX
    simulated: tuple[ca.MX, ...]
    initial: tuple[ca.MX, ...]
    parameters: Mapping[str, ca.MX]
