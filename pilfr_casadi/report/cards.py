"""Cards: summaries of a recording, a simulator, a fit, a diagnosis or a comparison for notebooks.

A card is one piece of HTML without scripts; its layout is `templates/card.html`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import with_nan
from ..data import COURSES, Recording
from ..diagnose import Diagnosis
from ..identify import Comparison, Fit
from ..laws import display_name
from ..models import ParameterSet
from ..simulators import PARAMETER, Simulator, kind_of, name_at
from .diagnosis_tables import facts, headline, tone
from .page import Table, number_text, render, signal_path, status_tone, uncertain_text

MOST_ROWS = 12  # rows of a table; the printed object has them all
LINE_BINS = 90  # stretches of a line, each drawn from its smallest to its largest value
LINE_WIDTH, LINE_HEIGHT = 180, 26  # of the line of a signal, in pixels


@dataclass(frozen=True)
class Card:
    """The content of a card, with the names of `Page`; `lines` are the points of a signal's line, one for each row."""

    title: str
    subtitle: str = ""
    status: str = ""
    tone: str = "plain"
    facts: Mapping[str, str] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    lines: Sequence[str] = ()

    def html(self) -> str:
        """Fill the template."""
        return render("card.html", card=self)


def recording_card(recording: Recording) -> str:
    """Show a recording: its channels with their range, and each as a line over time."""
    r = recording
    rows: list[list[Any]] = []
    lines = []
    for role, names, values in (("input", r.inputs, r.u), ("output", r.outputs, r.y)):
        for name, x in zip(names[:MOST_ROWS], values.T, strict=False):
            statistics = [float(v) for v in (x.min(), x.mean(), x.max(), x.std())]
            rows.append([name, role, r.units.get(name, ""), *statistics])
            lines.append(_line_points(x))
    start = {"estimate": "unknown, to be estimated", "zero": "zero", "periodic": "periodic steady state"}
    properties = [
        f"{len(r)} samples, step {r.dt:.6g} s, {len(r) * r.dt:.4g} s",
        f"initial state {start.get(r.begins, 'given')}",
        f"inputs {COURSES[r.hold].words} between samples" if r.hold else "hold not stated",
        *([f"period {r.period} samples"] if r.period else []),
        *([f"first {r.skip} samples not scored"] if r.skip else []),
    ]
    columns = ["channel", "role", "unit", "smallest", "mean", "largest", "deviation"]
    table = Table(columns, rows, note=_count_omitted(r.n_u + r.n_y, rows))
    return Card(f"Recording {r.name}".strip(), "; ".join(properties), tables=[table], lines=lines).html()


def _count_omitted(count: int, rows: Sequence[Any]) -> str:
    """Say how many of `count` rows a table omits."""
    return f"and {count - len(rows)} more" if count > len(rows) else ""


def _line_points(x: np.ndarray) -> str:
    """Compute the points of a line that draws a signal, from the smallest to the largest value of each stretch."""
    parts = np.array_split(x, min(LINE_BINS, len(x)))
    ends = np.array([(p.min(), p.max()) if p.argmin() <= p.argmax() else (p.max(), p.min()) for p in parts]).ravel()
    low, high = float(ends.min()), float(ends.max())
    across = np.linspace(0, LINE_WIDTH, len(ends))
    up = LINE_HEIGHT - 1 - (LINE_HEIGHT - 2) * (ends - low) / ((high - low) or 1.0)
    return " ".join(f"{a:.0f},{b:.0f}" for a, b in zip(across, up, strict=True))


def simulator_card(simulator: Simulator) -> str:
    """Show a simulator: its signals, ports, laws in ports, and parameters with bounds."""
    s = simulator
    properties = {
        "states": ", ".join(s.states) or "none",
        "inputs": ", ".join(s.inputs) or "none",
        "outputs": ", ".join(s.output_names),
        "ports": ", ".join(p.name for p in s.ports) or "one for each state equation",
    }
    if s.elements:
        properties["laws in ports"] = ", ".join(e.words for e in s.elements)
    title = "Simulator in discrete time" if s.discrete else "Simulator"
    return Card(title, facts=properties, tables=_parameter_tables(s.readable_parameters(), {})).html()


def _parameter_tables(parameters: ParameterSet, errors: Mapping[str, np.ndarray]) -> list[Table]:
    """Tabulate scalar parameters with unit, bounds, and known standard errors."""
    scalars = {name: p for name, p in parameters.items() if p.value.ndim == 0}
    rows = []
    for name, p in list(scalars.items())[:MOST_ROWS]:
        error = float(errors.get(name, np.full((), np.nan)))
        bounds = " … ".join(number_text(float(bound)) for bound in p.bounds).replace("inf", "∞")
        rows.append([name, uncertain_text(float(p.value), error), p.unit, "fixed" if np.all(p.fixed) else bounds])
    note = _count_omitted(len(parameters), rows)
    return [Table(["parameter", "value", "unit", "bounds"], rows, note=note)] if rows else []


def fit_card(fit: Fit) -> str:
    """Show a fit: how it ended, its errors, and the parameters of a simulator."""
    m = fit.model
    properties = {"NRMSE, training": ", ".join(f"{e:.4f}" for e in fit.train_nrmse)}
    if fit.linear_nrmse:
        properties["the linear model alone"] = ", ".join(f"{e:.4f}" for e in fit.linear_nrmse)
    properties["free parameters"] = str(int(m.parameters.free.sum()))
    if fit.seconds:
        properties["time"] = f"{fit.seconds:.1f} s"
    size = f"{m.n_x} states" + (f" and {m.n_s} of memory" if m.n_s else "") + f", step {fit.dt:.4g} s"
    limits = f"at a bound: {', '.join(fit.active[:MOST_ROWS])}" if fit.active else ""
    tables = _parameter_tables(fit.simulator.readable_parameters(), fit.errors) if fit.simulator else []
    return Card(
        f"Fit: {signal_path(m.inputs, m.outputs)}",
        "; ".join(filter(None, (size, limits))),
        f"{fit.status.value} {fit.status.advice}".strip(),
        status_tone(fit.status),
        properties,
        tables,
    ).html()


def diagnosis_card(diagnosis: Diagnosis) -> str:
    """Show a diagnosis: the verdict with its errors, and each effect with its parameters."""
    rows = []
    for e in diagnosis.effects:
        values = []
        for name, p in e.parameters.items():
            values.append(f"{name} = {uncertain_text(p['value'], with_nan(p['std']))} {p['unit']}".strip())
        varies = kind_of(e.port) == PARAMETER
        law = name_at(e.port, e.law, e.form) if varies else display_name(e.form or e.law)
        rows.append([law, e.port, f"{e.confidence:.2f}", ", ".join(values)])
    note = " ".join(diagnosis.warnings())
    tables = [Table(["law", "port", "confidence", "values"], rows, note=note)] if rows else []
    return Card("Diagnosis", "", headline(diagnosis), tone(diagnosis), facts(diagnosis), tables).html()


def comparison_card(comparison: Comparison) -> str:
    """Show a comparison: the table of errors."""
    name = comparison.recording.name
    table = Table(comparison.columns, comparison.rows, note=comparison.note)
    return Card(f"Comparison on {name or 'the recording'}", tables=[table]).html()
