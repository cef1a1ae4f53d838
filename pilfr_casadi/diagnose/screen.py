"""A score test of every port and law: the share of the residual that a small dose of a law would remove.

The outputs' sensitivity to a law at zero strength is projected off the simulator's own parameters and the initial
states (Rao 1948); shape parameters lie on a grid. The test is done twice: along the refitted simulation, and along an
observer with process noise at every port, on its innovations.

The same test is done for any force at a port: a flexible surface `w(z, ż)` of Chebyshev terms up to the fourth degree,
with stops, plays and relaxations beside it. Its response is linear in its coefficients, which are fitted to every
second block of the record by ridge regression and judged on the others, so that noise is not explained. This tells
noise from missing structure without knowing the floor, and a right name from one that only comes near.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from .._base import side_by_side
from ..laws import Creep, Law, Local, PlayHysteresis, Relaxation, StopHysteresis
from ..models import Parameter
from .linearise import Run, linearised, observer_gain, run
from .remainder import HUGE, Remainder, Task, held_out
from .workbench import Fitted, Workbench

KEPT = 3  # start values kept for each pair of port and law

DEGREE = 4  # of the flexible surface
# degrees in z and dz/dt of the surface's terms
TERMS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j)
MOST, LEAST = 600_000, 2500  # largest product of samples and squared number of states; least number of samples


@dataclass(frozen=True, eq=False)
class Scored:
    """A port and law with its score and start values, best first.

    The score is the share of the residual that a small dose removes on blocks that it was not fitted to; `sense` is
    `linearise.Run.sense`.
    """

    port: str
    law: Law
    share: float
    starts: tuple[dict[str, Any], ...]
    local: Local
    sense: int = 0
    source: str = "simulation"


def screen(
    bench: Workbench, fitted: Fitted, laws: Sequence[type[Law]], noise: np.ndarray, workers: int = 1
) -> tuple[list[Scored], np.ndarray | None]:
    """Score every port and law along the simulation and along the observer, best first.

    Also returns the observer's gain.

    Parameters
    ----------
    noise : array, shape (n_y,)
        Standard deviation of the outputs' noise.
    workers : int
        Ports processed in parallel.
    """
    probe, runs = linearised(bench, fitted)
    gain = observer_gain(probe, runs, noise)
    led = [run(bench, probe, fitted, i, gain) for i in range(len(runs))] if gain.any() else []
    if not all(_stays_bounded(r, bench.scale) for r in led):
        led = []
    ways = [("simulation", Remainder.of(bench, probe, runs, laws))]
    if led:
        ways.append(("observer", Remainder.of(bench, probe, led, laws)))
    tasks = [(rest, task, source) for source, rest in ways for task in rest.tasks]
    found = [scored for one in side_by_side(lambda task: _score(*task), tasks, workers) for scored in one]
    seen = any(s.source == "observer" for s in found)
    return sorted(found, key=lambda s: -s.share), gain if seen else None


def _stays_bounded(r: Run, scale: np.ndarray) -> bool:
    """Tell whether an observer has kept the simulator in its range and bounded."""
    finite = all(np.all(np.isfinite(values)) for values in (r.a, r.b, r.z, r.dz))
    return finite and bool(np.all(np.abs(r.error) < HUGE * scale))


def _score(rest: Remainder, task: Task, source: str) -> list[Scored]:
    """Score each law of one port."""
    total, out = max(float(rest.left @ rest.left), 1e-300), []
    for law, doses in rest.doses(task):
        sense, scores = rest.runs[0].sense(law, task.index), []
        for dose in doses:
            drop, strength = _gain(dose.phi, rest.left, law, sense)
            scores.append((drop / total, dose, -strength / dose.size))
        scores.sort(key=lambda s: -s[0])
        starts = tuple(start_values(law, dose.shape, c) for _, dose, c in scores[:KEPT])
        # a law with the sign of a drive explains nothing
        share = min(held_out(scores[0][1].phi, rest.left, rest.odd), scores[0][0])
        out.append(Scored(task.port.name, law, share, starts, task.local, sense, source))
    return out


def start_values(law: Law, shape: dict[str, Any], strength: np.ndarray) -> dict[str, Any]:
    """Compute a law's start values: its shape, and its strengths from one entry a column."""
    values, at, p = dict(shape), 0, law.at(shape).parameters()
    for name in law.strength:
        size = p[name].size
        values[name] = strength[at : at + size] if p[name].value.ndim else float(strength[at])
        at += size
    return values


def _signed(law: Law) -> np.ndarray:
    """Mark the strengths (one entry a column) that may have either sign."""
    p = law.parameters()
    return np.concatenate([np.full(p[name].size, name in law.signed) for name in law.strength])


def _gain(phi: np.ndarray, left: np.ndarray, law: Law, sense: int) -> tuple[float, np.ndarray]:
    """Compute the decrease of the sum of squares by the columns of one shape, and their coefficients."""
    gram, right = phi.T @ phi, phi.T @ left
    size = np.sqrt(np.diag(gram))
    if not np.any(size > 0):
        return 0.0, np.zeros(phi.shape[1])
    size = np.where(size > 0, size, 1.0)
    n = len(size)
    ridge = gram / np.outer(size, size) + 1e-10 * np.eye(n)
    if sense and n > 1:
        from scipy.optimize import nnls

        root = np.linalg.cholesky(ridge).T
        target = np.linalg.solve(root.T, -sense * right / size)
        both = _signed(law)  # strengths of either sign: their negatives are columns as well
        found = nnls(np.hstack([root, -root[:, both]]), target)[0]
        coefficients = found[:n]
        coefficients[both] -= found[n:]
        coefficients = -sense * coefficients
    else:
        coefficients = np.linalg.solve(ridge, right / size)
        if sense and n == 1 and -sense * coefficients[0] < 0:
            coefficients = np.zeros(1)
    share = float(2 * coefficients @ (right / size) - coefficients @ ridge @ coefficients)
    return share, coefficients / size


def chebyshev(x: Any, degree: int = DEGREE) -> list[Any]:
    """Compute the Chebyshev polynomials of the first kind, from degree 0 on."""
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
        """Compute the sum of Chebyshev terms."""
        a, b = chebyshev((z - p.z_m) / p.z_s), chebyshev(dz / p.v_s)
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


# forces that together follow any force at a port
FLEXIBLE = (Surface, StopHysteresis, PlayHysteresis, Relaxation, Creep)


def flexible_shares(bench: Workbench, fitted: Fitted) -> dict[str, float]:
    """Compute the held-out share of the residual's power that any force at a port explains, by port."""
    most = max(MOST // max(fitted.model.n_state, 1) ** 2, LEAST) // len(bench.recordings)
    if any(len(r) > most for r in bench.recordings):
        bench = bench.on([r.slice(0, max(most, r.skip + LEAST // 10)) for r in bench.recordings])
    probe, runs = linearised(bench, fitted)
    rest = Remainder.of(bench, probe, runs, FLEXIBLE)
    ridges = (1e-6, 1e-3)
    return {t.port.name: held_out(rest.columns(t)[0], rest.left, rest.odd, ridges) for t in rest.tasks}
