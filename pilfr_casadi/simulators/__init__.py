"""The user's equations with their ports: `Simulator`, integration over a sample, and what is accepted in its place."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .adapters import as_simulator as as_simulator
    from .expressions import Named as Named, numbers_or_nan as numbers_or_nan
    from .integration import (
        Equations as Equations,
        Instant as Instant,
        discretise as discretise,
        on_grid as on_grid,
        signals as signals,
        states_along as states_along,
    )
    from .observer import (
        INJECTION as INJECTION,
        measurement_update as measurement_update,
        steady_state_gain as steady_state_gain,
        with_output_injection as with_output_injection,
    )
    from .simulator import Placed as Placed, Port as Port, Simulator as Simulator, in_series as in_series
    from .simulator_files import (
        load_simulator as load_simulator,
        simulator_variable as simulator_variable,
        user_variable as user_variable,
    )
    from .substeps import (
        MOST as MOST,
        REACH as REACH,
        at_begin as at_begin,
        choose_substeps as choose_substeps,
        fastest as fastest,
        growth as growth,
        wanted_substeps as wanted_substeps,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
