"""Write one page for each law of the catalogue: equation, picture, parameters, and the laws it is confused with."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
from common import heading, table, write, write_figure

from pilfr_casadi.laws import CATALOGUE, LINEAR, Law, Local, display_name, readable_unit, unit_forces
from pilfr_casadi.plots import new_figure
from pilfr_casadi.plots.canvas import BLUE, GREY, finish

KINDS = {
    "stiffness": "Forces of position",
    "friction": "Forces of speed",
    "hysteresis": "Loops",
    "curves": "Curves of actuators and sensors",
    "dynamic": "Delays, creep, modes and trends",
    "composed": "Forces of speed",
    "in_line": "In line with a force of the equations",
    "thermal": "Heat flows",
    "electrical": "Currents and voltages",
}
# ids of the laws that are special cases of a law
SPECIAL_CASES = {
    "clearance": ("linear_stiffness", "piecewise_stiffness"),
    "creep": ("linear_stiffness", "viscous_damping"),
    "extra_mode": ("linear_stiffness", "viscous_damping"),
    "hysteresis": ("backlash", "coulomb_friction", "linear_stiffness"),
    "piecewise_stiffness": ("linear_stiffness",),
    "stribeck_friction": ("coulomb_friction",),
}
# units of w and z, by the name of a law or by its first domain
UNITS = {
    "Overpotential": ("V", "A"),
    "VoltageDrop": ("V", "A"),
    "SaturatingInductance": ("V", "A"),
    "Gravity": ("N m", "rad"),
    "WholeGravity": ("N m", "rad"),
    "Unbalance": ("N", "rad"),
    "FreeCurve": ("V", "1"),
    "thermal": ("W", "K"),
    "electrical": ("A", "V"),
    "mechanical": ("N", "m"),
}
WARM, HOT = 200.0, 500.0  # amplitude of a temperature difference, and the middle of an absolute temperature, K
NEAREST = 3  # look-alikes on a page
SECOND, IN_SERIES = 0.4, 0.5  # in a picture: strengths after the first, and the change of a signal, over its size


def motion() -> Local:
    """Two periods at full amplitude, then two small ones about another middle: a motion with major and minor loops."""
    dt = 0.005
    t = np.arange(0, 4, dt)
    fade = np.clip((t - 2) / 0.5, 0, 1)
    fade = fade**2 * (3 - 2 * fade)  # no jump of the rate
    z = (1 - 0.65 * fade) * np.sin(2 * np.pi * t) + 0.25 * fade
    return Local(
        z=z, dz=np.gradient(z, dt), dt=dt, lengths=(len(t),), max_stiffness=1e4, max_damping=1e2, revolution=2 * np.pi
    )


def motion_of(law: type[Law], local: Local) -> Local:
    """The motion that a law is shown on: temperatures in K for radiation, and a term for a law in line with it."""
    if law.in_line:
        drive = -np.cos(7 * local.dt * np.arange(len(local.z)))
        return replace(local, readers=(law.seen_by, "y"), term=lambda z, dz: drive if law.order == 2 else z + 0.05 * dz)
    if law.id != "radiation":
        return local
    return replace(local, z=WARM * local.z + (HOT if law.form == "absolute" else 0.0), dz=WARM * local.dz)


def columns(law: type[Law], local: Local) -> np.ndarray:
    """Forces at unit strength, shape (samples, shapes, strengths); shapes that overflow are left out."""
    found = unit_forces(law(), local, list(law().shapes(local)) or [{}])
    return found[:, np.all(np.isfinite(found), axis=(0, 2))]


def example(law: type[Law], forces: np.ndarray) -> np.ndarray:
    """Force of the middle shape, with all strengths above zero."""
    own = forces[:, forces.shape[1] // 2]
    if not law.strength:
        return own[:, 0]
    share = np.where(np.arange(own.shape[1]) == 0, 1.0, SECOND) if len(law.strength) > 1 else np.ones(own.shape[1])
    force = np.sum(share * own / np.maximum(np.max(np.abs(own), axis=0), 1e-12), axis=1)
    return force / np.max(np.abs(force)) * (1.0 if "parallel" in law.places else IN_SERIES)


def draw(law: type[Law], force: np.ndarray, local: Local) -> Any:
    """Draw a force over coordinate and rate (or time), or a signal behind a law over the signal and over time."""
    figure = new_figure(7.2, 2.7)
    left, right = figure.subplots(1, 2)
    t = local.dt * np.arange(len(local.z))
    if "parallel" in law.places:
        left.plot(local.z, force, color=BLUE)
        finish(left, "coordinate z", "force w")
        of_rate = "dz" in law.reads()
        right.plot(local.dz if of_rate else t, force, color=BLUE)
        finish(right, "rate dz/dt" if of_rate else "time [s]", "force w")
    else:
        left.plot(local.z, local.z, color=GREY, linewidth=1)
        left.plot(local.z, local.z + force, color=BLUE)
        right.plot(t, local.z, color=GREY, linewidth=1)
        right.plot(t, local.z + force, color=BLUE)
        finish(left, "signal u (grey: unchanged)", "behind the law")
        finish(right, "time [s]", "behind the law")
    return figure


def look_alikes(law: type[Law], force: np.ndarray, bases: dict[type[Law], np.ndarray]) -> list[tuple[str, float]]:
    """Ids of other laws with the rms share of the force that they leave, nearest first."""
    left: dict[str, float] = {}
    size = np.linalg.norm(force)
    for other, base in bases.items():
        apart = bool(other.domains and law.domains) and set(other.domains).isdisjoint(law.domains)
        if other.id == law.id or apart or set(other.places).isdisjoint(law.places) or size < 1e-9:
            continue
        explained = np.max(np.sum(np.einsum("nsk,n->sk", base, force / size) ** 2, axis=1))
        left[other.id] = min(left.get(other.id, 1.0), float(np.sqrt(max(1 - explained, 0.0))))
    return sorted(left.items(), key=lambda pair: pair[1])[:NEAREST]


def projected(forces: np.ndarray, local: Local, parallel: bool) -> np.ndarray:
    """Remove what a free spring and damper (a free gain and offset) follow."""
    own = np.column_stack([local.z, local.dz] if parallel else [local.z, np.ones(len(local.z))])
    q = np.linalg.qr(own)[0]
    flat = forces.reshape(len(forces), -1)
    return (flat - q @ (q.T @ flat)).reshape(forces.shape)


def orthonormal(forces: np.ndarray) -> np.ndarray:
    """Orthonormal columns of each shape."""
    out = np.zeros_like(forces)
    for s in range(forces.shape[1]):
        u, sizes, _ = np.linalg.svd(forces[:, s], full_matrices=False)
        out[:, s] = u * (sizes > 1e-6 * max(sizes[0], 1e-300))
    return out


def link(law: str) -> str:
    """Link to the page of a law."""
    return f":doc:`{display_name(law)} <{law}>`"


def place(law: type[Law]) -> str:
    """Say where a law may stand."""
    if "parallel" in law.places:
        return "a force at a port"
    return "a sensor" if law.places == ("sensor",) else "an actuator or a sensor"


def domains(law: type[Law]) -> str:
    """Say in what domains a law is tried."""
    if not law.domains:
        return ""
    return f" **Domains:** {', '.join(law.domains)}{'' if law.special else ', and where the domain is unknown'}."


def parameter_table(law: type[Law]) -> str:
    """Write the parameters with their units for a port of the law's domain, or for a signal in its own unit [u]."""
    own = UNITS.get(law.__name__, UNITS[(*law.domains, "mechanical")[0]])
    w, z = own if "parallel" in law.places else ("[u]", "[u]")
    rows = [
        (f"``{name}``", readable_unit(unit, w, z) or "1", "strength" if name in law.strength else "shape")
        for name, unit in law().units.items()
    ]
    return table(("parameter", "unit", "kind"), rows)


def form_section(law: type[Law], alike: list[tuple[str, float]], several: bool) -> str:
    """Write the section of one form of a law; `several` forms have headings."""
    series = "parallel" not in law.places
    title = display_name(law.form) if law.form else "plain"
    title += ", in series" if series and several else ""
    text = [heading(title[0].upper() + title[1:], "-")] if several else []
    text += [
        f"*{law.sentence[0].upper() + law.sentence[1:]}.*\n",
        f".. code-block:: none\n\n   {law.equation}\n",
        f".. image:: /laws/{law.__name__}.svg\n   :alt: {law.sentence.replace('|', ' ')}\n   :class: figure\n",
        parameter_table(law),
    ]
    if alike:
        said = ", ".join(f"{link(name)} ({100 * left:.0f} %)" for name, left in alike)
        text.append(f"**Nearest laws** (what they leave of this force, rms): {said}.\n")
    source = f"**Source:** {law.source}. " if law.source else ""
    name = law.__name__ if not law.__name__.endswith("BehindGap") else "behind_gap(CoulombFriction)"
    text.append(f"{source}**Stands at:** {place(law)}.{domains(law)} **In Python:** ``pilfr.laws.{name}``\n")
    return "\n".join(text)


def page(law_id: str, laws: list[type[Law]], alike: dict[type[Law], list[tuple[str, float]]]) -> str:
    """Write the page of one id, with all its forms."""
    name = display_name(law_id)
    title = name[0].upper() + name[1:]
    force = {"thermal": "surface", "electrical": "coil"}.get((*laws[0].domains, "mechanical")[0], "ground-mass")
    port = force if "parallel" in laws[0].places else "actuator:u"
    text = [
        heading(title),
        f"A diagnosis says: *The simulator leaves out {name} at {port}.* In results it is ``{law_id}``.\n",
    ]
    special = SPECIAL_CASES.get(law_id, ())
    general = [name for name, cases in SPECIAL_CASES.items() if law_id in cases]
    if special:
        text.append(f"Its special cases: {', '.join(map(link, special))}.\n")
    if general:
        text.append(f"It is a special case of {', '.join(map(link, general))}.\n")
    if law_id in LINEAR:
        text.append(
            "It is tried only where the simulator has no free spring, damper or gain of its own there: otherwise it "
            "is the same as another value of that parameter.\n"
        )
    for law in laws:
        text.append(form_section(law, alike[law], len(laws) > 1))
    return escape("\n".join(text))


def escape(text: str) -> str:
    """Escape bars outside code, which reStructuredText would read as substitutions."""
    lines, code = [], False
    for line in text.split("\n"):
        code = line.startswith(".. code-block") or (code and (not line or line.startswith("   ")))
        lines.append(line if code or line.startswith("   :alt:") else re.sub(r"\|", r"\\|", line))
    return "\n".join(lines)


INTRODUCTION = """\
The physical laws that `diagnose` tries at each port. Some belong to one :doc:`domain </howto/other_domains>` alone.
Every page has the equation, a picture, the parameters, and the laws that it is confused with. The pictures show one
motion: two periods at full amplitude, then two small ones about another middle. *Nearest laws* are those that follow
this law's force best on that motion, beside a free spring and damper (behind an actuator or sensor: a free gain and
offset). Real recordings decide better than this: ask :func:`~pilfr_casadi.check`.

A law of your own takes :doc:`ten lines </howto/own_law>`. These pages are made from `pilfr.laws` by the build.
"""


def build() -> None:
    """Write all pages of the catalogue."""
    local = motion()
    forces = {law: columns(law, motion_of(law, local)) for law in CATALOGUE}
    bases = {
        law: orthonormal(projected(f, local, "parallel" in law.places))
        for law, f in forces.items()
        if law.id not in LINEAR
    }
    by_id: dict[str, list[type[Law]]] = {}
    alike = {}
    for law, found in forces.items():
        shown = example(law, found)
        write_figure(f"laws/{law.__name__}.svg", draw(law, shown, motion_of(law, local)))
        rest = projected(shown[:, None], local, "parallel" in law.places)[:, 0]
        alike[law] = look_alikes(law, rest, bases)
        by_id.setdefault(law.id, []).append(law)
    for law_id, laws in by_id.items():
        write(f"laws/{law_id}.rst", page(law_id, laws, alike))
    text = [heading("Laws"), INTRODUCTION]
    kind = {law_id: KINDS[laws[0].__module__.rpartition(".")[2]] for law_id, laws in by_id.items()}
    for name, ids in groupby(by_id, kind.__getitem__):
        rows = [(link(i), by_id[i][0].sentence, f"``{by_id[i][0].equation}``") for i in ids]
        text += [heading(name, "-"), table(("law", "says", "equation of the first form"), rows, "20 40 40")]
    text.append(".. toctree::\n   :hidden:\n\n" + "".join(f"   {law_id}\n" for law_id in by_id))
    write("laws/index.rst", "\n".join(text))
