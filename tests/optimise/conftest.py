"""The recording that tests of constraints share."""

import pytest

from problems.constrained import three_plays


@pytest.fixture(scope="session")
def record():
    """1200 samples of an element of three plays before a lag."""
    return three_plays(0, 1200)
