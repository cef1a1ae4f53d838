"""`fit`: start values, multistart, the result, its uncertainty, and sparse fits."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .context import FitContext as FitContext, solve_within_bounds as solve_within_bounds
    from .fitting import fit as fit
    from .lagged import (
        one_step as one_step,
        solve_with_early_stopping as solve_with_early_stopping,
        split_validation as split_validation,
    )
    from .linear_start import (
        BLA as BLA,
        change_basis as change_basis,
        find_nearest_basis as find_nearest_basis,
        linear_model as linear_model,
    )
    from .multistart import (
        POLISH as POLISH,
        STARTS as STARTS,
        StartSearch as StartSearch,
        explore as explore,
        is_drawn as is_drawn,
        polish as polish,
        search_starts as search_starts,
    )
    from .penalty import hold_all_but_element as hold_all_but_element, normalise_weights as normalise_weights
    from .result import (
        PRIOR as PRIOR,
        Candidate as Candidate,
        Fit as Fit,
        describe_reached_gain as describe_reached_gain,
        load as load,
        match_channels as match_channels,
        save as save,
    )
    from .sparse import (
        WAYS as WAYS,
        RegularizationPath as RegularizationPath,
        operators_used as operators_used,
        prune as prune,
        regularization_path as regularization_path,
        thin_operators as thin_operators,
    )
    from .start import (
        deconvolve_inputs as deconvolve_inputs,
        envelope_start as envelope_start,
        fit_envelope as fit_envelope,
        grid_start as grid_start,
        loop_outline as loop_outline,
        network_start as network_start,
        paper_start as paper_start,
        regrid as regrid,
        threshold_range as threshold_range,
        unit_states as unit_states,
    )
    from .uncertainty import (
        _snap_to_bounds as _snap_to_bounds,
        covariance as covariance,
        gauge_tangents as gauge_tangents,
        gradient_covariance as gradient_covariance,
        standard_errors as standard_errors,
        variance as variance,
    )

else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
