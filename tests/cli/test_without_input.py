"""A simulator and recordings without an input, through every command that takes them."""

import shutil
from pathlib import Path

import free_pendulum
import numpy as np
import pytest
from command_line import refused, run


@pytest.fixture
def rig(tmp_path):
    """The simulator file, beside two recordings and their times alone."""
    for name, start in (("train", [0.8, 0.0]), ("test", [0.4, 1.0])):
        r = free_pendulum.decay(start)
        rows = np.column_stack([r.t, r.y])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="t,angle", comments="", fmt="%.9g")
    np.savetxt(tmp_path / "times.csv", r.t, header="t", comments="", fmt="%.9g")
    return Path(shutil.copy(free_pendulum.__file__, tmp_path / "rig.py"))


def test_the_missing_friction_is_named(capsys, rig):
    folder, out = rig.parent, rig.parent / "out"
    given = ("diagnose", rig, folder / "train.csv", "--test", folder / "test.csv", "--laws", "coulomb_friction,drift")
    status, said, err = run(capsys, *given, "--out", out)
    assert status == 0 and "warning" not in err
    assert "inputs none, outputs angle" in said and "leaves out Coulomb friction at bearing." in said
    assert "No input changes and there is one start" in said
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Diagnosis of a simulator: angle" in page and "no input" in page and "from the start alone" in page
    status, said, _ = run(capsys, "simulate", out / "corrected.py", folder / "test.csv", "--out", folder / "sim.csv")
    assert status == 0 and float(said.split("NRMSE on test: ")[1].split()[0]) < 0.05
    assert (folder / "sim.csv").read_text().startswith("t,angle [rad]\n")


def test_a_free_motion_is_simulated_and_exported_from_a_given_start(capsys, rig):
    out = rig.parent / "sim.csv"
    assert run(capsys, "simulate", rig, rig.parent / "times.csv", "--initial", "0.8,0", "--out", out)[0] == 0
    begin = np.loadtxt(out, delimiter=",", skiprows=1)[:3]
    assert begin[0].tolist() == [0.0, 0.8] and np.all(np.diff(begin[:, 1]) < 0)
    assert run(capsys, "export", rig, "--dt", 0.02, "--initial", "0.8,0", "--out", rig.parent / "m.casadi")[0] == 0


def test_check_tells_what_one_decay_hides_and_names_forms(capsys, rig):
    status, said, _ = run(capsys, "check", rig, rig.parent / "train.csv", "--laws", "coulomb_friction")
    assert status == 0 and "between samples" not in said
    assert "- No input changes and there is one start" in said and "next record: One from another start" in said
    for form in ("(smooth)", "(presliding)", "(asymmetric)"):
        assert f"bearing  Coulomb friction {form}" in said
    both = run(capsys, "check", rig, rig.parent / "train.csv", rig.parent / "test.csv", "--laws", "coulomb_friction")
    assert "there is one start" not in both[1]


def test_a_black_box_model_still_needs_an_input(capsys, rig):
    r = np.loadtxt(rig.parent / "train.csv", delimiter=",", skiprows=1)
    rows = np.column_stack([r[:, 0], np.ones(len(r)), r[:, 1]])
    np.savetxt(rig.parent / "still.csv", rows, delimiter=",", header="t,u,angle", comments="")
    given = ("fit", rig.parent / "still.csv", "--inputs", "u", "--outputs", "angle", "--out", rig.parent / "out")
    refused(capsys, *given, says=("the input u never changes", "needs an input that changes", "use a simulator"))
