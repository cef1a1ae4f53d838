"""The report of a fit: errors, hysteresis, modes, parameters, and how to use the model.

Errors are NRMSE as in Krikelis et al. (2024), Eq. 27.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import plots
from .._base import make_folder, write_atomically
from ..data import Recording, as_recordings, rmse_per_output
from ..identify import Fit
from ..models import StaticNetwork
from ..optimise import Status
from .fit_sections import curve, hysteresis, limit_blocks, linear_part, output_pictures, parameter_blocks
from .page import Block, Code, Page, Picture, Section, Table, Text, label_recording, render, status_tone

Records = Recording | Sequence[Recording]
RUNAWAY = 1e3  # NRMSE from which the page calls a simulation diverging


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
    used = as_recordings(train)
    unseen = as_recordings(tests) if isinstance(tests, Recording) or len(tests) else ()
    named = [
        (r.with_(name=label_recording(r, role, i, len(recordings))), role)
        for role, recordings in (("training", used), ("test", unseen))
        for i, r in enumerate(recordings)
    ]
    rows = [row for recording, role in named for row in _errors(fit, recording, role)]
    judged = [row for row in rows if row["role"] == "test"] or rows
    drawn = [recording for recording, role in named if role == "test"] or [named[0][0]]
    sections = [
        Section("How well it fits", [Text(_verdict(judged)), _error_table(rows), *output_pictures(fit, drawn)]),
        *([Section("The hysteresis it found", hysteresis(fit, drawn))] if fit.model.n_s else []),
        *([Section("The curve it found", curve(fit, drawn[0]))] if fit.model.n_w == 1 and not fit.model.n_s else []),
        Section("The linear part", linear_part(fit, used)),
        Section("Constraints and active bounds", limit_blocks(fit)),
        Section("How it was found", _search(fit)),
        Section("Parameters", parameter_blocks(fit)),
        Section("How to use it", [Code(render("use_fit.txt", fit=fit, model_file=model_file))]),
    ]
    status = fit.status
    return Page(
        f"Identified model: {', '.join(fit.model.inputs)} → {', '.join(fit.model.outputs)}",
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
    worst = max(judged, key=lambda r: r["nrmse"])
    several_outputs = len({r["output"] for r in judged}) > 1
    place = f"{worst['output']} in {worst['recording']}" if several_outputs else worst["recording"]
    text = f"Simulated from its inputs alone, {kind}, the model"
    if not worst["nrmse"] < RUNAWAY:
        return f"{text} diverges ({place})." if len(judged) > 1 else f"{text} diverges."
    text += f" is off by {100 * worst['nrmse']:.2g}\u00a0% of the output's standard deviation"
    text += f" at worst ({place})" if len(judged) > 1 else ""
    if np.isfinite(worst["linear"]):
        text += f"; a linear model of the same order by {100 * worst['linear']:.2g}\u00a0%"
    return f"{text}."


def _answer(judged: list[dict[str, Any]]) -> str:
    """Write the headline: the largest error of an output, and the error of a linear model there."""
    where = "unseen data" if judged[0]["role"] == "test" else "the training data; no other data was given"
    worst = max(judged, key=lambda r: r["nrmse"])
    if not worst["nrmse"] < RUNAWAY:
        return f"The model diverges on {where}"
    linear = f"; a linear model {100 * worst['linear']:.2g}\u00a0%" if np.isfinite(worst["linear"]) else ""
    return f"{100 * worst['nrmse']:.2g}\u00a0% error on {where}{linear}"


def _tone(status: Status, judged: list[dict[str, Any]]) -> str:
    """Choose the colour of the headline: good only if the fit converged and beats a linear model and the mean."""
    if not all(r["nrmse"] < RUNAWAY for r in judged):
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
        facts["error against a linear model"] = f"{gain:.2g} times smaller"
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
    lines = [line for line in str(fit).splitlines()[1:] if line]
    out: list[Block] = [Text(". ".join(line[0].upper() + line[1:] for line in lines) + ".")]
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
