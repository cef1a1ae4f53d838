"""Models on disk: the reading side. JSON in, a `Fit` or one plain sentence out.

Nothing in the file is trusted and nothing in it is executed. Sizes are compared with the numbers that are really there
before anything is built, so a few bytes cannot ask for a model of a billion operators. Every value is checked for its
shape, for being finite, and against the bounds and fixed values of the structure (where it says nothing, `w >= 0` and
`r >= 0` as in Krikelis et al. (2024), Eq. 16).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..models import PILFR, Model, block_shapes
from ..optimise import Iteration, Limit, Solution, Status
from .checked_json import ModelFile
from .loading_elements import element_of
from .model_keys import check_keys
from .saving import HISTORY, FitContent, SavedStart


def read_model_file(path: str | os.PathLike[str], model: Model | PILFR | None = None) -> FitContent:
    """Read what `write_model_file` wrote; simulations are the same to the last digit.

    Parameters
    ----------
    path : path
        The file.
    model : Model or PILFR, optional
        The equations, where the file cannot hold them: a closed model of your own, or a PI-LFR whose element has
        envelope expressions of your own. Its values are replaced by those of the file.

    Returns
    -------
    FitContent
        Solutions of the starts have an empty `theta`: only what they reached is kept.

    Raises
    ------
    InputError
        If the file is missing, unreadable, damaged, of another kind or version, was changed after it was written, does
        not fit `model`, or holds values that are missing, not finite, or outside their bounds.

    Warns
    -----
    UserWarning
        If the file is of the first version of the format, which has no digest to tell changes by.
    """
    file = ModelFile(path, given=model is not None)
    check_keys(file)
    signals, training = file.table(file.content, "model"), file.table(file.content, "training")
    names = _names(file, signals)
    dt = file.number(signals, "dt")
    if dt <= 0:
        file.damaged(f"the step dt is {dt:g} s")
    structure, start = _equations(file, names, model)
    fitted = _with_values(file, start, structure)
    return FitContent(
        model=fitted,
        structure=structure,
        dt=dt,
        linear=_linear(file, structure, names),
        errors=_errors(file, fitted),
        initial=_initial_states(file, fitted.n_x + fitted.n_s),
        units={channel["name"]: channel["unit"] for key in names for channel in signals[key] if channel["unit"]},
        **_training(file, training),
    )


def _training(file: ModelFile, training: dict[str, Any]) -> dict[str, Any]:
    """Read what is kept of the way to the fit, as fields of `FitContent`."""
    variables = file.table(training, "variables")
    theta = file.array(list(variables.values()), (len(variables),), "a variable")
    history = file.table(training, "history")
    numbers = file.array(history.get("number"), (len(file.rows(history, "number")),), "the history")
    columns = [file.array(history.get(key), numbers.shape, "the history", np.inf).tolist() for key in HISTORY[1:]]
    known = "limits" in training
    limits = tuple(_limit(file, row) for row in (file.rows(training, "limits") if known else []))
    solution = replace(
        _solution(file, training, file.table(training, "solve"), theta),
        multipliers=_multipliers(file, training, limits, theta),
        history=tuple(Iteration(int(k), *row) for k, *row in zip(numbers, *columns, strict=True)),
        message=file.text(training, "message"),
    )
    starts = [
        SavedStart(
            seed=file.count(start, "seed"),
            error=file.number(start, "error", np.inf),
            solution=_solution(file, start, start, np.zeros(0)),
            note=file.text(start, "note"),
            drawn=file.entry(start, "drawn", bool, "true or false") if "drawn" in start else True,
        )
        for start in file.rows(training, "starts")
    ]
    errors, linear = (
        file.array(file.rows(training, key) if key in training else [], None, "the training error", np.inf)
        for key in ("nrmse", "linear_nrmse")
    )
    return {
        "solution": solution,
        "labels": tuple(variables),
        "train_nrmse": tuple(errors.ravel().tolist()),
        "linear_nrmse": tuple(linear.ravel().tolist()),
        "limits": limits if known else None,
        "active": tuple(str(name) for name in file.rows(training, "active")),
        "starts": tuple(starts),
        "seconds": file.number(training, "seconds"),
        **_noise_and_weights(file, training),
    }


def _noise_and_weights(file: ModelFile, training: dict[str, Any]) -> dict[str, Any]:
    """Read the noise that priors are weighed against and the recordings' weights; the first files did not say them."""
    if "limits" not in training:
        return {}
    noise = None if training.get("noise") is None else file.number(training, "noise")
    weights = None
    if training.get("weights") is not None:
        rows = file.table(training, "weights")
        weights = {recording: float(file.array(weight, (), "a weight")) for recording, weight in rows.items()}
    if any(number <= 0 for number in (*(() if noise is None else (noise,)), *(weights or {}).values())):
        file.damaged("the noise or a weight of a recording is not above zero")
    return {"noise": noise, "weights": weights}


def _limit(file: ModelFile, row: Any) -> Limit:
    """A constraint or an active bound, where the file has them; no limit is null or infinite."""
    ends = {"lower": -np.inf, "upper": np.inf, "value": np.nan, "multiplier": np.nan}
    return Limit(
        name=file.text(row, "name"),
        kind=file.text(row, "kind"),
        active=file.entry(row, "active", bool, "true or false"),
        met=file.entry(row, "met", bool, "true or false"),
        **{key: file.number(row, key, missing) for key, missing in ends.items()},
    )


def _multipliers(file: ModelFile, training: dict[str, Any], limits: tuple[Limit, ...], theta: np.ndarray) -> np.ndarray:
    """One for each variable and each constraint, or none; the first files did not say what the constraints are."""
    rows = file.rows(training, "multipliers")
    found = file.array(rows, (len(rows),), "a multiplier", np.nan)
    n = len(theta) + sum(limit.kind == "constraint" for limit in limits)
    if found.size not in (0, n) and not ("limits" not in training and found.size > n):
        file.damaged(f"it has {found.size} multipliers of {n} variables and constraints")
    return found


def _initial_states(file: ModelFile, size: int) -> dict[str, np.ndarray]:
    states = file.table(file.content, "initial_states")
    return {recording: file.array(state, (size,), "an initial state") for recording, state in states.items()}


def _names(file: ModelFile, signals: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Names of inputs and outputs."""
    rows = {key: file.rows(signals, key) for key in ("inputs", "outputs")}
    names = {key: tuple(file.text(row, "name") for row in rows[key]) for key in rows}
    for row in (*rows["inputs"], *rows["outputs"]):
        file.text(row, "unit")
    every = [*names["inputs"], *names["outputs"]]
    if not (names["inputs"] and names["outputs"] and all(every)) or len(set(every)) < len(every):
        file.damaged("the names of inputs and outputs are missing or not distinct")
    return names


def _equations(
    file: ModelFile, names: Mapping[str, tuple[str, ...]], given: Model | PILFR | None
) -> tuple[PILFR | None, Model]:
    """The structure (None for a model of the user's own) and the closed model, not yet with the file's values."""
    n_u, n_y = len(names["inputs"]), len(names["outputs"])
    if isinstance(given, Model):
        if (given.n_u, given.n_y) != (n_u, n_y):
            file.damaged(f"it has {given.n_u} inputs and {given.n_y} outputs, the file {n_u} and {n_y}")
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
    element = None if table.get("element") is None else element_of(file, file.table(table, "element"), parameters)
    for name, shape in block_shapes(nx, n_u, n_y, 0 if element is None else element.channels).items():
        file.array(file.table(parameters, name).get("value"), shape, f"parameter {name!r}")
    fixed = {
        name: file.array(value, None, f"the fixed block {name!r}", np.nan)
        for name, value in file.table(table, "fixed").items()
    }
    pairs: dict[str, dict[str, tuple[Any, Any]]] = {}
    for key, ends in (("bounds", (-np.inf, np.inf)), ("priors", (None, None))):
        pairs[key] = {}
        for name, pair in file.table(table, key).items():
            if not isinstance(pair, list) or len(pair) != 2:
                file.damaged(f"the {key} of {name!r} are not a pair")
            low, high = (file.array(v, None, f"the {key} of {name!r}", end) for v, end in zip(pair, ends, strict=True))
            pairs[key][name] = (low, high)
    offset = file.entry(table, "offset", bool, "true or false")
    return file.build(PILFR, nx, element, fixed, pairs["bounds"], pairs["priors"], offset)


def _with_values(file: ModelFile, model: Model, structure: PILFR | None) -> Model:
    """The model at the values of the file, which must be all there, inside their bounds, and equal to what is fixed."""
    table, signals = file.table(file.content, "parameters"), file.table(file.content, "model")
    values = {
        name: file.array(file.table(table, name).get("value"), p.value.shape, f"parameter {name!r}")
        for name, p in model.parameters.items()
    }
    unknown = sorted(set(table) - set(values))
    if unknown:
        file.fail(f"has the parameter {unknown[0]!r}, which its model lacks; give the model it was saved from")
    states, memory = len(file.rows(signals, "states")), file.count(signals, "memory")
    if (states, memory) != (model.n_x, model.n_s):
        file.fail(
            f"is of a model with {states} states and {memory} of memory and this one has {model.n_x} and {model.n_s}; "
            "give the model it was saved from"
        )
    for name, p in model.parameters.items():
        if np.any((values[name] < p.bounds[0]) | (values[name] > p.bounds[1])):
            file.damaged(f"a value of parameter {name!r} lies outside its bounds")
        if structure is not None and name in structure.fixed and np.any((values[name] != p.value)[p.fixed]):
            file.damaged(f"parameter {name!r} differs from the value that the structure fixes")
    return model.with_parameters(model.parameters.change(**{name: {"value": v} for name, v in values.items()}))


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
    table, inputs, outputs = file.table(file.content, "linear"), names["inputs"], names["outputs"]
    model = structure.linear().model(len(inputs), len(outputs), inputs=inputs, outputs=outputs)
    values = {
        name: file.array(table.get(name), p.value.shape, f"the linear model's {name!r}")
        for name, p in model.parameters.items()
    }
    return model.with_parameters(model.parameters.change(**{name: {"value": v} for name, v in values.items()}))


def _solution(file: ModelFile, table: Any, numbers: Any, theta: np.ndarray) -> Solution:
    status = file.text(table, "status")
    if status not in Status.__members__:
        file.damaged(f"the status {status[:40]!r} is unknown")
    return Solution(
        theta=theta,
        cost=file.number(numbers, "cost", np.inf),
        status=Status[status],
        iterations=file.count(numbers, "iterations"),
        seconds=file.number(numbers, "seconds"),
        violation=file.number(numbers, "violation", np.inf),
    )
