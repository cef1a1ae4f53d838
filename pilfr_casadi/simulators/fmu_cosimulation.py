"""Simulators from functional mock-up units for co-simulation, which only step: `x⁺ = Φ_h(x, u, p)`.

A step sets states, inputs and parameters, advances the unit by h and reads states and outputs (`fmu_slave`). A variable
is a state if setting it changes a later step. Two steps must equal two steps with the states set in between; otherwise
the unit has memory that cannot be set, and no simulation could be repeated.

A diagnosis needs some ten million evaluations, which take an hour of a unit's steps. So its equations are looked for
first: polynomials (`polynomial_equations`) are fitted to the derivatives `lim (Φ_h(x) - x) / h`, extrapolated from
halved steps (Richardson), shorter ones if the unit is stiff. If they agree with the unit, they are the simulator, in
continuous time. Otherwise the simulator is in discrete time and steps the unit at every sample, with differences as
Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, check_known, listed, positive
from ..models import Named, Parameter
from .black_box import BlackBox
from .external import NOMINAL, RELATIVE_STEP
from .fmu_description import Description, Unit
from .fmu_slave import Slave
from .polynomial_equations import find_polynomials
from .user_arguments import as_names

LEVELS = 5  # halvings of a step from which a derivative is extrapolated
CONVERGED = 1e-5  # change by the last halving, over the largest derivative, up to which an extrapolation counts
SHORTER_STEPS = (2.0**-5, 2.0**-10, 2.0**-15)  # shares of the step that are tried for a stiff unit
EXACT = 1e-8  # relative change by the last halving below which no shorter step is tried
REPEATED = 1e-4  # relative difference that a restart of the unit's solver may cause
DECADES = (-3.0, 1.0)  # range of the powers of ten of states and inputs at which equations are checked
PROBED_POINTS = 4  # points at which the memory of a unit and the forces in its ports are checked


@dataclass(frozen=True)
class CoSimulation:
    """How a unit for co-simulation is stepped.

    Parameters
    ----------
    dt : float, optional
        Length of its steps, s: the sampling interval of the recordings. By default the step size that the file states.
    states : str or sequence of str, optional
        State variables; by default all outputs and local variables whose values change a step.
    """

    dt: float | None = None
    states: Sequence[str] | None = None


@dataclass(frozen=True, eq=False)
class SteppedUnit(Unit):
    """A unit for co-simulation with known states."""

    slave: Slave
    dt: float
    begin: Mapping[str, float]  # values of variables after the start of the program
    states: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path, described: Description, options: CoSimulation) -> SteppedUnit:
        """Load a unit and find its states; refuse a unit with other memory."""
        dt = options.dt if options.dt is not None else described.step_size
        if np.isnan(dt):
            raise InputError(
                f"{path} is for co-simulation and states no step size; give the recordings' step, as in "
                "from_fmu(..., cosimulation=pilfr_casadi.simulators.CoSimulation(dt=0.001))."
            )
        slave = Slave(path, described.version, described.token, described.slave)
        unit = cls(path, described, slave, positive(dt, "dt"), {})
        candidates = unit._candidates()
        names = tuple(dict.fromkeys((*candidates, *unit.inputs, *unit.parameters, *unit.outputs)))
        begin, failure = unit.steps((), np.zeros((1, 0)), 0.0, names)
        if not failure:
            failure = unit.steps((), np.zeros((1, 0)), dt, unit.outputs)[1]
        if failure:
            raise InputError(
                f"The program inside {path} does not step ({failure}); check it with the tool that made it."
            )
        unit = replace(unit, begin=dict(zip(names, begin[0].tolist(), strict=True)))
        given = as_names(options.states)
        check_known(given or (), candidates, "outputs and local variables", path)
        chosen = candidates if given is None else tuple(given)
        for fresh in (False, True):
            begun = replace(unit, slave=replace(slave, fresh=fresh))
            trial = begun._with_states(chosen, given is not None)
            if trial is not None:
                trial._check_memory()
                return trial
        raise InputError(
            f"{path} is for co-simulation, and none of its variables can be set as a state; export it for model "
            "exchange or with states that can be set, or give a table of what it simulates."
        )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.described.of("output")

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the tunable parameters."""
        return tuple(n for n in self.described.of("parameter") if self.variables[n].variability == "tunable")

    def steps(self, names: Sequence[str], values: np.ndarray, h: float, read: Sequence[str]) -> tuple[np.ndarray, str]:
        """Set variables by name and step; see `Slave.steps`."""
        sets, reads = ([self.variables[n].reference for n in each] for each in (names, read))
        return self.slave.steps(sets, values, np.full(len(values), h), reads)

    def _candidates(self) -> tuple[str, ...]:
        """List the states that the file names, or else all outputs and local variables."""
        local = (v.name for v in self.variables.values() if v.causality == "local" and v.variability == "continuous")
        return self.described.states or (*self.outputs, *local)

    def _with_states(self, names: tuple[str, ...], given: bool) -> SteppedUnit | None:
        """Copy with the states among some variables: they can be set and, if not `given`, change a step."""
        kept = tuple(n for n in names if not self.steps((n,), np.array([[self.begin[n]]]), self.dt, (n,))[1])
        unit = replace(self, states=kept)
        if not kept or (given and kept != names):
            return None
        if given:
            return unit
        z, read, n = unit.points(2)[0], (*kept, *unit.outputs), len(kept)
        # by as much as a step changes them: 1 Pa of a hydraulic pressure changes nothing that one would see
        stepped, _ = unit.steps(unit.set_names, z[None], self.dt, kept)
        rows = np.tile(z, (1 + n, 1))
        rows[1:, :n] += np.diag(np.max([np.abs(z[:n]), np.abs(stepped[0] - z[:n]), np.full(n, NOMINAL)], axis=0))
        found, _ = unit.steps(unit.set_names, rows, self.dt, read)
        moved = np.any(np.abs(found[1:] - found[0]) > REPEATED * np.abs(found[0]), axis=1)
        return replace(unit, states=tuple(n for n, m in zip(kept, moved, strict=True) if m)) if np.any(moved) else None

    @property
    def set_names(self) -> tuple[str, ...]:
        """Names of the variables that a step sets."""
        return (*self.states, *self.inputs, *self.parameters)

    def points(self, count: int, seed: int = 0) -> np.ndarray:
        """Draw values of `set_names` about the start values, with unchanged parameters."""
        rng, sizes = np.random.default_rng(seed), [self.variables[n].nominal for n in self.set_names]
        sizes = np.nan_to_num(np.array(sizes), nan=1.0) * 0.1
        sizes[len(self.states) + len(self.inputs) :] = 0.0
        return np.array([self.begin[n] for n in self.set_names]) + sizes * rng.standard_normal((count, len(sizes)))

    def _check_memory(self) -> None:
        """Refuse a unit whose steps depend on more than the variables that are set before them."""
        n, read = len(self.states), (*self.states, *self.outputs)
        for z in self.points(PROBED_POINTS, 1):
            on = np.full((1, len(z)), np.nan)
            first, failure = self.steps(self.set_names, np.vstack([z, on]), self.dt, read)
            other = np.vstack([self.points(1, 2), z, np.append(first[0, :n], z[n:])])
            again, more = self.steps(self.set_names, other, self.dt, read)
            if failure or more:
                raise InputError(f"{self.path} fails near its start values: {failure or more}; check it with its tool.")
            both, size = np.vstack([first, again[1:]]), np.abs(first[1] - first[0])
            off = np.abs(first - again[1:]) > REPEATED * size + RELATIVE_STEP * np.max(np.abs(both), axis=0)
            if np.any(off):
                name = read[int(np.argmax(np.any(off, axis=0)))]
                raise InputError(
                    f"{self.path} has memory that cannot be set, or depends on time: a step with the states "
                    f"{listed(self.states)} set gives another {name!r} than the same step before; export it for model "
                    "exchange or with all its states as outputs that can be set, or give a table of what it simulates."
                )


def unknown_signal(port: str, key: str, name: str, known: Sequence[str]) -> InputError:
    """Make the error about a port's coordinate or rate that is no signal of the unit."""
    there = listed(list(dict.fromkeys(known)))
    return InputError(f"`{key}` of port {port!r} is {name!r}; give an output or a state of the unit: {there}.")


def check_force(port: str, factors: Mapping[str, float], linear: bool, effective: bool) -> None:
    """Refuse inputs of a port that are no forces: their effect is not linear, or they have none."""
    inputs = listed(list(factors))
    if not linear:
        raise InputError(
            f"The force of port {port!r} does not add up in {inputs}: twice the input has not twice the effect; name "
            "an input that is a force."
        )
    if not effective:
        raise InputError(f"The input {inputs} of port {port!r} changes nothing; name another one.")


class UnitSteps:
    """The steps of a unit as functions of numbers, at points z that stack states, inputs and parameters.

    Parameters
    ----------
    unit : SteppedUnit
    inputs : tuple of str
        Inputs that are symbols.
    parameters : mapping
        Parameters that are symbols.
    needed : tuple of str
        Outputs that ports or recordings read.
    """

    def __init__(
        self, unit: SteppedUnit, inputs: tuple[str, ...], parameters: Mapping[str, Parameter], needed: tuple[str, ...]
    ) -> None:
        self.unit, self.inputs, self.parameters = unit, inputs, parameters
        self.others = tuple(n for n in needed if n not in unit.states)
        self.names = (*unit.states, *inputs, *parameters)
        self.rows = (*unit.states, *self.others)
        self.sizes = np.nan_to_num(np.array([unit.variables[n].nominal for n in self.names]), nan=1.0)
        self._start = np.array([unit.begin[n] for n in self.names])

    def find_polynomials(self) -> ca.Function | None:
        """Look for polynomials that are the unit's derivatives and outputs."""
        if not self.unit.described.variable_steps:
            return None
        inverse = [j for j, n in enumerate(self.names) if n in self.parameters and np.prod(self._range(n)) > 0]
        return find_polynomials(self.derivatives, self.draw, inverse)

    def _range(self, name: str) -> tuple[float, float]:
        """Return the range of a parameter in which equations are looked for."""
        p = self.parameters[name]
        value, low, high = (float(v) for v in (p.value, *p.bounds))
        reach = 10 * abs(value) or 1.0
        return max(low, value - reach), min(high, value + reach)

    def draw(self, count: int, wide: bool) -> np.ndarray:
        """Draw states and inputs about the start values, and parameters within their bounds."""
        rng, n = np.random.default_rng(int(wide)), len(self.names) - len(self.parameters)
        spread = 10 ** rng.uniform(*DECADES, (count, 1)) if wide else np.ones((count, 1))
        z = self._start + self.sizes * spread * rng.uniform(-1, 1, (count, len(self.names)))
        for j, name in enumerate(self.parameters, n):
            low, high = self._range(name)
            log = low > 0
            first, last = np.log([low, high]) if log else (low, high)
            drawn = rng.uniform(first, last, count)
            z[:, j] = np.exp(drawn) if log else drawn
        z[:, :n] -= self._start[:n] * np.array([name in self.unit.states for name in self.names[:n]])
        return z

    def results(self, z: np.ndarray, h: float) -> np.ndarray:
        """Step from points z of `names`, states from their start values; (K, n_rows)."""
        values = np.array(z, dtype=float)
        n, start = len(self.unit.states), self.unit.begin
        values[:, :n] += self._start[:n]
        given = dict(zip(self.names, values.T, strict=True))
        all_of = [given.get(name, np.full(len(z), start[name])) for name in self.unit.set_names]
        out = np.full((len(z), len(self.rows)), np.nan)
        usable = np.all(np.isfinite(values), axis=1)  # a diverged simulation does not call the unit
        if np.any(usable):
            out[usable] = self.unit.steps(self.unit.set_names, np.stack(all_of, axis=1)[usable], h, self.rows)[0]
        return out - np.append(self._start[:n], np.zeros(len(self.others)))

    @np.errstate(over="ignore", invalid="ignore")  # a step may fail or diverge
    def derivatives(self, z: np.ndarray) -> np.ndarray:
        """Extrapolate derivatives and outputs to steps of length zero; NaN without convergence.

        Where a step is too long for a stiff unit, shorter ones are tried, and the best is used.
        """
        best, error = self._extrapolated(z, self.unit.dt)
        for shorter in SHORTER_STEPS:
            rows = np.any(~(error <= EXACT * np.abs(best)), axis=1)
            if not np.any(rows):
                break
            found, its_error = self._extrapolated(z[rows], shorter * self.unit.dt)
            better = its_error < np.nan_to_num(error[rows], nan=np.inf)
            best[rows] = np.where(better, found, best[rows])
            error[rows] = np.where(better, its_error, error[rows])
        return np.where(error <= CONVERGED * np.max(np.abs(best), axis=0), best, np.nan)

    def _extrapolated(self, z: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Extrapolate derivatives and outputs from halved steps; return them, and their change by the last halving."""
        n, table = len(self.unit.states), list[np.ndarray]()
        for k in range(LEVELS):
            h = step / 2**k
            found = self.results(z, h)
            table.append(np.hstack([(found[:, :n] - z[:, :n]) / h, found[:, n:]]))
        before = table[-1]
        for order in range(1, LEVELS):
            before = table[-1]
            table = [(2**order * b - a) / (2**order - 1) for a, b in pairwise(table)]
        return table[0], np.abs(table[0] - before)


class Polynomials:
    """Polynomials that are the derivatives and the outputs of a unit, which is not called any more."""

    discrete, dt, program_calls = False, None, dict[str, int]()

    def __init__(self, steps: UnitSteps, polynomials: ca.Function) -> None:
        self.steps, self.unit, self.polynomials = steps, steps.unit, polynomials
        self.states, self.numbers = steps.unit.states, steps.derivatives

    @property
    def note(self) -> str:
        """Origin of the equations, in words."""
        return (
            f"{self.unit.path.name}: equations found from its steps, at states and inputs up to ten times their "
            "nominal size (1 where the file gives none); it is not called any more"
        )

    def _stack(self, x: Named, u: Mapping[str, Any], p: Named) -> Any:
        drives = (u.get(n, self.unit.begin[n]) for n in self.steps.inputs)
        return ca.vertcat(*(x[n] for n in self.states), *drives, *(p[n] for n in self.steps.parameters))

    def _by_name(self, rows: Any) -> dict[str, Any]:
        return dict(zip(self.steps.rows, ca.vertsplit(rows), strict=True))

    def evaluate(self, x: Named, u: Mapping[str, Any], p: Named) -> dict[str, Any]:
        """Evaluate the derivatives of states, and the other outputs, by name."""
        return self._by_name(self.polynomials(self._stack(x, u, p)))

    def effect(self, factors: Mapping[str, float], moved: Sequence[str]) -> Callable[..., Any]:
        """Make the effect of a unit force on the rows that it moves."""
        z = ca.SX.sym("z", len(self.steps.names))
        force = ca.SX(ca.DM([factors.get(n, 0.0) for n in self.steps.names]))
        along = ca.Function("along", [z], [ca.jtimes(self.polynomials(z), z, force)])

        def effect(x: Named, u: Named, p: Named) -> dict[str, Any]:
            found = self._by_name(along(self._stack(x, u._values, p)))
            return {n: found[n] for n in moved}

        return effect


class Steps:
    """The steps of a unit, which is called at every sample.

    An output that is no state is read after a step, so it belongs to the next sample and is kept as a state.
    """

    discrete = True

    def __init__(self, steps: UnitSteps) -> None:
        self.steps, self.unit, self.states, self.dt = steps, steps.unit, steps.rows, steps.unit.dt
        self.numbers = partial(steps.results, h=self.dt)
        n = len(steps.unit.states)
        sizes = np.concatenate([[1.0], steps.sizes[:n], np.ones(len(steps.others)), steps.sizes[n:]])
        self._nominal = NOMINAL * sizes
        kinds = (self.states, steps.inputs, tuple(steps.parameters))
        self._box = BlackBox(self._step, self.unit.path.name, self.states, kinds, self._slopes, self._nominal)

    @property
    def note(self) -> str:
        """Origin of the equations, in words."""
        searched = self.unit.described.variable_steps
        why = "no equations were found" if searched else "the length of its steps cannot be changed"
        return (
            f"steps of {self.unit.dt:g} s, because {why}; so the unit is called at every sample, and a diagnosis "
            "may take hours. Equations are polynomials in states, inputs and parameters; nominal values in the "
            f"file help to find them. {self._box.note}"
        )

    @property
    def program_calls(self) -> dict[str, int]:
        """Number of calls by the file's name."""
        return self._box.program_calls

    def evaluate(self, x: Named, u: Mapping[str, Any], p: Named) -> dict[str, Any]:
        """Evaluate the next values of states, and the other outputs, by name."""
        return self._box(x, Named("input", {n: u.get(n, self.unit.begin[n]) for n in self.steps.inputs}), p, 0.0)

    def _step(self, z: np.ndarray) -> np.ndarray:
        """Step from one point z = (t, x, u, p)."""
        return self.numbers(self._reduced(z[None]))[0]

    def _slopes(self, z: np.ndarray) -> np.ndarray:
        """Compute the differences by x, u and p in one call."""
        h = RELATIVE_STEP * np.maximum(np.abs(z), self._nominal)[1:]
        points = np.vstack([z, z + np.hstack([np.zeros((len(h), 1)), np.diag(h)])])
        found = self.numbers(self._reduced(points))
        return np.asarray((found[1:] - found[0]).T / h)

    def _reduced(self, z: np.ndarray) -> np.ndarray:
        """Drop time, and outputs that are kept as states."""
        n = 1 + len(self.unit.states)
        return np.delete(z, [0, *range(n, n + len(self.steps.others))], axis=1)

    def effect(self, factors: Mapping[str, float], moved: Sequence[str]) -> Callable[..., Any]:
        """Make the effect of a unit force on the rows that it moves."""
        start = self.unit.begin

        def effect(p: Named) -> dict[str, Any]:  # at rest
            at = Named("state", dict.fromkeys(self.states, ca.SX(0.0)))
            before, after = (
                self.evaluate(at, {n: start[n] + k * factors.get(n, 0.0) for n in self.steps.inputs}, p) for k in (0, 1)
            )
            return {n: after[n] - before[n] for n in moved}

        return effect


class UnitEquations:
    """The dynamics, outputs and ports of a unit, from expressions of its derivatives or its steps."""

    def __init__(self, steps: UnitSteps, expressions: Polynomials | Steps, measured: tuple[str, ...]) -> None:
        self.steps, self.unit, self.expressions, self.outputs = steps, steps.unit, expressions, measured
        self.states, self.discrete, self.dt = expressions.states, expressions.discrete, expressions.dt

    @property
    def note(self) -> str:
        """Origin of the equations, in words; a `Simulator` prints it."""
        return self.expressions.note

    @property
    def program_calls(self) -> dict[str, int]:
        """Number of calls by the file's name."""
        return self.expressions.program_calls

    def __call__(self, x: Named, u: Named, p: Named) -> dict[str, Any]:
        """Evaluate the derivatives, or the next states, by name: the dynamics of a `Simulator`."""
        found = self.expressions.evaluate(x, u._values, p)
        return {n: found[n] for n in self.states}

    def measured(self, x: Named, u: Named, p: Named) -> dict[str, Any]:
        """Evaluate the outputs by name."""
        read = not all(n in self.states for n in self.outputs)
        found = self.expressions.evaluate(x, u._values, p) if read else {}
        return {n: x[n] + self._start_of(n) if n in self.states else found[n] for n in self.outputs}

    def _start_of(self, state: str) -> float:
        """Return the start value of a state, its zero; an output that is kept as a state has none."""
        return self.unit.begin[state] if state in self.unit.states else 0.0

    def signal(self, port: str, key: str, name: str) -> Callable[..., Any]:
        """Make the local coordinate of a port, or its rate, from the name of a variable."""
        if name in self.states:
            start = self._start_of(name)
            return lambda x: x[name] + start
        if name in self.steps.others:
            return lambda x, u, p: self.expressions.evaluate(x, u._values, p)[name]
        known = [*self.unit.outputs, *(n for n in self.unit.states if n not in self.unit.outputs)]
        raise unknown_signal(port, key, name, known)

    def into(self, port: str, factors: Mapping[str, float]) -> Any:
        """Make the effect of a unit force on states and outputs."""
        z = self.steps.draw(PROBED_POINTS, True)
        step = np.array([factors.get(n, 0.0) for n in self.steps.names])
        none, once, twice = (self.expressions.numbers(z + k * step) for k in (0, 1, 2))
        usable = np.all(np.isfinite(np.hstack([none, once, twice])), axis=1)
        if not np.any(usable):
            raise InputError(
                f"{self.unit.path} fails at all values of its parameters that were tried for port {port!r}, within "
                "their bounds; give narrower bounds."
            )
        none, once, twice = (found[usable] for found in (none, once, twice))
        once, twice = once - none, twice - none
        size = np.max(np.abs(once), axis=0) + NOMINAL * np.max(np.abs(none), axis=0)
        moved = [n for n, change in zip(self.steps.rows, once.T, strict=True) if np.any(np.abs(change) > RELATIVE_STEP)]
        moved = [n for n in moved if n in self.states or n in self.outputs]
        linear = not np.any(np.abs(twice - 2 * once) > NOMINAL * size)
        check_force(port, factors, linear, bool(moved))
        return self.expressions.effect(factors, moved)


def find_equations(steps: UnitSteps, measured: tuple[str, ...]) -> UnitEquations:
    """Look for the equations of a unit; without them, step it. `measured` are the recorded outputs."""
    found = steps.find_polynomials()
    return UnitEquations(steps, Steps(steps) if found is None else Polynomials(steps, found), measured)
