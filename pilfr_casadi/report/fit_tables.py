"""Tables of a fit: the modes of its linear part in small and large motions, its parameters, and how to use it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..identify import Fit
from ..models import BLOCKS, ParameterSet, Play, Stop
from .page import Block, Table, Text, number_text


def mode_tables(fit: Fit) -> list[Block]:
    """Modes in small motions, where no operator slips, and in large ones, where all do."""
    values, element = fit.parameters, fit.model.element
    a = values.get("A")
    if a is None or not len(a) or a.shape != (fit.model.n_x,) * 2:
        return []
    operator = getattr(element, "operator", None)
    if not isinstance(operator, Play | Stop):
        return [Table(*_modes(a, fit.dt), caption="Modes of the linear part")]
    with_slope = a + values["B_w"] @ np.diag(values["w"].sum(axis=1)) @ values["C_z"]
    small, large = (a, with_slope) if isinstance(operator, Play) else (with_slope, a)
    note = (
        "Small motions leave every operator inside its threshold, in large ones all of them slip: the hysteresis moves "
        "the modes from the first table towards the second."
    )
    return [
        Table(*_modes(small, fit.dt), caption="Modes in small motions"),
        Table(*_modes(large, fit.dt), caption="Modes in large motions", note=note),
    ]


def _modes(a: np.ndarray, dt: float) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows of a table of the eigenvalues of a discrete-time A."""
    rows: list[list[Any]] = []
    for value in sorted(np.linalg.eigvals(a), key=lambda v: abs(np.angle(v))):
        if value.imag < 0:
            continue
        rate = np.log(complex(value)) / dt if value != 0 else complex(np.nan)
        oscillates = value.imag > 0 or value.real < 0
        kind = "oscillation" if oscillates else "decay" if abs(value) < 1 else "drift"
        frequency, damping = (abs(rate) / (2 * np.pi), -rate.real / abs(rate)) if oscillates else (None, None)
        rows.append([kind, frequency, damping, -1 / rate.real if rate.real < 0 else None, abs(value)])
    return ["mode", "frequency [Hz]", "damping ratio", "time constant [s]", "|eigenvalue|"], rows


def parameter_blocks(fit: Fit) -> list[Block]:
    """Values with standard errors: vectors and scalars, matrices, and the operators by threshold."""
    parameters = fit.model.parameters
    known = any(np.any(np.isfinite(e)) for e in fit.errors.values())
    basis = (
        " In a PI-LFR they hold in the scale and state basis of these values; entries fixed or at a bound have none."
        if set(BLOCKS) <= set(parameters)
        else ""
    )
    text = (
        f"Values with standard errors (±): what another record with another noise would change.{basis}"
        if known
        else "Values; standard errors are not known."
    )
    layer = [name for name in ("r", "w") if name in parameters and parameters[name].value.ndim == 2]
    matrices = [name for name, p in parameters.items() if min(p.shape) > 1 and name not in layer]
    out: list[Block] = []
    rows = [
        [label, value, error, parameters[name].unit, "yes" if fixed else ""]
        for name in parameters
        if name not in (*layer, *matrices)
        for label, value, error, fixed in _entries(fit, name)
    ]
    if rows:
        kept = [k for k in range(5) if k != 3 or any(row[3] for row in rows)]  # no column of units without units
        columns = ["parameter", "value", "standard error", "unit", "fixed"]
        caption = "Vectors and scalars" if layer else "Parameters"
        out.append(
            Table([columns[k] for k in kept], [[row[k] for k in kept] for row in rows], caption, folded=bool(layer))
        )
    for name in matrices:
        values, errors = parameters[name].value, _errors_of(fit, name)
        rows = [
            [str(i + 1), *(_cell(v, e) for v, e in zip(values[i], errors[i], strict=True))] for i in range(len(values))
        ]
        caption = f"{name}, {values.shape[0]} × {values.shape[1]}"
        out.append(Table(["row", *(str(j + 1) for j in range(values.shape[1]))], rows, caption=caption, folded=True))
    for c in range(fit.model.n_w if layer else 0):
        of = f" of channel {c + 1}" if fit.model.n_w > 1 else ""
        cells = {
            name: [_cell(v, e) for v, e in zip(parameters[name].value[c], _errors_of(fit, name)[c], strict=True)]
            for name in layer
        }
        order = np.argsort(parameters[layer[0]].value[c], kind="stable")
        columns = ["operator", *({"r": "threshold r", "w": "weight w"}[name] for name in layer)]
        rows = [[str(k + 1), *(cells[name][j] for name in layer)] for k, j in enumerate(order)]
        out.append(Table(columns, rows, caption=f"Operators{of}, by threshold", folded=True))
    return [Text(text), *out]


def _errors_of(fit: Fit, name: str) -> np.ndarray:
    return np.broadcast_to(fit.errors.get(name, np.nan), fit.model.parameters[name].value.shape)


def _entries(fit: Fit, name: str) -> list[tuple[str, float, float, bool]]:
    """(label, value, standard error, whether fixed) of every entry of a parameter."""
    p = fit.model.parameters[name]
    columns = [np.ravel(a, order="F") for a in (p.value, _errors_of(fit, name), p.fixed)]
    return [
        (label, float(v), float(e), bool(f))
        for label, v, e, f in zip(ParameterSet({name: p}).labels, *columns, strict=True)
    ]


def _cell(value: float, error: float) -> str:
    """`value ± error`, to two digits of the error."""
    if not np.isfinite(error):
        return number_text(value)
    decimals = 1 - int(np.floor(np.log10(error))) if error > 0 else 9
    if decimals < 8 and 1e-3 <= abs(value) < 1e6:
        texts = (f"{value:.{max(decimals, 0)}f}".replace("-", "−"), f"{error:.{max(decimals, 0)}f}")
    else:
        texts = (number_text(value), number_text(error, 2))
    return "\u00a0±\u00a0".join(texts)


def limit_blocks(fit: Fit) -> list[Block]:
    """Constraints and active bounds with their multipliers; nothing where there are none."""
    if not fit.limits:
        return []
    rows = [
        [
            limit.name,
            "active" if limit.active else "not active" if limit.met else "NOT MET",
            limit.value,
            limit.lower if np.isfinite(limit.lower) else "",
            limit.upper if np.isfinite(limit.upper) else "",
            limit.multiplier,
            limit.kind,
        ]
        for limit in fit.limits
    ]
    note = (
        "Multiplier: how fast the objective, half the mean squared error over the output's variance, would fall if the "
        "limit were moved outwards. A spectral radius is the one of the eigenvalues of the result's own numbers."
    )
    columns = ["limit", "state", "value", "lower", "upper", "multiplier", "kind"]
    return [Table(columns, rows, note=note, emphasis=[i for i, v in enumerate(fit.limits) if not v.met], digits=9)]


def usage(fit: Fit, model_file: str) -> str:
    """Code that loads the model and simulates with it."""
    load = (
        f"pilfr.load({model_file!r})"
        if fit.structure is not None
        else f"pilfr.load({model_file!r}, model=model)  # model: your equations"
    )
    names = f"inputs={list(fit.model.inputs)!r}, outputs={list(fit.model.outputs)!r}"
    return "\n".join(
        [
            "import pilfr_casadi as pilfr",
            "",
            f"fit = {load}",
            f'recording = pilfr.read_csv("new.csv", {names})',
            "print(fit.nrmse(recording))         # error in free-run simulation",
            "y = fit.simulate(recording)         # simulated outputs, (samples, outputs)",
            "",
            "step = fit.to_casadi()              # casadi.Function (x, u) -> (x_next, y), for controllers",
            "x = fit.initial_state(recording)    # linear states, then the operators' memory",
            "x, y0 = step(x, recording.u[0])",
        ]
    )
