"""Gate of constants: an unknown offset at an input or an output (a bias of an amplifier, the zero of a sensor).

An offset moves the working point, and without it a search bends other laws until they give one. It is tested to first
order (projected off what parameters and initial states can follow), confirmed by a refit, and then kept as a parameter
of the simulator, so that every law is fitted together with it. It is a fault of the recording where it was
the mismatch; a small one is a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from .._base import InputError
from ..laws import Law
from .floor import effective_size
from .gates import CURED, STRAINED, Gate, slips
from .linearise import linearised
from .proof import mean_nrmse
from .remainder import block_diagonal, moved, orthonormal
from .workbench import THOROUGH, Fitted, Workbench

ROOM = 12.0  # nats that an offset has to gain
STILL = 0.1  # of the value it was found with, that an offset has to keep beside effects to be told
LEAST = 0.01  # share of the mean square that it has to take away
WHOLE = 0.1  # share of the mean square that is left where the offsets were the mismatch


class Offset(Law):
    """A constant added to a signal."""

    id = "offset"
    equation = "w = w_0"
    source = "Ljung (1999), System Identification, sec. 14.1"
    sentence = "a constant offset of the signal"
    units: ClassVar[Mapping[str, str]] = {"w_0": "w"}
    strength: ClassVar[tuple[str, ...]] = ("w_0",)
    places: ClassVar[tuple[str, ...]] = ("series",)

    def force(self, p: Any) -> Any:
        """The constant."""
        return p.w_0


def first_order(bench: Workbench, fitted: Fitted, ports: Sequence[str]) -> dict[str, float]:
    """Share of the mean square that a constant at each port takes away, to first order."""
    probe, runs = linearised(bench, fitted)
    blocks, errors = [], []
    for r, one in zip(bench.recordings, runs, strict=True):
        forces = [(probe.ports.index(name), np.ones((len(r), 1))) for name in ports]
        blocks.append(moved(bench, one, forces, r.skip))
        errors.append((one.error / bench.scale)[r.skip :].ravel())
    first = blocks[0].shape[1] - len(ports)
    base = orthonormal(block_diagonal([b[:, :first] for b in blocks], runs[0].n_free))
    left, columns = np.concatenate(errors), np.concatenate([b[:, first:] for b in blocks])
    total = float(left @ left)
    size = np.linalg.norm(columns, axis=0)
    left = left - base @ (base.T @ left)
    columns = columns - base @ (base.T @ columns)
    rest = np.linalg.norm(columns, axis=0)
    seen = rest > 1e-6 * np.maximum(size, 1e-300)  # a constant that the initial state can follow is not
    drop = np.where(seen, (columns.T @ left) ** 2 / np.maximum(rest, 1e-150) ** 2, 0.0)
    return dict(zip(ports, (drop / max(total, 1e-300)).tolist(), strict=True))


def offsets(bench: Workbench, plain: Fitted) -> tuple[Workbench, Fitted, list[Gate]]:
    """Constants at inputs and outputs, the most useful first, as parameters of the simulator; laws stay where they are.

    They are a fault where they were the mismatch.
    """
    gates: list[Gate] = []
    before, laws = plain.cost, plain.simulator.elements[len(bench.simulator.elements) :]
    ports = [f"actuator:{n}" for n in bench.simulator.inputs]
    ports += [f"sensor:{n}" for n in bench.simulator.output_names]
    taken = {e.port for e in plain.simulator.elements}
    ports = [port for port in ports if port not in taken]
    while ports:
        share = first_order(bench, plain, ports)
        port = max(share, key=lambda name: share[name])
        if share[port] < LEAST:
            break
        other = replace(bench, simulator=bench.simulator.with_element(port, Offset()))
        parameter = f"{other.simulator.elements[-1].prefix}w_0"
        placed = other.simulator
        for e in laws:
            placed = placed.with_element(e.port, e.law)
        placed = placed.with_parameters({**placed.parameters, **plain.simulator.parameters})  # as they are bounded now
        try:
            found = other.fit(placed, [plain.values], states=plain.initial, solver=THOROUGH)
        except InputError:
            break
        if not _earned(plain, found):
            break
        value = float(found.values[parameter])
        sentence = _told(port, value) + (
            f"; with it as a parameter the refitted error falls from {mean_nrmse(bench, plain):.3g} to "
            f"{mean_nrmse(bench, found):.3g} of the outputs' deviation."
        )
        gates.append(Gate(port.split(":", 1)[1], "offset", value, sentence, True, parameter=parameter))
        bench, plain = other, found
        ports.remove(port)
    whole = plain.cost < WHOLE * before and not laws
    return bench, plain, [replace(g, fault=whole) for g in gates]


def _earned(plain: Fitted, found: Fitted) -> bool:
    """Whether a constant makes a fit that much better."""
    n = max(effective_size(found.residual), 30.0)
    return bool(0.5 * n * np.log(plain.cost / found.cost) - 0.5 * np.log(n) > ROOM)


def _told(port: str, value: float) -> str:
    kind, name = port.split(":", 1)
    where, load = ("input", ", or a constant load acts like one") if kind == "actuator" else ("output", "")
    return f"The {where} {name} has a constant offset of about {value:.3g}{load}"


def offset_gates(elements: Sequence[Any], values: Mapping[str, Any]) -> list[Gate]:
    """Findings for the offsets among fitted laws."""
    out = []
    for e in elements:
        if isinstance(e.law, Offset):
            parameter = f"{e.prefix}w_0"
            value = float(values[parameter])
            sentence = f"{_told(e.port, value)}; it is a parameter of the corrected simulator."
            out.append(Gate(e.port.split(":", 1)[1], "offset", value, sentence, True, parameter=parameter))
    return out


def another_zero(
    bench: Workbench, plain: Fitted, found: tuple[Workbench, Fitted, list[Gate]], workers: int
) -> tuple[Workbench, Fitted, list[Gate]]:
    """What slips put right, or where that is far better the slip of an output whose zero is another one as well.

    The offset is told, and kept, by `offsets`.
    """
    for name in bench.simulator.output_names if found[1].cost > STRAINED else ():
        placed = bench.simulator.with_element(f"sensor:{name}", Offset())
        try:
            level = bench.fit(placed, [{}, plain.values], states=plain.begin)
        except InputError:
            continue
        other, after, gates = slips(replace(bench, simulator=placed), level, workers, name)
        if gates and after.cost < CURED * found[1].cost:
            found = replace(other, simulator=bench.simulator), after, gates
    return found


def without_idle_offsets(bench: Workbench, fitted: Fitted) -> Fitted:
    """A simulator with effects, offsets that earn nothing held at zero: an effect may have looked like one."""
    before = len(bench.simulator.elements)
    placed = fitted.simulator.elements
    for element in placed[:before] if len(placed) > before else ():
        if not isinstance(element.law, Offset):
            continue
        name = f"{element.prefix}w_0"
        held = replace(fitted.simulator.parameters[name], value=0.0, fixed=True)
        simulator = fitted.simulator.with_parameters({**fitted.simulator.parameters, name: held})
        start = {k: v for k, v in fitted.values.items() if k != name}
        try:
            found = bench.fit(simulator, [start], states=fitted.initial, solver=THOROUGH)
        except InputError:
            continue
        if not _earned(found, fitted):
            fitted = found
    return fitted


def as_it_came_out(
    gates: Sequence[Gate], after: Fitted, std: Mapping[str, np.ndarray], effects: bool, sure: bool
) -> tuple[Gate, ...]:
    """Findings with the offsets that are some still, at their fitted values, beside effects or none."""
    out = []
    for gate in gates:
        if not gate.parameter:
            out.append(gate)
            continue
        value, error = float(after.values[gate.parameter]), float(std[gate.parameter])
        if not (abs(value) > 3 * error and abs(value) > STILL * abs(gate.value)):
            continue
        sentence = gate.sentence
        if effects:  # what it came to without them says little
            port = next(e.port for e in after.simulator.elements if gate.parameter.startswith(e.prefix))
            sentence = f"{_told(port, value)}; it is a parameter of the corrected simulator."
        if not sure:
            sentence += " As long as the mismatch has no sure name, it may be a part of that."
        out.append(replace(gate, value=value, sentence=sentence))
    return tuple(out)
