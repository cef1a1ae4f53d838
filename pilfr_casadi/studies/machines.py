"""The steps at one machine of a fleet: a refit, a diagnosis, a fit with the common physics, a diagnosis of the rest.

Each step is a job. It depends on the recordings of one machine and on earlier results of the fleet, runs in any
process, and returns numbers for the manifest and files for its folder.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, digest, in_words, json_text, to_json
from ..data import Recording, fingerprint
from ..diagnose import (
    Diagnosis,
    Replication,
    add_scaled_laws,
    diagnose,
    find_channel_faults,
    refit_error,
    replicate,
)
from ..laws import Law
from ..simulators import Simulator, name_at
from .executor import Outcome

REFIT, SAMPLE, MEASURE, REST = "refit", "sample", "measure", "rest"  # the steps at a machine
DONE = "DONE"  # status of a job with a result
PAGE, DIAGNOSIS, RESIDUAL = "report.html", "diagnosis.json", "residual.json"  # files of jobs
MOST_POINTS = 400  # samples of a residual that its picture shows


@dataclass(frozen=True, eq=False)
class LawAt:
    """A law of the common physics: its port, class, start values and limits, as JSON types."""

    port: str
    law: str
    id: str
    form: str
    parameters: Mapping[str, Mapping[str, Any]]

    def build(self, known: Mapping[str, type[Law]]) -> tuple[str, Law]:
        """Return the port and the law; `known` are the classes by name."""
        if self.law not in known:
            raise InputError(
                f"The common physics has the law {self.law}, which is not among the given laws; add it to laws=."
            )
        values = {name: fill_missing(p["value"], 0.0) for name, p in self.parameters.items()}
        limits = {
            name: (fill_missing(p["low"], -np.inf), fill_missing(p["high"], np.inf))
            for name, p in self.parameters.items()
        }
        return self.port, known[self.law]().at(values, limits)


def fill_missing(value: Any, missing: float) -> np.ndarray:
    """Convert a number or array of JSON, with `missing` in place of null."""
    return np.nan_to_num(np.asarray(value, dtype=float), nan=missing, posinf=np.inf, neginf=-np.inf)


@dataclass(frozen=True, eq=False)
class MachineJob:
    """A step at a machine; `laws` are the common physics, `starts` are values by name from which to fit."""

    step: str
    machine: str
    key: str
    recordings: tuple[Recording, ...]
    laws: tuple[LawAt, ...] = ()  # not classes: a class made at run time is a different one after unpickling
    starts: tuple[Mapping[str, Any], ...] = ()

    @property
    def id(self) -> str:
        """Name of the job and of its folder."""
        return f"{self.step}-{self.machine}"

    @property
    def parameters(self) -> dict[str, str]:
        """Step and machine."""
        return {"step": self.step, "machine": self.machine}


@dataclass(frozen=True, eq=False)
class MachineWork:
    """The simulator and the options of `diagnose`, which all jobs share."""

    simulator: Simulator
    hold: str | None
    laws: tuple[type[Law], ...]
    effects: int | None
    engine: str

    @property
    def known(self) -> dict[str, type[Law]]:
        """The laws that a diagnosis tries, by class name."""
        return {law.__name__: law for law in add_scaled_laws(self.laws, self.simulator)}

    def build(self, laws: Sequence[LawAt]) -> list[tuple[str, Law]]:
        """Return the ports and the laws."""
        known = self.known
        return [law.build(known) for law in laws]

    def place(self, laws: Sequence[LawAt]) -> Simulator:
        """Return the simulator with the laws in its ports."""
        placed = self.simulator
        for port, law in self.build(laws):
            placed = placed.with_element(port, law)
        return placed

    def channel_faults(self, laws: Sequence[LawAt], recordings: Any) -> list[str]:
        """Describe wrong signs and units and exchanged channels, which the usual values of the fleet reveal."""
        return list(find_channel_faults(self.place(laws), recordings, hold=self.hold, engine=self.engine))

    def __call__(self, job: MachineJob) -> Outcome:
        """Execute a step at a machine."""
        step = {REFIT: self._refit, SAMPLE: self._sample, MEASURE: self._measure, REST: self._rest}[job.step]
        began = time.perf_counter()
        return replace(step(job), seconds=time.perf_counter() - began)

    def key(self, job: MachineJob) -> str:
        """Compute the digest of everything that a job's result depends on, except versions."""
        return digest(
            {
                "step": job.step,
                "simulator": simulator_digest(self.simulator),
                "data": [_recording_content(r) for r in job.recordings],
                "options": [self.hold, [*self.known], self.effects, self.engine],
                "laws": [asdict(law) for law in job.laws],
                "starts": to_json(job.starts),
            }
        )

    def _refit(self, job: MachineJob) -> Outcome:
        error = refit_error(self.simulator, job.recordings, hold=self.hold, engine=self.engine)
        return Outcome({"status": DONE, "sentence": f"Refitted, its error is {error:.4f}.", "nrmse": error})

    def _sample(self, job: MachineJob) -> Outcome:
        found = self._diagnose(self.simulator, job.recordings)
        named = in_words([name_at(e.port, e.law, e.form) for e in found.effects]) or "no law"
        sentence = f"Diagnosed alone, it suggests {named}; the comparison with the other machines decides."
        sentence = " ".join([sentence, *found.corrected_faults])
        entry = {**_diagnosis_entry(found), "sentence": sentence, "hypotheses": self._hypotheses(found)}
        return Outcome(entry, files=_diagnosis_files(found))

    def _measure(self, job: MachineJob) -> Outcome:
        laws = self.build(job.laws)
        found = replicate(self.simulator, job.recordings, laws, job.starts, hold=self.hold, engine=self.engine)
        return Outcome(measured_entry(found), files={RESIDUAL: _bin_residual(found, job.recordings)})

    def _rest(self, job: MachineJob) -> Outcome:
        """Diagnose a machine that lacks more than the common physics, from the simulator with that physics.

        Its fitted values have followed a wrong unit or sign as far as they can, so that is sought first, without them.
        """
        if faults := self.channel_faults(job.laws, job.recordings):
            entry = {"status": DONE, "verdict": "recording-fault", "effects": [], "faults": faults}
            return Outcome({**entry, "sentence": " ".join(faults)})
        corrected = self.place(job.laws)
        own = corrected.parameter_set
        corrected = corrected.with_parameters(own.at(own.pack(job.starts[0])))
        found = self._diagnose(corrected, job.recordings)
        return Outcome(_diagnosis_entry(found), files=_diagnosis_files(found))

    def _diagnose(self, simulator: Simulator, recordings: Sequence[Recording]) -> Diagnosis:
        found = diagnose(
            simulator,
            recordings,
            hold=self.hold,
            laws=self.laws,
            effects=self.effects,
            workers=1,
            engine=self.engine,
        )
        if found.interrupted:
            raise KeyboardInterrupt
        return replace(found, seconds=0.0)  # so that the page is the same in every execution

    def _hypotheses(self, found: Diagnosis) -> list[dict[str, Any]]:
        """List the fitted hypotheses whose laws are known, with their evidence relative to the plain refit."""
        search, known = found.evidence.search, self.known
        out = []
        for trial in search.memo.values():
            if any(known.get(type(e.law).__name__) is not type(e.law) for e in trial.laws):
                continue
            prior = search.log_prior(trial)
            gain = search.evidence(trial) - search.evidence(search.root)
            if not np.isfinite(gain):
                continue
            laws = [
                asdict(LawAt(e.port, type(e.law).__name__, e.law.id, e.law.form, _describe_parameters(e, trial.fitted)))
                for e in trial.laws
            ]
            out.append({"laws": laws, "log_evidence": float(gain - prior), "log_prior": float(prior)})
        return out


def _describe_parameters(element: Any, fitted: Any) -> dict[str, Any]:
    """Return the value and limits of each parameter of a fitted law."""
    own = element.own(fitted.values)
    return {
        name: to_json({"value": own[name], "low": p.bounds[0], "high": p.bounds[1]})
        for name, p in element.law.parameters().items()
    }


def _diagnosis_entry(found: Diagnosis) -> dict[str, Any]:
    content = found.to_dict()
    effects = [{k: e[k] for k in ("port", "law", "confidence", "parameters")} for e in content["effects"]]
    entry = {"status": DONE, "verdict": found.verdict, "sentence": found.summary, "hold": found.hold}
    return {**entry, "effects": effects, "fit": content["fit"]}


def _diagnosis_files(found: Diagnosis) -> dict[str, str]:
    from ..report import diagnosis_page

    return {PAGE: diagnosis_page(found).html(), DIAGNOSIS: json_text(found.to_dict())}


def measured_entry(found: Replication) -> dict[str, Any]:
    """Return the manifest entry of a machine that was fitted with the common physics."""
    numbers = {
        "nrmse_before": found.nrmse_before,
        "nrmse_after": found.nrmse_after,
        "noise": found.noise,
        "remainder": found.remainder,
        "remainder_error": found.remainder_error,
        "gain": found.gain,
        "values": found.estimate.values,
        "errors": found.estimate.errors,
        "widths": found.widths,
        "by_recording": [{"values": v.values, "errors": v.errors} for v in found.by_recording],
        "parameters": found.after.values,
    }
    sentence = f"With the common physics, its error is {found.nrmse_after:.4f}, the noise {found.noise:.4f}."
    return {"status": DONE, "sentence": sentence, **to_json(numbers)}


def _bin_residual(found: Replication, recordings: Sequence[Recording]) -> str:
    """Bin the first output's residual over all recordings; return the extremes of each bin as JSON."""
    error = np.concatenate([e[:, 0] for e in found.residuals])
    bins = np.array_split(error, min(MOST_POINTS // 2, len(error)))
    low, high = ([float(f"{pick(b):.4g}") for b in bins] for pick in (np.min, np.max))
    seconds = len(error) * recordings[0].dt
    return json.dumps({"seconds": round(seconds, 9), "low": low, "high": high, "noise": found.noise}) + "\n"


def _recording_content(recording: Recording) -> list[Any]:
    """List everything in a recording that a result depends on."""
    names = [list(recording.inputs), list(recording.outputs), recording.name]
    return [fingerprint(recording), *names, recording.dt, recording.hold, recording.skip]


def simulator_digest(simulator: Simulator) -> str:
    """Compute the digest of a simulator's equations, ports and parameters."""
    x, u, p, t = simulator.symbols()
    ports, z = {}, ca.SX.sym("z", 2)
    parts = [simulator.derivatives(x, u, p, t), *simulator.measured(x, u, p, t).values()]
    for port in simulator.all_ports():
        into = simulator.into(port, x, u, p, t) if not port.series else {}
        ports[port.name] = [*into, port.domain, *port.signals]
        parts += [*into.values(), simulator.across(port, x, u, p, t)]
        parts += simulator.port_signals(port, x, u, p, t).values()
        parts += [simulator.rate(port, x, u, p, t)] if port.rate else []
        parts += [simulator.term(port, z[0], z[1], x, u, p)] if port.term else []
    symbols = [ca.vertcat(*names._values.values()) for names in (x, u)]
    symbols += [ca.vertcat(*(ca.vec(v) for v in p._values.values())), t, z]
    expressions = ca.vertcat(*parts)
    try:
        equations = ca.Function("simulator", symbols, [expressions]).serialize()
    except RuntimeError:  # a program that is called with numbers
        equations = str(expressions)
    parameters = {
        name: to_json([q.value, np.nan_to_num(q.bounds[0]), np.nan_to_num(q.bounds[1]), q.fixed])
        for name, q in simulator.parameters.items()
    }
    elements = [[e.port, type(e.law).__name__] for e in simulator.elements]
    options = [simulator.hold, simulator.discrete, to_json(simulator.observer), simulator.substeps]
    return digest({"equations": equations, "ports": ports, "parameters": parameters, "laws": elements, "said": options})
