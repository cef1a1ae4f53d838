"""The simulation-error problem written out over the horizon, for costs, constraints and solvers of one's own.

The record is simulated from its initial state by `mapaccum` of the model's symbolic step (single shooting), so that

    f(θ) = 1/2 mean(e²) + 1/2 Σ ((θ_i - m_i) / s_i)² v/R + l1 Σ |w|,      e = (y_hat(θ) - y) / σ_y

(Krikelis et al. (2024), Eq. 20, with the penalties of `problem`), the residual e, the simulated outputs and the
constraints are CasADi expressions of θ. CasADi differentiates them as they stand: for long records this costs many
times the time and the memory of the recursion that `GaussNewton` and `Ipopt` run on, so this form is for what those two
cannot express.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

if TYPE_CHECKING:
    from .problem import Problem


@dataclass(frozen=True, eq=False)
class Horizon:
    """A problem as CasADi expressions of its variables θ, in the words of `casadi.nlpsol`.

    Attributes
    ----------
    x : casadi.MX
        Variables θ, shape (n,), laid out as `Problem.labels`.
    f : casadi.MX
        Cost, equal to `Problem.cost`.
    g : casadi.MX
        General constraints, shape (n_g,).
    x0, lbx, ubx : array, shape (n,)
        Start and bounds of θ.
    lbg, ubg : array, shape (n_g,)
        Bounds of g.
    residual : casadi.MX
        Normalised residuals of the scored samples, shape (R,).
    simulated : tuple of casadi.MX
        Simulated outputs of each recording, one column a sample, shape (n_y, M), in the recording's units.
    initial : tuple of casadi.MX
        State with the element's memory before each recording; where it is periodic, before the periods that the start
        model takes to settle, which are written out before it.
    parameters : mapping of str to casadi.MX
        The model's parameters by name, fixed ones as numbers.
    """

    x: ca.MX
    f: ca.MX
    g: ca.MX
    x0: np.ndarray
    lbx: np.ndarray
    ubx: np.ndarray
    lbg: np.ndarray
    ubg: np.ndarray
    residual: ca.MX
    simulated: tuple[ca.MX, ...]
    initial: tuple[ca.MX, ...]
    parameters: Mapping[str, ca.MX]


def to_nlp(problem: Problem) -> Horizon:
    """Write a problem out over the horizon; see `Horizon` and `Problem.to_nlp`."""
    model = problem.model
    theta = ca.MX.sym("theta", problem.size)
    n_free, n_state = int(problem.free.sum()), model.n_x + model.n_s
    p = ca.MX(ca.DM(problem.parameters(problem.start)))
    if n_free:
        p[np.flatnonzero(problem.free).tolist()] = theta[:n_free]
    simulated, residual, initial = [], [], []
    for part in problem._parts:
        state = ca.MX(ca.DM(part.state)) if part.first is None else theta[part.first : part.first + n_state]
        r = part.recording
        u = np.concatenate([part.warm_up, part.drive])
        _, y = model.closed.mapaccum("run", len(u))(state, u.T, ca.repmat(p, 1, len(u)))
        y = y[:, len(part.warm_up) :: model.substeps]
        initial.append(state)
        simulated.append(y)
        residual.append(ca.vec(((y - r.y.T) / np.tile(part.scale[:, None], (1, len(r))))[:, r.skip :]))
    e = ca.vertcat(*residual)
    prior = 0.5 * ca.dot(problem.penalties.weight, (theta - problem.penalties.mean) ** 2)
    return Horizon(
        x=theta,
        f=0.5 * ca.sumsqr(e) / problem.residuals + prior + ca.dot(problem.penalties.slope, theta),
        g=problem.rows.function(p),
        x0=problem.start,
        lbx=problem.lower,
        ubx=problem.upper,
        lbg=problem.g_lower,
        ubg=problem.g_upper,
        residual=e,
        simulated=tuple(simulated),
        initial=tuple(initial),
        parameters=model.parameters.symbols(p),
    )
