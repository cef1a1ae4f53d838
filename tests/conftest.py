"""Settings of every test run: the same property-based examples each time, no clock on a shared machine, and Ctrl-C.

In the background of a script Ctrl-C is ignored, by its children too; tests of it would wait for ever.
"""

import signal
import threading

from hypothesis import HealthCheck, settings

settings.register_profile("steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("steady")
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
