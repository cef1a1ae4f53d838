"""The report of a fit: errors, hysteresis, modes, parameters, and how to use the model.

Errors are NRMSE as in Krikelis et al. (2024), Eq. 27; the pictures of outputs, hysteresis and linear part follow their
Figs. 8-11 and 15.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import plots
from .._base import capitalise, make_folder, multiple, write_atomically
from ..data import DIVERGING, Recording, as_recordings, rmse_per_output
from ..identify import Fit
from ..linear import LinearPart, any_bla
from ..models import BLOCKS, ParameterSet, StaticNetwork
from ..optimise import Status
from .page import (
    Block,
    Code,
    Page,
    Picture,
    Section,
    Table,
    Text,
    label_recording,
    render,
    signal_path,
    status_tone,
    uncertain_text,
)

Records = Recording | Sequence[Recording]
EXCITED_POWER = 0.999  # share of an input's power in its excited band
FAR_OUTSIDE = 2.0  # times the highest excited frequency from which the data say nothing of an oscillation
MOST_DRAWN = 4  # outputs of a recording that are drawn; the table has all of them
QUASI_STATIC = 0.9  # correlation of output and input above which the output is drawn over the input


def fit_report(fit: Fit, train: Records, tests: Records, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` and `model.json` of a fit into a folder; return the page's path.

    `train` are the recordings of the fit, `tests` further recordings that judge it, possibly none. An `InputError` is
    raised if a recording does not match the model, or if the folder cannot be written.
    """
    page = fit_page(fit, train, tests, model_file="model.json")
    target = make_folder(folder)
    fit.save(target / "model.json")
    return write_atomically(target / "report.html", page.html())


def fit_page(fit: Fit, train: Records, tests: Records, *, model_file: str = "model.json") -> Page:
    """Fill the page of a fit; see `fit_report`."""
    used = [fit.matched(r) for r in as_recordings(train)]
    unseen = [fit.matched(r) for r in (as_recordings(tests) if isinstance(tests, Recording) or len(tests) else ())]
    named = [
        (r.with_(name=label_recording(r, role, i, len(recordings))), role)
        for role, recordings in (("training", used), ("test", unseen))
        for i, r in enumerate(recordings)
    ]
    rows = [row for recording, role in named for row in _errors(fit, recording, role)]
    judged = [row for row in rows if row["role"] == "test"] or rows
    drawn = [recording for recording, role in named if role == "test"] or [named[0][0]]
    sections = [
        Section("How well it fits", [Text(_verdict(judged)), _error_table(rows), *_output_pictures(fit, drawn)]),
        *([Section("The hysteresis it found", _hysteresis(fit, drawn))] if fit.model.n_s else []),
        *([Section("The curve it found", _curve(fit, drawn[0]))] if fit.model.n_w == 1 and not fit.model.n_s else []),
        Section("The linear part", _linear_part(fit, used)),
        Section("Constraints and active bounds", _limit_blocks(fit)),
        Section("How it was found", _search(fit)),
        Section("Parameters", _parameter_blocks(fit)),
        Section("How to use it", [Code(render("use_fit.txt", fit=fit, model_file=model_file))]),
    ]
    status = fit.status
    return Page(
        f"Identified model: {signal_path(fit.model.inputs, fit.model.outputs)}",
        [s for s in sections if s.blocks],
        subtitle=_subtitle(fit),
        answer=_answer(judged),
        status=f"{status.value} {status.advice}".strip(),
        tone=_tone(status, judged),
        facts=_facts(fit, rows, judged),
    )


def _errors(fit: Fit, recording: Recording, role: str) -> list[dict[str, Any]]:
    """Compute the errors of each output of a recording over the scored samples (`Fit.scored_from`)."""
    recording = plots.as_scored(fit, recording)
    y, y_hat = recording.y, fit.simulate(recording)
    scored = y[recording.skip :]
    rms, sigma, extent = rmse_per_output(y, y_hat, recording.skip), np.std(scored, axis=0), np.ptp(scored, axis=0)
    linear = np.full(len(rms), np.nan)
    if plots.compares_linear(fit):
        linear = rmse_per_output(y, plots.linear_simulation(fit, recording), recording.skip)
    with np.errstate(divide="ignore", invalid="ignore"):
        return [
            {
                "recording": recording.name,
                "role": role,
                "output": name,
                "unit": recording.units.get(name, fit.units.get(name, "")),
                "seconds": len(scored) * recording.dt,
                "linear": float(linear[i] / sigma[i]),
                "nrmse": float(rms[i] / sigma[i]),
                "rms": float(rms[i]),
                "range": float(100 * rms[i] / extent[i]),
            }
            for i, name in enumerate(recording.outputs)
        ]


def _error_table(rows: list[dict[str, Any]]) -> Table:
    units = {r["unit"] for r in rows}
    unit = f" [{units.pop()}]" if len(units) == 1 and "" not in units else ""
    columns = {  # title: key
        "recording": "recording",
        "output": "output",
        "NRMSE, this model": "nrmse",
        "NRMSE, linear model": "linear",
        f"rms error{unit}": "rms",
        "rms error, % of range": "range",
        "length [s]": "seconds",
        "used for": "role",
    }
    if len({r["output"] for r in rows}) == 1:
        del columns["output"]
    if not any(np.isfinite(r["linear"]) for r in rows):
        del columns["NRMSE, linear model"]
    note = (
        "NRMSE: rms error of the free-run simulation over the standard deviation of the measured output "
        "(0 is perfect, 1 is no better than its mean)."
    )
    if any(r["role"] == "test" for r in rows):
        note += " Test recordings were not used to fit or to choose; samples that estimate a state are not scored."
    cells = [[r[key] for key in columns.values()] for r in rows]
    emphasis = [i for i, r in enumerate(rows) if r["role"] == "test"]
    return Table(list(columns), cells, note=note, emphasis=emphasis, digits=3)


def _verdict(judged: list[dict[str, Any]]) -> str:
    """Write a sentence on the largest error of an output, and the error of a linear model there."""
    kind = "on test recordings" if judged[0]["role"] == "test" else "on its training recordings"
    worst, error, linear = _worst(judged)
    several_outputs = len({r["output"] for r in judged}) > 1
    place = f"{worst['output']} in {worst['recording']}" if several_outputs else worst["recording"]
    text = f"Simulated from its inputs alone, {kind}, the model"
    if not error:
        return f"{text} diverges ({place})." if len(judged) > 1 else f"{text} diverges."
    where = f" at worst ({place})" if len(judged) > 1 else ""
    beside = f"; a linear model of the same order by {linear}" if linear else ""
    return f"{text} is off by {error} of the output's standard deviation{where}{beside}."


def _answer(judged: list[dict[str, Any]]) -> str:
    """Write the headline: the largest error of an output, and the error of a linear model there."""
    where = "unseen data" if judged[0]["role"] == "test" else "the training data; no other data was given"
    _, error, linear = _worst(judged)
    if not error:
        return f"The model diverges on {where}"
    return f"{error} error on {where}" + (f"; a linear model {linear}" if linear else "")


def _worst(judged: list[dict[str, Any]]) -> tuple[dict[str, Any], str, str]:
    """Return the row with the largest error, that error, and the linear model's; empty if it diverges or is unknown."""
    worst = max(judged, key=lambda r: r["nrmse"])
    error, linear = (f"{100 * worst[k]:.2g}\u00a0%" for k in ("nrmse", "linear"))
    return worst, error if worst["nrmse"] < DIVERGING else "", linear if np.isfinite(worst["linear"]) else ""


def _tone(status: Status, judged: list[dict[str, Any]]) -> str:
    """Choose the colour of the headline: good only if the fit converged and beats a linear model and the mean."""
    if not all(r["nrmse"] < DIVERGING for r in judged):
        return "bad"
    helps = all(r["nrmse"] < min(1.0, r["linear"] if np.isfinite(r["linear"]) else 1.0) for r in judged)
    return status_tone(status) if helps or not status.converged else "warning"


def _facts(fit: Fit, rows: list[dict[str, Any]], judged: list[dict[str, Any]]) -> dict[str, str]:
    facts: dict[str, str] = {}
    for role in ("training", "test"):
        values = [r["nrmse"] for r in rows if r["role"] == role]
        if values:
            facts[f"NRMSE, {role}" + (" (worst)" if len(values) > 1 else "")] = f"{max(values):.4f}"
    gain = np.min([r["linear"] / r["nrmse"] if 0 < r["nrmse"] < np.inf else np.nan for r in judged])
    if gain >= 1:
        facts["error against a linear model"] = f"{multiple(gain)} times smaller"
    facts["free parameters"] = str(int(fit.model.parameters.free.sum()))
    if fit.seconds:
        facts["time of the fit"] = f"{fit.seconds:.1f} s"
    return facts


def _subtitle(fit: Fit) -> str:
    element, n_x = fit.model.element, fit.model.n_x
    parts = [f"{n_x} state{'s' * (n_x != 1)}"]
    operator = getattr(element, "operator", None)
    if element is not None and operator is not None:
        channels = f", {element.channels} channels" if element.channels > 1 else ""
        parts.append(f"{getattr(element, 'n', '')} {operator.name.replace('_', ' ')} operators{channels}")
    elif isinstance(element, StaticNetwork):
        parts.append(f"{element.hidden * element.channels} neurons")
    elif element is not None:
        parts.append(type(element).__name__)
    return ", ".join([*parts, f"step {fit.dt:.4g} s ({1 / fit.dt:.4g} Hz)"])


def _search(fit: Fit) -> list[Block]:
    lines = [line.rstrip(".") for line in str(fit).splitlines()[1:] if line]
    out: list[Block] = [Text(". ".join(map(capitalise, lines)) + ".")]
    if fit.solution.history or any(c.solution.history for c in fit.candidates):
        caption = "Training error over iterations: every start, and the last solve of the best one."
        out.append(Picture(plots.convergence(fit), caption, "Convergence of the starts."))
    if fit.candidates:
        timed = any(c.solution.seconds for c in fit.candidates)
        rows = []
        for c in sorted(fit.candidates, key=lambda c: c.error):
            s = c.solution
            status = s.status.name.lower().replace("_", " ")
            rows.append([str(c.seed), c.error, s.iterations, *[s.seconds] * timed, status])
        note = "Errors at the end of the exploration, before the best starts are refined."
        columns = ["start", "training error", "iterations", *["time [s]"] * timed, "status"]
        out.append(Table(columns, rows, "All starts, best first", note, folded=True, digits=3))
    return out


def _output_pictures(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
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
    j = int(np.argmax(correlation)) if correlation else 0
    if correlation and correlation[j] > QUASI_STATIC:
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


def _curve(fit: Fit, recording: Recording) -> list[Block]:
    """Draw the curve of an element without memory."""
    drawn = plots.loop(fit, recording)
    return [Picture(drawn, "The element has no memory: w is a curve over z.", "Curve of the element, w over z.")]


def _hysteresis(fit: Fit, recordings: Sequence[Recording]) -> list[Block]:
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


def _linear_part(fit: Fit, train: Sequence[Recording]) -> list[Block]:
    """Tabulate the modes, and draw the initial linear model over the best linear approximation of the data."""
    out = mode_tables(fit, train)
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


def mode_tables(fit: Fit, train: Sequence[Recording] = ()) -> list[Block]:
    """Tabulate the modes in small motions, in which no operator slips, and in large motions, in which all slip.

    Oscillations that the inputs of `train` do not excite are marked.
    """
    a = fit.parameters.get("A")
    if a is None or not len(a) or a.shape != (fit.model.n_x,) * 2:
        return []
    parts, highest = fit.linear_parts(), _highest_excited(train)
    if len(parts) == 1:
        (only,) = parts.values()
        return [Table(*_modes(only, highest), caption="Modes of the linear part")]
    note = (
        "In small motions no operator reaches its threshold; in large motions all operators slip. With growing "
        "amplitude the hysteresis moves the modes from the first table towards the second."
    )
    small, large = parts.items()
    return [
        Table(*_modes(small[1], highest), caption=f"Modes in {small[0]}"),
        Table(*_modes(large[1], highest), caption=f"Modes in {large[0]}", note=note),
    ]


def _highest_excited(train: Sequence[Recording]) -> float:
    """Find the frequency, Hz, below which the inputs of some recording have nearly all their power."""
    highest = 0.0
    for r in train:
        for column in r.u.T:
            power = np.abs(np.fft.rfft((column - np.mean(column)) * np.hanning(len(column)))) ** 2
            at = int(np.searchsorted(np.cumsum(power), EXCITED_POWER * np.sum(power)))
            highest = max(highest, float(np.fft.rfftfreq(len(column), r.dt)[min(at, len(power) - 1)]))
    return highest or np.inf


def _modes(part: LinearPart, highest: float) -> tuple[list[str], list[list[Any]]]:
    """Return the columns and rows of a table of poles; `highest` is the highest frequency that inputs excite, Hz."""
    rows: list[list[Any]] = []
    for value in sorted(part.poles, key=lambda v: abs(np.angle(v))):
        if value.imag < 0:
            continue
        rate = np.log(complex(value)) / part.dt if value != 0 else complex(np.nan)
        oscillates = value.imag > 0 or value.real < 0
        kind = "oscillation" if oscillates else "decay" if abs(value) < 1 else "drift"
        frequency, damping = (abs(rate) / (2 * np.pi), -rate.real / abs(rate)) if oscillates else (None, None)
        if value.imag == 0 and oscillates:  # no continuous motion gives a negative real pole
            kind, frequency, damping = "alternates with every sample", None, None
        elif frequency is not None and frequency > FAR_OUTSIDE * highest:
            kind = "oscillation, outside the excited band"
        rows.append([kind, frequency, damping, -1 / rate.real if rate.real < 0 else None, abs(value)])
    return ["mode", "frequency [Hz]", "damping ratio", "time constant [s]", "|eigenvalue|"], rows


def _parameter_blocks(fit: Fit) -> list[Block]:
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


def _limit_blocks(fit: Fit) -> list[Block]:
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
