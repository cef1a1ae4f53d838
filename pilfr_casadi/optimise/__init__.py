"""The simulation-error problem, its constraints, and the solvers.

`problem` states the problem and its derivatives, `constraints` what may be demanded of parameters, `gauss_newton` the
default solver (its damping is the class `Damping`, its first value `GaussNewton(damping=...)`), `ipopt` the other one,
`exact_limits` the solves at a bound on stability and the last step onto exact limits, and `solution` the result with
the limits that hold it.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .constraints import (
        Constraint as Constraint,
        Gain as Gain,
        check_gain as check_gain,
        check_room as check_room,
        dc_gain as dc_gain,
        loosened as loosened,
        ordered as ordered,
        stability_limits as stability_limits,
        stable as stable,
        unbounded_sentence as unbounded_sentence,
    )
    from .exact_limits import (
        STEP as STEP,
        beyond as beyond,
        exactly as exactly,
        held_at_bounds as held_at_bounds,
        within_bounds as within_bounds,
    )
    from .gauss_newton import (
        GaussNewton as GaussNewton,
        first_state as first_state,
        samples_for_state as samples_for_state,
        unconstrained as unconstrained,
    )
    from .ipopt import Ipopt as Ipopt
    from .problem import Problem as Problem, checked_weights as checked_weights
    from .solution import (
        Iteration as Iteration,
        Limit as Limit,
        Progress as Progress,
        Solution as Solution,
        Status as Status,
        limits_of as limits_of,
        unknown_multipliers as unknown_multipliers,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
