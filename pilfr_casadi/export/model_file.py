"""Models on disk: write and read the values of a fit as JSON.

A model file is standard JSON: format and version, structure, parameter values by name with units and standard errors,
sampling, names, and a summary of the training. Its SHA-256 reveals numbers that were changed afterwards. The file holds
no code, and every number is restored to the last digit. A PI-LFR (Krikelis et al. 2024, Eq. 15-17) can be rebuilt from
its file; for a model of the user's own equations the file holds only the values.

Nothing in a file is trusted or executed. Sizes are compared with the numbers in the file before anything is built, so a
few bytes cannot ask for a model of a billion operators. Every value must be finite and have the right shape, and must
agree with the bounds and fixed values of the structure (by default `w >= 0` and `r >= 0` as in Eq. 16).
"""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import comb
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from .._base import (
    InputError,
    __version__,
    existing_file,
    is_number,
    ordered_digest,
    path_text,
    short,
    to_json,
    write_atomically,
)
from ..models import (
    OPERATORS,
    PILFR,
    Combined,
    Element,
    Envelope,
    GeneralizedPlay,
    Model,
    Part,
    PrandtlIshlinskii,
    Products,
    StaticNetwork,
    block_shapes,
)
from ..optimise import Candidate, Iteration, Limit, Solution, Status
from ..simulators import Simulator, discretise

if TYPE_CHECKING:
    from . import model_schema as schema

FORMAT = "pilfr_casadi model"
VERSION = 2
VERSION_WITHOUT_DIGEST = 1  # read with a warning
LARGEST_FILE = 200_000_000  # bytes; a model with 500 states takes 20 million
MOST_PARTS = 100  # combined elements, and largest degree of products; more would only exhaust the memory
HISTORY = ("number", "cost", "seconds", "step", "damping")  # columns of a solver's history
ELEMENT_FIELDS = {Envelope: ("channels",), Products: ("channels", "degrees"), StaticNetwork: ("hidden", "channels")}
LIMIT_NUMBERS = ("value", "lower", "upper", "multiplier")
SIMULATORS = {  # by the end of a file's name, for messages
    ".fmu": ("a functional mock-up unit", "from_fmu"),
    **dict.fromkeys((".xml", ".urdf"), ("a mechanism for MuJoCo", "from_mujoco")),
}
DEEPEST = 3  # levels of nested lists in an array: no parameter has more than two dimensions


@dataclass(frozen=True, eq=False)
class FitContent:
    """The values of a fit that a model file holds.

    Fields are named as in `Fit`; `structure` is None for a model of the user's own equations. The keys of `initial` and
    `weights` are the recordings' fingerprints. `noise` is the noise level that weights the data against priors.
    `limits` is None for files of the first releases, which did not store them.
    """

    model: Model
    structure: PILFR | None
    dt: float
    solution: Solution
    labels: tuple[str, ...] = ()
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    linear: Model | None = None
    initial: Mapping[str, np.ndarray] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    train_nrmse: tuple[float, ...] = ()
    linear_nrmse: tuple[float, ...] = ()
    seconds: float = 0.0
    active: tuple[str, ...] = ()
    limits: tuple[Limit, ...] | None = ()
    noise: float | None = None
    weights: Mapping[str, float] | None = None
    candidates: tuple[Candidate, ...] = ()


class _Unusable(Exception):
    """A file cannot be used as it is; the message completes the sentence "The file ..."."""


def write_model_file(path: str | os.PathLike[str], content: FitContent) -> None:
    """Write a fit as JSON, atomically; for a model of the user's own equations only its values."""
    write_atomically(path, model_text(content))


def model_text(content: FitContent) -> str:
    """Return the text of a model file."""
    tables = _make_tables(content)
    return _format_json({**tables, "sha256": ordered_digest(tables)}) + "\n"


def _make_tables(fit: FitContent) -> dict[str, Any]:
    model, solution = fit.model, fit.solution
    limited = len(solution.theta) + sum(limit.kind == "constraint" for limit in fit.limits or ())
    return {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {"pilfr_casadi": __version__, "casadi": ca.__version__},
        "model": {
            "dt": fit.dt,
            "inputs": [{"name": name, "unit": fit.units.get(name, "")} for name in model.inputs],
            "outputs": [{"name": name, "unit": fit.units.get(name, "")} for name in model.outputs],
            "states": model.states,
            "memory": model.n_s,
            **({"hold": model.hold, "substeps": model.substeps} if fit.structure is None else {}),
        },
        "structure": None if fit.structure is None else _make_structure_table(fit.structure),
        "parameters": {
            name: {"value": _to_json(p.value), "std": _to_json(fit.errors.get(name), "inf"), "unit": p.unit}
            for name, p in model.parameters.items()
        },
        "linear": None if fit.linear is None else {k: _to_json(p.value) for k, p in fit.linear.parameters.items()},
        "initial_states": {recording: _to_json(state) for recording, state in fit.initial.items()},
        "training": {
            "status": solution.status.name,
            "sentence": solution.status.value,
            "message": solution.message,
            "nrmse": _to_json(fit.train_nrmse),
            "noise": fit.noise,
            "weights": None if fit.weights is None else dict(fit.weights),
            "linear_nrmse": _to_json(fit.linear_nrmse),
            "seconds": fit.seconds,
            "active": fit.active,
            "limits": [
                {key: _to_json(v, "inf") if key in LIMIT_NUMBERS else v for key, v in asdict(limit).items()}
                for limit in fit.limits or ()
            ],
            "solve": _make_solve_table(solution),
            "variables": dict(zip(fit.labels, _to_json(solution.theta), strict=True)),
            "multipliers": _to_json(solution.multipliers if len(solution.multipliers) == limited else ()),
            "history": {key: _to_json([getattr(h, key) for h in solution.history]) for key in HISTORY},
            "starts": [
                {
                    "seed": c.seed,
                    "error": _to_json(c.error),
                    "status": c.solution.status.name,
                    "note": c.note,
                    "drawn": c.drawn,
                    **_make_solve_table(c.solution),
                }
                for c in fit.candidates
            ],
        },
    }


def _make_solve_table(solution: Solution) -> dict[str, Any]:
    numbers = {key: _to_json(getattr(solution, key)) for key in ("cost", "violation", "seconds")}
    return {"iterations": int(solution.iterations), **numbers}


def _make_structure_table(structure: PILFR) -> dict[str, Any]:
    pairs = {"bounds": structure.bounds, "priors": structure.priors}
    return {
        "nx": int(structure.nx),
        "offset": bool(structure.offset),
        "element": None if structure.element is None else _make_element_table(structure.element),
        "fixed": {name: _to_json(value) for name, value in structure.fixed.items()},
        **{key: {name: [_to_json(v) for v in pair] for name, pair in table.items()} for key, table in pairs.items()},
    }


def _make_element_table(element: Any) -> dict[str, Any]:
    if isinstance(element, Combined):
        parts = [
            {"name": p.name, "element": _make_element_table(p.element), "reads": p.reads, "writes": p.writes}
            for p in element.parts
        ]
        return {"kind": element.kind, "channels": element.channels, "parts": parts}
    if not isinstance(element, PrandtlIshlinskii):
        if type(element) not in ELEMENT_FIELDS:
            return {"kind": type(element).__name__}
        return {"kind": element.kind, **{name: getattr(element, name) for name in ELEMENT_FIELDS[type(element)]}}
    operator = element.operator
    out = {"kind": element.kind, "operator": operator.name, "n": element.n, "channels": element.channels}
    out["rounded"] = element.rounded
    if isinstance(operator, GeneralizedPlay):
        own = [side for side in ("l", "r") if getattr(operator, f"gamma_{side}") is not None]
        out |= {"neurons": operator.neurons, "expressions": own}
    return out


def _to_json(value: Any, infinite: str | None = None) -> Any:
    """Convert numbers to JSON: arrays to nested lists, nan to null, infinity to `infinite`."""
    return to_json(np.asarray(value, dtype=float), infinite)


def _format_json(value: Any, depth: int = 0) -> str:
    """Format JSON with one line for each entry of the outer tables, so that people can read and compare files."""
    if isinstance(value, dict) and value and depth < 2:
        pad = " " * (depth + 1)
        rows = [f"{pad}{json.dumps(key)}: {_format_json(item, depth + 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(rows) + "\n" + " " * depth + "}"
    return json.dumps(value, allow_nan=False)


def read_model_file(path: str | os.PathLike[str], model: Model | PILFR | Simulator | None = None) -> FitContent:
    """Read a file that `write_model_file` wrote, as `identify.load` describes.

    Candidates and their solutions have an empty `theta`: a file keeps only their results.
    """
    from .model_schema import read_tables

    if not isinstance(model, Model | PILFR | Simulator | None):
        raise InputError(f"model = {model!r} was given; give the Model, PILFR or Simulator that was fitted.")
    name = path_text(path, "model file")
    text = _read_text(name)
    try:
        content = _check_content(_parse(text))
        if content.pop("sha256", None) is None:
            warnings.warn(
                f"The file {short(name)} carries no digest (it has version {content['version']} of the model format), "
                "so changes made to it after it was written cannot be noticed; save the model again to give it one.",
                stacklevel=3,
            )
        return _build_content(read_tables(content), model)
    except _Unusable as error:
        fault = str(error)
    except ValueError as error:  # includes objects that refuse the file's entries
        fault = f"is damaged: {str(error).rstrip('.')}; save the model again"
        if model is not None:
            fault = f"does not fit the model given: {str(error).rstrip('.')}; give the model it was saved from"
    raise InputError(f"The file {short(name)} {' '.join(fault.split())}.")


def _read_text(path: str) -> str:
    try:
        file = existing_file(path)
        size = file.stat().st_size
        if file.suffix == ".py":
            fault = "is a simulator in Python; read it by `pilfr_casadi.simulators.load_simulator`"
        elif known := SIMULATORS.get(file.suffix.lower()):
            what, loader = known
            fault = (
                f"is {what}, not a saved model; read it by `pilfr_casadi.{loader}`. `pilfr simulate` and `export` take "
                f"a Python file with the line simulator = pilfr_casadi.{loader}(...)"
            )
        elif size > LARGEST_FILE:
            fault = f"has {size / 1e6:.0f} MB, which no model file has; give a file that `save` wrote"
        else:
            return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        fault = "is not a model file (it is not text); give a file that `save` wrote"
    except OSError as error:
        fault = f"cannot be read ({error.strerror or error}); check the path and the permissions"
    raise InputError(f"The file {short(path)} {fault}.")


def _parse(text: str) -> Any:
    """Parse JSON; refuse repeated keys and numbers beyond floating point."""

    def finite(digits: str) -> float:
        if not math.isfinite(number := float(digits)):
            raise InputError(f"it holds {digits[:20]}, which is not a finite number")
        return number

    def table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if len(set(keys)) < len(keys):
            twin = next(key for key in keys if keys.count(key) > 1)
            raise InputError(f"it has the key {twin[:40]!r} twice in one table")
        return dict(pairs)

    try:
        return json.loads(text, parse_constant=finite, parse_float=finite, object_pairs_hook=table)
    except json.JSONDecodeError as error:
        if not text.strip():
            fault = "is empty; it may have been cut off while being copied: copy or save it again"
        elif error.pos >= len(text.rstrip()) - 1 or "Unterminated" in error.msg:
            fault = "is incomplete, its end is missing; copy or save it again"
        else:
            fault = f"is not valid JSON (line {error.lineno}, column {error.colno}); give a file that `save` wrote"
    except InputError:
        raise
    except (ValueError, RecursionError, MemoryError):
        fault = "is not a model file (its JSON cannot be used); give a file that `save` wrote"
    raise _Unusable(fault)


def _check_content(content: Any) -> dict[str, Any]:
    """Check format, version and digest of a model file; return its content."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise _Unusable(f"is not a model file (its format is not {FORMAT!r}); give a file that `save` wrote")
    version = content.get("version")
    if type(version) is not int or version not in (VERSION_WITHOUT_DIGEST, VERSION):
        raise _Unusable(
            f"has version {json.dumps(version)[:20]} of the model format and this release reads versions "
            f"{VERSION_WITHOUT_DIGEST} and {VERSION}; save the model again with this release, or use the release "
            "that wrote it"
        )
    written = content.get("sha256")
    found = ordered_digest({key: value for key, value in content.items() if key != "sha256"})
    if written != found and (version == VERSION or written is not None):
        raise _Unusable(
            "was changed after it was written (its content does not have the SHA-256 that it was written with); "
            "restore it, or save the model again"
        )
    return content


def _build_content(tables: schema.ModelTables, given: Model | PILFR | Simulator | None) -> FitContent:
    training = tables.training
    structure, start = _build_model(tables, given)
    model = _restore_values(tables, start, structure)
    limits = None if training.limits is None else tuple(Limit(**dict(row)) for row in training.limits)
    return FitContent(
        model=model,
        structure=structure,
        dt=tables.model.dt,
        solution=_build_trained_solution(training, limits),
        labels=tuple(training.variables),
        errors={
            name: _array(tables.parameters[name].std, p.value.shape, f"the standard error of {name!r}", np.nan)
            for name, p in model.parameters.items()
            if tables.parameters[name].std is not None
        },
        linear=_build_linear(tables, structure),
        initial={
            recording: _array(state, (model.n_state,), "an initial state")
            for recording, state in tables.initial_states.items()
        },
        units={c.name: c.unit for c in (*tables.model.inputs, *tables.model.outputs) if c.unit},
        train_nrmse=tuple(training.nrmse),
        linear_nrmse=tuple(training.linear_nrmse),
        seconds=training.seconds,
        active=tuple(training.active),
        limits=limits,
        noise=training.noise,
        weights=training.weights,
        candidates=tuple(
            Candidate(s.seed, model, np.zeros(0), s.error, _build_solution(s, s.status), s.note, s.drawn)
            for s in training.starts
        ),
    )


def _build_model(tables: schema.ModelTables, given: Model | PILFR | Simulator | None) -> tuple[PILFR | None, Model]:
    """Build the structure (None for the user's own equations) and the closed model, without the file's values."""
    n_u, n_y = len(tables.model.inputs), len(tables.model.outputs)
    if isinstance(given, Simulator):
        given = _discretise_as_saved(given, tables.model)
    if isinstance(given, Model):
        own = len(given.inputs), len(given.outputs)  # the step may read further signals, such as the time
        if own != (n_u, n_y):
            raise InputError(f"it has {own[0]} inputs and {own[1]} outputs, the file {n_u} and {n_y}")
        return None, given
    structure = given or _build_structure(tables, n_u, n_y)
    return structure, _build_closed_model(structure, tables.model)


def _discretise_as_saved(simulator: Simulator, saved: schema.Signals) -> Model:
    """Discretise a simulator as it was for the fit."""
    if saved.hold is None or not saved.substeps:
        raise _Unusable(
            "does not state how inputs change between samples, because an earlier release wrote it; fit the simulator "
            "again, or give the fit's closed model"
        )
    if (simulator.inputs, simulator.output_names) != saved.names:
        raise _Unusable("has other inputs or outputs than the simulator; give the one that was fitted")
    return discretise(simulator, saved.dt, saved.hold, saved.substeps)


def _build_structure(tables: schema.ModelTables, n_u: int, n_y: int) -> PILFR:
    table = tables.structure
    if table is None:
        raise _Unusable(
            "holds the values of a model of your own equations, not the equations; give the model as `model=`"
        )
    element = None if table.element is None else _make_element(table.element, tables)
    for name, shape in block_shapes(table.nx, n_u, n_y, 0 if element is None else element.channels).items():
        _read_parameter(tables, name, shape)

    def pairs(kind: str, low: float | None, high: float | None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        return {
            name: (_array(pair[0], None, f"{kind} {name!r}", low), _array(pair[1], None, f"{kind} {name!r}", high))
            for name, pair in getattr(table, kind).items()
        }

    fixed = {name: _array(value, None, f"the fixed block {name!r}", np.nan) for name, value in table.fixed.items()}
    return PILFR(table.nx, element, fixed, pairs("bounds", -np.inf, np.inf), pairs("priors", None, None), table.offset)


def _make_element(table: schema.ElementTable, tables: schema.ModelTables, prefix: str = "") -> Element:
    """Build an element after checking its parameters in the file, called `prefix + name`."""

    def check(names: tuple[str, ...], *shape: int) -> None:
        for name in names:
            _read_parameter(tables, prefix + name, shape)

    channels = table.channels
    if not prefix and table.kind == "combined":
        rows = getattr(table, "parts", ())
        if len(rows) > MOST_PARTS:
            raise InputError(f"it combines {len(rows)} elements")
        elements = (_make_element(row.element, tables, f"{row.name}_") for row in rows)
        parts = (Part(row.name, own, row.reads, row.writes) for row, own in zip(rows, elements, strict=True))
        return Combined(tuple(parts), channels)
    if table.kind == "prandtl_ishlinskii":
        if table.operator not in OPERATORS:
            raise _Unusable(f"has the unknown operator {table.operator[:40]!r}; known are {', '.join(OPERATORS)}")
        check(("w", "r"), channels, table.n)
        operator = OPERATORS[table.operator]()
        if table.expressions:
            raise _Unusable(
                "has envelopes that are expressions of your own, which a file cannot hold; give the model as `model=`"
            )
        if table.operator == "generalized_play":
            check(("gamma_l_a", "gamma_l_b", "gamma_l_d"), channels, table.neurons)
            operator = GeneralizedPlay(table.neurons)
        return PrandtlIshlinskii(operator, table.n, channels, table.rounded)
    if table.kind == "static_network":
        check(("gain", "slope", "bias"), channels, table.hidden)
        return StaticNetwork(table.hidden, channels)
    if table.kind == "envelope":
        check(("knee",), channels)
        return Envelope(channels)
    if table.kind == "products":
        check(("reach",), channels)
        check(("gain",), channels, sum(comb(channels + d - 1, d) for d in set(table.degrees) if d <= MOST_PARTS))
        return Products(channels, table.degrees)
    raise _Unusable(f"has the element {table.kind[:40]!r}, which a file cannot hold; give the model as `model=`")


def _restore_values(tables: schema.ModelTables, model: Model, structure: PILFR | None) -> Model:
    """Set the file's values; refuse unknown names, values out of bounds, and values that differ from fixed ones."""
    values = {name: _read_parameter(tables, name, p.value.shape) for name, p in model.parameters.items()}
    unknown = sorted(set(tables.parameters) - set(values))
    if unknown:
        raise _Unusable(f"has the parameter {unknown[0]!r}, which its model lacks; give the model it was saved from")
    states, memory = len(tables.model.states), tables.model.memory
    if (states, memory) != (len(model.states), model.n_s):
        raise _Unusable(
            f"is of a model with {states} states and {memory} of memory and this one has {len(model.states)} and "
            f"{model.n_s}; give the model it was saved from"
        )
    for name, p in model.parameters.items():
        if np.any((values[name] < p.bounds[0]) | (values[name] > p.bounds[1])):
            raise InputError(f"a value of parameter {name!r} lies outside its bounds")
        if structure is not None and name in structure.fixed and np.any((values[name] != p.value)[p.fixed]):
            raise InputError(f"parameter {name!r} differs from the value that the structure fixes")
    return _set_values(model, values)


def _build_linear(tables: schema.ModelTables, structure: PILFR | None) -> Model | None:
    """Build the linear model that the fit started from, if the file has it."""
    if tables.linear is None or structure is None:
        return None
    model = _build_closed_model(structure.linear(), tables.model)
    values = {
        name: _array(tables.linear.get(name), p.value.shape, f"the linear model's {name!r}")
        for name, p in model.parameters.items()
    }
    return _set_values(model, values)


def _build_closed_model(structure: PILFR, signals: schema.Signals) -> Model:
    inputs, outputs = signals.names
    return structure.model(len(inputs), len(outputs), inputs=inputs, outputs=outputs)


def _set_values(model: Model, values: Mapping[str, np.ndarray]) -> Model:
    return model.with_parameters(model.parameters.change(**{name: {"value": v} for name, v in values.items()}))


def _build_trained_solution(training: schema.Training, limits: tuple[Limit, ...] | None) -> Solution:
    """Build the solution with its history and multipliers: one for each variable and constraint, or none."""
    theta, multipliers = (np.array(list(v), float) for v in (training.variables.values(), training.multipliers))
    n = len(theta) + sum(limit.kind == "constraint" for limit in limits or ())
    # the first files did not name the constraints
    if multipliers.size not in (0, n) and not (limits is None and multipliers.size > n):
        raise InputError(f"it has {multipliers.size} multipliers of {n} variables and constraints")
    columns = [getattr(training.history, key) for key in HISTORY]
    history = tuple(Iteration(int(number), *row) for number, *row in zip(*columns, strict=True))
    solution = _build_solution(training.solve, training.status)
    return replace(solution, theta=theta, multipliers=multipliers, history=history, message=training.message)


def _build_solution(solve: schema.Solve, status: str) -> Solution:
    numbers = solve.cost, Status[status], solve.iterations, solve.seconds
    return Solution(np.zeros(0), *numbers, violation=solve.violation)


def _read_parameter(tables: schema.ModelTables, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Read the value of a parameter; refuse another shape."""
    if name not in tables.parameters:
        raise InputError(f"{name!r} is missing")
    return _array(tables.parameters[name].value, shape, f"parameter {name!r}")


def _array(value: Any, shape: tuple[int, ...] | None, name: str, missing: float | None = None) -> np.ndarray:
    """Convert nested lists of finite numbers to an array; None allows any shape.

    If `missing` is given, it replaces null, and "inf" is read as infinity.
    """
    from .model_schema import number_or, show_value

    flat: list[float] = []

    def nested_shape(part: Any, depth: int = 0) -> tuple[int, ...]:
        """Collect the numbers; return the shape of the nested lists, -1 where their lengths differ."""
        if isinstance(part, list) and depth < DEEPEST:
            inner = {nested_shape(item, depth + 1) for item in part}
            return (len(part), *(inner.pop() if len(inner) == 1 else (-1,) if inner else ()))
        number = part if missing is None else number_or(missing, part)
        if number is part and not (is_number(part) and abs(part) <= sys.float_info.max):
            raise InputError(f"{name} holds {show_value(part)}, which is not a finite number")
        flat.append(float(number))
        return ()

    found = nested_shape(value)
    if shape is not None and len(flat) == math.prod(shape) == 0:
        return np.zeros(shape)
    if found != (found if shape is None else shape) or math.prod(found) != len(flat):
        expected = "" if shape is None else f", expected {shape}"
        raise InputError(f"{name} has {len(flat)} numbers in the shape {found}{expected}")
    return np.array(flat, dtype=float).reshape(found)
