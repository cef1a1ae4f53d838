"""`Fit`, the result of `fit`, with its verbs: simulate, nrmse, plot, save, export and report.

`FitOptions` are the options of `fit` that also apply to fits made from its result: the bound on spectral radii, the
constraints, the noise against which priors are weighed, and the weights of recordings. A model file contains no code.
So it stores the bound on spectral radii but only the names of other constraints, which must be supplied again or
dropped explicitly.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, is_number, later, listed
from ..data import NOTHING_SENTENCE, SAME_STEP, Recording, as_recordings, explains_nothing, fingerprint, nrmse
from ..engine import Engine, make_engine
from ..export import FitContent, exported, read_model_file, write_model_file
from ..linear import LinearPart, any_bla, linear_parts
from ..models import PILFR, Model, accumulate_steps
from ..optimise import (
    Candidate,
    Constraint,
    Limit,
    Problem,
    Solution,
    Status,
    check_weights,
    describe_unknown_multipliers,
    estimate_initial_state,
    samples_for_state,
    stability_limits,
)
from ..simulators import Simulator, check_hold
from .uncertainty import describe_unknown_errors

DENSITY_PRIOR = "weights held near a smooth density by a weak prior"  # note of a candidate and of its fit
RADIUS = "spectral radius"  # how the names of bounds on spectral radii begin


@dataclass(frozen=True, eq=False)
class FitOptions:
    """Options that a fit passes on to fits made from it, as for `fit`.

    `lost` names constraints that a model file could not store; `noise` is None if it is estimated; `weights` maps the
    `fingerprint` of each recording to its weight, None for equal weights.
    """

    stable: bool | float = True
    constraints: tuple[Constraint, ...] = ()
    lost: tuple[str, ...] = ()
    noise: float | None = None
    weights: Mapping[str, float] | None = None

    def updated(
        self,
        stable: bool | float | None = None,
        constraints: Any = None,
        noise: float | str | None = None,
        weights: Any = None,
        train: Any = (),
    ) -> FitOptions:
        """Return the options with some replaced; None keeps the present value. `weights` belong to `train`."""
        if noise is not None and noise != "estimate" and not (is_number(noise) and 0 < noise < np.inf):
            raise InputError(f"noise = {noise!r} was given; give a number above zero, or 'estimate'.")
        if constraints is None and self.lost:
            raise InputError(
                f"The fit had constraints that a file cannot store ({listed(self.lost)}); give them again as "
                "constraints=, or constraints=() to drop them."
            )
        return FitOptions(
            self.stable if stable is None else stable,
            self.constraints if constraints is None else _constraint_list(constraints),
            noise=self.noise if noise is None else None if noise == "estimate" else float(noise),
            weights=self.weights if weights is None else _weights_by_recording(weights, train),
        )

    def weights_of(self, recordings: Sequence[Recording]) -> np.ndarray | None:
        """Return the weight of each recording, or None without weights."""
        if self.weights is None:
            return None
        prints = [fingerprint(r) for r in recordings]
        for r, name in zip(recordings, prints, strict=True):
            if name not in self.weights:
                raise InputError(
                    f"The fit was made with weights of its recordings, and {r.label} is not one of them; give "
                    "weights=, one for each recording."
                )
        return np.array([self.weights[name] for name in prints])

    def all_constraints(self, structure: PILFR | None) -> tuple[Constraint, ...]:
        """List the bounds on spectral radii, then the other constraints."""
        return (*(stability_limits(structure, self.stable) if structure else ()), *self.constraints)


def _weights_by_recording(weights: Any, train: Any) -> dict[str, float]:
    """Map fingerprints to weights; a recording given twice gets the root mean square of both."""
    recordings, sums = as_recordings(train), dict[str, list[float]]()
    for r, weight in zip(recordings, check_weights(weights, len(recordings)), strict=True):
        sums.setdefault(fingerprint(r), []).append(float(weight))
    return {name: float(np.sqrt(np.mean(np.square(some)))) for name, some in sums.items()}


def options_from_limits(limits: Sequence[Limit], structure: PILFR | None, **more: Any) -> FitOptions:
    """Recover the options from the limits in a model file; `more` are options that the file contains."""
    names = dict.fromkeys(limit.name.partition("[")[0] for limit in limits if limit.kind == "constraint")
    radii = [limit.upper for limit in limits if limit.name.startswith(f"{RADIUS} <= ")]
    lost = tuple(name for name in names if not name.startswith(RADIUS))
    return FitOptions(min(radii) if radii else structure is None or not structure.nx, lost=lost, **more)


def _constraint_list(given: Constraint | Sequence[Constraint]) -> tuple[Constraint, ...]:
    """Return one constraint, or several, as a tuple."""
    if isinstance(given, Constraint):
        return (given,)
    if not isinstance(given, Sequence) or not all(isinstance(c, Constraint) for c in given):
        raise InputError(f"constraints = {given!r} was given; give a Constraint, or a list of them.")
    return tuple(given)


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model and how it came about.

    Attributes
    ----------
    model : Model
        Closed model with the fitted values as its parameters' values.
    structure : PILFR or None
        The structure that was fitted, if it was a PI-LFR.
    solution : Solution
        Status, cost, iterations, history, multipliers.
    train_nrmse : tuple of float
        NRMSE (Eq. 27) of each training recording.
    initial : dict
        Fingerprint of each training recording -> state with memory at its first sample.
    labels : tuple of str
        Names of the variables in `solution.theta`.
    errors : dict
        Standard errors by parameter name, in the gauge of `standard_errors`; nan where fixed or at a bound, inf where
        the data and the user's priors do not determine them (priors added by the search do not count).
    active : tuple of str
        Variables that are at a bound, with their values, and constraints that are at a limit.
    limits : tuple of Limit
        Every constraint, and every bound that is active, with its value and its multiplier.
    linear : Model or None
        The linear model that the search began with, `linear_nrmse` its NRMSE on each training recording.
    candidates : tuple of Candidate
        Every start that was tried.
    options : FitOptions
        Bound on spectral radii, constraints, noise and weights, which also apply to fits made from this one.
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
    options: FitOptions = FitOptions()
    simulator: Simulator | None = None

    @property
    def status(self) -> Status:
        """How the winning solve ended."""
        return self.solution.status

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """Fitted values by name."""
        return {name: p.value for name, p in self.model.parameters.items()}

    def with_simulator(self, simulator: Simulator) -> Fit:
        """Return the fit of a simulator's model with the simulator at the fitted values."""
        own = {name: self.model.parameters[name] for name in simulator.parameters}
        return replace(self, simulator=simulator.with_parameters(own))

    @cached_property
    def _engine(self) -> Engine:
        return make_engine(self.model, self.engine)

    def initial_state(self, recording: Recording) -> np.ndarray:
        """Find the state with memory at a recording's first sample, as its `initial` says.

        An estimated state of a training recording comes from the fit. For any other recording it is fitted to the first
        samples (ten per state, at least 50) at the model's parameters. Later samples are not used, and `nrmse` does not
        score the first ones.
        """
        recording = self.matched(recording)
        known = self.initial.get(fingerprint(recording))
        if known is not None:
            return known
        return estimate_initial_state(self.model, self._engine, recording, state_prior=True)

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulate the outputs for a recording's inputs, shape (M, n_y), in the units of the model (`units`).

        `matched(recording)` has the measured outputs in the same units.

        Raises
        ------
        InputError
            If it is not a recording, or the recording does not fit the model.
        """
        return self.signals(recording)["y"]

    def signals(self, recording: Recording) -> dict[str, np.ndarray]:
        """Simulate `y` (M, n_y) with the element's `z` and `w` (M, n_w)."""
        recording = self.matched(recording)
        state = self.initial_state(recording)
        y, _, z, w = self._engine.simulate(self.model.drive(recording), self.model.parameters.start, state, True)
        return {"y": y, "z": z, "w": w}

    def run(self, recording: Recording) -> tuple[Recording, np.ndarray, int]:
        """Return a recording with the model's channels, its simulated outputs (M, n_y), and its first scored sample."""
        recording = self.matched(recording)
        return recording, self.simulate(recording), self.scored_from(recording)

    def scored_from(self, recording: Recording) -> int:
        """Find the first scored sample: after `skip`, and after the samples to which an initial state is fitted."""
        recording = self.matched(recording)
        estimated = recording.begins == "estimate"
        if not estimated or fingerprint(recording) in self.initial or not self.model.n_state:
            return recording.skip
        first = max(recording.skip, samples_for_state(self.model))
        if first >= len(recording):
            raise InputError(
                f"The recording has {len(recording)} samples, but its initial state is fitted to the first "
                f"{samples_for_state(self.model)}, which are not scored; give a longer one, or its initial state."
            )
        return first

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """Compute the NRMSE (Eq. 27) over outputs, averaged over recordings, in free-run simulation.

        The samples to which the initial state of a test recording is fitted are not scored (`scored_from`). An output
        that rests in one of several recordings is scaled by its deviation over all of them.

        Raises
        ------
        InputError
            If a recording does not fit the model or has no samples left to score, or an output never changes.
        """
        given = [self.matched(r) for r in as_recordings(recordings)]
        first = [self.scored_from(r) for r in given]
        pooled = np.concatenate([r.y[k:] for r, k in zip(given, first, strict=True)])
        nrmse(pooled, pooled)  # refuses an output that never changes
        spread = np.std(pooled, axis=0)
        errors = [nrmse(r.y, self.simulate(r), k, spread) for r, k in zip(given, first, strict=True)]
        return float(np.mean(errors))

    def matched(self, recording: Recording) -> Recording:
        """Return a recording with the model's units and, where its names are the model's, order; check that it fits."""
        if not isinstance(recording, Recording):
            raise InputError(
                f"A {type(recording).__name__} was given to simulate; give a Recording, which holds inputs, outputs "
                "and the time step."
            )
        if self.simulator is not None:
            recording = self.simulator.matched(recording)
            check_hold(self.simulator, recording, self.model.hold)
        recording = self.model.in_order(recording).in_units(self.units)
        n_u, n_y = len(self.model.inputs), self.model.n_y
        unmeasured = recording.n_y == 0 and recording.begins != "estimate"
        if recording.n_u != n_u or not (recording.n_y == n_y or unmeasured):
            raise InputError(
                f"The recording has {recording.n_u} inputs and {recording.n_y} outputs, "
                f"the model {n_u} and {n_y}; they must match."
            )
        if abs(recording.dt / self.dt - 1) > SAME_STEP:
            raise InputError(
                f"The recording's step is {recording.dt:g} s, the model's {self.dt:g} s; resample the recording."
            )
        return recording

    def linear_parts(self, recording: Recording | None = None) -> dict[str, LinearPart]:
        """Return the linear models in the fitted model, by name; see `linear.linear_parts`.

        A fit of a simulator is linearised about the mean state and input of the recording, or about zero.
        """
        if recording is None or "A" in self.model.parameters:
            return linear_parts(self.model, self.dt)
        recording = self.matched(recording)
        drive, p = self.model.drive(recording), self.model.parameters.start
        values = np.broadcast_to(p, (len(drive), len(p)))
        states = accumulate_steps(self.model.closed, self.initial_state(recording), drive, values)[0]
        return linear_parts(self.model, self.dt, np.mean(states, axis=0), np.mean(drive, axis=0))

    def plot(self, recordings: Recording | Sequence[Recording], kind: str = "fit", **options: Any) -> Any:
        """Draw the fit over recordings.

        Parameters
        ----------
        recordings : Recording or several
            `"residuals"` draws the first of them; a simulator is linearised about the means of the first.
        kind : {"fit", "bode", "poles", "residuals"}
            Outputs and hysteresis (`plots.plot_fit`); the Bode diagram of the linear parts over the response measured
            in the recordings (`plots.bode`); their poles and zeros (`plots.pole_zero`); correlations of the residuals
            with themselves and with the inputs (`plots.residual_tests`).
        **options
            Of that function, such as `output` and `input` (numbers from 0) or `lags`.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        InputError
            If a recording does not fit the model, the kind is unknown, or the recording is too short for its tests.
        """
        from ..plots import bode, plot_fit, pole_zero, residual_tests

        given = as_recordings(recordings)
        if kind == "fit":
            return plot_fit(self, recordings, **options)
        if kind == "residuals":
            seen, y, first = self.run(given[0])
            return residual_tests(seen.with_(skip=first), [("this model", y)], **options)
        if kind not in ("bode", "poles"):
            raise InputError(f"kind={kind!r} was given to plot; give fit, bode, poles or residuals.")
        parts = self.linear_parts(given[0])
        if kind == "poles":
            return pole_zero(parts, **options).figure
        return bode(parts, any_bla([self.matched(r) for r in given]), **options)

    def report(
        self,
        folder: str | os.PathLike[str],
        train: Recording | Sequence[Recording],
        test: Recording | Sequence[Recording] = (),
    ) -> Path:
        """Write report.html and model.json into a folder; return the page's path. See `report.fit_report`."""
        return Path(later("report.fit_report")(self, train, test, folder))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the fit as JSON, atomically: an existing file stays as it is until the new one is complete on disk.

        Parameters
        ----------
        path : path
            The file, usually `*.json`. For your own model or simulator it holds only the values (for a simulator with a
            warning); give the model or the simulator to `load`.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_model_file(path, self.content())
        if self.simulator is not None:
            warnings.warn(
                f"{os.fspath(path)} holds the fitted values, not the simulator's equations, which are code; load it "
                "with load(path, model=simulator).",
                stacklevel=2,
            )

    def content(self) -> FitContent:
        """Collect the content of this fit's model file."""
        shared = {f.name: getattr(self, f.name) for f in fields(FitContent) if hasattr(self, f.name)}
        return FitContent(**shared, noise=self.options.noise, weights=self.options.weights)

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """`casadi.Function (x, u) -> (x_next, y)`, operator memory inside x; see `export.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def export(self, **options: Any) -> Any:
        """The step with start state, names and units, for CasADi, C and python-control; see `export.exported`."""
        return exported(self, **options)

    def __str__(self) -> str:
        errors = ", ".join(map(_format_error, self.train_nrmse))
        count = len(self.candidates)
        starts = f" for {count} start{'s' if count > 1 else ''}" if count else ""
        spent = f"{self.seconds:.1f} s{starts}; " if self.seconds else ""
        steps = f"{self.solution.iterations} iteration{'' if self.solution.iterations == 1 else 's'}"
        lines = [
            self.status.value,
            NOTHING_SENTENCE if explains_nothing(self.train_nrmse) else "",
            self.status.advice,
            f"NRMSE on the training recording{'s' if len(self.train_nrmse) > 1 else ''}: {errors}",
            f"{spent}the last solve took {steps}",
            *_describe_starts(self),
            _describe_linear(self),
            self.note,
            *describe_unknown_errors(self.errors),
            f"bounds that are active: {', '.join(self.active) if self.active else 'none'}",
            *_describe_constraints(self),
        ]
        return "\n".join(line for line in lines if line)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(later("report.fit_card")(self))


def save(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write a fit to a file; see `Fit.save`."""
    fit.save(path)


def load(path: str | os.PathLike[str], model: Model | PILFR | Simulator | None = None) -> Fit:
    """Read a fit that `save` wrote; simulations are the same to the last digit.

    A fit of a simulator needs it as `model`, with its equations; the parameters' values come from the file.
    See `export.read_model_file` for parameters, errors and warnings. Each candidate has its seed, error and status, an
    empty `theta` and the fitted model.
    """
    content = read_model_file(path, model)
    shared = {f.name: getattr(content, f.name) for f in fields(content) if f.name in Fit.__dataclass_fields__}
    options = FitOptions()  # files of the first versions have none
    if content.limits is not None:
        options = options_from_limits(content.limits, content.structure, noise=content.noise, weights=content.weights)
    fit = Fit(**{**shared, "limits": content.limits or ()}, options=options)
    return fit.with_simulator(model) if isinstance(model, Simulator) else fit


def _describe_starts(fit: Fit) -> list[str]:
    """Write the errors that the starts reached, and whether the seed has an effect."""
    if not fit.candidates:
        return []
    reached = sorted(c.error for c in fit.candidates)
    several = f"the starts reached NRMSE {_format_error(reached[0])} ... {_format_error(reached[-1])}"
    text = several if len(reached) > 1 else f"the start reached NRMSE {_format_error(reached[0])}"
    if DENSITY_PRIOR in fit.note and reached[0] < float(np.mean(fit.train_nrmse)):
        text += ", before the weak prior that makes the weights smooth"
    drawn = any(c.drawn for c in fit.candidates)
    return [text, "" if drawn else "no start is drawn at random, so the seed has no effect"]


def _describe_linear(fit: Fit) -> str:
    """Write the error of the linear model without the element."""
    if not fit.linear_nrmse:
        return ""
    alone = ", ".join(f"{e:.4f}" for e in fit.linear_nrmse)
    tight = any(v.kind == "constraint" and not v.name.endswith("<= 1") for v in fit.limits)
    without = ", without the constraints" if tight else ""
    return f"the linear model alone{without}, to judge the element by: NRMSE {alone}"


def _describe_constraints(fit: Fit) -> list[str]:
    """Write the constraints: active and unmet ones, then idle ones, whose rows are only counted."""
    constraints = [limit for limit in fit.limits if limit.kind == "constraint"]
    if not constraints:
        return []
    shown = [str(limit) for limit in constraints if limit.active or not limit.met]
    idle = [limit for limit in constraints if limit.met and not limit.active]
    shown += [str(limit) for limit in idle if "[" not in limit.name]
    rows = [limit.name.partition("[")[0] for limit in idle if "[" in limit.name]
    shown += [f"{len(rows)} not active ({', '.join(dict.fromkeys(rows))})"] if rows else []
    return [f"constraints: {'; '.join(shown)}", describe_unknown_multipliers(fit.limits, fit.status)]


def _format_error(error: float) -> str:
    return f"{error:.4f}" if error < 1e4 else f"{error:.3g}"


def with_solution(model: Model, problem: Problem, solution: Solution) -> Model:
    """Return the model at the values of a solution."""
    return model.with_parameters(model.parameters.at(problem.parameters(solution.theta)))
