"""The demonstration: what it prints and writes, to its end and where Ctrl-C strikes."""

from importlib import import_module

import pytest
from command_line import run, sentence

from pilfr_casadi import load
from pilfr_casadi.cli import demo, main

pytestmark = pytest.mark.usefixtures("blank_figures")


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.fixture
def quick(monkeypatch):
    """Ctrl-C strikes where the model with hysteresis begins; the linear one is fitted."""
    fit = demo.fit

    def struck(model, *given, **options):
        return (interrupted if model.element else fit)(model, *given, **options)

    monkeypatch.setattr(demo, "fit", struck)


def told(capsys, folder):
    """Status, stdout and stderr of the demonstration."""
    return run(capsys, "demo", "--workers", 1, "--out", folder)


@pytest.mark.usefixtures("quick")
def test_ctrl_c_between_two_fits_keeps_the_first(capsys, tmp_path):
    status, out, _ = told(capsys, tmp_path)
    assert status == 130
    assert "linear model" in out and "hysteresis operators" not in out
    assert "0.3026" in out and "noise floor" in out  # the published error beside it
    assert "Interrupted; the best model so far was written." in out and "Another rig" not in out
    error = load(tmp_path / "model.json").nrmse(demo.demo_recordings()["train"])
    assert 0.2 < error < demo.PUBLISHED["LTI"][0]  # no linear model follows the rig
    assert (tmp_path / "report.html").exists()


@pytest.mark.usefixtures("quick")
def test_ctrl_c_in_the_report_keeps_the_model(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(import_module("pilfr_casadi.report"), "fit_report", interrupted)
    status, out, _ = told(capsys, tmp_path)
    assert status == 130 and "a report was not written" in out
    assert (tmp_path / "model.json").exists() and not (tmp_path / "report.html").exists()


@pytest.mark.usefixtures("quick")
def test_after_the_fits_comes_the_diagnosis(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "SHOWN", {"LTI": "linear model"})
    monkeypatch.setattr(import_module("pilfr_casadi.diagnose"), "diagnose", interrupted)
    status, out, err = told(capsys, tmp_path)
    assert "Another rig, with a simulator" in out and "The model is in" in out and "Interrupted" not in out
    assert status == 130 and "the diagnosis was not written" in sentence(err)
    assert not (tmp_path / "diagnosis" / "diagnosis.json").exists()


@pytest.mark.parametrize(
    ("failure", "status", "words"),
    [
        (KeyboardInterrupt(), 130, "Interrupted before there was anything to write"),
        (PermissionError(13, "Permission denied", "model.json"), 2, "model.json cannot be used: Permission denied"),
        (MemoryError(), 1, "Memory ran out"),
        (ZeroDivisionError("division by zero"), 1, "ZeroDivisionError: division by zero"),
        (BrokenPipeError(), 0, ""),  # the reader of the output has gone
    ],
)
def test_a_failure_is_one_sentence_and_a_status(capsys, tmp_path, monkeypatch, failure, status, words):
    def fail(*_, **__):
        raise failure

    monkeypatch.setattr(demo, "fit", fail)
    found, _, err = told(capsys, tmp_path)
    assert found == status
    assert words in sentence(err) if words else not err


def test_a_failure_shows_its_traceback_in_debug_mode(tmp_path, monkeypatch):
    monkeypatch.setenv("PILFR_DEBUG", "1")
    monkeypatch.setattr(demo, "demo_recordings", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["demo", "--out", str(tmp_path)])


def test_the_demonstration_names_the_friction_of_its_rig(capsys, tmp_path):
    assert demo.diagnose_rig(tmp_path, 1) == 0
    assert "The simulator leaves out Coulomb friction at ground-m2.\n" in capsys.readouterr().out
