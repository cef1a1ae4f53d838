"""Forms that contain a law, and the plainer law, are fitted from its values."""

import numpy as np
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.laws import (
    FINER,
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
