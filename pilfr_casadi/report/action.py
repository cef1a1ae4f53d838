"""How a named law acts along the training recordings, in quantities that an engineer compares with a data sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..diagnose import Effect, Fitted, Workbench, law_signals
from ..laws import readable_unit
from ..simulators import PARAMETER
from .page import Table, number_text


@dataclass(frozen=True)
class Action:
    """How a law acts along the training recordings: its largest force with its unit, and a table."""

    strongest: str
    table: Table


def measure_action(bench: Workbench, fitted: Fitted, effect: Effect, number: int | None) -> Action | None:
    """Measure the force of element `number` along the training recordings; None without one, or if its run diverges.

    The equivalent stiffness k and damping c are those of the line w = k z + c dz/dt nearest to the force (equivalent
    linearisation, Krylov & Bogoliubov 1943); a cycle is one upward crossing of the mean of z. Where z is a speed, there
    is the damping alone.
    """
    if number is None:
        return None
    port = bench.simulator.port(effect.port)
    with np.errstate(all="ignore"):
        runs = [law_signals(bench, fitted, number, i) for i in range(len(bench.recordings))]
    z, dz, w = (np.concatenate(v) for v in zip(*runs, strict=True))
    if not all(np.all(np.isfinite(v)) for v in (z, dz, w)):
        return None
    largest = f"{number_text(float(np.max(np.abs(w))), 3)}\u00a0{port.unit}".strip()
    of = "parameter" if port.name.startswith(PARAMETER) else "signal"
    what = f"largest change of the {of}" if port.series else "largest force"
    rows = [[what, float(np.max(np.abs(w))), port.unit]]
    unit = readable_unit("w*s/z", port.unit, port.position_unit).replace(" *", "")
    if port.is_speed:
        damping = (w - np.mean(w)) @ z / (z @ z)
        rows += [["equivalent damping", float(damping), unit if port.unit and port.across_unit else ""]]
    elif not port.series:
        (stiffness, damping), *_ = np.linalg.lstsq(np.column_stack([z, dz]), w - np.mean(w), rcond=None)
        taken = sum(float(np.sum((f[1:] + f[:-1]) / 2 * np.diff(x))) for x, _, f in runs)
        cycles = sum(int(np.sum(np.diff(np.signbit(x - np.mean(x)).astype(int)) < 0)) for x, _, _ in runs)
        units = [readable_unit(u, port.unit, port.across_unit).replace(" *", "") for u in ("w*z", "w/z")]
        known = bool(port.unit and port.across_unit)
        rows += [["energy taken per cycle, mean", taken / cycles, units[0] if known else ""]] if cycles else []
        rows += [["equivalent stiffness", float(stiffness), units[1] if known else ""]]
        rows += [["equivalent damping", float(damping), unit if known else ""]]
    return Action(largest, Table(["how it acts in the training recordings", "value", "unit"], rows, digits=3))


def element_of(fitted: Fitted, effect: Effect) -> int | None:
    """Find the element of the fitted simulator that an effect is; offsets may stand before it."""
    placed = enumerate(fitted.simulator.elements)
    return next((i for i, p in placed if (p.port, p.law.id) == (effect.port, effect.law)), None)
