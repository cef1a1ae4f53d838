"""Tables and sentences of a diagnosis: errors, effects and how they act, candidates, parameters, checks, usage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from .. import identify, laws, simulators
from .._base import capitalise, in_words, percent, to_json, with_nan
from ..data import DIVERGING
from ..diagnose import ERROR_NAMES, Diagnosis, Effect, Fitted, Workbench, law_signals, learned_force
from ..laws import (
    VaryingParameter,
    carried,
    display_name,
    heated,
    readable_unit,
    scaled,
    scheduled,
    short_name,
    varying,
)
from ..models import Parameter, ParameterSet
from ..simulators import MECHANICAL, PARAMETER, UNKNOWN, CoSimulation, kind_of, name_at, name_at_any
from .page import Bar, Block, Code, Table, Text, number_text, render, typeset_numbers, uncertain_text

TONES = {"missing-physics": "good", "complete": "good", "unexplained": "warning", "recording-fault": "bad"}
CLEAR = 0.9  # confidence below which the report says what may lower it
BAR_MARGIN = 1.03  # smallest error over the left end of the bars' scale
OPPOSING_MOTION = ("friction", "damping", "drag")  # ends of the names of laws that have no stiffness
OPEN_ROWS = 12  # candidates in the open table; a folded table holds the others


def percent_text(value: float | None) -> str:
    """Write a relative error for a table: a dash if it was not computed, a word if the simulation runs away."""
    if value is None:
        return "\u2014"
    return typeset_numbers(percent(value)).replace(" ", "\u00a0") if value < DIVERGING else "diverges"


def correction_words(diagnosis: Diagnosis) -> str:
    """Describe how the corrected simulator differs from the refitted one; empty if it does not.

    The text says "put back" only if the names are certain and the laws help on the test recordings.
    """
    stated = diagnosis.sure and diagnosis.outcome in ("better", "")
    done = f" {'put back' if stated else 'added'}" if diagnosis.effects else ""
    return correction_label(diagnosis) + done


def correction_label(diagnosis: Diagnosis) -> str:
    """Name the corrected simulator in a legend; empty if it is the refitted one."""
    if diagnosis.effects:
        names = [_short_name(e) for e in diagnosis.effects]
        if diagnosis.nameless_laws:
            names.append("laws of uncertain name")
        if diagnosis.learned:
            names.append("a learned force")
        return f"with {in_words(names)}"
    if diagnosis.nameless:
        return "corrected"
    if diagnosis.freed:
        return f"with {diagnosis.freed} let go"
    return f"with {diagnosis.offsets}" if diagnosis.offsets else ""


def _short_name(e: Effect) -> str:
    """Name an effect without its port; for a parameter say which one varies."""
    return name_at(e.port, e.law, e.form) if kind_of(e.port) == PARAMETER else short_name(e.law, e.form)


def tone(diagnosis: Diagnosis) -> str:
    """Choose the colour of the headline: good only if the answer is certain and helps on the test recordings."""
    if diagnosis.outcome == "worse":
        return "bad"
    idle = diagnosis.outcome == "same" and not diagnosis.only_offsets
    doubtful = idle or (bool(diagnosis.effects) and not diagnosis.sure)
    return "warning" if doubtful else TONES.get(diagnosis.verdict, "plain")


def _name_errors(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the errors to show: names by key."""
    correction = correction_words(diagnosis)
    names = {key: name for key, name in ERROR_NAMES.items() if key != "after"}
    return names | ({"after": correction} if correction else {})


def judged_errors(diagnosis: Diagnosis) -> tuple[str, Mapping[str, float]]:
    """Return the role of the recordings that judge the answer, test if they can, and their errors."""
    errors = None if diagnosis.test_fault else diagnosis.errors.get("test")
    return ("test", errors) if errors else ("training", diagnosis.errors["train"] or {})


def answer(diagnosis: Diagnosis, forces: Sequence[str]) -> str:
    """Write the result in a few words: the missing physics, its strength and confidence, the gain.

    The strength is a quantity that the law defines, or else the largest force (`forces`, one for each effect).
    """
    d = diagnosis
    role, errors = judged_errors(d)
    named = []
    for e, force in zip(d.effects, forces, strict=True):
        sizes = [f"{name} {number_text(p['value'], 3)}\u00a0{p['unit']}".strip() for name, p in e.defined.items()]
        strong = sizes[0] if sizes else force
        name = name_at_any(e.port, e.law, e.form, e.indistinguishable)
        named.append(f"{name}{strong and ', ' + strong}, {100 * e.confidence:.0f}\u00a0% sure")
    places = ", ".join(dict.fromkeys(f.port for f in d.learned))
    nameless = f"A force without a name at {places}" if places else "Something is missing that has no name"
    at_fault = dict.fromkeys(f"{display_name(g.finding)} of {g.channel}" for g in d.gates if g.fault)
    are = "are" if " and " in d.freed else "is"
    other = {
        "complete": f"{d.freed} {are} not as stated" if d.freed else "Nothing is missing",
        "recording-fault": f"The recordings are at fault: {', '.join(at_fault)}".removesuffix(": "),
    }
    words = "; ".join(named) or other.get(d.verdict, nameless)
    steps = {"nominal": "as given", "before": "refitted"} | ({"after": "corrected"} if correction_words(d) else {})
    gain = ", ".join(f"{percent_text(errors.get(k))} {name}" for k, name in steps.items())
    worse = ", which is worse" if d.outcome == "worse" else ""
    data = "unseen data" if role == "test" else "the training data"
    return f"{capitalise(words)}; error on {data} {gain}{worse}"


def headline(diagnosis: Diagnosis) -> str:
    """Write the verdict with its errors."""
    role, errors = judged_errors(diagnosis)
    on = "On held-out recordings" if role == "test" else "On the training recordings (no test was given)"
    ahead = " of predictions one sample ahead" if "free_run" in diagnosis.errors else ""
    summary = diagnosis.summary
    if diagnosis.nameless:  # a section of the page describes the correction
        summary = summary.replace(f" {diagnosis.nameless.sentence}", "")
    summary = " ".join([summary, *diagnosis.corrections_made()])
    text = f"{summary.rstrip('. ')}. {on} the error{ahead} is {percent_text(errors.get('nominal'))} as given"
    text += f", {percent_text(errors.get('before'))} refitted"
    if what := correction_words(diagnosis):
        text += f", {percent_text(errors.get('after'))} {what}"
    floor = diagnosis.noise_text(diagnosis.noise_on_tests, percent_text)
    return f"{text}; the noise floor is {floor}."


def facts(diagnosis: Diagnosis) -> dict[str, str]:
    """Collect the figures of merit."""
    role, errors = judged_errors(diagnosis)
    out = {f"{role} error, {name}": percent_text(errors.get(k)) for k, name in _name_errors(diagnosis).items()}
    kind = {"periods": "from periods", "repeats": "from repeats"}.get(diagnosis.floor["source"], "estimated")
    out[f"noise floor, {kind}"] = percent_text(diagnosis.noise_on_tests["nrmse"])
    if diagnosis.effects:
        out["confidence"] = " / ".join(f"{e.confidence:.2f}" for e in diagnosis.effects)
    return out


def error_table(diagnosis: Diagnosis) -> Table:
    """Tabulate the errors before and after the correction, on training and test recordings."""
    steps = _name_errors(diagnosis)
    rows: list[list[Any]] = []
    predicted = "free_run" in diagnosis.errors
    free = "test" if diagnosis.errors.get("test") else "training"
    names = {"train": "training", "test": "test (held out)", "free_run": f"{free}, the same, free run"}
    for kind, name in names.items():
        errors = diagnosis.errors.get(kind)
        if errors:
            noise = diagnosis.floor if kind == "train" else diagnosis.noise_on_tests
            rows.append([name, *(percent_text(errors.get(k)) for k in steps), percent_text(noise["nrmse"])])
    note = (
        f"Rms error of {'the predictions one sample ahead' if predicted else 'the free-run simulation'} divided by the "
        "standard deviation of the measured output, averaged over outputs."
    )
    if diagnosis.floor["source"] == "estimated":
        note += " The noise floor is estimated from the residual; coloured noise would make it larger."
    if diagnosis.errors.get("test"):
        note += " On the test recordings it holds if they are as noisy as the training recordings."
    emphasis = [len(rows) - 1 - predicted]
    return Table(["recordings", *steps.values(), "noise floor"], rows, note=note, emphasis=emphasis)


def effect_blocks(diagnosis: Diagnosis, number: int, action: Table | None) -> list[Block]:
    """Describe an effect: its law, how it acts, its parameters, and the laws that are indistinguishable from it."""
    e = diagnosis.effects[number]
    name = name_at(e.port, e.law, e.form)
    out: list[Block] = [
        Text(f"{capitalise(name)}. In words: {e.sentence}. Confidence {e.confidence:.2f} of 1{e.place}."),
        Code(e.equation),
    ]
    if action:
        out.append(action)
    if worth := diagnosis.worth(e):
        out.append(Text(f"{capitalise(worth)}."))
    values = {
        name: (uncertain_text(p["value"], with_nan(p["std"])) + e.limit(name), p["unit"])
        for name, p in (e.defined | e.parameters).items()
    }
    given = any(np.isfinite(with_nan(p["std"])) for p in e.parameters.values())
    out += _value_table(values, "± one standard deviation." if given else "")
    if e.indistinguishable:
        others = "; ".join(name_at(port, law) for port, law in e.indistinguishable)
        out.append(Text(f"These recordings cannot tell it apart from: {others}."))
    else:
        out.append(Text("No law with another name is nearly as likely; other forms of the same law may be."))
        if e.confidence < CLEAR:
            why = "something is left unexplained, a value is at a limit, or several less likely laws share the rest"
            out.append(Text(f"The confidence is lower because {why}."))
    return out


def nameless_blocks(diagnosis: Diagnosis) -> list[Block]:
    """Describe the laws of a correction without a sure name: equations, values, and the laws that explain as much."""
    out = list[Block]()
    for law in diagnosis.nameless_laws:
        name = f"Also in the correction, without a sure name: {law.name}" if diagnosis.effects else capitalise(law.name)
        out += [Text(f"{name}:"), Code(law.equation)]
        values = {name: (", ".join(map(number_text, np.ravel(p.value))), p.unit) for name, p in law.free.items()}
        out += _value_table(values)
        out += [Text(f"{capitalise(law.doubt)}.")] if law.doubt else []
        out += [Text(f"These recordings cannot tell it apart from {law.alike}.")] if law.alike else []
    return out


def _value_table(values: Mapping[str, tuple[str, str]], note: str = "") -> list[Block]:
    """Tabulate values with their units, by name; no table if there are none."""
    rows = [[name, value, unit or "–"] for name, (value, unit) in values.items()]
    return [Table(["parameter", "value", "unit"], rows, note=note)] if rows else []


def candidates_by_pass(diagnosis: Diagnosis) -> list[tuple[list[dict[str, Any]], Any]]:
    """Return the candidates of each pass of the search, best first, and the hypothesis to which they were added.

    The hypothesis is None if it is unknown.
    """
    rows, search = list(diagnosis.candidates), diagnosis.evidence.search
    moves = search.moves_by_parent if search is not None else []
    sizes, parents = [len(move.trials) for move in moves], [move.parent for move in moves]
    if sum(sizes) != len(rows):
        sizes, parents = [len(rows)], parents[:1] or [None]
    ends = pairwise(np.cumsum([0, *sizes]))
    return [(sorted(rows[a:b], key=fit_error), parent) for (a, b), parent in zip(ends, parents, strict=True) if b > a]


def fit_error(row: Mapping[str, Any]) -> float:
    """Return a candidate's training error, by which candidates are ranked; infinite if its fit failed."""
    value = row.get("nrmse_train")
    return np.inf if value is None else float(value)


CANDIDATES = (
    "Each law is fitted together with the simulator's own parameters. Where a model is wrong, the likeliest laws are "
    "also judged on held-out blocks, which are not used in the fit. Bars: from the noise to the error without a law, "
    "logarithmic; the thin line ends at the error on held-out blocks, if it was computed. Margin: error of the fit "
    "divided by that of the law in bold, or of the first law if none is bold; below one, a law follows more closely "
    "but is less likely, such as one with more parameters. ΔBIC: twice the loss of log evidence; below zero is better "
    "than no law."
)


def candidate_tables(
    rows: Sequence[Mapping[str, Any]], chosen: Sequence[Effect], title: str, floor: float, without: float | None
) -> list[Block]:
    """Tabulate the candidates with their margins, best first; a folded table holds those beyond `OPEN_ROWS`.

    Bars reach from the noise `floor` to the error `without` a law, on a logarithmic scale.
    """
    named = {(e.port, e.law): e.form for e in chosen}
    named_rows = [i for i, r in enumerate(rows) if (r["port"], r["law"]) in named]
    winner = min(
        named_rows, key=lambda i: rows[i].get("form", "") != named[rows[i]["port"], rows[i]["law"]], default=None
    )
    best = fit_error(rows[winner or 0])
    cells = []
    errors = [fit_error(r) for r in rows if 0 < fit_error(r) < np.inf]
    low, top = min([*errors, floor or np.inf]) / BAR_MARGIN, max([*errors, without or 0.0])

    def share(error: float | None) -> float:
        return float(np.log(error / low) / np.log(top / low)) if error and low < error < np.inf else 0.0

    for i, r in enumerate(rows):
        form = f" ({display_name(r['form'])})" if r.get("form") else ""
        margin = fit_error(r) / best if best > 0 and np.isfinite(fit_error(r)) else np.inf
        gain = np.inf if r["delta_bic"] is None else r["delta_bic"]
        cells.append(
            [
                f"{i + 1}. {display_name(r['law'])}{form}",
                r["port"],
                Bar(percent_text(r["nrmse_train"]), share(r["nrmse_train"]), share(r["nrmse_validation"])),
                percent_text(r["nrmse_validation"]) if r["nrmse_validation"] is not None else "–",
                f"{margin:.2f} ×" if margin < 10 else f"{margin:.3g} ×" if np.isfinite(margin) else "–",
                f"{gain:+.0f}".replace("-", "−") if np.isfinite(gain) else "–",
            ]
        )
    columns = ["law", "port", "error of the fit", "error, held-out blocks", "margin", "ΔBIC"]
    emphasis = [] if winner is None else [winner]  # an index outside a table marks no row
    out: list[Block] = [Table(columns, cells[:OPEN_ROWS], caption=title, emphasis=emphasis)]
    if len(cells) > OPEN_ROWS:
        title, emphasis = f"{len(cells) - OPEN_ROWS} more, with larger errors", [i - OPEN_ROWS for i in emphasis]
        out.append(Table(columns, cells[OPEN_ROWS:], caption=title, emphasis=emphasis, folded=True))
    return out


def flexible_table(diagnosis: Diagnosis) -> Table | None:
    """Tabulate the share of the mismatch that a flexible force at each port could explain."""
    search = diagnosis.evidence.search
    opened = search.flexible(search.root) if search is not None else {}
    if not opened:
        return None
    rows = [[port, percent_text(share)] for port, share in sorted(opened.items(), key=lambda item: -item[1])]
    note = (
        "The flexible force is a smooth function of the local coordinate and its rate, not a law of the catalogue. "
        "With few outputs, several ports can explain the mismatch; in the pictures, look for the port where the force "
        "is a simple curve."
    )
    title = "Share of the mismatch that a flexible force at each port could explain"
    return Table(["port", "share of the mismatch explained"], rows, caption=title, note=note, emphasis=[0])


def parameter_table(diagnosis: Diagnosis) -> Table:
    """Tabulate the simulator's parameters: nominal, refitted, and with the correction in place."""
    rows, what = [], correction_words(diagnosis)
    for name, p in diagnosis.parameters.items():
        known = ParameterSet({name: Parameter(p["nominal"])})
        shape = np.shape(p["nominal"])
        given, without, after, std = (
            np.ravel(np.broadcast_to(np.asarray(with_nan(p[k]), dtype=float), shape), order="F")
            for k in ("nominal", "refit_without", "refit_with", "std")
        )
        for i, label in enumerate(known.labels):
            row = [label, uncertain_text(given[i], np.nan), uncertain_text(without[i], np.nan)]
            if what:
                change = after[i] / given[i] - 1 if given[i] else np.nan
                row += [uncertain_text(after[i], std[i])]
                row += [f"{100 * change:+.1f}\u00a0%".replace("-", "−") if np.isfinite(change) else "–"]
            rows.append([*row, p["unit"] or "–"])
    more = [f"refitted {what}", "change from nominal"] if what else []
    note = "A refit without the missing physics bends the other parameters to compensate for it."
    note = note if diagnosis.effects else ""
    return Table(["parameter", "nominal", "refitted as it is", *more, "unit"], rows, note=note)


def check_table(diagnosis: Diagnosis) -> Table | None:
    """Tabulate the findings of the recordings' checks; None without findings."""
    if not diagnosis.gates:
        return None
    rows = [[g.channel, display_name(g.finding), g.sentence, "yes" if g.corrected else "no"] for g in diagnosis.gates]
    return Table(["channel", "finding", "in words", "corrected"], rows)


def usage(diagnosis: Diagnosis) -> str:
    """Write Python code that builds the corrected simulator from the user's simulator and simulates a recording."""
    return render("use_diagnosis.txt", **_collect_correction(diagnosis))


def corrected_file(
    diagnosis: Diagnosis,
    source: str,
    loader: str = "load_simulator",
    options: Mapping[str, Any] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> str:
    """Write a simulator file that corrects the simulator of another file.

    Parameters
    ----------
    diagnosis : Diagnosis
    source : str
        Path of the other file from this one.
    loader : {"load_simulator", "load", "from_fmu", "from_mujoco"}
        Function that loads the other file.
    options : mapping, optional
        Its options.
    bounds : mapping, optional
        Bounds of parameters that had others in the diagnosis than in the other file.
    """
    options = {name: value for name, value in (options or {}).items() if value}
    content = _collect_correction(diagnosis)
    used = {loader, *(type(v).__name__ for v in options.values() if isinstance(v, CoSimulation))}
    if loader == "load":
        used = {"as_simulator"}
        content["modules"].setdefault(identify.__name__, set()).add(loader)
    content["modules"].setdefault(simulators.__name__, set()).update(used)
    return render("corrected.txt", source=source, loader=loader, options=options, bounds=bounds, **content) + "\n"


def _collect_correction(diagnosis: Diagnosis) -> dict[str, Any]:
    """Collect the values with which templates build the corrected simulator."""
    simulator = diagnosis.corrected
    fitted = {k: to_json(np.asarray(p.value)) for k, p in simulator.parameter_set.items()}
    modules: dict[str, set[str]] = {}
    elements = []
    for e in simulator.elements:
        imported, expression = _write_law_expression(type(e.law))
        for part in imported:
            home = laws.__name__ if getattr(laws, part.__name__, None) is part else part.__module__
            modules.setdefault(home, set()).add(part.__name__)
        bounds = {k: simulator.parameters[f"{e.prefix}{k}"].bounds for k in e.law.limits}  # a fit may have widened them
        limits = {k: tuple(np.asarray(end, dtype=float).tolist() for end in ends) for k, ends in bounds.items()}
        elements.append((e, expression, e.own(fitted), limits))
    own = diagnosis.refitted.parameters
    now = {k: np.array(p.bounds, dtype=float) for k, p in simulator.parameters.items() if k in own}
    freed = {k: tuple(ends.tolist()) for k, ends in now.items() if ends.ndim == 1 and np.any(ends != own[k].bounds)}
    values = {k: v for k, v in fitted.items() if k in own and own[k].value.size}  # a list has no shape (0, 2)
    return {
        "diagnosis": diagnosis,
        "simulator": simulator,
        "modules": modules,
        "elements": elements,
        "freed": freed,
        "values": values,
    }


def _write_law_expression(law: Any) -> tuple[tuple[Any, ...], str]:
    """Return the imports and the Python expression that make the class of a law."""
    if getattr(law, "factor", ""):
        of_speed = ", of_speed=True" if law.of_speed else ""
        return (learned_force,), f"learned_force({law.factor!r}{of_speed})"
    if issubclass(law, VaryingParameter) and law.signal:
        return (heated,), f"heated({law.signal!r})"
    if issubclass(law, VaryingParameter):
        return (varying,), f"varying({law.scheduled_by!r}, {law.profile!r})"
    if law.carried_by:
        return (carried,), f"carried({law.carried_by!r})"
    base = law.__base__
    if law.scaled_by != getattr(base, "scaled_by", ""):
        imported, inner = _write_law_expression(base)
        return (scaled, *imported), f"scaled({inner}, {law.scaled_by!r})"
    if law.scheduled_by != getattr(base, "scheduled_by", ""):
        imported, inner = _write_law_expression(base)
        how = f", {law.profile!r}" if law.profile not in ("", "linear") else ""
        return (scheduled, *imported), f"scheduled({inner}, {law.scheduled_by!r}{how})"
    return (law,), law.__name__


@dataclass(frozen=True)
class Action:
    """How a law acts along the training recordings: its largest force with its unit, and a table."""

    strongest: str
    table: Table


def measure_action(bench: Workbench, fitted: Fitted, effect: Effect, number: int | None) -> Action | None:
    """Measure the force of element `number` along the training recordings; None without one, or if its run diverges.

    The equivalent damping takes the energy that the law takes in whole cycles (Jacobsen 1930), and the equivalent
    stiffness k minimises the rms of w - k z; in a periodic motion both are those of Krylov & Bogoliubov (1943). Cycles
    begin where z crosses its mean upwards. If z is a speed, only the damping is measured; a friction has no stiffness.
    Outside mechanics, where force times motion is no energy, neither has a meaning.
    """
    if number is None:
        return None
    from scipy.integrate import trapezoid

    port = bench.simulator.port(effect.port)
    with np.errstate(all="ignore"):
        runs = [law_signals(bench, fitted, number, i) for i in range(len(bench.recordings))]
    z, dz, w = (np.concatenate(v) for v in zip(*runs, strict=True))
    if not all(np.all(np.isfinite(v)) for v in (z, dz, w)):
        return None
    largest = f"{number_text(float(np.max(np.abs(w))), 3)}\u00a0{port.unit}".strip()
    of = "parameter" if kind_of(port.name) == PARAMETER else "signal"
    mechanical = port.domain in (MECHANICAL, UNKNOWN) and not port.series
    what = f"largest change of the {of}" if port.series else "largest force" + " or flow" * (not mechanical)
    rows = [[what, float(np.max(np.abs(w))), port.unit]]
    unit = readable_unit("w*s/z", port.unit, port.position_unit)
    if mechanical and port.is_speed:
        damping = (w - np.mean(w)) @ z / (z @ z)
        rows += [["equivalent damping", float(damping), unit if port.unit and port.across_unit else ""]]
    elif mechanical:
        stiffness = (w - np.mean(w)) @ (z - np.mean(z)) / np.sum((z - np.mean(z)) ** 2)
        opposes = effect.law.endswith(OPPOSING_MOTION)
        closed, counts = zip(*(_whole_cycles(np.vstack(run)) for run in runs), strict=True)
        cycles = sum(counts)
        whole = runs if opposes and not cycles else closed  # what opposes motion stores no energy
        taken = sum(float(trapezoid(f, x)) for x, _, f in whole)
        over = sum(float(trapezoid(v, x)) for x, v, _ in whole)  # the integral of v^2
        units = [readable_unit(u, port.unit, port.across_unit) for u in ("w*z", "w/z")]
        known = bool(port.unit and port.across_unit)
        rows += [["energy taken per cycle, mean", taken / cycles, units[0] if known else ""]] if cycles else []
        if not opposes:
            rows += [["equivalent stiffness", float(stiffness), units[1] if known else ""]]
        rows += [["equivalent damping", taken / over, unit if known else ""]] if over > 0 else []
    return Action(largest, Table(["how it acts in the training recordings", "value", "unit"], rows, digits=3))


def _whole_cycles(run: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the part of a run (z, dz/dt, w) from the first to the last upward crossing of its mean, and its cycles.

    There z is the same at both ends, so that a spring has given back what it had taken.
    """
    z = run[0] - np.mean(run[0])
    up = np.flatnonzero(np.diff(np.signbit(z).astype(int)) < 0)
    if len(up) < 2:
        return run[:, :0], 0
    ends = [run[:, [k]] + (run[:, [k + 1]] - run[:, [k]]) * z[k] / (z[k] - z[k + 1]) for k in (up[0], up[-1])]
    return np.hstack([ends[0], run[:, up[0] + 1 : up[-1] + 1], ends[1]]), len(up) - 1


def element_of(fitted: Fitted, effect: Effect) -> int | None:
    """Return the index of an effect's element in the fitted simulator, where offsets may precede it, or None."""
    placed = enumerate(fitted.simulator.elements)
    return next((i for i, p in placed if p.name == (effect.port, effect.law)), None)
