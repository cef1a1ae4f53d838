"""`fit`: the verb that takes a model and recordings and returns one immutable result."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .compiled import make_engine
from .constraints import Constraint
from .elements import PrandtlIshlinskii
from .gauge import standard_errors
from .gauss_newton import GaussNewton
from .lfr import PILFR
from .metrics import nrmse
from .model import Model
from .multistart import KEEP, POLISH, PRIOR, Candidate, Search, linear_model, search_starts, stability
from .problem import Problem
from .recording import InputError, Recording, as_recordings, check_for_identification
from .sensitivities import Engine
from .solution import Solution, Status
from .threads import one_blas_thread

Progress = Callable[[str, int, int, float], None]


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model and how it came about.

    Attributes
    ----------
    model : Model
        Closed model with the fitted values as its parameters' values.
    structure : PILFR or None
        What was asked for, where it was a PI-LFR.
    solution : Solution
        Status, cost, iterations, history, multipliers.
    train_nrmse : tuple of float
        NRMSE (Eq. 27) of each training recording.
    initial : dict
        Fingerprint of each training recording -> state with memory at its first sample.
    labels : tuple of str
        Names of the variables in `solution.theta`.
    errors : dict
        Standard errors by parameter name, in the gauge of `gauge.standard_errors`; nan where fixed or at a bound.
    candidates : tuple of Candidate
        Every start that was tried.
    """

    model: Model
    structure: PILFR | None
    dt: float
    solution: Solution
    train_nrmse: tuple[float, ...]
    initial: dict[str, np.ndarray]
    labels: tuple[str, ...] = ()
    errors: dict[str, np.ndarray] = field(default_factory=dict)
    active: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    linear: Model | None = None
    seconds: float = 0.0
    units: dict[str, str] = field(default_factory=dict)
    engine: str = "auto"
    note: str = ""

    @property
    def status(self) -> Status:
        """How the winning solve ended."""
        return self.solution.status

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """Fitted values by name."""
        return {name: p.value for name, p in self.model.parameters.items()}

    @cached_property
    def _engine(self) -> Engine:
        return make_engine(self.model, self.engine)

    def initial_state(self, recording: Recording, samples: int | None = None) -> np.ndarray:
        """State with memory at a recording's first sample, as its `initial` says.

        Where it is to be estimated, a recording of the training gets the state of the fit. For any other the model is
        held and the state fitted to the first `samples` samples (default: ten a state, at least 50); nothing later is
        looked at.
        """
        n = self.model.n_x + self.model.n_s
        initial = recording.initial
        known = self.initial.get(fingerprint(recording))
        if known is not None and isinstance(initial, str) and initial != "zero":
            return known
        if not isinstance(initial, str):
            given = np.asarray(initial, dtype=float).ravel()
            if given.size not in (self.model.n_x, n):
                raise InputError(
                    f"An initial state of {given.size} numbers was given; expected {self.model.n_x} or {n}."
                )
            return np.concatenate([given, np.zeros(n - given.size)])
        values = self.model.parameters.start
        state = np.zeros(n)
        if initial == "periodic":
            period = recording.u[: recording.period]
            for _ in range(200):
                before = state
                state = self._engine.simulate(period, values, state)[1]
                if np.max(np.abs(state - before)) <= 1e-10 * max(float(np.max(np.abs(state))), 1e-300):
                    break
        elif initial == "estimate" and n:
            samples = min(len(recording), samples or max(10 * n, 50))
            held = self.model.with_parameters(
                self.model.parameters.change(**{k: {"fixed": True, "prior": None} for k in self.model.parameters})
            )
            head = recording.slice(0, max(samples, 2)).with_(skip=0)
            problem = Problem(held, head, engine=self._engine, scale=np.maximum(np.std(recording.y, axis=0), 1e-300))
            state = GaussNewton(max_iterations=50).solve(problem).theta
        return state

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulated outputs for a recording's inputs, shape (M, n_y)."""
        return self.signals(recording)["y"]

    def signals(self, recording: Recording) -> dict[str, np.ndarray]:
        """Simulated `y` (M, n_y) with the element's `z` and `w` (M, n_w)."""
        self._check(recording)
        state = self.initial_state(recording)
        y, _, z, w = self._engine.simulate(recording.u, self.model.parameters.start, state, True)
        return {"y": y, "z": z, "w": w}

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """NRMSE (Eq. 27) over outputs, averaged over recordings, in free-run simulation."""
        return float(np.mean([nrmse(r.y, self.simulate(r), skip=r.skip) for r in as_recordings(recordings)]))

    def _check(self, recording: Recording) -> None:
        if (recording.n_u, recording.n_y) != (self.model.n_u, self.model.n_y):
            raise InputError(
                f"The recording has {recording.n_u} inputs and {recording.n_y} outputs, "
                f"the model {self.model.n_u} and {self.model.n_y}; they must match."
            )
        if abs(recording.dt / self.dt - 1) > 1e-4:
            raise InputError(
                f"The recording's step is {recording.dt:g} s, the model's {self.dt:g} s; resample the recording."
            )

    def plot(self, recordings: Recording | Sequence[Recording], **options: Any) -> Any:
        """Figures of the fit over recordings; see `plots.plot_fit`."""
        from .plots import plot_fit

        return plot_fit(self, recordings, **options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as JSON, atomically; see `export.save`."""
        from .export import save

        save(self, path)

    def to_casadi(self, name: str = "model") -> Any:
        """`casadi.Function (x, u) -> (x_next, y)`, operator memory inside x; see `export.to_casadi`."""
        from .export import to_casadi

        return to_casadi(self, name)

    def __str__(self) -> str:
        errors = ", ".join(f"{e:.4f}" for e in self.train_nrmse)
        lines = [
            self.status.value,
            f"NRMSE on the training recording{'s' if len(self.train_nrmse) > 1 else ''}: {errors}",
            f"{self.solution.iterations} iterations in the last solve, {self.seconds:.1f} s in all",
        ]
        if self.candidates:
            reached = sorted(c.error for c in self.candidates)
            lines.append(f"{len(reached)} starts, explored to NRMSE {reached[0]:.4f} ... {reached[-1]:.4f}")
        if self.note:
            lines.append(self.note)
        lines.append(f"bounds that are active: {', '.join(self.active) if self.active else 'none'}")
        return "\n".join(lines)

    __repr__ = __str__


@one_blas_thread
def fit(
    model: PILFR | Model | Fit,
    train: Recording | Sequence[Recording],
    *,
    solver: Any = None,
    starts: int = 8,
    seed: int = 0,
    start: str = "grid",
    stable: bool | float = True,
    constraints: Sequence[Constraint] = (),
    l1: dict[str, float] | None = None,
    noise: float | None = None,
    engine: str = "auto",
    executor: Executor | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Fit:
    """Identify a model from recordings by minimising the simulation error (Krikelis et al. 2024, Eq. 20).

    Parameters
    ----------
    model : PILFR, Model or Fit
        A PI-LFR structure (start values are found), a closed model of your own, or an earlier fit (started at its
        values).
    train : Recording or sequence of Recording
        Training data; nothing else is used.
    solver : GaussNewton or Ipopt
        Solver of the final problem; by default `GaussNewton(tolerance=1e-4)`.
    starts, seed : int
        Number of random starts and the seed of all of them.
    start : {"grid", "paper"}
        Thresholds on a grid with screening and re-gridding, or the paper's start alone (Eq. 22-24).
    stable : bool or float
        Bound on the spectral radius of a PI-LFR's linear part, 1 by default; False for none.
    constraints, l1, noise
        See `Problem`.
    engine : {"auto", "c", "vm"}
        Generated C, or CasADi's virtual machine.
    executor, workers
        Where starts run: any `concurrent.futures.Executor`, or a pool of `workers` processes; the numbers are the same.
    progress : callable
        Called with (stage, done, total, smallest training error so far).

    Returns
    -------
    Fit

    Raises
    ------
    InputError
        If recordings and model do not fit each other, hold too little, or the start is not usable.
    """
    began = time.perf_counter()
    solver = solver or POLISH
    constraints = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
    _check_options(model, solver, starts, seed, workers, l1)
    if not isinstance(model, PILFR):
        given, structure = (model.model, model.structure) if isinstance(model, Fit) else (model, None)
        recordings = check_for_identification(train, int(given.parameters.free.sum()) + 2)
        limits = _limits(structure, stable) if structure else ()
        problem = Problem(
            given, recordings, constraints=(*limits, *constraints), l1=l1, noise=noise or 1.0, engine=engine
        )
        if not np.isfinite(problem.cost(problem.start)):
            raise InputError("The simulation diverges at the start values; start from a stable model.")
        return _result(given, structure, problem, solver.solve(problem), began, recordings)
    if start not in ("grid", "paper"):
        raise InputError(f"The start {start!r} is unknown; use 'grid' or 'paper'.")
    recordings = check_for_identification(train, _fewest_samples(model, train))
    limits = _limits(model, stable)
    linear, problem, solution = linear_model(recordings, model, engine=engine, constraints=limits[:1])
    fitted = _fitted(linear, problem, solution)
    if solution.status is Status.INTERRUPTED:
        return _result(linear, model.linear(), problem, solution, began, recordings)
    if model.element is None:
        with_bounds = model.model(
            linear.n_u,
            linear.n_y,
            {k: p.value for k, p in fitted.parameters.items()},
            inputs=linear.inputs,
            outputs=linear.outputs,
        )
        problem = Problem(
            with_bounds, recordings, constraints=(*limits, *constraints), noise=noise or 1.0, engine=engine
        )
        return _result(with_bounds, model, problem, solver.solve(problem), began, recordings)
    if not isinstance(model.element, PrandtlIshlinskii):
        raise InputError("A PI-LFR is identified with a PrandtlIshlinskii element; pass a closed Model for any other.")
    blocks = {k: p.value for k, p in fitted.parameters.items()}
    search = Search(model, recordings, blocks, solver, (*limits, *constraints), engine, start, l1 or {}, noise)
    pool = ProcessPoolExecutor(workers, initializer=_leave_interrupts) if executor is None and workers > 1 else None
    try:
        seen: list[float] = []

        def report(candidate: Candidate) -> None:
            seen.append(candidate.error)
            if progress:
                polishing = len(seen) > starts
                stage, total = ("polish", min(starts, KEEP)) if polishing else ("starts", starts)
                progress(stage, len(seen) - starts * polishing, total, min(seen))

        candidates, best, stopped = search_starts(search, starts, seed, executor or pool, report)
    finally:
        if pool is not None:
            pool.shutdown(cancel_futures=True)
    if best is None:
        return _result(linear, model.linear(), problem, replace(solution, status=Status.INTERRUPTED), began, recordings)
    problem = search.problem(best.model, noise=best.error)
    if stopped:
        result = replace(best.solution, status=Status.INTERRUPTED)
    else:
        result = best.solution if start == "paper" else solver.solve(problem, best.theta)
    return _result(best.model, model, problem, result, began, recordings, tuple(candidates), fitted, best.note)


def _check_options(model: Any, solver: Any, starts: Any, seed: Any, workers: Any, l1: Any) -> None:
    """Refuse what cannot be used before any long work."""
    if not isinstance(model, PILFR | Model | Fit):
        raise InputError(f"The model is a {type(model).__name__}; give a PILFR, a closed Model or a Fit.")
    if isinstance(solver, type) or not hasattr(solver, "solve"):
        raise InputError(f"The solver is {solver!r}; give an object such as GaussNewton() or Ipopt().")
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if not isinstance(value, int | np.integer) or value < least:
            raise InputError(f"{name} = {value!r} was given; give a whole number, {least} or more.")
    if l1 is not None and not isinstance(l1, dict):
        raise InputError(f'l1 = {l1!r} was given; give weights by name, like {{"w": 1e-4}}.')


def _leave_interrupts() -> None:
    """In a worker: Ctrl-C is for the process that waits for the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _limits(structure: PILFR, stable: bool | float) -> tuple[Constraint, ...]:
    return stability(structure, 1.0 if stable is True else float(stable)) if stable else ()


def fingerprint(recording: Recording) -> str:
    """Short digest of a recording's numbers."""
    return hashlib.sha256(recording.u.tobytes() + recording.y.tobytes()).hexdigest()[:16]


def _fewest_samples(model: PILFR, train: Recording | Sequence[Recording]) -> int:
    first = as_recordings(train)[0]
    shape = model.model(first.n_u, first.n_y)
    return max(int(shape.parameters.free.sum()), 10 * model.nx) + 2


def _fitted(model: Model, problem: Problem, solution: Solution) -> Model:
    return model.with_parameters(model.parameters.at(problem.parameters(solution.theta)))


def _result(
    model: Model,
    structure: PILFR | None,
    problem: Problem,
    solution: Solution,
    began: float,
    recordings: tuple[Recording, ...],
    candidates: tuple[Candidate, ...] = (),
    linear: Model | None = None,
    note: str = "",
) -> Fit:
    fitted = _fitted(model, problem, solution)
    if note == PRIOR:
        asked = structure.priors if structure else {}
        fitted = fitted.with_parameters(
            fitted.parameters.change(**{name: {"prior": asked.get(name)} for name in ("w", "r")})
        )
    theta = solution.theta
    at_bound = [
        f"{label} = {value:g}"
        for label, value, low, high in zip(problem.labels, theta, problem.lower, problem.upper, strict=True)
        if value in (low, high)
    ]
    g = problem.constraint(theta) if problem.constraints else np.zeros(0)
    at_bound += [
        name for name, value, high in zip(problem.g_labels, g, problem.g_upper, strict=True) if value >= high - 1e-7
    ]
    return Fit(
        model=fitted,
        structure=structure,
        dt=recordings[0].dt,
        solution=solution,
        train_nrmse=tuple(problem.nrmse(theta)),
        initial={fingerprint(r): state for r, state in zip(recordings, problem.first_states(theta), strict=True)},
        labels=problem.labels,
        errors=standard_errors(problem, theta, structure),
        active=tuple(at_bound),
        candidates=candidates,
        linear=linear,
        seconds=time.perf_counter() - began,
        units=dict(recordings[0].units),
        note=note,
    )
