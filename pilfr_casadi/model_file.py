"""Reading a model file: JSON in, a `Fit` or one plain sentence out.

Nothing in the file is trusted. Sizes are compared with the numbers that are really there before anything is built, so a few
bytes cannot ask for a model of a billion operators; every value is checked for its shape, for being finite, and against the
bounds and fixed values of the structure (`w >= 0`, `r >= 0` of Krikelis et al. 2024, Eq. 16, unless the structure says otherwise).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from .elements import PrandtlIshlinskii
from .export import FORMAT, VERSION
from .lfr import PILFR, block_shapes
from .model import Model
from .operators import GeneralizedPlay, Play, Stop
from .recording import InputError
from .solution import Iteration, Solution, Status

if TYPE_CHECKING:
    from .fit import Fit

LARGEST = 200_000_000  # bytes; a model with 500 states takes 20 million
OPERATORS = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}


class ModelFile:
    """The tables of a model file, and the checks that turn every surprise into one sentence."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path
        content = self._parse()
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            self.fail(f"is not a model file (its format is not {FORMAT!r}); give a file that `save` wrote")
        if content.get("version") != VERSION:
            self.fail(
                f"has version {str(content.get('version'))[:20]} of the model format and this release reads version {VERSION}; "
                "save the model again with this release, or use the release that wrote it"
            )
        self.content: dict[str, Any] = content

    def fail(self, what: str) -> NoReturn:
        """Raise the one sentence."""
        raise InputError(f"The file {self.path} {what}.")

    def damaged(self, what: str) -> NoReturn:
        """Raise the sentence for content that `save` never writes."""
        self.fail(f"is damaged: {what}; save the model again")

    def _parse(self) -> Any:
        try:
            size = os.stat(self.path).st_size
            if size > LARGEST:
                self.fail(f"has {size / 1e6:.0f} MB, which no model file has; give a file that `save` wrote")
            text = Path(self.path).read_text(encoding="utf-8")
        except FileNotFoundError:
            self.fail("does not exist; check the path")
        except IsADirectoryError:
            self.fail("is a folder; give the model file in it")
        except UnicodeDecodeError:
            self.fail("is not a model file (it is not text); give a file that `save` wrote")
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            self.fail(
                f"cannot be read ({getattr(error, 'strerror', None) or error}); check the path and the permissions"
            )
        try:
            return json.loads(text, parse_constant=self._no_constant)
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

    def _no_constant(self, name: str) -> NoReturn:
        self.damaged(f"it holds {name}, which is not a number")

    def table(self, parent: Any, key: str) -> dict[str, Any]:
        """A table inside a table."""
        return self.entry(parent, key, dict, "a table")

    def rows(self, parent: Any, key: str) -> list[Any]:
        """A list inside a table."""
        return self.entry(parent, key, list, "a list")

    def text(self, parent: Any, key: str) -> str:
        """A text inside a table."""
        return self.entry(parent, key, str, "a text")

    def entry(self, parent: Any, key: str, kind: type, called: str) -> Any:
        """An entry of a table, of one kind."""
        if not isinstance(parent, dict) or key not in parent:
            self.damaged(f"{key!r} is missing")
        if not isinstance(parent[key], kind) or (kind is int and isinstance(parent[key], bool)):
            self.damaged(f"{key!r} is not {called}")
        return parent[key]

    def count(self, parent: Any, key: str) -> int:
        """A whole number, zero or more."""
        value = self.entry(parent, key, int, "a whole number")
        if value < 0:
            self.damaged(f"{key!r} is negative")
        return int(value)

    def number(self, parent: Any, key: str, missing: float | None = None) -> float:
        """A finite number; where it is null, `missing`."""
        if not isinstance(parent, dict) or key not in parent:
            self.damaged(f"{key!r} is missing")
        return float(self.array(parent[key], (), key, missing))

    def array(self, value: Any, shape: tuple[int, ...] | None, where: str, missing: float | None = None) -> np.ndarray:
        """Nested lists of finite numbers as an array of a shape (any where None); null becomes `missing` and "inf" infinite, if that is given."""
        numbers = list(self._numbers(value, where, missing))
        if shape is not None and len(numbers) == math.prod(shape) == 0:
            return np.zeros(shape)
        found = _shape(value)
        if (shape is not None and found != shape) or math.prod(found) != len(numbers):
            expected = "" if shape is None else f", expected {shape}"
            self.damaged(f"{where} has {len(numbers)} numbers in the shape {found}{expected}")
        return np.array(numbers, dtype=float).reshape(found)

    def _numbers(self, value: Any, where: str, missing: float | None, depth: int = 0) -> Any:
        if isinstance(value, list) and depth < 3:
            for item in value:
                yield from self._numbers(item, where, missing, depth + 1)
        elif value is None and missing is not None:
            yield missing
        elif value == "inf" and missing is not None:
            yield math.inf
        elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1.7e308:
            self.damaged(f"{where} holds {json.dumps(value)[:20]}, which is not a finite number")
        else:
            yield float(value)


def _shape(value: Any) -> tuple[int, ...]:
    return (len(value), *(_shape(value[0]) if value else ())) if isinstance(value, list) else ()


def read_fit(path: str | os.PathLike[str], given: Model | PILFR | None = None) -> Fit:
    """Read a fit; see `export.load`."""
    from .fit import Fit
    from .multistart import Candidate

    file = ModelFile(path)
    signals, training = file.table(file.content, "model"), file.table(file.content, "training")
    names = {key: _names(file, signals, key) for key in ("inputs", "outputs")}
    units = {c["name"]: c["unit"] for key in names for c in signals[key] if c["unit"]}
    dt = file.number(signals, "dt")
    if dt <= 0:
        file.damaged(f"the step dt is {dt:g} s")
    structure, model = _model(file, names, given)
    values = {
        name: file.array(
            file.table(file.table(file.content, "parameters"), name).get("value"), p.value.shape, f"parameter {name!r}"
        )
        for name, p in model.parameters.items()
    }
    model = _with_values(file, model, values, structure)
    errors = _errors(file, model)
    n_state = model.n_x + model.n_s
    initial = {
        recording: file.array(state, (n_state,), "an initial state")
        for recording, state in file.table(file.content, "initial_states").items()
    }
    variables = file.table(training, "variables")
    theta = file.array(list(variables.values()), (len(variables),), "a variable")
    history = tuple(
        Iteration(int(h[0]), *(float(v) for v in h[1:]))
        for h in (file.array(row, (5,), "the history", np.inf) for row in file.rows(training, "history"))
    )
    multipliers = file.array(file.rows(training, "multipliers"), None, "a multiplier", np.nan)
    solution = _solution(file, training, file.table(training, "solve"), theta, multipliers=multipliers, history=history)
    candidates = tuple(
        Candidate(
            file.count(c, "seed"),
            model,
            np.zeros(0),
            file.number(c, "error", np.inf),
            _solution(file, c, c, np.zeros(0)),
            file.text(c, "note"),
        )
        for c in file.rows(training, "starts")
    )
    return Fit(
        model=model,
        structure=structure,
        dt=dt,
        solution=solution,
        train_nrmse=tuple(
            file.array(file.rows(training, "nrmse"), None, "the training error", np.inf).ravel().tolist()
        ),
        initial=initial,
        labels=tuple(variables),
        errors=errors,
        active=tuple(str(a) for a in file.rows(training, "active")),
        candidates=candidates,
        linear=_linear(file, structure, names),
        seconds=file.number(training, "seconds"),
        units=units,
    )


def _names(file: ModelFile, signals: Mapping[str, Any], key: str) -> tuple[str, ...]:
    rows = file.rows(signals, key)
    names = tuple(file.text(row, "name") for row in rows)
    for row in rows:
        file.text(row, "unit")
    if not names or len(set(names)) < len(names):
        file.damaged(f"the names of the {key} are missing or not distinct")
    return names


def _model(
    file: ModelFile, names: Mapping[str, tuple[str, ...]], given: Model | PILFR | None
) -> tuple[PILFR | None, Model]:
    """The structure (None for a model of the user's own) and the closed model, not yet with the file's values."""
    n_u, n_y = len(names["inputs"]), len(names["outputs"])
    if isinstance(given, Model):
        if (given.n_u, given.n_y) != (n_u, n_y):
            file.fail(
                f"is of a model with {n_u} inputs and {n_y} outputs and the one given has {given.n_u} and {given.n_y}; give the model it was saved from"
            )
        return None, given
    if given is None and file.content.get("structure") is None:
        file.fail("holds the values of a model of your own equations, not the equations; give the model as `model=`")
    structure = given or _structure(file, n_u, n_y)
    try:
        return structure, structure.model(n_u, n_y, inputs=names["inputs"], outputs=names["outputs"])
    except ValueError as error:
        file.damaged(f"its structure cannot be built ({str(error).rstrip('.')})")


def _structure(file: ModelFile, n_u: int, n_y: int) -> PILFR:
    table = file.table(file.content, "structure")
    nx, parameters = file.count(table, "nx"), file.table(file.content, "parameters")
    element = None if table.get("element") is None else _element(file, file.table(table, "element"), parameters)
    for name, shape in block_shapes(nx, n_u, n_y, 0 if element is None else element.channels).items():
        file.array(file.table(parameters, name).get("value"), shape, f"parameter {name!r}")
    fixed = {
        name: file.array(value, None, f"the fixed block {name!r}") for name, value in file.table(table, "fixed").items()
    }
    pairs: dict[str, dict[str, tuple[Any, Any]]] = {}
    for key, ends in (("bounds", (-np.inf, np.inf)), ("priors", (None, None))):
        pairs[key] = {}
        for name, pair in file.table(table, key).items():
            if not isinstance(pair, list) or len(pair) != 2:
                file.damaged(f"the {key} of {name!r} are not a pair")
            low, high = (file.array(v, None, f"the {key} of {name!r}", end) for v, end in zip(pair, ends, strict=True))
            pairs[key][name] = (low, high)
    try:
        return PILFR(
            nx, element, fixed, pairs["bounds"], pairs["priors"], file.entry(table, "offset", bool, "true or false")
        )
    except InputError as error:
        file.damaged(str(error).rstrip("."))


def _element(file: ModelFile, table: dict[str, Any], parameters: dict[str, Any]) -> PrandtlIshlinskii:
    if table.get("kind") != "prandtl_ishlinskii":
        file.fail(
            f"has the element {str(table.get('kind'))[:40]!r}, which a file cannot hold; give the model as `model=`"
        )
    name = file.text(table, "operator")
    if name not in OPERATORS:
        file.fail(f"has the unknown operator {name[:40]!r}; known are {', '.join(OPERATORS)}")
    n, channels = file.count(table, "n"), file.count(table, "channels")
    for key in ("w", "r"):
        file.array(file.table(parameters, key).get("value"), (channels, n), f"parameter {key!r}")
    operator: Any = OPERATORS[name]()
    if name == "generalized_play":
        if file.rows(table, "expressions"):
            file.fail(
                "has envelopes that are expressions of your own, which a file cannot hold; give the model as `model=`"
            )
        neurons = file.count(table, "neurons")
        for key in ("a", "b", "d"):
            file.array(
                file.table(parameters, f"gamma_l_{key}").get("value"), (channels, neurons), f"parameter 'gamma_l_{key}'"
            )
        operator = GeneralizedPlay(neurons)
    try:
        return PrandtlIshlinskii(operator, n, channels, file.entry(table, "rounded", bool, "true or false"))
    except InputError as error:
        file.damaged(str(error).rstrip("."))


def _with_values(file: ModelFile, model: Model, values: dict[str, np.ndarray], structure: PILFR | None) -> Model:
    """The model at the values of the file, which must be all there, inside their bounds, and equal to what is fixed."""
    unknown = sorted(set(file.table(file.content, "parameters")) - set(values))
    if unknown:
        file.fail(f"has the parameter {unknown[0]!r}, which its model lacks; give the model it was saved from")
    states, memory = (
        len(file.rows(file.table(file.content, "model"), "states")),
        file.count(file.content["model"], "memory"),
    )
    if (states, memory) != (model.n_x, model.n_s):
        file.fail(
            f"is of a model with {states} states and {memory} of memory, this one has {model.n_x} and {model.n_s}; give the model it was saved from"
        )
    for name, p in model.parameters.items():
        if np.any((values[name] < p.bounds[0]) | (values[name] > p.bounds[1])):
            file.damaged(f"a value of parameter {name!r} lies outside its bounds")
        if structure is not None and name in structure.fixed and np.any(values[name] != p.value):
            file.damaged(f"parameter {name!r} differs from the value that the structure fixes")
    return model.with_parameters(model.parameters.change(**{name: {"value": value} for name, value in values.items()}))


def _errors(file: ModelFile, model: Model) -> dict[str, np.ndarray]:
    """Standard errors by name; none where the fit had none."""
    table = file.table(file.content, "parameters")
    return {
        name: file.array(table[name].get("std"), p.value.shape, f"the standard error of {name!r}", np.nan)
        for name, p in model.parameters.items()
        if table[name].get("std") is not None
    }


def _linear(file: ModelFile, structure: PILFR | None, names: Mapping[str, tuple[str, ...]]) -> Model | None:
    """The linear model that the fit began with, where it is in the file."""
    if file.content.get("linear") is None or structure is None:
        return None
    table, n_u, n_y = file.table(file.content, "linear"), len(names["inputs"]), len(names["outputs"])
    model = structure.linear().model(n_u, n_y, **names)
    values = {
        name: file.array(table.get(name), p.value.shape, f"the linear model's {name!r}")
        for name, p in model.parameters.items()
    }
    return model.with_parameters(model.parameters.change(**{name: {"value": value} for name, value in values.items()}))


def _solution(file: ModelFile, table: Any, numbers: Any, theta: np.ndarray, **more: Any) -> Solution:
    status = file.text(table, "status")
    if status not in Status.__members__:
        file.damaged(f"the status {status[:40]!r} is unknown")
    message = file.text(table, "message") if "message" in table else ""
    cost, violation = (file.number(numbers, key, np.inf) for key in ("cost", "violation"))
    return Solution(
        theta,
        cost,
        Status[status],
        file.count(numbers, "iterations"),
        file.number(numbers, "seconds"),
        violation,
        message=message,
        **more,
    )
