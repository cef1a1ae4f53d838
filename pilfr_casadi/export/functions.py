"""Models as CasADi functions, for controllers and simulations elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol, TypeGuard

import casadi as ca
import numpy as np

from .._base import LARGEST, InputError, is_number, numbers
from ..data import Recording
from ..engine import make_engine
from ..models import Model
from ..optimise import first_state
from ..simulators import Simulator, choose_substeps, discretise
from .checked_step import CheckedStep
from .exported_model import Exported
from .names import check_name
from .sampled import Sampled, right_hand_side, sampled
from .smoothing import smoothed


class FittedModel(Protocol):
    """A model with a time step of its own, such as a `Fit`."""

    @property
    def model(self) -> Model:
        """Closed model at its fitted values."""

    @property
    def dt(self) -> float:
        """Duration of a step, s."""

    def initial_state(self, recording: Recording) -> np.ndarray:
        """State with memory at a recording's first sample."""


def exported(
    model: Any,
    *,
    dt: float | None = None,
    hold: str | None = None,
    substeps: int | None = None,
    start: Any = None,
    smooth: float = 0.0,
    name: str = "model",
) -> Exported:
    """A model as one step `(x, u) -> (x_next, y)`, with start state, names and units.

    Parameters
    ----------
    model : Fit, Simulator, Model or Diagnosis
        A simulator is taken with the laws in its ports, at its parameters' values; of a diagnosis, the corrected one.
    dt : float
        Duration of a step, s: needed for a simulator and a model; a fit and a diagnosis have theirs.
    hold : {"zero", "linear"}, optional
        What inputs do between samples, for a simulator; default: what it says itself, else "zero".
    substeps : int, optional
        Runge-Kutta steps a sample, for a simulator; chosen from its fastest eigenvalue where left out.
    start : Recording or array, optional
        Where `x0()` is: at a recording's first sample, as its `initial` says, or given, with or without memory.
    smooth : float
        eps > 0 rounds min, max, |.| and sign (`smoothing`), for solvers that need derivatives everywhere; the error is
        `Exported.bound`.
    name : str
        Name of the function: up to 50 letters, digits and single underscores, beginning with a letter; no word of C.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        If something is missing or does not fit; one sentence says what.
    """
    check_name(name)
    if not is_number(smooth) or not 0 <= smooth <= LARGEST:
        raise InputError(
            f"smooth = {smooth!r} was given; give a number, from zero to {LARGEST:g}, in the signals' units."
        )
    rhs = None
    if isinstance(model, Model) or _is_fitted(model):
        if hold is not None or substeps is not None:
            raise InputError("The model has its own steps; `hold` and `substeps` are for simulators, leave them out.")
        closed, step = _of_model(model, dt)
    elif isinstance(model, Simulator):
        closed, step = _of_simulator(model, dt, hold, substeps)
        rhs = right_hand_side(model, f"{name}_rhs")
    elif callable(getattr(model, "export", None)):
        given = {"dt": dt, "hold": hold, "substeps": substeps}
        if any(v is not None for v in given.values()):
            raise InputError("A diagnosis has its own step and hold; leave dt, hold and substeps out.")
        found: Exported = model.export(name=name, smooth=smooth, start=start)
        return found
    else:
        what = "a class" if isinstance(model, type) else f"a {type(model).__name__}"
        raise InputError(f"{what} was given; give a Fit, a Simulator, a Model or a Diagnosis.")
    one = smoothed(step.one, smooth) if smooth else None
    return Exported(
        step=CheckedStep(step.function(name, one)),
        start=_start(model, closed, step, start),
        states={n: i for i, n in enumerate(step.states)},
        thresholds=step.thresholds,
        inputs=step.inputs,
        outputs=step.outputs,
        units={k: v for k, v in getattr(model, "units", {}).items() if v},
        dt=step.dt,
        smooth=float(smooth),
        rhs=smoothed(rhs, smooth) if rhs is not None and smooth else rhs,
        sampled=step,
    )


def _is_fitted(model: Any) -> TypeGuard[FittedModel]:
    return isinstance(getattr(model, "model", None), Model) and callable(getattr(model, "initial_state", None))


def _of_model(model: FittedModel | Model, dt: float | None) -> tuple[Model, Sampled]:
    """A fit or a model closed, and as a step."""
    if isinstance(model, Model):
        return model, sampled(model, _duration(dt))
    if dt is not None and dt != model.dt:
        raise InputError(f"dt = {dt!r} was given, but the fit's step is {model.dt:g} s; leave dt out.")
    return model.model, sampled(model.model, model.dt)


def _of_simulator(model: Simulator, dt: float | None, hold: str | None, substeps: int | None) -> tuple[Model, Sampled]:
    """A simulator integrated over one sample, and as a step."""
    dt, hold = _duration(dt), hold or model.hold or "zero"
    if hold not in ("zero", "linear"):
        raise InputError(f"hold = {hold!r} was given; use 'zero' or 'linear'.")
    whole = isinstance(substeps, int | np.integer) and not isinstance(substeps, bool)
    if substeps is not None and not (whole and substeps >= 1):
        raise InputError(f"substeps = {substeps!r} was given; give a whole number, 1 or more.")
    closed = discretise(model, dt, hold, int(substeps or _substeps(model, dt)))
    return closed, sampled(closed, dt, model)


def to_casadi(model: Any, name: str = "model", **options: Any) -> ca.Function:
    """One step of a model as `casadi.Function (x, u) -> (x_next, y)`, in engineering units.

    Parameters
    ----------
    model : Fit, Simulator, Model or Diagnosis
        The model; its values become constants of the function.
    name : str
        Name of the function: up to 50 letters, digits and single underscores, beginning with a letter; no word of C.
    **options
        Those of `exported`: for a simulator `dt`, `hold`, `substeps`; `smooth`.

    Returns
    -------
    casadi.Function
        `x` (n_x + n_s,) holds the linear states in the order of `fit.model.states`, then the operators' memory: channel
        by channel, and inside a channel in the order of the thresholds `r[i, :]` (the play state, for stops too). `u`
        is (n_u,), `x_next` like `x`, `y` (n_y,). A step takes `fit.dt` s; `fit.initial_state(recording)` is an `x`.
        `exported` gives the same with a map of the states' names, start state and units.

    Raises
    ------
    InputError
        If CasADi does not take the name, or an option does not fit the model.
    """
    return exported(model, name=name, **options).step


def _duration(dt: float | None) -> float:
    if not is_number(dt) or not 0 < dt < np.inf:
        raise InputError(f"dt = {dt!r} was given; give the duration of a step in s, above zero.")
    return float(dt)


def _substeps(simulator: Simulator, dt: float) -> int:
    """Sub-steps a sample, from the fastest eigenvalue at rest, and what the laws need at least."""
    if simulator.discrete:
        return 1
    # without inputs, one that nothing reads stands for them
    driven = simulator if simulator.inputs else replace(simulator, inputs=("none",))
    at_rest = Recording(np.zeros((400, len(driven.inputs))), np.zeros((400, len(driven.output_names))), dt)
    least = max((getattr(e.law, "substeps", 1) for e in simulator.elements), default=1)
    return max(choose_substeps(driven, [at_rest]), least)


def _start(model: Any, closed: Model, step: Sampled, start: Any) -> np.ndarray:
    n, size = closed.n_state, len(step.states)
    if start is None:
        return np.zeros(size)
    if isinstance(start, Recording):
        if _is_fitted(model):
            state = model.initial_state(start)
        else:
            if (start.inputs, start.outputs) != (closed.inputs, closed.outputs):
                raise InputError(
                    f"The recording has {', '.join((*start.inputs, *start.outputs))}, the model "
                    f"{', '.join((*closed.inputs, *closed.outputs))}; they must be the same, in this order."
                )
            if abs(start.dt / step.dt - 1) > 1e-4:
                raise InputError(f"The recording's step is {start.dt:g} s, that of the export {step.dt:g} s; use one.")
            state = first_state(closed, make_engine(closed), start)
        if not np.all(np.isfinite(state)):
            raise InputError("The state at the recording's first sample is not finite; give another start.")
        return np.append(state, np.zeros(size - n))
    given = numbers(start, "The start state").ravel()
    if given.size not in (len(closed.states), n, size):
        raise InputError(
            f"The start state has {given.size} numbers; give {len(closed.states)} (memory zero) or {size}."
        )
    return np.append(given, np.zeros(size - given.size))
