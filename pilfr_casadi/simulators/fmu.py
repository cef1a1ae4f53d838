"""Simulators from functional mock-up units (https://fmi-standard.org), FMI 2.0 and 3.0, for model exchange.

Units for co-simulation alone are stepped (`fmu_cosimulation`).

A unit is a program and runs with the rights of the user, in processes of its own (`fmu_process`). Differences along
directions give the Jacobians (`external`). If a derivative or an output equals a state at every trial point, the
equations use the state instead of calling the unit.

A force in a port is added to an input of the unit. States are deviations from their start values. Events are not
located: the integration steps over them, which the simulator's print says.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, check_known
from ..models import Named, Parameter, parameter_within, within_a_factor
from .external import NOMINAL, ROUNDING, call_external, equal_state, external
from .fmu_cosimulation import (
    CoSimulation,
    SteppedUnit,
    UnitEquations,
    UnitSteps,
    check_force,
    find_equations,
    unknown_signal,
)
from .fmu_description import Description, Unit, Variable, check_file, parse_port
from .fmu_function import FmuFunction
from .fmu_instance import FmuFile, FmuSignals, unpack
from .fmu_process import has_time_event
from .ports import Port
from .simulator import Simulator
from .user_arguments import as_names, choose_parameters

COMPARED_POINTS = 8  # trial points at which derivatives and outputs are compared with states and with forces in ports
PORT_KEYS = ("into", "across", "rate", "unit", "across_unit")
TIMES = (0.0, 0.7, 13.0, 400.0)  # s, of the trial points; there a dependence on time is looked for too


@dataclass(frozen=True, eq=False)
class _Unit(Unit):
    """A unit with some of its outputs: `(t, x, u, p) -> (derivatives, outputs)`.

    `parameters` are the tunable ones, then fixed ones that the user names.
    """

    parameters: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return self.described.states

    @cached_property
    def program(self) -> FmuFunction:
        """The function that calls the unit."""
        folder, key = unpack(self.path)
        key = hashlib.sha256(f"{key} {self.parameters} {self.outputs}".encode()).hexdigest()[:16]
        name = f"fmu_{key}"
        if name not in _functions:
            parameters, inputs, outputs = (
                tuple(self.variables[n].reference for n in names)
                for names in (self.parameters, self.inputs, self.outputs)
            )
            tunable = sum(self.variables[n].variability == "tunable" for n in self.parameters)
            described = self.described
            file = FmuFile(folder, int(described.version), described.token, described.binary, parameters, tunable)
            _functions[name] = FmuFunction(name, FmuSignals(file, len(self.states), inputs, outputs))
        return _functions[name]

    def __reduce__(self) -> tuple[Any, ...]:
        """Unpack the file again in another process."""
        return _Unit, (self.path, self.described, self.parameters, self.outputs)

    def starts(self, names: Sequence[str]) -> np.ndarray:
        """Start values of variables, zero if the file gives none."""
        return np.nan_to_num(np.array([self.variables[n].start for n in names]))

    @cached_property
    def function(self) -> ca.Function:
        """`z -> (derivatives, outputs)` in one vector, for expressions; z holds t, x, u and p."""

        def evaluate(z: Any) -> Any:
            ends = np.cumsum([0, *self.program.signals.sizes]).tolist()
            return call_external(self.program.function, *(z[a:b] for a, b in pairwise(ends)))

        nominal = [1.0, *(self.variables[n].nominal for n in (*self.states, *self.inputs, *self.parameters))]
        sizes = NOMINAL * np.nan_to_num(np.array(nominal), nan=1.0)
        return external(evaluate, sizes, self.program.signals.results)

    def values(self, t: float, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Evaluate derivatives and outputs by numbers."""
        return self.program.evaluate(np.concatenate([[t], x, u, p]).tobytes())


_functions: dict[str, FmuFunction] = {}  # by name


def from_fmu(
    path: str | os.PathLike[str],
    *,
    ports: Mapping[str, Mapping[str, Any] | str] | None = None,
    parameters: Sequence[str] | Mapping[str, Parameter] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    hold: str | None = None,
    cosimulation: CoSimulation | None = None,
) -> Simulator:
    """Make a simulator from a functional mock-up unit, for model exchange if the unit supports it.

    Parameters
    ----------
    path : path
        An `.fmu` file. It is a program, and runs as such.
    ports : mapping, optional
        By name of a port `dict(into=..., across=..., rate=...)` with names of the unit's variables: `into` an input to
        which a law's force is added with the opposite sign (friction opposes motion), or `{input: factor}`; `across` an
        output or a state, the local coordinate; `rate`, which may be left out, its speed; `unit` and `across_unit`
        the units of force and coordinate, by default those of the file. The text "loss[W]:temperature[K]" says the
        same, and with the speed "force[N]:position[m]:velocity". By default each state's equation is a port. Actuators
        and sensors are always ports.
    parameters : one name or several, or mapping from names to Parameter, optional
        Parameters that a fit may change; by default all tunable ones. Fixed ones may be named too; each change of
        their values restarts the unit. Those with `bounds` are free too; the others keep the unit's values.
    bounds : mapping, optional
        `(lower, upper)` by parameter; by default the unit's bounds, else a factor of ten either way.
    inputs, outputs : str or sequence of str, optional
        Recorded inputs and outputs; by default all outputs, and all inputs that no port uses. Other inputs keep their
        start values, so name the recorded ones if the recordings lack some.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        As of `Simulator`.
    cosimulation : CoSimulation, optional
        Step size and states of a unit for co-simulation; a unit for both kinds is then stepped.

    Returns
    -------
    Simulator
        Its states are deviations from the unit's start values.

    Raises
    ------
    InputError
        If the file is no unit for this platform, a name is not one of its variables, or a unit for co-simulation has
        no states that can be set.
    """
    path, bounds = Path(path), bounds or {}
    inputs, outputs, parameters = map(as_names, (inputs, outputs, parameters))
    described = check_file(path, cosimulation is not None)
    given = {
        name: parse_port(name, port, described.variables) if isinstance(port, str) else port
        for name, port in (ports or {}).items()
    }
    unit: _Unit | SteppedUnit
    if cosimulation is not None and not isinstance(cosimulation, CoSimulation):
        raise InputError(f"cosimulation={cosimulation!r} was given; give CoSimulation(dt=STEP).")
    if described.identifier:
        unit = _load_unit(path, described, (*(parameters or ()), *bounds), outputs)
    else:
        unit = SteppedUnit.load(path, described, cosimulation or CoSimulation())
    for name, port in given.items():
        _check_port(name, port)
    used = [name for port in given.values() for name in _factors(port.get("into"))]
    own = parameters if parameters is not None else [n for n in described.of("parameter") if n in unit.parameters]
    _check_names(unit, (*used, *(inputs or ())), outputs or (), (*own, *bounds))
    all_outputs = described.of("output")
    drives = tuple(inputs) if inputs is not None else tuple(n for n in unit.inputs if n not in used)
    measured = tuple(outputs) if outputs is not None else all_outputs
    read = {port.get(key) for port in given.values() for key in ("across", "rate")}
    needed = tuple(n for n in all_outputs if n in measured or n in read)
    made = choose_parameters(own, bounds, lambda n, ends: _make_parameter(unit.variables[n], ends))
    equations: _Equations | UnitEquations
    if isinstance(unit, _Unit):
        equations = _Equations(replace(unit, outputs=needed), drives, tuple(made), measured)
    else:
        symbols = tuple(n for n in unit.inputs if n in drives or n in used)
        equations = find_equations(UnitSteps(unit, symbols, made, needed), measured)
    return Simulator(
        equations,
        equations.measured,
        equations.states,
        drives,
        made,
        tuple(_make_port(equations, name, port) for name, port in given.items()),
        hold,
        equations.discrete,
        units={n: unit.variables[n].unit for n in (*drives, *measured)},
    )


def _load_unit(path: Path, described: Description, named: Sequence[str], outputs: Sequence[str] | None) -> _Unit:
    """Make a unit with its tunable parameters and named fixed ones."""
    parameters = tuple(
        n for n in described.of("parameter") if n in named or described.variables[n].variability == "tunable"
    )
    tunable_first = tuple(sorted(parameters, key=lambda n: described.variables[n].variability != "tunable"))
    return _Unit(path, described, tunable_first, tuple(outputs or ()))


def _check_names(
    unit: _Unit | SteppedUnit, inputs: Sequence[str], outputs: Sequence[str], parameters: Sequence[str]
) -> None:
    """Refuse names of inputs, outputs and parameters that the unit does not have as numbers."""
    # fixed parameters are accepted where they are named
    accepted = unit.described.of("parameter") if isinstance(unit, _Unit) else unit.parameters
    roles = (
        (inputs, unit.inputs, "inputs"),
        (outputs, unit.described.of("output"), "outputs"),
        (parameters, accepted, "parameters"),
    )
    for names, known, kind in roles:
        for name in names:
            if found := unit.described.others.get(name):
                raise InputError(
                    f"{name!r} of {unit.path} is {found}; name variables that are single numbers of 64 bits."
                )
        check_known(names, known, kind, unit.path)


class _Equations:
    """The equations of a unit with some of its inputs, parameters and outputs.

    Parameters
    ----------
    unit : _Unit
    inputs, free, outputs : tuple of str
        Inputs and parameters that are symbols; outputs that are given.
    """

    def __init__(self, unit: _Unit, inputs: tuple[str, ...], free: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        self.unit, self.inputs, self.free, self.outputs = unit, inputs, free, outputs
        self.states, self.discrete = unit.states, False
        rows = (*map(_rate, unit.states), *unit.outputs)
        points = list(self._points())
        first = unit.values(*points[0])
        if unit.program.failure:
            raise InputError(
                f"The program inside {unit.path} cannot be evaluated: it {unit.program.failure}; check it with the "
                "tool that made it."
            )
        found = np.array([first, *(unit.values(*point) for point in points[1:])])
        if not np.all(np.isfinite(found)):
            row = rows[int(np.argmin(np.all(np.isfinite(found), axis=0)))]
            raise InputError(f"{unit.path} gives no finite number for {row!r} near its start values; check it.")
        later = np.array([[unit.values(t, *points[0][1:]), unit.values(t, *points[-1][1:])] for t in TIMES])
        self.timed = bool(np.any(np.abs(later - later[0]) > ROUNDING * np.max(np.abs(later))))
        states = np.array([x - unit.starts(unit.states) for _, x, _, _ in points])
        equal = [equal_state(row, states, unit.states) for row in found.T]
        self.equal = {row: same for row, same in zip(rows, equal, strict=True) if same}
        self.unit = replace(unit, outputs=tuple(n for n in unit.outputs if n not in self.equal))
        self.timed_events = has_time_event(unit.program.signals)

    def _points(self) -> Any:
        """Draw times, states, inputs and parameters near the start values; the first point holds the start values."""
        unit, rng = self.unit, np.random.default_rng(0)
        x, u, p = (unit.starts(names) for names in (unit.states, unit.inputs, unit.parameters))
        yield 0.0, x, u, p
        moves = np.array([n in self.free for n in unit.parameters], dtype=float)
        for k in range(1, COMPARED_POINTS):
            changes = [10 ** rng.uniform(-3, 0) * rng.standard_normal(len(a)) for a in (x, u)]
            values = p * (1 + 0.1 * moves * rng.uniform(-1, 1, len(p)))
            yield TIMES[k % len(TIMES)], x + changes[0], u + changes[1], values

    def _stack(self, x: Any, u: Any, p: Any, t: Any, added: Mapping[str, float] | None = None) -> Any:
        unit = self.unit
        state = [x[n] + start for n, start in zip(unit.states, unit.starts(unit.states), strict=True)]
        drive = [
            (u[n] if n in self.inputs else start) + (added or {}).get(n, 0.0)
            for n, start in zip(unit.inputs, unit.starts(unit.inputs), strict=True)
        ]
        values = zip(unit.parameters, unit.starts(unit.parameters), strict=True)
        time = t if self.timed else 0.0
        return ca.vertcat(time, *state, *drive, *(p[n] if n in self.free else start for n, start in values))

    def _rows(self, names: Sequence[str], x: Named, u: Named, p: Named, t: Any) -> list[Any]:
        """Evaluate derivatives `der(state)` and outputs."""
        rows = (*map(_rate, self.unit.states), *self.unit.outputs)
        calls = any(n not in self.equal for n in names)
        found: Any = call_external(self.unit.function, self._stack(x, u, p, t)) if calls else None
        return [x[self.equal[n]] if n in self.equal else found[rows.index(n)] for n in names]

    @property
    def note(self) -> str:
        """Events of the unit, in words; a `Simulator` prints it."""
        count = self.unit.described.event_indicators
        kinds = [f"{count} event indicator{'s' * (count > 1)}"] * bool(count) + ["events in time"] * self.timed_events
        if not kinds:
            return ""
        return (
            f"{self.unit.path.name} has {' and '.join(kinds)}; the integration steps over events, so stops, switches "
            "and dry friction inside the unit are only as exact as the sampling"
        )

    def __call__(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Evaluate the derivatives by state: the dynamics of a `Simulator`."""
        return dict(zip(self.states, self._rows([_rate(n) for n in self.states], x, u, p, t), strict=True))

    def measured(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Evaluate the outputs by name."""
        return dict(zip(self.outputs, self._rows(self.outputs, x, u, p, t), strict=True))

    def signal(self, port: str, key: str, name: str) -> Callable[..., Any]:
        """Make the local coordinate of a port, or its rate, from the name of a variable."""
        unit = self.unit
        if name in unit.states:
            return lambda x: x[name]
        if name not in (*unit.outputs, *self.equal):
            known = [*unit.outputs, *(n for n in self.equal if not n.startswith("der(")), *unit.states]
            raise unknown_signal(port, key, name, known)
        if same := self.equal.get(name):
            return lambda x: x[same]
        return lambda x, u, p, t: self._rows([name], x, u, p, t)[0]

    def into(self, port: str, factors: Mapping[str, float]) -> Any:
        """Make the effect of a unit force on derivatives and outputs: constants, or differences of two calls."""
        unit, step = self.unit, np.array([factors.get(n, 0.0) for n in self.unit.inputs])
        names = (*unit.states, *unit.outputs)
        rows = [i for i, n in enumerate(names) if i < len(unit.states) or n in self.outputs]
        points = list(self._points())
        none, once, twice = (
            np.array([unit.values(t, x, u + k * step, p)[rows] for t, x, u, p in points]) for k in (0, 1, 2)
        )
        once, twice = once - none, twice - none
        size = np.max(np.abs(once)) + ROUNDING * np.max(np.abs(none))
        moved = {k: i for k, i in enumerate(rows) if np.any(np.abs(once[:, k]) > ROUNDING * size)}
        linear = not np.any(np.abs(twice - 2 * once) > np.sqrt(ROUNDING) * size)
        check_force(port, factors, linear, bool(moved))
        if np.all(np.abs(once - once[0]) <= np.sqrt(ROUNDING) * size):
            return {names[i]: float(once[0, k]) for k, i in moved.items()}

        def into(x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
            before, after = (
                call_external(unit.function, self._stack(x, u, p, t, added)) for added in ({}, dict(factors))
            )
            return {names[i]: after[i] - before[i] for i in moved.values()}

        return into


def _check_port(name: str, given: Any) -> None:
    """Refuse a port that does not give the names of the unit's variables."""
    form = (
        "give dict(into=INPUT, across=VARIABLE, rate=VARIABLE, unit=UNIT, across_unit=UNIT); the last three are "
        "optional."
    )
    if not isinstance(given, Mapping):
        raise InputError(f"The port {name!r} is {given!r}; {form}")
    for key in given:
        if key not in PORT_KEYS:
            raise InputError(f"The port {name!r} has the unknown key {key!r}; {form}")
    texts = (given.get("across"), *(given.get(key, "") for key in PORT_KEYS[3:]))
    usable = all(isinstance(text, str) for text in texts) and isinstance(given.get("rate"), str | None)
    if not usable or not _factors(given.get("into")):
        raise InputError(f"The port {name!r} is {given!r}; {form}")


def _make_port(equations: _Equations | UnitEquations, name: str, given: Mapping[str, Any]) -> Port:
    """Make a port from the names of the unit's variables, whose units it has by default."""
    factors, across, rate = _factors(given["into"]), given["across"], given.get("rate")
    z = equations.signal(name, "across", across)
    dz = None if rate is None else equations.signal(name, "rate", rate)
    force, coordinate = (equations.unit.variables[n] for n in (next(iter(factors)), across))
    stated = given.get("unit", force.unit), given.get("across_unit", coordinate.unit)
    return Port(name, equations.into(name, factors), z, dz, *stated)


def _rate(state: str) -> str:
    return f"der({state})"


def _factors(into: Any) -> dict[str, float]:
    """Return the factors of a port's force by input; a single name has the factor -1."""
    if isinstance(into, str):
        return {into: -1.0}
    return dict(into) if isinstance(into, Mapping) else {}


def _make_parameter(variable: Variable, bounds: tuple[float, float] | None) -> Parameter:
    value = 0.0 if np.isnan(variable.start) else variable.start
    low, high = bounds if bounds is not None else (variable.low, variable.high)
    usual = within_a_factor(value) if value else (-np.inf, np.inf)
    low, high = (end if np.isnan(given) else given for given, end in zip((low, high), usual, strict=True))
    return parameter_within(variable.name, value, (low, high), variable.unit)
