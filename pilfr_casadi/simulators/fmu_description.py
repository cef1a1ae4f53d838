"""Read a functional mock-up unit without running it: its file and its `modelDescription.xml`."""

from __future__ import annotations

import os
import platform
import re
import sys
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from .._base import InputError, existing_file, listed, quote_error

SYSTEMS = {  # folders of programs in FMI 2.0 and 3.0, and their suffix
    "linux": ("linux", "linux", ".so"),
    "darwin": ("darwin", "darwin", ".dylib"),
    "win32": ("win", "windows", ".dll"),
}


@dataclass(frozen=True)
class Variable:
    """A variable of modelDescription.xml; missing numbers are NaN."""

    name: str
    causality: str
    variability: str
    unit: str
    low: float
    high: float
    nominal: float
    start: float
    reference: int


@dataclass(frozen=True)
class Description:
    """The content of modelDescription.xml.

    `identifier` is empty for a unit without model exchange, `slave` for a unit without co-simulation; `step_size` is
    NaN if the file states none.
    """

    version: str
    token: str
    identifier: str
    slave: str
    binary: str
    variables: dict[str, Variable]
    states: tuple[str, ...]
    step_size: float
    variable_steps: bool
    event_indicators: int
    others: dict[str, str]  # types of the variables that are no single real number of 64 bits

    def of(self, causality: str) -> tuple[str, ...]:
        """Names of the variables of a causality."""
        return tuple(v.name for v in self.variables.values() if v.causality == causality)


@dataclass(frozen=True, eq=False)
class Unit:
    """A unit with the content of its description."""

    path: Path
    described: Description

    @property
    def variables(self) -> dict[str, Variable]:
        """Variables by name."""
        return self.described.variables

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.described.of("input")


def describe(path: Path) -> Description:
    """Read modelDescription.xml."""
    existing_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            root = ET.fromstring(archive.read("modelDescription.xml"))
        entries = list(root.iterfind("ModelVariables/*"))
        types = _read_types(root)
        variables = {v.name: v for entry in entries if (v := _read_variable(entry, types)) is not None}
        events = len(list(root.iterfind("ModelStructure/EventIndicator")))
        events = events or int(root.get("numberOfEventIndicators") or 0)
    except (zipfile.BadZipFile, KeyError, ET.ParseError, OSError, EOFError, ValueError) as error:
        raise InputError(
            f"{path} is not a functional mock-up unit ({quote_error(error, -1)}); export it again."
        ) from None
    version = root.get("fmiVersion", "").partition(".")[0]
    token = root.get("guid" if version == "2" else "instantiationToken", "")
    kinds = [root.find(kind) for kind in ("ModelExchange", "CoSimulation")]
    identifier, slave = ("" if kind is None else kind.get("modelIdentifier", "") for kind in kinds)
    varies = kinds[1] is not None and kinds[1].get("canHandleVariableCommunicationStepSize") in ("true", "1")
    experiment = root.find("DefaultExperiment")
    step_size = _read_number(None if experiment is None else experiment.get("stepSize"))
    try:
        states = tuple(_state_names(root, entries, version))
    except (ValueError, IndexError, KeyError, StopIteration):
        states = ()
    binary = binary_path(identifier or slave, version)
    others = {n: _type(entry) for entry in entries if (n := entry.get("name", "")) not in variables}
    numbers = step_size, varies, events
    return Description(version, token, identifier, slave, binary, variables, states, *numbers, others)


def binary_path(identifier: str, version: str) -> str:
    """Return the path of this platform's program inside a unit of FMI "2" or "3"."""
    system, system3, suffix = SYSTEMS.get(sys.platform, SYSTEMS["linux"])
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    folder = f"{system}64" if version == "2" else f"{machine}-{system3}"
    return f"binaries/{folder}/{identifier}{suffix}"


def _state_names(root: ET.Element, entries: list[ET.Element], version: str) -> Iterator[str]:
    """List the states in the order of the unit's vector, found by the derivatives in its structure."""
    if version == "2":
        for unknown in root.iterfind("ModelStructure/Derivatives/Unknown"):
            real = entries[int(unknown.get("index", 0)) - 1].find("Real")
            assert real is not None
            yield entries[int(real.get("derivative", 0)) - 1].get("name", "")
        return
    by_reference = {entry.get("valueReference"): entry for entry in entries}
    for unknown in root.iterfind("ModelStructure/ContinuousStateDerivative"):
        state = by_reference[unknown.get("valueReference")].get("derivative")
        yield by_reference[state].get("name", "")


def _read_types(root: ET.Element) -> dict[str, dict[str, str]]:
    """Read the attributes of declared types by name."""
    old = {e.get("name", ""): e.find("Real") for e in root.iterfind("TypeDefinitions/SimpleType")}
    new = {e.get("name", ""): e for e in root.iterfind("TypeDefinitions/Float64Type")}
    return {name: dict(e.attrib) for name, e in {**old, **new}.items() if e is not None}


def _type(entry: ET.Element) -> str:
    """Return the type of a variable in words."""
    if entry.find("Dimension") is not None:
        return f"an array of {entry.tag}"
    return next((child.tag for child in entry if child.tag != "Annotations"), entry.tag) if len(entry) else entry.tag


def _read_variable(entry: ET.Element, types: dict[str, dict[str, str]]) -> Variable | None:
    """Read a real variable, with what its declared type states; None for one of another type, and for an array."""
    real = entry.find("Real")
    if (real is None and entry.tag != "Float64") or entry.find("Dimension") is not None:
        return None
    own = (entry if real is None else real).attrib
    stated = {**types.get(own.get("declaredType", ""), {}), **own}
    low, high, nominal, start = (_read_number(stated.get(key)) for key in ("min", "max", "nominal", "start"))
    name, causality, variability = entry.get("name", ""), entry.get("causality", "local"), entry.get("variability")
    reference, unit = int(entry.get("valueReference", 0)), stated.get("unit", "")
    return Variable(name, causality, variability or "continuous", unit, low, high, nominal, start, reference)


def _read_number(text: str | None) -> float:
    try:
        return float(text) if text is not None else np.nan
    except ValueError:
        return np.nan


def check_file(path: Path, stepped: bool = False) -> Description:
    """Refuse a file that is no unit with a program for this platform, or cannot be stepped; return its description."""
    unit = describe(path)
    if stepped and not unit.slave and unit.identifier:
        raise InputError(f"cosimulation was given, but {path} is for model exchange alone; leave it out.")
    if stepped:
        unit = replace(unit, identifier="", binary=binary_path(unit.slave, unit.version))
    if unit.version not in ("2", "3"):
        raise InputError(f"{path} is a unit of FMI {unit.version or '(none stated)'}; give one of FMI 2.0 or 3.0.")
    if not (unit.identifier or unit.slave):
        raise InputError(f"{path} is neither for model exchange nor for co-simulation; export it for one of these.")
    if not any(v.causality == "output" for v in unit.variables.values()):
        raise InputError(f"{path} has no output; export it with the measured variables as outputs.")
    with zipfile.ZipFile(path) as archive:
        there = {name.split("/")[1] for name in archive.namelist() if name.startswith("binaries/") and name[-1] != "/"}
    own = unit.binary.split("/")[1]
    if own not in there:
        raise InputError(f"{path} has programs for {listed(sorted(there)) or 'no platform'}; export it for {own}.")
    return unit


def needs_step_size(path: str | os.PathLike[str]) -> bool:
    """Tell whether a functional mock-up unit is for co-simulation alone, so that it has to be stepped."""
    described = describe(Path(path))
    return bool(described.slave) and not described.identifier


def fmu_signals(path: str | os.PathLike[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """List the inputs and the outputs of a functional mock-up unit, without running it."""
    described = describe(Path(path))
    return described.of("input"), described.of("output")


def parse_port(name: str, text: str, variables: Collection[str]) -> dict[str, str]:
    """Parse a port INTO[UNIT]:ACROSS[UNIT][:RATE]; the units are optional, and brackets may belong to a variable."""
    parts = [part.strip() for part in text.split(":")]
    if not 2 <= len(parts) <= 3 or not all(parts):
        raise InputError(
            f"The port {name}={text} was given; write NAME=INTO:ACROSS or NAME=INTO:ACROSS:RATE, with units as in "
            "loss[W]:temperature[K]."
        )
    out = {}
    for key, unit_key, part in zip(("into", "across", "rate"), ("unit", "across_unit", ""), parts, strict=False):
        found = None if part in variables else re.fullmatch(r"(.*\S)\s*\[([^\[\]]*)\]", part)
        if found and re.fullmatch(r"[\d, ]*", found[2]):  # an index
            found = None
        out[key] = found[1] if found else part
        if found and unit_key:  # the unit of a rate follows from that of the coordinate
            out[unit_key] = found[2].strip()
    return out
