"""Pictures of a hidden force: over local coordinate, rate and time, with the law on top, and what the law leaves."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import plots
from .._base import InputError
from ..diagnose import Fitted, Workbench
from .diagnosis_force import Hidden, hidden_force
from .page import Block, Picture, Text


def force_blocks(
    bench: Workbench, noise: np.ndarray, fitted: Fitted, port: str, number: int | None, name: str
) -> list[Block]:
    """Recover the force in a port and draw it.

    Parameters
    ----------
    bench, noise, fitted, port, number
        See `hidden_force`.
    name : str
        What the law is called.
    """
    records = bench.recordings
    loud = int(np.argmax([np.std(r.y[r.skip :] / bench.scale) * np.sqrt(len(r)) for r in records]))
    try:
        hidden = hidden_force(bench, fitted, port, number, noise, loud)
    except (InputError, np.linalg.LinAlgError, RuntimeError):
        hidden = None
    if hidden is None:
        return [Text(f"The force at {port} cannot be recovered from these outputs.")]
    place = bench.simulator.port(port)
    which = hidden.recording or (f"training recording {loud + 1}" if len(records) > 1 else "the recording")
    what = {"actuator": "added to the input", "sensor": "added to the output"}.get(port.split(":")[0], "force w")
    across = port.split(":", 1)[1] if place.series and ":" in port else "local coordinate z"
    units: dict[str, Any] = {"unit": place.unit, "across_unit": place.across_unit}
    how = (
        f"Blue is what has to act at {port} for the simulator to follow {which}. It is found by a smoother that takes "
        "the simulator's other parameters as fitted and knows no law: a force that wanders by random steps. "
    )
    how += f"Red is the fitted {name} along the simulation." if name else ""
    alt = f"Recovered force at {port}"
    first = f"{port}, over {across}."
    out: list[Block] = [
        Text(how),
        _cloud(hidden, across, what, name, units, first, f"{alt} over its local coordinate."),
    ]
    if np.ptp(hidden.dz) > 0:
        out.append(_over_rate(hidden, across, what, name, place.unit, place.across_unit, alt))
    elif place.series and len(hidden.law):
        out.append(_through(hidden, across, name, place.across_unit, alt))
    over = plots.force_time(hidden.t, hidden.force, hidden.std, hidden.law, label=what, unit=place.unit, name=name)
    caption = "The same over time, around its largest value, with the uncertainty that noise alone leaves."
    out.append(Picture(over.figure, caption, f"{alt} over time."))
    if len(hidden.law):
        left = hidden.force - hidden.law_held
        shown = plots.force_left(hidden.z, left, hidden.std, across=across, label="recovered − law", **units)
        caption = "What the law leaves of the recovered force. Where the mean bends away from zero, its form is off."
        out.append(Picture(shown.figure, caption, f"{alt} without the law."))
    return out


def _cloud(h: Hidden, across: str, what: str, name: str, units: dict[str, Any], caption: str, alt: str) -> Picture:
    shown = plots.force_cloud(h.z, h.force, h.law_z, h.law, across=across, label=what, title=h.port, name=name, **units)
    return Picture(shown.figure, caption, alt)


def _over_rate(h: Hidden, across: str, what: str, name: str, unit: str, across_unit: str, alt: str) -> Picture:
    units: dict[str, Any] = {"unit": unit, "across_unit": f"{across_unit}/s" if across_unit else ""}
    shown = plots.force_cloud(
        h.dz, h.force, h.law_dz, h.law, across=f"rate of {across}", label=what, title=h.port, name=name, **units
    )
    return Picture(shown.figure, "The same over the rate.", f"{alt} over its rate.")


def _through(h: Hidden, across: str, name: str, unit: str, alt: str) -> Picture:
    """What comes out of a series law over what goes in."""
    units: dict[str, Any] = {"unit": unit, "across_unit": unit}
    shown = plots.force_cloud(
        h.z, h.z + h.force, h.law_z, h.law_z + h.law, across=across, label=f"{across} as it acts", title=h.port,
        name=name, **units,
    )  # fmt: skip
    return Picture(shown.figure, "The same as what comes out over what goes in.", f"{alt}: output over input.")
