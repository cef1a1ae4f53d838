"""Diagnose a fleet, one simulator and recordings of many machines: the physics they all lack, and which differ.

The steps:

1. Every machine: the simulator is refitted as given.
2. A sample of machines, spread evenly over the ranks of their errors, is diagnosed, each machine alone. The common
   physics is the hypothesis with the largest evidence, summed over the sample, among the hypotheses that were fitted to
   every sampled machine. It may be the hypothesis that nothing is missing.
3. Every machine: the simulator is fitted with and without the common physics (`machines`, `diagnose.replicate`). With
   several recordings, each is also fitted alone.
4. `population` estimates the distributions of each value, of its trend in time, and of the remaining error over the
   machines, and the probability that each machine differs.
5. Machines whose error shows that they lack more are checked for a wrong sign or unit of a channel. If there is none,
   they are diagnosed alone, from the simulator with the common physics.

A step at a machine is a job. Jobs run side by side and are recorded in the folder, as in a campaign: however a fleet
ends, the same call continues from there, and gives the same bytes with any executor and any number of workers.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import (
    InputError,
    Progress,
    check_executor,
    deferred_interrupt,
    digest,
    is_number,
    make_folder,
    numbers,
    processors,
    to_json,
    whole,
)
from ..data import Recording, as_recordings
from ..diagnose import SURE, check_laws, match_recordings
from ..laws import Law
from ..simulators import Simulator, as_simulator
from .execution import NoModel, PrintLine, RunInterrupted
from .executor import AHEAD, Effort, run_side_by_side, versions
from .fleet_result import (
    CONTENT,
    PAGES,
    TABLE,
    Common,
    Fleet,
    Machine,
    distributions,
    judge_entry,
    values_by_recording,
)
from .folder import JOBS, Layout, Manifest, check_own, lock_folder, refuse_other_versions
from .machines import (
    DIAGNOSIS,
    DONE,
    MEASURE,
    PAGE,
    REFIT,
    RESIDUAL,
    REST,
    SAMPLE,
    LawAt,
    MachineJob,
    MachineWork,
    fill_missing,
)

SAMPLE_SIZE = 4  # machines that are diagnosed to find the common physics
FEWEST_MACHINES = 2
FLEET = Layout("fleet", "simulator file", (CONTENT, TABLE, PAGE, PAGES), (PAGE, DIAGNOSIS, RESIDUAL))
STAGES = {  # of each step at some machines, in words
    REFIT: "refit of the simulator as given, machine by machine",
    SAMPLE: "diagnosis of single machines, to find the common physics",
    MEASURE: "fit with the common physics, machine by machine",
    REST: "diagnosis of machines that lack more",
}
Recordings = Recording | Sequence[Recording]


def fleet(
    simulator: Any,
    machines: Mapping[str, Recordings],
    *,
    times: Mapping[str, Sequence[float]] | None = None,
    sample: int = SAMPLE_SIZE,
    hold: str | None = None,
    laws: Sequence[type[Law]] | None = None,
    effects: int | None = None,
    engine: str = "auto",
    workers: int | None = None,
    executor: Executor | None = None,
    ahead: int = AHEAD,
    time_limit: float | None = None,
    out: Any = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    tell: PrintLine | None = None,
) -> Fleet:
    """Find the physics that all machines of a fleet lack, and the machines that differ, drift or lack more.

    Parameters
    ----------
    simulator : Simulator, control.StateSpace, or a fitted PI-LFR
        The simulator of all machines.
    machines : mapping
        Recordings of each machine by its name, in the order of time.
    times : mapping, optional
        Time of each recording by machine, in any unit; by default 0, 1, 2, ...
    sample : int
        Number of machines that are diagnosed to find the common physics.
    hold, laws, effects, engine
        As for `diagnose`.
    workers : int, optional
        Number of processes, by default one per processor; 1 without a time limit runs in this process.
    executor : concurrent.futures.Executor, optional
        Runs the work instead of these processes, for example `dask.distributed.Client(address).get_executor()`.
    ahead : int
        Number of jobs submitted to the executor at a time; at least its number of workers.
    time_limit : float, optional
        Seconds after which a step at a machine is stopped; its entry records this.
    out : path, optional
        Folder of the results: empty, new, or from an earlier call, which continues. By default nothing is written.
    overwrite : bool
        Compute everything again, even if the folder has results.
    progress : callable
        Called with (stage, done, total, smallest error so far).
    tell : callable
        Called with a line of text after every job.

    Returns
    -------
    Fleet

    Raises
    ------
    InputError
        If an argument is wrong, or simulator and recordings do not fit each other. Its subclass `NoModel` is raised if
        no machine could be fitted.
    RunInterrupted
        On Ctrl-C; complete jobs are kept in `out`.
    """
    check_executor(executor)
    given = _check_machines(machines)
    count = min(whole(sample, "sample", 1), len(given))
    effort = Effort(processors() if workers is None else whole(workers, "workers", 1), time_limit)
    if time_limit is not None and not (is_number(time_limit) and time_limit > 0):
        raise InputError(f"time_limit={time_limit!r} was given; give seconds, a positive number.")
    own = as_simulator(simulator, next(iter(given.values())))
    given = _match_machines(own, given, hold)
    most = None if effects is None else whole(effects, "effects", 0)
    work = MachineWork(own, hold, check_laws(laws), most, engine)
    when = _check_times(times, given)
    with _open_folder(out, overwrite) as manifest:
        execution = _FleetExecution(
            work, given, manifest, effort, executor, ahead, progress or (lambda *_: None), tell or (lambda _: None)
        )
        try:
            return execution.execute(count, when)
        except KeyboardInterrupt:
            raise RunInterrupted(execution.done, execution.total) from None


def _check_machines(machines: Any) -> dict[str, tuple[Recording, ...]]:
    """Return the recordings of each machine; refuse names that cannot name a folder."""
    if not isinstance(machines, Mapping):
        raise InputError(f"The machines are {str(machines)[:60]}; give recordings by name, {{name: recordings}}.")
    if len(machines) < FEWEST_MACHINES:
        raise InputError(f"A fleet needs at least {FEWEST_MACHINES} machines; for one machine use diagnose.")
    for name in machines:
        if not isinstance(name, str) or not re.fullmatch(r"[\w.+-][\w .+-]{0,99}", name, re.ASCII):
            raise InputError(
                f"A machine is named {name!r}; give up to 100 letters, digits, spaces, dots, and the signs + - _."
            )
    if len({name.lower() for name in machines}) < len(machines):
        raise InputError("Two machines have names that differ in upper and lower case only; rename one of them.")
    return {name: tuple(as_recordings(found)) for name, found in sorted(machines.items())}


def _match_machines(
    simulator: Simulator, machines: Mapping[str, tuple[Recording, ...]], hold: str | None
) -> dict[str, tuple[Recording, ...]]:
    """Match the recordings to the simulator's channels; an error names the machine."""
    out = {}
    for name, recordings in machines.items():
        try:
            out[name] = match_recordings(simulator, recordings, hold)[1]
        except InputError as error:
            raise InputError(f"Machine {name!r}: {error}") from None
    return out


def _check_times(times: Any, machines: Mapping[str, tuple[Recording, ...]]) -> dict[str, tuple[float, ...]]:
    """Return the time of each recording by machine."""
    out = {}
    for name, found in (times or {}).items():
        if name not in machines:
            raise InputError(f"times has {name!r}, which is no machine of the fleet; correct the name.")
        t = numbers(found, f"times of {name!r}")
        count = len(machines[name])
        if t.shape != (count,):
            raise InputError(f"times of {name!r} has {t.size} numbers for {count} recordings; give one for each.")
        out[name] = tuple(map(float, t))
    return out


@contextmanager
def _open_folder(out: Any, overwrite: bool) -> Iterator[Manifest]:
    """Open the folder of the results, or a temporary one."""
    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            yield Manifest(Path(folder), layout=FLEET)
        return
    check_own(Path(out), None, overwrite, FLEET)
    target = make_folder(out)
    with lock_folder(target, FLEET):
        manifest = Manifest(target, layout=FLEET) if overwrite else Manifest.read(target, FLEET)
        refuse_other_versions(manifest)
        manifest.content["versions"] = versions()
        yield manifest


@dataclass(eq=False)
class _FleetExecution:
    """The execution of the steps of a fleet; `done` of `total` jobs are complete."""

    work: MachineWork
    machines: Mapping[str, tuple[Recording, ...]]
    manifest: Manifest
    effort: Effort
    executor: Executor | None
    ahead: int
    progress: Progress
    print_line: PrintLine
    done: int = 0
    jobs: dict[str, MachineJob] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.total = 2 * len(self.machines)

    def execute(self, sample: int, times: Mapping[str, Sequence[float]]) -> Fleet:
        """Execute the steps of the module docstring."""
        refits = self._run_step(REFIT, list(self.machines))
        names = _spread_sample({name: e["nrmse"] for name, e in refits.items() if e["status"] == DONE}, sample)
        if not names:
            raise NoModel(f"No machine could be fitted; {refits[next(iter(refits))]['sentence']}")
        self.total += len(names)
        common, hold = common_physics(self._run_step(SAMPLE, names))
        if self.work.hold is None and self.work.simulator.hold is None:
            self.work = replace(self.work, hold=hold)
        entries = self._run_step(MEASURE, list(self.machines), common.laws, dict.fromkeys(self.machines, common.starts))
        values, remainder = distributions(entries, self._units(common.laws), times)
        if not values and not np.isfinite(remainder.mean):
            raise NoModel(f"No machine could be fitted; {entries[next(iter(entries))]['sentence']}")
        places = {name: i for i, name in enumerate(n for n, e in entries.items() if e["status"] == DONE)}
        judged = {
            name: judge_entry(name, e, values, remainder, times.get(name), places[name])
            if name in places
            else Machine(name, failed=e["sentence"])
            for name, e in entries.items()
        }
        judged = self._diagnose_rest(judged, entries, common.laws, names)
        ranked = sorted(judged.values(), key=lambda m: (-m.probability, -np.nan_to_num(m.ratio), m.name))
        confirmed = sum(e["status"] == DONE and e["gain"] > 0 for e in entries.values())
        result = Fleet(
            common,
            confirmed,
            values,
            remainder,
            tuple(ranked),
            self.work,
            self._read_files(),
            _collect_histories(ranked, entries, times),
        )
        self._write(result)
        return result

    def _run_step(
        self,
        step: str,
        names: Sequence[str],
        laws: tuple[LawAt, ...] = (),
        starts: Mapping[str, tuple[Mapping[str, Any], ...]] | None = None,
    ) -> dict[str, dict[str, Any]]:
        """Execute a step at some machines, unless it is complete there; return the entries.

        `starts` are the start values by machine.
        """
        jobs = []
        for name in names:
            job = MachineJob(step, name, "", self.machines[name], laws, starts[name] if starts else ())
            jobs.append(replace(job, key=digest([self.work.key(job), versions()])))
        self.jobs |= {job.id: job for job in jobs}
        ready = {job.id for job in jobs if self._is_complete(job)}
        self.done += len(ready)
        missing = [job for job in jobs if job.id not in ready]
        if jobs:
            self.print_line(f"{step}: {STAGES[step]}; {len(ready)} of {len(jobs)} already done")
        done = len(ready)
        self.progress(step, done, len(jobs), np.nan)
        for batch in run_side_by_side(self.work, missing, self.effort, self.executor, self.ahead):
            if batch:
                with deferred_interrupt():  # a finished job must not be lost
                    self.manifest.record(batch)
                    self.done += len(batch)
            done += len(batch)
            for job, found in batch:
                self.print_line(f"{job.id}: {found.entry['sentence']}")
            self.progress(step, done, len(jobs), np.nan)
        text = json.dumps({job.machine: self.manifest.entries[job.id] for job in jobs}, sort_keys=True)
        entries: dict[str, dict[str, Any]] = json.loads(text)  # in the order in which a resumed fleet reads them
        return entries

    def _is_complete(self, job: MachineJob) -> bool:
        """Tell whether a job ended with the same inputs, and its files are unchanged."""
        settled = self.manifest.is_settled(job, self.effort.time_limit)
        return settled and all([self.manifest.holds(name) for name in self._file_names(job)])

    def _file_names(self, job: MachineJob) -> list[str]:
        return [name for name in self.manifest.content["files"] if name.startswith(f"{JOBS}/{job.id}/")]

    def _diagnose_rest(
        self,
        judged: Mapping[str, Machine],
        entries: Mapping[str, Mapping[str, Any]],
        laws: tuple[LawAt, ...],
        sampled: Sequence[str],
    ) -> dict[str, Machine]:
        """Diagnose the machines that lack more than the common physics; add the diagnoses and the reports.

        The largest error is first, because its diagnosis takes longest: no process is left alone with it at the end.
        """
        names = sorted((n for n, m in judged.items() if m.beyond > SURE), key=lambda n: (-judged[n].ratio, n))
        self.total += len(names)
        starts = {n: ({k: np.asarray(v, dtype=float) for k, v in entries[n]["parameters"].items()},) for n in names}
        found = self._run_step(REST, names, laws, starts)
        out = dict(judged)
        for name, m in judged.items():
            entry = found.get(name, {})
            diagnosed = "fit" in entry  # rather than failed, or a faulty recording
            step = REST if diagnosed else SAMPLE if name in sampled else ""
            page = f"{JOBS}/{step}-{name}/{PAGE}"
            keys: Sequence[str] = ("status", "verdict", "sentence", "effects")
            rest = {k: entry[k] for k in keys if k in entry}
            report = page if page in self.manifest.content["files"] else ""
            out[name] = replace(m, rest=rest, faults=tuple(entry.get("faults", ())), report=report)
        return out

    def _units(self, laws: Sequence[LawAt]) -> dict[str, str]:
        """Return the unit of each parameter by label, in the order of the simulator with the laws."""
        own = self.work.place(laws).readable_parameters()
        return {label: own[label.partition("[")[0]].unit for label in own.labels}

    def _read_files(self) -> dict[str, bytes]:
        names = [name for job in self.jobs.values() for name in self._file_names(job)]
        return {name: (self.manifest.folder / name).read_bytes() for name in sorted(names)}

    def _write(self, result: Fleet) -> None:
        """Write the files of the whole fleet; drop the entries of jobs that no longer belong to it."""
        self.manifest.content["jobs"] = {k: v for k, v in self.manifest.entries.items() if k in self.jobs}
        self.manifest.put(result.documents())
        self.manifest.content.pop("writing", None)
        self.manifest.write()


def _spread_sample(errors: Mapping[str, float], count: int) -> list[str]:
    """Choose machines spread evenly over the ranks of their errors, the middles of equal parts, the largest first."""
    ranked = sorted(errors, key=lambda name: (-errors[name], name))
    count = min(count, len(ranked))
    return [ranked[int((k + 0.5) * len(ranked) / count)] for k in range(count)]


def common_physics(sample: Mapping[str, Mapping[str, Any]]) -> tuple[Common, str]:
    """Choose the hypothesis with the largest evidence summed over the diagnosed machines; also return the hold.

    Only hypotheses that were fitted to all these machines count; the hypothesis that nothing is missing always was. The
    evidences of machines are independent, so their logarithms add up, and the prior counts once.
    """
    good = {name: e for name, e in sample.items() if e["status"] == DONE}
    if not good:
        raise NoModel(f"No machine of the sample could be diagnosed; {next(iter(sample.values()))['sentence']}")
    found = [{_law_classes(h): h for h in e["hypotheses"]} for e in good.values()]
    shared = [key for key in found[0] if all(key in other for other in found)]
    score = {
        key: sum(f[key]["log_evidence"] for f in found) + np.mean([f[key]["log_prior"] for f in found])
        for key in shared
    }
    best = max(shared, key=lambda key: score[key])
    weight = {key: float(np.exp(score[key] - score[best])) for key in shared}
    alike = [key for key in shared if _law_ids(found[0][key]) == _law_ids(found[0][best])]
    holds = [e["hold"] for e in good.values()]
    laws = tuple(_median_law(k, [f[best]["laws"] for f in found]) for k in range(len(found[0][best]["laws"])))
    probability = sum(weight[key] for key in alike) / sum(weight.values())
    return Common(laws, probability, tuple(good)), max(sorted(set(holds)), key=holds.count)


def _law_classes(hypothesis: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((law["port"], law["law"]) for law in hypothesis["laws"]))


def _law_ids(hypothesis: Mapping[str, Any]) -> list[tuple[str, str]]:
    return sorted((law["port"], law["id"]) for law in hypothesis["laws"])


def _median_law(k: int, laws: Sequence[Sequence[Mapping[str, Any]]]) -> LawAt:
    """Return the k-th law of a hypothesis with its median values over the sample, and the widest limits."""
    first = laws[0][k]
    same = [next(law for law in own if (law["port"], law["law"]) == (first["port"], first["law"])) for own in laws]
    parameters = {}
    for name in first["parameters"]:
        rows = [law["parameters"][name] for law in same]
        value = np.median([np.asarray(r["value"], dtype=float) for r in rows], axis=0)
        low = np.min([fill_missing(r["low"], -np.inf) for r in rows], axis=0)
        high = np.max([fill_missing(r["high"], np.inf) for r in rows], axis=0)
        parameters[name] = to_json({"value": value, "low": low, "high": high})
    return LawAt(first["port"], first["law"], first["id"], first["form"], parameters)


def _collect_histories(
    machines: Sequence[Machine], entries: Mapping[str, Mapping[str, Any]], times: Mapping[str, Sequence[float]]
) -> dict[str, dict[str, Any]]:
    """Collect the values over time of machines that drift: machine -> parameter -> times, values, errors."""
    out: dict[str, dict[str, Any]] = {}
    for m in machines:
        for label in (label for label, t in m.trends.items() if m.drifts and t.probability > SURE):
            values, errors = values_by_recording(entries[m.name], label)
            history = {"times": list(times.get(m.name, range(len(values)))), "values": values, "errors": errors}
            out.setdefault(m.name, {})[label] = history
    return out
