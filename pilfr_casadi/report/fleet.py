"""The page of a fleet, and a page of each machine, from the fleet.json of the fleet."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import plots
from .._base import with_nan
from .page import Block, Link, Page, Picture, Section, Table, Text, number_text, uncertain_text

Column = tuple[str, str, np.ndarray, np.ndarray]  # name, unit, values and standard errors of the machines
MOST_PICTURES = 12  # small pictures of residuals, and of trends
MOST_STRIPS = 6  # values drawn as strips
RESIDUAL = "Error with the common physics, over the output's deviation; the band is two deviations of the noise."
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
        Section("Drift", _drift(content, machines)),
        Section("Values of regular machines", [_values(content)] if content["values"] else []),
        Section("All machines", [_table(content)]),
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
    rows = [[_name(m), _with_minus(text), p] for m in shown for text, p in m["reasons"] or [(m["failed"], 1.0)]]
    note = "A row is shown if it is more likely than not. Each name leads to the machine's own page."
    return [Table(["machine", "finding", "probability"], rows, note=note, digits=3)]


def _with_minus(text: str) -> str:
    """Write the minus signs of numbers in a sentence as in print; hyphens of names stay."""
    return re.sub(r"(?<=\s)-(?=\d)", "−", text)


def _name(machine: Mapping[str, Any]) -> Link:
    return _link(machine["name"], machine["page"])


def _link(text: str, path: str) -> Link:
    return Link(text, path.replace(" ", "%20"))


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
        out.append(Picture(fleet_map(content).axes[0], caption, "map of the machines", wide=True))
    for column in columns[:MOST_STRIPS]:
        caption = f"{column[0]} of the machines, the most probable to differ first; bars are two standard errors."
        strip = plots.machine_strips([column], *_names_and_differing(content))
        out.append(Picture(strip.axes[0], caption, f"{column[0]} of the machines"))
    return out


def _rest(content: Mapping[str, Any], residuals: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Draw the residuals of machines with more missing physics, and link their pages."""
    shown = [m for m in content["machines"] if m["rest"] and m["name"] in residuals][:MOST_PICTURES]
    if not shown:
        return []
    figure = plots.small_multiples([residuals[m["name"]] for m in shown], [m["name"] for m in shown])
    rows = [[_name(m), m["rest"].get("verdict", "").replace("-", " "), m["rest"].get("sentence", "")] for m in shown]
    return [
        Picture(_alone(figure), RESIDUAL, "residuals of machines with more missing physics", wide=len(shown) > 1),
        Table(["machine", "verdict", "diagnosis of the remaining mismatch"], rows),
    ]


def _drift(content: Mapping[str, Any], machines: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Draw the values of machines that drift."""
    values = {v["name"]: v for v in content["values"]}
    trends = []
    for m in machines:
        for label, history in content["histories"].get(m["name"], {}).items():
            population = values[label]["population"]
            mean, deviation = population["mean"], population["deviation"]
            trends.append(
                {
                    **history,
                    "title": m["name"],
                    "per": m["trends"][label]["per"],
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
    return [Picture(_alone(figure), caption, "values that drift", wide=len(trends) > 1)]


def _alone(figure: Any) -> Any:
    """Return the axes of a figure with one picture, of which a page makes a chart; otherwise the figure."""
    return figure.axes[0] if len(figure.axes) == 1 else figure


def _values(content: Mapping[str, Any]) -> Table:
    rows = []
    for v in content["values"]:
        population = v["population"]
        mean = uncertain_text(with_nan(population["mean"]), with_nan(population["mean_error"]))
        drifting = sum(v["name"] in history for history in content["histories"].values())
        rows.append([v["name"], v["unit"], mean, population["deviation"], population["varies"], v["kind"], drifting])
    columns = ["value", "unit", "mean", "between machines", "probability that it varies", "kind", "machines that drift"]
    note = "Standard deviation between regular machines, and the probability that it is not zero."
    return Table(columns, rows, note=note, digits=3)


def _table(content: Mapping[str, Any]) -> Table:
    machines, labels = content["machines"], [v["name"] for v in content["values"]]
    rows = []
    for m in machines:
        values = [uncertain_text(with_nan(m["values"].get(k)), with_nan(m["errors"].get(k))) for k in labels]
        numbers = [m[k] for k in ("probability", "nrmse_before", "nrmse_after", "noise", "gain")]
        rows.append([_name(m), *numbers, *values])
    columns = ["machine", "differs", "refitted", "with the common physics", "noise", "log evidence", *labels]
    emphasis = [i for i, m in enumerate(machines) if m["name"] in content["differing"]]
    note = "The errors are NRMSE. The log evidence compares the common physics with the simulator as given."
    caption = f"{len(machines)} machines, sorted by the probability that they differ"
    folded = len(machines) > MOST_ROWS
    return Table(columns, rows, caption=caption, note=note, emphasis=emphasis, folded=folded, digits=3)


def machine_page(content: Mapping[str, Any], name: str, residual: Mapping[str, Any] | None = None) -> Page:
    """Fill the page of one machine of a fleet; a regular machine has no pictures, which take most of the time.

    Parameters
    ----------
    content : mapping
        The content of fleet.json.
    name : str
        Name of the machine.
    residual : mapping, optional
        See `fleet_page`.
    """
    m = next(m for m in content["machines"] if m["name"] == name)
    found = [f"{_with_minus(text)} (probability {number_text(p, 3)})" for text, p in m["reasons"]]
    if m["failed"]:
        tone, answer, status = "bad", "Could not be fitted", m["failed"]
    elif found:
        tone, answer, status = "warning", "Differs from regular machines", "; ".join(filter(None, [*found, m["note"]]))
    else:
        tone, answer, status = "good", "As the other machines", "No difference is more likely than not."
    sections = [
        Section("Values beside the fleet", [_own_values(content, m)] if m["values"] else []),
        Section("Error beside the fleet", [] if m["failed"] else _own_error(content, m, residual)),
        Section("Drift", _drift(content, [m])),
        Section("How it was judged", _judgement(m)),
    ]
    common = content["common"]["words"] or "nothing"
    return Page(
        f"Machine {name}",
        [s for s in sections if s.blocks],
        subtitle=f"One of {len(content['machines'])} machines; missing in all: {common}",
        answer=answer,
        status=status,
        tone=tone,
        facts={"probability of a difference": number_text(m["probability"], 3)},
    )


def _own_values(content: Mapping[str, Any], m: Mapping[str, Any]) -> Table:
    """Tabulate the values and trends of a machine beside those of regular machines."""
    per = next((t["per"] for t in m["trends"].values()), "")
    rows = []
    for v in content["values"]:
        label, population = v["name"], v["population"]
        value, error = (with_nan(m[kind].get(label)) for kind in ("values", "errors"))
        mean, spread = with_nan(population["mean"]), with_nan(population["deviation"])
        off = (value - mean) / np.hypot(spread, error) if np.hypot(spread, error) > 0 else np.nan
        usual = uncertain_text(mean, with_nan(population["mean_error"]))
        row = [label, v["unit"], uncertain_text(value, error), usual, spread, float(off), m["differs"].get(label)]
        if per:
            t = {k: with_nan(m["trends"].get(label, {}).get(k)) for k in ("slope", "error", "probability")}
            row += [uncertain_text(t["slope"], t["error"]), t["probability"]]
        rows.append(row)
    columns = ["value", "unit", "this machine", "mean", "between machines", "deviations off", "differs"]
    columns += [f"drift per {per}", "drifts"] if per else []
    note = (
        "± is one standard error. Mean, and standard deviation between machines, are of regular machines. The distance "
        "from the mean is in deviations, the standard error included. The other columns are probabilities."
    )
    return Table(columns, rows, note=note, digits=3)


def _own_error(content: Mapping[str, Any], m: Mapping[str, Any], residual: Mapping[str, Any] | None) -> list[Block]:
    """Compare the errors of a machine with those of all machines; draw the residual of a machine that differs."""
    kinds = {
        "refitted as given": "nrmse_before",
        "with the common physics": "nrmse_after",
        "noise": "noise",
        "error over noise": "ratio",
    }
    rows = []
    for text, key in kinds.items():
        every = np.array([other[key] for other in content["machines"]], dtype=float)
        known = every[np.isfinite(every)]
        rows.append([text, m[key], *(float(q) for q in np.quantile(known, (0.0, 0.5, 1.0)))])
    table = Table(
        ["error", "this machine", "smallest", "median", "largest"], rows, note="Errors and noise are NRMSE.", digits=3
    )
    if not (m["reasons"] and residual):
        return [table]
    figure = plots.small_multiples([residual], [m["name"]])
    return [table, Picture(_alone(figure), RESIDUAL, "residual of the machine")]


def _judgement(m: Mapping[str, Any]) -> list[Block]:
    """Explain the judgement, and link the page of the fleet and the diagnosis of the machine alone."""
    text = (
        "The simulator with the physics that all machines lack was fitted to this machine, and its values, its trends "
        "and its remaining error were compared with those of the others. Probabilities above one half are findings."
    )
    rows: list[list[Any]] = [[_link("all machines", "../../report.html"), "the comparison of all machines"]]
    diagnosis = _link("diagnosis of this machine", f"../../{m['report']}") if m["report"] else "diagnosis"
    sampled = "/sample-" in m["report"]
    if "sentence" in m["rest"]:
        rows.append(["diagnosis" if sampled else diagnosis, m["rest"]["sentence"]])
    if sampled:
        alone = (
            "used to find the common physics; it assumed constant values, and the judgement above replaces all that it "
            "names besides the common physics"
        )
        rows.append([diagnosis, alone])
    return [Text(text), Table(["page", "content"], rows)]
