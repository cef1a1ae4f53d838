"""Assess recordings before a diagnosis: what they and the sensors can reveal of a simulator, without fitting a law.

The simulator's own parameters are refitted once; everything else follows from the simulator linearised along that run:
`identifiability` says which parameters are identifiable, `detectability` which laws at which ports are detectable.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .._base import one_blas_thread, to_json
from ..data import Recording
from ..laws import Law, display_name
from .arguments import check_laws, matched
from .blind_spots import BlindSpot, Excitation, excitations, find_blind_spots, helpful_sensors, next_record
from .detectability import LawRow, assess_laws, words
from .floor import ABOVE_NOISE, noise_floor
from .gates import said_hold
from .identifiability import ParameterRow, Sensitivity, Tie, assess_parameters
from .linearise import linearised
from .remainder import lengths
from .workbench import Fitted, Workbench

FINEST = 1e-6  # noise over an output's deviation that is counted on at least: a sensor of 20 bits


@dataclass(frozen=True, eq=False)
class Check:
    """Answer of `check`: the power of recordings to reveal parameters and missing laws.

    Attributes
    ----------
    blind_spots : tuple of BlindSpot
        Facts that the recordings cannot reveal, the gravest first.
    parameters, ties : tuple of ParameterRow, tuple of Tie
        Free parameters as refitted, and groups that are traded off.
    laws : tuple of LawRow
        Every law at every port, and from what strength on it is detectable.
    classes : tuple of tuple of (port, law)
        Laws that look the same.
    excitation : tuple of Excitation
        Motion at each port.
    noise : dict
        `source`, and `deviation` and `share` of the output's deviation by output.
    error : float
        NRMSE of the refitted simulator.
    hold, starts : str, tuple of str
        Course of the inputs between samples as it was stated ("" where it was not), and the start of each recording.
    next_record : str
        The further record that would help most.
    seconds : float
    """

    blind_spots: tuple[BlindSpot, ...]
    parameters: tuple[ParameterRow, ...]
    ties: tuple[Tie, ...]
    laws: tuple[LawRow, ...]
    classes: tuple[tuple[tuple[str, str], ...], ...]
    excitation: tuple[Excitation, ...]
    noise: dict[str, Any]
    error: float
    hold: str
    starts: tuple[str, ...]
    next_record: str
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the content of check.json; numbers that are not finite are None."""
        clean: dict[str, Any] = to_json(
            {
                "schema": 1,
                "blind_spots": [asdict(b) for b in self.blind_spots],
                "parameters": [asdict(p) for p in self.parameters],
                "ties": [{**asdict(t), "sentence": t.sentence} for t in self.ties],
                "laws": [
                    {
                        **asdict(r),
                        "strength": dict(zip(("name", "value", "unit"), r.strength or (), strict=False)) or None,
                    }
                    for r in self.laws
                ],
                "classes": [[{"port": p, "law": law} for p, law in group] for group in self.classes],
                "excitation": [asdict(e) for e in self.excitation],
                "noise": self.noise,
                "error": self.error,
                "hold": self.hold or None,
                "starts": list(self.starts),
                "next_record": self.next_record,
            }
        )
        return clean

    def __str__(self) -> str:
        lines = ["Blind spots of these recordings:"] if self.blind_spots else ["No blind spot was found."]
        lines += [f"- {b.sentence}" for b in self.blind_spots]
        lines += ["", *self._parameter_lines(), "", *self._law_lines()]
        if groups := list(self._group_lines()):
            lines += ["", "Laws that look the same, one group a line:", *groups]
        lines += ["", *self._excitation_lines(), "", *self._circumstances(), f"next record: {self.next_record}"]
        return "\n".join([*lines, f"computed in {self.seconds:.1f} s"])

    def _parameter_lines(self) -> Iterator[str]:
        if not self.parameters:
            yield "The simulator has no free parameter."
            return
        yield from table(
            ("parameter", "refitted", "std. error (noise only)", "identifiable"),
            [
                (
                    p.name,
                    f"{p.value:.4g} {p.unit}",
                    "-" if p.std is None else f"{p.std:.2g} {p.unit}",
                    IDENTIFIABLE[p.status] + ", at its bound" * p.at_bound,
                )
                for p in self.parameters
            ],
        )

    def _label(self, port: str) -> str:
        """Join the names of all ports that look the same as this one."""
        groups = (b.names for b in self.blind_spots if b.kind == "alike-ports")
        return " = ".join(next((names for names in groups if port in names), (port,)))

    def _group_lines(self) -> Iterator[str]:
        """List groups of laws that look the same, beyond those at ports that all look the same."""
        for group in self.classes:
            names = dict.fromkeys(words((self._label(port), law)) for port, law in group)
            if len(names) > 1:
                yield f"- {', '.join(names)}"

    def _law_lines(self) -> Iterator[str]:
        rows = []
        ports = dict.fromkeys(r.port for r in self.laws)
        first = {self._label(name): name for name in reversed(ports)}
        for port, shown in reversed(first.items()):
            own = [r for r in self.laws if r.port == shown]
            found = sorted((r for r in own if r.status == "detectable"), key=lambda r: r.share or 0.0)
            rows += [(port, display_name(r.law), _force(r), _percent(r.share), _strength(r)) for r in found]
            for reason, laws in _undetectable(own).items():
                rows.append((port, ", ".join(map(display_name, laws)), reason, "", ""))
        columns = ("port", "law", "detectable from (rms)", "share", "strength")
        yield from table(columns, rows) if rows else ["No law is detectable at any port."]

    def _excitation_lines(self) -> Iterator[str]:
        rows = [
            (e.port, f"{e.travel:.3g} {e.unit}", str(e.reversals), str(e.amplitudes), str(e.rests))
            for e in self.excitation
        ]
        yield from table(("local coordinate", "travel", "reversals", "amplitudes", "rests"), rows)

    def _circumstances(self) -> Iterator[str]:
        noise = ", ".join(f"{name} {value:.2g}" for name, value in self.noise["deviation"].items())
        yield f"noise ({self.noise['source']}): {noise}"
        floor = float(np.mean(list(self.noise["share"].values())))
        times = self.error / max(floor, 1e-300)
        yield f"refitted: error {100 * self.error:.3g} % of the outputs' deviation, {times:.2g} times the noise"
        if times > ABOVE_NOISE:
            yield "  Something is missing or the noise is slow: the strengths above count the noise alone."
        yield f"inputs between samples: {HOLD_WORDS[self.hold]}"
        yield f"start of each recording: {', '.join(self.starts)}"


IDENTIFIABLE = {
    "identifiable": "yes",
    "dead": "no: dead, no output reacts",
    "flat": "no: flat within its bounds",
    "tied": "no: traded off, see above",
    "start": "no: traded off with the unknown start",
    "port": "only with a law at its port",
}
HOLD_WORDS = {
    "zero": "held",
    "linear": "interpolated",
    "": "not stated, here taken as held; say hold='zero' or hold='linear' if you know",
}
SOURCES = {
    "periods": "from the periods",
    "repeats": "from repeated recordings",
    "estimated": "from the refit's residual",
}


@one_blas_thread
def check(
    simulator: Any,
    train: Recording | Sequence[Recording],
    hold: str | None = None,
    laws: Sequence[type[Law]] | None = None,
    engine: str = "auto",
) -> Check:
    """Find what recordings can reveal about a simulator and about what it leaves out, before a law is fitted.

    Parameters
    ----------
    simulator : Simulator, control.StateSpace, or a fitted PI-LFR
        The simulator, with nominal parameters, bounds and ports.
    train : Recording or sequence of Recording
        The recordings that are to be diagnosed.
    hold : {"zero", "linear"}, optional
        Course of the inputs between samples, if neither recordings nor simulator say; held by default.
    laws : sequence of Law classes, optional
        By default the plainest form of each law of the catalogue.
    engine : {"auto", "c", "vm"}
        Generated C or CasADi's virtual machine; by default C where there is a compiler.

    Returns
    -------
    Check

    Raises
    ------
    InputError
        If simulator and recordings do not fit each other, or the simulation diverges or runs away from them.
    """
    simulator, recordings = matched(simulator, train, hold, excited=False)
    check_laws(laws)
    stated = said_hold(simulator, recordings, hold)
    bench = Workbench.of(simulator, recordings, stated or "zero", engine)
    fitted = bench.fit(simulator)
    bench.check_followed(fitted)
    return assess(bench, fitted, stated or "", laws)


def assess(bench: Workbench, fitted: Fitted, stated: str, laws: Sequence[type[Law]] | None = None) -> Check:
    """Assess the recordings of a bench along a refitted run; `stated` is the hold that somebody stated, if any."""
    began, simulator = time.perf_counter(), bench.simulator
    floor = noise_floor(bench.recordings, fitted.residual)
    noise = np.maximum(floor.deviation, FINEST * bench.scale)
    quiet = replace(bench, scale=noise)  # everything from here on is counted in units of the noise
    probe, runs = linearised(quiet, fitted)
    response = Sensitivity.of(quiet, probe, runs)
    parameters, ties = assess_parameters(response, quiet, fitted)
    law_rows, classes = assess_laws(quiet, fitted, probe, runs, laws, response.names)
    moving = tuple(excitations(quiet, probe, runs))
    sensors = helpful_sensors(quiet, fitted, probe, runs, response) if ties else ()
    alive = _alive_as_given(quiet, fitted, parameters)
    blind = tuple(find_blind_spots(bench, fitted, parameters, alive, ties, law_rows, classes, moving))
    by_output = dict(zip(simulator.output_names, zip(noise, noise / bench.scale, strict=True), strict=True))
    return Check(
        blind_spots=blind,
        parameters=parameters,
        ties=ties,
        laws=law_rows,
        classes=classes,
        excitation=moving,
        noise={
            "source": SOURCES[floor.source],
            "deviation": {k: float(v[0]) for k, v in by_output.items()},
            "share": {k: float(v[1]) for k, v in by_output.items()},
        },
        error=fitted.cost**0.5,
        hold=stated,
        starts=tuple(_start(r) for r in bench.recordings),
        next_record=next_record(bench, blind, ties, sensors),
        seconds=time.perf_counter() - began,
    )


def _alive_as_given(bench: Workbench, fitted: Fitted, parameters: Sequence[ParameterRow]) -> tuple[str, ...]:
    """Find parameters that are dead or flat as refitted and move the outputs at the given values."""
    doubtful = [p.name for p in parameters if p.status in ("dead", "flat")]
    values = {k: p.value for k, p in fitted.model.parameters.items()}
    given = bench.result(fitted.simulator, values, fitted.initial, fitted.engine, fitted.model) if doubtful else fitted
    if not doubtful or not np.isfinite(given.cost):
        return ()
    response = Sensitivity.of(bench, *linearised(bench, given))
    moved = lengths(response.raw * response.room) >= 1
    return tuple(name for name, there in zip(response.names, moved, strict=True) if there and name in doubtful)


def _start(r: Recording) -> str:
    words = {"zero": "at zero", "estimate": "estimated", "periodic": "periodic", "given": "as given"}
    return words[r.begins]


def _undetectable(rows: Sequence[LawRow]) -> dict[str, list[str]]:
    """Group the laws that are not detectable by the reason in words."""
    out: dict[str, list[str]] = {}
    for r in rows:
        if r.status != "detectable":
            reason = {"followed": f"no: followed by {r.why}", "weak": "no: below the noise", "no data": f"no: {r.why}"}
            out.setdefault(reason[r.status], []).append(r.law)
    return out


def _force(r: LawRow) -> str:
    return f"{r.force:.2g} {r.unit}".rstrip()


def _strength(r: LawRow) -> str:
    return f"{r.strength[0]} = {r.strength[1]:.2g} {r.strength[2]}".rstrip() if r.strength else ""


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.2g} %"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Align rows of text in columns."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    for row in (head, *rows):
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
