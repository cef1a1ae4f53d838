"""Detectability of laws at ports: excitation, the smallest force that recordings reveal, and laws that look the same.

Let φ be the change of the outputs by a law's force of unit size, and φ' its part that own parameters and unknown
initial states cannot imitate, both in units of the noise (`screen`). A force of size 3.29 / |φ'| is detected with 5
% false alarms and 5 % misses (Currie 1968, Anal. Chem. 40(3)). Laws whose φ' are parallel look the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import one_at_a_time
from ..data import Recording
from ..laws import CATALOGUE, Law, readable_unit
from ..models import map_points
from ..simulators import Port, Simulator
from .identifiability import stacked
from .linearise import Probe, Run, along
from .screen import Remainder, Task, lengths, orthonormal, own_changes, project_off
from .workbench import Fitted, Workbench

DETECTED = 3.29  # standard errors: 5 % false alarms and 5 % misses (Currie 1968)
TENTH = 0.1  # share of an effect; real machines follow a catalogue formula no more closely than this
FOLLOWED = TENTH**2  # share of a response below which a remainder comes from holding forces over samples
SMALLEST_SWING = 0.05  # of a reversal, as a share of the travel; smaller swings are ripple


@dataclass(frozen=True)
class LawRow:
    """A law at a port, and whether it is detectable.

    Attributes
    ----------
    status : str
        "detectable", "followed" (own parameters imitate it), "weak" (it moves no output by more than the noise), or
        "no data" (with the reason in `why`).
    force : float or None
        Smallest detectable rms force (in series: deviation of the signal), in `unit`.
    share : float or None
        That force relative to the largest own force of the simulator at the port, in series to the signal; None if
        unknown.
    strength : tuple or None
        Name, value and unit of the law's strength at that force, for laws with one strength.
    why : str
        The parameter that imitates it, or the reason why there is no data.
    """

    port: str
    law: str
    status: str
    force: float | None = None
    unit: str = ""
    share: float | None = None
    strength: tuple[str, float, str] | None = None
    why: str = ""


@dataclass(frozen=True)
class Excitation:
    """Motion of a port's local coordinate.

    Attributes
    ----------
    travel : float
        Largest minus smallest value, in `unit`.
    reversals : int
        Turning points with swings of at least a twentieth of the travel on both sides.
        Distinct amplitudes of nine tenths of the swings; amplitudes closer than a tenth of the largest count once.
    rests : int
        Stretches longer than two typical swings in which the coordinate stays within a twentieth of the travel.
    """

    port: str
    travel: float
    unit: str
    reversals: int
    amplitudes: int
    rests: int


@dataclass(frozen=True, eq=False)
class _Response:
    """Response to a law in its middle shape that own parameters cannot imitate, and a basis for each shape."""

    name: tuple[str, str]
    left: np.ndarray
    spans: list[np.ndarray]
    most: float  # response to the full local force, in standard deviations of the noise


def assess_laws(
    bench: Workbench,
    fitted: Fitted,
    probe: Probe,
    runs: list[Run],
    laws: Sequence[type[Law]] | None,
    names: Sequence[str],
) -> tuple[tuple[LawRow, ...], tuple[tuple[tuple[str, str], ...], ...]]:
    """Assess every law at every port, and group laws that look the same; the bench's scale is the noise.

    Without `laws`, take the plainest form of each law of the catalogue. `names` are those of the free parameters.
    """
    tried = {port.name: _laws_at(port, laws) for port in _live_ports(bench.simulator)}
    rest = Remainder.of(bench, probe, runs, tuple(dict.fromkeys(law for own in tried.values() for law in own)))
    own, start = own_changes(bench, rest.runs, known=[r.from_zero for r in rest.runs])
    base = orthonormal(np.hstack([own, start]))
    rest = replace(rest, base=base[:, :0])
    levels = _local_levels(bench, fitted, runs)
    rows: list[LawRow] = []
    responses: list[_Response] = []
    for task in rest.tasks:
        wanted = tried.get(task.port.name, ())
        if not wanted:
            continue
        task = replace(task, pairs=[(law, shapes) for law, shapes in task.pairs if type(law) in wanted])
        for row, response in _at_port(rest, task, base, own, levels[task.index], names):
            rows.append(row)
            responses += [response] if response else []
        seen = {type(law) for law, _ in task.pairs}
        for law in (law for law in wanted if law not in seen):
            why = law().why_not(task.local) or "its signals do not change"
            rows.append(LawRow(task.port.name, law.id, "no data", why=why))
    return tuple(rows), _classes(responses)


def _laws_at(port: Port, laws: Sequence[type[Law]] | None) -> tuple[type[Law], ...]:
    """Return the laws allowed at a port; from the catalogue only the first form of each, since finer ones are alike."""
    placed = [law for law in (CATALOGUE if laws is None else laws) if port.kinds & set(law.places)]
    first = {law.id: law for law in reversed(placed)}
    return tuple(law for law in placed if laws is not None or law is first[law.id])


def _at_port(
    rest: Remainder, task: Task, base: np.ndarray, own: np.ndarray, level: float | None, names: Sequence[str]
) -> Iterator[tuple[LawRow, _Response | None]]:
    """Assess the laws of one port; yield the row of each law, and its response if it is detectable."""
    w_unit, z_unit = port_units(task.port, rest.bench.recordings[0])
    most = level or np.inf
    for law, doses in rest.doses(task):
        left = [project_off(d.phi, base) for d in doses]
        for phi, d in zip(left, doses, strict=True):
            phi[:, lengths(phi) < FOLLOWED * lengths(d.phi)] = 0.0
        sizes = np.array([lengths(phi).max() for phi in left])
        shapes = np.flatnonzero(sizes) if np.any(sizes) else np.arange(len(sizes))
        middle = int(shapes[np.argsort(sizes[shapes], kind="stable")[len(shapes) // 2]])
        dose, size = doses[middle], float(sizes[middle])
        force = DETECTED / size if size > 0 else None
        share = force / level if force and level else None
        row = LawRow(task.port.name, law.id, "detectable", force, w_unit, share)
        if force is None or force > most:
            yield _undetectable(row, dose.phi, most, own, names), None
            continue
        if len(law.strength) == 1 and dose.phi.shape[1] == 1:
            unit = readable_unit(law.units[law.strength[0]], w_unit, z_unit)
            row = replace(row, strength=(law.strength[0], force / float(dose.size[0]), unit))
        spans = [orthonormal(phi) for phi in left if np.any(phi)]
        yield row, _Response((task.port.name, law.id), left[middle].sum(axis=1), spans, most * size)


def _undetectable(row: LawRow, phi: np.ndarray, most: float, own: np.ndarray, names: Sequence[str]) -> LawRow:
    """Say why a law is not detectable: it is weak at the largest local force, or own parameters imitate it."""
    response = phi[:, np.argmax(lengths(phi))]
    size = float(np.linalg.norm(response))
    if size == 0 or size * most < DETECTED:
        return replace(row, status="weak")
    cosines = np.abs(response @ own) / np.maximum(lengths(own), 1e-300)
    alike = np.max(cosines, initial=0.0) > TENTH
    return replace(row, status="followed", why=names[int(np.argmax(cosines))] if alike else "the unknown start")


def _classes(responses: list[_Response]) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Group responses: each member explains the most visible one within a tenth, and vice versa."""
    order = sorted(responses, key=lambda r: -r.most)
    if not order:
        return ()
    whole = np.column_stack([r.left / max(np.linalg.norm(r.left), 1e-300) for r in order])
    explained = np.array([np.max([np.sum((q.T @ whole) ** 2, axis=0) for q in r.spans], axis=0) for r in order])
    missed = np.sqrt(np.maximum(1 - explained, 0.0))
    alike = (missed < TENTH) | (missed * [r.most for r in order] < DETECTED)
    groups = group_alike(range(len(order)), lambda i, j: bool(alike[i, j] and alike[j, i]))
    return tuple(tuple(order[i].name for i in group) for group in groups if len(group) > 1)


def group_alike(items: Iterable[Any], alike: Callable[[Any, Any], bool]) -> list[list[Any]]:
    """Group items: each joins the first group whose first member is like it."""
    groups: list[list[Any]] = []
    for item in items:
        group = next((g for g in groups if alike(g[0], item)), None)
        if group is None:
            groups.append([item])
        else:
            group.append(item)
    return groups


def _live_ports(simulator: Simulator) -> list[Port]:
    """List the ports at which physics can be missing.

    Inputs that no equation reads, and equations that define a speed, are left out.
    """
    idle = {f"actuator:{name}" for name in simulator.idle_inputs} | {f"equation:{name}" for name in simulator.kinematic}
    return [port for port in simulator.all_ports() if port.name not in idle]


def port_units(port: Port, recording: Recording) -> tuple[str, str]:
    """Return the units of a port's force and coordinate, in series both those of the signal; empty if unknown."""
    if not port.series:
        return port.unit, port.across_unit
    unit = port.unit or recording.units.get(port.name.partition(":")[2], "")
    return unit, unit


@one_at_a_time
def _local_levels(bench: Workbench, fitted: Fitted, runs: list[Run]) -> list[float | None]:
    """Compute the largest rms of the simulator's own terms in the equation of each port of `all_ports`.

    A term is the equation's derivative with respect to a state or input, times that signal's deviation from its mean.
    For a port in series it is the signal's own deviation. Ports where nothing moves have None.
    """
    simulator, z, at = bench.simulator, np.concatenate([r.z for r in runs]), along(bench, fitted)
    swing = np.hstack([v - v.mean(axis=0) for v in at])
    own = simulator.parameter_set
    values = own.pack({k: v for k, v in fitted.values.items() if k in own})
    symbols = x, u, p, _ = (*simulator.symbols()[:3], ca.SX(0))
    vectors = stacked(x), stacked(u), stacked(p)
    changes = ca.vertsplit(simulator.derivatives(*symbols)) if simulator.states else []
    equations = {**simulator.measured(*symbols), **dict(zip(simulator.states, changes, strict=True))}
    found: list[float | None] = []
    for j, port in enumerate(simulator.all_ports()):
        if port.series:
            value = float(np.std(z[:, j]))
        else:
            into = simulator.into(port, *symbols)
            slopes = ca.jacobian(ca.vertcat(*(equations[name] for name in into)), ca.vertcat(*vectors[:2]))
            terms = ca.Function("terms", [*vectors], [ca.densify(slopes), ca.densify(ca.vertcat(*into.values()))])
            slope, factor = map_points(terms, *at, values)
            force = slope * swing[:, None, :] / np.where(factor == 0, np.inf, np.abs(factor))
            value = float(np.max(np.sqrt(np.mean(force**2, axis=0)), initial=0.0))
        found.append(value if np.isfinite(value) and value > 0 else None)
    return found


def excitations(bench: Workbench, probe: Probe, runs: Sequence[Run]) -> Iterator[Excitation]:
    """Count reversals, distinct amplitudes and rests of every live port's local coordinate along the refitted run."""
    for port in _live_ports(bench.simulator):
        signals = [r.z[:, probe.ports.index(port.name)] for r in runs]
        travel = float(np.ptp(np.concatenate(signals)))
        least = SMALLEST_SWING * travel
        reversals, rests, swings = 0, 0, list[float]()
        for z in signals if travel > 0 else ():
            turns = _turning_points(z, least)
            reversals += max(len(turns) - 2, 0)
            swings += np.abs(np.diff(z[turns])).tolist()
            rests += _rests(z, least, 2 * float(np.median(np.diff(turns))) if len(turns) > 2 else TENTH * len(z))
        unit = port_units(port, bench.recordings[0])[1]
        yield Excitation(port.name, travel, unit, reversals, _distinct(np.array(swings)), rests)


def _turning_points(z: np.ndarray, least: float) -> list[int]:
    """Find the turning points of z between swings of at least `least`, the first and the last included."""
    turns, extreme, way = [0], 0, 0.0
    for k, value in enumerate(z.tolist()):
        if way == 0:
            if abs(value - z[0]) >= least:
                way, extreme = np.sign(value - z[0]), k
        elif way * (value - z[extreme]) >= 0:
            extreme = k
        elif way * (z[extreme] - value) >= least:
            turns.append(extreme)
            way, extreme = -way, k
    return [*turns, extreme] if extreme > turns[-1] else turns


def _distinct(swings: np.ndarray) -> int:
    """Count the distinct sizes of nine tenths of the swings; sizes within a tenth of the largest count once."""
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
    """Count the stretches of more than `samples` samples in which z stays within `least`."""
    count, begin, low, high = 0, 0, z[0], z[0]
    for k, value in enumerate(z):
        low, high = min(low, value), max(high, value)
        if high - low > least or k == len(z) - 1:
            count += k - begin > samples
            begin, low, high = k, value, value
    return count
