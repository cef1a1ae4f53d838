"""The page of a fleet, from its fleet.json: the physics missing in all machines, and the machines that differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import plots
from .._base import with_nan
from .page import Block, Link, Page, Picture, Section, Table, Text, uncertain_text

Column = tuple[str, str, np.ndarray, np.ndarray]  # name, unit, values and standard errors of the machines
MOST_PICTURES = 12  # small pictures of residuals, and of trends
MOST_STRIPS = 6  # values drawn as strips
MOST_ROWS = 30  # machines in an open table; with more, the table is folded


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


def _columns(content: Mapping[str, Any]) -> list[Column]:
    """Return the values of all machines; first the values with the largest spread over their errors."""
    out: list[Column] = []
    for v in content["values"]:
        value, error = (
            np.array([m[kind].get(v["name"]) for m in content["machines"]], dtype=float)
            for kind in ("values", "errors")
        )
        if np.any(np.isfinite(value)):
            out.append((v["name"], v["unit"], value, error))

    def spread_over_error(column: Column) -> float:
        _, _, value, error = column
        known = np.isfinite(value) & np.isfinite(error)
        return float(np.std(value[known]) / max(np.median(error[known]), 1e-300)) if np.any(known) else 0.0

    return sorted(out, key=spread_over_error, reverse=True)


def _names_and_differing(content: Mapping[str, Any]) -> tuple[list[str], np.ndarray]:
    """Return the names of the machines, and for each whether it differs from the others."""
    names = [m["name"] for m in content["machines"]]
    return names, np.array([name in content["differing"] for name in names])


def fleet_map(content: Mapping[str, Any]) -> Any:
    """Draw the machines by the two values with the largest spread over their errors, or one value as a strip."""
    columns = _columns(content)
    if len(columns) < 2:
        return plots.machine_strips(columns, *_names_and_differing(content))
    return plots.machine_map(columns[0], columns[1], *_names_and_differing(content))


def _maps(content: Mapping[str, Any]) -> list[Block]:
    columns = _columns(content)
    if not columns:
        return []
    out: list[Block] = []
    if len(columns) > 1:
        caption = f"The machines by {columns[0][0]} and {columns[1][0]}; ellipses are two standard errors."
        out.append(Picture(fleet_map(content), caption, "map of the machines", wide=True))
    caption = "Values of the machines, sorted by the probability that they differ; bars are two standard errors."
    strips = plots.machine_strips(columns[:MOST_STRIPS], *_names_and_differing(content))
    return [*out, Picture(strips, caption, "values of the machines", wide=True)]


def _rest(content: Mapping[str, Any], residuals: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Draw the residuals of machines with more missing physics, and link their reports."""
    shown = [m for m in content["machines"] if m["rest"] and m["name"] in residuals][:MOST_PICTURES]
    if not shown:
        return []
    figure = plots.small_multiples([residuals[m["name"]] for m in shown], [m["name"] for m in shown])
    caption = "Error with the common physics, over the output's deviation; the band is two deviations of the noise."
    rows = [[_name(m), m["rest"].get("verdict", ""), m["rest"].get("sentence", "")] for m in shown]
    return [
        Picture(figure, caption, "residuals of machines with more missing physics", wide=True),
        Table(["machine", "verdict", "diagnosis of the remaining mismatch"], rows),
    ]


def _drift(content: Mapping[str, Any]) -> list[Block]:
    values = {v["name"]: v for v in content["values"]}
    trends = []
    for m in content["machines"]:
        for label, history in content["histories"].get(m["name"], {}).items():
            population = values[label]["population"]
            mean, deviation = population["mean"], population["deviation"]
            trends.append(
                {
                    **history,
                    "title": m["name"],
                    "name": label,
                    "unit": values[label]["unit"],
                    "regular": [mean - 2 * deviation, mean + 2 * deviation],
                    "slope": m["trends"][label]["slope"],
                }
            )
    if not trends:
        return []
    caption = "Values by recording with two standard errors; regular machines lie in the band."
    if len(trends) > MOST_PICTURES:
        caption += f" {len(trends) - MOST_PICTURES} more are in the tables."
    figure = plots.machine_trends(trends[:MOST_PICTURES])
    return [Picture(figure, caption, "values that drift", wide=True)]


def _values(content: Mapping[str, Any]) -> Table:
    rows = []
    for v in content["values"]:
        population = v["population"]
        mean = uncertain_text(with_nan(population["mean"]), with_nan(population["mean_error"]))
        drifting = sum((m["trends"].get(v["name"], {}).get("probability") or 0) > 0.5 for m in content["machines"])
        rows.append([v["name"], v["unit"], mean, population["deviation"], population["varies"], v["kind"], drifting])
    columns = ["value", "unit", "mean", "between machines", "probability that it varies", "kind", "machines that drift"]
    note = "Standard deviation between regular machines, and the probability that it is not zero."
    return Table(columns, rows, note=note, digits=3)


def _table(content: Mapping[str, Any], machines: Sequence[Mapping[str, Any]], folded: bool) -> Table:
    labels = [v["name"] for v in content["values"]]
    rows = []
    for m in machines:
        values = [uncertain_text(with_nan(m["values"].get(k)), with_nan(m["errors"].get(k))) for k in labels]
        numbers = [m[k] for k in ("probability", "nrmse_before", "nrmse_after", "noise", "gain")]
        rows.append([_name(m), *numbers, *values])
    columns = ["machine", "differs", "refitted", "with the common physics", "noise", "log evidence", *labels]
    emphasis = [i for i, m in enumerate(machines) if m["name"] in content["differing"]]
    note = "The errors are NRMSE. The log evidence compares the common physics with the simulator as given."
    caption = f"{len(machines)} machines, sorted by the probability that they differ"
    return Table(columns, rows, caption=caption, note=note, emphasis=emphasis, folded=folded, digits=3)
