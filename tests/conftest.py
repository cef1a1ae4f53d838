"""Settings of every test run: the same property-based examples each time, and no clock on a shared machine."""

from hypothesis import settings

settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")
