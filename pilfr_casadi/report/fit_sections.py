"""The sections of a fit's page: outputs, hysteresis, linear part (Krikelis et al. 2024, Figs. 8-11, 15), parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import plots
from ..data import Recording
from ..identify import Fit
from ..linear import LinearPart, any_bla
from ..models import BLOCKS, ParameterSet
from .page import Block, Picture, Table, Text, uncertain_text

MOST_DRAWN = 4  # outputs of a recording that are drawn; the table has all of them
QUASI_STATIC = 0.9  # correlation of output and input above which the output is drawn over the input


def output_pictures(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
    """Draw the outputs of recordings, measured and simulated."""
    out: list[Block] = []
    for r in recordings:
        for i in range(min(r.n_y, MOST_DRAWN)):
            out += _draw_output(fit, r, i)
        if r.n_y > MOST_DRAWN:
            out.append(Text(f"The first {MOST_DRAWN} of {r.n_y} outputs are drawn; the table has them all."))
    return out


def _draw_output(fit: Fit, r: Recording, i: int) -> list[Block]:
    """Draw one output: over its input for a quasi-static device, over time for any other."""
    name = f"{r.outputs[i]} in {r.name}"
    correlation = [abs(np.corrcoef(u, r.y[:, i])[0, 1]) if np.ptp(u) > 0 else 0.0 for u in r.u.T]
    j = int(np.argmax(correlation))
    if correlation[j] > QUASI_STATIC:
        across = r.inputs[j]
        drawn = plots.output_over_input(fit, r, input=j, output=i)
        whole = Picture(drawn, f"{name}, over {across}.", f"Measured and simulated {name} over {across}.")
    else:
        caption = f"{name}: the whole recording, with the errors of the models."
        whole = Picture(plots.time(fit, r, output=i), caption, f"Output and errors of {name} over time.")
    swings, error = plots.traces(fit, r, output=i), plots.remains(fit, r, output=i)
    spectrum = plots.spectrum(fit, r, output=i)
    around = f"{name}, measured and simulated, around the largest excursion."
    over = f"{name}: output and errors over frequency."
    return [
        Picture(swings, around, f"Simulated over measured {name}.", views={"largest swing": swings}),
        whole,
        Picture(error, f"{name}: the error of this model, enlarged.", f"Error of {name} over time."),
        Picture(spectrum, over, f"Amplitude densities of output and errors of {name}."),
    ]


def curve(fit: Fit, recording: Recording) -> list[Block]:
    """Draw the curve of an element without memory."""
    drawn = plots.loop(fit, recording)
    return [Picture(drawn, "The element has no memory: w is a curve over z.", "Curve of the element, w over z.")]


def hysteresis(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
    """Draw loops, loading curves and weights of every channel of the element."""
    intro = (
        "The element maps its local input z to w. Its scale is arbitrary, because the linear part can absorb it, so "
        "compare the shape, not the size."
    )
    out: list[Block] = [Text(intro)]
    for c in range(fit.model.n_w):
        of = f" of channel {c + 1}" if fit.model.n_w > 1 else ""
        loop, bare = (plots.loop(fit, recordings[0], channel=c, bare=k) for k in (False, True))
        curve = plots.loading_curve(fit, recordings, channel=c)
        without = f"The loop{of} without its mean slope: the hysteresis alone."
        out += [
            Picture(loop, f"The identified loop{of}: w over z.", f"Hysteresis loop{of}, w over z."),
            Picture(bare, without, f"Hysteresis loop{of} without its slope."),
            Picture(curve, f"Loading curve{of}: w while z grows from rest.", f"Loading curve{of}."),
        ]
        if {"r", "w"} <= set(fit.parameters):
            caption = f"Weights of the operators{of} over their thresholds, with standard errors where known."
            drawn = plots.weights(fit, recordings, channel=c)
            out.append(Picture(drawn, caption, f"Weights{of} over thresholds."))
    return out


def linear_part(fit: Fit, train: Sequence[Recording]) -> list[Block]:
    """Tabulate the modes, and draw the initial linear model over the best linear approximation of the data."""
    out = mode_tables(fit)
    if out:
        caption = "Poles in the z-plane with frequency and damping ratio, and zeros from the first input to the output."
        out.append(Picture(plots.pole_zero(fit.linear_parts()), caption, "Poles and zeros."))
    linear = fit.linear if fit.linear is not None else fit.model if fit.model.element is None else None
    if linear is None or "A" not in linear.parameters or (bla := any_bla(train)) is None:
        return out
    for i in range(min(bla.n_y, 2)):
        for j in range(min(bla.n_u, 2)):
            if bla.var_total is not None and np.mean(bla.var_total[:, i, j] < np.abs(bla.G[:, i, j]) ** 2) < 0.5:
                continue  # the training data excite too few frequencies for this response
            units = [fit.units.get(n, "") for n in (fit.model.outputs[i], fit.model.inputs[j])]
            unit = "/".join(units) if all(units) else ""
            figure = plots.best_linear_approximation(bla, linear, output=i, input=j, unit=unit)
            of = f"{fit.model.outputs[i]} over {fit.model.inputs[j]}"
            caption = f"Best linear approximation of {of} in the training data, and the initial linear model."
            out.append(Picture(figure, caption, f"Frequency response, {of}."))
    return out


def mode_tables(fit: Fit) -> list[Block]:
    """Tabulate the modes in small motions, in which no operator slips, and in large motions, in which all slip."""
    a = fit.parameters.get("A")
    if a is None or not len(a) or a.shape != (fit.model.n_x,) * 2:
        return []
    parts = fit.linear_parts()
    if len(parts) == 1:
        return [Table(*_modes(*parts.values()), caption="Modes of the linear part")]
    note = (
        "In small motions no operator reaches its threshold; in large motions all operators slip. With growing "
        "amplitude the hysteresis moves the modes from the first table towards the second."
    )
    small, large = parts.items()
    return [
        Table(*_modes(small[1]), caption=f"Modes in {small[0]}"),
        Table(*_modes(large[1]), caption=f"Modes in {large[0]}", note=note),
    ]


def _modes(part: LinearPart) -> tuple[list[str], list[list[Any]]]:
    """Return the columns and rows of a table of poles."""
    rows: list[list[Any]] = []
    for value in sorted(part.poles, key=lambda v: abs(np.angle(v))):
        if value.imag < 0:
            continue
        rate = np.log(complex(value)) / part.dt if value != 0 else complex(np.nan)
        oscillates = value.imag > 0 or value.real < 0
        kind = "oscillation" if oscillates else "decay" if abs(value) < 1 else "drift"
        frequency, damping = (abs(rate) / (2 * np.pi), -rate.real / abs(rate)) if oscillates else (None, None)
        rows.append([kind, frequency, damping, -1 / rate.real if rate.real < 0 else None, abs(value)])
    return ["mode", "frequency [Hz]", "damping ratio", "time constant [s]", "|eigenvalue|"], rows


def parameter_blocks(fit: Fit) -> list[Block]:
    """Tabulate values with standard errors: vectors and scalars, matrices, and the operators by threshold."""
    parameters = fit.model.parameters
    known = any(np.any(np.isfinite(e)) for e in fit.errors.values())
    basis = (
        " The errors of a PI-LFR hold for the scale and state basis of these values; entries that are fixed or at a "
        "bound have no error."
        if set(BLOCKS) <= set(parameters)
        else ""
    )
    text = "Values; standard errors are not known."
    if known:
        text = f"Values with standard errors (±), the spread over recordings that differ in noise.{basis}"
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
        columns = ["parameter", "value", "standard error", "unit", "fixed"]
        if not any(row[3] for row in rows):
            columns, rows = columns[:3] + columns[4:], [row[:3] + row[4:] for row in rows]
        out.append(Table(columns, rows, "Vectors and scalars" if layer else "Parameters", folded=bool(layer)))
    for name in matrices:
        values, errors = parameters[name].value, _errors_of(fit, name)
        rows = [
            [str(i + 1), *(uncertain_text(v, e) for v, e in zip(values[i], errors[i], strict=True))]
            for i in range(len(values))
        ]
        caption = f"{name}, {values.shape[0]} × {values.shape[1]}"
        out.append(Table(["row", *(str(j + 1) for j in range(values.shape[1]))], rows, caption=caption, folded=True))
    for c in range(fit.model.n_w if layer else 0):
        of = f" of channel {c + 1}" if fit.model.n_w > 1 else ""
        cells = {
            name: [
                uncertain_text(v, e) for v, e in zip(parameters[name].value[c], _errors_of(fit, name)[c], strict=True)
            ]
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
    """Return (label, value, standard error, fixed) for every entry of a parameter."""
    p = fit.model.parameters[name]
    columns = [np.ravel(a, order="F") for a in (p.value, _errors_of(fit, name), p.fixed)]
    return [
        (label, float(v), float(e), bool(f))
        for label, v, e, f in zip(ParameterSet({name: p}).labels, *columns, strict=True)
    ]


def limit_blocks(fit: Fit) -> list[Block]:
    """Tabulate constraints and active bounds with their multipliers; empty without limits."""
    if not fit.limits:
        return []
    rows = []
    for v in fit.limits:
        state = "active" if v.active else "not active" if v.met else "NOT MET"
        lower, upper = (end if np.isfinite(end) else "" for end in (v.lower, v.upper))
        rows.append([v.name, state, v.value, lower, upper, v.multiplier, v.kind])
    note = (
        "Multiplier: the decrease of the objective (half the mean square error divided by the output's variance) per "
        "unit by which the limit is relaxed. Spectral radii are computed from the eigenvalues of the fitted matrices."
    )
    columns = ["limit", "state", "value", "lower", "upper", "multiplier", "kind"]
    return [Table(columns, rows, note=note, emphasis=[i for i, v in enumerate(fit.limits) if not v.met], digits=9)]
