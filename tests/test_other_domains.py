"""Rigs outside mechanics: their truths, what a refit leaves, and diagnoses with the laws of a domain."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from problems import other_domains
from problems.other_domains import COMPLETE, KINDS, judge, recorded

NOISE = 6e-3  # a little more than the largest noise, over the output's deviation


def quick(kinds, first):
    """The kinds, of which all but some of the first are slow."""
    return [kind if kind in first else pytest.param(kind, marks=pytest.mark.slow) for kind in kinds]


@pytest.mark.parametrize("kind", quick(COMPLETE, ("complete oven",)))
def test_a_complete_simulator_follows_its_truth(kind):
    simulator, train, test = recorded(kind, 0)
    fit = pilfr.fit(simulator, train)
    assert fit.nrmse(train) < NOISE and fit.nrmse(test) < NOISE


@pytest.mark.parametrize("kind", quick(KINDS, ("valve",)))
def test_hidden_physics_is_no_matter_of_values(kind):
    simulator, train, _ = recorded(kind, 0)
    assert pilfr.fit(simulator, train).nrmse(train) > 3 * NOISE
    where, law = KINDS[kind][1:]
    assert any(simulator.port(where).admits(known) for known in laws.CATALOGUE if known.id == law)


@pytest.mark.parametrize(
    ("kind", "law", "tried"),
    [
        pytest.param("radiation", laws.Radiation, (laws.Radiation, laws.Convection), marks=pytest.mark.slow),
        ("saturating-core", laws.SaturatingInductance, (laws.SaturatingInductance, laws.CubicDamping)),
        pytest.param("diode", laws.Diode, (laws.Diode, laws.PiecewiseStiffness), marks=pytest.mark.slow),
    ],
)
def test_a_law_of_the_domain_is_named(kind, law, tried):
    simulator, train, test = recorded(kind, 0)
    found = pilfr.diagnose(simulator, train.slice(0, 400), test=test.slice(0, 400), laws=tried, effects=1, workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [(KINDS[kind][1], law.id, law.form)], str(found)
    assert found.errors["test"]["after"] < 3 * NOISE


def test_answers_are_judged():
    assert judge("diode", "missing-physics", [("load", "static_curve")]) == "right"
    assert judge("diode", "missing-physics", [("load", "static_curve"), ("load", "delay")]) == "wrong"
    assert judge("diode", "unexplained", []) == "unexplained"
    assert judge("diode", "complete", []) == judge("complete coil", "unexplained", []) == "wrong"
    assert judge("complete coil", "complete", []) == "right"


@pytest.mark.slow
def test_the_same_number_draws_the_same_rig():
    (_, train, test), (_, again, _) = (recorded("valve", 0) for _ in range(2))
    assert np.array_equal(train.y, again.y) and not np.array_equal(train.y, test.y)
    table = other_domains.table({"valve": other_domains.Counter(right=1)}, {"valve": [np.array([0.5, 0.1, 0.1])]})
    assert "1 of 1 right, 0 wrong" in table
