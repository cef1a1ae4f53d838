"""Models that leave the package: step functions, C code, `control` systems, and model files."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .digests import digest as digest, ordered_digest as ordered_digest
    from .exported_model import NAMES as NAMES, Exported as Exported
    from .files import made as made, write_atomically as write_atomically
    from .functions import FittedModel as FittedModel, exported as exported, to_casadi as to_casadi
    from .loading import read_model_file as read_model_file
    from .saving import (
        FitContent as FitContent,
        SavedStart as SavedStart,
        model_text as model_text,
        write_model_file as write_model_file,
    )
    from .sides import with_sides as with_sides
    from .smoothing import smoothed as smoothed
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
