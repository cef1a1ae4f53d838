"""Substitutes for a simulator: a linear surrogate of a simulation, a control.StateSpace, a fitted PI-LFR."""

import importlib

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.signal import cont2discrete

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Recording, multisine
from pilfr_casadi.engine import VirtualMachine
from pilfr_casadi.identify import POOR_SURROGATE, fit, surrogate, surrogate_warning
from pilfr_casadi.identify.modal_form import modes, to_continuous
from pilfr_casadi.identify.surrogates import modal_simulator
from pilfr_casadi.simulators import as_simulator, discretise

DT = 0.01


def random_system(seed, n_u=2, n_y=2):
    """Two oscillating modes and a slow one, mixed."""
    rng = np.random.default_rng(seed)
    a = np.zeros((5, 5))
    for k, (w, z) in enumerate(zip(rng.uniform(5, 60, 2), rng.uniform(0.01, 0.3, 2), strict=True)):
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[-z * w, w], [-w, -z * w]]
    a[4, 4] = -rng.uniform(0.5, 4.0)
    t = rng.standard_normal((5, 5)) + 3 * np.eye(5)
    b, c, d = rng.standard_normal((5, n_u)), rng.standard_normal((n_y, 5)), rng.standard_normal((n_y, n_u))
    return t @ a @ np.linalg.inv(t), t @ b, c @ np.linalg.inv(t), d


def response(a, b, c, d, w):
    return c @ np.linalg.solve(1j * w * np.eye(len(a)) - a, b) + d


def run(simulator, recording, hold="zero", substeps=1):
    """Simulated outputs from rest at the start values."""
    model = discretise(simulator, recording.dt, hold, substeps)
    state = np.zeros(model.n_x + model.n_s)
    return VirtualMachine(model).simulate(model.drive(recording), model.parameters.start, state)[0]


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from(["zero", "linear"]))
def test_to_continuous_undoes_sampling(seed, hold):
    system = random_system(seed)
    sampled = cont2discrete(system, DT, method={"zero": "zoh", "linear": "foh"}[hold])[:4]
    back = to_continuous(*sampled, DT, hold)
    for w in (0.0, 3.0, 30.0, 100.0):
        expected = response(*system, w)
        assert np.max(np.abs(response(*back, w) - expected)) < 1e-6 * np.max(np.abs(expected))


@pytest.mark.parametrize("hold", ["zero", "linear", "band-limited", "next"])
def test_a_surrogate_has_the_stated_hold(hold):
    def dynamics(x, u):
        return dict(x=x.v, v=u.f - 400 * x.x - 4 * x.v)

    known = pilfr.Simulator(dynamics, lambda x: dict(x=x.x), states=("x", "v"), inputs=("f",), parameters={})
    smooth = np.convolve(np.random.default_rng(0).standard_normal(1200), np.hanning(30), "valid")
    u = smooth[:1000, None]
    record = Recording(u, np.zeros_like(u), DT, ("f",), ("x",), initial="zero", hold=hold)
    found = surrogate(record.with_(y=known.simulate(record)), nx=2)[0]
    assert found.hold == hold
    assert found.nrmse(record.with_(y=known.simulate(record))) < 0.01


def test_a_mode_beyond_the_sampling_is_refused():
    one = np.ones((1, 1))
    for pole in (-0.5, 1e-6):
        with pytest.raises(InputError, match="shorter step"):
            to_continuous(pole * one, one, one, one, DT, "zero")


@given(st.integers(0, 10_000))
def test_modes_are_the_system(seed):
    a, b, c, d = random_system(seed)
    found = modes(a, b, c)
    assert [m.second_order for m in found].count(True) == 2 and len(found) == 3
    for w in (0.1, 4.0, 25.0):
        s, total = 1j * w, d.astype(complex)
        for m in found:
            if m.second_order:
                w0, two_zw = abs(m.value), -2 * m.value.real
                q = np.linalg.solve(np.array([[s, -1], [w0**2, s + two_zw]]), m.into)
            else:
                q = m.into / (s - m.value)
            total = total + m.out @ q
        expected = response(a, b, c, d, w)
        assert np.max(np.abs(total - expected)) < 1e-8 * np.max(np.abs(expected))


def test_the_modal_simulator_has_the_response_of_the_system(seed=3):
    a, b, c, d = random_system(seed)
    rng = np.random.default_rng(1)
    record = Recording(rng.standard_normal((300, 2)), np.zeros((300, 2)), DT, ("f", "g"), ("x", "y"))
    simulator = modal_simulator((a, b, c, d), np.array([0.5, -1.0]), record.with_(y=rng.standard_normal((300, 2))))
    sampled = cont2discrete((a, b, c, d), DT)[:4]
    x, expected = np.zeros(5), []
    for u in record.u:
        expected.append(sampled[2] @ x + sampled[3] @ u + [0.5, -1.0])
        x = sampled[0] @ x + sampled[1] @ u
    assert np.max(np.abs(run(simulator, record, substeps=20) - expected)) < 1e-6
    assert simulator.inputs == ("f", "g") and simulator.output_names == ("x", "y")


def simulation(seed=0, m=2000, cubic=0.0, lag=False, hold="zero"):
    """Inputs and outputs of a two-mass chain (0.8 and 3.2 Hz), or of a lag."""
    from pilfr_casadi import Parameter, Simulator

    def dynamics(x, u):
        if lag:
            return dict(a=(u.force - x.a) / 0.4)
        spring = 60 * (x.b - x.a) + cubic * (x.b - x.a) ** 3 + 0.4 * (x.vb - x.va)
        return dict(a=x.va, va=u.force - 60 * x.a - 0.3 * x.va + spring, b=x.vb, vb=-spring / 0.5)

    states = ("a",) if lag else ("a", "va", "b", "vb")
    simulator = Simulator(dynamics, lambda x: dict(position=x.a), states, ("force",), dict(none=Parameter(0.0)))
    u = 5 * multisine(m, f_max=8.0, fs=50.0, rng=np.random.default_rng(seed))
    blank = Recording(u, np.zeros(m), 0.02, ("force",), ("position",), initial="zero", name="sim")
    return blank.with_(y=run(simulator, blank, hold, substeps=8))


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_surrogate_finds_the_modes_of_a_simulation(hold):
    record = simulation(hold=hold)
    simulator, error = surrogate(record)
    assert error < 1e-3
    assert simulator.hold == hold  # a displacement has no direct feed-through, which reveals the hold
    k, m = np.array([[120, -60], [-120, 120.0]]), 2 * np.pi
    expected = np.sqrt(np.sort(np.linalg.eigvals(k))) / m
    found = sorted(float(p.value) for n, p in simulator.parameters.items() if n.endswith(": frequency"))
    assert found == pytest.approx(expected, rel=1e-3)
    names = [p.name for p in simulator.all_ports()]
    assert names == [*(f"mode:{f:.3g} Hz" for f in found), "actuator:force", "sensor:position"]
    p = simulator.parameters[f"mode {found[0]:.3g} Hz: frequency"]
    assert (p.bounds[0], p.bounds[1]) == pytest.approx((0.7 * found[0], 1.3 * found[0]))
    again = run(simulator, record, hold, substeps=8)
    assert np.std(again - record.y) < 2e-3 * np.std(record.y)


def test_simulations_with_different_holds_are_refused():
    with pytest.raises(InputError, match="differ in `hold`"):
        surrogate([simulation(seed).with_(hold=hold) for seed, hold in enumerate(("zero", "linear"))])


def test_a_lag_has_one_real_mode():
    simulator, error = surrogate(simulation(lag=True))
    assert error < 1e-3
    assert float(simulator.parameters["mode 0.398 Hz: rate"].value) == pytest.approx(2.5, rel=1e-3)
    assert simulator.ports[0].name == "mode:0.398 Hz"


@pytest.mark.parametrize("drag", [2.0, 0.1, 0.0])
def test_a_mass_on_a_rail_is_one_mode(drag):
    """Two real eigenvalues, one of them zero, are a displacement and its rate, on which friction can act."""
    a, b, c, d = np.array([[0, 1], [0, -drag]]), np.array([[0.0], [0.5]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
    sampled = cont2discrete((a, b, c, d), 0.01)[:4]
    u = multisine(2000, f_max=5.0, fs=100.0, rng=np.random.default_rng(0))
    y = control.forced_response(control.ss(*sampled, 0.01), U=u).outputs
    record = Recording(u, y, 0.01, ("force",), ("position",), initial="zero", hold="zero")
    simulator, error = surrogate(record)
    assert error < 1e-6 and [p.name for p in simulator.ports] == ["mode:0 Hz"]
    assert simulator.states == ("q1", "v1")
    assert float(simulator.parameters["mode 0 Hz: drag"].value) == pytest.approx(drag, rel=1e-4, abs=1e-4)
    assert float(simulator.parameters["mode 0 Hz: seen in position"].value) == pytest.approx(0.5, rel=1e-4)
    difference = run(simulator, record) - record.y  # where it integrates, a constant belongs to the initial state
    assert np.ptp(difference) < 1e-5 * np.ptp(record.y)


def test_a_simulation_that_is_not_linear_has_a_poor_surrogate():
    error = surrogate(simulation(cubic=3000.0))[1]
    assert error > POOR_SURROGATE and "is not linear" in surrogate_warning(error)
    assert surrogate_warning(POOR_SURROGATE) == ""


def test_diagnose_has_the_same_surrogate():
    assert importlib.import_module("pilfr_casadi.diagnose").surrogate is surrogate


def test_a_state_space_is_a_simulator():
    a, b, c = np.array([[0.0, 1.0], [-90.0, -1.5]]), np.array([[0.0], [2.0]]), np.array([[1.0, 0.0]])
    names = {"inputs": ["force"], "outputs": ["position"], "states": ["pos", "vel"]}
    simulator = as_simulator(control.ss(a, b, c, [[0.0]], **names))
    assert simulator.states == ("pos", "vel") and simulator.inputs == ("force",)
    assert simulator.output_names == ("position",)
    assert {n: float(p.value) for n, p in simulator.parameters.items()} == {"A21": -90.0, "A22": -1.5, "B21": 2.0}
    assert tuple(float(v) for v in simulator.parameters["A21"].bounds) == (-180.0, -45.0)
    record = simulation(m=200)
    expected = control.forced_response(control.sample_system(control.ss(a, b, c, 0), 0.02), U=record.u[:, 0]).outputs
    assert np.max(np.abs(run(simulator, record, substeps=40)[:, 0] - expected)) < 1e-8
    assert [p.name for p in simulator.all_ports()][:2] == ["equation:vel", "actuator:force"]


def test_names_come_from_the_recording_where_the_system_has_none():
    system = control.ss([[-1.0]], [[0.5]], [[3.0]], [[0.0]])
    assert as_simulator(system).inputs == ("u",) and as_simulator(system).output_names == ("y",)
    named = as_simulator(system, [simulation(m=200)])
    assert named.inputs == ("force",) and named.output_names == ("position",)
    assert as_simulator(control.tf([1.5], [1.0, 2.0])).states


def test_an_order_that_is_none_is_refused():
    for nx in (-1, 2.5):
        with pytest.raises(InputError, match="give a whole number, 0 or more"):
            surrogate(simulation(m=200), nx=nx)


def test_a_discrete_state_space_runs_at_its_own_step():
    record = simulation(m=200)
    system = control.ss([[0.9, 0.1], [-0.2, 0.8]], [[0.0], [0.3]], [[1.0, 0.5]], [[0.25]], 0.02)
    expected = control.forced_response(system, U=record.u[:, 0]).outputs
    assert np.max(np.abs(run(as_simulator(system, [record]), record)[:, 0] - expected)) < 1e-10
    with pytest.raises(InputError, match=r"0\.05 s.*0\.02 s"):
        as_simulator(control.ss([[0.9]], [[1.0]], [[1.0]], [[0.0]], 0.05), [record])
    assert as_simulator(system, [record.with_(dt=record.dt * (1 + 5e-5))]).discrete  # written with few digits
    with pytest.raises(InputError, match="resample"):
        as_simulator(system, [record.with_(dt=record.dt * (1 + 5e-4))])


def test_a_fitted_pilfr_runs_as_it_is():
    record = simulation(m=400)
    found = fit(pilfr.PILFR(4, pilfr.PrandtlIshlinskii(pilfr.Play, 3)), record, starts=1)
    simulator = as_simulator(found, [record])
    free = [n for n, p in simulator.parameters.items() if not np.all(p.fixed)]
    assert simulator.discrete and free == ["gain_position", "offset_position"]
    assert np.max(np.abs(run(simulator, record) - found.simulate(record))) < 1e-10
    assert as_simulator(found.model).inputs == ("force",)
    with pytest.raises(InputError, match="resample"):
        as_simulator(found, [record.with_(dt=0.05)])


def test_other_objects_are_no_simulator():
    for thing in (3, "rig.py", pilfr.Simulator, None):
        with pytest.raises(InputError, match=r"Simulator, a control\.StateSpace"):
            as_simulator(thing)
