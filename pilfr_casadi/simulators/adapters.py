"""Simulators from other sources: a user's Python file, a `control.StateSpace`, and a fitted PI-LFR.

A state space becomes equations whose matrix entries are parameters: entries that are exactly 0, 1 or -1 are structure
and stay constant; the others may change within a factor of two. A fitted model runs in discrete time, with its memory
among the states and its parameters fixed, because it has been fitted already; only a gain near one and an offset of
each output are free.
"""

from __future__ import annotations

import os
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, quote_error
from ..data import SAME_STEP, Recording, default_names
from ..models import Model, Parameter
from .equations import Named
from .simulator import Simulator
from .user_file import user_variable

FACTOR = 2.0  # by which an entry of a state space may change
GAIN_BOUNDS = (0.7, 1.3)  # of the gain of a fitted model's output
VARIABLE = "simulator"  # name of the variable that a simulator file sets


def as_simulator(thing: Any, recordings: Sequence[Recording] = ()) -> Simulator:
    """Convert a simulator, a linear system or a fitted model to a simulator.

    Parameters
    ----------
    thing : Simulator, control.StateSpace, control.TransferFunction, Fit or Model
        Unnamed signals get the names of the recordings' signals.
    recordings : sequence of Recording
        Recordings whose step a discrete-time system must have.

    Raises
    ------
    InputError
        If it is something else, or its step or number of signals differs from the recordings'.
    """
    if isinstance(thing, Simulator):
        return thing
    if isinstance(thing, Model):
        return _from_model(thing, recordings, {})
    if isinstance(getattr(thing, "model", None), Model):  # a Fit
        _check_step(float(thing.dt), recordings)
        return _from_model(thing.model, recordings, getattr(thing, "units", {}))
    if type(thing).__module__.partition(".")[0] == "control" and hasattr(thing, "ninputs"):
        return _from_system(thing, recordings)
    given = "a class" if isinstance(thing, type) else f"a {type(thing).__name__}"
    raise InputError(f"{given} was given; give a Simulator, a control.StateSpace, or a fitted PI-LFR.")


def _check_step(dt: float, recordings: Sequence[Recording]) -> None:
    for r in recordings:
        if abs(r.dt / dt - 1) > SAME_STEP:
            raise InputError(f"The model's step is {dt:g} s, that of {r.label} {r.dt:g} s; resample the recording.")


def _from_model(model: Model, recordings: Sequence[Recording], units: Mapping[str, str]) -> Simulator:
    if model.n_w and model.element is None:
        raise InputError("The model has an open port; close it with close_loop first.")
    if model.reads != ("u",) or model.substeps != 1:
        raise InputError("The model was made from a simulator; give the simulator itself.")
    own, parameters = model.parameters, {k: Parameter(p.value, p.unit, fixed=True) for k, p in model.parameters.items()}
    for name in model.outputs:
        deviations = [np.std(r.y[:, r.outputs.index(name)]) for r in recordings if name in r.outputs]
        reach = float(max(deviations, default=np.inf))
        parameters[f"gain_{name}"] = Parameter(1.0, bounds=GAIN_BOUNDS)
        parameters[f"offset_{name}"] = Parameter(0.0, bounds=(-reach, reach))
    states = tuple(model.states)
    states += tuple(f"memory{i + 1}" for i in range(model.n_state - len(states)))

    def step(x: Named, u: Named, p: Named) -> Any:
        state = ca.vertcat(ca.SX(0, 1), *(x[n] for n in states))
        vector = ca.vertcat(ca.SX(0, 1), *(ca.vec(p[n]) for n in own))
        return model.closed(state, ca.vertcat(*(u[n] for n in model.inputs)), vector)

    def dynamics(x: Named, u: Named, p: Named) -> dict[str, Any]:
        return {n: step(x, u, p)[0][i] for i, n in enumerate(states)}

    def outputs(x: Named, u: Named, p: Named) -> dict[str, Any]:
        y = step(x, u, p)[1]
        return {n: p[f"gain_{n}"] * y[i] + p[f"offset_{n}"] for i, n in enumerate(model.outputs)}

    return Simulator(dynamics, outputs, states, model.inputs, parameters, discrete=True, hold="zero", units=dict(units))


def _from_system(system: Any, recordings: Sequence[Recording]) -> Simulator:
    import control

    try:
        system = control.ss(system)
    except Exception as error:
        raise InputError(f"The system cannot be written as a state space ({quote_error(error)}); give one.") from error
    matrices = {"A": system.A, "B": system.B, "C": system.C, "D": system.D}
    if not all(np.all(np.isfinite(m)) for m in matrices.values()):
        raise InputError("The state space has entries that are not finite; give numbers.")
    discrete = bool(system.isdtime(strict=True))
    if discrete and system.dt is not True:
        _check_step(float(system.dt), recordings)
    first = recordings[0] if recordings else None
    inputs = _choose_names(system.input_labels, "u", first.inputs if first else ())
    outputs = _choose_names(system.output_labels, "y", first.outputs if first else ())
    states = _choose_names(system.state_labels, "x", ())
    return _linear_simulator(matrices, states, inputs, outputs, discrete)


def _linear_simulator(
    matrices: Mapping[str, np.ndarray],
    states: tuple[str, ...],
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    discrete: bool,
) -> Simulator:
    """Make `ẋ = A x + B u, y = C x + D u` (or `x⁺`) with a parameter for every entry that is not 0, 1 or -1."""
    parameters: dict[str, Parameter] = {}
    entries: dict[str, np.ndarray] = {}  # numbers, or names of parameters
    for letter, matrix in matrices.items():
        entries[letter] = np.array(matrix, dtype=object)
        for (i, j), value in np.ndenumerate(np.asarray(matrix, dtype=float)):
            if value not in (0.0, 1.0, -1.0):
                name = f"{letter}{i + 1}{j + 1}" if max(matrix.shape) < 10 else f"{letter}{i + 1}_{j + 1}"
                parameters[name] = Parameter(value, bounds=_bound_entry(value, letter == "A" and discrete))
                entries[letter][i, j] = name

    def product(letter: str, i: int, symbols: list[Any], p: Named) -> Any:
        total: Any = 0
        for entry, symbol in zip(entries[letter][i], symbols, strict=True):
            total = total + (p[entry] if isinstance(entry, str) else entry) * symbol
        return total

    def dynamics(x: Named, u: Named, p: Named) -> dict[str, Any]:
        xs, us = [x[n] for n in states], [u[n] for n in inputs]
        return {n: product("A", i, xs, p) + product("B", i, us, p) for i, n in enumerate(states)}

    def outputs_of(x: Named, u: Named, p: Named) -> dict[str, Any]:
        xs, us = [x[n] for n in states], [u[n] for n in inputs]
        return {n: product("C", i, xs, p) + product("D", i, us, p) for i, n in enumerate(outputs)}

    hold = "zero" if discrete else None
    return Simulator(dynamics, outputs_of, states, inputs, parameters, discrete=discrete, hold=hold)


def _bound_entry(value: float, pole: bool) -> tuple[float, float]:
    """Bound an entry by a factor of two; bound an entry of a discrete A also by half its distance to one."""
    if pole and abs(value) < 1:
        reach = min(abs(value) * (FACTOR - 1), max(0.5 * (1 - abs(value)), 1e-3))
        return value - reach, value + reach
    ends = (value / FACTOR, value * FACTOR)
    return min(ends), max(ends)


def _choose_names(labels: Sequence[str], letter: str, recorded: tuple[str, ...]) -> tuple[str, ...]:
    """Return the system's own names; replace u[0], u[1], ... by the recordings' names, or by u or u1, u2, ..."""
    own = tuple(str(label) for label in labels)
    if own != tuple(f"{letter}[{i}]" for i in range(len(own))):
        return own
    if len(recorded) == len(own) and recorded:
        return recorded
    return default_names(letter, len(own))


def load_simulator(path: str | os.PathLike[str]) -> Simulator:
    """Run a simulator file and return its variable `simulator` as a `Simulator`.

    Parameters
    ----------
    path : path
        A Python file that sets the variable `simulator` to a `Simulator` (or to what `as_simulator` accepts). It may
        import modules of the same folder.

    Raises
    ------
    InputError
        If the file cannot be read, does not run, or defines no simulator; with the line where there is one.
    """
    return as_simulator(simulator_variable(path))


def simulator_variable(path: str | os.PathLike[str]) -> Any:
    """Run a simulator file and return its variable `simulator` as it is; see `load_simulator`."""

    def checked(path: Path, module: types.ModuleType) -> None:
        names = [n for n, v in vars(module).items() if isinstance(v, Simulator) and not n.startswith("_")]
        if VARIABLE not in vars(module):
            there = f"it calls a Simulator {names[0]!r}; rename it" if names else "end with simulator = Simulator(...)"
            raise InputError(f"{path} does not set the variable {VARIABLE!r}: {there}.")
        try:
            as_simulator(vars(module)[VARIABLE])
        except InputError as error:
            raise InputError(f"In {path}, the variable {VARIABLE!r}: {error}") from error

    return user_variable(path, VARIABLE, "the simulator", checked)
