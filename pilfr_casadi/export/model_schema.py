"""The schema of a model file: which tables, keys and kinds of entries it has, each violation told in one sentence.

Only this file imports pydantic, and `read_model_file` imports this file only when a model is read.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NoReturn

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

Refuse = Callable[[str], NoReturn]  # raises an InputError that says what is wrong
SHOWN = 40  # letters of a key or a value in a message
DEEPEST = 3  # nested lists of an array: no parameter has more dimensions than two
KINDS = {
    "string_type": "a text",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "float_type": "a finite number",
    "finite_number": "a finite number",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "too_short": "a pair",
    "too_long": "a pair",
}


class Table(BaseModel):
    """A table with these keys and no others; numbers stay numbers and texts stay texts."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _or_missing(missing: float, value: Any) -> Any:
    """Read null as a number and "inf" as infinity: JSON has neither nan nor infinity."""
    return missing if value is None else math.inf if value == "inf" else value


Count = Annotated[int, Field(ge=0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
OrInfinite = Annotated[float, BeforeValidator(partial(_or_missing, math.inf))]
OrMinusInfinite = Annotated[float, BeforeValidator(partial(_or_missing, -math.inf))]
OrNan = Annotated[float, BeforeValidator(partial(_or_missing, math.nan))]
Pair = Annotated[list[Any], Field(min_length=2, max_length=2)]


class Channel(Table):
    """An input or an output."""

    name: str
    unit: str


class Signals(Table):
    """Sampling, names, and the size of the state."""

    dt: Finite
    inputs: list[Channel]
    outputs: list[Channel]
    states: list[str]
    memory: Count


class ElementTable(Table):
    """An element; which entries it has beside its kind depends on the kind."""

    kind: str
    channels: Count = 0
    operator: str = ""
    n: Count = 0
    rounded: bool = False
    neurons: Count = 0
    expressions: list[str] = []
    hidden: Count = 0
    degrees: list[Count] = []


class PartTable(Table):
    """A part of a combined element."""

    name: str
    element: ElementTable
    reads: list[Count]
    writes: list[Count]


class OuterElementTable(ElementTable):
    """The element of a structure, which alone may combine others."""

    parts: list[PartTable] = []


class Structure(Table):
    """A PI-LFR; its numbers are read as arrays."""

    nx: Count
    offset: bool
    element: OuterElementTable | None = None
    fixed: dict[str, Any]
    bounds: dict[str, Pair]
    priors: dict[str, Pair]


class ParameterRow(Table):
    """Value and standard error of a parameter, as nested lists."""

    value: Any = None
    std: Any = None
    unit: str = ""


class Solve(Table):
    """How a solve ended."""

    iterations: Count
    cost: OrInfinite
    violation: OrInfinite
    seconds: Finite


class Start(Solve):
    """A start of the search."""

    seed: Count
    error: OrInfinite
    status: str
    note: str
    drawn: bool = True


class LimitRow(Table):
    """A constraint or an active bound."""

    name: str
    kind: str
    value: OrNan
    lower: OrMinusInfinite
    upper: OrInfinite
    multiplier: OrNan
    active: bool
    met: bool


class History(Table):
    """The solver's history by column."""

    number: list[Finite]
    cost: list[OrInfinite]
    seconds: list[OrInfinite]
    step: list[OrInfinite]
    damping: list[OrInfinite]


class Training(Table):
    """How the fit came about; the first files had no limits, noise, weights and errors of the linear model."""

    status: str
    sentence: str = ""
    message: str
    nrmse: list[OrInfinite] = []
    noise: Finite | None = None
    weights: dict[str, Finite] | None = None
    linear_nrmse: list[OrInfinite] = []
    seconds: Finite
    active: list[str]
    limits: list[LimitRow] | None = None
    solve: Solve
    variables: dict[str, Finite]
    multipliers: list[OrNan]
    history: History
    starts: list[Start]


class WrittenBy(Table):
    """Versions of the programs that wrote the file."""

    pilfr_casadi: str = ""
    casadi: str = ""


class ModelTables(Table):
    """All tables of a model file, less its digest."""

    format: str
    version: int
    written_by: WrittenBy = WrittenBy()
    model: Signals
    structure: Structure | None = None
    parameters: dict[str, ParameterRow]
    linear: dict[str, Any] | None = None
    initial_states: dict[str, Any]
    training: Training


def read_tables(content: Any, refuse: Refuse) -> ModelTables:
    """Return the content of a file as its tables, or refuse it by its first violation."""
    try:
        return ModelTables.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        refuse(_sentence([str(part)[:SHOWN] for part in first["loc"]], first["type"], first.get("input")))


def _sentence(path: list[str], kind: str, found: Any) -> str:
    """Tell a violation: the field, what was found, what was expected."""
    inside = f" in {'.'.join(path[:-1])}" if path[:-1] else ""
    if kind == "extra_forbidden":
        return f"it has the unknown key {path[-1]!r}{inside}"
    if kind == "missing":
        return f"{path[-1]!r} is missing{inside}"
    if kind == "greater_than_equal":
        return f"{path[-1]!r} is negative{inside}"
    return f"{'.'.join(path)} is not {KINDS.get(kind, 'usable')} but {_shown(found)}"


def _shown(value: Any) -> str:
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a table"
    text = json.dumps(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2]}..."


def array(
    value: Any, shape: tuple[int, ...] | None, name: str, refuse: Refuse, missing: float | None = None
) -> np.ndarray:
    """Return nested lists of finite numbers as an array of a shape (any where None).

    Where `missing` is given, null becomes it and "inf" becomes infinite.
    """
    flat = list(_numbers(value, name, refuse, missing))
    if shape is not None and len(flat) == math.prod(shape) == 0:
        return np.zeros(shape)
    found = _nested_shape(value)
    if (shape is not None and found != shape) or math.prod(found) != len(flat):
        expected = "" if shape is None else f", expected {shape}"
        refuse(f"{name} has {len(flat)} numbers in the shape {found}{expected}")
    return np.array(flat, dtype=float).reshape(found)


def _numbers(value: Any, name: str, refuse: Refuse, missing: float | None, depth: int = 0) -> Any:
    if isinstance(value, list) and depth < DEEPEST:
        for item in value:
            yield from _numbers(item, name, refuse, missing, depth + 1)
    elif missing is not None and (value is None or value == "inf"):
        yield _or_missing(missing, value)
    elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        refuse(f"{name} holds {_shown(value)}, which is not a finite number")
    else:
        yield float(value)


def _nested_shape(value: Any) -> tuple[int, ...]:
    """Shape of nested lists; -1 where their lengths differ."""
    if not isinstance(value, list):
        return ()
    inner = {_nested_shape(item) for item in value}
    return (len(value), *(inner.pop() if len(inner) == 1 else (-1,) if inner else ()))
