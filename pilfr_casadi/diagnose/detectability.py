"""Detectability of laws at ports: the smallest force that recordings reveal, and the laws that look the same.

With φ the outputs' changes by a law's force of unit size and φ' what own parameters and unknown initial states leave of
them, both in units of the noise (`remainder`), a force of the size 3.29 / |φ'| is detected: 5 % false alarms and 5 % of
forces missed (Currie 1968, Anal. Chem. 40(3)). Laws whose φ' point the same way look the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from .._base import one_at_a_time
from ..data import Recording
from ..laws import CATALOGUE, Law, display_name, readable_unit
from ..models import map_points
from ..simulators import Port, Simulator
from .identifiability import Symbols
from .linearise import Probe, Run, along
from .remainder import Remainder, Task, block_diagonal, lengths, moved, orthonormal
from .workbench import Fitted, Workbench

DETECTED = 3.29  # standard errors
TENTH = 0.1  # of an effect: no machine follows a catalogue formula more closely, and no smaller difference has a name
FOLLOWED = TENTH**2  # share of a response: what is left below it comes from forces that are held over samples here
LINEAR = ("linear_stiffness", "viscous_damping")  # what a simulator's own parameters are for


@dataclass(frozen=True)
class LawRow:
    """A law at a port, and whether it is detectable.

    Attributes
    ----------
    status : str
        "detectable", "followed" (own parameters follow it), "weak" (it moves no output by more than the noise), or
        "no data" (with the reason in `why`).
    force : float or None
        Smallest rms force (in series: deviation of the signal) that would be detected, in `unit`.
    share : float or None
        That force over the largest force of the simulator's own at the port, in series over the signal; None where it
        is unknown.
    strength : tuple or None
        Name, value and unit of the law's strength at that force, for laws of one strength.
    why : str
        The parameter that follows it, or why there is no data.
    """

    port: str
    law: str
    status: str
    force: float | None = None
    unit: str = ""
    share: float | None = None
    strength: tuple[str, float, str] | None = None
    why: str = ""


@dataclass(frozen=True, eq=False)
class _Response:
    """Rest of a law's unit response at a port in its middle shape, and a basis of each of its shapes."""

    name: tuple[str, str]
    left: np.ndarray
    spans: list[np.ndarray]
    most: float  # deviations from the noise at the full local force


def plainest_forms(port: Port) -> tuple[type[Law], ...]:
    """Return the first form of each law that may stand at a port: its finer forms are detectable where this one is."""
    first: dict[str, type[Law]] = {}
    for law in CATALOGUE:
        if port.kinds & set(law.places):
            first.setdefault(law.id, law)
    return tuple(first.values())


def assess_laws(
    bench: Workbench,
    fitted: Fitted,
    probe: Probe,
    runs: list[Run],
    laws: Sequence[type[Law]] | None,
    names: Sequence[str],
) -> tuple[tuple[LawRow, ...], tuple[tuple[tuple[str, str], ...], ...]]:
    """Assess every law at every port, and group those that look the same; the bench's scale is the noise.

    Without `laws`, these are the plainest forms of the catalogue's. `names` are those of the free parameters.
    """
    ports = [port for port in bench.simulator.all_ports() if port.name not in idle_ports(bench.simulator)]
    tried = {port.name: plainest_forms(port) if laws is None else tuple(laws) for port in ports}
    rest = Remainder.of(bench, probe, runs, tuple(dict.fromkeys(law for own in tried.values() for law in own)))
    blocks = [moved(bench, r) for r in rest.runs]
    n = runs[0].n_free
    changes = block_diagonal(blocks, n)
    known = np.repeat([r.from_zero for r in rest.runs], (changes.shape[1] - n) // len(blocks))
    base = orthonormal(np.hstack([changes[:, :n], changes[:, n:][:, ~known]]))
    rest = replace(rest, base=base[:, :0])
    levels = local_levels(bench, fitted, runs)
    rows: list[LawRow] = []
    responses: list[_Response] = []
    for task in rest.tasks:
        if task.port.name not in tried:
            continue
        own = tried[task.port.name]
        task = replace(task, pairs=[(law, shapes) for law, shapes in task.pairs if type(law) in own])
        found, more = _at_port(rest, task, base, changes[:, :n], levels[task.index], names)
        rows += found
        responses += more
        rows += [
            LawRow(task.port.name, law.id, "no data", why=law().why_not(task.local) or "its signals do not change")
            for law in own
            if task.port.kinds & set(law.places) and law not in {type(other) for other, _ in task.pairs}
        ]
    return tuple(rows), _classes(responses)


def _at_port(
    rest: Remainder, task: Task, base: np.ndarray, own: np.ndarray, level: float | None, names: Sequence[str]
) -> tuple[list[LawRow], list[_Response]]:
    """Assess the laws of one port; return their rows, and the responses of those that are detectable."""
    rows, responses = [], []
    w_unit, z_unit = port_units(task.port, rest.bench.recordings[0])
    size = np.maximum(lengths(own), 1e-300)
    for law, doses in rest.doses(task):
        left = [d.phi - base @ (base.T @ d.phi) for d in doses]
        for phi, d in zip(left, doses, strict=True):
            phi[:, lengths(phi) < FOLLOWED * lengths(d.phi)] = 0.0
        loudest = [int(np.argmax(lengths(phi))) for phi in left]
        sizes = np.array([lengths(phi)[j] for phi, j in zip(left, loudest, strict=True)])
        order = np.argsort(sizes)[np.sum(sizes == 0) :] if np.any(sizes) else np.arange(len(sizes))
        middle = int(order[len(order) // 2])  # of the shapes that own parameters do not follow
        column, dose = loudest[middle], doses[middle]
        raw = dose.phi[:, int(np.argmax(lengths(dose.phi)))]
        force = DETECTED / sizes[middle] if sizes[middle] > 0 else None
        share = None if force is None or not level else force / level
        row = LawRow(task.port.name, law.id, "detectable", force, w_unit, share)
        most = level or np.inf
        if force is None or force > most:
            if not np.any(raw) or float(np.linalg.norm(raw)) * most < DETECTED:
                row = replace(row, status="weak")
            else:
                cosines = np.abs(raw @ own) / size
                best = names[int(np.argmax(cosines))] if len(names) and cosines.max() > TENTH else "the unknown start"
                row = replace(row, status="followed", why=best)
        else:
            if len(law.strength) == 1 and dose.phi.shape[1] == 1:
                unit = readable_unit(law.units[law.strength[0]], w_unit, z_unit)
                row = replace(row, strength=(law.strength[0], force / float(dose.size[column]), unit))
            spans = [orthonormal(phi) for phi in left if np.any(phi)]
            whole = left[middle].sum(axis=1)
            if np.any(whole):
                responses.append(_Response((task.port.name, law.id), whole, spans, most * sizes[middle]))
        rows.append(row)
    return rows, responses


def _classes(responses: list[_Response]) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Group responses: each member explains the most visible one, and is explained by it, to a tenth."""
    order = sorted(responses, key=lambda r: -r.most)
    if not order:
        return ()
    whole = np.column_stack([r.left / np.linalg.norm(r.left) for r in order])
    alike = np.zeros((len(order), len(order)), dtype=bool)
    most = np.array([r.most for r in order])
    for j, r in enumerate(order):
        shares = np.max([np.sum((q.T @ whole) ** 2, axis=0) for q in r.spans], axis=0)
        missed = np.sqrt(np.maximum(1 - shares, 0.0))
        alike[:, j] = (missed < TENTH) | (missed * most < DETECTED)
    alike &= alike.T
    out, free = [], list(range(len(order)))
    while free:
        first, *others = free
        group = [first, *(i for i in others if alike[first, i])]
        free = [i for i in others if i not in group]
        if len(group) > 1:
            out.append(tuple(order[i].name for i in group))
    return tuple(out)


def idle_ports(simulator: Simulator) -> frozenset[str]:
    """Find ports at which nothing can be missing: inputs that no equation reads, and equations that define a speed."""
    inputs = {f"actuator:{name}" for name in simulator.idle_inputs}
    return frozenset(inputs | {f"equation:{name}" for name in simulator.kinematic})


def port_units(port: Port, recording: Recording) -> tuple[str, str]:
    """Return the units of a port's force and coordinate, in series those of the signal; empty where unknown."""
    if not port.series:
        return port.unit, port.across_unit
    unit = port.unit or recording.units.get(port.name.partition(":")[2], "")
    return unit, unit


@one_at_a_time
def local_levels(bench: Workbench, fitted: Fitted, runs: list[Run]) -> list[float | None]:
    """Compute the largest rms of the simulator's own terms in the equation of each port of `all_ports`.

    A term is the equation's derivative with respect to a state or input times that signal's swing about its mean. In
    series it is the signal's own deviation. None where nothing moves.
    """
    simulator, probe_z = bench.simulator, np.concatenate([r.z for r in runs])
    at_x, at_u = along(bench, fitted)
    terms = _term_functions(simulator)
    own = simulator.parameter_set
    p = own.pack({k: v for k, v in fitted.values.items() if k in own})
    swing = np.hstack([at_x - at_x.mean(axis=0), at_u - at_u.mean(axis=0)])
    found: list[float | None] = []
    for j, port in enumerate(simulator.all_ports()):
        if port.series:
            value = float(np.std(probe_z[:, j]))
        else:
            slopes, factors = map_points(terms[port.name], at_x, at_u, p)
            force = slopes * swing[:, None, :] / np.where(factors == 0, np.inf, np.abs(factors))
            value = float(np.max(np.sqrt(np.mean(force**2, axis=0)), initial=0.0))
        found.append(value if np.isfinite(value) and value > 0 else None)
    return found


def _term_functions(simulator: Simulator) -> dict[str, ca.Function]:
    """Make `(x, u, p) -> (slopes (n_targets, n_x + n_u), factors (n_targets, 1))` of each parallel port, at t = 0."""
    s = Symbols.of(simulator)
    x, u, p, t = s.x, s.u, s.p, ca.SX(0)
    changes = ca.vertsplit(simulator.derivatives(x, u, p, t)) if simulator.states else []
    equations = {**simulator.measured(x, u, p, t), **dict(zip(simulator.states, changes, strict=True))}
    out = {}
    for port in simulator.all_ports():
        if not port.series:
            into = simulator.into(port, x, u, p, t)
            right = ca.vertcat(*(equations[name] for name in into))
            slopes = ca.densify(ca.jacobian(right, ca.vertcat(s.states, s.inputs)))
            factors = ca.densify(ca.vertcat(*(ca.SX(f) for f in into.values())))
            out[port.name] = ca.Function("terms", [s.states, s.inputs, s.vector], [slopes, factors])
    return out


def words(name: tuple[str, str]) -> str:
    """Name a law at a port in words."""
    return f"{display_name(name[1])} at {name[0]}"
