"""How much of a residual any force at a port could explain: a flexible surface `w(z, ż)` with memory, cross-validated.

The surface has Chebyshev terms of z and ż up to the fourth degree, stops (or plays) and relaxations besides. Its
response is linear in its coefficients, which are fitted to every second block of the record by ridge regression and
judged on the others: what is noise is not explained there. This tells noise from missing structure without knowing the
floor, and a right name from one that only comes near.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from ..laws import Creep, Law, Local, PlayHysteresis, Relaxation, StopHysteresis
from ..models import Parameter
from .linearise import linearised
from .remainder import Remainder, held_out
from .workbench import Fitted, Workbench

DEGREE = 4
TERMS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j)


def chebyshev(x: Any, degree: int = DEGREE) -> list[Any]:
    """Chebyshev polynomials of the first kind, from degree 0 on."""
    out = [1.0, x]
    for _ in range(degree - 1):
        out.append(2 * x * out[-1] - out[-2])
    return out


class Surface(Law):
    """A smooth force of the local coordinate and its rate."""

    id = "surface"
    equation = "w = sum_ij c_ij T_i(z) T_j(dz/dt)"
    units: ClassVar[Mapping[str, str]] = {"c": "w", "z_m": "z", "z_s": "z", "v_s": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, z: Any, dz: Any, p: Any) -> Any:
        """Chebyshev terms."""
        a, b = chebyshev((z - p.z_m) / p.z_s), chebyshev(dz / p.v_s)
        return sum(p.c[k] * a[i] * b[j] for k, (i, j) in enumerate(TERMS))

    def parameters(self) -> dict[str, Parameter]:
        """Coefficients and scales."""
        scales = {k: Parameter(float(self.values.get(k, 1.0))) for k in ("z_m", "z_s", "v_s")}
        return {"c": Parameter(np.zeros(len(TERMS))), **scales}

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """One scale, that of the data."""
        yield {
            "z_m": (local.low + local.high) / 2,
            "z_s": 1.1 * local.half,
            "v_s": 1.5 * local.speed if np.any(local.dz) else 1.0,
        }


MOST, LEAST = 600_000, 2500  # samples times states squared looked at, and samples at least
FLEXIBLE = (Surface, StopHysteresis, PlayHysteresis, Relaxation, Creep)


def explainable(bench: Workbench, fitted: Fitted) -> dict[str, float]:
    """Share of the residual's power that a flexible force explains on blocks it was not fitted to, by port."""
    most = max(MOST // max(fitted.model.n_state, 1) ** 2, LEAST) // len(bench.recordings)
    if any(len(r) > most for r in bench.recordings):
        bench = bench.on([r.slice(0, max(most, r.skip + LEAST // 10)) for r in bench.recordings])
    probe, runs = linearised(bench, fitted)
    rest = Remainder.of(bench, probe, runs, FLEXIBLE)
    ridges = (1e-6, 1e-3)
    return {t.port.name: held_out(rest.columns(t)[0], rest.left, rest.odd, ridges) for t in rest.tasks}
