"""Linear models: best linear approximation, subspace methods in time and frequency, order selection, Kalman gains.

`bla` estimates the best linear approximation, `subspace` identifies state spaces, `statespace` transforms and analyses
them, and `parts` linearises a closed model for small and for large motions.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .bla import (
        BLA as BLA,
        any_bla as any_bla,
        output_spectra as output_spectra,
        plain_bla as plain_bla,
        robust_bla as robust_bla,
    )
    from .parts import LinearPart as LinearPart, linear_parts as linear_parts
    from .statespace import (
        INJECTION as INJECTION,
        change_basis as change_basis,
        in_modal_coordinates as in_modal_coordinates,
        is_modal as is_modal,
        measurement_update as measurement_update,
        modal as modal,
        propagate as propagate,
        resolvent as resolvent,
        scale_states as scale_states,
        spectral_radius as spectral_radius,
        states_from_rest as states_from_rest,
        steady_state_gain as steady_state_gain,
        with_output_injection as with_output_injection,
    )
    from .subspace import (
        FrequencyProblem as FrequencyProblem,
        frequency_subspace as frequency_subspace,
        select_order as select_order,
        subspace_matrices as subspace_matrices,
        time_subspace as time_subspace,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
