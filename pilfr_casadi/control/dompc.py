"""A fitted model in do-mpc (Fiedler et al. 2023, Control Engineering Practice 140), an optional extra.

do-mpc solves the problem of `PredictiveController` by multiple shooting and IPOPT, with the states as variables. Both
problems agree as long as all output limits can be kept. The model keeps its kinks, and IPOPT may stop at one.
"""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from .control_task import NO_LIMIT, as_step_function, check_task, penalty_weight

Array = np.ndarray


def _import_do_mpc() -> Any:
    """Import do-mpc; if it is missing, explain how to install it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # do-mpc warns about each missing optional part
            import do_mpc
    except ImportError:
        raise InputError(
            "do-mpc is not installed; install it with `pip install pilfr-casadi[do-mpc]`, or use PredictiveController."
        ) from None
    return do_mpc


def do_mpc_model(function: Any) -> Any:
    """Build a discrete `do_mpc.model.Model` of `F(x, u) -> (x_next, y)`: state x, input u, expression y, reference r.

    Parameters
    ----------
    function : casadi.Function, Fit, KalmanFilter or Exported
        A model as for `PredictiveController`.

    Returns
    -------
    do_mpc.model.Model
        Ready for use; r is a time-varying parameter with as many entries as y.

    Raises
    ------
    InputError
        If do-mpc is not installed, or `function` cannot be used.
    """
    function = as_step_function(function)
    model = _import_do_mpc().model.Model("discrete", "SX")
    x = model.set_variable("_x", "x", (function.size1_in(0), 1))
    u = model.set_variable("_u", "u", (function.size1_in(1), 1))
    model.set_variable("_tvp", "r", (function.size1_out(1), 1))
    x_next, y = function(x, u)
    model.set_rhs("x", x_next)
    model.set_expression("y", y)
    model.setup()
    return model


def do_mpc_controller(
    function: Any,
    horizon: int,
    reference: Array,
    *,
    inputs: tuple[Any, Any],
    outputs: tuple[Any, Any] | None = None,
    move: float = 1e-3,
    y_scale: Any = None,
    u_scale: Any = None,
) -> Any:
    """Build a `do_mpc.controller.MPC` that follows a reference, with the arguments of `PredictiveController`.

    Each limit or scale is one number, or one for each signal.

    Parameters
    ----------
    reference : array, shape (M, n_y)
        The whole path, one row per sample; after its end the last row is kept.

    Returns
    -------
    do_mpc.controller.MPC
        Ready for use: set `x0` and `u0`, call `set_initial_guess()`, then `make_step(x)` at each sample. The time of
        do-mpc is the sample number.

    Raises
    ------
    InputError
        If do-mpc is not installed, or an argument cannot be used.
    """
    task = check_task(function, horizon, inputs, outputs, None, move, y_scale, u_scale)
    function, n_y = task.function, task.function.size1_out(1)
    path = numbers(reference, "The reference")
    path = path[:, None] if path.ndim == 1 else path
    if path.ndim != 2 or not len(path) or path.shape[1] != n_y:
        raise InputError(f"The reference has the shape {path.shape}; give (samples, {n_y}), one row per sample.")
    low, high, u_size = (_drop_horizon(v, horizon) for v in (task.low, task.high, task.u_scale))
    low_y, high_y, y_size = (_drop_horizon(v, horizon) for v in (task.low_y, task.high_y, task.y_scale))
    do_mpc = _import_do_mpc()
    model = do_mpc_model(function)
    mpc = do_mpc.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0, "ipopt.tol": 1e-9}
    mpc.set_param(n_horizon=horizon, t_step=1.0, store_full_solution=False, nlpsol_opts=quiet)
    error = (model.aux["y"] - model.tvp["r"]) / y_size
    mpc.set_objective(lterm=ca.sumsqr(error), mterm=ca.SX(0))
    mpc.set_rterm(u=task.move / u_size**2)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = low, high
    penalty = penalty_weight(np.maximum(low_y - path, path - high_y) / y_size)
    soft = {"ub": 0, "soft_constraint": True, "penalty_term_cons": penalty}
    for name, sign, limit in (("above", 1, high_y), ("below", -1, low_y)):
        limited = np.flatnonzero(np.abs(limit) < NO_LIMIT)
        if len(limited):
            mpc.set_nl_cons(name, sign * (model.aux["y"] - limit)[limited] / y_size[limited], **soft)
    template = mpc.get_tvp_template()

    def read_reference(sample: float) -> Any:
        for k in range(horizon + 1):
            template["_tvp", k, "r"] = path[min(round(np.asarray(sample).item()) + k, len(path) - 1)]
        return template

    mpc.set_tvp_fun(read_reference)
    mpc.setup()
    return mpc


def _drop_horizon(values: Array, samples: int) -> Array:
    """Return the value of each signal; refuse values that change over the horizon."""
    rows = values.reshape(samples, -1)
    if np.any(rows != rows[0]):
        raise InputError(
            "A limit or a scale changes over the horizon; for do-mpc give one value for each signal, or use "
            "PredictiveController."
        )
    return np.asarray(rows[0])
