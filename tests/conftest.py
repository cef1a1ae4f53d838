"""Settings of every test run: the same property-based examples each time, no clock on a shared machine, and Ctrl-C.

In the background of a script Ctrl-C is ignored, by its children too; tests of it would wait for ever.
"""

import base64
import signal
import threading

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("steady")
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg=="


@pytest.fixture
def blank_figures(monkeypatch):
    """Write every figure as one pixel, for tests that read only the words of a page: drawing takes most of its time."""

    def savefig(figure, file, **options):
        file.write(base64.b64decode(PIXEL))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
