"""Contacts that lose energy, in front of which a simulator without the contact runs away."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.laws import (
    AsymmetricCubicStiffness,
    CoulombFriction,
    CubicStiffness,
    DampedContact,
    HertzContact,
    Law,
    LossyContact,
    PiecewiseStiffness,
)

DT = 0.01


class Pad(Law):
    """A rubber pad at the end of the travel: spring and damper where they are in touch, and never a pull."""

    id, equation = "pad", "w = max(k (z - g) + c dz/dt, 0)  (z > g)"
    sentence = "a rubber pad"
    units = {"k": "w/z", "c": "w*s/z", "g": "z"}

    def force(self, z, dz, p):
        return ca.if_else(z > p.g, ca.fmax(p.k * (z - p.g) + p.c * dz, 0), 0)


def slider(m=1.0):
    """A slider that nothing holds."""
    return pilfr.Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=(u.force - p.d * x.vel) / p.m),
        lambda x: dict(pos=x.pos),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(
            m=pilfr.Parameter(m, unit="kg", bounds=(0.5, 2)), d=pilfr.Parameter(2.0, unit="N s/m", bounds=(0, 6))
        ),
        ports=(pilfr.Port("end stop", lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    )


def pressed(true, seed, samples=500):
    """A recording of pushes towards the stop and away from it."""
    rng = np.random.default_rng(seed)
    level = np.repeat(rng.uniform(-1, 3, samples // 50 + 1), 50)[:samples]
    u = level + 1.5 * np.sin(2 * np.pi * 2.1 * np.arange(samples) * DT)
    blank = pilfr.Recording(u[:, None], np.zeros((samples, 1)), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = true.simulate(blank)
    return blank.with_(y=y + 2e-4 * rng.standard_normal(y.shape))


def test_a_contact_with_loss_is_told_from_one_without():
    pad = Pad().at({"k": 400.0, "c": 12.0, "g": 0.1})
    train, test = (pressed(slider().with_element("end stop", pad), seed) for seed in (0, 1))
    laws = (PiecewiseStiffness, LossyContact, DampedContact, CoulombFriction)
    found = pilfr.diagnose(slider(1.2), train, test=test, laws=laws, workers=1)
    assert [e.law for e in found.effects] == ["piecewise_stiffness"]
    assert found.effects[0].form in ("above, with loss", "above, with damper") and found.effects[0].confidence > 0.9
    errors = found.errors["test"]
    assert errors["before"] > 1 and errors["after"] < 0.1


def test_forms_with_a_common_base_are_compared_for_a_single_effect_too():
    """A wrong form leaves an error that may pass for slow noise."""
    assert DampedContact.extends(LossyContact) and LossyContact.extends(DampedContact)
    assert not HertzContact.extends(LossyContact) and not PiecewiseStiffness.extends(LossyContact)
    train = pressed(slider().with_element("end stop", Pad().at({"k": 400.0, "c": 12.0, "g": 0.1})), 0)
    search = pilfr.diagnose(slider(1.2), train, laws=(PiecewiseStiffness, LossyContact), workers=1).evidence.search
    assert search.best.key == {("end stop", LossyContact)}
    lossy, search.laws = search.best, (PiecewiseStiffness, LossyContact, DampedContact)
    search.compare_effects()
    damped = search.memo[frozenset({("end stop", DampedContact)})]
    assert damped.error < lossy.error


def test_friction_beside_a_contact_shows_its_damper():
    """A contact with a damper can stand beside friction; and where one without was fitted first, it is refined."""
    true = rig().with_element("ground", Pad().at({"k": 1000.0, "c": 30.0, "g": 0.01}))
    true = true.with_element("ground", CoulombFriction().at({"F_c": 2.0, "v_0": 0.01}))
    train, test = recorded(true, 0, samples=500), recorded(true, 1, samples=400)
    laws = (PiecewiseStiffness, CoulombFriction, DampedContact)
    found = pilfr.diagnose(rig(430.0, 5.0), train, test=test, laws=laws, workers=1)
    forms = {"piecewise_stiffness": "above, with damper", "coulomb_friction": "smooth"}
    assert {e.law: e.form for e in found.effects} == forms

    search, plain = found.evidence.search, frozenset(("ground", law) for law in laws[:2])
    search.memo = {key: trial for key, trial in search.memo.items() if key in (frozenset(), plain)}
    assert search.best.key == plain
    search.compare_effects()
    key = frozenset({("ground", DampedContact), ("ground", CoulombFriction)})
    assert search.best.key == key

    found = search.memo[key]  # as a fit from other values that ended in a wrong minimum
    search.memo[key] = replace(found, mean_square=2 * search.memo[plain].mean_square)
    search.fit_related_forms(search.memo[plain].with_added(("ground", PiecewiseStiffness)))
    assert search.memo[key].mean_square == pytest.approx(found.mean_square, rel=0.05)


def test_a_contact_that_never_pulls_takes_no_stiffness_away():
    """A spring that softens beyond a point may be less stiff there; with a loss, that would give energy."""
    train = recorded(rig().with_element("ground", PiecewiseStiffness().at({"k_c": -250.0, "g": 0.01})), 0, samples=500)
    found = pilfr.diagnose(rig(430.0, 5.0), train, laws=(PiecewiseStiffness, LossyContact), workers=1)
    search, plain = found.evidence.search, frozenset({("ground", PiecewiseStiffness)})
    assert search.memo[plain].own["k_c"] < 0
    search.memo = {key: search.memo[key] for key in (frozenset(), plain)}
    search.fit_related_forms(search.memo[plain])
    assert search.memo[frozenset({("ground", LossyContact)})].own["k_c"] >= 0


def test_a_softening_spring_may_have_finer_forms_where_a_contact_was_screened_first():
    """A contact pushes back; that is no reason why the other laws of the position should."""
    train = recorded(rig().with_element("ground", CubicStiffness().at({"k_3": -4e3})), 0, samples=500)
    found = pilfr.diagnose(rig(430.0, 5.0), train, laws=(CubicStiffness, LossyContact), workers=1)
    search, plain = found.evidence.search, frozenset({("ground", CubicStiffness)})
    first = search.moves[0]
    by_sense = tuple(sorted(first.scored, key=lambda s: -s.sense))
    search.moves[0] = replace(first, scored=by_sense)
    assert by_sense[0].sense == 1 and search.memo[plain].own["k_3"] < 0
    search.fit_forms(search.memo[plain], [AsymmetricCubicStiffness])
    assert search.memo[frozenset({("ground", AsymmetricCubicStiffness)})].own["k_3"] < 0


def test_a_heat_path_that_sets_in_at_a_temperature_is_no_contact():
    """Finer forms are of the port's physical domain as well."""
    room = pilfr.Simulator(
        lambda x, u, p: {"T": (u.heat - p.k * x.T) / 20},
        lambda x: {"T": x.T},
        states=("T",),
        inputs=("heat",),
        parameters={"k": pilfr.Parameter(0.6, unit="W/K", bounds=(0.05, 5))},
        ports=pilfr.Port("wall", {"T": -0.05}, lambda x: x.T, unit="W", across_unit="K"),
    )
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-15, 30, 20), 25)[:, None]
    r = pilfr.Recording(u, np.zeros((500, 1)), 1.0, ("heat",), ("T",), initial="zero", hold="zero")
    y = room.with_element("wall", PiecewiseStiffness().at({"k_c": 1.5, "g": 10.0})).simulate(r)
    train = r.with_(y=y + 0.02 * rng.standard_normal(y.shape))
    found = pilfr.diagnose(room, train, laws=("piecewise_stiffness",), workers=1)
    assert [(e.law, e.form) for e in found.effects] == [("piecewise_stiffness", "above")]
    tried = {kind for key in found.evidence.search.memo for _, kind in key}
    assert PiecewiseStiffness in tried and not {LossyContact, DampedContact} & tried
