"""Models on disk: the writing side.

A model file is standard JSON: format and version, structure, parameter values by name with units and standard errors,
sampling, names, and a summary of the training, under the SHA-256 of all of it (`digests`), so that a number that was
changed afterwards does not go unnoticed. It holds no code, and every number comes back to the last digit.
Only the equations of a PI-LFR (Krikelis et al. 2024, Eq. 15-17) can be rebuilt from a file; of a model of the user's
own equations the file holds the values.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ..models import (
    PILFR,
    Combined,
    Envelope,
    GeneralizedPlay,
    Model,
    PrandtlIshlinskii,
    Products,
    StaticNetwork,
)
from ..optimise import Limit, Solution
from .files import ordered_digest, write_atomically

FORMAT = "pilfr_casadi model"
VERSION = 2  # version 1 had no digest; it is still read
HISTORY = ("number", "cost", "seconds", "step", "damping")  # columns of a solver's history


@dataclass(frozen=True, eq=False)
class FitContent:
    """A fit as values, which is all that a model file holds of it.

    Attributes
    ----------
    model : Model
        Closed model at the fitted values.
    structure : PILFR or None
        What the model was made from; None for a model of the user's own equations.
    dt : float
        Duration of a step, s.
    solution : Solution
        The winning solve.
    labels : tuple of str
        Names of the variables in `solution.theta`.
    errors : mapping
        Standard errors by parameter name.
    linear : Model or None
        Linear model that the search began with.
    initial : mapping
        Fingerprint of a training recording -> state with memory at its first sample.
    units : mapping
        Unit by name of an input or output.
    train_nrmse, linear_nrmse : tuple of float
        NRMSE on each training recording, of the model and of the linear one.
    seconds : float
        Time the identification took, s.
    active : tuple of str
        Variables at a bound and constraints at a limit.
    limits : tuple of Limit
        Constraints and active bounds; None in files that were written before these were kept.
    noise : float or None
        Noise that priors are weighed against.
    weights : mapping or None
        Weight of each training recording by its fingerprint.
    starts : tuple of SavedStart
        Every start that was tried.
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


@dataclass(frozen=True, eq=False)
class SavedStart:
    """A start of a multistart search: its seed, the error it reached, how its solve ended, and whether it was drawn."""

    seed: int
    error: float
    solution: Solution
    note: str = ""
    drawn: bool = True


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
    tables = _document(content)
    return _text({**tables, "sha256": ordered_digest(tables)}) + "\n"


def _document(fit: FitContent) -> dict[str, Any]:
    from .._base import __version__

    model, solution = fit.model, fit.solution
    limited = len(solution.theta) + sum(limit.kind == "constraint" for limit in fit.limits or ())
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
            "noise": fit.noise,
            "weights": None if fit.weights is None else dict(fit.weights),
            "linear_nrmse": _plain(fit.linear_nrmse),
            "seconds": fit.seconds,
            "active": list(fit.active),
            "limits": [_limit(limit) for limit in fit.limits or ()],
            "solve": _solve(solution),
            "variables": dict(zip(fit.labels, _plain(solution.theta), strict=True)),
            "multipliers": _plain(solution.multipliers if len(solution.multipliers) == limited else ()),
            "history": {key: _plain([getattr(h, key) for h in solution.history]) for key in HISTORY},
            "starts": [
                {
                    "seed": c.seed,
                    "error": _plain(c.error),
                    "status": c.solution.status.name,
                    "note": c.note,
                    "drawn": c.drawn,
                }
                | _solve(c.solution)
                for c in fit.starts
            ],
        },
    }


def _limit(limit: Any) -> dict[str, Any]:
    """A constraint or an active bound."""
    numbers = {key: _plain(getattr(limit, key), "inf") for key in ("value", "lower", "upper", "multiplier")}
    return {"name": limit.name, "kind": limit.kind, **numbers, "active": limit.active, "met": limit.met}


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
    if isinstance(element, Combined):
        parts = [
            {"name": p.name, "element": _element(p.element), "reads": list(p.reads), "writes": list(p.writes)}
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
