"""Forms that contain a law, and the plainer law, are fitted from its values."""

from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.laws import PreslidingFriction, PreslidingStribeckFriction


def test_the_plainer_law_starts_from_the_values_of_the_finer_one():
    """A friction that does not fall with speed was left without a name, where its own fit had ended elsewhere."""
    train = recorded(rig().with_element("ground", PreslidingFriction().at({"k_t": 7500.0, "r": 1.5e-4})), 0)
    finer, both = PreslidingStribeckFriction, (PreslidingFriction, PreslidingStribeckFriction)
    search = pilfr.diagnose(rig(430.0, 5.0), train, laws=(finer,), workers=1).evidence.search
    assert search.best.key == {("ground", finer)}
    search.laws = both
    search.compare_effects()
    assert search.best.key == {("ground", PreslidingFriction)}
