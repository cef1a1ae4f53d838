"""Build the exported step of a fit, a simulator, a model or a diagnosis, with named states and a start state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol, TypeGuard

import casadi as ca
import numpy as np

from .._base import LARGEST, InputError, is_number, numbers, positive, whole
from ..data import COURSES, SAME_STEP, Recording, known_hold, step_hold
from ..engine import make_engine
from ..models import Model, PrandtlIshlinskii
from ..optimise import estimate_initial_state
from ..simulators import ClosedEquations, Instant, Simulator, choose_substeps, discretise, on_grid
from .c_code import check_name, make_unique
from .smoothing import smooth_kinks
from .step import Exported

REST_SAMPLES = 400  # samples of a recording at rest, for the choice of a simulator's sub-steps
TIME, NEXT = "time", "_next"


class FittedModel(Protocol):
    """A model with its own time step, such as a `Fit`."""

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
    """Export a model as one step `(x, u) -> (x_next, y)`, with start state, names and units.

    Parameters
    ----------
    model : Fit, Simulator, Model or Diagnosis
        A simulator is exported with the laws in its ports, at its parameters' values; a diagnosis exports its corrected
        simulator.
    dt : float
        Duration of a step, s: required for a simulator and a model; a fit and a diagnosis have their own.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        Inter-sample behaviour of the inputs, for a simulator; default: its own, else "zero". A step takes band-limited
        inputs as linear, because it does not know the samples around it. The input of a step acts until the next one,
        also if recordings hold the next values.
    substeps : int, optional
        Runge-Kutta steps per sample, for a simulator; by default chosen from its fastest eigenvalue.
    start : Recording or array, optional
        State that `x0()` returns: an array with or without memory, or the state at a recording's first sample, as its
        `initial` says.
    smooth : float
        eps > 0 rounds min, max, |.| and sign (`smoothing`), for solvers that need derivatives everywhere; the error is
        `Exported.bound`.
    name : str
        Name of the function: up to 50 letters, digits and single underscores, beginning with a letter; not a C keyword.

    Raises
    ------
    InputError
        If an option is missing or does not fit the model.
    """
    check_name(name)
    if not is_number(smooth) or not 0 <= smooth <= LARGEST:
        raise InputError(
            f"smooth = {smooth!r} was given; give a number, from zero to {LARGEST:g}, in the signals' units."
        )
    if not isinstance(model, Simulator | Model) and not _is_fitted(model):
        if isinstance(model, type) or not callable(getattr(model, "export", None)):
            given = "a class" if isinstance(model, type) else f"a {type(model).__name__}"
            raise InputError(f"{given} was given; give a Fit, a Simulator, a Model or a Diagnosis.")
        if any(option is not None for option in (dt, hold, substeps)):
            raise InputError("A diagnosis has its own step and hold; leave dt, hold and substeps out.")
        corrected: Exported = model.export(name=name, smooth=smooth, start=start)
        return corrected
    rhs = None
    if isinstance(model, Simulator):
        dt = _check_dt(dt)
        closed = _discretise_over_sample(model, dt, hold, substeps)
        step = _build_step(closed, dt, model)
        rhs = _make_right_hand_side(model, f"{name.rstrip('_')}_rhs")
    else:
        if hold is not None or substeps is not None:
            raise InputError("The model has its own steps; `hold` and `substeps` are for simulators, leave them out.")
        if not isinstance(model, Model) and dt not in (None, model.dt):
            raise InputError(f"dt = {dt!r} was given, but the fit's step is {model.dt:g} s; leave dt out.")
        closed, dt = (model, _check_dt(dt)) if isinstance(model, Model) else (model.model, model.dt)
        step = _build_step(closed, dt)
    return replace(
        step,
        name=name,
        smooth=float(smooth),
        start=_find_start_state(model, closed, step, start),
        units={k: v for k, v in getattr(model, "units", {}).items() if v},
        rhs=smooth_kinks(rhs, smooth) if rhs is not None and smooth else rhs,
    )


def to_casadi(model: Any, name: str = "model", **options: Any) -> ca.Function:
    """Export one step of a model as `casadi.Function (x, u) -> (x_next, y)`, in engineering units.

    Parameters
    ----------
    model, name, **options
        As for `exported`; the model's values become constants of the function.

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
        As `exported`.
    """
    return exported(model, name=name, **options).step


def _is_fitted(model: Any) -> TypeGuard[FittedModel]:
    return isinstance(getattr(model, "model", None), Model) and callable(getattr(model, "initial_state", None))


def _check_dt(dt: float | None) -> float:
    return positive(dt, "dt", "the duration of a step in s")


def _discretise_over_sample(model: Simulator, dt: float, hold: str | None, substeps: int | None) -> Model:
    hold = step_hold(known_hold(hold) or model.hold or "zero")
    chosen = _choose_substeps_at_rest(model, dt) if substeps is None else whole(substeps, "substeps", 1)
    return discretise(model, dt, hold, chosen)


def _choose_substeps_at_rest(simulator: Simulator, dt: float) -> int:
    """Choose sub-steps per sample from the fastest eigenvalue at rest."""
    u, y = (np.zeros((REST_SAMPLES, len(names))) for names in (simulator.inputs, simulator.output_names))
    return choose_substeps(simulator, [Recording(u, y, dt)])


def _find_start_state(model: Any, closed: Model, step: Exported, start: Any) -> np.ndarray | None:
    """Find the start state, (n_x,), from a recording, an array or nothing."""
    n, size = closed.n_state, len(step.states)
    if start is None:
        return None
    if isinstance(start, Recording):
        if _is_fitted(model):
            state = model.initial_state(start)
        else:
            start = model.matched(start) if isinstance(model, Simulator) else start
            _check_recording(closed, step, start)
            state = estimate_initial_state(closed, make_engine(closed), start)
        if not np.all(np.isfinite(state)):
            raise InputError("The state at the recording's first sample is not finite; give another start.")
        return np.append(state, np.full(size - n, start.start))  # the time, if it is a state
    given = numbers(start, "The start state").ravel()
    if given.size not in (len(closed.states), n, size):
        fewer = f"{len(closed.states)} (memory zero) or " if size > len(closed.states) else ""
        raise InputError(f"The start state has {given.size} numbers; give {fewer}{size}.")
    return np.append(given, np.zeros(size - given.size))


def _check_recording(model: Model, step: Exported, recording: Recording) -> None:
    unmeasured = not recording.n_y and recording.begins != "estimate"
    if recording.inputs != model.inputs or not (unmeasured or recording.outputs == model.outputs):
        raise InputError(
            f"The recording has {', '.join((*recording.inputs, *recording.outputs))}, the model "
            f"{', '.join((*model.inputs, *model.outputs))}; they must be the same, in this order."
        )
    if abs(recording.dt / step.dt - 1) > SAME_STEP:
        raise InputError(f"The recording's step is {recording.dt:g} s, the export's {step.dt:g} s; use the same.")


def _build_step(model: Model, dt: float, simulator: Simulator | None = None) -> Exported:
    """Build the step of a closed model and name its states; `simulator` gives the names of its laws' states."""
    if model.n_w and model.element is None and not model.n_s:
        raise InputError("The model has an open port; close it with close_loop first.")
    if "y" in model.reads:
        raise InputError("The model is corrected by measured outputs at every step; export the model without that.")
    reads = tuple(signal for signal in model.reads if signal != "next" or not COURSES[model.hold].begin)
    columns = {signal: ca.SX.sym(signal, 1 if signal == "t" else len(model.inputs)) for signal in reads}
    row = ca.vertcat(*(columns.get(signal, columns["u"]) for signal in model.reads))  # the input acts at once
    arguments = [ca.SX.sym("x", model.n_state), ca.vertcat(*columns.values()), ca.SX.sym("p", model.parameters.size)]
    found = [ca.densify(e) for e in model.closed(arguments[0], row, arguments[2])]
    parametric = ca.Function("one", arguments, found, ["x", "row", "p"], ["x_next", "y"])
    parameters = model.parameters if simulator is None else simulator.readable_parameters()
    if simulator is None:
        states, thresholds, memory = _name_element_states(model)
    else:
        states, thresholds, memory = _name_law_states(model, dt, simulator)
    inputs = model.inputs + (tuple(f"{name}{NEXT}" for name in model.inputs) if "next" in reads else ())
    names = make_unique([*states, *([TIME] if "t" in model.reads else [])])
    renamed = dict(zip(states, names, strict=False))
    return Exported(
        parametric=parametric,
        parameters=parameters,
        reads=reads,
        substeps=model.substeps,
        dt=dt,
        hold=model.hold,
        states={name: i for i, name in enumerate(names)},
        inputs=make_unique(inputs),
        outputs=model.outputs,
        thresholds={renamed[name]: value for name, value in thresholds.items()},
        memory_names=tuple(renamed[name] for name in memory),
    )


def _make_right_hand_side(simulator: Simulator, name: str) -> ca.Function | None:
    """Make `(x, u) -> (xdot, y)`, or `(x, u, t) -> (xdot, y)` if the equations read the time.

    x holds the states of the simulator, then of its laws; inputs are constant. The result is None for a simulator in
    discrete time or with laws that have discrete memory.
    """
    if simulator.discrete:
        return None
    equations = ClosedEquations(simulator, ca.SX(simulator.parameter_set.start))
    if sum(equations.n_s):
        return None
    n_u = len(simulator.inputs)
    x, u, t = ca.SX.sym("x", len(simulator.states) + sum(equations.n_q)), ca.SX.sym("u", n_u), ca.SX.sym("t")
    found = equations.evaluate(Instant(x, ca.SX(0, 1), u, ca.SX.zeros(n_u), t))[:2]
    xdot, y = (ca.densify(e) for e in found)
    arguments = {"x": x, "u": u} | ({"t": t} if ca.depends_on(ca.vertcat(xdot, y), t) else {})
    return ca.Function(name, list(arguments.values()), [xdot, y], list(arguments), ["xdot", "y"])


def _name_element_states(model: Model) -> tuple[list[str], dict[str, float], list[str]]:
    """Name linear states, then the element's memory; `memory[0,3]` belongs to the threshold r[0,3].

    Returns all names, the thresholds by name of their memory, and the names of the memory.
    """
    states = [*model.states, *(f"state{k + 1}" for k in range(len(model.states), model.n_x))]
    if not isinstance(model.element, PrandtlIshlinskii):
        unnamed = [f"memory[{k}]" for k in range(model.n_s)]
        return [*states, *unnamed], {}, unnamed
    r = np.asarray(model.parameters["r"].value)
    thresholds = {f"memory[{i},{j}]": float(r[i, j]) for i, j in np.ndindex(r.shape)}
    return [*states, *thresholds], thresholds, list(thresholds)


def _name_law_states(model: Model, dt: float, simulator: Simulator) -> tuple[list[str], dict[str, float], list[str]]:
    """Name a simulator's states, then its laws' own states and memory: `ground.q1`, `ground.memory1`."""
    simulator = on_grid(simulator, dt / model.substeps)
    equations = ClosedEquations(simulator, ca.SX(simulator.parameter_set.start))
    flows, memory, operators = list[str](), list[str](), list[str]()
    thresholds: dict[str, float] = {}
    for element, n_q, n_s in zip(simulator.elements, equations.n_q, equations.n_s, strict=True):
        flows += [f"{element.prefix}q{k + 1}" for k in range(n_q)]
        own = [f"{element.prefix}memory{k + 1}" for k in range(n_s)]
        p = simulator.parameters.get(f"{element.prefix}r")
        r = np.ravel(p.value) if p is not None else np.zeros(0)
        thresholds |= dict(zip(own, map(float, r), strict=True)) if len(r) == n_s else {}
        memory += own
        operators += [] if getattr(element.law, "shifts", False) else own
    return [*simulator.states, *flows, *memory], thresholds, operators
