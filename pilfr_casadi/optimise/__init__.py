"""The simulation-error problem, its constraints, and the solvers.

`problem` states the problem and computes its derivatives, `penalties` adds priors and L1 terms, `constraints` holds
constraints on named parameters. `gauss_newton` is the default solver (its damping is the class `Damping`, the first
value `GaussNewton(damping=...)`) and solves a `quadratic_program` for each step; `ipopt` is the other solver.
`initial_state` estimates the state in which a further recording begins; in a fit such states are variables of the
problem. `steady_state` finds the state of a periodic recording. `exact_limits` solves at exact bounds on spectral radii
and moves results into the feasible set. `solution` holds the result of a solver, its status and its active limits.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .constraints import (
        Constraint as Constraint,
        Gain as Gain,
        check_gain as check_gain,
        check_radius_bounds as check_radius_bounds,
        dc_gain as dc_gain,
        describe_unbounded as describe_unbounded,
        loosen_radii as loosen_radii,
        ordered as ordered,
        stability_limits as stability_limits,
        stable as stable,
    )
    from .exact_limits import (
        BOUND_STEP_SOLVER as BOUND_STEP_SOLVER,
        at_active_radius as at_active_radius,
        move_inside_exact as move_inside_exact,
        solve_within_radii as solve_within_radii,
        violated_exact as violated_exact,
    )
    from .gauss_newton import GaussNewton as GaussNewton
    from .initial_state import (
        StatePrior as StatePrior,
        estimate_initial_state as estimate_initial_state,
        samples_for_state as samples_for_state,
        samples_to_start as samples_to_start,
    )
    from .ipopt import Ipopt as Ipopt
    from .penalties import check_penalised as check_penalised
    from .problem import Problem as Problem, check_weights as check_weights
    from .quadratic_program import unconstrained_step as unconstrained_step
    from .solution import (
        Candidate as Candidate,
        Iteration as Iteration,
        IterationCallback as IterationCallback,
        Limit as Limit,
        Solution as Solution,
        Status as Status,
        describe_unknown_multipliers as describe_unknown_multipliers,
        limits_of as limits_of,
    )
    from .steady_state import undetermined_memory as undetermined_memory
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
