"""The schema of a model file: its tables, keys and types of entries, and a sentence about the first violation.

Only this file imports pydantic in this folder, and `read_model_file` imports it only to read a model.
"""

from __future__ import annotations

import json
import math
from functools import partial
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from .._base import InputError
from ..data import Hold
from ..optimise import Status

SHOWN = 40  # characters of a key or a value in a message
KINDS = {
    "string_type": "a text",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "float_type": "a finite number",
    "finite_number": "a finite number",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "too_short": "a pair",
    "too_long": "a pair",
}


def _check_status(status: str) -> str:
    if status not in Status.__members__:
        raise ValueError(f"the status {status[:SHOWN]!r} is unknown")
    return status


def number_or(missing: float, value: Any) -> Any:
    """Read null as a number and "inf" as infinity: JSON has neither nan nor infinity."""
    return missing if value is None else math.inf if value == "inf" else value


Ending = Annotated[str, AfterValidator(_check_status)]
Count = Annotated[int, Field(ge=0)]
Counts = Annotated[tuple[Count, ...], Field(strict=False)]  # a list in the file
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
OrInfinite = Annotated[float, BeforeValidator(partial(number_or, math.inf))]
OrMinusInfinite = Annotated[float, BeforeValidator(partial(number_or, -math.inf))]
OrNan = Annotated[float, BeforeValidator(partial(number_or, math.nan))]
Arrays = dict[str, Any]  # nested lists, read as arrays once their shapes are known
Pairs = dict[str, Annotated[list[Any], Field(min_length=2, max_length=2)]]


class Table(BaseModel):
    """A table with these keys and no others; numbers and texts are not converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


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
    hold: Hold | None = None
    substeps: Count = 0

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of inputs and of outputs."""
        return tuple(c.name for c in self.inputs), tuple(c.name for c in self.outputs)

    @model_validator(mode="after")
    def _check(self) -> Self:
        inputs, outputs = self.names
        if not (outputs and all(inputs + outputs)) or len({*inputs, *outputs}) < len(inputs + outputs):
            raise ValueError("the names of inputs and outputs are missing or not distinct")
        if self.dt <= 0:
            raise ValueError(f"the step dt is {self.dt:g} s")
        return self


class ElementTable(Table):
    """An element; its other entries depend on its kind."""

    kind: str
    channels: Count = 0
    operator: str = ""
    n: Count = 0
    rounded: bool = False
    neurons: Count = 0
    expressions: list[str] = []
    hidden: Count = 0
    degrees: Counts = ()


class PartTable(Table):
    """A part of a combined element."""

    name: str
    element: ElementTable
    reads: Counts
    writes: Counts


class OuterElementTable(ElementTable):
    """The element of a structure; only this one may combine others."""

    parts: list[PartTable] = []


class Structure(Table):
    """A PI-LFR."""

    nx: Count
    offset: bool
    element: OuterElementTable | None = None
    fixed: Arrays
    bounds: Pairs
    priors: Pairs


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
    status: Ending
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

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len({len(column) for _, column in self}) > 1:
            raise ValueError("the columns of the history differ in length")
        return self


class Training(Table):
    """Results of the training; files of the first releases have no limits, noise, weights and linear errors."""

    status: Ending
    sentence: str = ""
    message: str
    nrmse: list[OrInfinite] = []
    noise: Positive | None = None
    weights: dict[str, Positive] | None = None
    linear_nrmse: list[OrInfinite] = []
    seconds: Finite
    active: list[str]
    limits: list[LimitRow] | None = None
    solve: Solve
    variables: dict[str, Finite]
    multipliers: list[OrNan]
    history: History
    starts: list[Start]


class ModelTables(Table):
    """All tables of a model file, without its digest."""

    format: str
    version: int
    written_by: dict[str, str] = {}
    model: Signals
    structure: Structure | None = None
    parameters: dict[str, ParameterRow]
    linear: Arrays | None = None
    initial_states: Arrays
    training: Training


def read_tables(content: Any) -> ModelTables:
    """Validate the content of a file; raise a sentence about its first violation."""
    try:
        return ModelTables.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    *outer, key = [str(part)[:SHOWN] for part in first["loc"]]
    inside = f" in {'.'.join(outer)}" if outer else ""
    expected = KINDS.get(first["type"], "usable")
    sentences = {
        "extra_forbidden": f"it has the unknown key {key!r}{inside}",
        "missing": f"{key!r} is missing{inside}",
        "greater_than_equal": f"{key!r} is negative{inside}",
        "greater_than": f"{key!r} is not above zero{inside}",
        "value_error": str(first.get("ctx", {}).get("error")),
    }
    other = f"{'.'.join([*outer, key])} is not {expected} but {show_value(first['input'])}"
    raise InputError(sentences.get(first["type"], other))


def show_value(value: Any) -> str:
    """Show an entry of a file in a message."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a table"
    text = json.dumps(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2]}..."
