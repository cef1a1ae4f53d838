"""A machine that changed, between recordings or in the time of one, is told as such."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.floor import Floor
from pilfr_casadi.diagnose.search import Search
from pilfr_casadi.diagnose.stages import Stages
from pilfr_casadi.diagnose.varying import varying
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import discretise

DT, M = 0.05, 1200


def cart():
    """A mass on a spring and a damper."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(22.0, bounds=(5, 100)), "d": Parameter(0.9, bounds=(0, 5))},
    )


def recorded(k, seed, state=(0.0, 0.0), initial="zero"):
    """A recording with a spring of stiffness k."""
    rng, model = np.random.default_rng(seed), discretise(cart(), DT)
    u = pilfr.multisine(M, f_max=2.0, fs=1 / DT, rng=rng)
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial=initial, hold="zero", name=f"run{seed}")
    theta = model.parameters.pack({"k": k, "d": 0.8})
    y, after = make_engine(model).simulate(model.drive(r), theta, np.array(state))
    return r.with_(y=y + 1e-3 * rng.standard_normal(y.shape)), after


def told(*recordings):
    """What is said of them where nothing else is found."""
    bench = Workbench.of(cart(), recordings, "zero")
    floor = Floor(np.full(1, 1e-3), "estimated")
    search = Search(bench, bench.fit(bench.simulator), floor, (), 1, Stages(lambda *_: None))
    return varying(search.run(0))


def test_recordings_that_disagree_are_told_with_the_value_that_differs():
    (gate,) = told(recorded(20.0, 0)[0], recorded(26.0, 1)[0])
    assert gate.finding == "varying" and gate.channel == "k" and "the recordings (run0 / run1)" in gate.sentence
    assert gate.value == [pytest.approx([20.0, 26.0], rel=0.02)]


def test_a_value_that_changes_within_a_recording_is_told_by_its_halves():
    first, after = recorded(20.0, 0)
    second, _ = recorded(26.0, 1, after)
    whole = first.with_(u=np.vstack([first.u, second.u]), y=np.vstack([first.y, second.y]))
    (gate,) = told(whole)
    assert gate.channel == "k" and "the halves (first / second)" in gate.sentence
    assert gate.value == [pytest.approx([20.0, 26.0], rel=0.02)]


def test_recordings_that_agree_are_not():
    assert told(recorded(20.0, 0)[0], recorded(20.0, 1)[0]) == ()
