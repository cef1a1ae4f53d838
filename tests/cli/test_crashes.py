"""A command that calls an FMU outlives its crash, and passes signals on to the process that runs it."""

import os
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
SCRIPT = """
import os, sys, time
PARENT = os.getpid()
from pilfr_casadi.cli.crashes import run_beside_units

def command():
    {body}

sys.exit(run_beside_units(command, ["diagnose", sys.argv[1]]))
"""


@pytest.fixture
def unit(tmp_path):
    path = tmp_path / "plant.fmu"
    path.touch()
    return str(path)


def started(body, unit):
    lines = body.replace("\n", "\n    ")
    given = [sys.executable, "-c", SCRIPT.format(body=lines), unit]
    return subprocess.Popen(given, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_crash_starts_the_command_again_with_the_unit_isolated(unit):
    process = started("return 3 if os.environ.get('PILFR_ISOLATED') else os.abort()", unit)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 3
    assert errors.startswith("pilfr: The FMU crashed (SIGABRT). The command starts again"), errors


def test_the_status_of_a_command_that_ends_is_its_own(unit):
    process = started("print(os.getppid() == PARENT, flush=True); return 2", unit)
    printed, errors = process.communicate(timeout=60)
    assert (process.returncode, printed, errors) == (2, "True\n", "")


def test_ctrl_c_reaches_the_command(unit):
    body = "try:\n    print('begun', flush=True)\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    return 130"
    with started(body, unit) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
