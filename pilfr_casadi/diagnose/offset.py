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

from ..laws.base import Law
from ..recording import InputError
from .floor import effective_size
from .gates import CURED, STRAINED, Gate, slips
from .linearise import linearised
from .remainder import block_diagonal, moved, orthonormal
from .workbench import THOROUGH, Fitted, Workbench

ROOM = 12.0  # nats that an offset has to gain
IDLE = 1.02  # times the mean square error that an offset which was none may take away
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
    """Constants at inputs and outputs, the most useful first, as parameters of the simulator."""
    gates: list[Gate] = []
    before = plain.cost
    ports = [f"actuator:{n}" for n in bench.simulator.inputs]
    ports += [f"sensor:{n}" for n in bench.simulator.output_names]
    while ports:
        share = first_order(bench, plain, ports)
        port = max(share, key=lambda name: share[name])
        if share[port] < LEAST:
            break
        placed = bench.simulator.with_element(port, Offset())
        other = replace(bench, simulator=placed)
        with_law = plain.simulator.with_element(port, Offset())
        try:
            found = other.fit(with_law, [plain.values], states=plain.initial, solver=THOROUGH)
        except InputError:
            break
        n = max(effective_size(found.residual), 30.0)
        if 0.5 * n * np.log(plain.cost / found.cost) - 0.5 * np.log(n) < ROOM:
            break
        kind, name = port.split(":", 1)
        value = float(found.values[with_law.elements[-1].prefix + "w_0"])
        where, load = ("input", ", or a constant load acts like one") if kind == "actuator" else ("output", "")
        sentence = (
            f"The {where} {name} has a constant offset of about {value:.3g}{load}; with it as a parameter the refitted "
            f"error falls from {plain.cost**0.5:.3g} to {found.cost**0.5:.3g} of the outputs' deviation."
        )
        gates.append(Gate(name, "offset", value, sentence, True, parameter=with_law.elements[-1].prefix + "w_0"))
        bench, plain = other, found
        ports.remove(port)
    whole = plain.cost < WHOLE * before
    return bench, plain, [replace(g, fault=whole) for g in gates]


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
    """A simulator with effects, its offsets held at zero where it does as well: an effect may have looked like one."""
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
        if found.cost < IDLE * fitted.cost:
            fitted = found
    return fitted
