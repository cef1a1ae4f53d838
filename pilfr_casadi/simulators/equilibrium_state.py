"""Equilibrium state of laws at the begin of a recording: as if their signals had stood still before.

From zero, a delay or a lag of a signal about a working point would first have to come there: a transient that no
recording shows, and that bends a fit of the law's parameters before the initial state has followed.
"""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np

from .._base import one_at_a_time
from ..models import ParameterSet, map_points
from .integration import ClosedEquations, Instant, on_grid
from .simulator import Simulator


def resting_elements(simulator: Simulator) -> list[int]:
    """Return the indices of elements whose states or memory come to rest where their signal does."""
    laws = [e.law for e in simulator.elements]
    return [i for i, law in enumerate(laws) if getattr(law, "follows", 0) or getattr(law, "shifts", False)]


@one_at_a_time
def compute_equilibrium(simulator: Simulator, h: float, vector: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Compute the state with laws' own states and memory at rest, (n_state,), on steps of h seconds.

    Parameters
    ----------
    vector : array
        Parameters; those that the simulator does not know stand behind its own.
    x : array
        The simulator's own states.
    u : array
        Inputs.
    """
    simulator = on_grid(simulator, h)
    p = ca.SX.sym("p", ParameterSet(dict(simulator.parameters)).size)
    equations, n_x, moved = ClosedEquations(simulator, p), len(simulator.states), resting_elements(simulator)
    n_q, n_s = equations.n_q, equations.n_s
    n_xq = n_x + sum(n_q)
    state = np.append(x[:n_x], np.zeros(sum(n_q) + sum(n_s)))
    own_q, own_s = pairwise(np.cumsum([n_x, *n_q])), pairwise(np.cumsum([n_xq, *n_s]))
    spans = [slice(*(q if q[0] < q[1] else s)) for q, s in zip(own_q, own_s, strict=True)]
    at, now = ca.SX.sym("x", len(state)), ca.SX.sym("u", len(u))
    local = equations.evaluate(Instant(at[:n_xq], at[n_xq:], now, ca.SX.zeros(len(u)), 0.0))[3]
    z = ca.Function("z", [at, now, p], [ca.vertcat(*(local[i][0] for i in moved))])
    for _ in moved:  # one law's signal may be what another gives out
        for i, value in zip(moved, map_points(z, state[None], u, vector[: p.numel()])[0].ravel(), strict=True):
            state[spans[i]] = simulator.elements[i].law.standing(float(value))
    return state
