"""Forms of laws that their nearest relatives do not follow."""

import numpy as np
import pytest
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.laws import (
    AsymmetricCubicStiffness,
    BoucWen,
    CoulombFriction,
    CubicStiffness,
    HertzContact,
    OffCentreClearance,
    PiecewiseStiffness,
    QuadraticStiffness,
    StiffeningBoucWen,
)


def test_loops_that_stiffen_are_told_from_those_that_soften():
    truth = {"k_h": 300.0, "q_0": 0.05, "h": 1.4, "n": 1.0}
    true = rig().with_element("ground", StiffeningBoucWen().at(truth))
    train, test = recorded(true, 0, samples=500), recorded(true, 1, samples=400)
    laws = (CoulombFriction, BoucWen, StiffeningBoucWen)
    found = pilfr.diagnose(rig(430.0, 5.0), train, test=test, laws=laws, effects=1, hold="zero", workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("ground", "hysteresis", "bouc_wen_stiffening")]
    assert found.effects[0].confidence > 0.9
    own = found.effects[0].parameters
    assert {name: own[name]["value"] for name in ("h", "n")} == pytest.approx({"h": 1.4, "n": 1.0}, rel=0.1)
    errors = found.errors["test"]
    assert errors["after"] < 0.1 * errors["before"]


@pytest.mark.slow
def test_a_spring_that_hardens_and_differs_between_the_directions_is_one_law():
    """Neither a cubic nor a quadratic force alone, nor a clearance that is off centre."""
    true = rig().with_element("ground", AsymmetricCubicStiffness().at({"k_3": 3e4, "b": -0.04}))
    train, test = recorded(true, 0, samples=500), recorded(true, 1, samples=400)
    tried = (CubicStiffness, AsymmetricCubicStiffness, QuadraticStiffness, OffCentreClearance)
    found = pilfr.diagnose(rig(430.0, 5.0), train, test=test, laws=tried, effects=1, hold="zero", workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("ground", "cubic_stiffness", "asymmetric")]
    values = {name: p["value"] for name, p in found.effects[0].parameters.items()}
    assert values == pytest.approx({"k_3": 3e4, "b": -0.04}, rel=0.05)


def test_forms_that_follow_alike_are_told():
    """A contact that is hardly touched, in noise: with which power its force grows remains open."""
    true = rig().with_element("ground", PiecewiseStiffness().at({"k_c": 600.0, "g": 0.02}))
    noise = 4e-3 * np.random.default_rng(5).standard_normal((500, 1))
    train = recorded(true, 0, samples=500)
    train = train.with_(y=train.y + noise)
    found = pilfr.diagnose(rig(430.0, 5.0), train, laws=(PiecewiseStiffness, HertzContact), effects=1, workers=1)
    (effect,) = found.effects
    other = {"above": "Hertz", "hertz": "above"}[effect.form]
    assert f"piecewise stiffness ({other}), another form of this law, is about as likely" in effect.sentence
