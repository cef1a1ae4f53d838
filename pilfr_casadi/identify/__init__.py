"""`fit`: identify a model from recordings.

`fitting` holds `fit`, which checks its arguments and chooses the method. `linear_start` finds the linear model from
which a search begins, `start` computes start values, `multistart` chooses which of them are tried and polishes the
best, `context` solves with the options that all fits share, `penalty` adds the L1 penalty, and `lagged` trains NARX and
NOE models. `result` is the `Fit`, `uncertainty` its standard errors, `undetermined` says what the recordings do not
determine, and `sparse` makes fits with fewer operators. `surrogates` identifies a linear model in modes (`modal_form`)
from a table of simulated inputs and outputs. `comparison` simulates models of any kind beside one recording.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .comparison import (
        Comparison as Comparison,
        compare as compare,
        run_free as run_free,
        run_simulator as run_simulator,
        simulator_nrmse as simulator_nrmse,
    )
    from .context import (
        FitContext as FitContext,
        check_recordings as check_recordings,
        solve_within_bounds as solve_within_bounds,
    )
    from .fitting import fit as fit
    from .lagged import (
        one_step as one_step,
        solve_with_early_stopping as solve_with_early_stopping,
        split_validation as split_validation,
    )
    from .linear_start import (
        BLA_OPTION as BLA_OPTION,
        change_basis as change_basis,
        find_nearest_basis as find_nearest_basis,
        linear_model as linear_model,
    )
    from .multistart import (
        DEFAULT_SOLVER as DEFAULT_SOLVER,
        START_KINDS as START_KINDS,
        StartSearch as StartSearch,
        explore as explore,
        is_drawn as is_drawn,
        polish as polish,
        regrid as regrid,
        search_starts as search_starts,
        threshold_range as threshold_range,
    )
    from .penalty import hold_all_but_element as hold_all_but_element, normalise_weights as normalise_weights
    from .result import (
        DENSITY_PRIOR as DENSITY_PRIOR,
        Candidate as Candidate,
        Fit as Fit,
        FitOptions as FitOptions,
        load as load,
        save as save,
    )
    from .sparse import (
        SPREADINGS as SPREADINGS,
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
        unit_states as unit_states,
    )
    from .surrogates import (
        POOR_SURROGATE as POOR_SURROGATE,
        surrogate as surrogate,
        surrogate_warning as surrogate_warning,
    )
    from .uncertainty import (
        covariance as covariance,
        gauge_tangents as gauge_tangents,
        generators as generators,
        gradient_covariance as gradient_covariance,
        standard_errors as standard_errors,
        variance as variance,
    )
    from .undetermined import describe_reached_gain as describe_reached_gain
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
