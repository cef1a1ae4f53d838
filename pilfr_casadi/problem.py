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

import numpy as np

from .compiled import make_engine
from .constraints import Constraint, check_free, compile_constraints, constraint_sizes
from .layout import lay_out
from .magnitude import Neighbours
from .model import Model
from .nlp import Horizon, to_nlp
from .recording import InputError, Recording, as_recordings
from .sensitivities import Engine

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
        Periods run before a recording in periodic steady state; by default as many as the start model takes to settle.

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
    ) -> None:
        self.model = model
        self.recordings = as_recordings(recordings)
        self.engine = make_engine(model, engine) if isinstance(engine, str) else engine
        self.constraints = tuple(constraints)
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
        self.scale = _output_scale(self.recordings) if scale is None else np.asarray(scale, dtype=float)
        self._parts = list(lay_out(model, self.recordings, self.engine, n_free, periods))
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
        self._set_penalties(self.l1, noise)
        compiled = compile_constraints(self.constraints, parameters)
        self._g, self._g_slope, self.g_lower, self.g_upper, self.g_labels, self._g_units = compiled
        self.g_sizes = constraint_sizes(self.constraints, parameters)
        named = parameters.unpack(self._base)
        held = np.repeat([c.check is not None and c.check(named) <= 0 for c in self.constraints], self.g_sizes)
        check_free(
            self._g,
            self._g_slope,
            self.free,
            self._base,
            self.g_lower,
            self.g_upper,
            self.g_labels,
            np.asarray(held, dtype=bool),
        )

    def _set_penalties(self, l1: dict[str, float], noise: float) -> None:
        parameters = self.model.parameters
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
                weight[where] = noise**2 / std**2 / self._residuals
        pad = np.zeros(self.size - int(self.free.sum()))
        self._prior_weight, self._prior_mean, self._l1 = (
            np.concatenate([a[self.free], pad]) for a in (weight, mean, slope)
        )

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
        p, states = self.parameters(theta), zip(self._parts, self.initial_states(theta), strict=True)
        return [
            self.engine.simulate(part.warm_up, p, state)[1] if len(part.warm_up) else state for part, state in states
        ]

    def _penalty(self, theta: np.ndarray) -> float:
        return float(0.5 * self._prior_weight @ (theta - self._prior_mean) ** 2 + self._l1 @ theta)

    def simulate(self, theta: np.ndarray) -> list[np.ndarray]:
        """Simulated outputs, one (M, n_y) array a recording."""
        p, states = self.parameters(theta), zip(self._parts, self.first_states(theta), strict=True)
        return [self.engine.simulate(part.drive, p, state)[0] for part, state in states]

    def residual(self, theta: np.ndarray) -> np.ndarray:
        """Normalised residuals `(y_hat - y) / σ_y` of all scored samples, shape (R,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            pairs = zip(self._parts, self.simulate(theta), strict=True)
            return np.concatenate([((y - p.recording.y) / self.scale)[p.recording.skip :].ravel() for p, y in pairs])

    def cost(self, theta: np.ndarray) -> float:
        """Value of the objective; infinite where the simulation diverges."""
        e = self.residual(theta)
        with np.errstate(over="ignore", invalid="ignore"):
            value = 0.5 * float(e @ e) / self._residuals + self._penalty(theta)
        return value if np.isfinite(value) else np.inf

    def stretches(self, theta: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Residuals (R_b,), their Jacobian (R_b, n_c) and its columns in θ, stretch by stretch of each recording."""
        p, n_free, n_state = self.parameters(theta), int(self.free.sum()), self.model.n_x + self.model.n_s
        for part, state in zip(self._parts, self.initial_states(theta), strict=True):
            estimated = part.first is not None
            columns = np.arange(n_free)
            seed = np.zeros((n_state, n_free + n_state * estimated))
            if part.first is not None:
                seed[:, n_free:] = np.eye(n_state)
                columns = np.concatenate([columns, part.first + np.arange(n_state)])
            length = max(1, STRETCH // max(1, seed.shape[1] * self.model.n_y))
            r, n = part.recording, self.model.substeps
            for a in range(0, len(part.warm_up), length * n):
                rows = part.warm_up[a : a + length * n]
                _, _, state, seed = self.engine.sensitivity(rows, p, state, seed, self._columns)
            for a in range(0, len(r), length):
                b = min(a + length, len(r))
                y, jac, state, seed = self.engine.sensitivity(part.drive[a * n : b * n], p, state, seed, self._columns)
                cut = min(max(r.skip - a, 0), b - a)
                e = ((y - r.y[a:b]) / self.scale)[cut:].ravel()
                jac /= self.scale[:, None]
                yield e, jac[cut:].reshape(e.size, jac.shape[2]), columns

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Jacobian of `residual`, shape (R, size)."""
        out, at = np.zeros((self._residuals, self.size)), 0
        for e, jac, columns in self.stretches(theta):
            out[at : at + e.size, columns] = jac
            at += e.size
        return out

    def normal(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Objective, its gradient and Gauss-Newton Hessian at θ."""
        value, gradient, hessian = 0.0, np.zeros(self.size), np.zeros((self.size, self.size))
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging simulation gives an infinite value
            for e, jac, columns in self.stretches(theta):
                value += float(e @ e)
                gradient[columns] += e @ jac
                square = np.ix_(columns, columns) if len(columns) < self.size else ...
                hessian[square] += jac.T @ jac
        m = self._residuals
        gradient = gradient / m + self._prior_weight * (theta - self._prior_mean) + self._l1
        return 0.5 * value / m + self._penalty(theta), gradient, hessian / m + np.diag(self._prior_weight)

    def constraint(self, theta: np.ndarray) -> np.ndarray:
        """Values g(θ) of the general constraints."""
        return np.asarray(self._g(self.parameters(theta))).ravel()

    def constraint_jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Jacobian of `constraint`, shape (n_g, size)."""
        jac = np.zeros((len(self.g_lower), self.size))
        if len(jac):
            jac[:, : int(self.free.sum())] = np.asarray(self._g_slope(self.parameters(theta)))[:, self.free]
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
        return np.where(np.isnan(self._g_units), np.max(change, axis=1, initial=0.0), self._g_units)

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


def _output_scale(recordings: Sequence[Recording]) -> np.ndarray:
    return np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
