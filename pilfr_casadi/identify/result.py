"""`Fit`, the result of `fit`: a fitted model that simulates, judges, draws and saves itself.

`FitContext.result` builds it from the solution of a problem. Its note says two things that the recordings leave open.

Memory in a periodic steady state: an operator that never slips in a whole period keeps whatever memory it has. Its row
of the state's slope over a period is that of the identity, every value in an interval is a steady state, and the
outputs differ by a constant. The memory that periods from rest lead to is taken.

A known DC gain beyond the recordings: the gain of `known` belongs to motions so large that every play slips (`slope`
1), or so small that every one sticks (0), after an infinite time. A fit may meet it where no data contradict it, by
operators whose thresholds lie beyond all motions, or by a slow pole. So the gain is computed a second time, over the
samples of the longest recording and without the operators that never slip (for small motions: with the operators that
have no threshold),

    gain_M = C' (Σ_{k<M} A'^k) B' + D',   with the blocks of `known` at S = diag(Σ_j w_ij), j slipping.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import InputError
from ..data import NOTHING_SENTENCE, Recording, as_recordings, explains_nothing, fingerprint, nrmse, rmse_per_output
from ..engine import Engine, make_engine
from ..export import FitContent, SavedStart, exported, read_model_file, write_model_file
from ..models import PILFR, Model, PrandtlIshlinskii, Stop
from ..optimise import (
    Gain,
    Limit,
    Problem,
    Solution,
    Status,
    first_state,
    samples_for_state,
    unknown_multipliers,
)
from ..simulators import Simulator
from .options import FitOptions, options_from_limits
from .uncertainty import describe_unknown_errors

PRIOR = "weights held near a smooth density by a weak prior"


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one start led to; `drawn` tells whether its start depends on the seed."""

    seed: int
    model: Model
    theta: np.ndarray
    error: float
    solution: Solution
    note: str = ""
    drawn: bool = True


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
    options : FitOptions
        Bound on spectral radii, constraints, noise and weights, which hold for fits made from this one too.
    simulator : Simulator or None
        The simulator with the fitted values, if one was fitted.
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
    options: FitOptions = FitOptions()  # noqa: RUF009  (frozen)
    simulator: Simulator | None = None

    @property
    def status(self) -> Status:
        """How the winning solve ended."""
        return self.solution.status

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """Fitted values by name."""
        return {name: p.value for name, p in self.model.parameters.items()}

    @property
    def asked(self) -> FitOptions:
        """Old name of `options`."""
        return self.options

    def with_simulator(self, simulator: Simulator) -> Fit:
        """Return the fit of a simulator's model with the simulator at the fitted values."""
        own = {name: self.model.parameters[name] for name in simulator.parameters}
        return replace(self, simulator=simulator.with_parameters(own))

    @cached_property
    def _engine(self) -> Engine:
        return make_engine(self.model, self.engine)

    def initial_state(self, recording: Recording, samples: int | None = None) -> np.ndarray:
        """State with memory at a recording's first sample, as its `initial` says.

        Where it is to be estimated, a recording of the training gets the state of the fit. For any other the model is
        held and the state fitted to the first `samples` samples (default: ten a state, at least 50); nothing later is
        looked at, and `nrmse` does not score them.
        """
        recording = self._matched(recording)
        known = self.initial.get(fingerprint(recording))
        return first_state(self.model, self._engine, recording, samples, state_prior=True) if known is None else known

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
        recording = self._matched(recording)
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
        recording = self._matched(recording)
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
        given = [self._matched(r) for r in as_recordings(recordings)]
        first = [self.scored_from(r) for r in given]
        pooled = np.concatenate([r.y[k:] for r, k in zip(given, first, strict=True)])
        nrmse(pooled, pooled)  # refuses an output that never changes
        errors = []
        for r, k in zip(given, first, strict=True):
            spread, size = np.std(r.y[k:], axis=0), np.max(np.abs(r.y[k:]), axis=0)
            spread = np.where(spread <= 1e-14 * size, np.std(pooled, axis=0), spread)
            errors.append(np.mean(rmse_per_output(r.y, self.simulate(r), k) / spread))
        return float(np.mean(errors))

    def _matched(self, recording: Recording) -> Recording:
        """Check that a recording fits the model; for a simulator, put its columns in the simulator's order."""
        if not isinstance(recording, Recording):
            raise InputError(
                f"A {type(recording).__name__} was given to simulate; give a Recording, which holds inputs, outputs "
                "and the time step."
            )
        if self.simulator is not None:
            recording = match_channels(self.simulator, recording)
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
        return recording

    def plot(self, recordings: Recording | Sequence[Recording], **options: Any) -> Any:
        """Figures of the fit over recordings; see `plots.plot_fit`."""
        from ..plots import plot_fit

        return plot_fit(self, recordings, **options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the fit as JSON, atomically: an existing file stays as it is until the new one is complete on disk.

        Parameters
        ----------
        path : path
            The file, usually `*.json`. Of a model or a simulator of the user's own it holds the values alone, which a
            warning says for a simulator; give the model to `load`.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_model_file(path, self.content())
        if self.simulator is not None:
            warnings.warn(
                f"{os.fspath(path)} holds the fitted values, not the simulator's equations, which are code; load it "
                "with load(path, model=fit.model).",
                stacklevel=2,
            )

    def content(self) -> FitContent:
        """Return the values that a model file holds of this fit."""
        return FitContent(
            model=self.model,
            structure=self.structure,
            dt=self.dt,
            solution=self.solution,
            labels=self.labels,
            errors=self.errors,
            linear=self.linear,
            initial=self.initial,
            units=self.units,
            train_nrmse=self.train_nrmse,
            linear_nrmse=self.linear_nrmse,
            seconds=self.seconds,
            active=self.active,
            limits=self.limits,
            noise=self.options.noise,
            weights=self.options.weights,
            starts=tuple(SavedStart(c.seed, c.error, c.solution, c.note, c.drawn) for c in self.candidates),
        )

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """`casadi.Function (x, u) -> (x_next, y)`, operator memory inside x; see `export.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def export(self, **options: Any) -> Any:
        """The step with start state, names and units, for CasADi, C and python-control; see `export.exported`."""
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
        lines += describe_unknown_errors(self.errors)
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


def match_channels(simulator: Simulator, recording: Recording) -> Recording:
    """Return a recording with its columns in a simulator's order, others left out.

    Raises
    ------
    InputError
        If a column is missing; a recording without outputs needs none.
    """
    changes: dict[str, Any] = {}
    for kind, names, own, values in (
        ("input", simulator.inputs, recording.inputs, recording.u),
        ("output", simulator.output_names, recording.outputs, recording.y),
    ):
        if tuple(own) == tuple(names) or (kind == "output" and not own):
            continue
        for name in names:
            if name not in own:
                raise InputError(
                    f"The recording {recording.label} has no {kind} {name!r}, which the simulator has; "
                    f"it has {', '.join(own) or 'none'}. Map a column to it by name."
                )
        changes["u" if kind == "input" else "y"] = values[:, [own.index(n) for n in names]]
        changes[f"{kind}s"] = tuple(names)
    if changes:
        kept = {*changes.get("inputs", recording.inputs), *changes.get("outputs", recording.outputs)}
        changes["units"] = {k: v for k, v in recording.units.items() if k in kept}
    return recording.with_(**changes) if changes else recording


def save(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write a fit to a file; see `Fit.save`."""
    fit.save(path)


def load(path: str | os.PathLike[str], model: Model | PILFR | None = None) -> Fit:
    """Read a fit that `save` wrote; simulations are the same to the last digit.

    Parameters
    ----------
    path : path
        The file.
    model : Model or PILFR, optional
        The equations, where the file cannot hold them: a closed model of your own, or a PI-LFR whose element has
        envelope expressions of your own. Its values are replaced by those of the file.

    Returns
    -------
    Fit
        Of the starts that were tried only what they reached is kept: each candidate has its seed, error and status, an
        empty `theta` and the fitted model.

    Raises
    ------
    InputError
        If the file is missing, unreadable, damaged, of another kind or version, was changed after it was written, does
        not fit `model`, or holds values that are missing, not finite, or outside their bounds.

    Warns
    -----
    UserWarning
        If the file is of the first version of the format, which has no digest to tell changes by.
    """
    content = read_model_file(path, model)
    candidates = tuple(
        Candidate(c.seed, content.model, np.zeros(0), c.error, c.solution, note=c.note, drawn=c.drawn)
        for c in content.starts
    )
    options = FitOptions()  # the first files did not hold them
    if content.limits is not None:
        options = options_from_limits(content.limits, content.structure, noise=content.noise, weights=content.weights)
    return Fit(
        model=content.model,
        structure=content.structure,
        dt=content.dt,
        solution=content.solution,
        train_nrmse=content.train_nrmse,
        initial=dict(content.initial),
        labels=content.labels,
        errors=dict(content.errors),
        active=content.active,
        candidates=candidates,
        linear=content.linear,
        seconds=content.seconds,
        units=dict(content.units),
        linear_nrmse=content.linear_nrmse,
        limits=content.limits or (),
        options=options,
    )


def _shown(error: float) -> str:
    return f"{error:.4f}" if error < 1e4 else f"{error:.3g}"


def with_solution(model: Model, problem: Problem, solution: Solution) -> Model:
    """Return the model at the values of a solution."""
    return model.with_parameters(model.parameters.at(problem.parameters(solution.theta)))


Array = np.ndarray
CHUNK = 512  # samples of a period whose slopes are held at a time
STILL = 1e-12  # difference from the identity that is none


def find_open_memory(problem: Problem, theta: Array, recording: Recording, state: Array) -> Array:
    """Which memories a period from a steady state leaves alone though outputs see them, indices (k,)."""
    engine, p, n_x = problem.engine, problem.parameters(theta), problem.model.n_x
    rows = CHUNK * problem.model.substeps
    period = problem.model.drive(recording)[: (recording.period or 1) * problem.model.substeps]
    slope, after, seen = np.eye(len(state)), state, np.zeros(len(state))
    for a in range(0, len(period), rows):
        _, jac, after, slope = engine.sensitivity(period[a : a + rows], p, after, slope, np.full(len(p), -1))
        seen = np.maximum(seen, np.max(np.abs(jac / problem.scale[:, None]), axis=(0, 1), initial=0.0))
    still = np.max(np.abs(slope - np.eye(len(state))), axis=1, initial=0.0) <= STILL
    return np.flatnonzero(still[n_x:] & (seen[n_x:] > STILL * np.max(seen, initial=0.0)))


def describe_open_memory(problem: Problem, theta: Array) -> str:
    """What it means for a result, naming the recordings; empty where every memory is decided."""
    counts = {}
    for k, (r, state) in enumerate(zip(problem.recordings, problem.first_states(theta), strict=True)):
        periodic = r.begins == "periodic"
        if periodic and problem.model.n_s and np.all(np.isfinite(state)):
            counts[r.label if len(problem.recordings) == 1 or r.name else f"recording {k + 1}"] = len(
                find_open_memory(problem, theta, r, state)
            )
    found = [f"{count} in {label}" for label, count in counts.items() if count]
    if not found:
        return ""
    return (
        f"operators that never slip in a steady period: {', '.join(found)}; the period does not tell their memory, "
        "which shifts the outputs and is taken as periods from rest with zero memory leave it"
    )


APART = 0.05  # difference of gains, next to the largest one asked for, that is told


def describe_reached_gain(problem: Problem, theta: Array) -> str:
    """What it means that a gain is met beyond the recordings alone, one for all; empty where none is."""
    found, at = [], 0
    values, moved = problem.model.parameters.unpack(problem.parameters(theta)), None
    samples = max(len(r) for r in problem.recordings)
    for c, size in zip(problem.constraints, problem.g_sizes, strict=True):
        rows, at = slice(at, at + size), at + size
        if not isinstance(c.expression, Gain):
            continue
        if moved is None:
            moved = find_slipping(problem, theta, values)
        low, high = problem.g_lower[rows], problem.g_upper[rows]
        room = APART * float(np.max(np.abs(np.concatenate([low, high])), initial=0.0))

        def far(gain: Array, low: Array = low, high: Array = high, room: float = room) -> bool:
            return bool(np.any(~((low - room <= gain) & (gain <= high + room))))

        whole, within, odd = channel_weights(problem.model.element, values, c.expression.slope, moved)
        if far(gain_over(values, whole, None)):
            continue  # not met at all, which is told elsewhere
        reached = gain_over(values, within, samples)
        if not far(reached):
            continue
        range_alone, time_alone = far(gain_over(values, within, None)), far(gain_over(values, whole, samples))
        both = not range_alone and not time_alone
        why = [odd] if (range_alone or both) and odd else []
        why += [f"it settles over more than their {samples} samples"] if time_alone or both else []
        shown = ", ".join(f"{g:.3g}" for g in reached)
        found.append(f"{c.name} holds only beyond the recordings: {' and '.join(why)}; within them it comes to {shown}")
    return "; ".join(found)


def find_slipping(problem: Problem, theta: Array, values: Mapping[str, Array]) -> Array:
    """Which operators slip in some recording, (channels, N); none without an element."""
    element = problem.model.element
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros((0, 0), dtype=bool)
    r, n_x, p = values["r"], problem.model.n_x, problem.parameters(theta)
    moved = np.zeros(r.shape, dtype=bool)
    for recording, state in zip(problem.recordings, problem.first_states(theta), strict=True):
        z = problem.engine.simulate(problem.model.drive(recording), p, state, True)[2]
        q = state[n_x:].reshape(r.shape)
        for row in z:
            after = np.clip(q, row[:, None] - r, row[:, None] + r)
            moved |= after != q
            q = after
    return moved


def channel_weights(
    element: object, values: Mapping[str, Array], slope: float, moved: Array
) -> tuple[Array, Array, str]:
    """Σw of each channel (n_w,) as asked for and within the recordings, and how the operators differ in them."""
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros(0), np.zeros(0), ""
    w, stops = values["w"], isinstance(element.operator, Stop)
    whole = slope * w.sum(axis=1)
    if slope not in (0.0, 1.0):
        return whole, whole, ""
    if (slope == 1.0) != stops:  # large motions
        odd, what = ~moved, "never slip in them"
    else:
        odd, what = values["r"] <= 0, "have no threshold below which they stick"
    odd = odd & (w > 0)
    active = odd if slope == 0.0 else ~odd
    return whole, (w * active).sum(axis=1), f"{int(odd.sum())} of {w.size} operators {what}" if np.any(odd) else ""


def gain_over(values: Mapping[str, Array], weight: Array, samples: int | None) -> Array:
    """Gain (n_y n_u,), row by row, with Σw of each channel, after a number of samples or (None) in the end."""
    a, b, c, d = (values[k] for k in ("A", "B_u", "C_y", "D_yu"))
    if len(weight):
        s = np.diag(weight)
        a, b = a + values["B_w"] @ s @ values["C_z"], b + values["B_w"] @ s @ values["D_zu"]
        c, d = c + values["D_yw"] @ s @ values["C_z"], d + values["D_yw"] @ s @ values["D_zu"]
    n = len(a)
    with np.errstate(over="ignore", invalid="ignore"):
        if samples is None:
            state = np.linalg.lstsq(np.eye(n) - a, b, rcond=None)[0] if n else b
        else:
            step = np.block([[a, b], [np.zeros((b.shape[1], n)), np.eye(b.shape[1])]])
            state = np.linalg.matrix_power(step, samples)[:n, n:]
        return np.asarray(c @ state + d).ravel()
