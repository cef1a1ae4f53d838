"""The work at one machine of a fleet: a refit, a diagnosis, values with the common physics, and what is left.

Each step is a job: it depends on the recordings of one machine and on what the fleet has found so far, runs in any
process, and gives numbers for the manifest and files for its folder.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, digest, to_json
from ..data import Recording, fingerprint
from ..diagnose import Diagnosis, Replication, add_scaled_laws, diagnose, refit_error, replicate
from ..laws import Law
from ..simulators import Simulator
from .executor import Outcome

REFIT, SAMPLE, MEASURE, REST = "refit", "sample", "measure", "rest"  # the steps at a machine
DONE = "DONE"  # status of a job with a result
PAGE, CONTENT, RESIDUAL = "report.html", "diagnosis.json", "residual.json"  # files of jobs
MOST_POINTS = 400  # samples of a residual that are kept for its picture


@dataclass(frozen=True, eq=False)
class LawAt:
    """A law of the common physics: its port, class, start values and limits, as JSON can hold them."""

    port: str
    law: str
    id: str
    form: str
    parameters: Mapping[str, Mapping[str, Any]]

    def build(self, known: Mapping[str, type[Law]]) -> tuple[str, Law]:
        """Return the port and the law; `known` are the classes by name."""
        if self.law not in known:
            raise InputError(
                f"The common physics has the law {self.law}, which is not among the laws; give it in laws=."
            )
        values = {name: _array(p["value"], 0.0) for name, p in self.parameters.items()}
        ends = {k: (_array(p["low"], -np.inf), _array(p["high"], np.inf)) for k, p in self.parameters.items()}
        return self.port, known[self.law]().at(values, ends)


def _array(value: Any, missing: float) -> Any:
    """Return a number or array with `missing` in place of None."""
    found = np.asarray(value, dtype=float)
    found = np.where(np.isnan(found), missing, found)
    return float(found) if found.ndim == 0 else found


@dataclass(frozen=True, eq=False)
class MachineJob:
    """A step at a machine; `laws` are the common physics, `starts` values by name to fit from."""

    step: str
    machine: str
    key: str
    recordings: tuple[Recording, ...]
    laws: tuple[LawAt, ...] = ()  # not the laws themselves: a class made at run time is another one once it is sent
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
        """The laws that a diagnosis tries, by the names of their classes."""
        return {law.__name__: law for law in add_scaled_laws(self.laws, self.simulator)}

    def build(self, laws: Sequence[LawAt]) -> list[tuple[str, Law]]:
        """Return the ports and the laws."""
        known = self.known
        return [law.build(known) for law in laws]

    def __call__(self, job: MachineJob) -> Outcome:
        """Execute a step at a machine."""
        step = {REFIT: self._refit, SAMPLE: self._sample, MEASURE: self._measure, REST: self._rest}[job.step]
        began = time.perf_counter()
        return replace(step(job), seconds=time.perf_counter() - began)

    def key(self, job: MachineJob) -> str:
        """Compute the digest of everything that a job's result depends on, but for versions."""
        return digest(
            {
                "step": job.step,
                "simulator": simulator_digest(self.simulator),
                "data": [_contents(r) for r in job.recordings],
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
        return Outcome({**_answer(found), "hypotheses": self._hypotheses(found)}, files=_files(found))

    def _measure(self, job: MachineJob) -> Outcome:
        laws = self.build(job.laws)
        found = replicate(self.simulator, job.recordings, laws, job.starts, hold=self.hold, engine=self.engine)
        return Outcome(measured_entry(found), files={RESIDUAL: _residual(found, job.recordings)})

    def _rest(self, job: MachineJob) -> Outcome:
        """Diagnose a machine that lacks more than the common physics, from the simulator with that physics."""
        corrected = self.simulator
        for port, law in self.build(job.laws):
            corrected = corrected.with_element(port, law)
        own = corrected.parameter_set
        corrected = corrected.with_parameters(own.at(own.pack(job.starts[0])))
        found = self._diagnose(corrected, job.recordings)
        return Outcome(_answer(found), files=_files(found))

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
        return replace(found, seconds=0.0)  # the page is the same in every execution

    def _hypotheses(self, found: Diagnosis) -> list[dict[str, Any]]:
        """List the fitted hypotheses whose laws are among `laws`, with their evidence relative to the refit's."""
        search, known = found.evidence["search"], self.known
        out = []
        for trial in search.memo.values():
            if any(known.get(type(e.law).__name__) is not type(e.law) for e in trial.laws):
                continue
            prior = search.log_prior(trial)
            gain = search.evidence(trial) - search.evidence(search.root)
            if not np.isfinite(gain):
                continue
            laws = [
                asdict(LawAt(e.port, type(e.law).__name__, e.law.id, e.law.form, _numbers(e, trial.fitted)))
                for e in trial.laws
            ]
            out.append({"laws": laws, "log_evidence": float(gain - prior), "log_prior": float(prior)})
        return out


def _numbers(element: Any, fitted: Any) -> dict[str, Any]:
    """Return value and limits of each parameter of a fitted law."""
    own = element.own(fitted.values)
    return {
        name: to_json({"value": own[name], "low": p.bounds[0], "high": p.bounds[1]})
        for name, p in element.law.parameters().items()
    }


def _answer(found: Diagnosis) -> dict[str, Any]:
    """Return the entry of a diagnosis."""
    content = found.to_dict()
    effects = [{k: e[k] for k in ("port", "law", "confidence", "parameters")} for e in content["effects"]]
    answer = {"status": DONE, "verdict": found.verdict, "sentence": found.summary, "hold": found.hold}
    return {**answer, "effects": effects, "fit": content["fit"]}


def _files(found: Diagnosis) -> dict[str, str]:
    """Return the page and the content of a diagnosis."""
    from ..report import diagnosis_page

    content = json.dumps(found.to_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    return {PAGE: diagnosis_page(found).html(), CONTENT: content}


def measured_entry(found: Replication) -> dict[str, Any]:
    """Return the numbers of a machine with the common physics, for JSON."""
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


def _residual(found: Replication, recordings: Sequence[Recording]) -> str:
    """Return the first output's residual over all recordings, in bins with their largest and smallest value."""
    error = np.concatenate([e[:, 0] for e in found.residuals])
    bins = np.array_split(error, min(MOST_POINTS // 2, len(error)))
    low, high = ([float(f"{pick(b):.4g}") for b in bins] for pick in (np.min, np.max))
    seconds = len(error) * recordings[0].dt
    return json.dumps({"seconds": round(seconds, 9), "low": low, "high": high, "noise": found.noise}) + "\n"


def _contents(recording: Recording) -> list[Any]:
    """Return everything of a recording that a result depends on."""
    names = [list(recording.inputs), list(recording.outputs), recording.name]
    return [fingerprint(recording), *names, recording.dt, recording.hold, recording.skip]


def simulator_digest(simulator: Simulator) -> str:
    """Compute the digest of a simulator: its equations with ports, and its parameters."""
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
    said = [simulator.hold, simulator.discrete, to_json(simulator.observer), simulator.substeps]
    return digest({"equations": equations, "ports": ports, "parameters": parameters, "laws": elements, "said": said})
