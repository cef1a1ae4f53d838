"""An unexplained mismatch hands back the fitted model that predicts unseen data best, without calling it a name."""

import json

import numpy as np
import pytest
from diagnosis_contract import SCHEMA, problems
from diagnosis_example import LAWS, recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.laws import Backlash, PiecewiseStiffness, ProgressiveStiffness
from pilfr_casadi.report import diagnosis_report

HYSTERETIC = rig().with_element("ground", LAWS["hysteresis"])
STIFF_TOO = HYSTERETIC.with_element("ground", LAWS["ground"])


def diagnosed(true, law, test=True):
    """A diagnosis by one law that is not the truth."""
    held_out = recorded(true, 2) if test else None
    options = {"hold": "zero", "effects": 1, "workers": 1, "engine": "vm"}
    return pilfr.diagnose(rig(430.0, 5.0), recorded(true, 0), test=held_out, laws=(law,), **options)


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("true", "law"),
    [(STIFF_TOO, PiecewiseStiffness), (HYSTERETIC, ProgressiveStiffness)],
    ids=["the search accepted the law", "the search accepted none"],
)
def test_the_corrected_simulator_is_the_better_model(true, law, tmp_path):
    found = diagnosed(true, law)
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert [(e.port, e.law.id) for e in found.corrected.elements] == [("ground", law.id)]
    described = found.description
    assert described.after < 0.9 * described.before and described.words.endswith("at ground")
    for errors in found.errors.values():
        assert errors["after"] < 0.95 * errors["before"]
    assert found.nrmse(found.test[0]) == pytest.approx(found.errors["test"]["after"], rel=1e-9)
    assert "a description without a sure name" in found.sentence and found.sentence in str(found)
    content = json.loads((diagnosis_report(found, tmp_path).parent / "diagnosis.json").read_text())
    assert problems(content, SCHEMA) == []
    assert content["description"]["elements"][0]["law"] == law.id
    page = (tmp_path / "report.html").read_text()
    assert "How to use the corrected simulator" in page and f"with {described.words} added" in page
    assert 'class="status warning"' in page


def test_the_refit_is_handed_back_where_nothing_predicts_better():
    found = diagnosed(HYSTERETIC, Backlash, test=False)
    assert found.verdict == "unexplained" and found.description is None
    assert found.corrected.elements == () and found.errors["train"]["after"] == found.errors["train"]["before"]
    assert found.outcome == "" and np.isfinite(found.errors["train"]["after"])
