"""An effect: a piece of physics that the simulator leaves out, as data and as text."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..simulators import EQUATION, PARAMETER, Placed, Simulator, in_series, name_at, split_port
from .faults.gates import value_with_unit
from .fits.evidence import SURE

OUTPUT_REVERSED = "as fitted it helps the motion: the sign of the output, or of the port's rate, may be reversed"
PORT_REVERSED = "its strength is negative, as a positive force at this port helps the motion: check the port's sign"


def sign_doubt(simulator: Simulator, e: Placed, values: Mapping[str, Any]) -> str:
    """Say that friction or damping in a declared port has negative strengths alone; empty if it opposes the motion."""
    law = e.law
    if not law.dissipative or e.port not in {port.name for port in simulator.ports}:
        return ""
    own = e.own(values)
    strengths = np.concatenate([np.zeros(0), *(np.ravel(own[name]) for name in law.strength if name not in law.signed)])
    if not (np.all(strengths <= 0) and np.any(strengths < 0)):
        return ""
    moved = simulator.into(simulator.port(e.port), *simulator.symbols())
    return OUTPUT_REVERSED if set(moved) <= set(simulator.output_names) else PORT_REVERSED


@dataclass(frozen=True, eq=False)
class Effect:
    """A piece of physics that the simulator leaves out.

    Attributes
    ----------
    at_port : float
        Confidence that this law or another of the catalogue acts at its port; nan if unknown.
    test_without : float, optional
        NRMSE on the test recordings of the corrected simulator without this effect, the others refitted; nan if there
        is no other.
    """

    port: str
    law: str
    confidence: float
    sentence: str
    equation: str
    parameters: dict[str, dict[str, Any]]
    indistinguishable: tuple[tuple[str, str], ...] = ()
    form: str = ""
    placebo: Mapping[str, float] = field(default_factory=dict)
    test_without: float = np.nan
    at_port: float = np.nan

    @property
    def name(self) -> str:
        """The law and its port in words."""
        return name_at(self.port, self.law, self.form)

    @property
    def place(self) -> str:
        """Tell for which ports the confidence holds, if for several; and that any law acts there, if that is surer."""
        ports = dict.fromkeys([self.port, *(port for port, law in self.indistinguishable if law == self.law)])
        where = f" that it acts at {' or '.join(ports)}" if len(ports) > 1 else ""
        surer = self.at_port > SURE > self.confidence
        return where + (f"; confidence {self.at_port:.2f} that a law acts there" if surer else "")

    def limit(self, name: str) -> str:
        """Say that a parameter is at the limit of what is tried here, or not distinct from zero; else empty."""
        p = self.parameters.get(name, {})
        if p.get("at_limit"):
            return ", at the limit of the values tried"
        superfluous = p.get("std") is not None and abs(p["value"]) < p["std"]
        return ", zero within its standard error: this term may be superfluous" if superfluous else ""

    @property
    def defined(self) -> dict[str, dict[str, Any]]:
        """Derived quantities: a product in the equation, such as `F_c = k_t r`, or the whole gap of a clearance."""
        if self.law == "clearance" and "g" in self.parameters:
            half = self.parameters["g"]
            std = None if half["std"] is None else 2 * half["std"]
            return {"gap": {"value": 2 * half["value"], "std": std, "unit": half["unit"]}}
        found = re.search(r",  (\w+) = (\w+) (\w+)$", self.equation)
        if not found or not all(name in self.parameters for name in found.groups()[1:]):
            return {}
        a, b = (self.parameters[key] for key in found.groups()[1:])
        unit = a["unit"].removesuffix(f"/{b['unit']}") if a["unit"].endswith(f"/{b['unit']}") else ""
        return {found[1]: {"value": a["value"] * b["value"], "std": None, "unit": unit}}

    def to_dict(self) -> dict[str, Any]:
        """Return the content for diagnosis.json."""
        out: dict[str, Any] = {
            "port": self.port,
            "law": self.law,
            "confidence": self.confidence,
            "sentence": self.sentence,
            "equation": self.equation,
            "parameters": self.parameters,
            "indistinguishable": [{"port": p, "law": law} for p, law in self.indistinguishable],
        }
        if self.form:
            out["form"] = self.form
        if self.placebo:
            out["placebo"] = dict(self.placebo)
        if not np.isnan(self.at_port):
            out["confidence_at_port"] = self.at_port
        if not np.isnan(self.test_without):
            out["test_without"] = self.test_without
        return out

    def __str__(self) -> str:
        kind, of = split_port(self.port)
        if kind == PARAMETER:
            symbols = f"where the change is added to {of}"
        elif in_series(self.port):
            symbols = "where u or z is the signal, and w is added to it"
        else:
            local = "v the speed" if re.search(r"\bv\b", self.equation) else "z the local coordinate"
            what = f"subtracted from the derivative of {of}" if kind == EQUATION else "the force or flow"
            if kind == EQUATION:
                local += (
                    f" at the port; times what the equation of {of} divides by (such as a mass, an area or a heat "
                    "capacity) it is a force that opposes, or a flow that leaves"
                )
            symbols = f"where w is {what} and {local}" + " at the port" * (kind != EQUATION)
        lines = [
            f"{self.name}, confidence {self.confidence:.2f}{self.place}",
            f"  {self.sentence}: {self.equation}",
            f"  {symbols}",
        ]
        shown = self.parameters | self.defined
        for name, keys in itertools.groupby(shown, lambda key: key.split("[")[0]):
            values = [shown[key] for key in keys]
            if name in shown:
                p = shown[name]
                std = "" if p["std"] is None else f" ± {p['std']:.2g}"
                lines.append(f"  {name} = {p['value']:.5g}{std} {p['unit']}".rstrip() + self.limit(name))
            else:  # an array; the report has the standard errors
                lines.append(f"  {name} = {value_with_unit([p['value'] for p in values], values[0]['unit'], 5)}")
        if self.indistinguishable:
            others = ", ".join(name_at(port, law) for port, law in self.indistinguishable)
            lines.append(f"  cannot be told apart from {others}")
        return "\n".join(lines)

    __repr__ = __str__
