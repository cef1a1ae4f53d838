"""Forms that contain a law, and the plainer law, are fitted from its values."""

import numpy as np
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import (
    FINER,
    FreeCurve,
    GeneralizedHysteresis,
    PlayHysteresis,
    PreslidingFriction,
    PreslidingStribeckFriction,
    related_forms,
)


def test_the_plainer_law_starts_from_the_values_of_the_finer_one():
    """A friction that does not fall with speed was left without a name, where its own fit had ended elsewhere."""
    train = recorded(rig().with_element("ground", PreslidingFriction().at({"k_t": 7500.0, "r": 1.5e-4})), 0)
    finer, both = PreslidingStribeckFriction, (PreslidingFriction, PreslidingStribeckFriction)
    search = pilfr.diagnose(rig(430.0, 5.0), train, laws=(finer,), workers=1).evidence.search
    assert search.best.key == {("ground", finer)}
    search.laws = both
    search.compare_effects()
    assert search.best.key == {("ground", PreslidingFriction)}


def test_a_voltage_that_falls_steeply_where_a_cell_runs_empty_is_followed():
    """A polynomial of ninth degree follows it to 2 %; the open-circuit voltage is that of Chen & Rincon-Mora (2006)."""
    simulator = Simulator(
        lambda x, u, p: {"charge": u.current / 3000},
        lambda x, u, p: {"voltage": p.E_0 + p.E_1 * x.charge + p.R * u.current},
        states=("charge",),
        inputs=("current",),
        parameters={
            "E_0": Parameter(3.5, unit="V", bounds=(2, 5)),
            "E_1": Parameter(0.5, unit="V", bounds=(0, 2)),
            "R": Parameter(0.2, unit="Ohm", bounds=(0, 1)),
        },
        ports=(Port("electrode", into={"voltage": 1.0}, across=lambda x: x.charge, unit="V", across_unit="1"),),
    )
    rng, dt, initial = np.random.default_rng(0), 60.0, np.array([0.0])
    level = 0.05 + 0.45 * (1 + np.cos(np.arange(400) / 25)) + 0.02 * np.sin(np.arange(400) / 3)
    level = np.maximum(level - level.min(), 0.0)
    current = np.append(np.diff(level), 0.0) * 3000 / dt
    initial[0] = level[0]
    voltage = 3.685 + 0.2156 * level - 0.1178 * level**2 + 0.3201 * level**3 - 1.031 * np.exp(-35 * level)
    voltage += 0.08 * current + 1e-3 * rng.standard_normal(400)
    names = {"inputs": ("current",), "outputs": ("voltage",)}
    train = Recording(current, voltage, dt, hold="zero", initial=initial, **names)
    found = pilfr.diagnose(simulator, train, laws=(FreeCurve,), workers=1)
    assert [(e.law, e.form) for e in found.effects] == [("static_curve", "free with a steep end")]
    assert found.errors["train"]["after"] < 0.008 < 0.3 < found.errors["train"]["before"]


def test_plain_plays_are_not_fitted_from_the_values_of_bent_ones():
    """They have no bend, and plays that start from others are split into two."""
    port, bent = "actuator:force", GeneralizedHysteresis
    own = {"w": np.array([-0.6, 0.1, 0.2, 0.1, 0.1, 0.1]), "r": np.linspace(0.0, 8.0, 6), "a_2": 0.015, "b_2": 0.0}
    train = recorded(rig().with_element(port, bent().at(own)), 0, samples=400)
    search = pilfr.diagnose(rig(430.0, 5.0), train, laws=(bent,), workers=1, hold="zero").evidence.search
    trial, search.laws = search.memo[frozenset({(port, bent)})], (PlayHysteresis, bent)
    search.fit_related_forms(trial)
    assert frozenset({(port, PlayHysteresis)}) not in search.memo
    assert list(related_forms(bent, search.laws)) == [*FINER[bent]]
