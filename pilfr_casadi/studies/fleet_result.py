"""The result of a fleet: the common physics, the distribution of each value, and the machines that differ.

The probabilities of `population` decide: a machine differs in a value, drifts in a value, or lacks more than the common
physics, if that is more likely than not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import (
    InputError,
    csv_text,
    in_words,
    json_text,
    make_folder,
    read_bytes,
    to_json,
    with_nan,
    write_atomically,
)
from ..data import Recording
from ..diagnose import SURE, check_laws, replicate
from ..laws import Law
from ..simulators import as_simulator, name_at
from .machines import DONE, PAGE, RESIDUAL, SAMPLE, LawAt, MachineWork, measured_entry
from .population import Population, combine, estimate_population, slope

CONTENT, TABLE, PAGES = "fleet.json", "fleet.csv", "pages"
SCHEMA = 1
MOST_SHOWN = 20  # machines in the printed result
SHARED, OWN = "shared", "per machine"
PER_RECORDING, PER_TIME = "recording", "unit of time"  # of a trend; the second is the unit of the given times


@dataclass(frozen=True, eq=False)
class Trend:
    """Change of a value, its standard error, the probability that it is not zero, and the unit of time."""

    slope: float
    error: float
    probability: float
    per: str = PER_TIME


@dataclass(frozen=True, eq=False)
class Machine:
    """A machine judged against the fleet.

    Attributes
    ----------
    values, errors : mapping
        Each free parameter by label, with its standard error.
    differs : mapping
        Probability that each value is not from a regular machine.
    trends : mapping
        Trend of each value over the recordings.
    beyond : float
        Probability that the machine lacks more than the common physics.
    ratio : float
        Remaining error over the noise.
    gain : float
        Log evidence that the machine has the common physics.
    nrmse_before, nrmse_after, noise : float
        NRMSE of the plain refit and with the common physics; the noise on the same scale.
    failed : str
        Why the machine could not be fitted; empty if it could.
    rest : mapping
        The diagnosis of what remains: `verdict`, `sentence` and `effects`; empty if there was none.
    faults : tuple of str
        Faults of the recordings that show beside the common physics, each a sentence.
    report : str
        Path of the machine's own diagnosis below the folder of the fleet, if there is one.
    """

    name: str
    values: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    differs: Mapping[str, float] = field(default_factory=dict)
    trends: Mapping[str, Trend] = field(default_factory=dict)
    beyond: float = np.nan
    ratio: float = np.nan
    gain: float = np.nan
    nrmse_before: float = np.nan
    nrmse_after: float = np.nan
    noise: float = np.nan
    failed: str = ""
    rest: Mapping[str, Any] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    report: str = ""

    @property
    def probability(self) -> float:
        """Largest probability of a difference from regular machines; 1 for a machine that could not be fitted."""
        every = [self.beyond, *self.differs.values(), *(t.probability for t in self.trends.values())]
        return 1.0 if self.failed else max((p for p in every if np.isfinite(p)), default=0.0)

    @property
    def reasons(self) -> tuple[tuple[str, float], ...]:
        """Findings that are more likely than not, each with its probability; the most probable first."""
        found = [(self._describe_rest(), self.beyond)] if self.beyond > SURE else []
        if self.faults:  # the values are then of wrong recordings
            return tuple(found)
        found += [
            (f"{name} = {_with_error(self.values[name], self.errors[name])}", p)
            for name, p in self.differs.items()
            if p > SURE
        ]
        found += [
            (f"{name} drifts by {_with_error(t.slope, t.error)} per {t.per}", t.probability)
            for name, t in self.trends.items()
            if t.probability > SURE
        ]
        return tuple(sorted(found, key=lambda r: -r[1]))

    @property
    def drifts(self) -> bool:
        """Whether a value drifts; values of faulty recordings say nothing about this."""
        return not self.faults and any(t.probability > SURE for t in self.trends.values())

    @property
    def page(self) -> str:
        """Path of the machine's page below the folder of the fleet."""
        return f"{PAGES}/{self.name}/{PAGE}"

    @property
    def note(self) -> str:
        """Withdraw the diagnosis of a single machine that assumed constant values; empty if there is none."""
        if not self.drifts or f"/{SAMPLE}-" not in self.report:
            return ""
        return "its diagnosis alone assumed constant values and is replaced by this finding"

    @property
    def findings(self) -> str:
        """The reasons with their probabilities, and the note; empty if there are none."""
        return "; ".join(filter(None, (*(f"{text} ({p:.2f})" for text, p in self.reasons), self.note)))

    def _describe_rest(self) -> str:
        if self.faults:
            return f"its error is {self.ratio:.3g} times the noise. {' '.join(self.faults).rstrip('.')}"
        text = f"lacks more: its error is {self.ratio:.3g} times the noise"
        named = ", ".join(name_at(e["port"], e["law"], e.get("form", "")) for e in self.rest.get("effects", ()))
        return f"{text}; {named}" if named else text

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        derived = {"probability": self.probability, "page": self.page, "note": self.note}
        content: dict[str, Any] = to_json({**asdict(self), **derived})
        return content

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Machine:
        """Make a machine from its JSON content."""
        given = {f.name: content[f.name] for f in fields(cls) if f.name != "faults" or "faults" in content}
        own = {name: value if name == "rest" else with_nan(value) for name, value in given.items()}
        trends = {name: Trend(**t) for name, t in own["trends"].items()}
        return cls(**{**own, "trends": trends, "faults": tuple(own.get("faults", ()))})


@dataclass(frozen=True, eq=False)
class FleetValue:
    """A parameter over the fleet: the distributions of its value and of its trend over regular machines."""

    name: str
    unit: str
    population: Population
    trends: Population

    @property
    def kind(self) -> str:
        """The text `OWN` if the value more likely than not varies between regular machines, else `SHARED`."""
        return OWN if self.population.varies > SURE else SHARED

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        both = {"population": self.population.to_dict(), "trends": self.trends.to_dict()}
        return {"name": self.name, "unit": self.unit, "kind": self.kind, **both}


@dataclass(frozen=True, eq=False)
class Common:
    """The physics that all machines lack: laws at their ports, and their probability."""

    laws: tuple[LawAt, ...]  # empty if nothing is missing in common
    probability: float  # posterior probability of these laws, in any form, from the sampled machines
    sample: tuple[str, ...]  # the machines that were diagnosed alone
    starts: tuple[Mapping[str, Any], ...] = ()  # start values by name for every machine, besides the user's

    @property
    def words(self) -> str:
        """The laws in words."""
        return in_words([name_at(law.port, law.id, law.form) for law in self.laws])


@dataclass(frozen=True, eq=False)
class Fleet:
    """Result of `fleet`.

    Attributes
    ----------
    common : Common
        The physics that all machines lack.
    confirmed : int
        Number of machines with more evidence for the common physics than against it.
    values : tuple of FleetValue
        The free parameters over the fleet.
    remainder : Population
        Distribution of the logarithm of the remaining error over the noise.
    machines : tuple of Machine
        All machines, the most probable to differ first.
    work : MachineWork
        The simulator and the options.
    files : mapping
        Pages and other files of jobs, by path below a folder.
    """

    common: Common
    confirmed: int
    values: tuple[FleetValue, ...]
    remainder: Population
    machines: tuple[Machine, ...]
    work: MachineWork
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    histories: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, repr=False)

    def __getitem__(self, name: str) -> Machine:
        for machine in self.machines:
            if machine.name == name:
                return machine
        raise InputError(f"There is no machine {name!r} in the fleet; it has {len(self.machines)}.")

    @property
    def differing(self) -> tuple[Machine, ...]:
        """Machines that lack more, differ in a value, or could not be fitted; the most probable first."""
        return tuple(
            m for m in self.machines if m.failed or m.beyond > SURE or any(p > SURE for p in m.differs.values())
        )

    @property
    def drifting(self) -> tuple[Machine, ...]:
        """Machines with a value that drifts."""
        return tuple(m for m in self.machines if m.drifts)

    @property
    def summary(self) -> str:
        """The result in a sentence or two."""
        n, sampled = len(self.machines), len(self.common.sample)
        if self.common.laws:
            text = (
                f"The machines lack {self.common.words} (probability {self.common.probability:.2f} on a sample of "
                f"{sampled}; confirmed on {self.confirmed} of {n})."
            )
        else:
            text = f"The machines lack nothing in common (probability {self.common.probability:.2f} on {sampled})."
        counts = [(len(self.differing), "differ"), (len(self.drifting), "drift")]
        found = [f"{count} {verb}{'s' if count == 1 else ''}" for count, verb in counts]
        return f"{text} Of {n} machines, {' and '.join(found)}."

    def judge(
        self,
        name: str,
        recordings: Recording | Sequence[Recording],
        times: Sequence[float] | None = None,
    ) -> Machine:
        """Judge a new machine against the fleet, which does not change.

        Parameters
        ----------
        name : str
            Name of the machine.
        recordings : Recording or sequence of Recording
            Its recordings, with the simulator's channels.
        times : sequence of float, optional
            Time of each recording, in the unit that the fleet uses; by default 0, 1, 2, ...

        Raises
        ------
        InputError
            If simulator and recordings do not fit each other.
        """
        work, laws = self.work, self.work.build(self.common.laws)
        found = replicate(work.simulator, recordings, laws, self.common.starts, hold=work.hold, engine=work.engine)
        judged = judge_entry(name, measured_entry(found), self.values, self.remainder, times)
        faults = work.channel_faults(self.common.laws, recordings) if judged.beyond > SURE else []
        return replace(judged, faults=tuple(faults))

    def table(self) -> list[dict[str, Any]]:
        """List the machines as the rows of fleet.csv, the most probable to differ first."""
        rows = []
        for m in self.machines:
            row: dict[str, Any] = {"machine": m.name, "probability": m.probability, "beyond": m.beyond}
            row |= {"error_over_noise": m.ratio, "nrmse_before": m.nrmse_before, "nrmse_after": m.nrmse_after}
            row |= {"log_evidence": m.gain}
            for v in self.values:
                row |= {v.name: m.values.get(v.name, np.nan), f"{v.name} error": m.errors.get(v.name, np.nan)}
                row |= {f"{v.name} differs": m.differs.get(v.name, np.nan)}
                if v.name in m.trends:
                    row |= {f"{v.name} slope": m.trends[v.name].slope, f"{v.name} drifts": m.trends[v.name].probability}
            rows.append({**row, "findings": m.failed or "; ".join(text for text, _ in m.reasons)})
        return rows

    def plot(self) -> Any:
        """Draw the map of the machines: `plots.machine_map`, or `plots.machine_strips` if there is one value."""
        from ..report import fleet_map

        return fleet_map(self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fleet.json; numbers that are not finite are None."""
        common = self.common
        raw = {
            "schema": SCHEMA,
            "sentence": self.summary,
            "common": {
                "laws": [asdict(law) for law in common.laws],
                "words": common.words,
                "probability": common.probability,
                "sample": common.sample,
                "starts": common.starts,
            },
            "confirmed": self.confirmed,
            "hold": self.work.hold,
            "values": [v.to_dict() for v in self.values],
            "remainder": self.remainder.to_dict(),
            "machines": [{**m.to_dict(), "reasons": m.reasons} for m in self.machines],
            "differing": [m.name for m in self.differing],
            "drifting": [m.name for m in self.drifting],
            "histories": self.histories,
        }
        content: dict[str, Any] = to_json(raw)
        return content

    def documents(self) -> dict[str, str]:
        """Make the contents of fleet.json, fleet.csv, report.html and the page of each machine."""
        from ..report import fleet_page, machine_page

        content, rows = self.to_dict(), self.table()
        names = list(dict.fromkeys(key for row in rows for key in row))
        residuals = {
            m.name: json.loads(self.files[path])
            for m in self.machines
            if (path := f"jobs/measure-{m.name}/{RESIDUAL}") in self.files
        }
        return {
            CONTENT: json_text(content),
            TABLE: csv_text([names, *([row.get(name, "") for name in names] for row in rows)]),
            PAGE: fleet_page(content, residuals).html(),
            **{m.page: machine_page(content, m.name, residuals.get(m.name)).html() for m in self.machines},
        }

    def report(self, folder: Any) -> Path:
        """Write fleet.json, fleet.csv, report.html and the pages of the machines; return the page's path."""
        target = make_folder(folder)
        contents: dict[str, str | bytes] = {**self.files, **self.documents()}
        for name, data in contents.items():
            make_folder((target / name).parent)
            write_atomically(target / name, data)
        return target / PAGE

    def __str__(self) -> str:
        lines = [self.summary, "values of regular machines:"]
        for v in self.values:
            mean = f"{_with_error(v.population.mean, v.population.mean_error)} {v.unit}".rstrip()
            between = f", deviation between machines {v.population.deviation:.2g}" if v.kind == OWN else ""
            lines.append(f"  {v.name} = {mean}, {v.kind}{between}")
        shown = [m for m in self.machines if m.failed or m.reasons]
        lines += ["machines that differ or drift, the surest first:"] if shown else []
        for m in shown[:MOST_SHOWN]:
            lines.append(f"  {m.name}: {m.failed or m.findings}")
        return "\n".join([*lines, f"  and {len(shown) - MOST_SHOWN} more"] if len(shown) > MOST_SHOWN else lines)

    __repr__ = __str__


def judge_entry(
    name: str,
    entry: Mapping[str, Any],
    values: Sequence[FleetValue],
    remainder: Population,
    times: Sequence[float] | None,
    place: int | None = None,
) -> Machine:
    """Judge the manifest entry of a machine by the distributions over the fleet, in which it may have a `place`."""

    def compare(population: Population, *estimate: float) -> float:
        return population.probability(*estimate) if place is None else float(population.differs[place])

    found = {v.name: trend_of(entry, v.name, times) for v in values}
    trends = {
        v.name: Trend(
            *found[v.name][:2], compare(v.trends, *found[v.name]), PER_RECORDING if times is None else PER_TIME
        )
        for v in values
        if np.isfinite(found[v.name][0])
    }
    estimates = estimates_of(entry, any(t.probability > SURE for t in trends.values()))
    above = entry["remainder"] > remainder.mean
    left = entry["remainder"], entry["remainder_error"], remainder_width(entry)
    beyond = compare(remainder, *left) if above else 0.0
    # the values of a machine that lacks more make up for that, and say nothing of the machine
    differs = {
        v.name: compare(v.population, *estimates[v.name], float(entry["widths"][v.name]))
        for v in values
        if beyond <= SURE and np.all(np.isfinite(estimates.get(v.name, np.nan))) and np.isfinite(v.population.mean)
    }
    return Machine(
        name,
        values={label: value for label, (value, _) in estimates.items()},
        errors={label: error for label, (_, error) in estimates.items()},
        differs=differs,
        trends=trends,
        beyond=beyond,
        ratio=float(np.exp(entry["remainder"])),
        gain=entry["gain"],
        nrmse_before=entry["nrmse_before"],
        nrmse_after=entry["nrmse_after"],
        noise=entry["noise"],
    )


def estimates_of(entry: Mapping[str, Any], drifts: bool) -> dict[str, tuple[float, float]]:
    """Return the value and standard error of each parameter, from the fit to all recordings.

    Values that drift would bias that fit. If any value `drifts`, means over the fits to single recordings are used.
    """
    out = {}
    for label, value in entry["values"].items():
        mean, error = combine(*values_by_recording(entry, label)) if drifts else (np.nan, np.nan)
        if not np.isfinite(mean):
            mean, error = (np.nan if x is None else float(x) for x in (value, entry["errors"].get(label)))
        out[label] = mean, error
    return out


def values_by_recording(entry: Mapping[str, Any], label: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the values and standard errors of a parameter from the fits to single recordings, nan if unknown."""
    rows = entry["by_recording"]
    values, errors = (np.array([r[kind].get(label) for r in rows], dtype=float) for kind in ("values", "errors"))
    return values, errors


def remainder_width(entry: Mapping[str, Any]) -> float:
    """Return the range of log(error / noise), from the noise to the standard deviation of the outputs."""
    return max(-float(np.log(max(entry["noise"], 1e-300))), 0.0)


def trend_of(entry: Mapping[str, Any], name: str, times: Sequence[float] | None) -> tuple[float, float, float]:
    """Return the slope of a value, its standard error, and the width of its prior range; nan if unknown."""
    rows = entry["by_recording"]
    if len(rows) < 2:
        return np.nan, np.nan, np.nan
    t = np.arange(len(rows), dtype=float) if times is None else np.asarray(times, dtype=float)
    return *slope(t, *values_by_recording(entry, name)), float(entry["widths"][name] / max(np.ptp(t), 1e-300))


def distributions(
    entries: Mapping[str, Mapping[str, Any]], units: Mapping[str, str], times: Mapping[str, Sequence[float]]
) -> tuple[tuple[FleetValue, ...], Population]:
    """Estimate the distribution of every value, and of the remaining error, over the machines of a fleet.

    `units` maps the labels of the parameters, in the order of the result, to their units.
    """
    good = {name: e for name, e in entries.items() if e["status"] == DONE}
    labels = [label for label in units if any(label in e["values"] for e in good.values())]
    slopes = {label: np.array([trend_of(e, label, times.get(name)) for name, e in good.items()]) for label in labels}
    trends = {label: estimate_population(*slopes[label].T, centre=0.0) for label in labels}
    drifting = [any(t.differs[i] > SURE for t in trends.values()) for i in range(len(good))]
    estimates = [estimates_of(e, drifts) for e, drifts in zip(good.values(), drifting, strict=True)]
    values = []
    for label in labels:
        v, s = np.array([e.get(label, (np.nan, np.nan)) for e in estimates]).T
        d = np.array([e["widths"].get(label) for e in good.values()], dtype=float)
        values.append(FleetValue(label, units[label], estimate_population(v, s, d), trends[label]))
    left, error = (np.array([e[k] for e in good.values()]) for k in ("remainder", "remainder_error"))
    return tuple(values), estimate_population(left, error, [remainder_width(e) for e in good.values()])


def read_fleet(folder: Any, simulator: Any, laws: Sequence[type[Law]] | None = None) -> Fleet:
    """Read a fleet from its folder, to judge new machines.

    Parameters
    ----------
    folder : path
        The folder of a fleet, or its fleet.json.
    simulator, laws
        As for `fleet`.

    Raises
    ------
    InputError
        If the file cannot be read, or does not hold a fleet.
    """
    own = as_simulator(simulator)
    tried = check_laws(laws)
    path = Path(folder) / CONTENT if Path(folder).is_dir() else Path(folder)
    if not path.exists():
        raise InputError(f"There is no fleet in {folder}; give the folder of a fleet.")
    text = read_bytes(path)
    try:
        content = json.loads(text)
        if content["schema"] != SCHEMA:
            raise KeyError
        common = content["common"]
        found = tuple(LawAt(**law) for law in common["laws"])
        starts = tuple({k: np.asarray(v, dtype=float) for k, v in s.items()} for s in common["starts"])
        values = tuple(
            FleetValue(v["name"], v["unit"], Population.of(v["population"]), Population.of(v["trends"]))
            for v in content["values"]
        )
        machines = tuple(map(Machine.of, content["machines"]))
        return Fleet(
            Common(found, common["probability"], tuple(common["sample"]), starts),
            content["confirmed"],
            values,
            Population.of(content["remainder"]),
            machines,
            MachineWork(own, content["hold"], tried, None, "auto"),
            histories=content["histories"],
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path} is not a fleet.json that this release writes; give the folder of a fleet.") from None


def _with_error(value: float, error: float) -> str:
    return f"{value:.5g} ± {error:.2g}" if np.isfinite(error) else f"{value:.5g}"
