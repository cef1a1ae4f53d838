"""The grid of a run file: every combination of the values listed in `[grid]` is a cell, and every seed a job in it.

A run without a grid has one cell. Keys of the grid are those of `[model]` and `[solver]` that a study varies; what it
does not list is as these tables say. A cell has the keys that matter to its model (a NARX has lags and no operators);
combinations that differ in nothing else are one cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..models import ANY, HYSTERETIC, LAGGED, PILFR, TAKES, Lagged, Model
from .tables import Table, as_plain, shown

MODEL_KEYS = ("structure", "nx", "operator", "operators", "channels", "neurons", "hidden", "lags")
SOLVER_KEYS = ("start", "starts", "linear")
OF_LFR = ("start", "linear")  # not of a NARX or NOE


@dataclass(frozen=True, eq=False)
class Cell:
    """One model of a study.

    Attributes
    ----------
    values : dict
        Key of the grid -> value, of the keys that matter to the cell; empty where there is no grid.
    model : PILFR, NARX, NOE or Model
    search : dict
        `starts` and `start`, and `linear` where it is said, as for `fit`.
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


def cells_of(
    top: Table, model_of: Callable[[Table], PILFR | Lagged], solver_of: Callable[[Table], tuple[Any, dict[str, Any]]]
) -> tuple[tuple[Cell, ...], Any]:
    """The cells of a run, in the order of the grid's keys with the last varying fastest; and the solver of all."""
    model, solver = top.any("model", {}), top.any("solver", {})
    if isinstance(model, PILFR | Lagged | Model):
        if top.has("grid"):
            top.fail("[grid] varies a [model] table, and the model is an object; leave one of them out")
        found, search = solver_of(Table(top.file, "solver", solver))
        _check_start(top, model, search)
        return (Cell({}, model, search, as_plain({"model": model, "solver": solver})[0]),), found
    axes = _axes(top.table("grid"))
    base = {"model": Table(top.file, "model", model).content, "solver": Table(top.file, "solver", solver).content}
    cells: dict[str, Cell] = {}
    for values in itertools.product(*axes.values()):
        cell = dict(zip(axes, values, strict=True))
        said = {
            "model": base["model"] | {k: v for k, v in cell.items() if k in MODEL_KEYS},
            "solver": base["solver"] | {k: v for k, v in cell.items() if k in SOLVER_KEYS},
        }
        idle = _idle(said["model"], axes)
        said = {table: {k: v for k, v in content.items() if k not in idle} for table, content in said.items()}
        found, search = solver_of(Table(top.file, "solver", said["solver"]))
        built = model_of(Table(top.file, "model", said["model"]))
        _check_start(top, built, search)
        plain = as_plain(said)[0]
        form = "linear" if _linear(said["model"]) else said["model"].get("structure", "lfr")
        meaning = str({**plain, "model": {**plain["model"], "structure": form}})
        cells.setdefault(meaning, Cell({k: v for k, v in cell.items() if k not in idle}, built, search, plain))
    return tuple(cells.values()), found


def _linear(model: Mapping[str, Any]) -> bool:
    """Whether a [model] table says a linear model: no operators."""
    return TAKES.get(model.get("structure", "lfr")) == HYSTERETIC and model.get("operators") == 0


def _idle(model: Mapping[str, Any], axes: Mapping[str, list[Any]]) -> set[str]:
    """Keys that say nothing of this cell: other structures of the grid take them, or its model is the same without."""
    structure, out = model.get("structure", "lfr"), set[str]()
    if "structure" in axes and structure in TAKES:
        others = {name for s in axes["structure"] for name in TAKES.get(s, ())}
        out = {k for k in ANY.difference(TAKES[structure]) if k not in axes or k in others}
        if structure in LAGGED:
            out |= {k for k in OF_LFR if k not in axes or not LAGGED.keys() >= set(axes["structure"])}
    kinds = axes.get("operator", [])
    if kinds and model.get("operator") != "generalized_play" and ("neurons" not in axes or "generalized_play" in kinds):
        out.add("neurons")
    if axes and _linear(model):
        out |= {"operator", "neurons", "channels", *(k for k in SOLVER_KEYS if k in axes)}
    return out


def grid_keys(found: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of the grid that any cell has, in the order of the grid."""
    given = {k for values in found for k in values}
    return [k for k in (*MODEL_KEYS, *SOLVER_KEYS) if k in given]


def _check_start(top: Table, model: PILFR | Lagged | Model, search: Mapping[str, Any]) -> None:
    if isinstance(model, Lagged) and search["start"] != "grid":
        top.fail(
            f"start = {search['start']!r} is not for a NARX or NOE, whose starts are of their own kind; leave it out"
        )
    if "linear" in search and not isinstance(model, PILFR):
        of = "a NARX or NOE" if isinstance(model, Lagged) else "a Model, which has its own values"
        top.fail(f"linear = {search['linear']!r} is not for {of}; leave it out")


def _axes(table: Table) -> dict[str, list[Any]]:
    axes = {}
    for key in (*MODEL_KEYS, *SOLVER_KEYS):
        if not table.has(key):
            table.known.append(key)
            continue
        values = table.any(key)
        usable = isinstance(values, list | tuple) and values and all(isinstance(v, int | str) for v in values)
        if not usable or len(set(values)) < len(values):
            table.fail(f"{table.where(key)} is {shown(values)}; give a list of different values")
        axes[key] = list(values)
    table.done()
    return axes


def seeds_of(top: Table) -> tuple[int, ...]:
    """The seeds: a number, a list, or a table of `first` and `count`."""
    seeds = top.any("seeds", [0])
    if isinstance(seeds, Mapping):
        table = Table(top.file, "seeds", seeds)
        first, count = table.number("first", 0, 0, whole=True), table.number("count", 1, 1, whole=True)
        table.done()
        return tuple(range(first, first + count))
    seeds = [seeds] if isinstance(seeds, int) else seeds
    usable = isinstance(seeds, list | tuple | range) and all(type(s) is int and s >= 0 for s in seeds)
    if not usable or not seeds or len(set(seeds)) < len(seeds):
        top.fail(f"'seeds' is {shown(seeds)}; give different whole numbers of 0 or more, or first and count")
    return tuple(seeds)
