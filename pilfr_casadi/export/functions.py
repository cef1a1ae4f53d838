"""A fitted model as a CasADi function, for controllers and simulations elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from ..recording import InputError

if TYPE_CHECKING:
    from ..fit import Fit


def to_casadi(fit: Fit, name: str = "model") -> ca.Function:
    """One step of the fitted model as `casadi.Function (x, u) -> (x_next, y)`, in engineering units.

    Parameters
    ----------
    fit : Fit
        The model; its fitted values become constants of the function.
    name : str
        Name of the function: letters, digits and single underscores, beginning with a letter.

    Returns
    -------
    casadi.Function
        `x` (n_x + n_s,) holds the linear states in the order of `fit.model.states`, then the operators' memory: channel
        by channel, and inside a channel in the order of the thresholds `r[i, :]` (the play state, for stops too). `u`
        is (n_u,), `x_next` like `x`, `y` (n_y,). A step takes `fit.dt` s; `fit.initial_state(recording)` is an `x`.

    Raises
    ------
    InputError
        If CasADi does not take the name.
    """
    if not ca.Function.check_name(name):
        raise InputError(f"The function name {name!r} cannot be used; give letters, digits and single underscores.")
    model = fit.model
    x, u = ca.SX.sym("x", model.n_x + model.n_s), ca.SX.sym("u", model.n_u)
    x_next, y = model.closed(x, u, ca.DM(model.parameters.start))
    return ca.Function(name, [x, u], [x_next, y], ["x", "u"], ["x_next", "y"])
