"""What was accepted, looked at again: a strength beside what it is traded for, and laws that a second effect hid."""

from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_rig import DT, recordings, rig

from pilfr_casadi.diagnose.proof import deviations, shown
from pilfr_casadi.diagnose.review import WIDER, _never_fitted
from pilfr_casadi.diagnose.screen import Scored
from pilfr_casadi.diagnose.workbench import Workbench
from pilfr_casadi.laws import CATALOGUE, CoulombFriction, Local, PreslidingStribeckFriction, StribeckFriction
from pilfr_casadi.laws.dynamic import Relaxation


@pytest.fixture(scope="module")
def relaxed():
    """A slow relaxation, fitted beside the spring that its stiffness can be traded for."""
    law = Relaxation().at({"k_v": 400.0, "T": 1.0})
    bench = Workbench.of(rig(), recordings(law, port="m1-m2", count=1, noise=2e-2), "zero")
    placed = rig().with_element("m1-m2", law.at(law.values, {"T": (5 * DT, 10.0)}))
    return bench, bench.fit(placed, [{}])


def test_a_strength_that_is_plain_to_see_is_shown_though_it_can_be_traded(relaxed):
    bench, fitted = relaxed
    prefix = fitted.simulator.elements[-1].prefix
    alone = fitted.values[f"{prefix}k_v"] / deviations(bench, fitted)[f"{prefix}k_v"]
    assert shown(bench, fitted) > 3 * alone


def test_nothing_is_not_shown():
    law = Relaxation().at({"k_v": 1.0, "T": 1.0}, {"T": (5 * DT, 10.0)})
    bench = Workbench.of(rig(), recordings(None, count=1, noise=2e-2), "zero")
    assert shown(bench, bench.fit(rig().with_element("m1-m2", law), [{}])) < 3


def _scored(port, kind):
    z = np.sin(np.linspace(0, 20, 400))
    local = Local(z, np.gradient(z, DT), DT, (400,))
    start = {name: 0.1 for name in kind.units}
    return Scored(port, kind(), 0.5, (start,), local, 1.0)


def test_a_wider_law_that_the_screen_did_not_let_through_is_put_up_beside_a_second_effect():
    winner = SimpleNamespace(port="ground-m1", law=CoulombFriction())
    fitted = SimpleNamespace(port="ground-m1", law=PreslidingStribeckFriction())
    scored = [_scored(port, kind) for port in ("m1-m2", "ground-m1") for kind in CATALOGUE if "parallel" in kind.places]
    first = SimpleNamespace(choice=SimpleNamespace(winner=winner), candidates=(winner, fitted), scored=tuple(scored))
    search = SimpleNamespace(passes=[first, None], bench=SimpleNamespace(simulator=rig()))
    found = _never_fitted(search)
    assert 1 <= len(found) <= WIDER
    assert all(r.element.port == "ground-m1" for r in found)
    ids = {r.element.law.id for r in found}
    assert ids <= {"stribeck_friction", "hysteresis"}
    assert not any(isinstance(r.element.law, PreslidingStribeckFriction) for r in found)
    only = [s for s in scored if isinstance(s.law, StribeckFriction)]
    search.passes[0].scored = tuple(only)
    assert [type(r.element.law) for r in _never_fitted(search)] == [StribeckFriction]
