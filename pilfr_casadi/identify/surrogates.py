"""A linear surrogate in named modes for a simulation known only by its inputs and outputs.

A discrete model is identified from the simulation's record and converted to real modes in continuous time
(`modal_form`). Their frequencies, dampings and gains are parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, whole
from ..data import Recording, as_recordings, check_for_identification, nrmse, step_hold
from ..models import PILFR, Parameter
from ..simulators import Named, Port, Simulator, one_hold
from .fitting import fit
from .modal_form import Mode, modes, to_continuous

POOR_SURROGATE = 0.02  # NRMSE above which a simulation is too nonlinear for a surrogate
RANGE = 0.3  # how far parameters may move, as a share of their values
EXACT_ERROR = 1e-3  # NRMSE below which no higher order is tried
HIGHEST = 8  # highest order that is tried
NEGLIGIBLE_SHARE = 1e-3  # share of an output below which a coefficient is fixed
# names of the gains of inputs on a mode's displacement and rate, and of displacement and rate in the outputs
INPUT_GAINS, OUTPUT_GAINS = ("gain on the displacement of", "gain of"), ("seen in", "rate seen in")
Array = np.ndarray
Equation = Callable[[Named, Named, Named], dict[str, Any]]


def surrogate(recordings: Recording | Sequence[Recording], *, nx: int | None = None) -> tuple[Simulator, float]:
    """Identify a linear simulator from the inputs and outputs of a simulation.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Inputs and outputs of the simulation.
    nx : int, optional
        Number of states; chosen from the recordings if left out.

    Returns
    -------
    Simulator
        The simulator in modes, with ports `mode:<frequency> Hz`; its parameters may move by 30 %.
    float
        Its NRMSE on the recordings, in free-run simulation from the fitted initial state.

    Raises
    ------
    InputError
        If nothing can be identified from the recordings or they differ in `hold`, or nx is not a whole number of 0 or
        more.
    """
    records = check_for_identification(as_recordings(recordings), 40)
    hold = one_hold(records)
    # the sampled model has other states: with interpolated inputs, rest is not zero there
    records = tuple(r if r.period else r.with_(initial="estimate") for r in records)
    found: list[tuple[float, Simulator]] = []
    # a simulation has no noise, so its order is evident
    for n in range(HIGHEST + 1) if nx is None else (whole(nx, "nx", 0),):
        identified = _identify(records, n, hold)
        if identified is not None:
            found.append(identified)
        if found and found[-1][0] < EXACT_ERROR:
            break
    if not found:
        raise InputError(
            "No linear model in continuous time follows the simulation; give the simulator itself, or a simulation "
            "at a shorter step."
        )
    least = min(error for error, _ in found)
    error, simulator = next(f for f in found if f[0] <= max(1.1 * least, EXACT_ERROR))
    return simulator, error


def surrogate_warning(error: float) -> str:
    """Return a warning if the NRMSE `error` of a surrogate shows that the simulation is not linear, else ""."""
    if error <= POOR_SURROGATE:
        return ""
    return (
        "The linear model is poor: the simulation is not linear there, and the error of the model may show up as "
        "missing physics. Give the simulator itself if you have it."
    )


def _identify(records: Sequence[Recording], n: int, hold: str | None) -> tuple[float, Simulator] | None:
    """Identify a simulator of order n; return its NRMSE and the simulator, or None if there is no such model."""
    try:
        found = fit(PILFR(n), records)
    except InputError:
        return None
    p = found.parameters
    a, b, c, d = (p[k] for k in ("A", "B_u", "C_y", "D_yu"))
    options = []
    for between in (step_hold(hold),) if hold else ("zero", "linear"):
        try:
            continuous = to_continuous(a, b, c, d, records[0].dt, between)
        except InputError:
            continue
        direct = np.max(np.abs(continuous[3]) / np.maximum(np.abs(d).max(), 1e-300), initial=0.0)
        options.append((float(direct), between, continuous))
    if not options:
        return None
    # a simulation without direct feed-through reveals the course of its inputs between samples
    _, between, matrices = min(options, key=lambda o: o[0]) if not hold else options[0]
    simulator = replace(modal_simulator(matrices, np.ravel(p["y_0"]), records[0]), hold=hold or between)
    errors = [nrmse(r.y, found.simulate(r), skip=r.skip) for r in records]
    return float(np.mean(errors)), simulator


def _as_mass(mode: Mode, slow: float) -> Mode:
    """Turn a second-order mode too slow to oscillate in a recording into a mass with almost no spring."""
    if not mode.second_order or mode.spring or abs(mode.value) > slow:
        return mode
    return replace(mode, spring=(abs(mode.value) ** 2, -2 * mode.value.real))


def modal_simulator(matrices: tuple[Array, Array, Array, Array], offset: Array, recording: Recording) -> Simulator:
    """Make a simulator in modes, with the names and units of a recording.

    Parameters
    ----------
    matrices : A, B, C, D
        In continuous time.
    offset : array, shape (n_y,)
        Constants of the outputs.
    """
    slowest = 0.05 / (len(recording) * recording.dt)
    found = [_as_mass(mode, slowest) for mode in modes(*matrices[:3])]
    names = _number_equal_names([mode.label(slowest) for mode in found])
    named = dict(zip(names, found, strict=True))
    parameters: dict[str, Parameter] = {}
    for name, mode in named.items():
        parameters |= _mode_parameters(name, mode, recording)
    parameters |= _output_parameters(matrices[3], offset, recording)
    dynamics, read_outputs = _modal_equations(named, recording.inputs, recording.outputs)
    states: list[str] = []
    for i, mode in enumerate(found, 1):
        states += [f"q{i}", f"v{i}"] if mode.second_order else [f"q{i}"]
    ports = tuple(_port(f"mode:{name}", i, mode) for i, (name, mode) in enumerate(named.items(), 1))
    units = dict(recording.units)
    return Simulator(dynamics, read_outputs, tuple(states), recording.inputs, parameters, ports, units=units)


def _parameter(value: float, unit: str = "", size: float = 0.0) -> Parameter:
    """Make a parameter that may move by `RANGE`, fixed if it is negligible next to the typical `size`."""
    reach = RANGE * max(abs(value), 0.1 * size)
    negligible = abs(value) <= NEGLIGIBLE_SHARE * size
    return Parameter(value, unit=unit, bounds=(value - reach, value + reach), fixed=negligible)


def _mode_parameters(name: str, mode: Mode, recording: Recording) -> dict[str, Parameter]:
    """Make the parameters of a mode: its frequency and damping, and its gains from the inputs and in the outputs."""
    prefix = f"mode {name}: "
    rate = max(abs(mode.value), 1 / (len(recording) * recording.dt))
    out: dict[str, Parameter] = {}
    if mode.spring:
        out[f"{prefix}stiffness"] = _parameter(mode.spring[0], "1/s^2", rate**2)
        out[f"{prefix}drag"] = _parameter(mode.spring[1], "1/s", rate)
    elif mode.second_order:
        w = abs(mode.value)
        out[f"{prefix}frequency"] = _parameter(w / (2 * np.pi), "Hz")
        out[f"{prefix}damping"] = _parameter(-mode.value.real / w)
    else:
        out[f"{prefix}rate"] = _parameter(-mode.value.real, "1/s")
    ratios = np.array([1.0, rate])[: len(mode.into)]  # typical ratios of q and v to q
    largest_in = float(np.max(np.abs(mode.into) * (ratios[::-1])[:, None]))
    largest_out = float(np.max(np.abs(mode.out) * ratios))
    for row, kind, ratio in zip(mode.into, INPUT_GAINS[-len(ratios) :], ratios[::-1], strict=True):
        for other, value in zip(recording.inputs, row, strict=True):
            # the strongest input has gain one; the gains in the outputs hold the size of the mode
            strongest = value == 1.0
            gain = Parameter(1.0, fixed=True) if strongest else _parameter(float(value), size=largest_in / ratio)
            out[f"{prefix}{kind} {other}"] = gain
    for column, kind, ratio in zip(mode.out.T, OUTPUT_GAINS, ratios, strict=False):
        for other, value in zip(recording.outputs, column, strict=True):
            unit = recording.units.get(other, "")
            out[f"{prefix}{kind} {other}"] = _parameter(float(value), unit, largest_out / ratio)
    return out


def _output_parameters(direct: Array, offset: Array, recording: Recording) -> dict[str, Parameter]:
    """Make the direct gains (n_y, n_u) from inputs to outputs, and the outputs' offsets (n_y,)."""
    spreads, moved = np.std(recording.y[recording.skip :], axis=0), np.std(recording.u, axis=0)
    out: dict[str, Parameter] = {}
    for name, row, spread in zip(recording.outputs, direct, spreads, strict=True):
        for other, value, push in zip(recording.inputs, row, moved, strict=True):
            size = float(spread / max(push, 1e-300))
            out[f"direct: {other} in {name}"] = _parameter(float(value), size=size)
    for name, value, spread in zip(recording.outputs, offset, spreads, strict=True):
        out[f"offset: {name}"] = Parameter(value, bounds=(value - spread, value + spread))
    return out


def _modal_equations(
    found: Mapping[str, Mode], inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[Equation, Equation]:
    """Make the state equations and the output equations of modes by name, as functions of named x, u and p."""

    def force(u: Named, p: Named, prefix: str, kind: str) -> Any:
        return sum((p[f"{prefix}{kind} {n}"] * u[n] for n in inputs), start=ca.SX(0))

    def dynamics(x: Named, u: Named, p: Named) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for i, (name, mode) in enumerate(found.items(), 1):
            prefix = f"mode {name}: "
            if mode.second_order:
                q, v = x[f"q{i}"], x[f"v{i}"]
                if mode.spring:
                    pull = p[f"{prefix}stiffness"] * q + p[f"{prefix}drag"] * v
                else:
                    w = 2 * np.pi * p[f"{prefix}frequency"]
                    pull = w**2 * q + 2 * p[f"{prefix}damping"] * w * v
                out[f"q{i}"] = v + force(u, p, prefix, INPUT_GAINS[0])
                out[f"v{i}"] = force(u, p, prefix, INPUT_GAINS[1]) - pull
            else:
                out[f"q{i}"] = -p[f"{prefix}rate"] * x[f"q{i}"] + force(u, p, prefix, INPUT_GAINS[1])
        return out

    def read_outputs(x: Named, u: Named, p: Named) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for name in outputs:
            y = p[f"offset: {name}"] + sum((p[f"direct: {n} in {name}"] * u[n] for n in inputs), start=ca.SX(0))
            for i, (label, mode) in enumerate(found.items(), 1):
                for state, kind in zip("qv", OUTPUT_GAINS[: len(mode.into)], strict=False):
                    y = y + p[f"mode {label}: {kind} {name}"] * x[f"{state}{i}"]
            out[name] = y
        return out

    return dynamics, read_outputs


def _port(name: str, i: int, mode: Mode) -> Port:
    if not mode.second_order:
        return Port(name, {f"q{i}": -1.0}, lambda x: x[f"q{i}"])
    return Port(name, {f"v{i}": -1.0}, lambda x: x[f"q{i}"], lambda x: x[f"v{i}"])


def _number_equal_names(names: list[str]) -> list[str]:
    """Append numbers to names that occur several times."""
    return [n if names.count(n) == 1 else f"{n} ({names[:k].count(n) + 1})" for k, n in enumerate(names)]
