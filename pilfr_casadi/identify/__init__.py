"""`fit`: start values, multistart, the result, its uncertainty, and sparse fits."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .fitting import fit as fit
    from .lagged import one_step as one_step
    from .linear_start import BLA as BLA
    from .model_files import load as load, save as save
    from .multistart import POLISH as POLISH, STARTS as STARTS, drawn as drawn
    from .result import Candidate as Candidate, Fit as Fit
    from .sparse import (
        RegularizationPath as RegularizationPath,
        operators_used as operators_used,
        prune as prune,
        regularization_path as regularization_path,
    )
    from .uncertainty import covariance as covariance, standard_errors as standard_errors, variance as variance

__getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
