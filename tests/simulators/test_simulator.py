"""A simulator as a model: against an independent integrator, with laws at every kind of port, in both engines."""

import warnings
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from free_pendulum import simulator as pendulum
from scipy.integrate import solve_ivp

from pilfr_casadi import InputError, Parameter, Port, PrandtlIshlinskii, Recording, Simulator, Stop, multisine, play
from pilfr_casadi.engine import VirtualMachine, compiler, make_engine
from pilfr_casadi.laws import (
    Backlash,
    BoucWen,
    CoulombFriction,
    CubicStiffness,
    Delay,
    LinearStiffness,
    Relaxation,
    Saturation,
    StopHysteresis,
    ViscousDamping,
)
from pilfr_casadi.models import ParameterSet, close_loop
from pilfr_casadi.optimise import GaussNewton, Problem
from pilfr_casadi.simulators import LARGEST_STEP, MOST_SUBSTEPS, choose_substeps, discretise

DT, M = 0.02, 250
VALUES = {"m": 1.3, "k": 90.0, "d": 1.1}


def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m)


def rig(**options):
    ports = (
        Port("ground", lambda p: dict(vel=-1 / p.m), lambda x: x.pos),
        Port("damper on the table", lambda p: dict(vel=-1 / p.m, load=1.0), lambda x, u: x.pos - u.table),
    )
    given = dict(
        dynamics=dynamics,
        outputs=lambda x: dict(position=x.pos, load=0.0),
        states=("pos", "vel"),
        inputs=("force", "table"),
        parameters={n: Parameter(v) for n, v in VALUES.items()},
        ports=ports,
    )
    return Simulator(**{**given, **options})


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    u = np.column_stack([20 * multisine(M, f_max=4.0, fs=1 / DT, rng=rng), 0.3 * multisine(M, 4.0, 1 / DT, rng=rng)])
    return Recording(u, np.zeros((M, 2)), DT, ("force", "table"), ("position", "load"), initial="zero")


def test_an_error_over_several_recordings_and_a_short_print(record):
    simulator = rig()
    measured = record.with_(y=simulator.simulate(record) + [0.01, 0.0] * np.sin(record.t)[:, None])
    one = rig(outputs=lambda x: dict(position=x.pos), ports=())
    alone = measured.with_(y=measured.y[:, :1], outputs=("position",))
    assert 0 < one.nrmse(alone) == pytest.approx(one.nrmse([alone, alone]))
    begun = alone.slice(50, M).with_(initial="estimate")
    assert one.nrmse(begun) < 2 * one.nrmse(alone) < 0.5 * one.nrmse(begun.with_(initial="zero"))
    shown = repr(simulator)
    assert "states pos, vel" in shown and "  k = 90" in shown and "inputs force, table" in shown
    with pytest.raises(InputError, match="no output 'load'"):
        simulator.nrmse(alone)


def test_a_law_is_shown_in_the_units_of_its_port():
    port = Port("ground", dict(vel=-1.0), lambda x: x.pos, unit="N", across_unit="m")
    simulator = rig(ports=port).with_element("ground", CubicStiffness({"k_3": 2.0}))
    assert "ground: cubic_stiffness" in repr(simulator) and "ground.k_3 = 2 N/m^3" in repr(simulator)


def run(simulator, record, hold="zero", substeps=1, state=None, engine=None):
    model = discretise(simulator, record.dt, hold, substeps)
    state = np.zeros(model.n_state) if state is None else state
    made = VirtualMachine(model) if engine is None else make_engine(model, engine)
    return made.simulate(model.drive(record), model.parameters.start, np.asarray(state, dtype=float))[0]


def reference(rates, record, hold, n=2, seen=lambda t, s, u: [s[0], 0.0], start=None):
    """The same equations by `solve_ivp`, sample by sample."""
    s, out = np.zeros(n) if start is None else np.array(start, dtype=float), []
    for k, u in enumerate(record.u):
        after = record.u[min(k + 1, len(record) - 1)] if hold == "linear" else u
        out.append(seen(k * DT, s, u))

        def f(t, x, k=k, u=u, after=after):
            return rates(t, x, u + (after - u) * (t - k * DT) / DT)

        s = solve_ivp(f, (k * DT, (k + 1) * DT), s, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return np.array(out)


def linear_rates(t, s, u, w=0.0):
    return [s[1], (u[0] - VALUES["k"] * s[0] - VALUES["d"] * s[1] - w) / VALUES["m"]]


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_the_linear_rig_is_solve_ivps(record, hold):
    expected = reference(linear_rates, record, hold)
    errors = [np.max(np.abs(run(rig(), record, hold, n) - expected)) for n in (1, 2, 4, 8)]
    assert errors[-1] < 1e-7 * np.max(np.abs(expected))
    for coarse, fine in pairwise(errors):  # fourth order: half the step, a sixteenth of the error
        assert 12 < coarse / fine < 20
    other = {"zero": "linear", "linear": "zero"}[hold]
    assert np.max(np.abs(run(rig(), record, other, 8) - expected)) > 1e-3 * np.max(np.abs(expected))


def test_time_reaches_the_equations(record):
    def shaken(x, u, p, t):
        return dict(pos=x.vel, vel=dynamics(x, u, p)["vel"] + 5 * ca.sin(3 * t) / p.m)

    expected = reference(lambda t, s, u: linear_rates(t, s, u, -5 * np.sin(3 * t)), record, "zero")
    assert np.max(np.abs(run(rig(dynamics=shaken), record, substeps=8) - expected)) < 1e-7


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_law_inside_the_dynamics(record, hold):
    closed = rig().with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    expected = reference(lambda t, s, u: linear_rates(t, s, u, 700 * s[0] ** 3), record, hold)
    assert np.max(np.abs(run(closed, record, hold, 16) - expected)) < 1e-7


def test_a_class_in_place_of_a_law_is_refused():
    with pytest.raises(InputError, match=r"class CubicStiffness .* such as CubicStiffness\(\).at\({'k_3': 1.0}\)"):
        rig().with_element("ground", CubicStiffness)


def test_a_law_with_equations_of_its_own(record):
    law = Relaxation(values={"k_v": 60.0, "T": 0.2})
    expected = reference(
        lambda t, s, u: [*linear_rates(t, s, u, 60 * (s[0] - s[2])), (s[0] - s[2]) / 0.2], record, "zero", n=3
    )
    assert np.max(np.abs(run(rig().with_element("ground", law), record, substeps=8) - expected)) < 1e-7
    law = BoucWen(values={"k_h": 80.0, "q_0": 0.1, "s": 0.6, "n": 1.0})

    def hysteretic(t, s, u):
        size = (abs(s[2] / 0.1) + 1e-9) ** 1.0
        flow = s[1] * (1 - 0.4 * size) - 0.6 * abs(s[1]) * np.sign(s[2]) * size
        return [*linear_rates(t, s, u, 80 * s[2]), flow]

    expected = reference(hysteretic, record, "zero", n=3)
    assert np.max(np.abs(run(rig().with_element("ground", law), record, substeps=16) - expected)) < 1e-3


def test_a_port_across_an_input_into_an_output(record):
    """A damper between the mass and a moving table, whose force is an output: its rate sees the table's speed."""
    law = CoulombFriction(values={"F_c": 2.0, "v_0": 0.3})
    slope = np.diff(record.u[:, 1], append=record.u[-1, 1]) / DT

    def force(t, s):
        return 2 * np.tanh((s[1] - slope[min(int(t / DT + 1e-9), M - 1)]) / 0.3)

    expected = reference(
        lambda t, s, u: linear_rates(t, s, u, force(np.floor(t / DT + 1e-7) * DT, s)),
        record,
        "linear",
        seen=lambda t, s, u: [s[0], force(t, s)],
    )
    found = run(rig().with_element("damper on the table", law), record, "linear", 16)
    assert np.max(np.abs(found - expected)[1:-1]) < 1e-5 * np.max(np.abs(expected))


def test_series_at_actuator_and_sensor(record):
    plain = run(rig(), record, substeps=4)
    clipped = record.with_(u=np.column_stack([np.clip(record.u[:, 0], -9, 9), record.u[:, 1]]))
    limited = rig().with_element("actuator:force", Saturation(values={"L": 9.0}))
    assert np.allclose(run(limited, record, substeps=4), run(rig(), clipped, substeps=4), rtol=0, atol=1e-13)
    seen = run(rig().with_element("sensor:position", Saturation(values={"L": 0.05})), record, substeps=4)
    assert np.allclose(seen[:, 0], np.clip(plain[:, 0], -0.05, 0.05), rtol=0, atol=1e-13)


def test_parallel_laws_add_and_series_laws_follow_each_other(record):
    one, two = CubicStiffness(values={"k_3": 300.0}), CubicStiffness(values={"k_3": 400.0})
    both = rig().with_element("ground", one).with_element("ground", two)
    assert tuple(both.parameters)[-2:] == ("ground.k_3", "ground#2.k_3")
    whole = rig().with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    assert np.allclose(run(both, record), run(whole, record), rtol=0, atol=1e-13)
    first, second = Saturation(values={"L": 9.0}), Backlash(values={"r": 2.0})
    closed = rig().with_element("actuator:force", first).with_element("actuator:force", second)
    u, q = np.clip(record.u[:, 0], -9, 9), 0.0
    for k, value in enumerate(u):
        u[k] = q = play(value, q, 2.0)
    moved = record.with_(u=np.column_stack([u, record.u[:, 1]]))
    assert np.allclose(run(closed, record), run(rig(), moved), rtol=0, atol=1e-12)


def test_two_laws_at_two_ports(record):
    closed = rig().with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    closed = closed.with_element("sensor:position", Saturation(values={"L": 0.1}))
    expected = reference(
        lambda t, s, u: linear_rates(t, s, u, 700 * s[0] ** 3),
        record,
        "zero",
        seen=lambda t, s, u: [np.clip(s[0], -0.1, 0.1), 0.0],
    )
    assert np.max(np.abs(run(closed, record, substeps=16) - expected)) < 1e-7


def test_a_delay_of_which_nothing_says_how_long_it_is_is_refused(record):
    for law in (Delay(), Delay(limits={"T": (0.0, np.inf)})):
        with pytest.raises(InputError, match=r"'sensor:position' yet: give the time that it starts at"):
            rig().with_element("sensor:position", law)
    late = rig().with_element("sensor:position", Delay().at({"T": 40 * DT}))  # more than the screen tries
    expected = np.r_[np.zeros(40), run(rig(), record)[:-40, 0]]
    assert np.max(np.abs(run(late, record)[:, 0] - expected)) < 1e-12


@pytest.mark.parametrize(
    ("port", "steps"), [("sensor:position", 3.0), ("sensor:position", 2.25), ("actuator:force", 2.0)]
)
def test_a_delay_is_as_long_as_it_says(record, port, steps):
    law = Delay(values={"T": steps * DT}, limits={"T": (0.0, 0.2)})
    found, plain = run(rig().with_element(port, law), record)[:, 0], run(rig(), record)[:, 0]
    if port.startswith("sensor"):
        expected = np.interp(np.arange(M) - steps, np.arange(M), plain, left=0.0)
    else:
        late = np.r_[np.zeros(int(steps)), record.u[: -int(steps), 0]]
        expected = run(rig(), record.with_(u=np.column_stack([late, record.u[:, 1]])))[:, 0]
    assert np.max(np.abs(found - expected)[4:]) < 1e-12


def test_a_delay_between_samples_is_that_of_a_held_input(record):
    steps = 1.3
    law = Delay(values={"T": steps * DT}, limits={"T": (0.0, 0.2)})

    def late(t, s, u):
        k = int(np.floor(t / DT - steps + 1e-9))
        return linear_rates(t, s, record.u[k] if k >= 0 else np.zeros(2))

    s, expected = np.zeros(2), []
    for k in range(M):
        expected.append(s[0])
        edges = k * DT, (k + steps % 1) * DT, (k + 1) * DT
        for a, b in pairwise(edges):
            now = lambda t, x, at=(a + b) / 2: late(at, x, None)  # noqa: E731
            s = solve_ivp(now, (a, b), s, rtol=1e-10, atol=1e-12).y[:, -1]
    closed, size = rig().with_element("actuator:force", law), np.max(np.abs(expected))
    errors = [np.max(np.abs(run(closed, record, substeps=n)[:, 0] - expected)) / size for n in (1, law.substeps)]
    assert errors[1] < 2e-4 and errors[0] > 3 * errors[1]


def test_a_delay_between_samples_is_that_of_an_interpolated_input(record):
    steps, k = 1.3, np.arange(M)
    u = record.u[:, :1] * np.minimum(k / 20, 1)[:, None]  # from nothing, as the register begins
    given = record.with_(u=np.column_stack([u, np.zeros(M)]), hold="linear")

    def late(t, s):
        return linear_rates(t, s, [np.interp(t / DT - steps, k, u[:, 0], left=0.0), 0.0])

    s, expected = np.zeros(2), []
    for i in range(M):
        expected.append(s[0])
        for a, b in pairwise((i * DT, (i + steps % 1) * DT, (i + 1) * DT)):
            s = solve_ivp(late, (a, b), s, rtol=1e-10, atol=1e-12).y[:, -1]
    law = Delay(values={"T": steps * DT}, limits={"T": (0.0, 0.2)})
    found = run(rig().with_element("actuator:force", law), given, "linear", law.substeps)[:, 0]
    assert np.max(np.abs(found - expected)) < 5e-4 * np.max(np.abs(expected))


def test_one_way_to_close_a_loop(record):
    """`close_loop` puts a law into a simulator's port, and the layer of the PI-LFR as well."""
    law = CubicStiffness(values={"k_3": 700.0})
    assert np.array_equal(run(close_loop(rig(), law, "ground"), record), run(rig().with_element("ground", law), record))
    w, r = np.full(6, 15.0), np.linspace(0.01, 0.2, 6)
    layer = PrandtlIshlinskii(Stop, 6)
    closed = close_loop(rig(), layer, port="ground")
    own = closed.parameters.change(**{"ground.w": {"value": w[None]}, "ground.r": {"value": r[None]}})
    found, expected = run(closed.with_parameters(own), record), run(hysteretic(), record)
    assert np.max(np.abs(found - expected)) < 1e-12 * np.max(np.abs(expected))
    with pytest.raises(InputError, match="port"):
        close_loop(rig(), law)
    with pytest.raises(InputError, match="channels"):
        close_loop(rig(), PrandtlIshlinskii(Stop, 6, channels=2), port="ground")


def hysteretic(law=None):
    law = law or StopHysteresis(values={"w": np.full(6, 15.0), "r": np.linspace(0.01, 0.2, 6)})
    return rig().with_element("ground", law)


def test_memory_inside_the_stages(record):
    """Stops on a very fine grid against a memory that moves once a step."""
    w, r = np.full(6, 15.0), np.linspace(0.01, 0.2, 6)
    s, state, h = np.zeros(6), np.zeros(2), DT / 400
    expected = []
    for u in record.u:
        expected.append(state[0])
        for _ in range(400):
            s = np.clip(s, state[0] - r, state[0] + r)
            v = state[1] + h * linear_rates(0, state, u, w @ (state[0] - s))[1]
            state = np.array([state[0] + h * v, v])
    errors = [np.max(np.abs(run(hysteretic(), record, substeps=n)[:, 0] - expected)) for n in (1, 8)]
    assert errors[1] < 2e-3 * np.max(np.abs(expected)) and errors[0] < 2e-2 * np.max(np.abs(expected))


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("what", ["linear", "memory", "series", "flow", "time"])
def test_both_engines_agree(record, hold, what):
    simulator = {
        "linear": rig,
        "memory": hysteretic,
        "series": lambda: rig().with_element("actuator:force", Backlash(values={"r": 2.0})),
        "flow": lambda: rig().with_element("ground", BoucWen(values={"k_h": 80.0, "q_0": 0.1, "s": 0.6, "n": 1.3})),
        "time": lambda: rig(dynamics=lambda x, u, p, t: dict(pos=x.vel, vel=dynamics(x, u, p)["vel"] + ca.sin(t))),
    }[what]()
    one, other = (run(simulator, record, hold, 2, engine=e) for e in ("c", "vm"))
    assert np.max(np.abs(one - other)) < 1e-10
    model = discretise(simulator, DT, hold, 2)
    costs = [Problem(model, record, engine=e, scale=np.ones(2)) for e in ("c", "vm")]
    jacobians = [p.normal_equations(p.start) if hasattr(p, "normal_equations") else p.cost(p.start) for p in costs]
    for a, b in zip(np.atleast_1d(jacobians[0]), np.atleast_1d(jacobians[1]), strict=True):
        assert np.allclose(np.asarray(a, dtype=float), np.asarray(b, dtype=float), rtol=1e-8, atol=1e-10)


def test_a_static_device_and_its_memory():
    device = Simulator(
        dynamics=lambda: {},
        outputs=lambda u, p: dict(travel=p.gain * u.volt),
        inputs=("volt",),
        parameters=dict(gain=Parameter(0.4)),
    )
    rng = np.random.default_rng(1)
    u = 10 * multisine(200, f_max=5.0, fs=50.0, rng=rng)
    record = Recording(u, np.zeros(200), DT, ("volt",), ("travel",), initial="zero")
    assert np.array_equal(run(device, record)[:, 0], 0.4 * u)
    q, expected = 0.0, []
    for value in u:
        q = play(value, q, 3.0)
        expected.append(0.4 * q)
    closed = device.with_element("actuator:volt", Backlash(values={"r": 3.0}))
    for hold in ("zero", "linear"):
        assert np.max(np.abs(run(closed, record, hold)[:, 0] - expected)) < 1e-12


def test_the_memory_at_the_first_sample_is_estimated(record):
    law = Backlash(values={"r": 6.0})
    truth = [0.02, -0.3, 5.0]
    closed = rig().with_element("actuator:force", law)
    y = run(closed, record, state=truth)
    held = closed.with_parameters({k: replace(p, fixed=True) for k, p in closed.parameters.items()})
    model = discretise(held, DT)
    problem = Problem(model, record.with_(y=y, initial="estimate"), scale=np.ones(2))
    theta = problem.start.copy()
    theta[-1] = 3.0
    solution = GaussNewton(max_iterations=100).solve(problem, theta)
    found = problem.first_states(solution.theta)[0]
    assert found[:2] == pytest.approx(truth[:2], abs=1e-6)
    assert np.max(np.abs(run(closed, record, state=found) - y)) < 1e-7


def test_substeps_follow_the_fastest_eigenvalue(record):
    counts = [choose_substeps(rig(parameters={**rig().parameters, "k": Parameter(k)}), [record]) for k in (90.0, 9e3)]
    assert counts[0] == 1 and counts[1] == int(np.ceil(np.sqrt(9e3 / 1.3) * DT / LARGEST_STEP))
    too_fast = rig(parameters={**rig().parameters, "k": Parameter(90.0 * (MOST_SUBSTEPS * 50) ** 2)})
    with pytest.raises(InputError, match="too fast"):
        choose_substeps(too_fast, [record])


@pytest.mark.parametrize(
    ("equations", "said"),
    [
        (lambda x, u: {"a": x.b, "b": u.f - ca.log(x.a)}, r"derivative of the state 'b' .* at a = 0, b = 0, f = 2,"),
        (lambda x, u, p: {"a": x.b, "b": (u.f - x.a) / p.m}, r"derivative of the state 'b' .* at .*, m = 0;"),
        (lambda x, u: {"a": -1 / x.b, "b": u.f}, r"derivative of the state 'a' .* at a = 0, b = 0, f = 2"),
        (lambda x, u: {"a": 0.1 * x.b, "b": -1 - ca.sqrt(x.b)}, r"derivative of the state 'b' .*, b = -0"),
        (
            lambda x, u: {"a": x.b, "b": -ca.sqrt(1e9 * x.b)},
            r"slope of the derivative of 'b' by the state 'b'.* b = 0",
        ),
    ],
)
def test_what_is_not_finite_is_named(equations, said):
    wrong = Simulator(equations, lambda x: {"y": x.a}, ("a", "b"), ("f",), {"m": Parameter(0.0)})
    recording = Recording(np.full(50, 2.0), np.arange(50.0), 0.1, ("f",), ("y",))
    with pytest.raises(InputError, match=said) as error:
        choose_substeps(wrong, [recording])
    assert str(error.value).endswith(".") and ". " not in str(error.value)


def test_a_logarithm_is_looked_at_where_the_recording_begins():
    tank = Simulator(lambda x, u: {"a": u.f - ca.log(x.a)}, lambda x: {"y": x.a}, ("a",), ("f",))
    recording = Recording(np.full(50, 2.0), np.arange(50.0), 0.1, ("f",), ("y",), initial=np.array([3.0]))
    assert choose_substeps(tank, [recording]) == 1


def test_a_discrete_simulator_steps_once_a_sample(record):
    a = np.array([[0.9, 0.2], [-0.3, 0.8]])
    simulator = rig(
        dynamics=lambda x, u: dict(pos=0.9 * x.pos + 0.2 * x.vel, vel=-0.3 * x.pos + 0.8 * x.vel + u.force),
        discrete=True,
        ports=(),
    )
    x, expected = np.zeros(2), []
    for u in record.u:
        expected.append(x[0])
        x = a @ x + [0.0, u[0]]
    assert np.max(np.abs(run(simulator, record)[:, 0] - expected)) < 1e-10
    assert [p.name for p in simulator.all_ports()][:2] == ["actuator:force", "actuator:table"]


def test_equation_ports_stand_in_for_declared_ones(record):
    free = rig(ports=())
    names = [p.name for p in free.all_ports()]
    assert names[:2] == ["equation:vel", "actuator:force"]  # that of the position only defines the speed
    cubic = free.with_element("equation:vel", CubicStiffness(values={"k_3": 700.0 / 1.3}))  # z is the position there
    whole = rig().with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    assert np.allclose(run(cubic, record), run(whole, record), rtol=0, atol=1e-12)


def test_equation_ports_have_the_units_of_outputs_that_show_their_coordinate():
    free = rig(ports=(), units={"position": "mm", "force": "N"})
    shown = {p.name: (p.unit, p.across_unit, p.domain) for p in free.all_ports()}
    assert shown["equation:vel"] == ("mm/s^2", "mm", "mechanical")
    oven = Simulator(
        lambda x, u: dict(air=u.heat - x.air + x.wall, wall=x.air - x.wall),
        lambda x: dict(temperature=x.air),
        states=("air", "wall"),
        inputs=("heat",),
        parameters={},
        units={"temperature": "degC"},
    )
    assert {p.domain for p in oven.all_ports()} == {"thermal"}
    assert not oven.port("equation:wall").admits(CoulombFriction)


def test_misplaced_laws_are_refused():
    with pytest.raises(InputError, match="in series"):
        rig().with_element("actuator:force", CubicStiffness())
    with pytest.raises(InputError, match="in parallel"):
        rig().with_element("ground", Saturation())
    with pytest.raises(InputError, match="no port 'roof'"):
        rig().with_element("roof", CubicStiffness())
    assert ParameterSet(dict(rig().parameters)).size == 3


def test_a_port_with_the_name_of_a_built_in_one_is_refused():
    (port,) = rig().ports[:1]
    with pytest.raises(InputError, match="'actuator:force' is declared"):
        rig(ports=(replace(port, name="actuator:force"),))


def test_one_port_needs_no_tuple(record):
    (port,) = rig().ports[:1]
    alone = rig(ports=port)
    assert [p.name for p in alone.ports] == ["ground"]
    stiff = CubicStiffness(values={"k_3": 700.0})
    assert np.array_equal(
        run(alone.with_element("ground", stiff), record), run(rig().with_element("ground", stiff), record)
    )


def with_mount(into, across=lambda x: x.pos):
    return rig(ports=Port("mount", into, across))


def test_a_numpy_function_of_a_symbol_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rig(outputs=lambda x: dict(position=np.sign(x.pos), load=x.vel)).output_names == ("position", "load")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Port("mount", {"vel": -1.0}, across="x1"), "`across` of port 'mount' is 'x1'; give a function"),
        (lambda: Port("mount", {"vel": -1.0}, lambda x: x.pos, rate="x2"), "`rate` of port 'mount' is 'x2'"),
        (
            lambda: Port("mount", "vel", lambda x: x.pos),
            "`into` of port 'mount' is 'vel'; give {state or output: factor}",
        ),
        (lambda: Port(3, {"vel": -1.0}, lambda x: x.pos), "A port's name is 3; give a text"),
        (lambda: Port("mount", {"vel": -1.0}, lambda x: x.pos, unit=1), "`unit` of port 'mount' is 1; give plain text"),
        (lambda: rig(ports="ground"), "The simulator's ports are 'ground'; give Port"),
        (lambda: rig(ports=[("ground", None)]), "ports are .* give Port"),
        (lambda: rig(ports=5), "ports are 5; give Port"),
        (lambda: rig(dynamics={"pos": 1}), "The simulator's dynamics are {'pos': 1}; give a function"),
        (lambda: rig(outputs=None), "The simulator's outputs are None; give a function"),
        (lambda: rig(states=(1, 2)), r"The simulator's states are \(1, 2\); give their names"),
        (lambda: rig(inputs=7), "The simulator's inputs are 7; give their names"),
        (lambda: rig(parameters=[1.0]), r"parameters are \[1.0\]; give {name: Parameter"),
        (lambda: rig(parameters={"m": 1.0}), "parameter 'm' is 1.0; give Parameter"),
        (lambda: rig(units="N"), "units are 'N'; give {name: unit}"),
        (lambda: rig(units={"position": 5}), "units are {'position': 5}; give {name: unit}"),
        (lambda: rig(units={"x_2": "m"}), "The simulator has no 'x_2' among its inputs and outputs; they are force, "),
        (lambda: with_mount(lambda x: {"vel": np.nan}), "'mount: into vel' holds NaN"),
        (lambda: with_mount({"vel": 1.0}, lambda x: x.pos * np.nan), "'mount: across' holds NaN"),
        (lambda: rig(dynamics=dict), "dynamics is <class 'dict'>; give a function"),
    ],
)
def test_wrong_types_get_one_sentence(make, says):
    with pytest.raises(InputError, match=says) as error:
        make()
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


def test_a_simulator_simulates_and_scores_a_recording(record):
    own = rig().with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    y = own.simulate(record)
    np.testing.assert_allclose(y, run(own, record, substeps=choose_substeps(own, [record])), rtol=0, atol=1e-13)
    given = record.with_(y=y + 0.01 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape), skip=10)
    swapped = given.with_(
        u=given.u[:, ::-1], inputs=given.inputs[::-1], y=given.y[:, ::-1], outputs=given.outputs[::-1]
    )
    moving = rig(outputs=lambda x: dict(position=x.pos, load=x.vel))
    measured = record.with_(y=moving.simulate(record))
    assert moving.nrmse(measured) == 0.0
    assert 0.1 < rig(outputs=moving.outputs, parameters={**rig().parameters, "k": Parameter(80.0)}).nrmse(measured) < 2
    np.testing.assert_array_equal(own.simulate(swapped), y)
    more = given.with_(u=np.column_stack([given.u, given.u]), inputs=(*given.inputs, "unused1", "unused2"))
    np.testing.assert_array_equal(own.simulate(more), y)
    with pytest.raises(InputError, match="has no outputs, and the simulator's observer reads them"):
        replace(own, observer=np.zeros((2, 2))).simulate(given.with_(y=np.empty((len(given), 0)), outputs=(), units={}))
    started = rig().simulate(record.with_(initial=np.array([0.2, 0.0])))
    assert started[0, 0] == 0.2
    with pytest.raises(InputError, match="has the inputs force, valve; the simulator has force, table"):
        own.simulate(record.with_(inputs=("force", "valve")))
    with pytest.raises(InputError, match="has no output 'load'; it has position, weight"):
        own.nrmse(record.with_(outputs=("position", "weight")))
    with pytest.raises(InputError, match="A list was given; give a Recording"):
        own.simulate([record])


def test_other_values_check_no_equation_again(record):
    calls = []

    def counted(x, u, p):
        calls.append(1)
        return dynamics(x, u, p)

    simulator = rig(dynamics=counted)
    simulator.all_ports()  # finds the force of the inputs in the equations
    before = len(calls)
    stiffer = simulator.with_parameters({**simulator.parameters, "k": Parameter(95.0)})
    law = stiffer.with_element("ground", CubicStiffness(values={"k_3": 700.0}))
    assert len(calls) == before and law.without_element().elements == ()
    whole = rig(parameters={**rig().parameters, "k": Parameter(95.0)})
    expected = run(whole.with_element("ground", CubicStiffness(values={"k_3": 700.0})), record)
    assert np.array_equal(run(law, record), expected)


def test_other_bounds_free_a_parameter():
    own = {"k": Parameter(2.0, "N/m", (1, 3), fixed=True), "d": Parameter([1.0, 2.0], bounds=(0, 5))}
    simulator = Simulator(lambda x, p: {"x": -p.k * x.x - p.d[0]}, lambda x: {"y": x.x}, ("x",), parameters=own)
    changed = simulator.with_bounds({"k": (0.5, 50), "d": (0, 9)}).parameters
    assert changed["k"].bounds == (0.5, 50) and not changed["k"].fixed and changed["k"].unit == "N/m"
    assert np.all(changed["d"].bounds[1] == 9) and simulator.parameters["k"].fixed
    with pytest.raises(InputError, match=r"'d' is 2, outside of its bounds 0 to 1\.5; widen them"):
        simulator.with_bounds({"d": (0, 1.5)})
    with pytest.raises(InputError, match="bounds 3 to 1 of 'k' are infeasible"):
        simulator.with_bounds({"k": (3, 1)})
    with pytest.raises(InputError, match="There is no parameter 'm'; the simulator has k, d"):
        simulator.with_bounds({"m": (0, 1)})


def test_a_free_motion_of_three_samples_is_simulated():
    """A recording that is too short to show how fast the equations are along it."""
    short = Recording(np.empty((3, 0)), np.empty((3, 0)), 1.0, initial=[1.0, 0.0])
    assert np.all(np.abs(pendulum.simulate(short)) < 1.1)


def test_a_band_limited_input_is_followed_between_its_samples():
    """Two sines of a lag, one of them with three samples a period, in closed form."""
    lag = Simulator(
        lambda x, u, p: {"y": (u.u - x.y) / p.T}, lambda x: {"y": x.y}, ("y",), ("u",), {"T": Parameter(0.3)}
    )
    t, waves = 0.1 * np.arange(400), ((3.2, 0.0), (0.7, 1.0))
    u = sum(np.sin(2 * np.pi * f * t + phase) for f, phase in waves)
    y = sum(np.imag(np.exp(1j * (2 * np.pi * f * t + phase)) / (1 + 2j * np.pi * f * 0.3)) for f, phase in waves)
    off = {}
    for hold in ("zero", "linear", "band-limited"):
        r = Recording(u, y, 0.1, hold=hold, initial=[y[0]])
        off[hold] = lag.nrmse(r)
    assert off["band-limited"] < 0.01 < 0.05 < off["linear"] < off["zero"]
    same = replace(lag, hold="band-limited")
    assert same.nrmse(r.with_(hold=None)) == off["band-limited"]


@pytest.mark.parametrize(("unit", "damping", "stiffness"), [("", "N/[z]", "N/([z] s)"), ("rpm", "N/rpm", "N/(rpm s)")])
def test_laws_at_a_speed_are_written_in_its_position(unit, damping, stiffness):
    """Whatever the unit of the speed: a force over a position has another unit than one over the speed."""
    speed = lambda x: x.w  # noqa: E731
    port = Port("shaft", {"w": -1.0}, across=speed, rate=speed, unit="N", across_unit=unit)
    own = Simulator(lambda x, u, p: {"w": u.f - x.w}, lambda x: {"w": x.w}, states=("w",), inputs=("f",), ports=port)
    placed = own.with_element("shaft", ViscousDamping()).with_element("shaft", LinearStiffness())
    assert [p.unit for p in placed.readable_parameters().values()] == [damping, stiffness]


@pytest.mark.parametrize("index", [-1, 2, "a"])
def test_a_law_has_no_place_beyond_the_others(index):
    lag = Simulator(lambda x, u: {"v": u.f - x.v}, lambda x: {"v": x.v}, states=("v",), inputs=("f",))
    one = lag.with_element("equation:v", LinearStiffness())
    assert one.with_element("equation:v", ViscousDamping(), 0).elements[0].law.id == "viscous_damping"
    with pytest.raises(InputError, match="whole number from 0 to 1"):
        one.with_element("equation:v", ViscousDamping(), index)
