"""The simulation-error problem: Krikelis et al. (2024), Eq. 20, over any number of recordings.

    minimise  1/2 mean(e²) + 1/2 Σ ((θ_i - m_i) / s_i)² v/R + l1 Σ |w|      e = (y_hat(θ) - y) / σ_y,
    subject to  lower <= θ <= upper,  lower_g <= g(θ) <= upper_g.

θ stacks the model's free parameters and, for each recording whose initial state is estimated, that state with the
element's memory. The mean runs over all R scored samples and outputs; `v` is the noise variance that the priors are
weighed against. Derivatives come from the sensitivity recursion; `normal` accumulates `JᵀJ` and `Jᵀe` over stretches
of the record, so memory does not grow with its length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from .._base import InputError
from ..data import Recording, as_recordings
from ..engine import Engine, VirtualMachine, make_engine
from ..models import Model, Neighbours
from .constraints import Constraint, Rows
from .known import check_gain
from .layout import Part, checked_weights, lay_out, output_scale
from .nlp import Horizon, to_nlp
from .penalties import Penalties
from .slopes import Pass, settled, steady_slope, steady_sums, sums

STRETCH = 2_000_000  # numbers in the piece of the Jacobian that is held at a time


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
        """The function of each item, a few at a time."""
        if self.threads == 1 or len(items) == 1:
            return [function(item) for item in items]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(function, items))

    def simulate(self, theta: np.ndarray) -> list[np.ndarray]:
        """Simulated outputs, one (M, n_y) array a recording."""
        p, states = self.parameters(theta), self.first_states(theta)
        pairs = [(part.drive, state) for part, state in zip(self._parts, states, strict=True)]
        return self._each(lambda pair: self.engine.simulate(pair[0], p, pair[1])[0], pairs)

    def residual(self, theta: np.ndarray) -> np.ndarray:
        """Normalised residuals `(y_hat - y) / σ_y` of all scored samples, shape (R,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            pairs = zip(self._parts, self.simulate(theta), strict=True)
            return np.concatenate([((y - p.recording.y) / p.scale)[p.recording.skip :].ravel() for p, y in pairs])

    def cost(self, theta: np.ndarray) -> float:
        """Value of the objective; infinite where the simulation diverges."""
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
        """Objective, its gradient and Gauss-Newton Hessian at θ."""
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
        return 0.5 * value / m + self.penalties.value(theta), gradient, hessian / m + np.diag(self.penalties.weight)

    def constraint(self, theta: np.ndarray) -> np.ndarray:
        """Values g(θ) of the general constraints."""
        return self.rows.values(self.parameters(theta))

    def constraint_jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Jacobian of `constraint`, shape (n_g, size)."""
        jac = np.zeros((len(self.g_lower), self.size))
        if len(jac):
            jac[:, : int(self.free.sum())] = self.rows.slope(self.parameters(theta))[:, self.free]
        return jac

    def constraint_units(self, theta: np.ndarray, squares: np.ndarray | None = None) -> np.ndarray:
        """A change of each general constraint that counts, shape (n_g,): as given, else what its variables bring about.

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
