"""Functions that are called with numbers: values and derivatives equal their equations; a failure fails one trial."""

import re
import signal
import time
import timeit

import casadi as ca
import cloudpickle
import numpy as np
import pytest
from command_line import refused

from pilfr_casadi import InputError, Parameter, Recording, diagnose, fit
from pilfr_casadi.engine import compiler, make_engine
from pilfr_casadi.simulators import Numeric, PythonFunction, discretise, from_function

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def swing(t, x, u, p):
    pos, vel = x
    return [vel, (u[0] - p["k"] * pos - p["d"] * vel**3) / 2.0]


def swing_jacobian(t, x, u, p):
    pos, vel = x
    slope = [-p["k"], -3 * p["d"] * vel**2, 1.0, -pos, -(vel**3)]
    return np.array([[0.0, 1.0, 0.0, 0.0, 0.0], np.array(slope) / 2.0])


def jacobian_by_name(t, y, k, d):
    return swing_jacobian(t, y, None, {"k": k, "d": d})


SWING = dict(
    states=("pos", "vel"),
    inputs="force",
    parameters={"k": Parameter(90.0, bounds=(10, 500)), "d": Parameter(1.0, bounds=(0, 10))},
)


def sensitivities(simulator, engine):
    u = 20 * np.sin(0.05 * np.arange(200))[:, None]
    given = Recording(u, np.zeros((200, 1)), 0.01, ("force",), ("pos",), initial="zero")
    model = discretise(simulator, 0.01, "zero", 2)
    p, n = model.parameters.start, model.n_state
    seed = np.zeros((n, len(p) + n))
    seed[:, len(p) :] = np.eye(n)
    return make_engine(model, engine).sensitivity(model.drive(given), p, np.zeros(n), seed, np.arange(len(p)))[:2]


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
@pytest.mark.parametrize(
    "numeric, exact",
    [(Numeric(), 1e-6), (Numeric(jacobian=swing_jacobian), 1e-12), (Numeric(jacobian=jacobian_by_name), 1e-12)],
)
def test_a_function_called_with_numbers_has_the_derivatives_of_its_equations(engine, numeric, exact):
    y_equations, jac_equations = sensitivities(from_function(swing, "pos", **SWING), "vm")
    made = from_function(swing, "pos", numeric=numeric, **SWING)
    y, jac = sensitivities(made, engine)
    assert np.abs(y - y_equations).max() <= 1e-12 * np.ptp(y)
    assert np.all(np.abs(jac - jac_equations).max(axis=(0, 1)) <= exact * np.abs(jac_equations).max(axis=(0, 1)))
    assert ("the given Jacobian" in str(made)) == (numeric.jacobian is not None)
    assert int(re.search(r"swing: called (\d+) times", str(made))[1]) >= 4 * 2 * 200  # stages, sub-steps, samples


def test_a_function_called_with_numbers_keeps_what_it_defines():
    def measured(t, x, u, p):
        return {"pos": x[0], "power": u[0] * x[1]}

    made = from_function(swing, measured, numeric=Numeric(), **SWING)
    assert made.kinematic == {"pos"}
    x, u, p, t = made.symbols()
    assert str(made.measured(x, u, p, t)["pos"]) == "pos"
    given = Recording(np.ones((50, 1)), np.zeros((50, 2)), 0.01, ("force",), ("pos", "power"))
    equations = from_function(swing, measured, **SWING)
    assert np.allclose(made.simulate(given), equations.simulate(given), rtol=1e-12, atol=1e-14)


def test_a_function_that_cannot_be_followed_is_called_with_numbers():
    table = {0: 90.0, 1: 110.0}

    def stepped(t, x, u, p):
        k = table[int(float(x[0]) > 0.1)] * p["k"] / 90.0
        return [x[1], (u[0] - k * x[0] - x[1]) / 2.0]

    parameters = {"k": Parameter(90.0, bounds=(10, 500))}
    options = dict(states=("pos", "vel"), inputs="force", parameters=parameters)
    made = from_function(stepped, "pos", numeric=Numeric(nominal={"pos": 1e-4}), **options)
    u = 20 + 10 * np.sin(0.1 * np.arange(100))[:, None]
    given = Recording(u, np.zeros((100, 1)), 0.01, ("force",), ("pos",), initial="zero")
    given = given.with_(y=made.simulate(given))
    moved = made.with_parameters(made.parameter_set.change(k={"value": 80.0}))
    found = fit(moved, given)
    assert found.parameters["k"] == pytest.approx(90.0, rel=1e-4)


def fragile(t, x, u, p):
    if x[0] > 1.0:
        raise ValueError("too far")
    return [(u[0] - x[0]) * p["k"]]


def test_a_function_that_fails_at_a_point_is_a_failed_trial():
    made = from_function(
        fragile, "pos", numeric=Numeric(), states="pos", inputs="force", parameters={"k": Parameter(1.0)}
    )
    given = Recording(np.full((200, 1), 5.0), np.zeros((200, 1)), 0.05, ("force",), ("pos",))
    assert np.isnan(made.simulate(given)[-1, 0]) and np.isfinite(made.simulate(given)[0, 0])
    assert "it failed first with ValueError('too far')" in str(made)


@pytest.mark.slow
def test_a_diagnosis_tells_that_a_function_has_failed():
    options = dict(states="pos", inputs="force", parameters={"k": Parameter(1.0, bounds=(0.01, 3.0))})
    made = from_function(fragile, "pos", numeric=Numeric(), **options)
    u = np.tile([[4.0]] * 10 + [[0.0]] * 10, (3, 1))
    given = Recording(u, u, 0.1, ("force",), ("pos",), initial="zero", hold="zero")
    given = given.with_(y=made.with_parameters({"k": 0.1}).simulate(given))
    with pytest.raises(InputError, match=r"pos is not finite .* fragile failed with ValueError\('too far'\)"):
        diagnose(made, given, workers=1, engine="vm")
    found = diagnose(made.with_parameters({"k": 0.12}), given, laws=[], effects=0, workers=1, engine="vm", time_limit=1)
    note = next(g.sentence for g in found.gates if g.finding == "failure")
    assert note.startswith("fragile failed at some points, first with ValueError('too far').")


def test_a_diagnosis_says_how_often_it_calls_and_how_long_a_simulation_takes():
    left = 0

    def slow_at_first(t, x, u, p):
        nonlocal left
        left -= 1
        if left > 0:
            time.sleep(0.002)
        return swing(t, x, u, p)

    made = from_function(slow_at_first, "pos", numeric=Numeric(), **SWING)
    u = 20 * np.sin(0.05 * np.arange(200) + np.sin(0.013 * np.arange(200)))[:, None]
    given = Recording(u, np.zeros((200, 1)), 0.01, ("force",), ("pos",), initial="zero", hold="zero")
    given = given.with_(y=made.simulate(given) + 1e-3 * np.random.default_rng(0).standard_normal((200, 1)))
    before, left, stages = made.program_calls["slow_at_first"], 300, set()
    found = diagnose(made, given, laws=(), effects=0, workers=1, progress=lambda stage, *_: stages.add(stage))
    counted = made.program_calls["slow_at_first"] - before
    assert all("s a simulation: " in stage for stage in stages) and "calls slow_at_first at every step" in str(found)
    said = int(re.search(r"computed in .* s, (\d+) calls of slow_at_first$", str(found))[1])
    assert 1000 < said == found.calls["slow_at_first"] <= counted


def test_a_call_costs_little_beside_the_function():
    program = PythonFunction(lambda z: z[:2], (9,), 2)
    many, points = program.map(2000), ca.DM(np.ones((9, 2000)))
    one, matrix = np.ones(9), ca.DM(np.ones(9))

    def convert():
        for _ in range(2000):
            ca.DM(one)
            matrix.full()

    def fastest(run):
        return min(timeit.repeat(run, number=1, repeat=5))

    assert fastest(lambda: many(points)) < fastest(convert)


@pytest.mark.parametrize(
    "numeric, says",
    [
        (True, "numeric=True was given; give Numeric"),
        (Numeric(nominal={"x": 1.0}), "give a positive size by the name of a state"),
        (Numeric(nominal={"pos": 0.0}), "give a positive size by the name of a state"),
    ],
)
def test_wrong_sizes_are_refused_in_one_sentence(numeric, says):
    with pytest.raises(InputError, match=says) as error:
        from_function(swing, "pos", numeric=numeric, **SWING)
    assert str(error.value).count(".") <= 3 and "\n" not in str(error.value)


def test_the_command_says_how_to_use_what_it_cannot_export(tmp_path, capsys):
    text = """\
from pilfr_casadi import from_function
from pilfr_casadi.simulators import Numeric

simulator = from_function(lambda t, y, flow: [flow - y[0]], "h", states="h", inputs="flow", numeric=Numeric())
"""
    (tmp_path / "tank.py").write_text(text)
    out = tmp_path / "c"
    says = ("no file can hold", "use `pilfr_casadi.exported` in Python")
    refused(capsys, "export", tmp_path / "tank.py", "--dt", 0.1, "--c", "--out", out, says=says)
    assert not out.exists()


def test_it_survives_another_process():
    made = from_function(swing, "pos", numeric=Numeric(jacobian=swing_jacobian), **SWING)
    again = cloudpickle.loads(cloudpickle.dumps(made))
    assert again.kinematic == {"pos"} and "called 0 times" in str(again)
    assert np.array_equal(sensitivities(again, "vm")[1], sensitivities(made, "vm")[1])


class Interrupted:
    """The swing, during whose run Ctrl-C is pressed once, after so many calls."""

    def __init__(self):
        self.left = self.calls = 0

    def __call__(self, t, x, u, p):
        self.calls += 1
        self.left -= 1
        if self.left == 0:
            signal.raise_signal(signal.SIGINT)
        return swing(t, x, u, p)


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
def test_an_interrupt_ends_a_run_of_slow_calls_without_a_word(engine, capfd):
    called = Interrupted()
    made = from_function(called, "pos", numeric=Numeric(), **SWING)
    u = 20 * np.sin(0.05 * np.arange(60))[:, None]
    given = Recording(u, np.zeros((60, 1)), 0.01, ("force",), ("pos",), initial="zero", hold="zero")
    given = given.with_(y=made.simulate(given))
    fit(made.with_parameters({"k": 80.0}), given, engine=engine)
    whole = called.calls
    called.calls, called.left = 0, whole // 2
    found = fit(made.with_parameters({"k": 80.0}), given, engine=engine)
    assert found.status.name == "INTERRUPTED" and called.calls < whole
    assert "Traceback" not in capfd.readouterr().err
    model, one = discretise(made, 0.01, "zero", 1), called.calls
    run = make_engine(model, engine)
    called.left = 40
    with pytest.raises(KeyboardInterrupt):
        run.simulate(model.drive(given), model.parameters.start, np.zeros(2))
    assert called.calls - one < 200 and "Traceback" not in capfd.readouterr().err
    y = run.simulate(model.drive(given), model.parameters.start, np.zeros(2))[0]
    assert np.all(np.isfinite(y)) and np.any(y)


def test_an_interrupt_outside_a_run_is_raised_and_leaves_no_numbers_wrong():
    called = Interrupted()
    program = PythonFunction(lambda z: np.array(called(0.0, z[:2], z[2:], {"k": 90.0, "d": 1.0})), (3,), 2)
    z, called.left = np.ones(3), 2
    first = program(z).full()
    with pytest.raises((KeyboardInterrupt, RuntimeError)):
        program(z)
    assert np.array_equal(program(z).full(), first) and np.all(np.isfinite(first))
