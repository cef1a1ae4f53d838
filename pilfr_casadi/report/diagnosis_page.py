"""The page of a diagnosis: the verdict, where it hurts, what is missing, the proof, and how to use it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import plots
from ..diagnose import Diagnosis, Fitted, Workbench, mismatch
from . import diagnosis_tables as tables
from .diagnosis_hidden import force_blocks
from .diagnosis_runs import Comparison, comparisons, replay, steps
from .diagnosis_tables import words
from .page import Block, Code, Page, Picture, Section, Text

MOST = 3  # outputs and recordings drawn; tables have them all


@dataclass(frozen=True, eq=False)
class _Case:
    """A diagnosis with what its pictures need."""

    diagnosis: Diagnosis
    bench: Workbench
    before: Fitted | None
    after: Fitted | None
    noise: np.ndarray
    found: dict[str, Any]

    @classmethod
    def of(cls, d: Diagnosis) -> _Case:
        bench = Workbench.of(d.refitted, d.train, d.hold)
        search = d.evidence.get("search")
        noise = float(d.floor["nrmse"]) * bench.scale if search is None else np.asarray(search.floor.deviation)
        noise = np.nan_to_num(noise)
        before = replay(bench, d.refitted, steps(d, "without"))
        after = replay(bench, d.corrected, steps(d, "after")) if d.corrected.elements else before
        found = d.mismatch
        if "map" not in found and before is not None:
            simulated = [e + r.y for e, r in zip(before.residual, bench.recordings, strict=True)]
            found = mismatch(bench.recordings, before.residual, simulated, noise, bench.scale)
        return cls(d, bench, before, after, noise, dict(found))

    def unit(self, name: str) -> str:
        """Unit of an input or output, where it is known."""
        known = self.bench.recordings[0].units
        return known.get(name, self.diagnosis.refitted.units.get(name, ""))


def diagnosis_page(diagnosis: Diagnosis) -> Page:
    """Fill a page; see `diagnosis_report`."""
    case = _Case.of(diagnosis)
    notes = Section("What the recordings' checks found", _notes(diagnosis))
    faulty = diagnosis.verdict == "recording-fault"
    sections = [
        *([notes] if faulty else []),
        Section("What is missing" if diagnosis.effects else "How well it does", _verdict(case)),
        Section("Where it hurts", _where(case)),
        Section("The hidden force", _hidden(case)),
        Section("What was tried", _tried(diagnosis)),
        Section("The simulator's own parameters", [tables.parameter_table(diagnosis)] if diagnosis.parameters else []),
        Section("The proof" if diagnosis.test else "Measured and simulated", _proof(case)),
        *([] if faulty else [notes]),
        Section("The next experiment", _next(diagnosis)),
        Section(_usage_title(diagnosis), _usage(case)),
    ]
    names = f"{', '.join(diagnosis.refitted.inputs)} → {', '.join(diagnosis.refitted.output_names)}"
    return Page(
        f"Diagnosis of a simulator: {names}",
        [s for s in sections if s.blocks],
        subtitle=_subtitle(case),
        status=tables.headline(diagnosis),
        tone=tables.tone(diagnosis),
        facts=tables.facts(diagnosis),
    )


def _usage_title(d: Diagnosis) -> str:
    corrected = (d.effects or d.description) and d.outcome != "worse"
    return "How to use the corrected simulator" if corrected else "How to use the result"


def _subtitle(case: _Case) -> str:
    d, r = case.diagnosis, case.bench.recordings[0]
    total = sum(map(len, d.train))
    parts = [f"{len(d.train)} training recording{'s' * (len(d.train) != 1)}, {total} samples"]
    parts += [f"{len(d.test)} held out, {sum(map(len, d.test))} samples"] if d.test else ["none held out"]
    between = {"zero": "held", "linear": "interpolated"}.get(d.hold, d.hold)
    parts += [f"step {r.dt:.4g} s", f"inputs {between} between samples", f"{d.seconds:.1f} s of work"]
    return "; ".join(parts)


def _verdict(case: _Case) -> list[Block]:
    d = case.diagnosis
    out: list[Block] = []
    for k in range(len(d.effects)):
        out += tables.effect_blocks(d, k)
    if d.verdict == "complete" and not d.let_go:
        out.append(Text("Refitted inside its bounds, the simulator follows the recordings down to the noise."))
    elif d.verdict == "unexplained":
        out.append(Text("No law of the catalogue explains what is missing; below is where it acts, and how."))
    elif d.verdict == "recording-fault":
        out.append(Text("Before physics is looked for, the recordings need a correction; see the checks above."))
    return [*out, tables.error_table(d), *map(Text, d.warnings())]


def _where(case: _Case) -> list[Block]:
    found = case.found
    out: list[Block] = [Text(found["sentence"])] if found.get("sentence") else []
    if "map" not in found:
        return out
    unit = case.unit(next(iter(found["scale"])))
    outputs = "the outputs" if len(found["scale"]) > 1 else next(iter(found["scale"]))
    intro = "The residual of the refitted simulator, without any law added"
    return [
        *out,
        Picture(
            plots.mismatch_map(found, unit).figure,
            f"{intro}, over frequency and the amplitude of {outputs}.",
            "Map of the residual over frequency and amplitude.",
        ),
        Picture(
            plots.mismatch_bands(found).figure,
            "The same by band of frequency, beside the noise floor.",
            "Residual by band of frequency.",
        ),
        Picture(
            plots.mismatch_growth(found, unit).figure,
            "Growth with amplitude. The refit has bent the parameters to hide what it can: this says where the "
            "simulator fails, not why.",
            "Residual over amplitude.",
        ),
        Picture(
            plots.mismatch_growth(found, unit, kind="rate").figure,
            "Growth with speed.",
            "Residual over rate.",
        ),
        Picture(
            plots.mismatch_time(found).figure,
            "The same over time, beside the motion of the output.",
            "Residual over time.",
        ),
        Picture(
            plots.mismatch_level(found, case.unit(found["level"]["output"])).figure,
            f"The same over the value of {found['level']['output']}.",
            "Residual over the value of the output.",
        ),
    ]


def _hidden(case: _Case) -> list[Block]:
    d, out = case.diagnosis, list[Block]()
    for e in d.effects:
        number = next((i for i, p in enumerate(d.corrected.elements) if (p.port, p.law.id) == (e.port, e.law)), None)
        if case.after is not None and number is not None:
            out += force_blocks(case.bench, case.noise, case.after, e.port, number, words(e.law))
    if d.verdict == "unexplained":
        search = d.evidence.get("search")
        rows = tables.passes(d)
        nearest = search.passes[0].choice if search is not None and search.passes else None
        if nearest is not None:
            winner = nearest.winner
            fitted = replay(case.bench, winner.fitted.corrected(), winner.fitted.model.substeps)
            if fitted is not None:
                number, name = len(fitted.simulator.elements) - 1, f"{words(winner.law.id)} (the nearest law)"
                out += force_blocks(case.bench, case.noise, fitted, winner.port, number, name)
        elif rows and case.before is not None:
            out += force_blocks(case.bench, case.noise, case.before, rows[0][0]["port"], None, "")
        table = tables.flexible_table(d)
        if table is not None:
            out.append(table)
            freest = str(table.rows[0][0])
            if case.before is not None and (nearest is None or freest != nearest.winner.port):
                out += force_blocks(case.bench, case.noise, case.before, freest, None, "")
    return out


def _tried(d: Diagnosis) -> list[Block]:
    out: list[Block] = []
    chosen = {(e.port, e.law) for e in d.effects}
    for k, rows in enumerate(tables.passes(d)):
        own = {(d.effects[k].port, d.effects[k].law)} if k < len(d.effects) else set() if k else chosen
        title = "Every port and law that was fitted"
        if k:
            before = " and ".join(f"{words(e.law)} at {e.port}" for e in d.effects[:k]) or "the first"
            title = f"A second look, with {before} in place"
        cells = [(r["port"], words(r["law"]), tables.held_out(r)) for r in rows]
        framed = [(port, words(law)) for port, law in own]
        figure = plots.port_law_map(cells, framed, tables.held_out_before(d, k), d.floor["nrmse"] or None).figure
        caption = (
            f"{title}: the error on the part of the training recordings that was not fitted, in %, by port and law "
            "(best form). Grey: left out by the quick test before the fits."
        )
        out += [Picture(figure, caption, "Errors by port and law.", wide=len({r["port"] for r in rows}) > 6)]
        out += tables.candidate_tables(rows, own, title)
    return out


def _proof(case: _Case) -> list[Block]:
    d = case.diagnosis
    shown = comparisons(case.bench, d.test or d.train, d, "test" if d.test else "training")
    out: list[Block] = []
    if d.test:
        text = "Simulated from their inputs alone. These recordings were used neither to fit nor to choose"
        out.append(Text(f"{text}; only their initial state was estimated where it is unknown."))
    for c in shown[:MOST]:
        for i in range(min(c.recording.n_y, MOST)):
            out += _compared(case, c, i)
    return out


def _compared(case: _Case, c: Comparison, i: int) -> list[Block]:
    r, name = c.recording, c.recording.outputs[i]
    unit, floor = case.unit(name), float(case.noise[i])
    simulated: plots.Simulated = [("refitted", c.before)]
    if what := tables.correction_words(case.diagnosis):
        simulated.append((what.removesuffix(" put back").removesuffix(" added"), c.after))
    gone = [label for label, v in simulated if v is None]
    lost = f" The simulation diverges: {', '.join(gone)}." if gone else ""
    where = f"{name} in {r.name}"
    return [
        Picture(
            plots.compared_traces(r, simulated, i, unit).figure,
            f"{where}: measured and simulated, around the largest excursion.{lost}",
            f"Measured and simulated {where}.",
        ),
        Picture(
            plots.compared_traces(r, simulated, i, unit, quiet=True).figure,
            f"{where}: the same in a stretch with little motion.",
            f"Measured and simulated {where}, little motion.",
        ),
        Picture(
            plots.compared_residuals(r, simulated, i, unit, floor).figure,
            f"{where}: what is left, the whole recording.",
            f"Residuals of {where}.",
        ),
        Picture(
            plots.compared_spectra(r, simulated, i, unit, floor).figure,
            f"{where}: output and what is left over frequency, beside the noise floor.",
            f"Spectra of {where}.",
        ),
    ]


def _notes(d: Diagnosis) -> list[Block]:
    table = tables.note_table(d)
    return [table] if table else []


def _next(d: Diagnosis) -> list[Block]:
    if not d.next_experiment:
        return []
    known = {k: v for k, v in d.next_experiment.items() if isinstance(v, str | int | float) and k != "sentence"}
    out: list[Block] = [Text(str(d.next_experiment["sentence"]))] if d.next_experiment.get("sentence") else []
    rows = [[words(str(k)), v] for k, v in known.items()]
    return [*out, *([tables.Table(["what", "value"], rows)] if rows else [])]


def _usage(case: _Case) -> list[Block]:
    d = case.diagnosis
    kind = "with the law closed in, at the fitted values" if d.effects else "refitted"
    text = f"In the session that made the diagnosis, diagnosis.corrected is the simulator {kind}. Anywhere else:"
    return [Text(text), Code(tables.usage(d))]
