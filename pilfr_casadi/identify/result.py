"""What `fit` returns: a fitted model with how it came about, which simulates, judges, draws and saves itself."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from .._base import InputError
from ..data import NOTHING_SENTENCE, Recording, as_recordings, explains_nothing, fingerprint, nrmse, rmse_per_output
from ..engine import Engine, make_engine
from ..models import PILFR, Model
from ..optimise import GaussNewton, Limit, Problem, Solution, Status, settled, unknown_multipliers
from .gauge import unknown_sentences
from .options import Asked
from .search import Candidate


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
        Standard errors by parameter name, in the gauge of `gauge.standard_errors`; nan where fixed or at a bound, inf
        where the data (and the user's priors, but none of the search's own) say nothing.
    active : tuple of str
        Variables that are at a bound, with their values, and constraints that are at a limit.
    limits : tuple of Limit
        Every constraint, and every bound that is active, with its value and its multiplier; see `limits`.
    linear : Model or None
        The linear model that the search began with, `linear_nrmse` its NRMSE on each training recording.
    candidates : tuple of Candidate
        Every start that was tried.
    asked : Asked
        Bound on spectral radii, constraints, noise and weights, which hold for fits made from this one too.
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
    linear_nrmse: tuple[float, ...] = ()
    limits: tuple[Limit, ...] = ()
    asked: Asked = Asked()  # noqa: RUF009  (frozen)

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
        looked at, and `nrmse` does not score them.
        """
        self._check(recording)
        known = self.initial.get(fingerprint(recording))
        return first_state(self.model, self._engine, recording, samples) if known is None else known

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulated outputs for a recording's inputs, shape (M, n_y).

        Raises
        ------
        InputError
            If what is given is no recording, or does not fit the model.
        """
        return self.signals(recording)["y"]

    def signals(self, recording: Recording) -> dict[str, np.ndarray]:
        """Simulated `y` (M, n_y) with the element's `z` and `w` (M, n_w)."""
        self._check(recording)
        state = self.initial_state(recording)
        y, _, z, w = self._engine.simulate(self.model.drive(recording), self.model.parameters.start, state, True)
        return {"y": y, "z": z, "w": w}

    def scored_from(self, recording: Recording) -> int:
        """First sample that is scored: behind `skip`, and behind those that an initial state has been fitted to.

        Raises
        ------
        InputError
            If no sample is left.
        """
        estimated = recording.begins == "estimate"
        if not estimated or fingerprint(recording) in self.initial or not self.model.n_x + self.model.n_s:
            return recording.skip
        first = max(recording.skip, samples_for_state(self.model))
        if first >= len(recording):
            raise InputError(
                f"The recording has {len(recording)} samples, but its initial state is fitted to the first "
                f"{samples_for_state(self.model)} and these are not scored; give a longer one, or its initial state."
            )
        return first

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """NRMSE (Eq. 27) over outputs, averaged over recordings, in free-run simulation.

        Nothing is fitted to what is scored, but for the training itself: where the initial state of another recording
        is estimated, the samples it is fitted to are left out (`scored_from`). An output that rests in one of several
        recordings counts next to its deviation in all of them.

        Raises
        ------
        InputError
            If a recording does not fit the model, is not longer than what its initial state is fitted to, or an output
            never changes.
        """
        given = as_recordings(recordings)
        first = [self.scored_from(r) for r in given]
        pooled = np.concatenate([r.y[k:] for r, k in zip(given, first, strict=True)])
        nrmse(pooled, pooled)  # refuses an output that never changes
        errors = []
        for r, k in zip(given, first, strict=True):
            spread, size = np.std(r.y[k:], axis=0), np.max(np.abs(r.y[k:]), axis=0)
            spread = np.where(spread <= 1e-14 * size, np.std(pooled, axis=0), spread)
            errors.append(np.mean(rmse_per_output(r.y, self.simulate(r), k) / spread))
        return float(np.mean(errors))

    def _check(self, recording: Recording) -> None:
        if not isinstance(recording, Recording):
            raise InputError(
                f"A {type(recording).__name__} was given to simulate; give a Recording, which holds inputs, outputs "
                "and the time step."
            )
        n_u, n_y = len(self.model.inputs), self.model.n_y
        unmeasured = recording.n_y == 0 and recording.begins != "estimate"
        if recording.n_u != n_u or not (recording.n_y == n_y or unmeasured):
            raise InputError(
                f"The recording has {recording.n_u} inputs and {recording.n_y} outputs, "
                f"the model {n_u} and {n_y}; they must match."
            )
        if abs(recording.dt / self.dt - 1) > 1e-4:
            raise InputError(
                f"The recording's step is {recording.dt:g} s, the model's {self.dt:g} s; resample the recording."
            )

    def plot(self, recordings: Recording | Sequence[Recording], **options: Any) -> Any:
        """Figures of the fit over recordings; see `plots.plot_fit`."""
        from ..plots import plot_fit

        return plot_fit(self, recordings, **options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as JSON, atomically; see `export.save`."""
        from ..export import save

        save(self, path)

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """`casadi.Function (x, u) -> (x_next, y)`, operator memory inside x; see `export.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def export(self, **options: Any) -> Any:
        """The step with start state, names and units, for CasADi, C and python-control; see `export.exported`."""
        from ..export import exported

        return exported(self, **options)

    def __str__(self) -> str:
        errors = ", ".join(map(_shown, self.train_nrmse))
        spent = f", {self.seconds:.1f} s in all" if self.seconds else ""
        lines = [
            self.status.value,
            *([self.status.advice] if self.status.advice else []),
            f"NRMSE on the training recording{'s' if len(self.train_nrmse) > 1 else ''}: {errors}",
            f"{self.solution.iterations} iterations in the last solve{spent}",
        ]
        if explains_nothing(self.train_nrmse):
            lines.insert(1, NOTHING_SENTENCE)
        if self.candidates:
            reached = sorted(c.error for c in self.candidates)
            some = f"{len(reached)} starts" if len(reached) > 1 else "1 start"
            lines.append(f"{some}, explored to NRMSE {_shown(reached[0])} ... {_shown(reached[-1])}")
            if not any(c.drawn for c in self.candidates):
                lines.append("none of them is drawn, so the seed changes nothing")
        if self.linear_nrmse:
            alone = ", ".join(f"{e:.4f}" for e in self.linear_nrmse)
            tight = any(v.kind == "constraint" and not v.name.endswith("<= 1") for v in self.limits)
            without = ", without the constraints" if tight else ""
            lines.append(f"the linear model alone{without}, to judge the element by: NRMSE {alone}")
        if self.note:
            lines.append(self.note)
        lines += unknown_sentences(self.errors)
        lines.append(f"bounds that are active: {', '.join(self.active) if self.active else 'none'}")
        constraints = [limit for limit in self.limits if limit.kind == "constraint"]
        if constraints:
            shown = [str(limit) for limit in constraints if limit.active or not limit.met]
            idle = [limit for limit in constraints if limit.met and not limit.active]
            shown += [str(limit) for limit in idle if "[" not in limit.name]
            rows = [limit.name.partition("[")[0] for limit in idle if "[" in limit.name]
            shown += [f"{len(rows)} not active ({', '.join(dict.fromkeys(rows))})"] if rows else []
            lines.append(f"constraints: {'; '.join(shown)}")
            lines.append(unknown_multipliers(self.limits, self.status))
        return "\n".join(line for line in lines if line)

    __repr__ = __str__


def samples_for_state(model: Model) -> int:
    """Samples that an unknown initial state is fitted to: ten a state, at least 50."""
    return max(10 * (model.n_x + model.n_s), 50)


def first_state(model: Model, engine: Engine, recording: Recording, samples: int | None = None) -> np.ndarray:
    """State with memory at a recording's first sample, as its `initial` says; the model's parameters are held.

    Where it is to be estimated, it is fitted to the first `samples` samples; nothing later is looked at.

    Raises
    ------
    InputError
        If a given state has another number of entries.
    """
    n, initial, values = model.n_x + model.n_s, recording.initial, model.parameters.start
    if not isinstance(initial, str):
        given = np.asarray(initial, dtype=float).ravel()
        states = len(model.states)
        if given.size not in (states, n):
            raise InputError(f"An initial state of {given.size} numbers was given; expected {states} or {n}.")
        return np.concatenate([given, np.zeros(n - given.size)])
    state = np.zeros(n)
    if initial == "periodic":
        period = model.drive(recording)[: (recording.period or 1) * model.substeps]
        state = settled(engine, period, values, state)
    elif initial == "estimate" and n:
        samples = min(len(recording), samples or samples_for_state(model))
        held = model.with_parameters(
            model.parameters.change(**{k: {"fixed": True, "prior": None} for k in model.parameters})
        )
        head = recording.slice(0, max(samples, 2)).with_(skip=0)
        spread = np.std(head.y, axis=0)
        spread = np.where(spread > 0, spread, np.max(spread) or 1.0)
        problem = Problem(held, head, engine=engine, scale=spread)
        state = GaussNewton(max_iterations=50).solve(problem).theta
    return state


def _shown(error: float) -> str:
    return f"{error:.4f}" if error < 1e4 else f"{error:.3g}"
