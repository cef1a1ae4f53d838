"""Force of a law along given local signals, for every shape at once: what the screen looks at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ..parameters import ParameterSet
from .base import Law, Local

BLOCK = 100  # samples unrolled


class _Values:
    """Parameters by name, `p.k` or `p["k"]`."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.__dict__.update(values)

    def __getitem__(self, name: str) -> Any:
        return self.__dict__[name]


def columns(law: Law) -> int:
    """Columns a shape has: one a strength, or one for a law without."""
    p = law.parameters()
    return max(1, sum(p[name].size for name in law.strength))


def trace(law: Law, local: Local, shapes: Sequence[dict[str, Any]]) -> np.ndarray:
    """Force at unit strength for each shape, shape (M, len(shapes), columns).

    Laws with states or memory start each recording from rest.
    """
    if not shapes:
        return np.zeros((len(local.z), 0, columns(law)))
    law = law.on_grid(local.dt)
    z, dz, t = ca.SX.sym("z"), ca.SX.sym("dz"), ca.SX.sym("t")
    following, dz_next = ca.SX.sym("z_next"), ca.SX.sym("dz_next")
    n_q, n_s = law.order, int(getattr(law, "memory", 0)) if hasattr(law, "step") else 0
    memory = ca.SX.sym("memory", (n_q + n_s) * len(shapes))
    forces, after = [], []
    for i, shape in enumerate(shapes):
        own = memory[i * (n_q + n_s) : (i + 1) * (n_q + n_s)]
        for values in _units(law, shape):
            p = _Values(values)
            if n_s:
                w, end = law.step(z, own, p)  # type: ignore[attr-defined]
            else:
                w = _call(law.force, z=z, dz=dz, q=own, t=t, p=p)
                end = _advance(law, own, (z, following), (dz, dz_next), t, p, local.dt) if n_q else own
            forces.append(w)
        after.append(end)
    outputs = [ca.vertcat(*after), ca.vertcat(*forces)]
    step = ca.Function("trace", [memory, ca.vertcat(z, dz, t, following, dz_next)], outputs)
    found, at = [], 0
    for m in local.lengths:
        zs, dzs = local.z[at : at + m], local.dz[at : at + m]
        rows = np.vstack([zs, dzs, local.dt * np.arange(m), np.append(zs[1:], zs[-1]), np.append(dzs[1:], dzs[-1])])
        at += m
        if n_q + n_s:
            found.append(_accumulate(step, rows))
        else:
            found.append(np.asarray(step(np.zeros((0, m)), rows)[1]).T)
    return np.vstack(found).reshape(len(local.z), len(shapes), -1)


def _accumulate(step: ca.Function, rows: np.ndarray) -> np.ndarray:
    """Outputs of a step from rest, shape (M, n); some samples unrolled at a time, which costs little to set up."""
    state, found, m, at = np.zeros(step.size1_in(0)), [], rows.shape[1], 0
    for length in (BLOCK, 1):
        run = step.mapaccum("run", length) if at + length <= m else step
        while at + length <= m:
            states, out = run(state, rows[:, at : at + length])
            state = states[:, -1]
            found.append(np.asarray(out))
            at += length
    return np.hstack(found).T


def _units(law: Law, shape: dict[str, Any]) -> list[dict[str, Any]]:
    """Parameter values with one strength at one and the others at zero, in turn."""
    p = ParameterSet(law.at(shape).parameters())
    base = {name: ca.DM(v.value) for name, v in p.items()}
    if not law.strength:
        return [base]
    zero = {name: ca.DM(np.zeros(p[name].value.shape)) for name in law.strength}
    out = []
    for name in law.strength:
        for j in range(p[name].size):
            one = np.zeros(p[name].size)
            one[j] = 1.0
            out.append({**base, **zero, name: ca.DM(one)})
    return out


def _call(function: Any, **available: Any) -> Any:
    import inspect

    return function(**{k: available[k] for k in inspect.signature(function).parameters})


def _advance(law: Law, q: Any, z: tuple[Any, Any], dz: tuple[Any, Any], t: Any, p: Any, h: float) -> Any:
    """One Runge-Kutta step of a law's own states along the chord of z."""

    def flow(state: Any, share: float) -> Any:
        at = {k: a + share * (b - a) for k, (a, b) in {"z": z, "dz": dz}.items()}
        return _call(law.flow, **at, q=state, t=t + share * h, p=p)  # type: ignore[attr-defined]

    k1 = flow(q, 0.0)
    k2 = flow(q + h / 2 * k1, 0.5)
    k3 = flow(q + h / 2 * k2, 0.5)
    k4 = flow(q + h * k3, 1.0)
    return q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
