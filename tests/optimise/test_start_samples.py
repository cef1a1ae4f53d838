"""The number of samples to which an unknown initial state is fitted follows the mode that rings longest."""

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator
from pilfr_casadi.engine import make_engine
from pilfr_casadi.optimise import samples_for_state, samples_to_start
from pilfr_casadi.simulators import discretise


def frame(c):
    """A slow storey of period 3 s below a fast one, seen by an accelerometer on the fast one."""
    return Simulator(
        lambda x, u, p: {
            "q1": x.v1,
            "v1": -4 * x.q1 - p.c * x.v1 - u.ground,
            "q2": x.v2,
            "v2": 4000 * (x.q1 - x.q2) - 10 * x.v2 - u.ground,
        },
        lambda x, u, p: {"acc": 4000 * (x.q1 - x.q2) - 10 * x.v2},
        states=("q1", "v1", "q2", "v2"),
        inputs=("ground",),
        parameters={"c": Parameter(c)},
    )


def test_a_slow_mode_that_rings_on_takes_a_longer_start():
    rng = np.random.default_rng(1)
    r = Recording(rng.standard_normal(2000), np.zeros(2000), 0.005, ("ground",), ("acc",), hold="zero")
    samples = {}
    for c in (0.1, 60.0):
        y = frame(c).simulate(r.with_(initial="zero"))
        noisy = r.with_(y=y + 0.05 * np.std(y) * rng.standard_normal(y.shape))
        model = discretise(frame(c), r.dt, "zero")
        samples[c] = samples_to_start(model, make_engine(model), noisy)
        assert pilfr.compare(noisy, {"truth": frame(c)}).nrmse["truth"] < 0.06
    assert samples[60.0] == samples_for_state(model) < samples[0.1] <= 666
