"""What other runs tell of the initial state of a recording."""

import numpy as np
import pytest

from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose import Workbench, proof
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import run_free
from pilfr_casadi.optimise import StatePrior
from pilfr_casadi.simulators import discretise

NOISE = 0.2


def house():
    """Air, two walls that it hardly shows in the first samples, and a constant."""
    return Simulator(
        lambda x, u, p: {
            "air": 0.2 * u.heater - 0.1 * (x.air - x.wall) - 0.05 * (x.air - x.floor) + 0.0 * x.constant,
            "wall": p.slow * (x.air - x.wall - x.wall),
            "floor": 0.04 * (x.air - x.floor),
            "constant": 0.0 * x.air,
        },
        lambda x: {"air": x.air},
        ("air", "wall", "floor", "constant"),
        ("heater",),
        {"slow": Parameter(0.01, fixed=True)},
        Port("inside", {"air": -1.0}, lambda x: x.air),
        hold="zero",
    )


def states_and_recording(seed, m, begin):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 4, m // 20), 20)[:, None]
    model = discretise(house(), 0.1, "zero")
    blank = Recording(u, 0 * u, 0.1, ("heater",), ("air",), initial=begin, hold="zero")
    engine, states, state = make_engine(model), [], np.array(begin)
    for k in range(m):
        states.append(state)
        state = engine.simulate(model.drive(blank)[k : k + 1], model.parameters.start, state)[1]
    y = np.array(states)[:, :1] + NOISE * rng.standard_normal((m, 1))
    return model, np.array(states), blank.with_(y=y)


def test_a_state_that_the_first_samples_hardly_reveal_is_as_in_other_runs():
    model, known, trained = states_and_recording(0, 4000, [6.0, 2.0, 6.0, 0.3])
    prior = StatePrior.of(known, trained.y - known[:, :1])
    assert prior.noise == pytest.approx([NOISE], rel=0.05)
    assert not prior.precision[3].any() and prior.precision[0, 0] > 0  # the constant did not move
    errors = {"none": [], "known": []}
    for seed in range(1, 9):
        _, states, r = states_and_recording(seed, 240, [7.0, 2.5, 6.0, 3.0])
        for name, one in (("none", None), ("known", prior)):
            y, first = run_free(model, make_engine(model), r.with_(initial="estimate"), known=one)
            errors[name].append(np.sqrt(np.mean((y - states[:, :1])[first:] ** 2)))
    assert np.mean(errors["known"]) < 0.7 * np.mean(errors["none"])


def test_fits_are_tested_with_what_their_own_runs_tell():
    """The simulator as given has the same values here, but no runs."""
    trained = states_and_recording(0, 4000, [6.0, 2.0, 6.0, 0.3])[2].with_(initial="estimate")
    bench = Workbench.of(house(), [trained], "zero")
    fitted = bench.fit(house())
    tests = [states_and_recording(seed, 240, [7.0, 2.5, 6.0, 3.0])[2] for seed in range(1, 9)]
    unknown = [r.with_(initial="estimate") for r in tests]
    fits = {"before": fitted, "after": fitted}
    errors = proof.test_errors(bench, unknown, (), fits, bench.model(house())).errors
    assert errors["after"] == errors["before"] < 0.9 * errors["nominal"]
    known = proof.test_errors(bench, tests, (), fits, bench.model(house())).errors
    assert known["after"] == known["nominal"]


def two_lags():
    """Two slow states of which the output shows the sum."""
    return Simulator(
        lambda x, u: {"a": u.f - 0.2 * x.a, "b": u.g - 0.05 * x.b},
        lambda x: {"y": x.a + x.b},
        ("a", "b"),
        ("f", "g"),
        ports=(Port("a", {"a": -1.0}, lambda x: x.a),),
        hold="zero",
    )


@pytest.mark.parametrize("share", [0.0, 1e-15, 0.1])
def test_samples_that_contradict_the_prior_win(share):
    """The other runs hardly moved a state that is plain to see."""
    rng = np.random.default_rng(0)
    model = discretise(two_lags(), 0.1, "zero")
    engine = make_engine(model)
    u = np.repeat(rng.uniform(-1, 1, (120, 2)), 10, axis=0) * [1.0, share]

    def run(state, noise):
        r = Recording(u, 0 * u[:, :1], 0.1, ("f", "g"), ("y",), hold="zero")
        y = engine.simulate(model.drive(r), model.parameters.start, np.array(state))[0]
        return r.with_(y=y + noise * rng.standard_normal(y.shape), initial="estimate"), y

    states = np.cumsum(0.05 * u, axis=0)  # about those of the runs
    states[:, 1] += 0.3
    prior = StatePrior.of(states, 0.02 * rng.standard_normal((1200, 1)))
    r, true = run([-0.3, 4.0], 0.02)
    y, first = run_free(model, engine, r, known=prior)
    assert np.sqrt(np.mean((y - true)[first:] ** 2)) < 0.02


def test_runs_that_diverge_or_have_no_error_tell_nothing():
    states = np.arange(6.0).reshape(3, 2)
    assert StatePrior.of(states, np.zeros((3, 1))) is None
    assert StatePrior.of(states + np.inf, np.ones((3, 1))) is None
    assert StatePrior.of(states, np.ones((3, 1))) is not None
