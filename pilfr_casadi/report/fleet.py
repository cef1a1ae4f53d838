"""The page of a fleet, from the content of its fleet.json: what all machines lack, and which of them differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import plots
from .page import Block, Link, Page, Picture, Section, Table, Text, uncertain_text

MOST_PICTURES = 12  # small pictures of residuals, and of trends
MOST_STRIPS = 6  # values that are drawn as strips
MOST_ROWS = 30  # machines in the open table; a folded one has all


def fleet_page(content: Mapping[str, Any], residuals: Mapping[str, Mapping[str, Any]]) -> Page:
    """Fill the page of a fleet.

    Parameters
    ----------
    content : mapping
        The content of fleet.json.
    residuals : mapping
        `seconds`, `low`, `high` and `noise` of the residual by machine; see `plots.small_multiples`.
    """
    machines, common = content["machines"], content["common"]
    differs = len(content["differing"]) + len(content["drifting"]) > 0
    sections = [
        Section("Machines that differ", _differing(content)),
        Section("Map of the machines", _maps(content)),
        Section("What is left", _rest(content, residuals)),
        Section("Drift", _drift(content)),
        Section("Values of regular machines", [_values(content)] if content["values"] else []),
        Section("All machines", [_table(content, machines, folded=len(machines) > MOST_ROWS)]),
    ]
    facts = {
        "machines": str(len(machines)),
        "missing in all": common["words"] or "nothing",
        "differ": str(len(content["differing"])),
        "drift": str(len(content["drifting"])),
    }
    return Page(
        "A fleet of machines",
        [s for s in sections if s.blocks],
        subtitle=f"{len(machines)} machines; diagnosed alone: {', '.join(common['sample'])}",
        status=content["sentence"],
        tone="warning" if differs else "good",
        facts=facts,
    )


def _differing(content: Mapping[str, Any]) -> list[Block]:
    shown = [m for m in content["machines"] if m["reasons"] or m["failed"]]
    if not shown:
        return [Text("No machine differs from the others.")]
    rows = [[_name(m), text, p] for m in shown for text, p in m["reasons"] or [(m["failed"], 1.0)]]
    note = "A row is shown if it is more likely than not. Names with a link lead to the machine's own report."
    return [Table(["machine", "finding", "probability"], rows, note=note, digits=3)]


def _name(machine: Mapping[str, Any]) -> str:
    return Link(machine["name"], machine["report"].replace(" ", "%20")) if machine["report"] else machine["name"]


def _columns(content: Mapping[str, Any]) -> list[tuple[str, str, np.ndarray, np.ndarray]]:
    """Return the values of all machines, those first that vary most over their errors."""
    out = []
    for v in content["values"]:
        own = [[m[kind].get(v["name"]) for m in content["machines"]] for kind in ("values", "errors")]
        value, error = (np.array(column, dtype=float) for column in own)
        if np.any(np.isfinite(value)):
            out.append((v["name"], v["unit"], value, error))

    def telling(column: tuple[str, str, np.ndarray, np.ndarray]) -> float:
        known = np.isfinite(column[2]) & np.isfinite(column[3])
        return float(np.std(column[2][known]) / max(np.median(column[3][known]), 1e-300)) if np.any(known) else 0.0

    return sorted(out, key=telling, reverse=True)


def fleet_map(content: Mapping[str, Any]) -> Any:
    """Draw the machines by their two most telling values, or as a strip where there is only one."""
    columns = _columns(content)
    names = [m["name"] for m in content["machines"]]
    differs = np.array([name in content["differing"] for name in names])
    if len(columns) < 2:
        return plots.machine_strips(columns, names, differs)
    return plots.machine_map(columns[0], columns[1], names, differs)


def _maps(content: Mapping[str, Any]) -> list[Block]:
    columns = _columns(content)
    if not columns:
        return []
    names = [m["name"] for m in content["machines"]]
    differs = np.array([name in content["differing"] for name in names])
    out: list[Block] = []
    if len(columns) > 1:
        told = f"The machines by {columns[0][0]} and {columns[1][0]}; ellipses are two standard errors."
        out.append(Picture(fleet_map(content), told, "map of the machines", wide=True))
    strips = plots.machine_strips(columns[:MOST_STRIPS], names, differs)
    caption = "Values of the machines, the surest to differ first; bars are two standard errors."
    return [*out, Picture(strips, caption, "values of the machines", wide=True)]


def _rest(content: Mapping[str, Any], residuals: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Draw the residuals of machines that lack more, and link their reports."""
    shown = [m for m in content["machines"] if m["rest"] and m["name"] in residuals][:MOST_PICTURES]
    if not shown:
        return []
    figure = plots.small_multiples([residuals[m["name"]] for m in shown], [m["name"] for m in shown])
    caption = "Error with the common physics, over the output's deviation; the band is two deviations of the noise."
    rows = [[_name(m), m["rest"].get("verdict", ""), m["rest"].get("sentence", "")] for m in shown]
    return [
        Picture(figure, caption, "residuals of machines that lack more", wide=True),
        Table(["machine", "verdict", "diagnosis of what is left"], rows),
    ]


def _drift(content: Mapping[str, Any]) -> list[Block]:
    populations = {v["name"]: v for v in content["values"]}
    found = []
    for m in content["machines"]:
        for label, history in content["histories"].get(m["name"], {}).items():
            own = populations[label]["population"]
            band = [own["mean"] - 2 * own["deviation"], own["mean"] + 2 * own["deviation"]]
            more = {"title": m["name"], "name": label, "unit": populations[label]["unit"], "regular": band}
            found.append({**history, **more, "slope": m["trends"][label]["slope"]})
    if not found:
        return []
    caption = "Values by recording with two standard errors; the band holds regular machines."
    left = f" {len(found) - MOST_PICTURES} more are in the tables." if len(found) > MOST_PICTURES else ""
    figure = plots.machine_trends(found[:MOST_PICTURES])
    return [Picture(figure, caption + left, "values that drift", wide=True)]


def _values(content: Mapping[str, Any]) -> Table:
    rows = []
    for v in content["values"]:
        own = v["population"]
        mean = uncertain_text(_number(own["mean"]), _number(own["mean_error"]))
        drifting = sum((m["trends"].get(v["name"], {}).get("probability") or 0) > 0.5 for m in content["machines"])
        rows.append([v["name"], v["unit"], mean, own["deviation"], own["varies"], v["kind"], drifting])
    columns = ["value", "unit", "mean", "between machines", "probability that it varies", "kind", "machines that drift"]
    note = "Standard deviation between regular machines, and the probability that it is not zero."
    return Table(columns, rows, note=note, digits=3)


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _table(content: Mapping[str, Any], machines: Sequence[Mapping[str, Any]], folded: bool) -> Table:
    labels = [v["name"] for v in content["values"]]
    rows = []
    for m in machines:
        values = [uncertain_text(_number(m["values"].get(k)), _number(m["errors"].get(k))) for k in labels]
        numbers = [m[k] for k in ("probability", "nrmse_before", "nrmse_after", "noise", "gain")]
        rows.append([_name(m), *numbers, *values])
    columns = ["machine", "differs", "refitted", "with the common physics", "noise", "log evidence", *labels]
    emphasis = [i for i, m in enumerate(machines) if m["name"] in content["differing"]]
    note = "The errors are NRMSE. The log evidence is that of the common physics against the simulator as given."
    caption = f"{len(machines)} machines, the surest to differ first"
    return Table(columns, rows, caption=caption, note=note, emphasis=emphasis, folded=folded, digits=3)
