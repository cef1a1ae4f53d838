"""Real recordings, where they are at hand."""

import pytest

from pilfr_casadi.cli import main
from problems.measured_data import measured
from problems.piezo_stack import run

PIEZO = measured("piezo_dbo")
needs_piezo = pytest.mark.skipif(PIEZO is None, reason="the piezo recordings are not beside the repository")


@pytest.mark.slow
@needs_piezo
def test_piezo_stack_reaches_its_figures():
    errors = {(name, where): error for name, where, error, _ in run(PIEZO)}
    assert errors["20 plays, nx = 0", "sine -> varying"] <= 2.2
    assert errors["20 plays, nx = 1", "first half -> second half"] <= 1.7
    assert errors["linear gain", "sine -> varying"] > 5


@pytest.mark.slow
@needs_piezo
def test_piezo_stack_on_the_command_line(capsys, tmp_path):
    names = ["--inputs", "u_control_V", "--outputs", "y_disp_um", "--skip", "20", "--nx", "0", "--operators", "20"]
    train, test = PIEZO / "piezo_model_1Hz_sine.csv", PIEZO / "piezo_test_varying_amplitude.csv"
    status = main(["fit", str(train), "--test", str(test), *names, "--starts", "4", "--out", str(tmp_path)])
    out = capsys.readouterr().out
    assert status == 0
    assert float(out.split("rms error ")[1].split()[0]) <= 2.2
