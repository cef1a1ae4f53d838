"""A base rig of the concealed cases: the simulator an engineer hands over, as source text, with the ranges of truth.

`$parameters` and `$ports` stand in the text; the same text is run here and written for the command line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

FORCE: tuple[str, ...] = (
    "cubic_stiffness",
    "quadratic_stiffness",
    "piecewise_stiffness",
    "clearance",
    "coulomb_friction",
)
FORCE += ("stribeck_friction", "quadratic_drag", "cubic_damping", "hysteresis", "creep", "extra_mode")
SPRING: tuple[str, ...] = (
    "cubic_stiffness",
    "quadratic_stiffness",
    "piecewise_stiffness",
    "clearance",
    "cubic_damping",
)
SPRING += ("hysteresis", "creep")
GUIDE = ("coulomb_friction", "stribeck_friction", "quadratic_drag", "cubic_damping", "periodic_force")
SHAFT = ("cubic_stiffness", "clearance", "hysteresis", "coulomb_friction")
FLOW = ("cubic_stiffness", "quadratic_stiffness", "piecewise_stiffness")
ACTUATOR = ("saturation", "dead_zone", "backlash", "hysteresis", "static_curve", "delay", "creep", "extra_mode")
SENSOR = ("saturation", "static_curve", "delay", "drift", "backlash", "dead_zone", "extra_mode")

HEAD = "import casadi as ca\n\nfrom pilfr_casadi import Parameter, Port, Simulator\n"
TAIL = "\nsimulator = Simulator(\n    dynamics,\n    outputs,\n    states=$states,\n    inputs=$inputs,\n"
TAIL += "    parameters=dict(\n$parameters    ),\n    ports=($ports),\n)\n"


@dataclass(frozen=True)
class Rig:
    """A base rig.

    Parameters
    ----------
    body : str
        Source of `dynamics` and `outputs`.
    parameters : mapping
        name -> (low, high, unit, fixed); truth is drawn log-uniformly between.
    ports : mapping
        name -> source text of the Port.
    laws : mapping
        Port -> law ids that make sense there.
    force : tuple of float
        Amplitude (standard deviation) of each input.
    bare : mapping
        Port -> name it has where the user declares no ports; empty where the ports are always declared.
    band : tuple of float
        Excitation up to this multiple of the characteristic frequency, drawn between.
    """

    name: str
    title: str
    body: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: Mapping[str, tuple[float, float, str, bool]]
    ports: Mapping[str, str]
    laws: Mapping[str, tuple[str, ...]]
    force: tuple[float, ...]
    bare: Mapping[str, str] = field(default_factory=dict)
    integrator: bool = False
    slow: bool = False  # first-order plant: sampled in proportion to its time constant
    linear_plant: bool = True
    quasi_static: bool = False
    hold: str | None = None
    band: tuple[float, float] = (1.6, 2.8)

    def source(self, values: Mapping[str, str], declared: bool = True) -> str:
        """Text of SIMULATOR.py with `Parameter(...)` texts."""
        lines = "".join(f"        {n}={t},\n" for n, t in values.items())
        ports = "".join(f"\n        {t}," for t in self.ports.values()) if declared else ""
        text = f'"""{self.title}."""\n\n{HEAD}{self.body}{TAIL}'
        text = text.replace("$states", repr(self.states)).replace("$inputs", repr(self.inputs))
        return text.replace("$parameters", lines).replace("$ports", ports + ("\n    " if ports else ""))

    def module(self, source: str) -> dict[str, Any]:
        """Run a source; the names are given to it, so that it also runs where they are not exported."""
        from pilfr_casadi.models import Parameter
        from pilfr_casadi.simulators import Port, Simulator

        space: dict[str, Any] = {"Parameter": Parameter, "Port": Port, "Simulator": Simulator, "__name__": "rig"}
        exec(source.replace("from pilfr_casadi import Parameter, Port, Simulator\n", ""), space)
        return space


def port(name: str, into: str, across: str, rate: str | None, unit: str = "N", across_unit: str = "m") -> str:
    """Source of a port."""
    text = f'Port("{name}", into={into}, across={across}'
    return text + (f", rate={rate}" if rate else "") + f', unit="{unit}", across_unit="{across_unit}")'
