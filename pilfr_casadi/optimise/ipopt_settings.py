"""What IPOPT is told by default, its words for how it ended, and the options of a user, which IPOPT itself judges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from .._base import InputError
from .solution import Status

SETTINGS = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-9,
    "nlp_scaling_method": "none",
    "bound_relax_factor": 0.0,
    "mu_strategy": "adaptive",
    "adaptive_mu_globalization": "never-monotone-mode",
    "mu_max": 1e-3,
    "mu_init": 1e-3,
    "watchdog_shortened_iter_trigger": 0,
    "bound_push": 1e-4,
    "bound_frac": 1e-4,
    "slack_bound_push": 1e-4,
    "slack_bound_frac": 1e-4,
}
ENDINGS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.CONVERGED,
    "Maximum_Iterations_Exceeded": Status.MAX_ITERATIONS,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}


def check_settings(options: Any) -> None:
    """Let IPOPT itself judge its options, on a problem of one variable.

    Raises
    ------
    InputError
        If it does not take one.
    """
    if not isinstance(options, Mapping):
        raise InputError(f'IPOPT\'s options were given as {options!r}; give them by name, like {{"print_level": 5}}.')
    x = ca.MX.sym("x")
    for name, value in options.items():
        try:
            ca.nlpsol("check", "ipopt", {"x": x, "f": x**2}, {"ipopt": {name: value, "sb": "yes"}, "print_time": False})
        except (RuntimeError, TypeError, NotImplementedError):
            raise InputError(
                f"IPOPT does not take the option {name!r} with the value {value!r}; see its own list of options."
            ) from None
