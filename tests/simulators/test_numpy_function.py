"""NumPy functions as simulators: the equations agree with the function, or one sentence says why not."""

import contextlib
import functools
import itertools
import math
import random
from math import copysign

import casadi as ca
import cloudpickle
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator, RegularGridInterpolator, interp1d, make_interp_spline
from scipy.optimize import brentq

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Parameter, Port, Simulator
from pilfr_casadi.simulators import Numeric, from_function, load_simulator

K = np.array([[3.0, -1.0], [-1.0, 2.0]])
PARAMETERS = {
    "m": Parameter(2.0, unit="kg", fixed=True),
    "k": Parameter(1100.0, unit="N/m", bounds=(500, 3000)),
    "d": Parameter(15.0, unit="N s/m", bounds=(0, 100)),
}
GROUND = Port("ground", lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel, "N", "m")
NAMES = {"states": ("pos", "vel"), "inputs": "force", "parameters": PARAMETERS}


def rhs(t, x, u, p):
    dx = np.zeros(2)
    dx[0] = x[1]
    dx[1] = (u[0] - p["k"] * x[0] - p["d"] * x[1]) / p["m"]
    return dx


def symbolic():
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": (u.force - p.k * x.pos - p.d * x.vel) / p.m},
        lambda x: {"pos": x.pos},
        ports=GROUND,
        **{**NAMES, "inputs": ("force",)},
    )


def equations(function):
    """The equations of a function of two states, one input and k as a `casadi.Function`."""
    made = from_function(function, ("a", "b"), states=("a", "b"), inputs="f", parameters={"k": Parameter(0.7)})
    x, u, p, t = made.symbols()
    return ca.Function("f", [t, x.a, x.b, u.f, p.k], [made.derivatives(x, u, p, t)])


def spring(v, k):
    """A helper of the functions below, found by its name."""
    if v > 0.5:
        return k * (v - 0.5)
    return k * (v + 0.5) if v < -0.5 else 0.0


def mass_matrix(t, x, u, p):
    M = np.array([[2.0, np.cos(x[0])], [np.cos(x[0]), 1.5]])
    return np.linalg.solve(M, np.array([u[0], p["k"] * np.sin(x[1])]))


def masked(t, x, u, p):
    y = np.zeros_like(x)
    y[x > 0] = 1.0
    y[1] += p["k"] * x[0]
    return y


def table(t, x, u, p):
    return [np.interp(x[0], [-1.0, 0.0, 2.0], [1.0, 0.0, 5.0]), np.interp(t, [0, 10], [0, 1]) + u[0]]


LEVELS = np.array([-2.0, -0.5, 0.0, 1.0, 2.5])
LINE = interp1d(LEVELS, LEVELS**3, fill_value="extrapolate")
HELD = interp1d(LEVELS, LEVELS**3, bounds_error=False, fill_value=(-8.0, 9.0))
SPLINE, PCHIP = CubicSpline(LEVELS, np.sin(LEVELS)), PchipInterpolator(LEVELS, np.sin(LEVELS))
PERIODIC = CubicSpline([0.0, 1.0, 2.0, 3.0], [1.0, 2.0, 0.5, 1.0], bc_type="periodic")
SMOOTH = make_interp_spline(LEVELS, np.cos(LEVELS))


class Plant:
    stiffness = 4.0
    table = LINE

    def __call__(self, t, x, u, p):
        dx = np.zeros(2)
        dx[0], dx[1] = x[1], self.force(x[0]) + p["k"] * math.tanh(u[0])
        return dx

    def force(self, q):
        return -self.stiffness * q if q > 0 else self.table(q)


FUNCTIONS = {
    "list": lambda t, x, u, p: [x[1], u[0] - p["k"] * x[0] ** 3],
    "matrix": lambda t, x, u, p: -K @ x + np.array([0, 1]) * u,
    "column": lambda t, x, u, p: (-K @ x.reshape(2, 1)) * p["k"],
    "sums": lambda t, x, u, p: [np.sum(x * x), np.linalg.norm(x) + np.mean(K * x)],
    "functions": lambda t, x, u, p: [np.sin(t) * np.exp(-abs(x[0])), np.arctan2(x[1], u[0]) + np.log10(1 + x[0] ** 2)],
    "mathematics": lambda t, x, u, p: [math.sin(x[0]), copysign(p["k"], x[1]) * math.sqrt(abs(u[0]))],
    "where": lambda t, x, u, p: np.where(np.abs(x) > 0.3, x, 2 * x) * np.sign(u[0]),
    "limits": lambda t, x, u, p: [np.clip(x[0], -1, 1), np.maximum(0, x[1]) + np.minimum(x[0], u[0])],
    "methods": lambda t, x, u, p: [np.std(x) + np.var(x), x.clip(-1, 1)[0] + x.clip(max=u[0])[1]],
    "branches": lambda t, x, u, p: [max(0, x[0]), spring(x[0] - x[1], p["k"]) if u[0] > 0 else min(x[1], 1)],
    "conditions": lambda t, x, u, p: [1.0 if 0 < x[0] < 1 or x[1] > u[0] else -1.0, (x[0] > x[1]) & (u[0] < 1)],
    "floats": lambda t, x, u, p: np.array([float(x[0]), float(len(x)) * u.astype(float)[0]], dtype=float),
    "mass matrix": mass_matrix,
    "boolean index": masked,
    "tables": table,
    "tables of SciPy": lambda t, x, u, p: [LINE(x[0]) + HELD(x[1]), SPLINE(x[0]) * PERIODIC(x[1])],
    "arrays in a table": lambda t, x, u, p, table=PCHIP: table(x) + SMOOTH(x[0]),
    "guard": lambda t, x, u, p: x if np.all(np.isfinite(x)) else None,
    "method": Plant().__call__,
    "object": Plant(),
}


@pytest.mark.parametrize("case", FUNCTIONS)
def test_equations_are_those_of_the_function(case):
    function, traced = FUNCTIONS[case], equations(FUNCTIONS[case])
    rng = np.random.default_rng(1)
    for _ in range(100):
        t, k, u, x = rng.uniform(0, 9), rng.uniform(0.5, 2), rng.normal(size=1), rng.normal(size=2)
        expected = np.ravel(np.asarray(function(t, x, u, {"k": k}), dtype=float))
        assert np.allclose(traced(t, *x, *u, k).full().ravel(), expected, rtol=1e-12, atol=1e-13)


@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.1.0", reason="the names min and max are newer")
def test_limits_have_two_names():
    traced = equations(lambda t, x, u, p: [np.clip(x[0], min=-1, max=u[0]), np.clip(x[1], a_min=-1, a_max=None)])
    assert traced(0, -3, -3, 2, 1).full().ravel().tolist() == [-1, -1]
    assert traced(0, 3, 3, 2, 1).full().ravel().tolist() == [2, 3]


def force(t):
    return 10 * np.interp(t, [0, 5, 10], [0, 1, -1])


def ivp_with_force(t, y, force, m, k, d):
    pos, vel = y
    return [vel, (force - k * pos - d * vel) / m]


def ivp_with_all_inputs(t, y, u, m, k=1.0, d=1.0, note="not a parameter"):
    return np.array([y[1], (u[0] - k * y[0] - d * y[1]) / m])


def ivp_with_mapping(t, y, p, force):
    return [y[1], (force - p["k"] * y[0] - p["d"] * y[1]) / p["m"]]


@pytest.mark.parametrize("numeric", [None, Numeric()])
@pytest.mark.parametrize(
    "function",
    [
        ivp_with_force,
        ivp_with_all_inputs,
        ivp_with_mapping,
        functools.partial(ivp_with_force, m=PARAMETERS["m"].value),
        lambda *given: rhs(*given),
        lambda time, state, forces, values: rhs(time, state, forces, values),
        lambda time, state, u, values: rhs(time, state, u, values),
    ],
    ids=["names", "inputs in u", "parameters in p", "partial", "open-ended", "positions", "one position"],
)
def test_arguments_may_be_inputs_and_parameters_by_name(function, numeric):
    made = from_function(function, lambda t, y, k, d: {"load": k * y[0] + d * y[1]}, numeric=numeric, **NAMES)
    u = 5 * np.random.default_rng(0).normal(size=(100, 1))
    record = pilfr.Recording(u, u, 5e-3, inputs=("force",), outputs=("load",), initial="zero", hold="zero")
    for other in ({}, {"k": 700.0, "d": 40.0}):
        expected = from_function(
            rhs, lambda t, x, u, p: {"load": p["k"] * x[0] + p["d"] * x[1]}, **NAMES
        ).with_parameters(other)
        found = made.with_parameters(other).simulate(record)
        assert np.allclose(found, expected.simulate(record), rtol=1e-9, atol=1e-12)


def test_a_function_of_time_and_states_alone_has_no_inputs():
    made = from_function(lambda t, y: [force(t) - y[0]], "level", states="level")
    x, u, p, t = made.symbols()
    assert made.inputs == () and made.derivatives(x, u, p, t).size1() == 1
    assert float(ca.Function("f", [t, x.level], [made.derivatives(x, u, p, t)])(2.5, 1.0)) == 4.0


def outflow(t, x, u, p):
    flow = p["k"] * math.sqrt(x[0]) if x[0] > 0 else 0.0
    angle = math.acos(x[1] / 9) + np.arccosh(x[1] + 1) + np.log(x[1]) / x[1] if 0 < x[1] < 9 else 0.0
    return [u[0] - flow, flow - angle]


def test_derivatives_are_finite_in_both_branches():
    traced = equations(outflow)
    for x in ([0.0, 0.0], [-1.0, 2.0], [4.0, -1.0], [4.0, 10.0]):
        assert np.all(np.isfinite(traced.jacobian()(0.5, *x, 1.0, 0.7, np.zeros(2))[1].full()))
        assert np.all(np.isfinite(traced.jacobian()(0.5, *x, 1.0, 0.7, np.zeros(2))[2].full()))
    slope = traced.jacobian()(0.5, 4.0, 1.0, 1.0, 0.7, np.zeros(2))[1].full().ravel()
    assert np.allclose(slope, [-0.7 / 4, 0.7 / 4])


def test_parameters_may_be_arrays():
    stiffness = Parameter(np.array([[3.0, -1.0], [-2.0, 5.0]]))
    made = from_function(lambda t, x, u, p: -p["K"] @ x, "a", states=("a", "b"), parameters={"K": stiffness})
    x, u, p, t = made.symbols()
    f = ca.Function("f", [x.a, x.b, p.K], [made.derivatives(x, u, p, t)])
    assert np.allclose(f(1.0, 2.0, stiffness.value).full().ravel(), -stiffness.value @ [1, 2])


def test_time_and_discrete_functions_are_followed():
    u = np.ones((50, 1))
    record = pilfr.Recording(u, u, 0.1, inputs=("u",), outputs=("y",), initial="zero", hold="zero")
    options = {"states": "y", "inputs": "u", "hold": "zero"}
    swing = from_function(lambda t, x, u, p: [np.cos(t)], "y", **options)
    assert np.allclose(swing.simulate(record)[:, 0], np.sin(0.1 * np.arange(50)), atol=1e-6)
    step = from_function(lambda t, x, u, p: 0.5 * x + u, "y", discrete=True, **options)
    assert np.allclose(step.simulate(record)[:, 0], 2 * (1 - 0.5 ** np.arange(50)))
    assert from_function(rhs, "pos", **NAMES).kinematic == {"pos"}


def test_equations_survive_a_worker_process_and_are_exported():
    made = cloudpickle.loads(cloudpickle.dumps(from_function(rhs, "pos", ports=GROUND, hold="zero", **NAMES)))
    step = pilfr.exported(made, dt=1e-3).step
    assert made.output_names == ("pos",) and step.size1_in(0) == 2


def test_it_simulates_as_the_symbolic_simulator_does_and_is_not_called_any_more():
    calls = 0

    def counted(t, x, u, p):
        nonlocal calls
        calls += 1
        return rhs(t, x, u, p)

    made = from_function(counted, lambda t, x, u, p: {"pos": x[0]}, ports=GROUND, hold="zero", **NAMES)
    assert calls == 41
    assert "derivatives: equations of counted; called 41 times (1 for its branches, 40 as a check)" in repr(made)
    u = np.random.default_rng(0).normal(size=(400, 1))
    record = pilfr.Recording(u, u, 5e-3, inputs=("force",), outputs=("pos",), initial="zero", hold="zero")
    one, other = made.simulate(record), symbolic().simulate(record)
    assert np.max(np.abs(one - other)) <= 1e-12 * np.max(np.abs(other)) and calls == 41


def test_a_law_in_a_port_adds_its_parameters():
    law = pilfr.laws.CoulombFriction().at({"F_c": 12.0, "v_0": 0.003})
    force = 12 * np.sin(np.arange(200.0) / 9)[:, None]
    record = pilfr.Recording(force, force, 5e-3, inputs=("force",), outputs=("pos",), initial="zero", hold="zero")
    simulators = from_function(rhs, "pos", ports=GROUND, **NAMES), symbolic()
    made, other = (s.with_element("ground", law) for s in simulators)
    np.testing.assert_allclose(made.simulate(record), other.simulate(record), rtol=1e-9, atol=1e-12)


def test_missing_friction_is_found_as_with_the_symbolic_simulator():
    t = np.arange(500) * 5e-3
    f, phase = np.linspace(0.3, 8, 30), np.random.default_rng(0).uniform(0, 2 * np.pi, 30)
    force = 12 * np.sum(np.cos(2 * np.pi * f[:, None] * t + phase[:, None]), axis=0)[:, None]
    blank = pilfr.Recording(force, force, 5e-3, inputs=("force",), outputs=("pos",), initial="zero", hold="zero")
    law = pilfr.laws.CoulombFriction
    y = symbolic().with_element("ground", law().at({"F_c": 12.0, "v_0": 0.003})).simulate(blank)
    record = blank.with_(y=y + 1e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape))
    made = from_function(rhs, "pos", ports=GROUND, **NAMES)
    found = [
        pilfr.diagnose(s, record, laws=(law,), effects=1, hold="zero", workers=1, engine="vm")
        for s in (made, symbolic())
    ]
    named = [(d.verdict, [(e.port, e.law) for e in d.effects]) for d in found]
    assert named[0] == named[1] == ("missing-physics", [("ground", "coulomb_friction")])


def loops(t, x, u, p):
    v = x[0]
    while v > 1:
        v = v / 2
    return [v, 0.0]


def writes(t, x, u, p):
    x[0] = 0.0
    return x


def sets_parameter(t, x, u, p):
    p["k"] = 3.0
    return [x[0], x[1]]


def adds_into_numbers(t, x, u, p):
    total = np.linspace(0, 1, 2)
    total += x
    return total


def guards(t, x, u, p):
    if x[0] > 1e9:
        raise ValueError("out of range")
    return x


def rounds(t, x, u, p):
    return [np.round(x[0]), x[1]]


def converts(t, x, u, p):
    return [K[int(x[0]) % 2, 0], x[1]]


def looks_up(t, x, u, p):
    return [TABLE(x[:1])[0], x[1]]


def asks_for_a_type(t, x, u, p):
    return [x[0] if isinstance(x[0], np.floating) else 2 * x[0], x[1]]


NOISE, COUNTER = np.random.default_rng(0), itertools.count()
TABLE = RegularGridInterpolator([[-1e9, 0.0, 1e9]], [0.0, 1.0, 2.0])


def finds_a_root(t, x, u, p):
    return [brentq(lambda z: z + z**3 - x[0], -1e9, 1e9), x[1]]


def loses_an_error(t, x, u, p):
    with contextlib.suppress(Exception):  # as compiled code that calls on after an error
        x[0].__float__()
        return x
    raise ValueError("f(a) and f(b) must have different signs")


randn = np.random.randn
BAD = {
    "not callable": (3, ("3", "function of t, x, u and p")),
    "one argument": (lambda x: x, ("(t, x, u, p)",)),
    "input inside": (lambda t, y: [y[1], force(t)], ("(t, y) does not take f", "recording", "as an argument", "y, f)")),
    "input inside, parameters": (lambda t, y, k: [y[1], force(t) - k], ("(t, y, k) does not take f",)),
    "undeclared argument": (lambda t, y, f, k, d: y, ("(t, y, f, k, d)", "'d'", "input (f)", "parameter (k)")),
    "undeclared arguments": (
        lambda t, y, d, m: [y[1], -m * y[0]],
        ("because d and m are no names", "u is the array of the inputs"),
    ),
    "time after the states": (lambda y, t, f: y, ("(y, t, f) takes the time after", "<lambda>(t, y, ...)")),
    "too few": (lambda t, x, u, p: [x[0]], ("1 value;", "derivatives a, b")),
    "too many": (lambda t, x, u, p: [x[0], x[1], 0], ("3 values;", "derivatives a, b")),
    "a matrix": (lambda t, x, u, p: np.outer(x, x)[:, :1] * x, ("shape (2, 2)", "derivatives a, b")),
    "nothing": (lambda t, x, u, p: None, ("1 value",)),
    "texts": (lambda t, x, u, p: ["a", x[0]], ("a str for 'a'", "number")),
    "writes into its arguments": (writes, ("line", "x[0] = 0.0", "arguments", "np.array")),
    "sets a parameter": (sets_parameter, ("line", "arguments")),
    "unknown parameter": (lambda t, x, u, p: x * p["q"], ("'q'", "there are k")),
    "always fails": (lambda t, x, u, p: x + np.ones(3), ("line", "ValueError", "with numbers")),
    "never finite": (lambda t, x, u, p: x * np.nan, ("finite",)),
    "guard": (guards, ("line", "raise ValueError", "out of range")),
    "endless": (loops, ("line", "while v > 1", "64 times", "fixed number")),
    "rounds": (rounds, ("line", "np.round(x[0])", "np.rint", "np.where")),
    "whole number": (converts, ("line", "int(x[0])", "leave out int()")),
    "adds into numbers": (adds_into_numbers, ("line", "total += x", "y = y + ...")),
    "table of another package": (looks_up, ("line", "TABLE(x[:1])", "CasADi")),
    "solver": (finds_a_root, ("line", "brentq(", "a plain number", "numeric=Numeric(...)")),
    "lost error": (loses_an_error, ("line", "a plain number", "numeric=Numeric(...)")),
    "random": (lambda t, x, u, p: x * NOISE.random(), ("line", "NOISE.random()", "uses random numbers")),
    "legacy random": (lambda t, x, u, p: x + randn(), ("line", "randn()", "uses random numbers")),
    "random of Python": (lambda t, x, u, p: x + random.random(), ("line", "random.random()", "uses random numbers")),
    "memory": (lambda t, x, u, p: x * next(COUNTER), ("its equations", "memory", "random numbers")),
    "types": (asks_for_a_type, ("its equations", "types")),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_functions_are_refused_in_one_sentence(case):
    function, says = BAD[case]
    with pytest.raises(InputError) as caught:
        equations(function)
    message = str(caught.value)
    print(message)
    assert "\n" not in message and len(message) < 420
    for word in says:
        assert word in message, message


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"states": ("pos", "pos")}, "not unique"),
        ({"states": ()}, "names"),
        ({"inputs": 3}, "names"),
        ({"parameters": {"k": 3.0}}, "Parameter"),
        ({"parameters": [1]}, "Parameter"),
        ({"outputs": 3}, "function of t, x, u and p"),
        ({"outputs": ("pos", "speed")}, "pos and vel"),
        ({"outputs": lambda t, x, u, p: [x[0]]}, "{name: value}"),
        ({"outputs": lambda t, x, u, p: {"a": x[0]} if x[0] > 0 else {"b": x[0]}}, "before"),
        ({"outputs": lambda t, x, u, p: {"a": x}}, "shape (1, 2)"),
    ],
)
def test_bad_arguments_are_refused_in_one_sentence(changes, says):
    with pytest.raises(InputError) as caught:
        from_function(rhs, **{"outputs": "pos", **NAMES, **changes})
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_a_simulator_file_may_hold_a_numpy_function(tmp_path):
    text = """\
import numpy as np
from pilfr_casadi import Parameter, from_function

def rhs(t, x, u, p):
    return [x[1], u[0] - p["k"] * np.tanh(x[0])]

simulator = from_function(rhs, "pos", states=("pos", "vel"), inputs="force", parameters={"k": Parameter(3.0)})
"""
    path = tmp_path / "rig.py"
    path.write_text(text)
    assert load_simulator(path).inputs == ("force",)
    path.write_text(text.replace("np.tanh", "int"))
    with pytest.raises(InputError, match=r"rig.py, line 5: .*int\(x\[0\]\)"):
        load_simulator(path)
