"""What tests of several commands share."""

import shutil
from pathlib import Path

import pytest

import pilfr_casadi

DEMO = Path(pilfr_casadi.__file__).parent / "cli" / "demo_data"


@pytest.fixture
def files(tmp_path):
    """A folder with copies of the demonstration's rig and its training recording."""
    for name in ("rig.py", "rig_train.csv"):
        shutil.copy(DEMO / name, tmp_path)
    return tmp_path
