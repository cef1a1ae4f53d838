"""A fleet: one simulator, recordings of many machines; what all of them lack, and which of them differ.

The steps:

1. Every machine: the simulator is refitted as given.
2. A sample of machines, drawn evenly over the size of these errors, is diagnosed, each machine alone. The common
   physics is the hypothesis with the largest evidence, summed over the sample, among those that were fitted to every
   sampled machine; or nothing.
3. Every machine: the simulator is fitted with and without the common physics (`machines`, `diagnose.replicate`). With
   several recordings, each is also fitted alone.
4. `population` estimates the distribution of each value over the machines, of its trend in time, and of the error that
   remains. It gives each machine's probability to differ.
5. Machines whose error says that they lack more are diagnosed alone, from the simulator with the common physics.

The work at a machine is a job. Jobs run side by side and are recorded in the folder, as those of a campaign: however it
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
from .executor import AHEAD, LOST, Effort, run_side_by_side, versions
from .fleet_result import CONTENT, TABLE, Common, Fleet, Machine, distributions, judge_entry
from .folder import JOBS, Layout, Manifest, check_own, lock_folder, refuse_other_versions
from .machines import (
    CONTENT as DIAGNOSIS,
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
)

SAMPLED = 4  # machines that are diagnosed to find the common physics
FEWEST_MACHINES = 2
FLEET = Layout("fleet", "simulator file", (CONTENT, TABLE, PAGE), (PAGE, DIAGNOSIS, RESIDUAL))
Recordings = Recording | Sequence[Recording]


def fleet(
    simulator: Any,
    machines: Mapping[str, Recordings],
    *,
    times: Mapping[str, Sequence[float]] | None = None,
    sample: int = SAMPLED,
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
    """Find what all machines of a fleet lack, and which of them differ, drift or lack more.

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
        Seconds after which the work at a machine is given up, and recorded as such.
    out : path, optional
        Folder of the results: empty, new, or from an earlier call, which is continued. By default nothing is written.
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
    given = _checked_machines(machines)
    count = min(whole(sample, "sample", 1), len(given))
    effort = Effort(processors() if workers is None else whole(workers, "workers", 1), time_limit)
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"time_limit={time_limit!r} was given; give seconds, a positive number.")
    own = as_simulator(simulator, next(iter(given.values())))
    given = _matched(own, given, hold)
    most = None if effects is None else whole(effects, "effects", 0)
    work = MachineWork(own, hold, check_laws(laws), most, engine)
    when = _checked_times(times, given)
    with _opened(out, overwrite) as manifest:
        steps = _Steps(
            work, given, manifest, effort, executor, ahead, progress or (lambda *_: None), tell or (lambda _: None)
        )
        try:
            return steps.execute(count, when)
        except KeyboardInterrupt:
            raise RunInterrupted(steps.done, steps.total) from None


def _checked_machines(machines: Any) -> dict[str, tuple[Recording, ...]]:
    """Return the recordings of each machine; refuse names that cannot be those of folders."""
    if not isinstance(machines, Mapping) or len(machines) < FEWEST_MACHINES:
        raise InputError(
            f"A fleet needs a dict of at least {FEWEST_MACHINES} machines, {{name: recordings}}; for one machine use "
            "diagnose."
        )
    for name in machines:
        if not isinstance(name, str) or not re.fullmatch(r"[\w.+-][\w .+-]{0,99}", name, re.ASCII):
            raise InputError(
                f"A machine is named {name!r}; give up to 100 letters, digits, spaces, dots, and the signs + - _."
            )
    if len({name.lower() for name in machines}) < len(machines):
        raise InputError("Two machines have names that differ in upper and lower case only; rename one of them.")
    return {name: tuple(as_recordings(found)) for name, found in sorted(machines.items())}


def _matched(
    simulator: Simulator, machines: Mapping[str, tuple[Recording, ...]], hold: str | None
) -> dict[str, tuple[Recording, ...]]:
    """Return the recordings with the simulator's channels; refuse those that do not fit it, with the machine's name."""
    out = {}
    for name, recordings in machines.items():
        try:
            out[name] = match_recordings(simulator, recordings, hold)[1]
        except InputError as error:
            raise InputError(f"Machine {name!r}: {error}") from None
    return out


def _checked_times(times: Any, machines: Mapping[str, tuple[Recording, ...]]) -> dict[str, tuple[float, ...]]:
    """Return the time of each recording by machine."""
    out = {}
    for name, found in (times or {}).items():
        if name not in machines:
            raise InputError(f"times holds {name!r}, which is no machine of the fleet.")
        t = numbers(found, f"times of {name!r}")
        count = len(machines[name])
        if t.shape != (count,):
            raise InputError(f"times of {name!r} has {t.size} numbers for {count} recordings; give one for each.")
        out[name] = tuple(map(float, t))
    return out


@contextmanager
def _opened(out: Any, overwrite: bool) -> Iterator[Manifest]:
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
class _Steps:
    """The execution of the steps; `done` of `total` jobs are complete."""

    work: MachineWork
    machines: Mapping[str, tuple[Recording, ...]]
    manifest: Manifest
    effort: Effort
    executor: Executor | None
    ahead: int
    progress: Progress
    print_line: PrintLine
    done: int = 0
    used: dict[str, MachineJob] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.total = 2 * len(self.machines)

    def execute(self, sample: int, times: Mapping[str, Sequence[float]]) -> Fleet:
        """Execute the steps of the module docstring."""
        refits = self._do(REFIT, list(self.machines))
        names = _spread_sample({name: e["nrmse"] for name, e in refits.items() if e["status"] == DONE}, sample)
        if not names:
            raise NoModel(f"No machine could be fitted; {refits[next(iter(refits))]['sentence']}")
        self.total += len(names)
        common, hold = common_physics(self._do(SAMPLE, names))
        if self.work.hold is None and self.work.simulator.hold is None:
            self.work = replace(self.work, hold=hold)
        entries = self._do(MEASURE, list(self.machines), common.laws, common.starts)
        values, remainder = distributions(entries, self._units(common.laws), times)
        if not values and not np.isfinite(remainder.mean):
            raise NoModel(f"No machine could be fitted; {entries[next(iter(entries))]['sentence']}")
        judged = {
            name: judge_entry(name, e, values, remainder, times.get(name))
            if e["status"] == DONE
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
            self._files(),
            _histories(ranked, entries, times),
        )
        self._finish(result)
        return result

    def _do(
        self,
        step: str,
        names: Sequence[str],
        laws: tuple[LawAt, ...] = (),
        starts: Sequence[Mapping[str, Any]] | Mapping[str, Any] = (),
    ) -> dict[str, dict[str, Any]]:
        """Execute a step at some machines, as far as it is not complete; return the entries.

        `starts` are those of all machines, or a mapping from machines to theirs.
        """
        jobs = []
        for name in names:
            own = (starts[name],) if isinstance(starts, Mapping) else tuple(starts)
            job = MachineJob(step, name, "", self.machines[name], laws, own)
            jobs.append(replace(job, key=digest([self.work.key(job), versions()])))
        self.used |= {job.id: job for job in jobs}
        ready = {job.id for job in jobs if self._complete(job)}
        self.done += len(ready)
        missing = [job for job in jobs if job.id not in ready]
        for batch in run_side_by_side(self.work, missing, self.effort, self.executor, self.ahead):
            with deferred_interrupt():  # a finished job must not be lost
                self.manifest.record(batch)
                self.done += len(batch)
            for job, found in batch:
                self.print_line(f"{job.id}: {found.entry['sentence']}")
            self.progress(step, len(ready) + sum(j.id in self.manifest.entries for j in missing), len(jobs), np.nan)
        text = json.dumps({job.machine: self.manifest.entries[job.id] for job in jobs}, sort_keys=True)
        entries: dict[str, dict[str, Any]] = json.loads(text)  # in the order in which a resumed fleet reads them
        return entries

    def _complete(self, job: MachineJob) -> bool:
        """Tell whether a job ended with the same inputs, and its files are unchanged."""
        entry = self.manifest.entries.get(job.id, {})
        if entry.get("key") != job.key or entry["status"] == LOST or "time_limit" in entry:
            return False
        return all([self.manifest.holds(name) for name in self._names(job)])

    def _names(self, job: MachineJob) -> list[str]:
        return [name for name in self.manifest.content["files"] if name.startswith(f"{JOBS}/{job.id}/")]

    def _diagnose_rest(
        self,
        judged: Mapping[str, Machine],
        entries: Mapping[str, Mapping[str, Any]],
        laws: tuple[LawAt, ...],
        sampled: Sequence[str],
    ) -> dict[str, Machine]:
        """Diagnose the machines that lack more than the common physics; add what was found and the reports."""
        names = [name for name, m in judged.items() if m.beyond > SURE]
        self.total += len(names)
        values = {n: {k: np.asarray(v, dtype=float) for k, v in entries[n]["parameters"].items()} for n in names}
        found = self._do(REST, names, laws, values)
        out = dict(judged)
        for name, m in judged.items():
            step = REST if name in found and found[name]["status"] == DONE else SAMPLE if name in sampled else ""
            page = f"{JOBS}/{step}-{name}/{PAGE}"
            keys = ("status", "verdict", "sentence", "effects")
            rest = {k: found[name][k] for k in keys if k in found[name]} if name in found else {}
            out[name] = replace(m, rest=rest, report=page if page in self.manifest.content["files"] else "")
        return out

    def _units(self, laws: Sequence[LawAt]) -> dict[str, str]:
        """Return the unit of each parameter by label, in the order of the simulator with the laws."""
        placed = self.work.simulator
        for port, law in self.work.build(laws):
            placed = placed.with_element(port, law)
        own = placed.readable_parameters()
        return {label: own[label.partition("[")[0]].unit for label in own.labels}

    def _files(self) -> dict[str, bytes]:
        """Read the files of the jobs of this fleet."""
        names = [name for job in self.used.values() for name in self._names(job)]
        return {name: (self.manifest.folder / name).read_bytes() for name in sorted(names)}

    def _finish(self, result: Fleet) -> None:
        """Write the files of the fleet as a whole, and forget jobs that are no longer part of it."""
        self.manifest.content["jobs"] = {k: v for k, v in self.manifest.entries.items() if k in self.used}
        for name, text in result.documents().items():
            self.manifest.put(name, text)
        self.manifest.content.pop("writing", None)
        self.manifest.write()


def _spread_sample(errors: Mapping[str, float], count: int) -> list[str]:
    """Draw machines evenly over the ranks of their errors: the middles of equal parts."""
    ranked = sorted(errors, key=lambda name: (errors[name], name))
    count = min(count, len(ranked))
    return [ranked[int((k + 0.5) * len(ranked) / count)] for k in range(count)]


def common_physics(sample: Mapping[str, Mapping[str, Any]]) -> tuple[Common, str]:
    """Choose the hypothesis with the largest evidence summed over the diagnosed machines; also return the hold.

    Only hypotheses that were fitted to all of them count; the one of no missing physics always is. The evidences of
    machines are independent, so their logarithms add up, and the prior counts once.
    """
    good = {name: e for name, e in sample.items() if e["status"] == DONE}
    if not good:
        raise NoModel(f"No machine of the sample could be diagnosed; {next(iter(sample.values()))['sentence']}")
    found = [{_key(h): h for h in e["hypotheses"]} for e in good.values()]
    shared = [key for key in found[0] if all(key in other for other in found)]
    score = {
        key: sum(f[key]["log_evidence"] for f in found) + np.mean([f[key]["log_prior"] for f in found])
        for key in shared
    }
    best = max(shared, key=lambda key: score[key])
    weight = {key: float(np.exp(score[key] - score[best])) for key in shared}
    alike = [key for key in shared if _ids(found[0][key]) == _ids(found[0][best])]
    holds = [e["hold"] for e in good.values()]
    laws = tuple(_typical(k, [f[best]["laws"] for f in found]) for k in range(len(found[0][best]["laws"])))
    probability = sum(weight[key] for key in alike) / sum(weight.values())
    return Common(laws, probability, tuple(good)), max(sorted(set(holds)), key=holds.count)


def _key(hypothesis: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((law["port"], law["law"]) for law in hypothesis["laws"]))


def _ids(hypothesis: Mapping[str, Any]) -> list[tuple[str, str]]:
    return sorted((law["port"], law["id"]) for law in hypothesis["laws"])


def _typical(k: int, laws: Sequence[Sequence[Mapping[str, Any]]]) -> LawAt:
    """Return the k-th law of a hypothesis with its median values over the sample, and limits that hold all of them."""
    first = laws[0][k]
    same = [next(law for law in own if (law["port"], law["law"]) == (first["port"], first["law"])) for own in laws]
    parameters = {}
    for name in first["parameters"]:
        rows = [law["parameters"][name] for law in same]
        value = np.median([np.asarray(r["value"], dtype=float) for r in rows], axis=0)
        low, high = (
            [np.nan_to_num(np.asarray(r[end], dtype=float), nan=free) for r in rows]
            for end, free in (("low", -np.inf), ("high", np.inf))
        )
        parameters[name] = to_json({"value": value, "low": np.min(low, axis=0), "high": np.max(high, axis=0)})
    return LawAt(first["port"], first["law"], first["id"], first["form"], parameters)


def _histories(
    machines: Sequence[Machine], entries: Mapping[str, Mapping[str, Any]], times: Mapping[str, Sequence[float]]
) -> dict[str, dict[str, Any]]:
    """Collect the values over time of machines that drift: machine -> parameter -> times, values, errors."""
    out: dict[str, dict[str, Any]] = {}
    for m in machines:
        rows = entries[m.name].get("by_recording", [])
        for label in (label for label, t in m.trends.items() if t.probability > SURE):
            history = {kind: [r[kind].get(label) for r in rows] for kind in ("values", "errors")}
            out.setdefault(m.name, {})[label] = {"times": list(times.get(m.name, range(len(rows)))), **history}
    return out
