"""What a run file says, checked: data, model, solver, constraints, grid, seeds and the folder of the results.

A run file is TOML, or a Python file that sets `run` to such a table, in which the model may be a `PILFR` or a closed
`Model`, the solver an object, and `own` a list of constraints under `constraints`. Paths are relative to the file.
Where there are objects, the jobs depend on the contents of the Python file; what it imports is not looked at.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._base import InputError, is_number
from ..identify import BLA, POLISH, STARTS
from ..models import OPERATORS, PILFR, STRUCTURES, TAKES, Lagged, Model, named_structure
from ..optimise import Constraint, GaussNewton, Ipopt, check_gain, dc_gain, ordered
from ..simulators import user_variable
from .folder import check_inside
from .grid import Cell, cells_of, seeds_of
from .tables import Table, as_plain, shown

ROLES = ("train", "validation", "test")
SIZE = {"nx": "states", "lags": "past outputs"}
OPTIONS = {"period": int, "hold": str, "skip": int, "dt": float, "time_tolerance": float, "initial": str}


@dataclass(frozen=True, eq=False)
class Run:
    """A run, checked.

    Attributes
    ----------
    file, out : Path
        The run file, and the folder of the results.
    said : dict
        What the file says under `model`, `solver`, `constraints` and `regularization`, as plain numbers and texts: what
        a job depends on besides its data and its seed. `own` is True where Python objects are among them.
    files : dict
        Recordings by role (`train`, `validation`, `test`), as they are named in the file.
    reading : dict
        How they are read: `inputs`, `outputs`, `columns` and fields of `Recording`.
    cells : tuple of Cell
        The models of the grid with their searches; one where there is no grid.
    solver : GaussNewton or Ipopt, or one of the user's own
    stable : bool or float
    constraints : tuple of Constraint
    l1, prune, path, margin
        Of the regularization: a weight, whether to fit again after pruning, strengths of a path (None: no path; empty:
        the usual ones).
    seeds : tuple of int
    folds : int
        Of the cross-validation that chooses among the cells; 0 for none.
    time_limit, retries
        Seconds a job of a campaign may take (None: no limit), and how often one whose worker has died is tried again.
    workers : int
    engine : str
    report : bool
        Whether to write a page about the job that is chosen.
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
        """Where a file of the run lies."""
        return self.file.parent / name


def read_run(path: Any, kind: str = "run") -> Run:
    """Read a run file, `.toml` or `.py`; `kind` ends the name of the folder of the results where the file gives none.

    Raises
    ------
    InputError
        If it cannot be read, or says what cannot be done: one sentence with the file and the key.
    """
    file = Path(path)
    if file.suffix.lower() == ".py":
        content = user_variable(file, "run", "the run")
    else:
        try:
            content = tomllib.loads(file.read_bytes().decode())
        except OSError as error:
            raise InputError(f"The run file {file} cannot be read ({error.strerror}); check its name.") from None
        except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise InputError(f"{file} is not a TOML file ({error}); correct it.") from None
    return _checked(file, content, kind)


def _checked(file: Path, content: Any, kind: str) -> Run:
    top = Table(file, "", content)
    said = {k: content.get(k) for k in ("model", "grid", "solver", "constraints", "regularization")}
    plain, own = as_plain(said)
    data = top.table("data")
    files = {role: data.names(role, required=role == "train") for role in ROLES}
    reading = _reading(data)
    data.done()
    _check_files(top, files)
    cells, solver = cells_of(top, _model, _solver)
    if "period" not in reading and any("linear" in cell.search for cell in cells):
        top.fail("linear = 'bla' is for periodic training recordings; give their 'period' in [data], in samples")
    stable, constraints = _constraints(top.table("constraints"), [cell.model for cell in cells])
    regularization = _regularization(top.table("regularization"), files)
    out = top.take("out", str, f"{file.stem}-{kind}")
    wrong = check_inside(file, out)
    if wrong:
        top.fail(wrong)
    more = {
        "seeds": seeds_of(top),
        "folds": top.number("folds", 0, 2, whole=True),
        **_campaign(top.table("campaign")),
        "workers": top.number("workers", 1, 1, whole=True),
        "engine": top.choice("engine", ("auto", "c", "vm"), "auto"),
        "report": top.take("report", bool, True),
    }
    top.done()
    return Run(
        file,
        file.parent / out,
        plain,
        own,
        files,
        reading,
        cells,
        solver,
        stable,
        constraints,
        **regularization,
        **more,
    )


def _reading(data: Table) -> dict[str, Any]:
    reading: dict[str, Any] = {key: data.names(key, required=True) for key in ("inputs", "outputs")}
    columns = data.table("columns")
    reading["columns"] = {key: columns.take(key, str) for key in list(columns.content)}
    for key, kind in OPTIONS.items():
        value = data.take(key, kind)
        if value is not None:
            reading[key] = value
    return reading


def _check_files(top: Table, files: Mapping[str, tuple[str, ...]]) -> None:
    seen: dict[Path, str] = {}
    for role, names in files.items():
        for name in names:
            path = (top.file.parent / name).resolve()
            if not path.is_file():
                top.fail(
                    f"the {role} recording {name} does not exist; check its name, which is relative to the run file"
                )
            if path in seen:
                top.fail(f"{name} is given twice, as {seen[path]} and {role} recording; leave one out")
            seen[path] = role


def _model(table: Table) -> PILFR | Lagged:
    if table.content.get("structure") in ("lti", "linear"):
        given_as = table.content["structure"]
        table.fail(f"'structure' in [model] is {given_as!r}; for a linear model give 'lfr' with operators = 0")
    structure = table.choice("structure", STRUCTURES, "lfr")
    numbers = {"nx": 0, "operators": 0, "channels": 1, "neurons": 0, "hidden": 1, "lags": 1, "input_lags": 1}
    read: dict[str, Any] = {key: table.number(key, None, least, whole=True) for key, least in numbers.items()}
    read["operator"] = table.choice("operator", tuple(OPERATORS), None)
    read["offset"] = table.take("offset", bool)
    read |= {key: table.take(key, dict) for key in ("fix", "bounds", "priors")}
    given, takes = {key: value for key, value in read.items() if value is not None}, TAKES[structure]
    if takes[0] not in given:
        table.fail(f"'{takes[0]}' in [model] is missing; give the number of {SIZE[takes[0]]}")
    table.done()
    for key in given:
        if key not in takes:
            table.fail(f"{key!r} in [model] is not for structure = {structure!r}, which takes {', '.join(takes)}")
    if "neurons" in given and given.get("operator") != "generalized_play":
        table.fail("'neurons' in [model] goes with operator = 'generalized_play'; leave it out")
    try:
        return named_structure(structure, **given)
    except InputError as error:
        table.fail(f"[model]: {str(error).rstrip('.')}")


def _solver(table: Table) -> tuple[Any, dict[str, Any]]:
    search = {
        "starts": table.number("starts", 8, 1, whole=True),
        "start": table.choice("start", STARTS, "grid"),
    }
    if table.choice("linear", ("output-error", BLA), "output-error") == BLA:
        search["linear"] = BLA
    name = table.any("name", "gauss-newton")
    if not isinstance(name, str):
        table.done()
        return name, search
    if name not in ("gauss-newton", "ipopt"):
        table.fail(f"'name' in [solver] is {name!r}; give 'gauss-newton' or 'ipopt'")
    options = {
        "max_iterations": table.number("max_iterations", None, 1, whole=True),
        "tolerance": table.number("tolerance", None, 0.0),
    }
    if table.has("time_limit"):
        table.fail("'time_limit' in [solver] would make the result depend on the machine's load; give max_iterations")
    table.done()
    given = {k: v for k, v in options.items() if v is not None}
    if name == "ipopt":
        return Ipopt(**given), search
    return (GaussNewton(**{"tolerance": POLISH.tolerance, **given}) if given else POLISH), search


def _constraints(table: Table, models: Sequence[PILFR | Lagged | Model]) -> tuple[bool | float, tuple[Constraint, ...]]:
    stable = table.any("spectral_radius", True)
    if not isinstance(stable, bool) and not (isinstance(stable, int | float) and 0 < stable < float("inf")):
        table.fail(f"'spectral_radius' in [constraints] is {shown(stable)}; give a number above zero, true or false")
    found: list[Constraint] = []
    gain, gap = table.any("dc_gain"), table.any("ordered_thresholds", False)
    try:
        if gain is not None:
            given = dict(gain) if isinstance(gain, Mapping) else {"value": gain}
            found.append(dc_gain(given.pop("value"), **given))
        if gap is not False:
            found.append(ordered("r", 0.0 if gap is True else float(gap)))
    except InputError as error:
        table.fail(f"[constraints]: {str(error).rstrip('.')}")
    except (TypeError, ValueError, KeyError):
        table.fail(
            f"[constraints] holds dc_gain = {shown(gain)} and ordered_thresholds = {shown(gap)}; give a number (or "
            "value, within and slope) for the first, and true or a least gap for the second"
        )
    own = table.any("own", [])
    if not isinstance(own, list | tuple) or not all(isinstance(c, Constraint) for c in own):
        table.fail(f"'own' in [constraints] is {shown(own)}; give a list of Constraint, in a Python run file")
    table.done()
    if found and isinstance(models[0], Model):
        table.fail("dc_gain and ordered_thresholds are for a PI-LFR, and the model is your own; use 'own'")
    if any(isinstance(model, Lagged) for model in models) and not isinstance(stable, bool):
        table.fail("'spectral_radius' in [constraints] is not for structure = 'narx' or 'noe', whose state is the past")
    try:
        for model in models:
            check_gain((*found, *own), model.element)
    except InputError as error:
        table.fail(f"[constraints]: {str(error).rstrip('.')}")
    return stable if isinstance(stable, bool) else float(stable), (*found, *own)


def _campaign(table: Table) -> dict[str, Any]:
    limit, retries = table.number("time_limit", None, 0.01), table.number("retries", 2, 0, whole=True)
    table.done()
    return {"time_limit": limit, "retries": retries}


def _regularization(table: Table, files: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    path = table.any("path", False)
    l1, prune = table.number("l1", None, 0.0), table.take("prune", bool)
    margin = table.number("margin", 0.05, 0.0)
    table.done()
    if prune is not None and l1 is None:
        table.fail("'prune' in [regularization] goes with 'l1', a path prunes by itself; give l1, or leave prune out")
    if path is not False:
        usable = path is True or (
            isinstance(path, list | tuple) and path and all(is_number(s) and 0 < s < float("inf") for s in path)
        )
        if not usable:
            table.fail(f"'path' in [regularization] is {shown(path)}; give true, or a list of strengths above zero")
        if l1 is not None:
            table.fail("'path' and 'l1' in [regularization] exclude each other; leave one out")
        if not files["validation"]:
            table.fail("'path' in [regularization] is chosen by validation; give [data] a validation recording")
        path = () if path is True else tuple(float(s) for s in path)
    return {"l1": l1, "prune": prune is not False, "path": None if path is False else path, "margin": margin}
