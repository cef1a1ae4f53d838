"""A simulator goes through the same `fit` as a model, and its fit has the same verbs."""

import numpy as np
import pytest
from free_pendulum import decay, simulator as pendulum

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Simulator
from pilfr_casadi._base import InputError
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import run_simulator
from pilfr_casadi.laws import Delay
from pilfr_casadi.simulators import discretise

DT = 0.01


def simulator(k=1100.0, d=15.0):
    return Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m),
        lambda x, u, p: dict(position=x.pos),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(m=Parameter(2.0, fixed=True), k=Parameter(k, bounds=(500, 3000)), d=Parameter(d)),
    )


@pytest.fixture(scope="module")
def record():
    u = 0.3 * np.cumsum(np.random.default_rng(0).standard_normal((400, 1)), axis=0)
    model = discretise(simulator(1500.0, 25.0), DT, "zero", 4)
    blank = pilfr.Recording(u, u, DT, ("force",), ("position",))
    y = make_engine(model, "vm").simulate(model.drive(blank), model.parameters.start, np.zeros(2))[0]
    return blank.with_(y=y)


@pytest.fixture(scope="module")
def fitted(record):
    return pilfr.fit(simulator(), record, engine="vm")


def test_the_parameters_are_found(record, fitted):
    assert fitted.parameters["k"] == pytest.approx(1500.0, rel=1e-3)
    assert fitted.simulator.parameters["d"].value == pytest.approx(25.0, rel=1e-2)
    assert fitted.nrmse(record) < 1e-3
    assert np.isfinite(fitted.errors["k"]) and np.isnan(fitted.errors["m"])


def test_a_fit_and_a_simulation_use_the_substeps_of_a_law(record):
    late = simulator().with_element("actuator:force", Delay({"T": 0.025}))
    found = pilfr.fit(late, record, engine="vm")
    assert found.model.substeps == Delay.substeps > 1
    placed = found.simulator
    assert np.max(np.abs(placed.simulate(record)[:, 0] - found.simulate(record)[:, 0])) < 1e-9 * np.std(record.y)


def test_recordings_with_different_holds_are_refused(record):
    with pytest.raises(InputError, match="differ in `hold`"):
        pilfr.fit(simulator(), [record.with_(hold=hold) for hold in ("zero", "linear")], engine="vm")
    one_states = [record.with_(hold=None), record.with_(y=record.y + 1e-3, hold="linear")]
    assert pilfr.fit(simulator(), one_states, engine="vm").model.hold == "linear"  # as in a diagnosis


def test_a_recording_with_another_hold_than_the_fit_is_refused(record, fitted):
    sloped = record.with_(hold="linear")
    for verb in (fitted.simulate, fitted.nrmse, lambda r: pilfr.fit(fitted, r)):
        with pytest.raises(InputError, match="states hold='linear', and the simulator was fitted with 'zero'"):
            verb(sloped)
    assert fitted.nrmse(record.with_(hold="zero")) == fitted.nrmse(record)
    again = pilfr.fit(fitted.simulator, sloped, engine="vm")
    assert np.max(np.abs(again.simulate(sloped) - fitted.simulate(record))) > 0


def test_run_simulator_equals_simulate_from_zero(record):
    placed = simulator().with_element("actuator:force", Delay({"T": 0.025}))
    for hold in ("zero", "linear"):
        known = record.with_(hold=hold, initial="zero")
        matched, y, first = run_simulator(placed, known)
        np.testing.assert_allclose(y, placed.simulate(known), atol=1e-9 * np.std(record.y))
        assert (matched.outputs, first) == (record.outputs, record.skip)


def test_columns_are_matched_by_name(record, fitted):
    wide = pilfr.Recording(
        np.hstack([0 * record.u, record.u]),
        np.hstack([record.y, 0 * record.y]),
        DT,
        ("idle", "force"),
        ("position", "b"),
    )
    np.testing.assert_array_equal(fitted.simulate(wide), fitted.simulate(record))
    with pytest.raises(InputError, match="has no input 'force'"):
        fitted.simulate(pilfr.Recording(record.u, record.y, DT, ("thrust",), ("position",)))


def test_the_verbs(record, fitted, tmp_path):
    with pytest.warns(UserWarning, match="not the simulator's equations"):
        fitted.save(tmp_path / "sim.json")
    again = pilfr.load(tmp_path / "sim.json", model=fitted.model)
    np.testing.assert_array_equal(again.simulate(record), fitted.simulate(record))
    assert fitted.to_casadi().size1_in(0) == 2
    assert fitted.plot(record) is not None
    assert pilfr.fit(fitted, record, engine="vm").simulator is not None


@pytest.mark.parametrize("hold", ["zero", "linear", "band-limited"])
def test_a_saved_fit_of_a_simulator_is_loaded_with_it(record, tmp_path, hold):
    given = record.with_(hold=hold)
    fit = pilfr.fit(simulator(), given, engine="vm")
    with pytest.warns(UserWarning, match="model=simulator"):
        fit.save(tmp_path / "sim.json")
    closed = pilfr.load(tmp_path / "sim.json", model=fit.model)
    np.testing.assert_array_equal(closed.simulate(given), fit.simulate(given))
    again = pilfr.load(tmp_path / "sim.json", model=simulator())
    np.testing.assert_array_equal(again.simulate(given), fit.simulate(given))
    assert again.simulator.parameters["k"].value == fit.parameters["k"]
    assert again.simulator.nrmse(given) == pytest.approx(fit.simulator.nrmse(given))
    thrust = Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.thrust - p.k * x.pos - p.d * x.vel - p.m),
        simulator().outputs,
        states=("pos", "vel"),
        inputs=("thrust",),
        parameters=simulator().parameters,
    )
    for other, words in ((thrust, "other inputs or outputs"), (fit, "Model, PILFR or Simulator")):
        with pytest.raises(InputError, match=words):
            pilfr.load(tmp_path / "sim.json", model=other)


def test_an_exact_fit_has_no_warning(record):
    """Nothing is left whose colour could be estimated; a warning would be an error here."""
    exact = simulator(1500.0, 25.0)
    start = record.with_(initial="zero", hold="zero")
    fit = pilfr.fit(exact, start.with_(y=exact.simulate(start)), engine="vm")
    assert fit.errors["k"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("constant", [None, 0.0, 3.0])
def test_a_decay_needs_no_input_that_changes(tmp_path, constant):
    true = pendulum.with_parameters({"w": 5.3, "d": 0.05})
    r = decay([0.8, 0.0], true)
    if constant is not None:  # a simulator takes its own columns
        r = r.with_(u=np.full((len(r), 1), constant), inputs=("room",))
    found = pilfr.fit(pendulum, r, engine="vm")
    assert found.parameters["w"] == pytest.approx(5.3, rel=1e-3)
    assert found.initial_state(r) == pytest.approx([0.8, 0.0], abs=5e-3)
    with pytest.raises(InputError, match="needs an input that changes"):
        pilfr.fit(pilfr.PILFR(1, None), r)
    with pytest.warns(UserWarning, match="not the simulator's equations"):
        assert found.report(tmp_path, r).exists()
    assert pilfr.load(tmp_path / "model.json", model=found.model).parameters["w"] == found.parameters["w"]
