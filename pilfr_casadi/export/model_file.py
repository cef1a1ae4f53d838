"""Models on disk: a fit's values as JSON, out and in.

A model file is standard JSON: format and version, structure, parameter values by name with units and standard errors,
sampling, names, and a summary of the training, under the SHA-256 of all of it, so that a number changed afterwards does
not go unnoticed. It holds no code, and every number comes back to the last digit. Only the equations of a PI-LFR
(Krikelis et al. 2024, Eq. 15-17) can be rebuilt from a file; of a model of the user's own equations it has the values.

Nothing in a file is trusted and nothing in it is executed. Sizes are compared with the numbers that are really there
before anything is built, so a few bytes cannot ask for a model of a billion operators. Every value is checked for its
shape, for being finite, and against the bounds and fixed values of the structure (by default `w >= 0` and `r >= 0` as
in Eq. 16).
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import comb
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import casadi as ca
import numpy as np

from .._base import InputError, __version__, ordered_digest, path_text, short, write_atomically
from ..models import (
    PILFR,
    Combined,
    Element,
    Envelope,
    GeneralizedPlay,
    Model,
    Part,
    Play,
    PrandtlIshlinskii,
    Products,
    StaticNetwork,
    Stop,
    block_shapes,
)
from ..optimise import Iteration, Limit, Solution, Status

if TYPE_CHECKING:
    from . import model_schema as schema

FORMAT = "pilfr_casadi model"
VERSION = 2
VERSION_WITHOUT_DIGEST = 1  # still read, with a warning
LARGEST_FILE = 200_000_000  # bytes; a model with 500 states takes 20 million
MOST_PARTS = 100  # combined elements and degrees of products; more would only exhaust the memory
HISTORY = ("number", "cost", "seconds", "step", "damping")  # columns of a solver's history
OPERATORS: dict[str, Any] = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}
Built = TypeVar("Built")


@dataclass(frozen=True, eq=False)
class SavedStart:
    """A start of a multistart search: its seed, the error it reached, how its solve ended, and whether it was drawn."""

    seed: int
    error: float
    solution: Solution
    note: str = ""
    drawn: bool = True


@dataclass(frozen=True, eq=False)
class FitContent:
    """A fit as values, which is all that a model file holds of it.

    Fields have the names and meanings of those of `Fit`; `structure` is None for a model of the user's own equations,
    `initial` and `weights` go by the recordings' fingerprints, `noise` is the one that priors are weighed against, and
    `limits` is None in files from before these were kept.
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
    starts: tuple[SavedStart, ...] = ()


def write_model_file(path: str | os.PathLike[str], content: FitContent) -> None:
    """Write a fit as JSON, atomically: an existing file stays as it is until the new one is complete on disk.

    Parameters
    ----------
    path : path
        The file, usually `*.json`.
    content : FitContent
        The values to save. Of a model of the user's own equations only the values are kept; see `read_model_file`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_atomically(path, model_text(content))


def model_text(content: FitContent) -> str:
    """Return the text of a model file."""
    tables = _tables_of_fit(content)
    return _layout({**tables, "sha256": ordered_digest(tables)}) + "\n"


def _tables_of_fit(fit: FitContent) -> dict[str, Any]:
    model, solution = fit.model, fit.solution
    limited = len(solution.theta) + sum(limit.kind == "constraint" for limit in fit.limits or ())
    return {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {"pilfr_casadi": __version__, "casadi": ca.__version__},
        "model": {
            "dt": fit.dt,
            "inputs": _channel_tables(model.inputs, fit.units),
            "outputs": _channel_tables(model.outputs, fit.units),
            "states": list(model.states),
            "memory": model.n_s,
        },
        "structure": None if fit.structure is None else _structure_table(fit.structure),
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
            "active": list(fit.active),
            "limits": [_limit_table(limit) for limit in fit.limits or ()],
            "solve": _solve_table(solution),
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
                }
                | _solve_table(c.solution)
                for c in fit.starts
            ],
        },
    }


def _limit_table(limit: Any) -> dict[str, Any]:
    """Constraint or active bound."""
    numbers = {key: _to_json(getattr(limit, key), "inf") for key in ("value", "lower", "upper", "multiplier")}
    return {"name": limit.name, "kind": limit.kind, **numbers, "active": limit.active, "met": limit.met}


def _solve_table(solution: Any) -> dict[str, Any]:
    numbers = {"cost": solution.cost, "violation": solution.violation, "seconds": solution.seconds}
    return {"iterations": int(solution.iterations), **{k: _to_json(v) for k, v in numbers.items()}}


def _channel_tables(names: tuple[str, ...], units: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "unit": units.get(name, "")} for name in names]


def _structure_table(structure: PILFR) -> dict[str, Any]:
    pairs = {"bounds": structure.bounds, "priors": structure.priors}
    return {
        "nx": int(structure.nx),
        "offset": bool(structure.offset),
        "element": None if structure.element is None else _element_table(structure.element),
        "fixed": {name: _to_json(value) for name, value in structure.fixed.items()},
        **{key: {name: [_to_json(v) for v in pair] for name, pair in table.items()} for key, table in pairs.items()},
    }


def _element_table(element: Any) -> dict[str, Any]:
    if isinstance(element, Combined):
        parts = [
            {"name": p.name, "element": _element_table(p.element), "reads": list(p.reads), "writes": list(p.writes)}
            for p in element.parts
        ]
        return {"kind": element.kind, "channels": element.channels, "parts": parts}
    if isinstance(element, Envelope):
        return {"kind": element.kind, "channels": element.channels}
    if isinstance(element, Products):
        return {"kind": element.kind, "channels": element.channels, "degrees": list(element.degrees)}
    if isinstance(element, StaticNetwork):
        return {"kind": element.kind, "hidden": element.hidden, "channels": element.channels}
    if not isinstance(element, PrandtlIshlinskii):
        return {"kind": type(element).__name__}
    operator = element.operator
    out = {"kind": element.kind, "operator": operator.name, "n": element.n, "channels": element.channels}
    out["rounded"] = element.rounded
    if isinstance(operator, GeneralizedPlay):
        own = [side for side in ("l", "r") if getattr(operator, f"gamma_{side}") is not None]
        out |= {"neurons": operator.neurons, "expressions": own}
    return out


def _to_json(value: Any, infinite: str | None = None) -> Any:
    """Convert numbers to JSON: arrays to nested lists, nan to null, infinity to null or to the word `infinite`."""
    if value is None:
        return None
    array = np.asarray(value, dtype=float)
    if array.ndim:
        return [_to_json(v, infinite) for v in array]
    number = float(array)
    return number if np.isfinite(number) else infinite if number > 0 else None


def _layout(value: Any, depth: int = 0) -> str:
    """Lay out JSON with one line for each entry of the outer tables, so that people can read and compare files."""
    if isinstance(value, dict) and value and depth < 2:
        pad = " " * (depth + 1)
        rows = [f"{pad}{json.dumps(key)}: {_layout(item, depth + 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(rows) + "\n" + " " * depth + "}"
    return json.dumps(value, allow_nan=False)


def read_model_file(path: str | os.PathLike[str], model: Model | PILFR | None = None) -> FitContent:
    """Read a file that `write_model_file` wrote; simulations are the same to the last digit.

    Parameters
    ----------
    path : path
        The file.
    model : Model or PILFR, optional
        The equations, where the file cannot hold them: a closed model of your own, or a PI-LFR whose element has
        envelope expressions of your own. Its values are replaced by those of the file.

    Returns
    -------
    FitContent
        Solutions of the starts have an empty `theta`: a file keeps only what they reached.

    Raises
    ------
    InputError
        If the file is missing, unreadable, damaged, of another kind or version, was changed after it was written, does
        not fit `model`, or holds values that are missing, not finite, or outside their bounds.

    Warns
    -----
    UserWarning
        If the file is of the first version of the format, which has no digest to tell changes by.
    """
    return _Reader(path, model).fit_content()


class _Reader:
    """A model file being read; every surprise in it becomes one sentence about the file."""

    def __init__(self, path: str | os.PathLike[str], given: Model | PILFR | None) -> None:
        from . import model_schema as schema

        self.path, self.given = path_text(path, "model file"), given
        self.tables = schema.read_tables(self._content(), self.damaged)
        self.inputs = tuple(channel.name for channel in self.tables.model.inputs)
        self.outputs = tuple(channel.name for channel in self.tables.model.outputs)

    def fail(self, fault: str) -> NoReturn:
        """Raise the sentence for a file that cannot be used."""
        raise InputError(f"The file {short(self.path)} {' '.join(fault.split())}.")

    def damaged(self, fault: str) -> NoReturn:
        """Raise the sentence for content that is never written, or was written for another model than the one given."""
        if self.given is not None:
            self.fail(f"does not fit the model given: {fault}; give the model it was saved from")
        self.fail(f"is damaged: {fault}; save the model again")

    def build(self, make: Callable[..., Built], *parts: Any) -> Built:
        """Make an object of parts of the file; where they do not go together, the file is damaged."""
        try:
            return make(*parts)
        except InputError as error:
            self.damaged(str(error).rstrip("."))

    def array(self, value: Any, shape: tuple[int, ...] | None, name: str, missing: float | None = None) -> np.ndarray:
        """Read nested lists as an array of a shape."""
        from . import model_schema as schema

        return schema.array(value, shape, name, self.damaged, missing)

    def parameter(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Read the value of a parameter, which must have this shape."""
        if name not in self.tables.parameters:
            self.damaged(f"{name!r} is missing")
        return self.array(self.tables.parameters[name].value, shape, f"parameter {name!r}")

    def _content(self) -> dict[str, Any]:
        """Tables of the file, less the digest, which must be theirs."""
        content = self._parse(self._text())
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            self.fail(f"is not a model file (its format is not {FORMAT!r}); give a file that `save` wrote")
        version = content.get("version")
        if type(version) is not int or version not in (VERSION_WITHOUT_DIGEST, VERSION):
            self.fail(
                f"has version {json.dumps(version)[:20]} of the model format and this release reads versions "
                f"{VERSION_WITHOUT_DIGEST} and {VERSION}; save the model again with this release, or use the release "
                "that wrote it"
            )
        written = content.pop("sha256", None)
        if written != ordered_digest(content) and (version == VERSION or written is not None):
            self.fail(
                "was changed after it was written (its content does not have the SHA-256 that it was written with); "
                "restore it, or save the model again"
            )
        if written is None:
            warnings.warn(
                f"The file {short(self.path)} carries no digest (it has version {version} of the model format), so "
                "changes made to it after it was written cannot be noticed; save the model again to give it one.",
                stacklevel=5,
            )
        return content

    def _text(self) -> str:
        try:
            size = os.stat(self.path).st_size
            if size > LARGEST_FILE:
                self.fail(f"has {size / 1e6:.0f} MB, which no model file has; give a file that `save` wrote")
            return Path(self.path).read_text(encoding="utf-8-sig")
        except FileNotFoundError:
            self.fail("does not exist; check the path")
        except IsADirectoryError:
            self.fail("is a folder; give the model file in it")
        except UnicodeDecodeError:
            self.fail("is not a model file (it is not text); give a file that `save` wrote")
        except InputError:
            raise
        except (OSError, ValueError) as error:
            self.fail(
                f"cannot be read ({getattr(error, 'strerror', None) or error}); check the path and the permissions"
            )

    def _parse(self, text: str) -> Any:
        def refuse_constant(name: str) -> NoReturn:
            self.damaged(f"it holds {name}, which is not a number")

        def parse_float(digits: str) -> float:
            number = float(digits)
            if not math.isfinite(number):
                self.damaged(f"it holds {digits[:20]}, which is not a finite number")
            return number

        def refuse_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
            keys = [key for key, _ in pairs]
            if len(set(keys)) < len(keys):
                twin = next(key for key in keys if keys.count(key) > 1)
                self.damaged(f"it has the key {twin[:40]!r} twice in one table")
            return dict(pairs)

        try:
            return json.loads(
                text, parse_constant=refuse_constant, parse_float=parse_float, object_pairs_hook=refuse_twins
            )
        except json.JSONDecodeError as error:
            if not text.strip():
                self.fail("is empty; it may have been cut off while being copied: copy or save it again")
            if error.pos >= len(text.rstrip()) - 1 or "Unterminated" in error.msg:
                self.fail("is incomplete, its end is missing; copy or save it again")
            self.fail(f"is not valid JSON (line {error.lineno}, column {error.colno}); give a file that `save` wrote")
        except InputError:
            raise
        except (ValueError, RecursionError, MemoryError):
            self.fail("is not a model file (its JSON cannot be used); give a file that `save` wrote")

    def fit_content(self) -> FitContent:
        """Build the model and read everything about its training."""
        tables, training = self.tables, self.tables.training
        names = (*self.inputs, *self.outputs)
        if not (self.inputs and self.outputs and all(names)) or len(set(names)) < len(names):
            self.damaged("the names of inputs and outputs are missing or not distinct")
        if tables.model.dt <= 0:
            self.damaged(f"the step dt is {tables.model.dt:g} s")
        structure, start = self._equations()
        model = self._with_values(start, structure)
        limits = None if training.limits is None else tuple(Limit(**dict(row)) for row in training.limits)
        theta = np.array(list(training.variables.values()), dtype=float)
        solution = replace(
            self._solution(training.solve, training.status, theta),
            multipliers=self._multipliers(limits, len(theta)),
            history=self._history(),
            message=training.message,
        )
        if any(v <= 0 for v in (training.noise, *(training.weights or {}).values()) if v is not None):
            self.damaged("the noise or a weight of a recording is not above zero")
        return FitContent(
            model=model,
            structure=structure,
            dt=tables.model.dt,
            solution=solution,
            labels=tuple(training.variables),
            errors={
                name: self.array(tables.parameters[name].std, p.value.shape, f"the standard error of {name!r}", np.nan)
                for name, p in model.parameters.items()
                if tables.parameters[name].std is not None
            },
            linear=self._linear(structure),
            initial={
                recording: self.array(state, (model.n_x + model.n_s,), "an initial state")
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
            starts=tuple(
                SavedStart(s.seed, s.error, self._solution(s, s.status, np.zeros(0)), s.note, s.drawn)
                for s in training.starts
            ),
        )

    def _equations(self) -> tuple[PILFR | None, Model]:
        """Structure (None for a model of the user's own) and closed model, not yet with the file's values."""
        n_u, n_y = len(self.inputs), len(self.outputs)
        if isinstance(self.given, Model):
            if (self.given.n_u, self.given.n_y) != (n_u, n_y):
                self.damaged(f"it has {self.given.n_u} inputs and {self.given.n_y} outputs, the file {n_u} and {n_y}")
            return None, self.given
        structure = self.given or self._structure(n_u, n_y)
        try:
            return structure, structure.model(n_u, n_y, inputs=self.inputs, outputs=self.outputs)
        except ValueError as error:
            self.damaged(f"its structure cannot be built ({str(error).rstrip('.')})")

    def _structure(self, n_u: int, n_y: int) -> PILFR:
        table = self.tables.structure
        if table is None:
            self.fail(
                "holds the values of a model of your own equations, not the equations; give the model as `model=`"
            )
        element = None if table.element is None else self._outer_element(table.element)
        for name, shape in block_shapes(table.nx, n_u, n_y, 0 if element is None else element.channels).items():
            self.parameter(name, shape)

        def pairs(kind: str, low: float | None, high: float | None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
            title = f"the {kind} of"
            return {
                name: (self.array(pair[0], None, f"{title} {name!r}", low), self.array(pair[1], None, title, high))
                for name, pair in getattr(table, kind).items()
            }

        fixed = {n: self.array(value, None, f"the fixed block {n!r}", np.nan) for n, value in table.fixed.items()}
        bounds, priors = pairs("bounds", -np.inf, np.inf), pairs("priors", None, None)
        return self.build(PILFR, table.nx, element, fixed, bounds, priors, table.offset)

    def _outer_element(self, table: schema.OuterElementTable) -> Element:
        """Build the element of the structure, which may combine others."""
        if table.kind != "combined":
            return self._element(table, "")
        if len(table.parts) > MOST_PARTS:
            self.damaged(f"it combines {len(table.parts)} elements")
        parts = []
        for row in table.parts:
            element = self._element(row.element, f"{row.name}_")
            parts.append(self.build(Part, row.name, element, tuple(row.reads), tuple(row.writes)))
        return self.build(Combined, tuple(parts), table.channels)

    def _element(self, table: schema.ElementTable, prefix: str) -> Element:
        """Build the element that a table describes; its parameters in the file are called `prefix + name`."""
        channels, hidden, degrees = table.channels, table.hidden, tuple(table.degrees)
        terms = sum(comb(channels + d - 1, d) for d in set(degrees) if d <= MOST_PARTS)
        known: dict[str, tuple[dict[str, tuple[int, ...]], Callable[..., Element], tuple[Any, ...]]] = {
            "static_network": (
                dict.fromkeys(("gain", "slope", "bias"), (channels, hidden)),
                StaticNetwork,
                (hidden, channels),
            ),
            "envelope": ({"knee": (channels,)}, Envelope, (channels,)),
            "products": ({"reach": (channels,), "gain": (channels, terms)}, Products, (channels, degrees)),
        }
        if table.kind == "prandtl_ishlinskii":
            return self._layer(table, prefix)
        if table.kind not in known:
            self.fail(f"has the element {table.kind[:40]!r}, which a file cannot hold; give the model as `model=`")
        shapes, make, arguments = known[table.kind]
        for name, shape in shapes.items():
            self.parameter(prefix + name, shape)
        return self.build(make, *arguments)

    def _layer(self, table: schema.ElementTable, prefix: str) -> Element:
        if table.operator not in OPERATORS:
            self.fail(f"has the unknown operator {table.operator[:40]!r}; known are {', '.join(OPERATORS)}")
        for name in ("w", "r"):
            self.parameter(prefix + name, (table.channels, table.n))
        operator = OPERATORS[table.operator]()
        if table.operator == "generalized_play":
            if table.expressions:
                self.fail(
                    "has envelopes that are expressions of your own, which a file cannot hold; give the model as "
                    "`model=`"
                )
            for name in ("a", "b", "d"):
                self.parameter(f"{prefix}gamma_l_{name}", (table.channels, table.neurons))
            operator = self.build(GeneralizedPlay, table.neurons)
        return self.build(PrandtlIshlinskii, operator, table.n, table.channels, table.rounded)

    def _with_values(self, model: Model, structure: PILFR | None) -> Model:
        """Put the file's values into the model: all of them, inside their bounds, and equal to what is fixed."""
        values = {name: self.parameter(name, p.value.shape) for name, p in model.parameters.items()}
        unknown = sorted(set(self.tables.parameters) - set(values))
        if unknown:
            self.fail(f"has the parameter {unknown[0]!r}, which its model lacks; give the model it was saved from")
        states, memory = len(self.tables.model.states), self.tables.model.memory
        if (states, memory) != (model.n_x, model.n_s):
            self.fail(
                f"is of a model with {states} states and {memory} of memory and this one has {model.n_x} and "
                f"{model.n_s}; give the model it was saved from"
            )
        for name, p in model.parameters.items():
            if np.any((values[name] < p.bounds[0]) | (values[name] > p.bounds[1])):
                self.damaged(f"a value of parameter {name!r} lies outside its bounds")
            if structure is not None and name in structure.fixed and np.any((values[name] != p.value)[p.fixed]):
                self.damaged(f"parameter {name!r} differs from the value that the structure fixes")
        return _at_values(model, values)

    def _linear(self, structure: PILFR | None) -> Model | None:
        """Linear model that the fit began with, where the file has it."""
        table = self.tables.linear
        if table is None or structure is None:
            return None
        n_u, n_y = len(self.inputs), len(self.outputs)
        model = structure.linear().model(n_u, n_y, inputs=self.inputs, outputs=self.outputs)
        values = {
            name: self.array(table.get(name), p.value.shape, f"the linear model's {name!r}")
            for name, p in model.parameters.items()
        }
        return _at_values(model, values)

    def _solution(self, solve: schema.Solve, status: str, theta: np.ndarray) -> Solution:
        if status not in Status.__members__:
            self.damaged(f"the status {status[:40]!r} is unknown")
        return Solution(theta, solve.cost, Status[status], solve.iterations, solve.seconds, violation=solve.violation)

    def _multipliers(self, limits: tuple[Limit, ...] | None, n_theta: int) -> np.ndarray:
        """One for each variable and each constraint, or none; the first files did not name the constraints."""
        found = np.array(self.tables.training.multipliers, dtype=float)
        n = n_theta + sum(limit.kind == "constraint" for limit in limits or ())
        if found.size not in (0, n) and not (limits is None and found.size > n):
            self.damaged(f"it has {found.size} multipliers of {n} variables and constraints")
        return found

    def _history(self) -> tuple[Iteration, ...]:
        columns = [getattr(self.tables.training.history, key) for key in HISTORY]
        if len({len(column) for column in columns}) > 1:
            self.damaged("the columns of the history differ in length")
        return tuple(Iteration(int(number), *row) for number, *row in zip(*columns, strict=True))


def _at_values(model: Model, values: Mapping[str, np.ndarray]) -> Model:
    return model.with_parameters(model.parameters.change(**{name: {"value": v} for name, v in values.items()}))
