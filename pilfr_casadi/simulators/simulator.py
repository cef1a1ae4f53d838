"""The user's simulator: equations with ports, the laws in them, and its simulation.

`close_loop(simulator, law, port)` puts a law into a port and gives a simulator again; `discretise` makes it a `Model`
like any other.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, later
from ..data import Recording, conversion
from ..laws import readable_unit
from ..models import Parameter, ParameterSet, accumulate_steps
from .equations import Equations
from .ports import Placed
from .substeps import discretise_for


@dataclass(frozen=True, eq=False, repr=False)
class Simulator(Equations):
    """A simulator with ports.

    Parameters
    ----------
    dynamics : callable
        From any of x, u, p (and t, time in s) by name to `{state: derivative}`; x.<state>, u.<input>, p.<parameter> are
        CasADi symbols.
    outputs : callable
        From the same to `{output: expression}`. It may also read `dx`, the states' derivatives, for sensors of
        acceleration or force: `lambda x, dx: {"acceleration": dx.vel}`. Outputs must be linear in `dx`.
    states, inputs : tuple of str
        Names; `states=()` is a static device, and `inputs=()` a machine that its start alone moves, such as a decay.
    parameters : mapping
        `Parameter` by name.
    ports : Port or tuple of Port
        Declared ports; by default each state's equation is a port.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        Inputs between samples, for recordings that do not state it.
    discrete : bool
        `dynamics` gives the next sample's states instead of derivatives.
    elements : tuple of Placed
        Laws in the ports; see `close_loop`.
    units : mapping
        Units of inputs and outputs by name.
    observer : array, shape (n_x, n_y), optional
        Gain K of a one-step predictor (Ljung 1999, System Identification, sec. 4.3): after each sample, K times the
        measured minus the simulated output is added to the states. Outputs are then predictions one sample ahead.
    substeps : int
        Least number of integration steps per sample. If the equations are fast at the beginning of a recording, more
        steps are taken; if they become fast later, give the number of steps here.

    Raises
    ------
    InputError
        If an argument has the wrong type, names are not unique, a derivative is missing, or a port names a state or
        output that does not exist.

    Examples
    --------
    >>> from pilfr_casadi import Parameter, Port, Simulator
    >>> simulator = Simulator(
    ...     lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos),
    ...     lambda x: dict(position=x.pos),
    ...     states=("pos", "vel"),
    ...     inputs=("force",),
    ...     parameters=dict(k=Parameter(100.0, unit="N/m", bounds=(50, 200))),
    ...     ports=Port("mount", into=dict(vel=-1.0), across=lambda x: x.pos),
    ... )
    >>> simulator.output_names
    ('position',)
    """

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulate the outputs for a recording's inputs, shape (M, n_y), at the parameters' values.

        They are in the simulator's units; `matched(recording)` has the measured outputs in the same units.
        The simulation starts from the recording's `initial` if it holds numbers, else from zero. To estimate the
        initial state, `fit` the simulator and simulate the fit.

        Raises
        ------
        InputError
            If the recording lacks an input of the simulator, or the equations are too fast for its samples.
        """
        if not isinstance(recording, Recording):
            raise InputError(f"A {type(recording).__name__} was given; give a Recording, as from pilfr.read_csv.")
        if not set(self.inputs) <= set(recording.inputs):
            raise InputError(
                f"{recording.label} has the inputs {', '.join(recording.inputs) or 'none'}; the simulator has "
                f"{', '.join(self.inputs) or 'none'}; give the missing ones as columns, or for an FMU name the "
                "recorded ones, as in from_fmu(..., inputs=...)."
            )
        if self.observer is None:  # outputs are not read
            units = {name: unit for name, unit in recording.units.items() if name in recording.inputs}
            recording = recording.with_(y=np.empty((len(recording), 0)), outputs=(), units=units)
        elif not recording.n_y:
            raise InputError(f"{recording.label} has no outputs, and the simulator's observer reads them; give them.")
        own = self.matched(recording)
        model = discretise_for(self, [own])
        drive, start = model.drive(own), np.zeros(model.n_state)
        if not isinstance(own.initial, str):
            start = model.rest_at(np.asarray(own.initial, dtype=float), own.u[0], self.parameter_set.start)
        values = np.broadcast_to(self.parameter_set.start, (len(drive), self.parameter_set.size))
        return accumulate_steps(model.closed, start, drive, values)[1][:: model.substeps]

    def matched(self, recording: Recording) -> Recording:
        """Return a recording with only the simulator's columns, in its order and units.

        Raises
        ------
        InputError
            If a column is missing, or its unit measures something else; a recording without outputs needs none.
        """
        outputs = self.output_names if recording.outputs else ()
        for kind, names, own in (("input", self.inputs, recording.inputs), ("output", outputs, recording.outputs)):
            for name in names:
                if name not in own:
                    raise InputError(
                        f"{recording.label} has no {kind} {name!r}; it has {', '.join(own) or 'none'}. Map a column to "
                        "it by name."
                    )
        return recording.in_order(self.inputs, outputs).in_units(self.units)

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """Compute the NRMSE (Krikelis et al. 2024, Eq. 27) of a simulation, averaged over outputs and recordings.

        As in `Fit.nrmse`, an unknown initial state is fitted to the first samples, which are then not scored.

        Raises
        ------
        InputError
            As `simulate`, and if the recording lacks an output of the simulator.
        """
        return later("identify.simulator_nrmse")(self, recordings)

    def plot(self, recording: Recording) -> Any:
        """Draw simulated and recorded outputs: a row for each output, the largest swing and all residuals.

        An unknown initial state is fitted to the first samples; `compare` draws the same figure.

        Returns
        -------
        matplotlib.figure.Figure
        """
        return later("identify.compare")(recording, self).plot()

    @property
    def program_calls(self) -> dict[str, int]:
        """How often functions have been called with numbers, by name; empty if there are equations for all.

        A worker process counts its own calls.
        """
        found = dict[str, int]()
        for part in (self.dynamics, self.outputs):
            found |= getattr(part, "program_calls", {})
        return found

    @property
    def program_failures(self) -> dict[str, str]:
        """First error of each function that is called with numbers, by name; empty if none has failed."""
        found = dict[str, str]()
        for part in (self.dynamics, self.outputs):
            found |= getattr(part, "program_failures", {})
        return found

    def _repr_html_(self) -> str:
        return str(later("report.simulator_card")(self))

    def __repr__(self) -> str:
        lines = [
            f"Simulator with the states {', '.join(self.states) or 'none'}; inputs {', '.join(self.inputs) or 'none'}; "
            f"outputs {', '.join(self.output_names)}",
            *(f"  {e.port}: {e.law.id}" for e in self.elements),
            *(f"  {note}" for f in (self.dynamics, self.outputs) if (note := getattr(f, "note", ""))),
        ]
        for name, p in self.parameters.items():
            value = f"{float(p.value):.5g}" if p.value.ndim == 0 else np.array2string(p.value, precision=5, threshold=8)
            lines.append(f"  {name} = {value} {self._find_unit(name)}{' (fixed)' if np.all(p.fixed) else ''}".rstrip())
        return "\n".join(lines)

    def readable_parameters(self) -> ParameterSet:
        """Copy the parameters, with the parameters of laws in the units of their ports."""
        return ParameterSet({name: replace(p, unit=self._find_unit(name)) for name, p in self.parameters.items()})

    def _find_unit(self, name: str) -> str:
        """Return the unit of a parameter; for a parameter of a law, in the units of its port."""
        unit = self.parameters[name].unit
        for e in self.elements:
            if name.startswith(e.prefix):
                port = self.port(e.port)
                return readable_unit(unit, port.unit, port.position_unit, self.signal_units(e.port))
        return unit

    def with_parameters(self, parameters: Mapping[str, Any]) -> Simulator:
        """Copy with some parameters replaced; a number or an array replaces only the value.

        Raises
        ------
        InputError
            If a name is unknown.
        """
        self._check_parameters(parameters)
        own = self.parameter_set
        given = ParameterSet(
            {k: p if isinstance(p := parameters.get(k, q), Parameter) else replace(q, value=p) for k, q in own.items()}
        )
        alike = all(given[name].shape == own[name].shape for name in own)
        return self._copy_with(parameters=given) if alike else replace(self, parameters=given)

    def _check_parameters(self, names: Iterable[str]) -> None:
        own = self.parameter_set
        for name in names:
            if name not in own:
                raise InputError(f"There is no parameter {name!r}; the simulator has {', '.join(own) or 'none'}.")

    def with_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> Simulator:
        """Copy with other bounds `(lower, upper)` of some parameters, which a fit may then change.

        Raises
        ------
        InputError
            If a name is unknown, or a value lies outside its bounds.
        """
        self._check_parameters(bounds)
        return self._copy_with(parameters=self.parameter_set.free_within(bounds))

    def with_element(self, port: str, law: Any, index: int | None = None) -> Simulator:
        """Copy with a law in a port, behind all `elements` or before one of them; see `close_loop`."""
        place = self.port(port)
        if isinstance(law, type):
            names = [*getattr(law, "units", ())]
            example = f", such as {law.__name__}().at({{{names[0]!r}: 1.0}})" if names else ""
            raise InputError(f"The class {law.__name__} was given for port {port!r}; give a law with values{example}.")
        allowed = getattr(law, "places", ("series", "parallel"))
        if not place.kinds & set(allowed):
            kind = "a parameter" if place.kinds == {"parameter"} else "series" if place.series else "parallel"
            raise InputError(f"The law {law.id!r} cannot stand in {kind} at {port!r}; choose another port or law.")
        if getattr(law, "in_line", False) and not place.has_term_for(law):
            raise InputError(
                f"The law {law.id!r} ({law.form or 'plain'}) stands in line with a term of the equations, and the port "
                f"{port!r} names none; give Port(..., term=...), or choose another law."
            )
        if getattr(law, "sensed", False) and not self.shown_states(place):
            raise InputError(
                f"The law {law.id!r} ({law.form}) changes what outputs show of {port!r}, but no output reads its "
                "coordinate as a state, or that state's rate; choose another port or law."
            )
        if getattr(law, "channels", 1) != 1:
            raise InputError(f"The element has {law.channels} channels, the port {port!r} has one; give as many.")
        if lacks := getattr(law, "lacks", ""):
            raise InputError(f"The law {law.id!r} cannot be closed in at {port!r} yet: {lacks}.")
        placed = Placed(port, law, self._choose_prefix(port))
        own = self.parameter_set | placed.named(law.parameters())
        at = len(self.elements) if index is None else index
        if at not in range(len(self.elements) + 1):
            raise InputError(f"The index is {index!r}; give a whole number from 0 to {len(self.elements)}.")
        return self._copy_with(parameters=own, elements=(*self.elements[:at], placed, *self.elements[at:]))

    def _choose_prefix(self, port: str) -> str:
        """Choose the prefix of a further law's parameters at a port; no other parameter's name begins with it."""
        taken = (*self.parameters, *(e.prefix for e in self.elements))
        prefixes = itertools.chain([f"{port}."], (f"{port}#{k}." for k in itertools.count(2)))
        return next(p for p in prefixes if not any(name.startswith(p) for name in taken))

    def without_element(self, index: int = -1) -> Simulator:
        """Copy without one of the `elements`, by default the last."""
        others = list(self.elements)
        removed = others.pop(index)
        own = {k: p for k, p in self.parameters.items() if not k.startswith(removed.prefix)}
        return self._copy_with(parameters=ParameterSet(own), elements=tuple(others))


def unit_notes(units: Mapping[str, str], recording: Recording, owner: str = "simulator") -> dict[str, str]:
    """Describe, by channel, the conversions of a recording's values to a simulator's units, and unknown units."""
    out = {}
    for name in (n for n in (*recording.inputs, *recording.outputs) if n in recording.units):
        unit, wanted = recording.units[name], units.get(name, "")
        factor = recording.factor_to(units, name)
        said = f"{name} is recorded in {unit}, and the {owner} has it in {wanted}"
        if factor != 1:
            out[name] = f"{said}: its values were multiplied by {factor:g}."
        elif wanted and unit != wanted and conversion(unit, wanted) is None:
            out[name] = f"{said}; no conversion is known, so that its values were taken as they are."
    return out
