"""Read a run file into a checked `Run`: its paths, its solver, and a cell for every combination of the grid."""

from __future__ import annotations

import itertools
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._base import InputError, existing_file, read_bytes
from ..models import ALL_OPTIONS, HYSTERETIC_OPTIONS, LAGGED, PILFR, STRUCTURE_OPTIONS, Lagged, Model
from ..optimise import Constraint
from ..simulators import user_variable
from .schema import (
    MODEL_KEYS,
    SOLVER_KEYS,
    ModelTable,
    RegularizationTable,
    RunTable,
    SolverTable,
    show_value,
    validate,
)

ROLES = ("train", "validation", "test")
READING = ("period", "hold", "skip", "dt", "time_tolerance", "initial")  # fields of a Recording


@dataclass(frozen=True, eq=False)
class Cell:
    """One model of a study, with the search options of `fit`: `starts`, `start` and, if given, `linear`."""

    values: Mapping[str, Any]  # key of the grid -> value, for the keys that apply to the cell
    model: PILFR | Lagged | Model
    search: dict[str, Any]
    plain_tables: dict[str, Any] = field(default_factory=dict)  # `model` and `solver` as plain numbers and texts

    @property
    def name(self) -> str:
        """The cell's values in a few words."""
        return ", ".join(f"{key} {value}" for key, value in self.values.items())


@dataclass(frozen=True, eq=False)
class Run:
    """A checked run; fields that are keys of the run file are described in `demo_data/every_key.toml`.

    Attributes
    ----------
    file, out : Path
        The run file, and the folder of the results.
    plain_tables : dict
        The tables `model`, `grid`, `solver`, `constraints` and `regularization` as plain numbers and texts. A job
        depends on these, the data and the seed; if `own` is True, there are objects, and it depends on the Python file
        too.
    files : dict
        Names of the recordings in the file, by role (`train`, `validation`, `test`).
    reading : dict
        Options to read the recordings: `inputs`, `outputs`, `columns` and fields of `Recording`.
    cells : tuple of Cell
        The models of the grid with their search options; one cell without a grid.
    """

    file: Path
    out: Path
    plain_tables: dict[str, Any]
    own: bool
    files: dict[str, tuple[str, ...]]
    reading: dict[str, Any]
    cells: tuple[Cell, ...]
    solver: Any
    stable: bool | float
    constraints: tuple[Constraint, ...]
    regularization: RegularizationTable
    seeds: tuple[int, ...] = (0,)
    folds: int = 0
    time_limit: float | None = None
    retries: int = 2
    workers: int = 1
    engine: str = "auto"
    report: bool = True

    def path_of(self, name: str) -> Path:
        """Return the path of a file of the run."""
        return self.file.parent / name


def as_plain(value: Any) -> tuple[Any, bool]:
    """Convert a value to JSON types, objects to a placeholder; also tell whether there are objects."""
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
    """Read a run file, `.toml` or `.py`; the default folder of the results is named after the file and `kind`.

    Raises
    ------
    InputError
        If the file cannot be read, or a key has a bad value; the sentence names the file and the key.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{path!r} was given for a run file; give its path, or the result of `read_run`.")
    file = Path(path)
    try:
        if file.suffix.lower() == ".py":
            content = user_variable(existing_file(file), "run", "the run")
        else:
            content = tomllib.loads(read_bytes(file).decode())
    except InputError as error:
        raise InputError(f"The run file cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is not a TOML file ({error}); correct it.") from None
    try:
        return _check_content(file, content, kind)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _check_content(file: Path, content: Any, kind: str) -> Run:
    table = validate(RunTable, content)
    plain, own = as_plain({k: content.get(k) for k in ("model", "grid", "solver", "constraints", "regularization")})
    files = {role: getattr(table.data, role) for role in ROLES}
    _check_files(file, files)
    reading = {"inputs": table.data.inputs, "outputs": table.data.outputs, "columns": table.data.columns}
    reading |= {key: content["data"][key] for key in READING if getattr(table.data, key) is not None}
    cells, solver = _build_cells(table)
    if "period" not in reading and any("linear" in cell.search for cell in cells):
        raise InputError(
            "linear = 'bla' is for periodic training recordings; give their 'period' in [data], in samples."
        )
    return Run(
        file=file,
        out=_output_folder(file, f"{file.stem}-{kind}" if table.out is None else table.out),
        plain_tables=plain,
        own=own,
        files=files,
        reading=reading,
        cells=cells,
        solver=solver,
        stable=table.constraints.spectral_radius,
        constraints=table.constraints.for_models([cell.model for cell in cells]),
        **{key: getattr(table, key) for key in ("regularization", "seeds", "folds", "workers", "engine", "report")},
        **dict(table.campaign),
    )


def _output_folder(file: Path, out: str) -> Path:
    """Return the folder of the results; refuse a folder that is not below the folder of the run file."""
    above = os.path.realpath(file.parent)
    try:
        inside = above in map(str, Path(os.path.realpath(os.path.join(above, out))).parents)
    except (OSError, ValueError):
        inside = False
    if not inside:
        raise InputError(
            f"'out' is {out[:60]!r}, not below the folder of the run file; give a folder there, or any with --out."
        )
    return file.parent / out


def _check_files(file: Path, files: Mapping[str, tuple[str, ...]]) -> None:
    seen: dict[str, str] = {}
    for role, names in files.items():
        for name in names:
            path = os.path.realpath(file.parent / name)
            try:
                existing_file(path)
            except InputError as error:
                raise InputError(f"{role!r} in [data]: {error}") from None
            if path in seen:
                raise InputError(f"{name} is given twice, as {seen[path]} and {role} recording; leave one out.")
            seen[path] = role


def _build_cells(table: RunTable) -> tuple[tuple[Cell, ...], Any]:
    """Build the cells, in the order of the grid's keys with the last key varying fastest, and their solver.

    A cell keeps the keys that apply to its model (a NARX has lags and no operators); combinations that differ only in
    other keys are one cell.
    """
    model, solver, axes = table.model, table.solver, table.axes
    if isinstance(model, PILFR | Lagged | Model):
        if axes:
            raise InputError("[grid] varies a [model] table, and the model is an object; leave one of them out.")
        cell = _build_cell({}, model, {"model": model, "solver": solver})
        return (cell,), validate(SolverTable, solver, "solver").build()
    for name, content in (("model", model), ("solver", solver)):
        if not isinstance(content, Mapping):
            raise InputError(f"{name} is {show_value(content)}; give a table.")
    cells: dict[str, Cell] = {}
    for combination in itertools.product(*axes.values()):
        values = dict(zip(axes, combination, strict=True))
        tables = {
            "model": {**model, **{k: v for k, v in values.items() if k in MODEL_KEYS}},
            "solver": {**solver, **{k: v for k, v in values.items() if k in SOLVER_KEYS}},
        }
        idle = _idle_keys(tables["model"], axes)
        tables = {name: {k: v for k, v in content.items() if k not in idle} for name, content in tables.items()}
        built = validate(ModelTable, tables["model"], "model").build()
        cell = _build_cell({k: v for k, v in values.items() if k not in idle}, built, tables)
        form = "linear" if _is_linear(tables["model"]) else tables["model"].get("structure", "lfr")
        cells.setdefault(str({**cell.plain_tables, "model": {**cell.plain_tables["model"], "structure": form}}), cell)
    return tuple(cells.values()), validate(SolverTable, solver, "solver").build()


def _build_cell(values: Mapping[str, Any], model: PILFR | Lagged | Model, tables: dict[str, Any]) -> Cell:
    """Build a cell; refuse search options that do not apply to its model."""
    search = validate(SolverTable, tables["solver"], "solver").search
    if isinstance(model, Lagged) and search["start"] != "grid":
        raise InputError(f"start = {search['start']!r} is not for a NARX or NOE, which has other starts; leave it out.")
    if "linear" in search and not isinstance(model, PILFR):
        of = "a NARX or NOE" if isinstance(model, Lagged) else "a Model, which has its own values"
        raise InputError(f"linear = {search['linear']!r} is not for {of}; leave it out.")
    return Cell(values, model, search, as_plain(tables)[0])


def _is_linear(model: Mapping[str, Any]) -> bool:
    """Tell whether a [model] table describes a linear model, without operators."""
    return STRUCTURE_OPTIONS.get(model.get("structure", "lfr")) == HYSTERETIC_OPTIONS and model.get("operators") == 0


def _idle_keys(model: Mapping[str, Any], axes: Mapping[str, Sequence[Any]]) -> set[str]:
    """Return the keys without effect on a cell's model, such as keys of other structures."""
    structure, out = model.get("structure", "lfr"), set[str]()
    if "structure" in axes and structure in STRUCTURE_OPTIONS:
        others = {name for s in axes["structure"] for name in STRUCTURE_OPTIONS.get(s, ())}
        out = {k for k in ALL_OPTIONS.difference(STRUCTURE_OPTIONS[structure]) if k not in axes or k in others}
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
