"""The command line `pilfr`, a thin skin over the Python API.

`app` runs a command and turns failures into exit statuses. The commands are in `diagnose` (and check), `models` (fit,
simulate, export), `studies` (run, campaign, fleet) and `demo`; `_common` holds the options that they share.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .app import main as main, name_options as name_options
    from .models import describe_test_error as describe_test_error
    from .studies import EVERY_KEY as EVERY_KEY
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
