"""The command line `pilfr`, a thin skin over the Python API."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .app import main as main, name_options as name_options
    from .models import describe_test_error as describe_test_error
    from .studies import EVERY_KEY as EVERY_KEY
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
