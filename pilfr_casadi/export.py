"""Models on disk, and models as CasADi functions.

A model file is standard JSON: format and version, structure, parameter values by name with units and standard errors, sampling,
names, a summary of the training. It holds no code, nothing in it is executed, and every number comes back to the last digit.
Only the equations of a PI-LFR (Krikelis et al. 2024, Eq. 15-17) can be rebuilt from a file; for a model of the user's own
equations the file holds the values, and `load` takes the model beside it. `model_file.py` does the reading.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from .elements import PrandtlIshlinskii
from .model import Model
from .operators import GeneralizedPlay
from .recording import InputError

if TYPE_CHECKING:
    from .fit import Fit
    from .lfr import PILFR

FORMAT = "pilfr_casadi model"
VERSION = 1

AnyPath = str | os.PathLike[str]


def to_casadi(fit: Fit, name: str = "model") -> ca.Function:
    """One step of the fitted model as `casadi.Function (x, u) -> (x_next, y)`, in engineering units.

    Parameters
    ----------
    fit : Fit
        The model; its fitted values become constants of the function.
    name : str
        Name of the function: letters, digits and single underscores, beginning with a letter.

    Returns
    -------
    casadi.Function
        `x` (n_x + n_s,) holds the linear states in the order of `fit.model.states`, then the operators' memory, channel by
        channel and inside a channel in the order of the thresholds `r[i, :]` (the play states, for stops too); `u` (n_u,);
        `x_next` like `x`, `y` (n_y,). A step takes `fit.dt` seconds; `fit.initial_state(recording)` is an `x`.

    Raises
    ------
    InputError
        If CasADi does not take the name.
    """
    if not ca.Function.check_name(name):
        raise InputError(f"The function name {name!r} cannot be used; give letters, digits and single underscores.")
    model = fit.model
    x, u = ca.SX.sym("x", model.n_x + model.n_s), ca.SX.sym("u", model.n_u)
    x_next, y = model.closed(x, u, ca.DM(model.parameters.start))
    return ca.Function(name, [x, u], [x_next, y], ["x", "u"], ["x_next", "y"])


def save(fit: Fit, path: AnyPath) -> None:
    """Write a fit as JSON, atomically: an existing file stays as it is until the new one is complete on disk.

    Parameters
    ----------
    fit : Fit
        What to save. A model of the user's own equations is saved by its values alone; see `load`.
    path : path
        The file, usually `*.json`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_atomically(path, _text(_document(fit)) + "\n")


def load(path: AnyPath, model: Model | PILFR | None = None) -> Fit:
    """Read a fit that `save` wrote; simulations are the same to the last digit.

    Parameters
    ----------
    path : path
        The file.
    model : Model or PILFR, optional
        The equations, where the file cannot hold them: a closed model of your own, or a PI-LFR whose element has envelope
        expressions of your own. Its values are replaced by those of the file.

    Returns
    -------
    Fit
        Of the starts that were tried only what they reached is kept: each candidate has its seed, error and status, an
        empty `theta` and the fitted model.

    Raises
    ------
    InputError
        If the file is missing, unreadable, damaged, of another kind or version, does not fit `model`, or holds values that
        are missing, not finite, or outside their bounds.
    """
    from .model_file import read_fit

    return read_fit(path, model)


def write_atomically(path: AnyPath, content: str | bytes) -> Path:
    """Write a file so that at any moment either the old or the whole new one is there.

    The content goes to a temporary file in the same folder, is forced to disk, and takes the name in one step; on any failure
    the temporary file is removed and an existing file is left untouched.

    Raises
    ------
    InputError
        If the folder does not exist or the file cannot be written there.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file in it.")
    data = content.encode() if isinstance(content, str) else content
    partial = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.tmp")
    try:
        handle = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, target)
        except BaseException:
            with contextlib.suppress(OSError):
                partial.unlink()
            raise
    except OSError as error:
        if error.errno == errno.ENOENT and not target.parent.is_dir():
            raise InputError(
                f"The folder {target.parent} does not exist; make it first or give another path."
            ) from error
        raise InputError(f"{path} cannot be written ({error.strerror or error}); give another path.") from error
    _sync_folder(target.parent)
    return target


def _sync_folder(folder: Path) -> None:
    """Force the new name to disk too, where the system can do that."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _document(fit: Fit) -> dict[str, Any]:
    from . import __version__

    model, solution = fit.model, fit.solution
    return {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {"pilfr_casadi": __version__, "casadi": ca.__version__},
        "model": {
            "dt": fit.dt,
            "inputs": _channels(model.inputs, fit.units),
            "outputs": _channels(model.outputs, fit.units),
            "states": list(model.states),
            "memory": model.n_s,
        },
        "structure": None if fit.structure is None else _structure(fit.structure),
        "parameters": {
            name: {"value": _plain(p.value), "std": _plain(fit.errors.get(name), "inf"), "unit": p.unit}
            for name, p in model.parameters.items()
        },
        "linear": None if fit.linear is None else {k: _plain(p.value) for k, p in fit.linear.parameters.items()},
        "initial_states": {recording: _plain(state) for recording, state in fit.initial.items()},
        "training": {
            "status": solution.status.name,
            "sentence": solution.status.value,
            "message": solution.message,
            "nrmse": _plain(fit.train_nrmse),
            "seconds": fit.seconds,
            "active": list(fit.active),
            "solve": _solve(solution),
            "variables": dict(zip(fit.labels, _plain(solution.theta), strict=True)),
            "multipliers": _plain(solution.multipliers),
            "history": [_plain([h.number, h.cost, h.seconds, h.step, h.damping]) for h in solution.history],
            "starts": [
                {"seed": c.seed, "error": _plain(c.error), "status": c.solution.status.name, "note": c.note}
                | _solve(c.solution)
                for c in fit.candidates
            ],
        },
    }


def _solve(solution: Any) -> dict[str, Any]:
    numbers = {"cost": solution.cost, "violation": solution.violation, "seconds": solution.seconds}
    return {"iterations": int(solution.iterations), **{k: _plain(v) for k, v in numbers.items()}}


def _channels(names: tuple[str, ...], units: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "unit": units.get(name, "")} for name in names]


def _structure(structure: PILFR) -> dict[str, Any]:
    pairs = {"bounds": structure.bounds, "priors": structure.priors}
    return {
        "nx": int(structure.nx),
        "offset": bool(structure.offset),
        "element": None if structure.element is None else _element(structure.element),
        "fixed": {name: _plain(value) for name, value in structure.fixed.items()},
        **{key: {name: [_plain(v) for v in pair] for name, pair in table.items()} for key, table in pairs.items()},
    }


def _element(element: Any) -> dict[str, Any]:
    if not isinstance(element, PrandtlIshlinskii):
        return {"kind": type(element).__name__}
    operator = element.operator
    out = {"kind": element.kind, "operator": operator.name, "n": element.n, "channels": element.channels}
    out["rounded"] = element.rounded
    if isinstance(operator, GeneralizedPlay):
        own = [side for side in ("l", "r") if getattr(operator, f"gamma_{side}") is not None]
        out |= {"neurons": operator.neurons, "expressions": own}
    return out


def _plain(value: Any, infinite: str | None = None) -> Any:
    """Numbers as JSON knows them, arrays as nested lists, nan as null, and what is infinite as null or as a word."""
    if value is None:
        return None
    array = np.asarray(value, dtype=float)
    if array.ndim:
        return [_plain(v, infinite) for v in array]
    number = float(array)
    return number if np.isfinite(number) else infinite if number > 0 else None


def _text(value: Any, depth: int = 0) -> str:
    """JSON with one line for each entry of the outer tables, so that people can read and compare files."""
    if isinstance(value, dict) and value and depth < 2:
        pad = " " * (depth + 1)
        rows = [f"{pad}{json.dumps(key)}: {_text(item, depth + 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(rows) + "\n" + " " * depth + "}"
    return json.dumps(value, allow_nan=False)
