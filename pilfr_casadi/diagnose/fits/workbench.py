"""The data shared by all steps of a diagnosis: the simulator, its recordings, its integration and its fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..._base import InputError, Interrupt, one_at_a_time
from ...data import HOLDS, Recording, nrmse
from ...engine import Engine, make_engine
from ...identify import solve_within_bounds
from ...laws import Local
from ...linear import INJECTION, with_output_injection
from ...models import Model, ParameterSet, is_at_bound
from ...optimise import GaussNewton, Problem, Status
from ...simulators import (
    LARGEST_STEP,
    MOST_SUBSTEPS,
    Placed,
    Simulator,
    choose_substeps,
    discretise,
    fastest_rates,
    growth_rate,
    least_substeps,
    needed_substeps,
    rate_at_start,
)
from .floor import DIVERGED as DIVERGED, ROUNDING2, pool

# Solvers: of the fits that results are based on; of other fits; of the first fit of a law, to rank the laws
THOROUGH = GaussNewton(max_iterations=150, tolerance=1e-6, patience=6)
QUICK = GaussNewton(max_iterations=40, tolerance=1e-3, patience=4)
BRIEF = GaussNewton(max_iterations=12, tolerance=1e-3, patience=4)
LAST = GaussNewton(max_iterations=1000, tolerance=1e-6, patience=6)  # of the fit whose values an answer states
FEW = 3  # ports, laws, starts or fits that are tried at each choice of a search, which saves time
COMPARED_SAMPLES = 8000  # samples on which fits and forces are compared first

FINER_STEPS = 4  # largest factor on the sub-steps for a law, and factor of each refinement of steps and knees

# Fits of outputs with unequal noise
MOST_BALANCES = 4  # fits with other weights at most
NEAR_BALANCE = 1.2  # ratio of two weights that counts as equal

# Diverging runs
OUT_OF_BOUNDS = 1e6  # output over the largest measured value, from which a message says where a run diverges
RUNAWAY = 10.0  # over the outputs' deviation; a bounded oscillation about another point is off by less
# growth within a recording, in e-folds, above which no estimated initial state can keep the run bounded
MOST_GROWTH = 20.0


class RunsAway(InputError):
    """The simulator is unstable, and no values within its bounds keep it near the recordings."""


@dataclass(frozen=True, eq=False, repr=False)
class CompiledSimulator:
    """A simulator with its discretised model and the engine that runs it."""

    simulator: Simulator
    model: Model
    engine: Engine

    def run_as(self, simulator: Simulator) -> CompiledSimulator:
        """Run a simulator of the same equations, such as with other start values, by this model and engine."""
        return CompiledSimulator(simulator, self.model, self.engine)


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(CompiledSimulator):
    """A simulator fitted to recordings."""

    values: dict[str, np.ndarray]  # parameters by name
    initial: list[np.ndarray]  # state with memory at each recording's first sample
    # (M, n_y), simulated minus measured outputs of each recording, unscored samples included
    residual: list[np.ndarray]
    cost: float  # mean square of the scored residuals, each output in units of its deviation; see `floor.pool`
    squares: np.ndarray  # (n_y,), the same of each output
    balance: np.ndarray  # (n_y,), relative variances of the outputs' errors, with which they are pooled
    status: Status = Status.CONVERGED  # how the fit ended; a run at given values counts as converged

    @property
    def vector(self) -> np.ndarray:
        """Parameter vector of the model."""
        return self.model.parameters.pack(self.values)

    @property
    def fitted_model(self) -> Model:
        """The model with the fitted values as start values."""
        return self.model.with_parameters(self.model.parameters.at(self.vector))

    @property
    def share_at_bounds(self) -> float:
        """Share of the free parameters at a bound."""
        p = self.model.parameters
        return float(np.mean(is_at_bound(self.vector, p.lower, p.upper)[p.free])) if np.any(p.free) else 0.0

    def is_at_bound(self, name: str) -> np.ndarray:
        """Mark the entries of a parameter that are at one of its bounds."""
        return is_at_bound(self.values[name], *self.model.parameters[name].bounds)

    def strained(self, names: Iterable[str]) -> int:
        """Count the free parameters of some at a bound other than zero, which the fit wants beyond."""
        free = (name for name in names if not np.all(self.model.parameters[name].fixed))
        return sum(bool(np.any(self.is_at_bound(name) & (self.values[name] != 0))) for name in free)

    @property
    def begin(self) -> list[np.ndarray]:
        """The simulator's own states at each recording's first sample, without those of laws."""
        return [state[: len(self.simulator.states)] for state in self.initial]

    def last_elements(self, count: int) -> tuple[Placed, ...]:
        """Return the elements that were added last, in their order."""
        return self.simulator.elements[len(self.simulator.elements) - count :]

    def corrected(self) -> Simulator:
        """Return the simulator with the fitted values as start values."""
        own = self.simulator.parameter_set
        return self.simulator.with_parameters(own.at(pack_known(own, self.values)))

    def simulate(self, r: Recording, state: np.ndarray) -> np.ndarray:
        """Simulate at the fitted values along a recording's inputs from an initial state; return the outputs."""
        return np.asarray(self.engine.simulate(self.model.drive(r), self.vector, state)[0])


@dataclass(frozen=True, eq=False, repr=False)
class Workbench:
    """The data of one diagnosis, with the settings for running and fitting simulators on it.

    The outputs' errors are in units of `scale`, their deviation. With `noise2`, the mean square noise of each output in
    units of its variance, errors are pooled and fits are weighted as `floor.pool` tells; otherwise all outputs are
    alike.
    """

    simulator: Simulator
    recordings: tuple[Recording, ...]
    hold: str
    substeps: int
    scale: np.ndarray
    engine: str = "auto"
    at_least: int = 1  # sub-steps of simulators with laws
    typical: tuple[np.ndarray, np.ndarray] | None = None  # states and inputs along the refitted run
    chosen: int = 1  # sub-steps first chosen for the simulator, on which limits are based
    interrupt: Interrupt = field(default_factory=Interrupt)  # shared by all benches of a search
    deadline: float = np.inf  # time (of `time.perf_counter`) at which every fit ends
    noise2: np.ndarray | None = None

    @classmethod
    def of(cls, simulator: Simulator, recordings: Sequence[Recording], hold: str, engine: str = "auto") -> Workbench:
        """Put the recordings' channels into the simulator's order, and choose the sub-steps."""
        ordered = tuple(simulator.matched(r) for r in recordings)
        chosen = choose_substeps(simulator, ordered)
        return cls(simulator, ordered, hold, chosen, output_deviation(ordered), engine, chosen=chosen)

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return self.recordings[0].dt

    @property
    def stacked_inputs(self) -> np.ndarray:
        """Inputs (M, n_u) of all recordings, one after the other."""
        return np.concatenate([r.u for r in self.recordings])

    def unit_of(self, channel: str) -> str:
        """Return the unit of an input or output, "" if it is unknown; that of the recordings comes first."""
        return {**self.simulator.units, **self.recordings[0].units}.get(channel, "")

    def with_other_holds(self, among: Sequence[str] = HOLDS) -> list[Workbench]:
        """Return the bench with interpolated inputs, or with each other hold if they are interpolated already.

        Held inputs come half a sample later than interpolated ones, the next values half a sample earlier.
        """
        return [replace(self, hold=hold) for hold in among if (hold == "linear") != (self.hold == "linear")]

    def on(self, recordings: Sequence[Recording]) -> Workbench:
        """Return the bench with other recordings; errors stay in units of the training outputs' deviation."""
        return replace(self, recordings=tuple(self.simulator.matched(r) for r in recordings))

    def renewed(self, recordings: Sequence[Recording]) -> Workbench:
        """Return a bench for other recordings, with sub-steps and the unit of errors chosen for them."""
        bench = Workbench.of(self.simulator, recordings, self.hold, self.engine)
        return replace(bench, deadline=self.deadline, interrupt=self.interrupt, noise2=self.noise2)

    def nrmse(self, fitted: Fitted) -> float:
        """Compute the NRMSE averaged over outputs and recordings.

        Where an output rests in a recording, its deviation over all recordings counts.
        """
        pairs = zip(fitted.residual, self.recordings, strict=True)
        return float(np.mean([nrmse(r.y, r.y + e, skip=r.skip, resting=self.scale) for e, r in pairs]))

    def pool(self, squares: np.ndarray) -> float:
        """Pool mean square errors of the outputs (n_y,), in units of their variance; see `floor.pool`."""
        return pool(squares, self.noise2)[0]

    def balanced(self, fitted: Fitted) -> Workbench:
        """Return the bench with outputs in units in which the errors of a fit are about alike."""
        if np.all(fitted.balance == 1):
            return self
        return replace(self, scale=self.scale * np.sqrt(fitted.balance), noise2=None)

    @one_at_a_time
    def model(self, simulator: Simulator, gain: np.ndarray | None = None) -> Model:
        """Discretise a simulator, with output injection if a gain is given."""
        model = discretise(simulator, self.dt, self.hold, self._substeps(simulator))
        return model if gain is None else with_output_injection(model, gain)

    def compile(self, simulator: Simulator, gain: np.ndarray | None = None) -> CompiledSimulator:
        """Discretise and compile a simulator, with output injection if a gain is given."""
        model = self.model(simulator, gain)
        return CompiledSimulator(simulator, model, make_engine(model, self.engine))

    def _substeps(self, simulator: Simulator) -> int:
        """Choose more sub-steps for a fast law, up to a limit: a stiff start of a law is not worth a fine grid."""
        if not simulator.elements:
            return self.substeps
        wanted = needed_substeps(simulator, self.recordings)[0]
        wanted = wanted if wanted <= MOST_SUBSTEPS else 0
        # passed at every reversal, even if not at rest there
        if any(getattr(e.law, "knee", "") for e in simulator.elements):
            wanted = max(wanted, int(np.ceil(rate_at_start(simulator, self.recordings[0]) * self.dt / LARGEST_STEP)))
        if self.typical is not None:  # a contact is not active at rest
            p = simulator.parameter_set.start
            rates = fastest_rates(simulator, *self.typical, p)
            if np.any(np.isfinite(rates)):
                wanted = max(wanted, int(np.ceil(float(np.nanquantile(rates, 0.95)) * self.dt / LARGEST_STEP)))
        least = max(self.substeps, self.at_least, least_substeps(simulator))
        if any(getattr(e.law, "shifts", False) for e in simulator.elements):  # its memory has an entry for every step
            least = min(least, FINER_STEPS * self.chosen)
        return int(np.clip(wanted, least, max(FINER_STEPS * self.chosen, least)))

    def problem(
        self,
        model: Model,
        engine: Engine,
        scored: Sequence[np.ndarray] | None = None,
        balance: np.ndarray | float = 1.0,
    ) -> Problem:
        """Make the simulation-error problem of a model.

        `scored` marks the samples that count, all by default; `balance` are relative variances of the outputs' errors.
        """
        return Problem(model, self.recordings, engine=engine, scale=self.scale * np.sqrt(balance), scored=scored)

    def problem_at(self, fitted: Fitted, scored: Sequence[np.ndarray] | None = None) -> tuple[Problem, np.ndarray]:
        """Make the simulation-error problem of a fitted simulator; return it and its variables at the fitted values."""
        problem = self.problem(fitted.fitted_model, fitted.engine, scored, fitted.balance)
        return problem, problem.variables(problem.start[: problem.n_free], fitted.initial)

    def fit(
        self,
        simulator: Simulator,
        starts: Sequence[Mapping[str, Any]] = ({},),
        *,
        states: Sequence[np.ndarray] = (),
        anneal: Sequence[float] = (),
        solver: GaussNewton = QUICK,
        like: CompiledSimulator | None = None,
    ) -> Fitted:
        """Fit from several starts (values by name), each through the sequence of injection gains `anneal`.

        `states` are initial guesses of each recording's initial state, without the states of new laws at its end. The
        compiled model of `like` is reused.

        Raises
        ------
        InputError
            If the simulation diverges from every start.
        """
        one = self.compile(simulator) if like is None else like.run_as(simulator)
        estimated = any(r.begins == "estimate" for r in self.recordings)
        if not np.any(one.model.parameters.free) and not (estimated and one.model.n_state):
            given = self._run_as_given(one)
            if not np.isfinite(given.cost):
                raise InputError("The simulation diverges at the given values; check the parameters' values and units.")
            return given
        best: tuple[float, np.ndarray, Problem, Status] | None = None
        for start in starts:
            if best is not None and time.perf_counter() > self.deadline:
                break
            found = self._fit_from(one, start, states, tuple(anneal), solver)
            if found is not None and (best is None or found[0] < best[0]):
                best = found
        if best is None:
            unstable = self._describe_instability(simulator)
            raise (RunsAway if unstable else InputError)(
                f"The simulation diverges at the start values{self._describe_divergence(one, starts[0])}; "
                + (unstable or "check the parameters' values and units, and the hold.")
            )
        _, theta, problem, status = best
        values = problem.values(theta)
        values.pop(INJECTION, None)
        return replace(self.result(one, values, problem.first_states(theta)), status=status)

    def _describe_divergence(self, one: CompiledSimulator, start: Mapping[str, Any]) -> str:
        """Describe where a run from rest exceeds every bound."""
        vector = start_vector(one.model, start)
        for r in self.recordings:
            with np.errstate(all="ignore"):
                y = one.engine.simulate(one.model.drive(r), vector, np.zeros(one.model.n_state))[0]
                off = ~(np.abs(y) < OUT_OF_BOUNDS * np.max(np.abs(r.y), axis=0))
            if np.any(off):
                k = int(np.argmax(np.any(off, axis=1)))
                name = self.simulator.output_names[int(np.argmax(off[k]))]
                how = "is out of all bounds" if np.isfinite(y[k]).all() else "is not finite"
                failed = "".join(f"; {f} failed with {e}" for f, e in self.simulator.program_failures.items())
                return f" ({name} {how} {k * r.dt:.3g} s into {r.label}{failed})"
        return ""

    def check_followed(self, fitted: Fitted, most: float = RUNAWAY**2) -> None:
        """Refuse a fit of an unstable simulator that leaves more than `most` of the mean square.

        A fit that an interrupt may have ended is not refused.
        """
        if fitted.cost > most and not self.interrupt.pressed and (why := self._describe_instability(self.simulator)):
            off = f"{fitted.cost**0.5:.3g} times the outputs' deviation"
            raise RunsAway(f"Refitted, the simulation runs away from the recordings, by {off}; {why}")

    def _describe_instability(self, simulator: Simulator) -> str:
        """Say what to do about a simulator too unstable to follow a controlled machine; empty if it is not."""
        rate = growth(simulator, self.recordings) if simulator.observer is None else 0.0
        if not rate:
            return ""
        return (
            f"it is unstable (it grows e-fold in {1 / rate:.2g} s) and cannot be run by its own inputs alone: put the "
            "controller into the simulator, with its reference as the input; or let the recordings lead it, by the "
            "focus 'prediction' of a diagnosis."
        )

    def run_given(self, like: CompiledSimulator | None = None) -> Fitted:
        """Run the simulator at the given values, with the states in which a fit begins.

        The cost of a diverging run is infinite. The compiled model of `like` is reused.
        """
        return self._run_as_given(self.compile(self.simulator) if like is None else like.run_as(self.simulator))

    def _run_as_given(self, one: CompiledSimulator) -> Fitted:
        parameters = one.model.parameters
        freed = parameters.change(**{name: {"fixed": False} for name in parameters})
        problem = self.problem(one.model.with_parameters(freed), one.engine)  # which needs variables
        values = {k: p.value for k, p in parameters.items()}
        return self.result(one, values, problem.first_states(problem.start))

    def _fit_from(
        self,
        one: CompiledSimulator,
        start: Mapping[str, Any],
        guess: Sequence[np.ndarray],
        path: tuple[float, ...],
        solver: GaussNewton,
    ) -> tuple[float, np.ndarray, Problem, Status] | None:
        """Fit from one start through injection gains down to none; None if it diverges.

        A large gain keeps the run near the recordings, so that a poor start does not end in a wrong minimum.
        """
        model, parameters = one.model, one.model.parameters
        vector = start_vector(model, start)
        states = [model.first_state(r) for r in self.recordings]
        if len(guess):
            states = self.initial_states(model, vector, guess)
        problem: Problem | None = None
        status = Status.SOLVER_FAILED
        for gamma in (*path, 0.0):
            at = parameters.at(vector)
            if INJECTION in parameters:
                at = at.change(**{INJECTION: {"value": gamma}})
            problem = self.problem(model.with_parameters(at), one.engine)
            theta = problem.variables(problem.start[: problem.n_free], states)
            if not np.isfinite(problem.cost(theta)):
                if gamma == 0.0 and not path:
                    return None
                continue
            problem, theta, status = self._solve(problem, theta, solver)
            if np.all(np.isfinite(theta)):
                vector, states = problem.parameters(theta), problem.initial_states(theta)
        assert problem is not None
        theta = problem.variables(vector[problem.free], states)
        balance = self._balance(problem, theta)
        if not near_balance(balance, (problem.scale / self.scale) ** 2):
            problem = self.problem(problem.model, one.engine, balance=balance)
        cost = problem.cost(theta)  # starts are compared with the weights of where they end
        return (cost, theta, problem, status) if cost < DIVERGED else None

    def _solve(self, problem: Problem, theta: np.ndarray, solver: GaussNewton) -> tuple[Problem, np.ndarray, Status]:
        """Solve a problem, and again while its outputs are out of balance (iteratively reweighted least squares)."""

        def end_if_pressed(*_: object) -> None:
            self.interrupt.raise_pending()

        status, until = Status.SOLVER_FAILED, min(time.perf_counter() + solver.time_limit, self.deadline)
        for done in range(MOST_BALANCES):
            balance = self._balance(problem, theta)
            near = near_balance(balance, (problem.scale / self.scale) ** 2)
            if done and (near or status is not Status.CONVERGED):
                break
            if not near:
                problem = self.problem(problem.model, problem.engine, balance=balance)
            try:
                timed = replace(solver, time_limit=until - time.perf_counter())
                with np.errstate(all="ignore"):
                    solution = solve_within_bounds(problem, theta, timed, progress=end_if_pressed)
            except (RuntimeError, FloatingPointError, np.linalg.LinAlgError):  # a quadratic program of huge numbers
                break
            theta, status = solution.theta, solution.status
            if status is Status.INTERRUPTED:
                self.interrupt.pressed = True
        return problem, theta, status

    def _balance(self, problem: Problem, theta: np.ndarray) -> np.ndarray:
        """Compute the balance of the outputs at some variables of a problem."""
        now = (problem.scale / self.scale) ** 2
        if self.noise2 is None or len(now) == 1:
            return now
        squares = np.mean(problem.residual(theta).reshape(-1, len(now)) ** 2, axis=0)
        return pool(squares * now, self.noise2)[1]

    def initial_states(self, model: Model, vector: np.ndarray, states: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Complete initial states (n_state,) from their first entries; laws begin at rest at the first inputs."""
        out, n = [], model.n_state
        for r, given in zip(self.recordings, states, strict=True):
            state = np.asarray(given, dtype=float)[:n]
            if r.begins in ("estimate", "given"):
                state = model.rest_at(state, r.u[0], vector)
            out.append(np.append(state, np.zeros(n - len(state))))
        return out

    def by_cost(
        self, one: CompiledSimulator, starts: Sequence[Mapping[str, Any]], states: Sequence[np.ndarray]
    ) -> list[Mapping[str, Any]]:
        """Order starts by their error before a fit, from the same initial states."""
        initial = self.initial_states(one.model, start_vector(one.model, starts[0]), states)

        def cost(start: Mapping[str, Any]) -> float:
            values = one.model.parameters.unpack(start_vector(one.model, start))
            return self.result(one, values, initial).cost

        return sorted(starts, key=cost)

    def local(self, z: np.ndarray, dz: np.ndarray) -> Local:
        """Return the local signals of a port along all recordings, with the time and the inputs."""
        inputs = self.signals_of([r.u for r in self.recordings])
        lengths, rest = tuple(map(len, self.recordings)), tuple(r.begins == "zero" for r in self.recordings)
        return Local(z, dz, self.dt, lengths, inputs=inputs, from_zero=rest)

    def signals_of(self, inputs: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return the inputs and the time `t`, also if an input has its name, along all recordings.

        `inputs` holds those (M, n_u) of each recording.
        """
        time = np.concatenate(
            [r.start + self.dt * np.arange(len(u)) for r, u in zip(self.recordings, inputs, strict=True)]
        )
        return {**dict(zip(self.simulator.inputs, np.concatenate(inputs).T, strict=True)), "t": time}

    def run(self, simulator: Simulator, values: Mapping[str, Any], states: Sequence[np.ndarray]) -> Fitted:
        """Run a simulator at values by name, from the simulator's own initial states."""
        one = self.compile(simulator)
        vector = start_vector(one.model, values)
        initial = self.initial_states(one.model, vector, states)
        return self.result(one, one.model.parameters.unpack(vector), initial)

    def scored(self, residual: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the residual of each recording (M, n_y) without the samples that do not count."""
        return [e[r.skip :] for e, r in zip(residual, self.recordings, strict=True)]

    def rerun(
        self,
        fitted: Fitted,
        values: dict[str, np.ndarray] | None = None,
        initial: list[np.ndarray] | None = None,
    ) -> Fitted:
        """Run a fitted simulator along these recordings, at its own values and initial states or at others."""
        values = fitted.values if values is None else values
        initial = fitted.initial if initial is None else initial
        return self.result(fitted, values, initial)

    def result(self, one: CompiledSimulator, values: dict[str, np.ndarray], initial: list[np.ndarray]) -> Fitted:
        """Compute the residuals at given values and initial states."""
        model, engine = one.model, one.engine
        vector = model.parameters.pack(values)
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging run has an infinite cost
            runs = zip(self.recordings, initial, strict=True)
            residual = [engine.simulate(model.drive(r), vector, state)[0] - r.y for r, state in runs]
            squares = np.mean((np.concatenate(self.scored(residual)) / self.scale) ** 2, axis=0)
            squares = np.maximum(squares, ROUNDING2)
            cost, balance = pool(squares, self.noise2)
        cost = cost if np.isfinite(cost) else np.inf
        return Fitted(one.simulator, model, engine, values, initial, residual, cost, squares, balance)


def growth(simulator: Simulator, recordings: Sequence[Recording]) -> float:
    """Compute the rate, 1/s, at which a simulator grows by itself; 0 if the recordings are too short to show it."""
    rate = growth_rate(simulator, recordings[0])
    return rate if rate * max(len(r) * r.dt for r in recordings) > MOST_GROWTH else 0.0


def near_balance(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether two balances of the outputs give fits about the same weights."""
    return bool(np.max(np.abs(np.log(one / other))) < 2 * np.log(NEAR_BALANCE))


def output_deviation(recordings: Sequence[Recording]) -> np.ndarray:
    """Compute the standard deviation of each output over the scored samples of all recordings, (n_y,)."""
    return np.asarray(np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0))


def pack_known(parameters: ParameterSet, values: Mapping[str, Any]) -> np.ndarray:
    """Return the parameter vector at values by name; names of other parameters are ignored."""
    return parameters.pack({k: v for k, v in values.items() if k in parameters})


def start_vector(model: Model, start: Mapping[str, Any]) -> np.ndarray:
    """Return the parameter vector at start values by name, clipped to the bounds; see `pack_known`."""
    p = model.parameters
    return np.asarray(np.clip(pack_known(p, start), p.lower, p.upper))


def refit(
    bench: Workbench,
    starts: Sequence[Mapping[str, Any]] = ({},),
    simulator: Simulator | None = None,
    *,
    states: Sequence[np.ndarray] = (),
    solver: GaussNewton = QUICK,
    like: CompiledSimulator | None = None,
) -> Fitted | None:
    """Fit a simulator, by default the bench's; None if it diverges. The compiled model of `like` is reused."""
    try:
        return bench.fit(simulator or bench.simulator, starts, states=states, solver=solver, like=like)
    except InputError:
        return None


def refit_with_other_holds(
    bench: Workbench,
    starts: Sequence[Mapping[str, Any]],
    simulator: Simulator | None = None,
    *,
    states: Sequence[np.ndarray] = (),
    solver: GaussNewton = THOROUGH,
    among: Sequence[str] = HOLDS,
    may_go_on: Callable[[], bool] = lambda: True,
) -> list[tuple[Workbench, Fitted]]:
    """Refit with each other hold of the inputs; the smallest error is first, diverging ones are left out.

    See `Workbench.with_other_holds`; no refit begins once `may_go_on` is false.
    """
    found = []
    for held in bench.with_other_holds(among):
        if not may_go_on():
            break
        fitted = refit(held, starts, simulator, states=states, solver=solver)
        if fitted is not None:
            found.append((held, fitted))
    return sorted(found, key=lambda pair: pair[1].cost)


def converge(bench: Workbench, fitted: Fitted, seconds: float) -> Fitted:
    """Continue a fit that was stopped by its limit of iterations, for at most so many seconds."""
    if fitted.status is not Status.MAX_ITERATIONS or seconds <= 0:
        return fitted
    solver = replace(LAST, time_limit=seconds)
    found = refit(bench, [fitted.values], fitted.simulator, states=fitted.initial, solver=solver, like=fitted)
    return found if found is not None and found.cost < fitted.cost else fitted
