"""Whether what looks like a second effect is the first one's own shape.

A law of the catalogue has its formula, a machine has a curve of its own. What the formula leaves of a strong effect is
a force at the same port, of the same signal, and a law somewhere else may follow a part of that. So a second effect is
put up against a free curve beside the first law, of nothing but the signal that this reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import casadi as ca
import numpy as np

from ..laws import Law, Local
from ..models import Parameter
from .candidate import Candidate, attempt
from .flexible import chebyshev

if TYPE_CHECKING:
    from .search import Search

DEGREE = 9
WIDER = 1.2  # times the range of the data, over which the curve is a polynomial; beyond it is level


class CurveOfPosition(Law):
    """A polynomial of the local coordinate."""

    id = "curve"
    equation = "w = sum_k c_k T_k(z / s)"
    units: ClassVar[Mapping[str, str]] = {"c": "w", "s": "z"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, z: Any, p: Any) -> Any:
        """Chebyshev terms."""
        return _curve(z, p)

    def parameters(self) -> dict[str, Parameter]:
        """Coefficients, and the scale, which is held."""
        scale = Parameter(float(self.values.get("s", 1.0)), fixed=True)
        return {"c": Parameter(np.zeros(DEGREE)), "s": scale}


class CurveOfRate(CurveOfPosition):
    """The same of its rate."""

    equation = "w = sum_k c_k T_k(dz/dt / s)"
    units: ClassVar[Mapping[str, str]] = {"c": "w", "s": "z/s"}

    def force(self, dz: Any, p: Any) -> Any:
        """Chebyshev terms."""
        return _curve(dz, p)


def _curve(signal: Any, p: Any) -> Any:
    inside = ca.fmax(ca.fmin(signal / p.s, 1.0), -1.0)
    return sum(p.c[k] * term for k, term in enumerate(chebyshev(inside, DEGREE)[1:]))


def _beside(law: Law, local: Local) -> Law | None:
    """A free curve of what a law reads, over the data."""
    for kind, name in ((CurveOfRate, "dz"), (CurveOfPosition, "z")):
        if name in law.reads():
            return kind().at({"s": WIDER * float(np.max(np.abs(getattr(local, name))))})
    return None


def own_shape(search: Search, second: Candidate) -> bool:
    """Whether a free curve beside the first effect comes nearer than a second effect at another port."""
    first = search.base.simulator.elements[-1]
    local = next((s.local for p in search.passes for s in p.scored if s.port == first.port), None)
    curve = _beside(first.law, local) if local is not None and second.port != first.port else None
    if curve is None:
        return False
    began = search.begin("own shape")
    placed = search.base.simulator.with_element(first.port, curve)
    found = attempt(search.bench, placed, [search.base.values], states=search.base.begin)
    search.timed("own shape", began)
    return found is not None and found.error < second.error
