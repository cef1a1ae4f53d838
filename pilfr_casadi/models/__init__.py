"""Models: parameters, hysteresis operators, elements, `Model` with `close_loop`, PI-LFR structures and baselines.

A model holds the equations of one time step, with ports for elements. An element maps a local signal `z` to an internal
signal `w` and may have memory. `close_loop` puts an element into a port.

`model` holds `Model`, `parameters` the parameters of all models, `operators` the hysteresis operators and `elements`
the elements made of them. `pilfr` holds the PI-LFR, `structures` the models to compare it with (add one there), and
`conversion` rewrites a PI-LFR with plays as one with stops.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .conversion import to_plays as to_plays, to_stops as to_stops
    from .elements import (
        CREST as CREST,
        LAYER as LAYER,
        Combined as Combined,
        Element as Element,
        Envelope as Envelope,
        Part as Part,
        PrandtlIshlinskii as PrandtlIshlinskii,
        Products as Products,
        StaticNetwork as StaticNetwork,
        element_bound as element_bound,
        element_slopes as element_slopes,
        unknown_slope as unknown_slope,
        weight_density as weight_density,
    )
    from .model import (
        Buffered as Buffered,
        Model as Model,
        accumulate_steps as accumulate_steps,
        close_loop as close_loop,
        inject_outputs as inject_outputs,
        map_points as map_points,
        model_functions as model_functions,
        open_model as open_model,
    )
    from .operators import (
        GeneralizedPlay as GeneralizedPlay,
        Play as Play,
        Stop as Stop,
        fmin as fmin,
        generalized_play as generalized_play,
        play as play,
        stop as stop,
    )
    from .parameters import (
        Named as Named,
        Neighbours as Neighbours,
        Parameter as Parameter,
        ParameterSet as ParameterSet,
        check_size as check_size,
        is_at_bound as is_at_bound,
        or_one as or_one,
        parameter_within as parameter_within,
        within_a_factor as within_a_factor,
    )
    from .pilfr import (
        BLOCKS as BLOCKS,
        PILFR as PILFR,
        block_shapes as block_shapes,
        direction_fixed as direction_fixed,
        fixed_blocks as fixed_blocks,
        hammerstein as hammerstein,
        is_hammerstein as is_hammerstein,
        is_wiener as is_wiener,
        is_zero as is_zero,
        places as places,
        wiener as wiener,
        with_port_gain as with_port_gain,
    )
    from .structures import (
        ALL_OPTIONS as ALL_OPTIONS,
        HYSTERETIC_OPTIONS as HYSTERETIC_OPTIONS,
        LAGGED as LAGGED,
        NARX as NARX,
        NOE as NOE,
        OPERATORS as OPERATORS,
        STRUCTURE_OPTIONS as STRUCTURE_OPTIONS,
        STRUCTURES as STRUCTURES,
        Lagged as Lagged,
        lagged_start as lagged_start,
        named_structure as named_structure,
        network_lfr as network_lfr,
        neurons_over as neurons_over,
        read_measured_output as read_measured_output,
        ssnn as ssnn,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
