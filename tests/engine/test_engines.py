"""Sensitivities: both engines give the same numbers, and they are the derivatives of the simulation."""

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from random_models import OPERATORS, random_input, random_lfr

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.engine import (
    Compiled,
    VirtualMachine,
    cache_directory,
    compiler,
    linearize,
    make_engine as engine_of,
    source_code,
)
from pilfr_casadi.models import (
    PILFR,
    GeneralizedPlay,
    Parameter,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    Stop,
    open_model,
)
from problems.constrained import three_plays

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def case(seed=0, length=150, fixed=(), **sizes):
    """A random model, input, state with memory, parameters, and the columns of its free parameters."""
    structure, values = random_lfr(seed, **sizes)
    n_u, n_y = values["B_u"].shape[1], len(values["C_y"])
    model = structure.model(n_u, n_y, values)
    model = model.with_parameters(model.parameters.change(**{name: {"fixed": True} for name in fixed}))
    free = model.parameters.free
    state = np.random.default_rng(seed).normal(size=model.n_x + model.n_s)
    return (
        model,
        random_input(seed, length, n_u),
        state,
        model.parameters.start,
        np.where(free, np.cumsum(free) - 1, -1),
    )


def grey_box():
    """Nonlinear in states, inputs and parameters, with a port."""
    parameters = ParameterSet({"k": Parameter(0.3), "m": Parameter(1.4), "a": Parameter([[0.1, 0.7]])})
    return open_model(
        lambda x, u, w, p: (
            ca.vertcat(x[0] + 0.1 * x[1], 0.9 * x[1] + (u - p["k"] * x[0] ** 3 - w) / p["m"] * 0.1),
            ca.vertcat(p["a"] @ ca.sin(x), w * u),
        ),
        lambda x, u, p: x[0] - p["k"] * u,
        parameters,
        n_x=2,
        n_u=1,
        n_w=1,
    )


def sensitivity(engine, model, u, state, p, columns, initial=True):
    """J (M, n_y, n_c) with columns of the free parameters, then of the initial state with memory."""
    n_free, n = int(np.sum(columns >= 0)), model.n_x + model.n_s
    seed = np.zeros((n, n_free + n * initial))
    if initial:
        seed[:, n_free:] = np.eye(n)
    return engine.sensitivity(u, p, state, seed, columns)


MODELS = {
    "play": {"operator": Play},
    "stop": {"operator": Stop},
    "generalized play": {"operator": GeneralizedPlay, "n": 2},
    "several channels, inputs, outputs": {"operator": Play, "nx": 4, "n_u": 2, "n_y": 3, "n_w": 2},
    "stops in two channels": {"operator": Stop, "n_u": 3, "n_y": 1, "n_w": 2},
    "no element": {"n_w": 0, "n_u": 2, "n_y": 2},
    "no states": {"nx": 0},
    "neither": {"nx": 0, "n_w": 0},
    "fixed blocks": {"operator": Play, "fixed": ("A", "D_yu", "r")},
    "only the initial state": {
        "operator": Play,
        "fixed": ("A", "B_u", "B_w", "C_y", "D_yu", "D_yw", "C_z", "D_zu", "y_0", "w", "r"),
    },
}


@needs_compiler
@pytest.mark.parametrize("name", MODELS)
def test_both_engines_give_the_same_numbers(name):
    model, u, state, p, columns = case(3, **MODELS[name])
    both = [kind(model) for kind in (VirtualMachine, Compiled)]
    simulated = [e.simulate(u, p, state, True) for e in both]
    found = [sensitivity(e, model, u, state, p, columns) for e in both]
    for a, b in (*zip(*simulated, strict=True), *zip(*found, strict=True)):
        assert np.array_equal(a, b)
    np.testing.assert_allclose(found[0][0], simulated[0][0], rtol=0, atol=1e-12 * np.max(np.abs(simulated[0][0])))


@needs_compiler
def test_both_engines_on_a_nonlinear_model():
    from pilfr_casadi.models import close_loop

    model = close_loop(grey_box(), PrandtlIshlinskii(Stop, 3))
    u, p = random_input(0, 100), model.parameters.start
    columns = np.arange(len(p))
    found = [sensitivity(kind(model), model, u, np.zeros(5), p, columns) for kind in (VirtualMachine, Compiled)]
    for a, b in zip(*found, strict=True):
        assert np.array_equal(a, b)


def smooth(engine, u, p, state, columns, h=1e-6, gap=1e-3):
    """Central differences of the outputs; nan from where one-sided slopes differ by more than `gap`: a kink."""
    variables = [*np.flatnonzero(columns >= 0), *(len(p) + np.arange(len(state)))]
    out = np.empty((len(u), engine.linear.sizes["y"], len(variables)))
    here = engine.simulate(u, p, state)[0]
    for c, v in enumerate(variables):
        ends = []
        for s in (h, -h):
            p_s, state_s = np.array(p), np.array(state)
            if v < len(p):
                p_s[v] += s
            else:
                state_s[v - len(p)] += s
            ends.append(engine.simulate(u, p_s, state_s)[0])
        ahead, back = (ends[0] - here) / h, (here - ends[1]) / h
        kink = np.abs(ahead - back) > gap * (1 + np.abs(ahead))
        out[:, :, c] = np.where(np.logical_or.accumulate(kink.any(axis=1))[:, None], np.nan, (ahead + back) / 2)
    return out


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
@pytest.mark.parametrize("name", MODELS)
def test_central_differences(name, engine):
    model, u, state, p, columns = case(4, length=80, **MODELS[name])
    e = engine_of(model, engine)
    jac = sensitivity(e, model, u, state, p, columns)[1]
    expected = smooth(e, u, p, state, columns)
    known = ~np.isnan(expected)
    assert known.mean() > 0.8
    np.testing.assert_allclose(jac[known], expected[known], rtol=1e-5, atol=1e-6 * np.max(np.abs(expected[known])))


@pytest.mark.parametrize("operator", OPERATORS)
def test_against_the_derivative_of_the_unrolled_record(operator):
    """CasADi's own jacobian of the whole recursion, on a short record."""
    model, u, state, p, columns = case(5, length=25, operator=operator, n=2, n_w=2, n_y=2)
    vector, first = ca.MX.sym("p", len(p)), ca.MX.sym("x", len(state))
    _, y = model.closed.mapaccum("run", len(u))(first, u.T, ca.repmat(vector, 1, len(u)))
    slope = ca.Function("slope", [vector, first], [ca.densify(ca.jacobian(ca.vec(y), ca.vertcat(vector, first)))])
    expected = np.asarray(slope(p, state)).reshape(len(u), model.n_y, -1)
    jac = sensitivity(VirtualMachine(model), model, u, state, p, columns)[1]
    np.testing.assert_allclose(jac, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
def test_in_pieces_as_in_one(engine):
    model, u, state, p, columns = case(6, length=101)
    e = engine_of(model, engine)
    y, jac, last, slope = sensitivity(e, model, u, state, p, columns)
    seed = np.zeros((len(state), jac.shape[2]))
    seed[:, -len(state) :] = np.eye(len(state))
    pieces, at = [], state
    for piece in np.split(u, [1, 7, 40, 99]):
        y_piece, jac_piece, at, seed = e.sensitivity(piece, p, at, seed, columns)
        pieces.append((y_piece, jac_piece))
    np.testing.assert_array_equal(np.concatenate([a for a, _ in pieces]), y)
    np.testing.assert_array_equal(np.concatenate([a for _, a in pieces]), jac)
    np.testing.assert_array_equal(at, last)
    np.testing.assert_array_equal(seed, slope)


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
def test_nothing_given_is_written_to(engine):
    model, u, state, p, columns = case(7, length=40)
    seed = np.zeros((len(state), int(columns.max()) + 1))
    given = [np.array(a) for a in (u, p, state, seed, columns)]
    for a in (u, p, state, seed, columns):
        a.setflags(write=False)
    engine_of(model, engine).sensitivity(u, p, state, seed, columns)
    for a, b in zip((u, p, state, seed, columns), given, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("engine", ["vm", pytest.param("c", marks=needs_compiler)])
def test_a_simulation_that_diverges_ends_in_no_exception(engine):
    model, u, state, _, columns = case(8, length=400)
    wild = model.parameters.pack({"A": 9.0 * np.eye(3)})
    e = engine_of(model, engine)
    y, last = e.simulate(u, wild, state)
    assert not np.all(np.isfinite(y))
    assert not np.all(np.isfinite(last))
    assert not np.all(np.isfinite(sensitivity(e, model, u, state, wild, columns)[1]))


def test_rounded_operators_have_a_derivative_in_the_width_of_the_rounding():
    structure = PILFR(2, PrandtlIshlinskii(Play, 2, rounded=True))
    _, values = random_lfr(9, nx=2, n=2)
    model = structure.model(1, 1, {**values, "eps": 0.3})
    u, p, state, columns = random_input(9, 60), model.parameters.start, np.zeros(4), np.arange(model.parameters.size)
    e = VirtualMachine(model)
    jac = sensitivity(e, model, u, state, p, columns)[1]
    expected = smooth(e, u, p, state, columns, gap=np.inf)  # no kinks left
    np.testing.assert_allclose(jac, expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))
    at_zero = model.parameters.pack({"eps": 0.0})
    fixed = np.where(
        np.array(model.parameters.labels) == "eps", -1, np.cumsum(np.array(model.parameters.labels) != "eps") - 1
    )
    assert np.all(np.isfinite(sensitivity(e, model, u, state, at_zero, fixed)[1]))
    assert np.all(np.isfinite(sensitivity(e, model, u, state, at_zero, columns)[1]))


def test_partial_derivatives_of_one_step():
    model, u, state, p, _ = case(10, operator=GeneralizedPlay, n_w=2, n=2)
    linear = linearize(model)
    x, s = state[:3], state[3:]
    x_next, s_next, y, z, w, c = (np.asarray(a) for a in linear.step(x, s, u[0], p))
    np.testing.assert_allclose(z, np.asarray(model.port(x, u[0], p)))
    together, _ = model.closed(state, u[0], p)
    np.testing.assert_allclose(np.concatenate([x_next, s_next]), np.asarray(together), atol=1e-15)
    blocks = linear.blocks({"x": x, "s": s, "z": z, "w": w, "c": c, "u": u[0], "p": p})
    named = model.parameters.unpack(p)
    np.testing.assert_array_equal(np.asarray(blocks["x", "x"]), named["A"])
    np.testing.assert_array_equal(np.asarray(blocks["y", "w"]), named["D_yw"])
    assert y.shape == (1, 1)
    assert c.size == 0


# ---- the ways to run ----


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_directory.cache_clear()
    yield
    cache_directory.cache_clear()


@needs_compiler
@pytest.mark.usefixtures("own_cache")
def test_another_structure_is_another_library():
    texts = {source_code(linearize(case(0, **sizes)[0])) for sizes in ({}, {"n": 5}, {"operator": Stop}, {"nx": 4})}
    assert len(texts) == 4
    assert source_code(linearize(case(0)[0])) == source_code(linearize(case(1)[0]))  # values are not part of it
    for changes, libraries in (({}, 1), ({}, 1), ({"operator": Stop}, 2)):
        Compiled(case(libraries, nx=1, n=1, **changes)[0])
        kept = list(cache_directory().glob("*/*"))
        assert [path.suffix for path in kept] == [".so"] * (1 + libraries)  # the loops, and nothing half done


@needs_compiler
def test_without_a_compiler_the_same_numbers(tmp_path):
    program = (
        "import numpy as np; from test_engines import *\n"
        "model, u, state, p, columns = case(3)\n"
        "engine = engine_of(model)\n"
        "assert type(engine) is VirtualMachine\n"
        "y, jac, _, _ = sensitivity(engine, model, u, state, p, columns)\n"
        f"np.savez({str(tmp_path / 'found.npz')!r}, y=y, jac=jac)\n"
    )
    here = Path(__file__).parent
    paths = os.pathsep.join(map(str, (here, here.parent, here.parent.parent)))
    environment = {**os.environ, "PILFR_COMPILER": "none", "PYTHONPATH": paths}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, cwd=tmp_path)
    found = np.load(tmp_path / "found.npz")
    model, u, state, p, columns = case(3)
    y, jac, _, _ = sensitivity(Compiled(model), model, u, state, p, columns)
    assert np.array_equal(found["y"], y) and np.array_equal(found["jac"], jac)


@pytest.mark.slow
@needs_compiler
def test_without_a_compiler_the_same_fit():
    record = three_plays(0, 400)
    structure = PILFR(2, PrandtlIshlinskii(Play, 4))
    fits = [pilfr.fit(structure, record, starts=2, seed=0, engine=engine) for engine in ("c", "vm")]
    for name, value in fits[0].parameters.items():
        assert np.array_equal(value, fits[1].parameters[name]), name
    assert fits[0].solution.cost == fits[1].solution.cost


def test_an_unknown_engine():
    with pytest.raises(InputError, match="'gpu' is unknown"):
        engine_of(case(0)[0], "gpu")
