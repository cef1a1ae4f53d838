"""The user's equations with ports for missing physics.

`ports` are the places where laws may stand. `equations` evaluates the equations and their ports, and `integration`
closes them with laws and discretises them to a `Model` with enough `substeps`. `simulator` holds the class `Simulator`.
`domains` infers a port's physical domain, and `user_arguments` checks what a user gives. `adapters` convert a Python
file (`user_file`), a state space or a fitted model to a simulator. `fmu` wraps a functional mock-up unit as a simulator
(`fmu_description`, `fmu_instance`, `fmu_process`, `fmu_function`, for co-simulation `fmu_cosimulation`), and `mujoco`
writes the equations of a MuJoCo model (`mujoco_model`). `numpy_function` makes a simulator from a NumPy function, whose
arguments `signature` reads: `tracing` calls the function with `symbols` to obtain its equations. A function that cannot
be traced is called with numbers (`black_box`). `external` lets equations call such a program, and `external_buffers`
lets compiled C do so.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .adapters import (
        as_simulator as as_simulator,
        load_simulator as load_simulator,
        simulator_variable as simulator_variable,
    )
    from .black_box import Numeric as Numeric
    from .domains import (
        MECHANICAL as MECHANICAL,
        UNKNOWN as UNKNOWN,
        infer_domain as infer_domain,
        may_be_flow as may_be_flow,
    )
    from .equations import (
        Named as Named,
        evaluate_at_random_points as evaluate_at_random_points,
        stack as stack,
    )
    from .external import (
        PythonFunction as PythonFunction,
        calls_external as calls_external,
        units as units,
    )
    from .external_buffers import EXTERNAL_CALLS as EXTERNAL_CALLS, bind as bind
    from .fmu import from_fmu as from_fmu
    from .fmu_cosimulation import CoSimulation as CoSimulation
    from .fmu_description import (
        binary_path as binary_path,
        fmu_signals as fmu_signals,
        needs_step_size as needs_step_size,
        parse_port as parse_port,
    )
    from .fmu_function import map_points as map_points
    from .fmu_instance import FmuSignals as FmuSignals
    from .fmu_process import run_in_unit as run_in_unit
    from .integration import (
        ClosedEquations as ClosedEquations,
        Instant as Instant,
        discretise as discretise,
        on_grid as on_grid,
        signals as signals,
        term_function as term_function,
    )
    from .mujoco import from_mujoco as from_mujoco
    from .numpy_function import from_function as from_function
    from .ports import (
        ACTUATOR as ACTUATOR,
        EQUATION as EQUATION,
        PARAMETER as PARAMETER,
        SENSOR as SENSOR,
        Placed as Placed,
        Port as Port,
        in_series as in_series,
        kind_of as kind_of,
        name_at as name_at,
        name_at_any as name_at_any,
        port_name as port_name,
        split_port as split_port,
    )
    from .simulator import (
        Simulator as Simulator,
        unit_notes as unit_notes,
    )
    from .substeps import (
        LARGEST_STEP as LARGEST_STEP,
        MOST_SUBSTEPS as MOST_SUBSTEPS,
        check_hold as check_hold,
        choose_substeps as choose_substeps,
        discretise_for as discretise_for,
        fastest_rates as fastest_rates,
        growth_rate as growth_rate,
        least_substeps as least_substeps,
        needed_substeps as needed_substeps,
        one_hold as one_hold,
        rate_at_start as rate_at_start,
        stated_hold as stated_hold,
        states_along as states_along,
    )
    from .user_file import user_variable as user_variable
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
