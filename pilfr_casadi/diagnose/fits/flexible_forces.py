"""The share of a residual that any force at a port explains.

The test of a law (`screen`) is done for a flexible force: a surface `w(z, ż)` of Chebyshev terms up to the fourth
degree, with stops, plays and relaxations beside it, or curves of the speed at a port that has no position. Its response
is linear in its coefficients, which are fitted to every second block of the record by ridge regression and judged on
the others, so that noise is not explained. This tells noise from missing structure without knowing the floor, and a
right name from one that only comes near.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ...data import Recording
from ...laws import Creep, Law, Local, PlayHysteresis, Relaxation, StopHysteresis, chebyshev
from ...models import Parameter
from .coloured_noise import whiten, whitening_filters
from .linearise import linearise_runs, loudest_stretch
from .screen import RIDGES, Remainder, held_out, least_rest, lengths, orthonormal, project_off
from .workbench import Fitted, Workbench

DEGREE = 4  # of the flexible surface
# degrees in z and dz/dt of the surface's terms
TERMS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j)
SPEED_DEGREE = 7  # of the polynomials of a speed
KNEES = (0.01, 0.05, 0.25)  # of the curves v / (|v| + knee), over the largest speed: from dry friction to a smooth bend
SPEED_CURVES = SPEED_DEGREE + 2 * len(KNEES)  # number of curves of `speed_curves`
# limits of samples times squared number of states: of the time beyond LEAST_SAMPLES, and of memory in any case
MOST_WORK, LEAST_SAMPLES, MOST_MEMORY = 600_000, 2500, 100_000_000


class Surface(Law):
    """A smooth force of the local coordinate and its rate."""

    id = "surface"
    equation = "w = sum_ij c_ij T_i(z) T_j(dz/dt)"
    units: ClassVar[Mapping[str, str]] = {"c": "w", "z_m": "z", "z_s": "z", "v_s": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, z: Any, dz: Any, p: Any) -> Any:
        """Compute the sum of Chebyshev terms."""
        a, b = chebyshev((z - p.z_m) / p.z_s, DEGREE), chebyshev(dz / p.v_s, DEGREE)
        return sum(p.c[k] * a[i] * b[j] for k, (i, j) in enumerate(TERMS))

    def parameters(self) -> dict[str, Parameter]:
        """Return coefficients and scales."""
        scales = {k: Parameter(float(self.values.get(k, 1.0))) for k in ("z_m", "z_s", "v_s")}
        return {"c": Parameter(np.zeros(len(TERMS))), **scales}

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the scales of the data."""
        yield {
            "z_m": (local.low + local.high) / 2,
            "z_s": 1.1 * local.half,
            "v_s": 1.5 * local.speed if np.any(local.dz) else 1.0,
        }


class SpeedCurve(Law):
    """A force of the speed, at a port that has no position: smooth, or bent at rest."""

    id = "speed_curve"
    equation = "w = sum_j c_j phi_j(dz/dt)"
    units: ClassVar[Mapping[str, str]] = {"c": "w", "v_s": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("c",)

    def force(self, dz: Any, p: Any) -> Any:
        """Compute the sum of the curves."""
        curves = speed_curves(dz / p.v_s)
        return sum(p.c[k] * curve for k, curve in enumerate(curves))

    def parameters(self) -> dict[str, Parameter]:
        """Return coefficients and the scale of the speed."""
        return {"c": Parameter(np.zeros(SPEED_CURVES)), "v_s": Parameter(float(self.values.get("v_s", 1.0)))}

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the scale of the data."""
        yield {"v_s": 1.5 * local.speed}

    def why_not(self, local: Local) -> str:
        """Say that the port has a position; `Surface` is for those."""
        return "" if local.is_speed else "the port has a position"


def speed_curves(v: Any) -> list[Any]:
    """Compute curves of a scaled speed: polynomials, and friction that is alike in both directions or not."""
    return [*chebyshev(v, SPEED_DEGREE)[1:], *(one / (ca.fabs(v) + knee) for knee in KNEES for one in (v, ca.fabs(v)))]


# forces that together follow any force at a port
FLEXIBLE = (Surface, SpeedCurve, StopHysteresis, PlayHysteresis, Relaxation, Creep)


def flexible_shares(bench: Workbench, fitted: Fitted) -> dict[str, float]:
    """Compute the held-out share of the residual's power that any force at a port explains, by port."""
    rest = _remainder_for_flexible_forces(bench, fitted)
    return {t.port.name: held_out(rest.columns(t)[0], rest.left, rest.odd, RIDGES) for t in rest.tasks}


def innovation_share(bench: Workbench, fitted: Fitted) -> float:
    """Compute the largest held-out share that a force at any port explains of the innovations of any output's residual.

    A force seems to explain slow noise on held-out blocks, because a block is known from its neighbours. The
    innovations have no such neighbours; see `coloured_noise`. The noise is what the force leaves (Cochrane & Orcutt
    1949): a filter made for the whole residual would also predict slow physics. Each output counts in units of its own
    noise, so that a noisy sensor does not hide what a quiet one shows.
    """
    rest, n_y = _remainder_for_flexible_forces(bench, fitted), bench.recordings[0].n_y
    sizes = [len(r.z) for r in rest.runs]
    found = [0.0]
    for task in rest.tasks:
        phi = rest.columns(task)[0]
        noise = least_rest(phi, rest.left, rest.odd, RIDGES)
        noise = noise if noise @ noise < rest.left @ rest.left else rest.left
        filters = whitening_filters(np.split(noise.reshape(-1, n_y), np.cumsum(sizes)[:-1]))
        unit = lengths(whiten(noise[:, None], filters, sizes).reshape(-1, n_y))
        filters = [taps / (size or 1.0) for taps, size in zip(filters, unit, strict=True)]
        base = orthonormal(whiten(rest.base, filters, sizes))
        left, phi = (project_off(whiten(a, filters, sizes), base) for a in (rest.left[:, None], phi))
        after = least_rest(phi, left[:, 0], rest.odd, RIDGES)
        if after @ after < left[:, 0] @ left[:, 0]:
            whole, rest_of = (lengths(e.reshape(-1, n_y)) for e in (left, after))
            found.append(float(1 - np.min(rest_of[whole > 0] / whole[whole > 0]) ** 2))
    return max(found)


def _remainder_for_flexible_forces(bench: Workbench, fitted: Fitted) -> Remainder:
    """Project the error along the stretches of the recordings with the largest error that memory and time allow."""
    bench = bench.balanced(fitted)
    size = max(fitted.model.n_state, 1) ** 2  # hundreds of states if a law holds a long delay
    most = max(MOST_WORK // size, min(LEAST_SAMPLES, MOST_MEMORY // size)) // len(bench.recordings)
    if any(len(r) > most for r in bench.recordings):
        pieces, states = list[Recording](), list[np.ndarray]()
        for r, e, state in zip(bench.recordings, fitted.residual, fitted.initial, strict=True):
            part = loudest_stretch(np.sum((e / bench.scale) ** 2, axis=1), max(most, LEAST_SAMPLES // 10), r.skip)
            begin = part.start if part.start > r.skip else 0
            pieces.append(r.slice(begin, part.stop))
            before = fitted.model.drive(r)[: begin * fitted.model.substeps]
            states.append(fitted.engine.simulate(before, fitted.vector, state)[1] if begin else state)
        bench, fitted = bench.on(pieces), replace(fitted, initial=states)
    return Remainder.of(bench, *linearise_runs(bench, fitted), FLEXIBLE)
