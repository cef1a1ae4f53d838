"""Settings of every test run: the same property-based examples each time, no clock on a shared machine, and Ctrl-C.

In the background of a script Ctrl-C is ignored, by its children too; tests of it would wait for ever.
"""

import base64
import contextlib
import signal
import threading

import pytest
from hypothesis import HealthCheck, settings

# thirty examples: they are the same in every run, so that more of them would find something once only
settings.register_profile(
    "steady", max_examples=30, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("steady")
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg=="


@pytest.fixture(scope="session")
def without_drawing():
    """Make a context that writes every figure as one pixel: drawing takes most of a page's time."""

    def savefig(figure, file, **options):
        file.write(base64.b64decode(PIXEL))

    @contextlib.contextmanager
    def context():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("matplotlib.figure.Figure.savefig", savefig)
            yield

    return context


@pytest.fixture
def blank_figures(without_drawing):
    """Write every figure as one pixel, for tests that read only the words of a page."""
    with without_drawing():
        yield
