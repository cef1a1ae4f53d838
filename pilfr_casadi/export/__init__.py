"""Models that leave the package: step functions, C code, `control` systems, and model files.

`step` holds the step function `Exported` of any model, which `build_step` makes; `c_code` and `fmu` write it as C code
and as a functional mock-up unit. `smoothing` replaces kinks for solvers. `model_file` writes and reads model files by
the layout of `model_schema`.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .build_step import FittedModel as FittedModel, exported as exported, to_casadi as to_casadi
    from .model_file import (
        FitContent as FitContent,
        model_text as model_text,
        read_model_file as read_model_file,
        write_model_file as write_model_file,
    )
    from .smoothing import enclose as enclose, smooth_kinks as smooth_kinks
    from .step import NAMES as NAMES, Exported as Exported
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
