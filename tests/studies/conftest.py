"""The folder of a campaign."""

import pytest
from run_files import prepared


@pytest.fixture
def folder(tmp_path, blank_figures):
    """A prepared folder, for tests that read only the numbers of a campaign."""
    return prepared(tmp_path)
