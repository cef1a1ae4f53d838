"""A step as a co-simulation FMU (https://fmi-standard.org): C source, binary and `modelDescription.xml` in one archive.

The source is the code that CasADi generates for `(x, u, p) -> (x_next, y)`, behind the functions of FMI 2.0 or 3.0. It
includes no header of the standard, so it compiles anywhere. A value reference is the index of a variable in one array:
time, parameters, states, inputs, slopes of interpolated inputs, outputs.
"""

from __future__ import annotations

import io
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np

from .._base import InputError, __version__, digest, path_text, write_atomically
from ..engine import compiler, run_compiler
from ..models import ParameterSet
from ..simulators import binary_path
from .c_code import fill_template, generate_code, make_unique

VERSIONS = ("2.0", "3.0")
# -O1: see `engine.compiled`; without fused products, so that its numbers equal the result of `simulate`
OPTIONS = ("-O1", "-fno-thread-jumps", "-fPIC", "-shared", "-std=c99", "-ffp-contract=off", "-fvisibility=hidden")
EPOCH = (1980, 1, 1, 0, 0, 0)  # time of all files in the archive, so that the same model gives the same bytes
UNUSED_TYPES = (  # of FMI 3.0
    *((f"Int{n}", f"int{n}_t") for n in (8, 16, 32, 64)),
    *((f"UInt{n}", f"uint{n}_t") for n in (8, 16, 32, 64)),
    ("Float32", "float"),
    ("Boolean", "bool"),
    ("String", "fmi3String"),
)


@dataclass(frozen=True)
class _Variable:
    """An entry of the FMU's array; its value reference is its place."""

    name: str
    causality: str
    variability: str
    start: float
    unit: str = ""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    description: str = ""


@dataclass(frozen=True, eq=False)
class FmuContent:
    """A step and its description in the FMU.

    Attributes
    ----------
    step : casadi.Function
        `(x, u, p) -> (x_next, y)`.
    names : mapping
        As of `Exported.names`.
    parameters : ParameterSet
        Entries of p.
    interpolated : bool
        Whether the second half of u holds the inputs of the next sample.
    time_state : int or None
        Index of the state that is the time.
    """

    step: ca.Function
    names: Mapping[str, Any]
    parameters: ParameterSet
    interpolated: bool
    time_state: int | None

    @property
    def inputs(self) -> list[str]:
        """Names of the inputs at the present sample."""
        given = list(self.names["inputs"])
        return given[: len(given) // 2] if self.interpolated else given

    @cached_property
    def variables(self) -> list[_Variable]:
        """All variables in the order of the array; inputs, outputs and parameters keep their names."""
        found = list(self._list_variables())
        by_rank = sorted(range(len(found)), key=lambda i: found[i].causality == "local")
        unique = make_unique(_clean(found[i].name) for i in by_rank)
        names = dict(zip(by_rank, unique, strict=True))
        return [replace(v, name=names[i]) for i, v in enumerate(found)]

    def _list_variables(self) -> Iterator[_Variable]:
        units, thresholds = self.names["units"], self.names["thresholds"]
        yield _Variable("time", "independent", "continuous", 0.0, "s", description="Time")
        own = self.parameters
        unit_of = [p.unit for p in own.values() for _ in range(p.size)]
        for name, value, unit, low, high, free in zip(
            own.labels, own.start, unit_of, own.lower, own.upper, own.free, strict=True
        ):
            yield _Variable(name, "parameter", "tunable" if free else "fixed", value, unit, (low, high))
        for (name, index), value in zip(self.names["states"].items(), self.names["x0"], strict=True):
            text = "Time inside the equations" if index == self.time_state else "State"
            text = f"Memory of half-width {thresholds[name]:.6g}" if name in thresholds else text
            unit = "s" if index == self.time_state else units.get(name, "")
            yield _Variable(f"state.{name}", "local", "continuous", value, unit, description=text)
        for name in self.inputs:
            yield _Variable(name, "input", "continuous", 0.0, units.get(name, ""))
        for name in self.inputs if self.interpolated else ():
            unit = f"{units[name]}/s" if units.get(name) else ""
            text = f"Slope of {name} until the next sample"
            yield _Variable(f"der({name})", "input", "continuous", 0.0, unit, description=text)
        for name in self.names["outputs"]:
            yield _Variable(name, "output", "continuous", 0.0, units.get(name, ""))


def write_fmu(path: str | os.PathLike[str], content: FmuContent, fmi: str) -> Path:
    """Write the FMU of a step; see `Exported.to_fmu`."""
    if fmi not in VERSIONS:
        raise InputError(f"The FMI version {fmi!r} was given; give one of {', '.join(VERSIONS)}.")
    if not path_text(path, "file").endswith(".fmu"):
        raise InputError(f"{path} was given for the FMU; give a name that ends in .fmu.")
    name = content.names["name"]
    code = generate_code(content.step)
    token = digest({"code": code, "description": _write_description(content, fmi, "")})
    source = _write_source(content, fmi, token, code)
    files: dict[str, str | bytes] = {
        "modelDescription.xml": _write_description(content, fmi, token),
        binary_path(name, fmi[0]): _compile_library(source),
        f"sources/{name}.c": source,
    }
    if fmi == "3.0":
        files["sources/buildDescription.xml"] = _write_build_description(name)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as out:
        for inside, data in files.items():
            out.writestr(zipfile.ZipInfo(inside, EPOCH), data, zipfile.ZIP_DEFLATED)
    return write_atomically(path, archive.getvalue())


def _write_source(content: FmuContent, fmi: str, token: str, code: str) -> str:
    variables = content.variables
    return fill_template(
        "_fmu.c",
        {
            **content.names,
            "fmi": fmi,
            "token": token,
            "code": code,
            "function": content.step,
            "interpolated": content.interpolated,
            "time_state": content.time_state,
            "start": [float(v.start) for v in variables],
            "n_p": content.parameters.size,
            "n_x": len(content.names["states"]),
            "n_u": len(content.inputs),
            "n_y": len(content.names["outputs"]),
            "types": UNUSED_TYPES,
        },
    )


def _compile_library(source: str) -> bytes:
    """Compile the source to a library of this platform; return its bytes."""
    cc = compiler()
    if cc is None:
        raise InputError("An FMU holds a compiled program, and no C compiler was found; install cc, gcc or clang.")
    with tempfile.TemporaryDirectory() as folder:
        try:
            return run_compiler(cc, source, Path(folder), OPTIONS).read_bytes()
        except OSError as error:
            raise InputError(
                f"The C compiler {cc} could not build the FMU ({error}); repair it, or name another in CC."
            ) from None


def _write_description(content: FmuContent, fmi: str, token: str) -> str:
    """Write modelDescription.xml."""
    two, name = fmi == "2.0", content.names["name"]
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": fmi,
            "modelName": name,
            "guid" if two else "instantiationToken": token,
            "generationTool": f"pilfr_casadi {__version__}",
            "variableNamingConvention": "flat",
        },
    )
    state = "FMUstate" if two else "FMUState"
    abilities = {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    if two:
        abilities |= {"canInterpolateInputs": str(content.interpolated).lower()}
        abilities |= {"canNotUseMemoryManagementFunctions": "true"}
    else:
        abilities |= {"fixedInternalStepSize": repr(float(content.names["dt"]))}
    simulation = ET.SubElement(root, "CoSimulation", {"modelIdentifier": name, **abilities})
    if two:
        ET.SubElement(ET.SubElement(simulation, "SourceFiles"), "File", name=f"{name}.c")
    units = list(dict.fromkeys(unit for v in content.variables if (unit := _clean(v.unit))))
    defined = ET.SubElement(root, "UnitDefinitions")
    for unit in units:
        ET.SubElement(defined, "Unit", name=unit)
    ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name="logStatusError")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(float(content.names["dt"])))
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(content.variables):
        _add_variable(variables, variable, reference, two)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [i for i, v in enumerate(content.variables) if v.causality == "output"]
    for kind in ("Outputs", "InitialUnknowns") if two and outputs else ():
        group = ET.SubElement(structure, kind)
        for i in outputs:
            ET.SubElement(group, "Unknown", index=str(i + 1))
    for kind in () if two else ("Output", "InitialUnknown"):
        for i in outputs:
            ET.SubElement(structure, kind, valueReference=str(i))
    return _to_text(root)


def _add_variable(parent: ET.Element, variable: _Variable, reference: int, two: bool) -> None:
    """Add a variable; in FMI 2.0 its numbers are in an element of their own."""
    v = variable
    about = {"name": v.name, "valueReference": str(reference), "causality": v.causality, "variability": v.variability}
    if v.description:
        about["description"] = _clean(v.description)
    if v.causality in ("parameter", "local"):
        about["initial"] = "exact"
    numbers = {"unit": unit} if (unit := _clean(v.unit)) else {}
    if v.causality not in ("output", "independent"):
        numbers["start"] = repr(float(v.start))
    numbers |= {key: repr(float(b)) for key, b in zip(("min", "max"), v.bounds, strict=True) if np.isfinite(b)}
    if two:
        ET.SubElement(ET.SubElement(parent, "ScalarVariable", about), "Real", numbers)
    else:
        ET.SubElement(parent, "Float64", about | numbers)


def _write_build_description(name: str) -> str:
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    sources = ET.SubElement(build, "SourceFileSet", language="C99")
    ET.SubElement(sources, "SourceFile", name=f"{name}.c")
    return _to_text(root)


def _to_text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _clean(text: str) -> str:
    """Replace the characters that XML or the standard forbids in a name."""
    return "".join(c if c.isprintable() else "_" for c in text)
