"""`fit`: start values, multistart, the result, its uncertainty, and sparse fits."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .fitting import fit as fit
    from .gauge import covariance as covariance, standard_errors as standard_errors, variance as variance
    from .gauge_cost import costless as costless
    from .lagged_fit import one_step as one_step
    from .linear_model import BLA as BLA
    from .multistart import POLISH as POLISH, STARTS as STARTS, drawn as drawn
    from .options import Asked as Asked, asked_by as asked_by
    from .result import Fit as Fit, first_state as first_state, samples_for_state as samples_for_state
    from .search import Candidate as Candidate
    from .sparse import (
        RegularizationPath as RegularizationPath,
        operators_used as operators_used,
        prune as prune,
        regularization_path as regularization_path,
    )
    from .start import density as density
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
