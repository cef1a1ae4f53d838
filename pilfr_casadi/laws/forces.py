"""Forces of a law along given local signals at unit strength, for many shapes at once: the columns of the screen."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, one_at_a_time
from ..models import Named, accumulate_steps, map_points
from .base import Law, Local
from .scheduling import PROFILES


def count_columns(law: Law) -> int:
    """Count the columns of one shape: one for each strength, or one for a law without strengths."""
    p = law.parameters()
    return max(1, sum(p[name].size for name in law.strength))


def unit_forces(law: Law, local: Local, shapes: Sequence[dict[str, Any]]) -> np.ndarray:
    """Compute the force at unit strength for each shape, shape (M, len(shapes), columns).

    Laws with states or memory start each recording at rest, at zero or at the first z; see `Local.from_zero`.
    """
    if not shapes:
        return np.zeros((len(local.z), 0, count_columns(law)))
    kind: Any = type(law)
    if hasattr(kind, "forces_along"):  # not a force of the present signals alone
        return np.asarray(kind().forces_along(local, shapes))
    if law.scaled_by or law.scheduled_by:
        bare = unit_forces(kind.__base__(), local, [{k: s[k] for k in kind.__base__.units if k in s} for s in shapes])
        if law.scaled_by:
            return np.asarray(bare * local.inputs[law.scaled_by][:, None, None])
        signal = law.schedule(local)
        weights = np.array([PROFILES[kind.profile].weights(signal, shape) for shape in shapes])
        return np.concatenate([bare * of_value.T[:, :, None] for of_value in np.swapaxes(weights, 0, 1)], axis=2)
    step = _build_lanes(kind, len(shapes), local.dt if law.shifts else 0.0)
    p = law.at(shapes[0]).parameters()
    names = [name for name in p if name not in law.strength]
    table = [np.ravel(shape.get(n, p[n].value)) for shape in shapes for n in names]
    vector = np.concatenate([*table, [local.dt]])
    found, begin, clock = [], 0, local.inputs.get("t")
    for i, m in enumerate(local.lengths):
        zs, dzs = local.z[begin : begin + m], local.dz[begin : begin + m]
        following = (np.append(values[1:], values[-1]) for values in (zs, dzs))
        time = local.dt * np.arange(m) if clock is None else clock[begin : begin + m]
        rows = np.column_stack([zs, dzs, time, *following])
        begin += m
        if step.size1_in(0):
            same = np.broadcast_to(vector, (m, len(vector)))
            first = kind().standing(0.0 if any(local.from_zero[i : i + 1]) else zs[0])
            found.append(accumulate_steps(step, np.tile(first, len(shapes)), rows, same)[1])
        else:
            found.append(map_points(step, np.zeros((m, 0)), rows, vector)[1][:, :, 0])
    forces = np.concatenate(found) if len(found) > 1 else found[0]
    return forces.reshape(len(local.z), len(shapes), -1)


@one_at_a_time
@functools.lru_cache(maxsize=256)
def _build_lanes(kind: Any, lanes: int, h: float) -> ca.Function:
    """Build `(memory, [z, dz, t, z_next, dz_next], [shapes of all lanes, dt]) -> (next memory, forces)`."""
    lane = _build_lane(kind, h)
    n, sizes = lane.size1_in(0), lane.size1_in(2)
    memory, signals = ca.SX.sym("memory", n * lanes), ca.SX.sym("signals", 5)
    vector = ca.SX.sym("shapes", sizes * lanes + 1)
    spans = [(slice(i * n, (i + 1) * n), slice(i * sizes, (i + 1) * sizes)) for i in range(lanes)]
    found = [lane(memory[own], signals, vector[shape], vector[-1]) for own, shape in spans]
    after, forces = zip(*found, strict=True)
    return ca.Function("trace", [memory, signals, vector], [ca.vertcat(*after), ca.vertcat(*forces)])


@one_at_a_time
@functools.lru_cache(maxsize=256)
def _build_lane(kind: Any, h: float) -> ca.Function:
    """Build `(memory, [z, dz, t, z_next, dz_next], shape, dt) -> (next memory, forces)` for one shape."""
    law = kind()
    law = law.on_grid(h) if law.shifts else law
    p = law.parameters()
    names = [name for name in p if name not in law.strength]
    sizes = [p[n].size for n in names]
    vector, signals, dt = ca.SX.sym("shape", sum(sizes)), ca.SX.sym("signals", 5), ca.SX.sym("dt")
    z, dz, t, following, dz_next = ca.vertsplit(signals)
    n_q, n_s = law.order, int(getattr(law, "memory", 0)) if hasattr(law, "step") else 0
    own = ca.SX.sym("memory", n_q + n_s)
    edges = np.cumsum([0, *sizes])
    shape = {n: vector[int(a) : int(b)] for n, a, b in zip(names, edges[:-1], edges[1:], strict=True)}
    forces = []
    for strength in _unit_strengths(law):
        values = Named("parameter", {**shape, **strength})
        if n_s:
            rate = {"dz": dz} if "dz" in law.reads() else {}
            w, end = law.step(z, own, values, **rate)
        else:
            w = _call(law, "force", z=z, dz=dz, q=own, t=t, p=values)
            end = _advance(law, own, (z, following), (dz, dz_next), t, values, dt) if n_q else own
        forces.append(w)
    return ca.Function("lane", [own, signals, vector, dt], [ca.densify(end), ca.densify(ca.vertcat(*forces))])


def _unit_strengths(law: Law) -> list[dict[str, Any]]:
    """List the strengths with one entry at one and the others at zero, in turn."""
    sizes = {name: law.parameters()[name].size for name in law.strength}
    zero = {name: ca.DM(np.zeros(size)) for name, size in sizes.items()}
    return [{**zero, name: ca.DM(one)} for name, size in sizes.items() for one in np.eye(size)] or [{}]


@functools.cache
def _names(function: Any) -> tuple[str, ...]:
    return tuple(inspect.signature(function).parameters)


def _call(law: Law, name: str, **available: Any) -> Any:
    """Call a function of a law, which may be a user's, with the signals that its arguments name."""
    what = f"`{name}` of the law {law.id!r}"
    if getattr(type(law), name, None) in (None, getattr(Law, name, None)):
        raise InputError(f"The law {law.id!r} has no `{name}`; write one, as in {name}(self, z, p).")
    function = getattr(law, name)
    for wanted in _names(function):
        if wanted not in available:
            raise InputError(f"The {what} asks for {wanted!r}; in a diagnosis it can have {', '.join(available)}.")
    try:
        return function(**{k: available[k] for k in _names(function)})
    except RuntimeError as error:
        if "truth value" not in str(error):
            raise
        raise InputError(
            f"The {what} decides by the value of a symbol (if, and, or, min, max), which has none yet; use "
            "casadi.if_else, casadi.fmin and casadi.fmax."
        ) from error


def _advance(law: Law, q: Any, z: tuple[Any, Any], dz: tuple[Any, Any], t: Any, p: Any, h: Any) -> Any:
    """Advance a law's own states by a Runge-Kutta step along the chord of z."""

    def flow(state: Any, share: float) -> Any:
        at = {k: a + share * (b - a) for k, (a, b) in {"z": z, "dz": dz}.items()}
        return _call(law, "flow", **at, q=state, t=t + share * h, p=p)

    k1 = flow(q, 0.0)
    k2 = flow(q + h / 2 * k1, 0.5)
    k3 = flow(q + h / 2 * k2, 0.5)
    k4 = flow(q + h * k3, 1.0)
    return q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
