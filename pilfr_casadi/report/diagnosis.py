"""The report of a diagnosis: `report.html` with the verdict and its proof, `diagnosis.json`, and the figures."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import plots
from .._base import InputError, in_words, make_folder, write_atomically
from ..data import COURSES
from ..diagnose import (
    BeforeAfter,
    Diagnosis,
    Fitted,
    HiddenForce,
    Learned,
    Workbench,
    closest_hypothesis,
    hidden_force,
    port_signals,
)
from ..laws import display_name, readable_unit, strengths_over
from ..plots import Signal
from ..simulators import ACTUATOR, MECHANICAL, PARAMETER, SENSOR, Port, in_series, kind_of, name_at, split_port
from . import diagnosis_tables as tables
from .diagnosis_tables import Action, element_of, measure_action
from .page import Block, Code, Page, Picture, Section, Table, Text, label_recording, signal_path

MOST_DRAWN = 3  # outputs and recordings that are drawn; the tables have all of them


def diagnosis_report(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html`, `diagnosis.json` and `figures/*.png` of a diagnosis into a folder; return the page's path.

    Each file is written atomically, the page last. Figures of an earlier diagnosis are deleted.
    """
    page = diagnosis_page(diagnosis)
    html, figures = page.html(), _figures(page)
    target = make_folder(Path(folder) / "figures").parent
    for name, png in figures.items():
        write_atomically(target / "figures" / name, png)
    diagnosis.save(target / "diagnosis.json")
    path = write_atomically(target / "report.html", html)
    for old in (target / "figures").glob("diagnosis-[0-9][0-9]-*.png"):
        if old.name not in figures:
            with contextlib.suppress(OSError):
                old.unlink()
    return path


def _figures(page: Page) -> dict[str, bytes]:
    """Draw the pictures of a page; return PNG files by name."""
    pictures = [block for section in page.sections for block in section.blocks if isinstance(block, Picture)]
    files: dict[str, bytes] = {}
    for k, picture in enumerate(pictures, 1):
        short = "".join(c if c.isascii() and c.isalnum() else "-" for c in picture.alt.lower())[:50].strip("-")
        files[f"diagnosis-{k:02d}-{short}.png"] = picture.png
    return files


@dataclass(frozen=True, eq=False)
class _Case:
    """A diagnosis with the data for its pictures."""

    diagnosis: Diagnosis
    bench: Workbench
    before: Fitted
    after: Fitted
    noise: np.ndarray  # standard deviation of each output's noise, (n_y,)

    @classmethod
    def of(cls, d: Diagnosis) -> _Case:
        search, noise = d.evidence.search, d.evidence.noise
        recordings = d.train if search is None else search.bench.recordings  # stretches of long recordings
        bench = Workbench.of(d.refitted, recordings, d.hold)
        noise = float(d.floor["nrmse"]) * bench.scale if noise is None else noise
        return cls(d, bench, d.evidence.without, d.evidence.after, np.nan_to_num(noise))


def diagnosis_page(diagnosis: Diagnosis) -> Page:
    """Build the page of a diagnosis; see `diagnosis_report`."""
    case, d = _Case.of(diagnosis), diagnosis
    actions = [measure_action(case.bench, case.after, e, element_of(case.after, e)) for e in d.effects]
    checks = tables.check_table(d)
    check_section = Section("What the recordings' checks found", [checks] if checks else [])
    faulty = d.verdict == "recording-fault"
    sections = [
        *([check_section] if faulty else []),
        Section(_result_title(d), _result(d, actions)),
        Section("Where the simulator is off", _mismatch(case)),
        Section("The hidden force", _hidden_forces(case)),
        Section("Candidates", _candidates(d)),
        Section("The simulator's parameters", [tables.parameter_table(d)] if d.parameters else []),
        Section("The proof" if d.test else "Measured and simulated", _proof(case)),
        *([] if faulty else [check_section]),
        Section("The next experiment", _next_experiment(d)),
        Section(_usage_title(d), _usage(d)),
    ]
    names = signal_path(d.refitted.inputs, d.refitted.output_names)
    return Page(
        f"Diagnosis of a simulator: {names}",
        [s for s in sections if s.blocks],
        subtitle=_subtitle(case),
        answer=tables.answer(d, [a.strongest if a else "" for a in actions]),
        status=tables.headline(d),
        tone=tables.tone(d),
        facts=tables.facts(d),
    )


def _subtitle(case: _Case) -> str:
    d, r = case.diagnosis, case.bench.recordings[0]
    parts = [f"{len(d.train)} training recording{'s' * (len(d.train) != 1)}, {sum(map(len, d.train))} samples"]
    parts += [f"{len(d.test)} held out, {sum(map(len, d.test))} samples"] if d.test else ["none held out"]
    parts += [f"step {r.dt:.4g} s", f"inputs {COURSES[d.hold].words} between samples" if r.n_u else "no input"]
    parts += [f"computed in {d.seconds:.1f} s"] if d.seconds else []
    return "; ".join(parts)


def _result_title(d: Diagnosis) -> str:
    if d.effects:
        return "What is missing" if d.sure and d.outcome in ("better", "") else "What may be missing"
    return "A correction without a certain name" if d.nameless else "How good the simulator is"


def _result(d: Diagnosis, actions: Sequence[Action | None]) -> list[Block]:
    out: list[Block] = [Text(line) for line in d.gravest_blind_spots()]
    for k, action in enumerate(actions):
        out += tables.effect_blocks(d, k, action.table if action else None)
    if d.verdict == "unexplained":
        out.append(Text("The sections below show where and how the mismatch acts."))
    elif d.verdict == "recording-fault":
        out.append(Text("Correct the recordings before you look for missing physics; see the checks above."))
    if d.correction and (d.nameless or d.learned):
        out.append(Text(d.correction.sentence))
    out += tables.nameless_blocks(d)
    out += [Text(learned.sentence) for learned in d.learned]
    return [*out, tables.error_table(d), *map(Text, d.warnings())]


def _mismatch(case: _Case) -> list[Block]:
    found = case.diagnosis.mismatch
    out: list[Block] = [Text(found["sentence"])] if found.get("sentence") else []
    if "map" not in found:
        return out
    unit = case.bench.unit_of(next(iter(found["scale"])))
    outputs = "the outputs" if len(found["scale"]) > 1 else next(iter(found["scale"]))
    drawn = (
        (
            plots.mismatch_map(found, unit),
            f"Error of the refitted simulator, without any law added, over frequency and the amplitude of {outputs}.",
            "Map of the error over frequency and amplitude.",
        ),
        (plots.mismatch_bands(found), "The error and the noise by frequency band.", "Error by frequency band."),
        (
            plots.mismatch_growth(found, unit),
            "The error over the amplitude. The refit has bent the parameters to hide as much as possible: this shows "
            "where the simulator fails, not why.",
            "Error over amplitude.",
        ),
        (plots.mismatch_growth(found, unit, kind="rate"), "The error over the speed.", "Error over speed."),
        (plots.mismatch_time(found), "The error and the motion of the output over time.", "Error over time."),
        (
            plots.mismatch_level(found, case.bench.unit_of(found["level"]["output"])),
            f"The error over the value of {found['level']['output']}.",
            "Error over the value of the output.",
        ),
    )
    return [*out, *(Picture(*picture) for picture in drawn)]


def _hidden_forces(case: _Case) -> list[Block]:
    """Draw the forces of the named effects; without a name, those of the closest laws and of the likeliest port."""
    d, out = case.diagnosis, [block for learned in case.diagnosis.learned for block in _learned_force(case, learned)]
    for e in d.effects:
        if (number := element_of(case.after, e)) is not None:
            if kind_of(e.port) != PARAMETER:  # no force acts there
                out += _force_blocks(case, case.after, e.port, number, display_name(e.law))
            out += _strength_pictures(case, number)
    if d.verdict != "unexplained":
        return out
    search, passes = d.evidence.search, tables.candidates_by_pass(d)
    closest: Any = search and closest_hypothesis(search, d.correction.closest if d.correction else None)
    for acting in (e for e in closest.effects if kind_of(e.port) != PARAMETER) if closest else ():
        number, law = closest.fitted.simulator.elements.index(acting), display_name(acting.law.id)
        out += _force_blocks(case, closest.fitted, acting.port, number, f"{law} (the closest law)")
    if not closest and passes:
        candidates, _ = passes[0]
        out += _force_blocks(case, case.before, candidates[0]["port"], None, "")
    table = tables.flexible_table(d)
    if table is not None:
        out.append(table)
        port = str(table.rows[0][0])
        if not closest or port not in {acting.port for acting in closest.effects}:
            out += _force_blocks(case, case.before, port, None, "")
    return out


def _learned_force(case: _Case, learned: Learned) -> list[Block]:
    """Draw a learned force over the local coordinate and its rate, with the named laws nearest to it."""
    port = case.bench.simulator.port(learned.port)
    force = Signal("learned force w", learned.force, port.unit)
    laws = [(f"{display_name(n.law)}, off by {100 * n.error:.2g} %", n.force) for n in learned.nearest]
    text = (
        f"The points are the learned force at {learned.port} along the training recordings. The lines are the "
        "named laws that come nearest to it, drawn along the stretch where it is strongest."
    )
    out: list[Block] = [Text(text)]
    for x, name in zip(_local_signals(port, learned.z, learned.dz), ("its local coordinate", "its rate"), strict=True):
        if x is not None:
            figure = plots.learned_force(x, force, laws, title=learned.port)
            caption = f"The learned force at {learned.port} over {name}, with the nearest laws."
            out.append(Picture(figure, caption, f"Learned force at {learned.port} over {name}."))
    return out


def _local_signals(port: Port, z: np.ndarray, dz: np.ndarray) -> tuple[Signal, Signal | None]:
    """Label a port's local coordinate and its rate; the rate is None if it is zero throughout."""
    if port.is_speed and port.domain == MECHANICAL:
        return Signal("speed", z, port.across_unit), None
    channel = split_port(port.name)[1]
    across, unit = channel if port.series and channel else "local coordinate z", port.across_unit
    rate = Signal(f"rate of {across}", dz, f"{unit}/s" if unit else "") if np.ptp(dz) > 0 else None
    return Signal(across, z, unit), rate


def _force_blocks(case: _Case, fitted: Fitted, port: str, number: int | None, name: str) -> list[Block]:
    """Recover the force in a port along the recording with the most energy, and draw it with the law called `name`."""
    bench, records = case.bench, case.bench.recordings
    strongest = int(np.argmax([np.std(r.y[r.skip :] / bench.scale) * np.sqrt(len(r)) for r in records]))
    what = "signal" if in_series(port) else "force"
    try:
        hidden = hidden_force(bench, fitted, port, number, case.noise, strongest)
    except (InputError, np.linalg.LinAlgError, RuntimeError):
        hidden = None
    if hidden is None:
        return [Text(f"The outputs do not show the {what} at {port}, so it cannot be recovered.")]
    numbered = f"training recording {strongest + 1}" if len(records) > 1 else "the recording"
    recording = f"the recording “{hidden.recording}”" if hidden.recording else numbered
    text = (
        f"The points are the {what} at {port} that makes the simulator follow {recording}. A smoother computed it with "
        f"the fitted parameters, assuming only that the {what} changes in random steps; it uses no law."
    )
    text += f" The line is the fitted {name} along the simulation." if name else ""
    return [Text(text), *_force_pictures(hidden, bench.simulator.port(port), name)]


def _force_pictures(h: HiddenForce, port: Port, name: str) -> list[Block]:
    """Draw a force over its local coordinate, rate and time, and the remainder after subtracting the law."""
    label = {ACTUATOR: "added to the input", SENSOR: "added to the output"}.get(kind_of(h.port), "force w")
    (x, rate), force = _local_signals(port, h.z, h.dz), Signal(label, h.force, port.unit)
    alt, cloud = f"Recovered force at {h.port}", functools.partial(plots.force_cloud, title=h.port, name=name)
    drawn = [(cloud(x, force, h.law_z, h.law), f"{h.port}, over {x.name}.", f"{alt} over its local coordinate.")]
    if rate:
        drawn.append((cloud(rate, force, h.law_dz, h.law), "The same force over the rate.", f"{alt} over its rate."))
    elif port.series and len(h.law):  # a law in series: its output over its input
        acting = Signal(f"{x.name} as it acts", h.z + h.force, port.across_unit)
        caption = "The output of the law over its input."
        drawn.append((cloud(x, acting, h.law_z, h.law_z + h.law), caption, f"{alt}: output over input."))
    caption = "The same force over time, around its largest value. The band is the uncertainty due to noise."
    drawn.append((plots.force_time(h.t, force, h.std, h.law, name), caption, f"{alt} over time."))
    if len(h.law):
        remainder = plots.force_remainder(x, Signal("recovered − law", h.force - h.law_held, port.unit), h.std)
        caption = "The recovered force minus the law. Where the mean bends away from zero, the law's form is wrong."
        drawn.append((remainder, caption, f"{alt} without the law."))
    return [Picture(*picture) for picture in drawn]


def _strength_pictures(case: _Case, number: int) -> list[Block]:
    """Draw the strength of an element over the signal that varies it; empty if the strength is constant."""
    element = case.after.simulator.elements[number]
    law, by = element.law, element.law.scheduled_by
    if not by:
        return []
    port, values = case.bench.simulator.port(element.port), element.own(case.after.values)
    units = case.bench.simulator.signal_units(element.port, case.bench.recordings[0].units)
    grid = np.linspace(values["low"], values["high"], 200)
    signal = Signal(by, grid, units.get(by, ""))
    if by == "t":
        signal = Signal("time", grid, "s")
    elif by == "z" and not port.series:
        signal = Signal("local coordinate z", grid, port.across_unit)
    seen = law.schedule(port_signals(case.bench, case.after, element.port))
    out: list[Block] = []
    for name, found in strengths_over(law, values, grid).items():
        unit = readable_unit(law.units[name], port.unit, port.across_unit)
        total, title = found if found.ndim == 1 else found.sum(axis=1), f"{name} of the {name_at(*element.name)}"
        if kind_of(element.port) == PARAMETER:
            name = title = split_port(element.port)[1]
            total = total + float(case.after.values[name])
        figure = plots.strength_over_signal(signal, Signal(name, total, unit), seen, title=element.port)
        out.append(Picture(figure, f"How {title} varies with {signal.name}.", f"{title} over {signal.name}."))
    return out


def _candidates(d: Diagnosis) -> list[Block]:
    passes = tables.candidates_by_pass(d)
    out: list[Block] = [Text(tables.CANDIDATES)] if passes else []
    for rows, parent in passes:
        laws = "" if parent is None else in_words([name_at(*e.name) for e in parent.laws])
        title = f"Fitted in addition to {laws}" if laws else "All fitted pairs of port and law"
        error = None if parent is None else float(parent.error)
        out += tables.candidate_tables(rows, d.effects, title, d.floor["nrmse"], error)
    return out


def _proof(case: _Case) -> list[Block]:
    d, out = case.diagnosis, list[Block]()
    if d.test:
        out.append(
            Text(
                f"Simulated from the {'inputs' if d.refitted.inputs else 'start'} alone. These recordings were used "
                "neither to fit nor to choose; only an unknown initial state was estimated from the first samples and "
                "the training runs."
            )
        )
    role, recordings = ("test", d.test) if d.test else ("training", d.train)
    for k, r in enumerate(recordings[:MOST_DRAWN]):
        compared = d.before_and_after(r)
        label = label_recording(r, role, k, len(recordings))
        compared = replace(compared, recording=compared.recording.with_(name=label))
        for i in range(min(r.n_y, MOST_DRAWN)):
            out += _draw_comparison(case, compared, i)
    return out


def _draw_comparison(case: _Case, c: BeforeAfter, i: int) -> list[Block]:
    """Draw one output of a recording: two stretches, errors over time, and spectra."""
    r, name = c.recording, c.recording.outputs[i]
    unit, floor = case.bench.unit_of(name), float(case.noise[i])
    noise = case.diagnosis.floor
    white = noise.get("white", noise["nrmse"]) / max(noise["nrmse"], 1e-300)  # the slow part is no white noise
    simulated: plots.Simulated = [("as given", c.given), ("refitted", c.before)]
    if correction := tables.correction_label(case.diagnosis):
        simulated.append((correction, c.after))
    diverging = [label for label, y in simulated if y is None]
    note = f" The simulation diverges: {', '.join(diverging)}." if diverging else ""
    where = f"{name} in {r.name}"
    wide = plots.new_figure(11.0, 3.8).add_subplot()
    largest = plots.compared_traces(r, simulated, i, unit, ax=wide)
    quiet = plots.compared_traces(r, simulated, i, unit, quiet=True)
    return [
        Picture(
            largest,
            f"{where}: measured and simulated, around the largest swing.{note}",
            f"Measured and simulated {where}.",
            wide=True,
            views={"largest swing": largest, "little motion": quiet},
        ),
        Picture(
            quiet,
            f"{where}: a stretch with little motion.",
            f"Measured and simulated {where}, little motion.",
            replaced=True,
        ),
        Picture(
            plots.compared_residuals(r, simulated, i, unit, floor),
            f"{where}: the error over the whole recording.",
            f"Errors of {where}.",
        ),
        Picture(
            plots.compared_spectra(r, simulated, i, unit, floor * white),
            f"{where}: output, errors and noise over frequency.",
            f"Spectra of {where}.",
        ),
    ]


def _next_experiment(d: Diagnosis) -> list[Block]:
    if not d.next_experiment:
        return []
    sentence = d.next_experiment.get("sentence")
    settings = {k: v for k, v in d.next_experiment.items() if isinstance(v, str | int | float) and k != "sentence"}
    rows: Sequence[Sequence[Any]] = [[display_name(str(k)), v] for k, v in settings.items()]
    out: list[Block] = [Text(str(sentence))] if sentence else []
    return [*out, *([Table(["setting", "value"], rows)] if rows else [])]


def _usage_title(d: Diagnosis) -> str:
    useful = d.changed and d.outcome != "worse"
    return "How to use the corrected simulator" if useful else "How to use the result"


def _usage(d: Diagnosis) -> list[Block]:
    kind = "with the correction and the fitted values" if d.changed else "with the refitted values"
    text = f"In the session that made the diagnosis, diagnosis.corrected is the simulator {kind}. Anywhere else, run:"
    return [Text(text), Code(tables.usage(d))]
