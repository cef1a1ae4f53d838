"""The linear models in a closed model: in small and in large motions, or about a working point.

Plays stand still in motions too small to cross a gap; in large motions they are the gain `w = diag(Σ w) z`. Stops are
this gain in small motions and none in large ones. An operator with the threshold zero has no gap: as a play it always
moves, as a stop it is zero. With the gain K of the operators,

    A + B_w K C_z,   B_u + B_w K D_zu,   C_y + D_yw K C_z,   D_yu + D_yw K D_zu.

A simulator is linearised about a state and an input over a whole sample, with the inputs held and the memory of its
laws at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from .._base import InputError, one_at_a_time
from ..models import Model, Play, Stop, with_port_gain
from .statespace import resolvent

Array = np.ndarray
INFINITE_ZERO = 1e6  # larger zeros are zeros at infinity, up to rounding


@dataclass(frozen=True, eq=False)
class LinearPart:
    """`x⁺ = A x + B u, y = C x + D u` with a step of dt seconds; of shapes (n_x, n_x) to (n_y, n_u)."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float

    def response(self, frequency: Array) -> Array:
        """Return the frequency response, (F, n_y, n_u), at frequencies (F,) in Hz."""
        z = np.exp(2j * np.pi * np.asarray(frequency) * self.dt)
        return np.asarray(resolvent(self.A, self.C, z) @ self.B + self.D)

    @property
    def poles(self) -> Array:
        """Eigenvalues of A, (n_x,), complex."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=complex)

    def zeros(self, output: int = 0, input: int = 0) -> Array:
        """Return the finite zeros of the response from one input to one output, complex."""
        from scipy.linalg import eigvals

        n, c, d = len(self.A), self.C[[output]], self.D[output, input].reshape(1, 1)
        pencil = np.block([[self.A, self.B[:, [input]]], [c, d]])
        mass = np.zeros_like(pencil)
        mass[:n, :n] = np.eye(n)
        with np.errstate(all="ignore"):
            found = np.asarray(eigvals(pencil, mass), dtype=complex)
        return found[np.isfinite(found) & (np.abs(found) < INFINITE_ZERO)]


def linear_parts(
    model: Model, dt: float, state: Array | None = None, drive: Array | None = None
) -> dict[str, LinearPart]:
    """Return the linear models in a closed model, by name.

    Parameters
    ----------
    model : Model
        `small motions` and `large motions` of a PI-LFR with plays or stops; its `linear part` with any other element;
        `linearised` of any other model.
    dt : float
        Sampling interval, s.
    state, drive : array, optional
        Working point of a model that has to be linearised, (n_state,) and (n_u,); zero by default.

    Raises
    ------
    InputError
        If the model reads measured outputs, as a model with an observer does.
    """
    names = ("A", "B_u", "C_y", "D_yu")
    if not set(names) <= set(model.parameters):
        return {"linearised": _linearise(model, dt, state, drive)}
    operator = getattr(model.element, "operator", None)
    if not isinstance(operator, Play | Stop):
        a, b, c, d = (model.parameters[name].value for name in names)
        return {"linear part": LinearPart(a, b, c, d, dt)}
    w, r = (model.parameters[name].value for name in ("w", "r"))
    with_gap, total = (w * (r > 0)).sum(axis=1), w.sum(axis=1)
    small, large = (total - with_gap, total) if isinstance(operator, Play) else (with_gap, 0 * total)
    p = {name: parameter.value for name, parameter in model.parameters.items()}
    gains = {"small motions": small, "large motions": large}
    return {name: LinearPart(*with_port_gain(p, np.diag(gain)), dt) for name, gain in gains.items()}


@one_at_a_time
def _linearise(model: Model, dt: float, state: Array | None, drive: Array | None) -> LinearPart:
    """Linearise a sample of a model about a working point, its memory held."""
    if "y" in model.reads:
        raise InputError("The model reads its measured outputs; leave out its observer, then it has a linear part.")
    n_x, n_u = model.n_x, (model.n_u - ("t" in model.reads)) // (1 + ("next" in model.reads))
    start = np.zeros(model.n_state) if state is None else np.asarray(state, dtype=float)
    held = np.zeros(model.n_u) if drive is None else np.asarray(drive, dtype=float)
    x, u, p = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u), ca.DM(model.parameters.start)
    columns = {"u": u, "next": u, "t": held[-1] if len(held) else 0.0}  # the time comes last
    signals = ca.vertcat(ca.SX(0, 1), *(columns[name] for name in model.reads))
    moved, y = x, model.closed(ca.vertcat(x, start[n_x:]), signals, p)[1]
    for _ in range(model.substeps):
        moved = model.closed(ca.vertcat(moved, start[n_x:]), signals, p)[0][:n_x]
    jacobians = [ca.jacobian(f, s) for f in (moved, y) for s in (x, u)]
    found = ca.Function("parts", [x, u], jacobians)(start[:n_x], held[:n_u])
    a, b, c, d = (np.asarray(m, dtype=float) for m in found)
    return LinearPart(a, b, c, d, dt)
