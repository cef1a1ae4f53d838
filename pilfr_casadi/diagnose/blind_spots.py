"""Blind spots of recordings, from the ports' motion and the tables of `check`, and the record that would help most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base import in_words
from ..laws import display_name
from ..simulators import in_series
from .detectability import LINEAR, TENTH, LawRow, idle_ports, port_units
from .identifiability import ParameterRow, Sensitivity, Tie, count_undetermined
from .linearise import Probe, Run, along
from .workbench import Fitted, Workbench

SMALLEST_SWING = 0.05  # of a reversal, over the travel; smaller ones are ripple on the way
HALF = 0.5  # mean square error over the outputs' power, above which the linearisation may be that of another machine
MOTION = ("no-reversal", "one-amplitude")


@dataclass(frozen=True)
class Excitation:
    """Motion of a port's local coordinate.

    Attributes
    ----------
    travel : float
        Largest minus smallest value, in `unit`.
    reversals : int
        Turning points with swings of at least a twentieth of the travel on both sides.
    amplitudes : int
        Distinct amplitudes, a tenth of the largest apart, of nine tenths of the swings.
    rests : int
        Stretches longer than two usual swings in which it stays within a twentieth of the travel.
    """

    port: str
    travel: float
    unit: str
    reversals: int
    amplitudes: int
    rests: int


@dataclass(frozen=True)
class BlindSpot:
    """Something that the recordings cannot reveal: its kind, the names that it concerns, and a sentence."""

    kind: str
    names: tuple[str, ...]
    sentence: str


def excitations(bench: Workbench, probe: Probe, runs: Sequence[Run]) -> Iterator[Excitation]:
    """Describe the motion of every port's local coordinate along the refitted run."""
    for j, name in enumerate(probe.ports):
        if name not in idle_ports(bench.simulator):
            unit = port_units(bench.simulator.port(name), bench.recordings[0])[1]
            yield excitation(name, unit, [r.z[:, j] for r in runs])


def excitation(port: str, unit: str, signals: Sequence[np.ndarray]) -> Excitation:
    """Count reversals, distinct amplitudes and rests of a local coordinate in recordings, arrays of shape (M,)."""
    travel = float(max(z.max() for z in signals) - min(z.min() for z in signals))
    if not travel > 0:
        return Excitation(port, 0.0, unit, 0, 0, 0)
    least = SMALLEST_SWING * travel
    reversals, rests, swings = 0, 0, list[float]()
    for z in signals:
        turns = _turning_points(z, least)
        reversals += max(len(turns) - 2, 0)
        swings += np.abs(np.diff(z[turns])).tolist()
        rests += _rests(z, least, 2 * float(np.median(np.diff(turns))) if len(turns) > 2 else TENTH * len(z))
    return Excitation(port, travel, unit, reversals, _distinct(np.array(swings)), rests)


def _turning_points(z: np.ndarray, least: float) -> list[int]:
    """Find the samples at which z turns round between swings of at least `least`, the first and the last included."""
    step = np.diff(z)
    candidates = [0, *(np.flatnonzero(step[:-1] * step[1:] <= 0) + 1).tolist(), len(z) - 1]
    turns, extreme, way = [0], 0, 0
    for k in candidates[1:]:
        if way == 0:
            if abs(z[k] - z[turns[0]]) >= least:
                way, extreme = (1 if z[k] > z[turns[0]] else -1), k
        elif way * (z[k] - z[extreme]) >= 0:
            extreme = k
        elif way * (z[extreme] - z[k]) >= least:
            turns.append(extreme)
            way, extreme = -way, k
    return [*turns, extreme] if extreme > turns[-1] else turns


def _distinct(swings: np.ndarray) -> int:
    """Count the sizes, a tenth of the largest apart, that nine tenths of the swings have."""
    if not len(swings):
        return 0
    left, counts = np.sort(swings)[::-1], list[int]()
    apart = TENTH * float(left[0])
    while len(left):
        own = left > left[0] - apart
        counts.append(int(np.sum(own)))
        left = left[~own]
    share = np.cumsum(sorted(counts, reverse=True)) / sum(counts)
    return int(np.searchsorted(share, 1 - TENTH - 1e-9) + 1)


def _rests(z: np.ndarray, least: float, samples: float) -> int:
    """Count the stretches of more than some samples in which z stays within `least`."""
    count, begin, low, high = 0, 0, z[0], z[0]
    for k, value in enumerate(z):
        low, high = min(low, value), max(high, value)
        if high - low > least or k == len(z) - 1:
            count += k - begin > samples
            begin, low, high = k, value, value
    return count


def find_blind_spots(
    bench: Workbench,
    fitted: Fitted,
    parameters: Sequence[ParameterRow],
    alive: Sequence[str],
    ties: Sequence[Tie],
    laws: Sequence[LawRow],
    classes: Sequence[Sequence[tuple[str, str]]],
    moving: Sequence[Excitation],
) -> Iterator[BlindSpot]:
    """Put everything that the recordings cannot reveal into sentences, the gravest first.

    `alive` are dead or flat parameters that move the outputs at the given values.
    """
    simulator = bench.simulator
    if fitted.cost > HALF:
        left = f"{100 * fitted.cost**0.5:.3g} % of the outputs' deviation"
        yield BlindSpot("rough", (), f"The refitted simulator leaves {left}, so all of this is rough.")
    u = np.concatenate([r.u for r in bench.recordings])
    if still := tuple(n for n, v in zip(simulator.inputs, u.T, strict=True) if not np.ptp(v) > 0):
        yield BlindSpot("constant-input", still, f"Constant in all recordings: {in_words(still)}.")
    if not parameters:
        text = "The simulator has no free parameter, so a wrong value and a missing law look alike."
        yield BlindSpot("no-free-parameter", (), text)
    sentences = {
        "dead": "No output reacts to {}.",
        "flat": "These recordings say less about {} than the bounds do.",
        "start": "{} cannot be distinguished from the unknown initial state; say initial='zero' if it was zero.",
    }
    for kind, sentence in sentences.items():
        if names := tuple(p.name for p in parameters if p.status == kind):
            text = sentence.format(in_words(names))
            if own := [name for name in names if name in alive]:
                text += f" At the given values, before the refit, the outputs do react to {in_words(own)}."
            yield BlindSpot(kind, names, text)
    for tie in ties:
        yield BlindSpot("tied", tie.names, tie.sentence)
    yield from _motion([e for e in moving if e.port.removeprefix("actuator:") not in still])
    yield from _undetectable(laws, [p.name for p in parameters])
    yield from _alike_ports(laws, classes)


def _motion(moving: Sequence[Excitation]) -> Iterator[BlindSpot]:
    still = tuple(e.port for e in moving if e.travel == 0)
    ahead = tuple(e.port for e in moving if e.travel > 0 and e.reversals == 0)
    single = tuple(e.port for e in moving if e.reversals and e.amplitudes == 1)
    if still:
        yield BlindSpot("no-motion", still, f"Nothing moves at {in_words(still)}.")
    if ahead:
        text = f"No reversal at {in_words(ahead)}: hysteresis and friction look like stiffness and damping there."
        yield BlindSpot("no-reversal", ahead, text)
    if single:
        text = f"A single amplitude at {in_words(single)}: hysteresis looks like damping and stiffness there."
        yield BlindSpot("one-amplitude", single, text)


def _undetectable(laws: Sequence[LawRow], names: Sequence[str]) -> Iterator[BlindSpot]:
    """Find ports at which nothing is detectable, and at the others laws that own parameters follow."""
    ports = dict.fromkeys(r.port for r in laws)
    dark = tuple(port for port in ports if not any(r.status == "detectable" for r in laws if r.port == port))
    if dark:
        yield BlindSpot("hidden-port", dark, f"No law of the catalogue is detectable at {in_words(dark)}.")
    for port in ports:
        followed = [r for r in laws if r.port == port and r.status == "followed" and r.law not in LINEAR]
        for why in dict.fromkeys(r.why for r in followed):
            own = tuple(r.law for r in followed if r.why == why)
            what = f"a change of {why}" if why in names else why
            names_of = in_words([display_name(name) for name in own])
            text = f"{names_of[0].upper()}{names_of[1:]} at {port} cannot be distinguished from {what}."
            yield BlindSpot("followed", (port, *own), text)


def _alike_ports(laws: Sequence[LawRow], classes: Sequence[Sequence[tuple[str, str]]]) -> Iterator[BlindSpot]:
    """Find ports at which every law that is detectable at both looks the same."""
    detectable: dict[str, set[str]] = {}
    for r in laws:
        if r.status == "detectable":
            detectable.setdefault(r.port, set()).add(r.law)
    of = {name: i for i, group in enumerate(classes) for name in group}

    def one(port: str, other: str) -> bool:
        shared = detectable[port] & detectable[other]
        return bool(shared) and all(of.get((port, n), -1) == of.get((other, n), -2) for n in shared)

    groups: list[list[str]] = []
    for port in detectable:
        group = next((g for g in groups if one(port, g[0])), None)
        if group is None:
            groups.append([port])
        else:
            group.append(port)
    for group in groups:
        if len(group) > 1:
            text = f"A law looks the same at {in_words(group)}."
            yield BlindSpot("alike-ports", tuple(group), text)


def helpful_sensors(
    bench: Workbench, fitted: Fitted, probe: Probe, runs: list[Run], response: Sensitivity
) -> tuple[str, ...]:
    """Find states whose sensor, as quiet as the present ones, would determine more of the parameters; best first."""
    states, _ = along(bench, fitted)
    moved_by = np.std(states, axis=0)
    y = np.std(np.concatenate([r.y for r in bench.recordings]), axis=0)
    share = float(np.mean(bench.scale / y))
    count, found = count_undetermined(response.scaled), list[tuple[int, str]]()
    for j, name in enumerate(bench.simulator.states):
        if not moved_by[j] > 0:
            continue
        row = np.zeros((1, runs[0].a.shape[1]))
        row[0, j] = 1 / (share * moved_by[j])

        def other(r: Run, row: np.ndarray = row) -> Run:
            c = np.concatenate([r.c / bench.scale[:, None], np.broadcast_to(row, (len(r.c), *row.shape))], axis=1)
            d = np.concatenate([r.d / bench.scale[:, None], np.zeros((len(r.d), 1, r.d.shape[2]))], axis=1)
            return replace(r, c=c, d=d)

        left = count_undetermined(Sensitivity.of(bench, probe, runs, other).scaled)
        found += [(left, name)] if left < count else []
    return tuple(name for _, name in sorted(found))


def next_record(bench: Workbench, blind: Sequence[BlindSpot], ties: Sequence[Tie], sensors: Sequence[str]) -> str:
    """Say what to record next, by the gravest blind spot that a record can mend."""
    by_kind = {b.kind: b.names for b in reversed(blind)}
    if "rough" in by_kind:
        return "None before the simulator follows these better: check its values and units, the start and the hold."
    u = np.concatenate([r.u for r in bench.recordings])
    driven = [n for n, v in zip(bench.simulator.inputs, u.T, strict=True) if np.ptp(v) > 0]
    drive = driven[0] if driven else "the input"
    if "constant-input" in by_kind:
        return f"One in which {in_words(by_kind['constant-input'])} varies."
    for inner in (True, False):  # forces inside first, then the signals
        ahead, single = ([p for p in by_kind.get(k, ()) if in_series(p) != inner] for k in MOTION)
        own = [port.removeprefix("actuator:") for port in (*ahead, *single) if port.startswith("actuator:")]
        name = drive if inner or not own else own[0]
        if ahead:
            return f"A slow triangle of {name} with reversals, at two amplitudes."
        if single:
            return f"A second amplitude of {name}, such as half of it."
    if sensors:
        names = in_words([n for t in ties for n in t.names])
        return f"One with another sensor, such as one of {sensors[0]}, to separate {names}."
    if "hidden-port" in by_kind or "dead" in by_kind:
        hidden = (*by_kind.get("hidden-port", ()), *by_kind.get("dead", ()))
        return f"One with another sensor, which reacts to {in_words(hidden)}."
    if "alike-ports" in by_kind:
        group = by_kind["alike-ports"]
        inner_ports = [port for port in group if not in_series(port)]
        if inner_ports:
            return f"One that also measures the force at {inner_ports[0]}."
        return f"One with another sensor between {in_words(group)}."
    if "flat" in by_kind or "followed" in by_kind:
        return f"A longer one, with other amplitudes and rates of {drive}."
    if "start" in by_kind:
        return "One that begins at rest, with initial='zero'."
    if ties:
        return f"No further record of these signals helps: measure {ties[0].names[0]} separately and fix it."
    return "None is pressing; for the test take amplitudes that the training recordings do not have."
