"""Compute which laws recordings can detect at which ports, and which look the same.

Everything follows from the simulator linearised along its refitted run, in units of the noise. Let φ be the change of
the outputs by a law's force of unit size, and φ' its part that own parameters and unknown initial states cannot imitate
(`screen`). A force of size 3.29 / |φ'| is detected with 5 % false alarms and 5 % misses (Currie 1968, Anal. Chem.
40(3)). Laws whose φ' are parallel look the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from .._base import one_at_a_time
from ..data import Recording
from ..laws import CATALOGUE, LINEAR, Law, readable_unit
from ..simulators import ACTUATOR, EQUATION, Port, Simulator, map_points, port_name, split_port, stack
from .fits.linearise import Probe, Run, sample_run
from .fits.screen import Remainder, Task, lengths, orthonormal, own_changes, project_off
from .fits.workbench import Fitted, Workbench, pack_known

DETECTION_ERRORS = 3.29  # standard errors: 5 % false alarms and 5 % misses (Currie 1968)
SMALL_SHARE = 0.1  # of an effect: real machines follow a catalogue formula no more closely
HOLD_REMAINDER = SMALL_SHARE**2  # share of a response below which a remainder comes from holding forces


@dataclass(frozen=True)
class LawRow:
    """A law at a port, and whether it is detectable."""

    port: str
    law: str
    # "detectable", "followed" (own parameters imitate it), "weak" (it moves no output by more than the noise), or "no
    # data" (with the reason in `why`)
    status: str
    force: float | None = None  # smallest detectable rms force (in series: deviation of the signal), in `unit`
    unit: str = ""
    # that force relative to the largest own force of the simulator at the port, in series to the signal; None if
    # unknown
    share: float | None = None
    # name, value and unit of the law's strength at that force, for laws with one strength
    strength: tuple[str, float, str] | None = None
    why: str = ""  # the parameter that imitates it, or the reason why there is no data
    form: str = ""  # of laws that were asked for, which may be several forms of one law


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

    Without `laws`, take the plainest form of each law of the catalogue, or if own parameters imitate that, the first
    that is detectable. `names` are the names of the free parameters.
    """
    tried = {port.name: _select_laws(port, laws) for port in live_ports(bench.simulator)}
    wished = {law.id for own in tried.values() for law in own}
    every = tuple(law for law in CATALOGUE if law.id in wished) if laws is None else laws
    rest = Remainder.of(bench, probe, runs, tuple(dict.fromkeys(every)))
    own, start = own_changes(bench, rest.runs, known=[r.from_zero for r in rest.runs])
    base, needed = orthonormal(np.hstack([own, start])), _needed_directions(own, start)
    rest = replace(rest, base=base[:, :0])
    levels = _local_levels(bench, fitted, runs)
    rows: list[LawRow] = []
    responses: list[_Response] = []
    for task in rest.tasks:
        wanted = tried.get(task.port.name, ())
        chosen = replace(task, pairs=[(law, shapes) for law, shapes in task.pairs if type(law) in wanted])
        if not chosen.pairs:
            continue
        assess = partial(_assess_port, rest, base=base, own=(own, needed), level=levels[task.index], names=names)
        for form, row, response in assess(chosen):
            if laws is None and row.status == "followed" and row.law not in LINEAR:
                row, response = _find_detectable_form(assess, task, row, wanted)
            rows.append(row if laws is None else replace(row, form=form))
            responses += [response] if response else []
        rows += _rows_without_data(chosen, wanted, named=laws is not None)
    return tuple(rows), _group_responses(responses)


def _find_detectable_form(
    assess: Callable[[Task], Iterable[tuple[str, LawRow, _Response | None]]],
    task: Task,
    followed: LawRow,
    wanted: Sequence[type[Law]],
) -> tuple[LawRow, _Response | None]:
    """Return the first other form of an imitated law that is detectable, else the law itself.

    A root may look like a gain where a free curve does not.
    """
    others = [pair for pair in task.pairs if pair[0].id == followed.law and type(pair[0]) not in wanted]
    assessed = (found for pair in others for found in assess(replace(task, pairs=[pair])))
    found = ((row, response) for _, row, response in assessed if row.status == "detectable")
    return next(found, (followed, None))


def _rows_without_data(task: Task, wanted: Sequence[type[Law]], named: bool) -> Iterator[LawRow]:
    """Generate a row for each wanted law on which the data at a port carry no information, with its form if `named`."""
    tried = {type(law) for law, _ in task.pairs}
    jumps = np.ptp(task.local.z) > 0 and not np.any(task.local.dz)
    still = "its coordinate jumps and has no rate, like a held input" if jumps else "its signals do not change"
    for law in (law for law in wanted if law not in tried):
        why = law().why_not(task.local) or still
        yield LawRow(task.port.name, law.id, "no data", why=why, form=law.form if named else "")


def _select_laws(port: Port, laws: Sequence[type[Law]] | None) -> tuple[type[Law], ...]:
    """Return the laws allowed at a port; from the catalogue only the first form of each, because most are alike."""
    placed = [law for law in (CATALOGUE if laws is None else laws) if port.admits(law)]
    first = {law.id: law for law in reversed(placed)}
    return tuple(law for law in placed if laws is not None or law is first[law.id])


def _assess_port(
    rest: Remainder,
    task: Task,
    base: np.ndarray,
    own: tuple[np.ndarray, np.ndarray],
    level: float | None,
    names: Sequence[str],
) -> Iterator[tuple[str, LawRow, _Response | None]]:
    """Assess the laws of one port; yield the form and the row of each, and its response if it is detectable.

    `own` are the changes by each parameter, and their directions by `_needed_directions`.
    """
    w_unit, z_unit = port_units(task.port, rest.bench.recordings[0])
    most = level or np.inf
    for law, doses in rest.doses(task):
        left = [project_off(d.phi, base) for d in doses]
        for phi, d in zip(left, doses, strict=True):
            phi[:, lengths(phi) < HOLD_REMAINDER * lengths(d.phi)] = 0.0
        sizes = np.array([lengths(phi).max() for phi in left])
        shapes = np.flatnonzero(sizes) if np.any(sizes) else np.arange(len(sizes))
        middle = int(shapes[np.argsort(sizes[shapes], kind="stable")[len(shapes) // 2]])
        dose, size = doses[middle], float(sizes[middle])
        force = DETECTION_ERRORS / size if size > 0 else None
        share = force / level if force and level else None
        row = LawRow(task.port.name, law.id, "detectable", force, w_unit, share)
        if force is None or force > most:
            yield law.form, _undetectable(row, dose.phi, most, own, names), None
            continue
        if len(law.strength) == 1 and dose.phi.shape[1] == 1:
            unit = readable_unit(law.units[law.strength[0]], w_unit, z_unit)
            row = replace(row, strength=(law.strength[0], force / float(dose.size[0]), unit))
        spans = [orthonormal(phi) for phi in left if np.any(phi)]
        yield law.form, row, _Response((task.port.name, law.id), left[middle].sum(axis=1), spans, most * size)


def _needed_directions(own: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the direction of each parameter's change (R, n) that neither others nor initial states can follow.

    Along it lies all that would be left of an imitated response without that parameter.
    """
    columns = np.hstack([own, start])
    dual = np.linalg.pinv(columns / np.maximum(lengths(columns), 1e-300), rcond=1e-6).T[:, : own.shape[1]]
    return np.asarray(dual / np.maximum(lengths(dual), 1e-300))


def _undetectable(
    row: LawRow, phi: np.ndarray, most: float, own: tuple[np.ndarray, np.ndarray], names: Sequence[str]
) -> LawRow:
    """Say why a law is not detectable: it is weak at the largest local force, or own parameters imitate it.

    If several parameters imitate it, the one without which most would be left is named.
    """
    response = phi[:, np.argmax(lengths(phi))]
    size = float(np.linalg.norm(response))
    if size == 0 or size * most < DETECTION_ERRORS:
        return replace(row, status="weak")
    changes, needed = own
    cosines = np.abs(response @ changes) / np.maximum(size * lengths(changes), 1e-300)
    if not np.max(cosines, initial=0.0) > SMALL_SHARE:
        return replace(row, status="followed", why="the unknown start")
    return replace(row, status="followed", why=names[int(np.argmax(np.abs(response @ needed)))])


def _group_responses(responses: list[_Response]) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Group responses: each member explains the most visible one within a tenth, and vice versa."""
    order = sorted(responses, key=lambda r: -r.most)
    if not order:
        return ()
    whole = np.column_stack([r.left / max(np.linalg.norm(r.left), 1e-300) for r in order])
    explained = np.array([np.max([np.sum((q.T @ whole) ** 2, axis=0) for q in r.spans], axis=0) for r in order])
    missed = np.sqrt(np.maximum(1 - explained, 0.0))
    visible = np.minimum([r.most for r in order], np.finfo(float).max)  # without a limit, zero times it is still zero
    alike = (missed < SMALL_SHARE) | (missed * visible < DETECTION_ERRORS)
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


def live_ports(simulator: Simulator) -> list[Port]:
    """List the ports at which physics can be missing.

    Inputs that no equation reads, and equations that define a speed, are left out.
    """
    idle = {port_name(ACTUATOR, name) for name in simulator.idle_inputs}
    idle |= {port_name(EQUATION, name) for name in simulator.kinematic}
    return [port for port in simulator.all_ports() if port.name not in idle]


def port_units(port: Port, recording: Recording) -> tuple[str, str]:
    """Return the units of a port's force and position (in series twice the signal's unit); empty if unknown."""
    if not port.series:
        return port.unit, port.position_unit
    unit = port.unit or recording.units.get(split_port(port.name)[1], "")
    return unit, unit


@one_at_a_time
def _local_levels(bench: Workbench, fitted: Fitted, runs: list[Run]) -> list[float | None]:
    """Compute the largest deviation of a term in the equation of each port of `all_ports`, in the force's unit.

    Terms are the summands of the equation as it is written, such as the force of a spring. For a port in series it is
    the deviation of the signal. Ports where nothing moves have None.
    """
    simulator, z, at = bench.simulator, np.concatenate([r.z for r in runs]), sample_run(bench, fitted)
    values = pack_known(simulator.parameter_set, fitted.values)
    symbols = x, u, p, _ = (*simulator.symbols()[:3], ca.SX(0))
    vectors = stack(x), stack(u), stack(p)
    changes = ca.vertsplit(simulator.derivatives(*symbols)) if simulator.states else []
    equations = {**simulator.measured(*symbols), **dict(zip(simulator.states, changes, strict=True))}
    found: list[float | None] = []
    for j, port in enumerate(simulator.all_ports()):
        if port.series:
            value = float(np.std(z[:, j]))
        else:
            into = simulator.into(port, *symbols).items()
            forces = [term / factor for name, factor in into for term in _summands(equations[name])]
            rows = map_points(ca.Function("forces", [*vectors], [ca.densify(ca.vertcat(*forces))]), *at, values)[0]
            with np.errstate(all="ignore"):  # a factor may be zero
                spread = np.std(rows, axis=0)
            value = float(np.max(spread[np.isfinite(spread)], initial=0.0))
        found.append(value if np.isfinite(value) and value > 0 else None)
    return found


def _summands(expression: ca.SX) -> list[ca.SX]:
    """Split a sum into its terms, also one that is divided by a mass."""
    found, left = [], [(ca.SX(expression), ca.SX(1))]
    while left:
        e, factor = left.pop()
        if e.is_leaf() or e.op() not in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_DIV):
            found.append(e * factor)
        elif e.op() == ca.OP_DIV:
            left.append((e.dep(0), factor / e.dep(1)))
        else:
            left += [(e.dep(k), factor) for k in range(e.n_dep())]  # a sign does not matter
    return found
