"""The schema of a run file: data, model, solver, constraints, grid, seeds and the folder of the results.

A run file is TOML, or a Python file that sets `run` to such a table, in which the model may be a `PILFR` or a closed
`Model`, the solver an object, and `own` a list of constraints under `constraints`. Paths are relative to the file.
Where there are objects, the jobs depend on the contents of the Python file; modules that it imports are not looked at.

Each table is a pydantic model. The `description` of a field is the end of the sentence for a bad value: "'nx' in
[model] is 'one'; give a whole number from 0 to 1000".
"""

from __future__ import annotations

import difflib
import itertools
import math
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model

from .._base import InputError, is_number
from ..identify import BLA, POLISH, STARTS
from ..models import ANY, HYSTERETIC, LAGGED, OPERATORS, PILFR, STRUCTURES, TAKES, Lagged, Model, named_structure
from ..optimise import Constraint, GaussNewton, Ipopt, check_gain, dc_gain, ordered
from ..simulators import user_variable
from .largest_sizes import LARGEST_SIZE, MOST_JOBS, MOST_SAMPLES

ROLES = ("train", "validation", "test")
# keys of the grid: those of [model] and [solver] that a study varies
MODEL_KEYS = ("structure", "nx", "operator", "operators", "channels", "neurons", "hidden", "lags")
SOLVER_KEYS = ("start", "starts", "linear")
READING = ("period", "hold", "skip", "dt", "time_tolerance", "initial")  # fields of a Recording
SIZE = {"nx": "states", "lags": "past outputs"}


@dataclass(frozen=True, eq=False)
class Cell:
    """One model of a study.

    Attributes
    ----------
    values : dict
        Key of the grid -> value, of the keys that matter to the cell; empty where there is no grid.
    model : PILFR, NARX, NOE or Model
    search : dict
        `starts` and `start`, and `linear` where it is given, as for `fit`.
    said : dict
        What the jobs of the cell depend on, as plain numbers and texts: `model` and `solver` with the cell's values.
    """

    values: Mapping[str, Any]
    model: PILFR | Lagged | Model
    search: dict[str, Any]
    said: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The cell's values in a few words."""
        return ", ".join(f"{key} {value}" for key, value in self.values.items())


@dataclass(frozen=True, eq=False)
class Run:
    """A run, checked; fields that the run file has too are described in `demo_data/every_key.toml`.

    Attributes
    ----------
    file, out : Path
        The run file, and the folder of the results.
    said : dict
        The tables `model`, `grid`, `solver`, `constraints` and `regularization` as plain numbers and texts: what a job
        depends on besides its data and its seed. `own` is True where Python objects are among them.
    files : dict
        Recordings by role (`train`, `validation`, `test`), as they are named in the file.
    reading : dict
        How they are read: `inputs`, `outputs`, `columns` and fields of `Recording`.
    cells : tuple of Cell
        The models of the grid with their searches; one where there is no grid.
    path : tuple of float, optional
        Strengths of the L1 regularization to choose from; empty for the usual ones.
    folds : int
        Of the cross-validation that chooses among the cells; 0 for none.
    time_limit : float, optional
        Seconds that a job of a campaign may take.
    """

    file: Path
    out: Path
    said: dict[str, Any]
    own: bool
    files: dict[str, tuple[str, ...]]
    reading: dict[str, Any]
    cells: tuple[Cell, ...]
    solver: Any = POLISH
    stable: bool | float = True
    constraints: tuple[Constraint, ...] = ()
    l1: float | None = None
    prune: bool = True
    path: tuple[float, ...] | None = None
    margin: float = 0.05
    seeds: tuple[int, ...] = (0,)
    folds: int = 0
    time_limit: float | None = None
    retries: int = 2
    workers: int = 1
    engine: str = "auto"
    report: bool = True

    def located(self, name: str) -> Path:
        """Return where a file of the run lies."""
        return self.file.parent / name


class Table(BaseModel):
    """A table of a run file: no unknown keys, and no conversions between kinds of values."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


T = TypeVar("T", bound=Table)


def _whole(key: str, least: int, default: int | None = None) -> Any:
    most = LARGEST_SIZE[key]
    return Field(default, ge=least, le=most, description=f"a whole number from {least} to {most}")


def _number(least: float, default: float | None = None) -> Any:
    return Field(default, ge=least, allow_inf_nan=False, description=f"a number, {least:g} or more")


def _choice(choices: Iterable[str], default: str | None = None) -> Any:
    pattern = f"^({'|'.join(map(re.escape, choices))})$"
    return Field(default, pattern=pattern, description=", ".join(map(repr, choices)))


def _as_names(value: Any) -> tuple[str, ...]:
    """Turn a name, or a list of names, into a tuple."""
    given = [value] if isinstance(value, str | Path) else value
    if not isinstance(given, list | tuple) or not all(isinstance(v, str | Path) and str(v).strip() for v in given):
        raise ValueError
    return tuple(map(str, given))


def _as_seeds(value: Any) -> tuple[int, ...]:
    """Turn a number, a list, or a table of `first` and `count` into a tuple of different seeds."""
    if isinstance(value, Mapping):
        table = validate(SeedsTable, value, "seeds")
        return tuple(range(table.first, table.first + table.count))
    given = [value] if type(value) is int else value
    usable = isinstance(given, list | tuple | range) and 0 < len(given) <= MOST_JOBS
    usable = usable and all(type(s) is int and 0 <= s <= LARGEST_SIZE["seed"] for s in given)
    if not usable or len(set(given)) < len(given):
        raise ValueError
    return tuple(given)


def _as_axis(values: Any) -> list[Any]:
    """Check a list of different values of the grid."""
    usable = isinstance(values, list | tuple) and values and all(isinstance(v, int | str) for v in values)
    if not usable or len(set(values)) < len(values):
        raise ValueError
    return list(values)


Names = Annotated[tuple[str, ...], BeforeValidator(_as_names)]
Axis = Annotated[list[Any] | None, BeforeValidator(_as_axis)]
AXIS: Any = Field(None, description="a list of different values")
NAMES = "a name, or a list of names"


class SeedsTable(Table):
    """`seeds = { first = 0, count = 100 }`."""

    first: int = _whole("seed", 0, 0)
    count: int = Field(1, ge=1, le=MOST_JOBS, description=f"a whole number from 1 to {MOST_JOBS}")


class DataTable(Table):
    """`[data]`: the recordings, and how they are read."""

    train: Names = Field(min_length=1, description=NAMES)
    validation: Names = Field((), description=NAMES)
    test: Names = Field((), description=NAMES)
    inputs: Names = Field(min_length=1, description=NAMES)
    outputs: Names = Field(min_length=1, description=NAMES)
    columns: dict[str, str] = Field({}, description="a table of names and their columns")
    period: int | None = Field(None, ge=0, le=MOST_SAMPLES, description="a whole number of samples")
    hold: str | None = Field(None, description="a text")
    skip: int | None = Field(None, ge=0, le=MOST_SAMPLES, description="a whole number of samples")
    dt: float | None = Field(None, description="a number of seconds")
    time_tolerance: float | None = Field(None, description="a number of steps")
    initial: str | None = Field(None, description="a text")


class ModelTable(Table):
    """`[model]`: the structure and its sizes."""

    structure: str = _choice(STRUCTURES, "lfr")
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


class SolverTable(Table):
    """`[solver]`: the solver, and the search for its start."""

    name: Any = "gauss-newton"
    starts: int = _whole("starts", 1, 8)
    start: str = _choice(STARTS, "grid")
    linear: str = _choice(("output-error", BLA), "output-error")
    max_iterations: int | None = _whole("max_iterations", 1)
    tolerance: float | None = _number(0.0)


class ConstraintsTable(Table):
    """`[constraints]`."""

    spectral_radius: Any = True
    ordered_thresholds: Any = False
    dc_gain: Any = None
    own: Any = ()


class RegularizationTable(Table):
    """`[regularization]`: one L1 weight, or a path of them."""

    path: Any = False
    margin: float = _number(0.0, 0.05)
    l1: float | None = _number(0.0)
    prune: bool | None = Field(None, description="true or false")


class CampaignTable(Table):
    """`[campaign]`: for `pilfr campaign` alone."""

    time_limit: float | None = _number(0.01)
    retries: int = _whole("retries", 0, 2)


def _as_axes(content: Any) -> dict[str, list[Any]]:
    """Check `[grid]`: lists of different values of keys of [model] and [solver], in their order there."""
    fields: dict[str, Any] = {key: (Axis, AXIS) for key in (*MODEL_KEYS, *SOLVER_KEYS)}
    kind: type[Table] = create_model("GridTable", __base__=Table, **fields)
    return {key: values for key, values in validate(kind, content, "grid") if values}


def _table(kind: str) -> Any:
    return Field({}, validate_default=True, description=f"a table [{kind}]")


class RunTable(Table):
    """The whole run file; `model` and `solver` are checked with the values of each cell."""

    seeds: Annotated[tuple[int, ...], BeforeValidator(_as_seeds)] = Field(
        (0,), description=f"at most {MOST_JOBS} different whole numbers of 0 or more, or first and count"
    )
    out: str | None = Field(None, description="a text")
    report: bool = Field(True, description="true or false")
    engine: str = _choice(("auto", "c", "vm"), "auto")
    workers: int = _whole("workers", 1, 1)
    folds: int = _whole("folds", 0, 0)
    data: DataTable = _table("data")
    model: Any = Field({}, description="a table [model]")
    grid: Annotated[dict[str, list[Any]], BeforeValidator(_as_axes)] = Field({}, description="a table [grid]")
    solver: Any = Field({}, description="a table [solver]")
    constraints: ConstraintsTable = _table("constraints")
    regularization: RegularizationTable = _table("regularization")
    campaign: CampaignTable = _table("campaign")


def validate(kind: type[T], content: Any, name: str = "") -> T:
    """Check a table.

    Raises
    ------
    InputError
        With one sentence: the key, what was given, what is expected, and the key that may have been meant.
    """
    if not isinstance(content, Mapping):
        raise InputError(f"{name or 'the run'} is {shown(content)}; give a table.")
    try:
        return kind.model_validate(dict(content))
    except ValidationError as error:
        raise InputError(_sentence(error, kind, content, name)) from None


def _sentence(error: ValidationError, kind: type[Table], content: Any, name: str) -> str:
    """Put the first error into a sentence; unknown keys go first, since a misspelt key leaves another one missing."""
    found = error.errors(include_url=False)
    first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
    own = first.get("ctx", {}).get("error")
    if isinstance(own, InputError):
        return str(own)
    for key in map(str, first["loc"]):
        if key not in kind.model_fields:
            near = difflib.get_close_matches(key.lower(), kind.model_fields, 1)
            place = f"[{name}]" if name else "the run"
            known = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(kind.model_fields)}."
            return f"{place} has an unknown key {key!r}; {known}"
        expected = kind.model_fields[key]
        value = content.get(key, {}) if isinstance(content, Mapping) else {}
        inner = expected.annotation
        if not (isinstance(inner, type) and issubclass(inner, Table) and isinstance(value, Mapping)):
            break
        kind, content, name = inner, value, key
    where = f"{key!r} in [{name}]" if name else repr(key)
    given = "is missing" if first["type"] == "missing" else f"is {shown(value)}"
    return f"{where} {given}; give {expected.description}."


def shown(value: Any) -> str:
    """Write a value in a sentence, shortened."""
    try:
        text = repr(value)
    except ValueError:  # of more digits than Python writes
        return "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


def as_plain(value: Any) -> tuple[Any, bool]:
    """Turn a value into what JSON can write, objects into a mark; return it and whether there are any objects."""
    if isinstance(value, Mapping):
        parts = {str(k): as_plain(v) for k, v in sorted(value.items(), key=lambda kv: str(kv[0]))}
        return {k: v for k, (v, _) in parts.items()}, any(o for _, o in parts.values())
    if isinstance(value, list | tuple | range):
        items = [as_plain(v) for v in value]
        return [v for v, _ in items], any(o for _, o in items)
    if isinstance(value, float):
        return repr(value), False  # inf and nan too
    if value is None or isinstance(value, bool | int | str):
        return value, False
    return f"object {type(value).__name__}", True


def read_run(path: Any, kind: str = "run") -> Run:
    """Read a run file, `.toml` or `.py`; `kind` ends the name of the folder of the results where the file gives none.

    Raises
    ------
    InputError
        If it cannot be read, or asks for something impossible: one sentence with the file and the key.
    """
    file = Path(path)
    if file.suffix.lower() == ".py":
        content = user_variable(file, "run", "the run")
    else:
        try:
            content = tomllib.loads(file.read_bytes().decode())
        except OSError as error:
            raise InputError(f"The run file {file} cannot be read ({error.strerror}); check its name.") from None
        except (ValueError, RecursionError) as error:
            raise InputError(f"{file} is not a TOML file ({error}); correct it.") from None
    try:
        return _checked(file, content, kind)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _checked(file: Path, content: Any, kind: str) -> Run:
    table = validate(RunTable, content)
    said = {k: content.get(k) for k in ("model", "grid", "solver", "constraints", "regularization")}
    plain, own = as_plain(said)
    files = {role: getattr(table.data, role) for role in ROLES}
    _check_files(file, files)
    reading = {"inputs": table.data.inputs, "outputs": table.data.outputs, "columns": table.data.columns}
    reading |= {key: content["data"][key] for key in READING if getattr(table.data, key) is not None}
    if table.folds == 1:
        raise InputError("'folds' is 1; give 2 or more, or leave it out.")
    count = math.prod(map(len, table.grid.values())) * len(table.seeds) * max(table.folds, 1)
    if count > MOST_JOBS:
        raise InputError(f"grid, seeds and folds make {count} jobs; give at most {MOST_JOBS}.")
    cells, solver = _cells(table)
    if "period" not in reading and any("linear" in cell.search for cell in cells):
        raise InputError(
            "linear = 'bla' is for periodic training recordings; give their 'period' in [data], in samples."
        )
    stable, constraints = _constraints(table.constraints, [cell.model for cell in cells])
    return Run(
        file,
        _folder(file, f"{file.stem}-{kind}" if table.out is None else table.out),
        plain,
        own,
        files,
        reading,
        cells,
        solver,
        stable,
        constraints,
        **_regularization(table.regularization, files),
        **{key: getattr(table, key) for key in ("seeds", "folds", "workers", "engine", "report")},
        **dict(table.campaign),
    )


def _folder(file: Path, out: str) -> Path:
    """Return the folder of the results, which lies below that of the run file."""
    above = os.path.realpath(file.parent)
    try:
        inside = above in map(str, Path(os.path.realpath(os.path.join(above, out))).parents)
    except (OSError, ValueError):
        inside = False
    if not inside:
        raise InputError(
            f"'out' is {out[:60]!r}, which is no folder below that of the run file; give one, or another with --out."
        )
    return file.parent / out


def _check_files(file: Path, files: Mapping[str, tuple[str, ...]]) -> None:
    seen: dict[str, str] = {}
    for role, names in files.items():
        for name in names:
            path = os.path.realpath(file.parent / name)
            if not os.path.isfile(path):
                raise InputError(
                    f"the {role} recording {name} does not exist; check its name, which is relative to the run file."
                )
            if path in seen:
                raise InputError(f"{name} is given twice, as {seen[path]} and {role} recording; leave one out.")
            seen[path] = role


def _cells(table: RunTable) -> tuple[tuple[Cell, ...], Any]:
    """Return the cells, in the order of the grid's keys with the last varying fastest, and the solver of all.

    A cell has the keys that matter to its model (a NARX has lags and no operators); combinations that differ in
    nothing else are one cell.
    """
    model, solver, axes = table.model, table.solver, table.grid
    if isinstance(model, PILFR | Lagged | Model):
        if axes:
            raise InputError("[grid] varies a [model] table, and the model is an object; leave one of them out.")
        found, search = _solver(solver)
        _check_search(model, search)
        return (Cell({}, model, search, as_plain({"model": model, "solver": solver})[0]),), found
    base = {}
    for name, content in (("model", model), ("solver", solver)):
        if not isinstance(content, Mapping):
            raise InputError(f"{name} is {shown(content)}; give a table.")
        base[name] = dict(content)
    cells: dict[str, Cell] = {}
    for values in itertools.product(*axes.values()):
        cell = dict(zip(axes, values, strict=True))
        said = {
            "model": base["model"] | {k: v for k, v in cell.items() if k in MODEL_KEYS},
            "solver": base["solver"] | {k: v for k, v in cell.items() if k in SOLVER_KEYS},
        }
        idle = _idle_keys(said["model"], axes)
        said = {table: {k: v for k, v in content.items() if k not in idle} for table, content in said.items()}
        found, search = _solver(said["solver"])
        built = _model(said["model"])
        _check_search(built, search)
        plain = as_plain(said)[0]
        form = "linear" if _is_linear(said["model"]) else said["model"].get("structure", "lfr")
        meaning = str({**plain, "model": {**plain["model"], "structure": form}})
        cells.setdefault(meaning, Cell({k: v for k, v in cell.items() if k not in idle}, built, search, plain))
    return tuple(cells.values()), found


def _is_linear(model: Mapping[str, Any]) -> bool:
    """Whether a [model] table asks for a linear model: no operators."""
    return TAKES.get(model.get("structure", "lfr")) == HYSTERETIC and model.get("operators") == 0


def _idle_keys(model: Mapping[str, Any], axes: Mapping[str, list[Any]]) -> set[str]:
    """Return the keys that do not matter to a cell: other structures take them, or the model is the same without."""
    structure, out = model.get("structure", "lfr"), set[str]()
    if "structure" in axes and structure in TAKES:
        others = {name for s in axes["structure"] for name in TAKES.get(s, ())}
        out = {k for k in ANY.difference(TAKES[structure]) if k not in axes or k in others}
        if structure in LAGGED:
            of_lfr = ("start", "linear")  # not of a NARX or NOE
            out |= {k for k in of_lfr if k not in axes or not LAGGED.keys() >= set(axes["structure"])}
    kinds = axes.get("operator", [])
    if kinds and model.get("operator") != "generalized_play" and ("neurons" not in axes or "generalized_play" in kinds):
        out.add("neurons")
    if axes and _is_linear(model):
        out |= {"operator", "neurons", "channels", *(k for k in SOLVER_KEYS if k in axes)}
    return out


def grid_keys(found: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the keys of the grid that any cell has, in the order of the grid."""
    given = {k for values in found for k in values}
    return [k for k in (*MODEL_KEYS, *SOLVER_KEYS) if k in given]


def _check_search(model: PILFR | Lagged | Model, search: Mapping[str, Any]) -> None:
    if isinstance(model, Lagged) and search["start"] != "grid":
        raise InputError(
            f"start = {search['start']!r} is not for a NARX or NOE, whose starts are of their own kind; leave it out."
        )
    if "linear" in search and not isinstance(model, PILFR):
        of = "a NARX or NOE" if isinstance(model, Lagged) else "a Model, which has its own values"
        raise InputError(f"linear = {search['linear']!r} is not for {of}; leave it out.")


def _model(content: Mapping[str, Any]) -> PILFR | Lagged:
    if content.get("structure") in ("lti", "linear"):
        raise InputError(
            f"'structure' in [model] is {content['structure']!r}; for a linear model give 'lfr' with operators = 0."
        )
    table = validate(ModelTable, content, "model")
    given = {key: value for key, value in table if value is not None and key != "structure"}
    takes = TAKES[table.structure]
    if takes[0] not in given:
        raise InputError(f"'{takes[0]}' in [model] is missing; give the number of {SIZE[takes[0]]}.")
    for key in given:
        if key not in takes:
            raise InputError(
                f"{key!r} in [model] is not for structure = {table.structure!r}, which takes {', '.join(takes)}."
            )
    if "neurons" in given and given.get("operator") != "generalized_play":
        raise InputError("'neurons' in [model] goes with operator = 'generalized_play'; leave it out.")
    try:
        return named_structure(table.structure, **given)
    except InputError as error:
        raise InputError(f"[model]: {error}") from None


def _solver(content: Any) -> tuple[Any, dict[str, Any]]:
    """Return the solver, and the options of the search."""
    if isinstance(content, Mapping) and "time_limit" in content:
        raise InputError(
            "'time_limit' in [solver] would make the result depend on the machine's load; give max_iterations."
        )
    table = validate(SolverTable, content, "solver")
    search = {"starts": table.starts, "start": table.start}
    if table.linear == BLA:
        search["linear"] = BLA
    given = {k: getattr(table, k) for k in ("max_iterations", "tolerance") if getattr(table, k) is not None}
    if not isinstance(table.name, str):
        if given:
            raise InputError(
                f"{', '.join(given)} in [solver] goes with a name; the solver is an object that has its own."
            )
        return table.name, search
    if table.name not in ("gauss-newton", "ipopt"):
        raise InputError(f"'name' in [solver] is {shown(table.name)}; give 'gauss-newton' or 'ipopt'.")
    if table.name == "ipopt":
        return Ipopt(**given), search
    return (GaussNewton(**{"tolerance": POLISH.tolerance, **given}) if given else POLISH), search


def _constraints(
    table: ConstraintsTable, models: Sequence[PILFR | Lagged | Model]
) -> tuple[bool | float, tuple[Constraint, ...]]:
    stable, gain, gap, own = table.spectral_radius, table.dc_gain, table.ordered_thresholds, table.own
    if not isinstance(stable, bool) and not (is_number(stable) and 0 < stable < math.inf):
        raise InputError(
            f"'spectral_radius' in [constraints] is {shown(stable)}; give a number above zero, true or false."
        )
    if not isinstance(own, list | tuple) or not all(isinstance(c, Constraint) for c in own):
        raise InputError(f"'own' in [constraints] is {shown(own)}; give a list of Constraint, in a Python run file.")
    found: list[Constraint] = []
    try:
        if gain is not None:
            given = dict(gain) if isinstance(gain, Mapping) else {"value": gain}
            found.append(dc_gain(given.pop("value"), **given))
        if gap is not False:
            found.append(ordered("r", 0.0 if gap is True else float(gap)))
        for model in models:
            check_gain((*found, *own), model.element)
    except InputError as error:
        raise InputError(f"[constraints]: {error}") from None
    except (TypeError, ValueError, KeyError, OverflowError):
        raise InputError(
            f"[constraints] holds dc_gain = {shown(gain)} and ordered_thresholds = {shown(gap)}; give a number (or "
            "value, within and slope) for the first, and true or a least gap for the second."
        ) from None
    if found and isinstance(models[0], Model):
        raise InputError("dc_gain and ordered_thresholds are for a PI-LFR, and the model is your own; use 'own'.")
    if any(isinstance(model, Lagged) for model in models) and not isinstance(stable, bool):
        raise InputError(
            "'spectral_radius' in [constraints] is not for structure = 'narx' or 'noe', whose state is the past."
        )
    return stable if isinstance(stable, bool) else float(stable), (*found, *own)


def _regularization(table: RegularizationTable, files: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    path, l1, prune = table.path, table.l1, table.prune
    if prune is not None and l1 is None:
        raise InputError(
            "'prune' in [regularization] goes with 'l1', a path prunes by itself; give l1, or leave prune out."
        )
    if path is not False:
        usable = isinstance(path, list | tuple) and path and all(is_number(s) and 0 < s < math.inf for s in path)
        if path is not True and not usable:
            raise InputError(
                f"'path' in [regularization] is {shown(path)}; give true, or a list of strengths above zero."
            )
        if l1 is not None:
            raise InputError("'path' and 'l1' in [regularization] exclude each other; leave one out.")
        if not files["validation"]:
            raise InputError("'path' in [regularization] is chosen by validation; give [data] a validation recording.")
        path = () if path is True else tuple(float(s) for s in path)
    return {"l1": l1, "prune": prune is not False, "path": None if path is False else path, "margin": table.margin}
