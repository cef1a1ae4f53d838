"""Define the schema of a run file: data, model, solver, constraints, grid, seeds and the folder of the results.

A run file is TOML, or a Python file that sets `run` to such a table. In Python the model may be a `PILFR` or a closed
`Model`, the solver an object, and `own` under `constraints` a list of constraints. Paths are relative to the file. With
objects, the jobs depend on the text of the Python file, but not on the modules that it imports.

Each table is a pydantic model. The `description` of a field ends the message about a bad value: "'nx' in [model] is
'one'; give a whole number from 0 to 1000".
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    InstanceOf,
    Strict,
    ValidationError,
    create_model,
    model_validator,
)

from .._base import InputError
from ..identify import BLA_OPTION, DEFAULT_SOLVER, START_KINDS
from ..models import OPERATORS, PILFR, STRUCTURE_OPTIONS, STRUCTURES, Lagged, Model, named_structure
from ..optimise import Constraint, GaussNewton, Ipopt, check_gain, dc_gain, ordered

# keys of [model] and [solver] that a grid may vary
MODEL_KEYS = ("structure", "nx", "operator", "operators", "channels", "neurons", "hidden", "lags")
SOLVER_KEYS = ("start", "starts", "linear")
SIZE = {"nx": "states", "lags": "past outputs"}

# The largest sizes that a run file or the command line accepts, far above every sensible model: a larger job never ends
# or exhausts the memory.
LARGEST_SIZE = {
    "nx": 1_000,  # states: A alone has 1e6 parameters, and the Gauss-Newton matrix 1e12 entries
    "operators": 10_000,  # per channel: the Jacobian of the paper's 6144 samples then has 1 GB
    "channels": 100,  # of the element: each has all operators
    "neurons": 1_000,  # of an envelope
    "hidden": 10_000,  # neurons of a network: like operators
    "lags": 10_000,  # samples: `fit` requires a longer recording
    "input_lags": 10_000,
    "starts": 1_000_000,  # 12 days at one second per start
    "seed": 2**63 - 1,  # the largest integer of 64 bits
    "max_iterations": 1_000_000,
    "folds": 10_000,
    "retries": 1_000,
    "workers": 1_024,  # processes: each takes 100 MB and more
    "samples": 10**9,  # of a period, or skipped: 8 GB per channel
    "jobs": 100_000,  # of a run: the manifest names each, about 300 bytes per job, and is written after every one
}


class Table(BaseModel):
    """A table of a run file, without unknown keys or conversions between types."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


T = TypeVar("T", bound=Table)


def _whole(key: str, least: int, default: int | None = None) -> Any:
    most = LARGEST_SIZE[key]
    return Field(default, ge=least, le=most, description=f"a whole number from {least} to {most}")


def _number(least: float, default: float | None = None) -> Any:
    return Field(default, ge=least, allow_inf_nan=False, description=f"a number, {least:g} or more")


def _choice(choices: Iterable[str], default: str | None = None, more: str = "") -> Any:
    pattern = f"^({'|'.join(map(re.escape, choices))})$"
    return Field(default, pattern=pattern, description=", ".join(map(repr, choices)) + more)


def _as_list(value: Any) -> Any:
    """Turn one value, or a range, into a list; paths into texts."""
    given = [value] if isinstance(value, str | Path | int) else value
    return [str(v) if isinstance(v, Path) else v for v in given] if isinstance(given, list | tuple | range) else given


def _as_seeds(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return _as_list(value)
    table = validate(SeedsTable, value, "seeds")
    return range(table.first, table.first + table.count)


def _all_different(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) < len(values):
        raise ValueError
    return values


def _as_gap(value: bool | float) -> Constraint | None:
    return None if value is False else ordered("r", 0.0 if value is True else value)


def _as_gain(value: Any) -> Constraint:
    given = dict(value) if isinstance(value, Mapping) else {"value": value}
    try:
        return dc_gain(given.pop("value"), **given)
    except (TypeError, KeyError, OverflowError):
        raise ValueError from None


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seed = Annotated[int, Field(ge=0, le=LARGEST_SIZE["seed"])]
Names = Annotated[tuple[Annotated[str, Field(pattern=r"\S")], ...], Strict(False), BeforeValidator(_as_list)]
Seeds = Annotated[
    tuple[Seed, ...],
    Strict(False),
    Field(min_length=1, max_length=LARGEST_SIZE["jobs"]),
    AfterValidator(_all_different),
    BeforeValidator(_as_seeds),
]
Axis = Annotated[tuple[int | str, ...], Strict(False), Field(min_length=1), AfterValidator(_all_different)]
NAMES = "a name, or a list of names"
SAMPLES = "a whole number of samples"


class SeedsTable(Table):
    """`seeds = { first = 0, count = 100 }`."""

    first: int = _whole("seed", 0, 0)
    count: int = _whole("jobs", 1, 1)


class DataTable(Table):
    """`[data]`: the recordings and the options of reading them."""

    train: Names = Field(min_length=1, description=NAMES)
    validation: Names = Field((), description=NAMES)
    test: Names = Field((), description=NAMES)
    inputs: Names = Field(min_length=1, description=NAMES)
    outputs: Names = Field(min_length=1, description=NAMES)
    columns: dict[str, str] = Field({}, description="a table of names and their columns")
    period: int | None = Field(None, ge=0, le=LARGEST_SIZE["samples"], description=SAMPLES)
    hold: str | None = Field(None, description="a text")
    skip: int | None = Field(None, ge=0, le=LARGEST_SIZE["samples"], description=SAMPLES)
    dt: float | None = Field(None, description="a number of seconds")
    time_tolerance: float | None = Field(None, description="a number of steps")
    initial: str | None = Field(None, description="a text")


class ModelTable(Table):
    """`[model]`: the structure and its sizes."""

    structure: str = _choice(STRUCTURES, "lfr", "; for a linear model give 'lfr' with operators = 0")
    nx: int | None = _whole("nx", 0)
    operators: int | None = _whole("operators", 0)
    operator: str | None = _choice(OPERATORS)
    channels: int | None = _whole("channels", 1)
    neurons: int | None = _whole("neurons", 0)
    hidden: int | None = _whole("hidden", 1)
    lags: int | None = _whole("lags", 1)
    input_lags: int | None = _whole("input_lags", 1)
    offset: bool | None = Field(None, description="true or false")
    fix: dict[str, Any] | None = Field(None, description="a table of blocks and their values")
    bounds: dict[str, Any] | None = Field(None, description="a table of parameters and their bounds")
    priors: dict[str, Any] | None = Field(None, description="a table of parameters and their priors")

    def build(self) -> PILFR | Lagged:
        """Build the model; refuse keys that do not apply to its structure."""
        given = {key: value for key, value in self if value is not None and key != "structure"}
        takes = STRUCTURE_OPTIONS[self.structure]
        if takes[0] not in given:
            raise InputError(f"'{takes[0]}' in [model] is missing; give the number of {SIZE[takes[0]]}.")
        for key in given:
            if key not in takes:
                raise InputError(
                    f"{key!r} in [model] is not for structure = {self.structure!r}, which takes {', '.join(takes)}."
                )
        if self.neurons is not None and self.operator != "generalized_play":
            raise InputError("'neurons' in [model] goes with operator = 'generalized_play'; leave it out.")
        try:
            return named_structure(self.structure, **given)
        except InputError as error:
            raise InputError(f"[model]: {error}") from None


class SolverTable(Table):
    """`[solver]`: the solver, and the search for its start."""

    name: Any = "gauss-newton"
    starts: int = _whole("starts", 1, 8)
    start: str = _choice(START_KINDS, "grid")
    linear: str = _choice(("output-error", BLA_OPTION), "output-error")
    max_iterations: int | None = _whole("max_iterations", 1)
    tolerance: float | None = _number(0.0)

    @property
    def search(self) -> dict[str, Any]:
        """The search options of `fit`."""
        search = {"starts": self.starts, "start": self.start}
        return {**search, "linear": BLA_OPTION} if self.linear == BLA_OPTION else search

    def build(self) -> Any:
        """Build the solver; return an object unchanged."""
        given = {k: getattr(self, k) for k in ("max_iterations", "tolerance") if getattr(self, k) is not None}
        if not isinstance(self.name, str):
            if given:
                raise InputError(
                    f"{', '.join(given)} in [solver] goes with a solver given by name; an object has its own options."
                )
            return self.name
        if self.name not in ("gauss-newton", "ipopt"):
            raise InputError(f"'name' in [solver] is {show_value(self.name)}; give 'gauss-newton' or 'ipopt'.")
        if self.name == "ipopt":
            return Ipopt(**given)
        return GaussNewton(**{"tolerance": DEFAULT_SOLVER.tolerance, **given}) if given else DEFAULT_SOLVER


class ConstraintsTable(Table):
    """`[constraints]`."""

    spectral_radius: bool | Positive = Field(True, description="a number above zero, true or false")
    ordered_thresholds: Annotated[bool | float, AfterValidator(_as_gap)] | None = Field(
        None, description="true, or a least gap"
    )
    dc_gain: Annotated[Any, BeforeValidator(_as_gain)] = Field(
        None, description="a number, or a table of value, within and slope"
    )
    own: Annotated[tuple[InstanceOf[Constraint], ...], Strict(False)] = Field(
        (), description="a list of Constraint, in a Python run file"
    )

    def for_models(self, models: Sequence[PILFR | Lagged | Model]) -> tuple[Constraint, ...]:
        """Return the constraints; refuse constraints that do not apply to all models."""
        given: list[Any] = [self.dc_gain, self.ordered_thresholds]  # the validators made constraints of them
        found = [c for c in given if c is not None]
        try:
            for model in models:
                check_gain((*found, *self.own), model.element)
        except InputError as error:
            raise InputError(f"[constraints]: {error}") from None
        if found and isinstance(models[0], Model):
            raise InputError("dc_gain and ordered_thresholds are for a PI-LFR, and the model is your own; use 'own'.")
        if not (all(isinstance(model, PILFR) for model in models) or isinstance(self.spectral_radius, bool)):
            raise InputError(
                "'spectral_radius' in [constraints] is for a PI-LFR, and another model is given; leave one of them out."
            )
        return (*found, *self.own)


class RegularizationTable(Table):
    """`[regularization]`: one L1 weight, or a path of them."""

    path: bool | Annotated[tuple[Positive, ...], Strict(False), Field(min_length=1)] = Field(
        False, description="true, or a list of strengths above zero"
    )
    margin: float = _number(0.0, 0.05)
    l1: float | None = _number(0.0)
    prune: bool | None = Field(None, description="true or false")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.prune is not None and self.l1 is None:
            raise InputError(
                "'prune' in [regularization] goes with 'l1', a path prunes by itself; give l1, or leave prune out."
            )
        if self.path and self.l1 is not None:
            raise InputError("'path' and 'l1' in [regularization] exclude each other; leave one out.")
        return self


class CampaignTable(Table):
    """`[campaign]`: options of `pilfr campaign`."""

    time_limit: float | None = _number(0.01)
    retries: int = _whole("retries", 0, 2)


AXIS: Any = (Axis | None, Field(None, description="a list of different values"))
GridTable: Any = create_model("GridTable", __base__=Table, **dict.fromkeys((*MODEL_KEYS, *SOLVER_KEYS), AXIS))


def _table(kind: str) -> Any:
    return Field({}, validate_default=True, description=f"a table [{kind}]")


class RunTable(Table):
    """The whole run file; `model` and `solver` are checked with the values of each cell."""

    seeds: Seeds = Field(
        (0,), description=f"at most {LARGEST_SIZE['jobs']} different whole numbers of 0 or more, or first and count"
    )
    out: str | None = Field(None, description="a text")
    report: bool = Field(True, description="true or false")
    engine: str = _choice(("auto", "c", "vm"), "auto")
    workers: int = _whole("workers", 1, 1)
    folds: int = _whole("folds", 0, 0)
    data: DataTable = _table("data")
    model: Any = Field({}, description="a table [model]")
    grid: GridTable = _table("grid")
    solver: Any = Field({}, description="a table [solver]")
    constraints: ConstraintsTable = _table("constraints")
    regularization: RegularizationTable = _table("regularization")
    campaign: CampaignTable = _table("campaign")

    @property
    def axes(self) -> dict[str, tuple[int | str, ...]]:
        """Values of each given key of the grid, in the order of the keys in [model] and [solver]."""
        return {key: values for key, values in self.grid if values}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.folds == 1:
            raise InputError("'folds' is 1; give 2 or more, or leave it out.")
        count = math.prod(map(len, self.axes.values())) * len(self.seeds) * max(self.folds, 1)
        if count > LARGEST_SIZE["jobs"]:
            raise InputError(f"grid, seeds and folds make {count} jobs; give at most {LARGEST_SIZE['jobs']}.")
        if self.regularization.path and not self.data.validation:
            raise InputError("'path' in [regularization] is chosen by validation; give [data] a validation recording.")
        return self


def validate(kind: type[T], content: Any, name: str = "") -> T:
    """Check a table; the `InputError` states the key, the value that was given, and what is expected."""
    try:
        return kind.model_validate(dict(content) if isinstance(content, Mapping) else content)
    except ValidationError as error:
        raise InputError(_sentence(error, kind, name)) from None


def _sentence(error: ValidationError, kind: type[Table], name: str) -> str:
    """Describe the first error; an unknown key precedes a missing one, since it may be its misspelling."""
    found = error.errors(include_url=False)
    first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
    own = first.get("ctx", {}).get("error")
    if isinstance(own, InputError):  # raised inside a table, without its name
        return f"[{first['loc'][0]}]: {own}" if len(first["loc"]) > 1 else str(own)
    if not first["loc"]:
        return f"{name or 'the run'} is {show_value(first['input'])}; give a table."
    key, *inner = map(str, first["loc"])
    table = kind.model_fields[key].annotation if inner else None
    if isinstance(table, type) and issubclass(table, Table):
        kind, name, key = table, key, inner[0]
    if key not in kind.model_fields:
        near = difflib.get_close_matches(key.lower(), kind.model_fields, 1)
        known = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(kind.model_fields)}."
        return f"{f'[{name}]' if name else 'the run'} has an unknown key {key!r}; {known}"
    where = f"{key!r} in [{name}]" if name else repr(key)
    given = "is missing" if first["type"] == "missing" else f"is {show_value(first['input'])}"
    return f"{where} {given}; give {kind.model_fields[key].description}."


def show_value(value: Any) -> str:
    """Write a value for a message, shortened."""
    try:
        text = repr(value)
    except ValueError:  # a number with more digits than Python converts
        return "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."
