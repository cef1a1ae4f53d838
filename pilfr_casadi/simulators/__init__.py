"""The user's equations with ports for missing physics.

`equations` evaluates them with their laws, `integration` makes them a discrete-time `Model`, `simulator` holds the
class `Simulator` and the state in which its laws begin at rest, and `adapters` accept a Python file, a state space or a
fitted model in its place. `fmu` makes one of a functional mock-up unit, which its equations call (`external`,
`fmu_description`, `fmu_instance`). `numpy_function` makes one from a NumPy function, whose equations `tracing` finds by
calling it with the `symbols` of the file of that name; one that cannot be followed stays a `black_box`.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .adapters import (
        as_simulator as as_simulator,
        load_simulator as load_simulator,
        simulator_variable as simulator_variable,
        user_variable as user_variable,
    )
    from .black_box import Numeric as Numeric
    from .equations import Named as Named, Placed as Placed, Port as Port, in_series as in_series
    from .external import (
        PythonFunction as PythonFunction,
        leaves as leaves,
        units as units,
    )
    from .fmu import from_fmu as from_fmu
    from .fmu_description import fmu_signals as fmu_signals
    from .fmu_instance import FmuInstance as FmuInstance
    from .integration import (
        LARGEST_STEP as LARGEST_STEP,
        MOST_SUBSTEPS as MOST_SUBSTEPS,
        ClosedEquations as ClosedEquations,
        Instant as Instant,
        choose_substeps as choose_substeps,
        discretise as discretise,
        fastest_rates as fastest_rates,
        growth_rate as growth_rate,
        needed_substeps as needed_substeps,
        on_grid as on_grid,
        rate_at_start as rate_at_start,
        signals as signals,
        states_along as states_along,
    )
    from .numpy_function import from_function as from_function
    from .simulator import (
        Simulator as Simulator,
        compute_equilibrium as compute_equilibrium,
        resting_elements as resting_elements,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
