"""Envelopes, products, and elements combined in one port."""

import json

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

from pilfr_casadi import load
from pilfr_casadi._base import InputError, ordered_digest
from pilfr_casadi.control import response_bound
from pilfr_casadi.data import Recording
from pilfr_casadi.engine import VirtualMachine
from pilfr_casadi.identify import fit
from pilfr_casadi.models import (
    PILFR,
    Combined,
    Envelope,
    GeneralizedPlay,
    ParameterSet,
    Part,
    Play,
    PrandtlIshlinskii,
    Products,
    Stop,
    close_loop,
    element_bound,
    open_model,
)
from pilfr_casadi.optimise import GaussNewton

EVERY = Combined(
    (
        Part("envelope", Envelope(2), (0, 1)),
        Part("products", Products(2), (0, 1), (1, 0)),
        Part("input", PrandtlIshlinskii(Play, 3), (2,), (0,)),
        Part("stops", PrandtlIshlinskii(Stop, 2), (1,)),
    )
)


def run(element, z, **values):
    """Outputs for a signal z (M, channels), from memory zero."""
    parameters = element.parameters()
    signal, s, p = (
        ca.SX.sym(k, n) for k, n in (("z", element.channels), ("s", element.memory), ("p", parameters.size))
    )
    step = ca.Function("step", [signal, s, p], element.step(signal, s, parameters.symbols(p)))
    numbers, memory, out = parameters.pack(values), np.zeros(element.memory), []
    for row in z:
        w, memory = (np.asarray(a).ravel() for a in step(row, memory, numbers))
        out.append(w)
    return np.array(out), memory


def some_values(element, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: p.value if np.all(p.fixed) else np.clip(rng.uniform(0.05, 1.0, p.value.shape), *p.bounds)
        for name, p in element.parameters().items()
    }


# ---- the envelope ----


def test_an_envelope_measures_the_amplitude_and_scales_by_it():
    z = 2.0 * np.sqrt(2.0) * np.sin(2 * np.pi * np.arange(4000) / 20)[:, None]
    w, memory = run(Envelope(1), z, rate=[0.005], knee=[3.0])
    assert memory[0] == pytest.approx(2.0**2, rel=0.02)
    np.testing.assert_allclose(w[-20:], z[-20:] * 2.0 / (2.0 + 3.0), atol=0.02)


def test_the_gain_of_an_envelope_grows_with_the_amplitude_and_is_in_phase():
    t, gains = np.arange(4000), []
    for size in (0.5, 1.0, 2.0, 4.0):
        z = size * np.sin(2 * np.pi * t / 20)[:, None]
        w = run(Envelope(1), z, rate=[0.002], knee=[1.0])[0][-1000:, 0]
        gains.append(w @ z[-1000:, 0] / (z[-1000:, 0] @ z[-1000:, 0]))
        quarter = size * np.cos(2 * np.pi * t[-1000:] / 20)
        assert abs(w @ quarter) < 0.01 * abs(w @ z[-1000:, 0])  # no damping: nothing a quarter period behind
    assert np.all(np.diff(gains) > 0.1)


@given(st.integers(0, 1000))
def test_bounds_of_elements_hold(seed):
    rng = np.random.default_rng(seed)
    values = some_values(EVERY, seed) | {"envelope_reach": [1.5, 0.7], "products_reach": [0.8, 1.1]}
    z = rng.normal(size=(60, 3)) * rng.uniform(0.1, 5.0)
    w, _ = run(EVERY, z, **values)
    assert np.all(np.abs(w) <= element_bound(EVERY, values, np.max(np.abs(z), axis=0)) + 1e-12)
    free = element_bound(EVERY, values, np.full(3, np.inf))
    assert np.isinf(free[0]) and np.isfinite(free[1])  # the play at channel 0 follows its input


def test_bounds_of_a_layer():
    p = {"w": np.array([[0.5, 0.0]]), "r": np.array([[2.0, 1.0]])}
    every, two = np.array([np.inf]), np.array([3.0])
    assert element_bound(PrandtlIshlinskii(Stop, 2), p, every) == 1.0
    assert element_bound(PrandtlIshlinskii(Play, 2), p, every) == np.inf
    assert element_bound(PrandtlIshlinskii(Play, 2), p, two) == 0.5
    assert element_bound(PrandtlIshlinskii(GeneralizedPlay, 2), p, two) == np.inf
    negative = {**p, "w": -p["w"]}  # where the user's bounds let them
    for layer in (PrandtlIshlinskii(Stop, 2), PrandtlIshlinskii(Play, 2)):
        for size in (two, every):
            assert element_bound(layer, negative, size) == element_bound(layer, p, size)


# ---- products ----


def test_products_are_a_polynomial():
    element = Products(2, (2, 3))
    assert element.terms == ((0, 0), (0, 1), (1, 1), (0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))
    rng = np.random.default_rng(0)
    gain, z = rng.normal(size=(2, 7)), rng.normal(size=(5, 2))
    x, y = z.T
    expected = np.array([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]).T @ gain.T
    np.testing.assert_allclose(run(element, z, gain=gain)[0], expected, atol=1e-13)
    held = run(element, 10 * np.sign(z), gain=gain, reach=[2.0, 3.0])[0]
    np.testing.assert_allclose(held, run(element, np.sign(z) * [2.0, 3.0], gain=gain)[0], atol=1e-12)


# ---- combined ----


def test_parts_read_and_write_their_channels():
    values, rng = some_values(EVERY), np.random.default_rng(1)
    z = rng.normal(size=(40, 3))
    own = [{k.removeprefix(f"{p.name}_"): v for k, v in values.items() if k.startswith(p.name)} for p in EVERY.parts]
    out, memory = run(EVERY, z, **values)
    expected, memories = np.zeros((40, 3)), []
    for part, numbers in zip(EVERY.parts, own, strict=True):
        w, s = run(part.element, z[:, part.reads], **numbers)
        expected[:, part.writes] += w
        memories.append(s)
    np.testing.assert_allclose(out, expected, atol=1e-13)
    np.testing.assert_array_equal(memory, np.concatenate(memories))


def test_derivatives_of_a_closed_loop():
    n_x, parameters = 2, ParameterSet()
    rng = np.random.default_rng(0)
    A, B, C = np.array([[0.8, 0.3], [-0.3, 0.8]]), 0.05 * rng.normal(size=(2, 3)), 0.3 * rng.normal(size=(3, 2))
    model = open_model(
        lambda x, u, w, p: (A @ x + B @ w + ca.vertcat(u, 0), x[0] + w[1]),
        lambda x, u, p: C @ x,
        parameters,
        n_x=n_x,
        n_u=1,
        n_w=3,
    )
    closed = close_loop(model, EVERY)
    p = closed.parameters.pack(some_values(EVERY))
    engine, u = VirtualMachine(closed), rng.normal(size=(80, 1))
    columns, state = np.arange(len(p)), np.zeros(closed.n_state)
    _, jac, *_ = engine.sensitivity(u, p, state, np.zeros((len(state), len(p))), columns)
    for i in range(len(p)):
        d = 1e-6 * np.eye(len(p))[i]
        slope = (engine.simulate(u, p + d, state)[0] - engine.simulate(u, p - d, state)[0]) / 2e-6
        np.testing.assert_allclose(jac[:, :, i], slope, atol=1e-6)


# ---- a machine whose resonance frequency falls with the level, with two inputs and outputs ----


def machine():
    """A PI-LFR with an envelope in the feedback, products, and plays at the inputs."""
    element = Combined(
        (
            Part("envelope", Envelope(2), (0, 1)),
            Part("products", Products(2, (2,)), (0, 1)),
            Part("input", PrandtlIshlinskii(Play, 2, 2), (2, 3), (0, 1)),
        )
    )
    block = np.array([[0.85, 0.45], [-0.45, 0.85]])
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = block, 0.98 * block.T
    rng = np.random.default_rng(3)
    B, C = 0.2 * rng.normal(size=(4, 2)), rng.normal(size=(2, 4))
    mask = np.kron(np.eye(2), np.ones((2, 2)))
    fixed = {"A": np.where(mask, np.nan, 0.0), "envelope_reach": 50.0, "products_reach": 10.0}
    fixed["C_z"] = np.vstack([np.full((2, 4), np.nan), np.zeros((2, 4))])
    fixed["D_zu"] = np.vstack([np.full((2, 2), np.nan), np.eye(2)])
    fixed["B_w"], fixed["D_yw"] = (np.hstack([np.full((n, 2), np.nan), np.zeros((n, 2))]) for n in (4, 2))
    structure = PILFR(4, element, fixed, {"envelope_rate": (1e-3, 0.5)}, offset=False)
    values = {
        "A": A,
        "B_u": B,
        "C_y": C,
        "B_w": np.hstack([0.05 * B, np.zeros((4, 2))]),
        "C_z": np.vstack([C, np.zeros((2, 4))]),
        "envelope_rate": np.full(2, 0.01),
        "envelope_knee": np.full(2, 1.0),
        "products_gain": 0.1 * rng.normal(size=(2, 3)),
        "input_w": np.full((2, 2), 0.2),
        "input_r": np.tile([0.3, 1.0], (2, 1)),
    }
    return structure, values


def steady_records(structure, values, levels=(0.4, 1.5), period=240, noise=0.0):
    model, rng = structure.model(2, 2, values), np.random.default_rng(5)
    engine, p, out = VirtualMachine(model), model.parameters.start, []
    for level in levels:
        u = level * np.tile(rng.normal(size=(period, 2)), (2, 1))
        state = np.zeros(model.n_state)
        for _ in range(8):
            _, state = engine.simulate(u, p, state)
        y, _ = engine.simulate(u, p, state)
        y = y + noise * np.std(y, axis=0) * rng.normal(size=y.shape)
        out.append(Recording(u, y, 1.0, period=period, initial="periodic", name=f"level {level}"))
    return out


def disturbed(structure, values, size=0.01):
    rng = np.random.default_rng(9)
    return {
        k: v if k.endswith("_reach") or k not in structure.model(2, 2).parameters else v * (1 + size * rng.normal())
        for k, v in values.items()
    }


def test_a_combined_machine_is_identified_in_steady_state(tmp_path):
    structure, values = machine()
    train = steady_records(structure, values)
    found = fit(structure, train, start=disturbed(structure, values), solver=GaussNewton(max_iterations=80), workers=2)
    assert max(found.train_nrmse) < 1e-3
    fresh = steady_records(structure, values, levels=(0.9,))
    assert found.nrmse(fresh) < 5e-3
    linear = fit(PILFR(4, offset=False), train)
    assert max(linear.train_nrmse) > 0.05  # the elements are needed
    found.save(tmp_path / "machine.json")
    again = load(tmp_path / "machine.json")
    assert again.structure.element == structure.element
    np.testing.assert_array_equal(again.simulate(fresh[0]), found.simulate(fresh[0]))
    assert len(found.plot(fresh).axes) >= 2 * 2 + 2 * 4  # outputs, and loop and loading curve of the channels
    np.testing.assert_allclose(found.export(start=fresh[0]).x0(), found.initial_state(fresh[0]))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    structure, values = machine()
    record = steady_records(structure, values, levels=(0.4,))
    path = tmp_path_factory.mktemp("saved") / "machine.json"
    fit(structure, record, start=values, solver=GaussNewton(max_iterations=1)).save(path)
    return json.loads(path.read_text())


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda e: e["parts"][0]["element"].update(kind="spring"), "element 'spring', which a file cannot hold"),
        (lambda e: e["parts"][0]["element"].update(channels=10**9), "parameter 'envelope_knee'"),
        (lambda e: e["parts"][1]["element"].update(degrees=[2, 50]), "parameter 'products_gain'"),
        (lambda e: e["parts"][2]["element"].update(n=10**9), "parameter 'input_w'"),
        (lambda e: e["parts"][0].update(reads=[0]), "1 channels and its element has 2"),
        (
            lambda e: e["parts"][0].update(element=json.loads(json.dumps(e))),
            "unknown key 'parts'",
        ),
        (lambda e: e.update(parts=[]), "give a list of Part"),
        (lambda e: e.update(parts=e["parts"] * 40), "combines 120 elements"),
        (lambda e: e.update(channels=3), "channel 3 of 3"),
    ],
)
def test_damaged_files_are_refused_in_one_sentence(saved, tmp_path, change, words):
    content = json.loads(json.dumps(saved))
    change(content["structure"]["element"])
    del content["sha256"]
    content["sha256"] = ordered_digest(content)
    path = tmp_path / "machine.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words) as error:
        load(path)
    said = str(error.value)
    assert ". " not in said and said.count(str(path)) == 1 and said.count("is damaged") <= 1


def test_the_response_is_bounded_and_the_bound_holds():
    structure, values = machine()
    record = steady_records(structure, values)[0]
    found = fit(structure, record, start=values, solver=GaussNewton(max_iterations=1))
    bound = response_bound(found, 2.0)
    assert bound.guaranteed and bound.radius < 1
    assert "bounded for every input" in str(bound)
    wild = 2.0 * np.sign(np.random.default_rng(0).normal(size=(500, 2)))
    y = found.simulate(record.with_(u=wild, y=np.zeros((500, 2)), period=None, initial="zero"))
    assert np.all(np.max(np.abs(y), axis=0) <= bound.outputs)
    loose = PILFR(1, PrandtlIshlinskii(Play, 2), {"D_zu": 0.0})
    loose = fit(loose, record.with_(u=record.u[:, :1], inputs=()), starts=1, stable=0.9)
    assert not response_bound(loose, 1.0).guaranteed
    assert "unbounded in channel 0" in str(response_bound(loose, 1.0))


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Envelope(0), "number of channels is 0"),
        (lambda: Products(2, ()), "degrees of products are"),
        (lambda: Products(2, (1,)), "degree of products is 1"),
        (lambda: Part("a b", Envelope(1), (0,)), "'a b'"),
        (lambda: Part("a", Envelope, (0,)), "give an element"),
        (lambda: Part("a", Envelope(2), (0,)), "1 channels and its element has 2"),
        (lambda: Part("a", Envelope(1), "0"), "give a tuple of channels"),
        (lambda: Part("a", Envelope(2), (0, 1), (1, 1)), "each channel once"),
        (lambda: Combined(()), "give a list of Part"),
        (lambda: Combined((Part("a", Envelope(1), (0,)), Part("a", Envelope(1), (1,)))), "a name of its own"),
        (lambda: Combined((Part("a", Envelope(1), (4,)),), 3), "channel 4 of 3"),
        (lambda: fit(PILFR(1, Envelope(1)), steady_records(*machine())), "give start="),
        (lambda: fit(PILFR(1), steady_records(*machine()), weights=[1, 1]), "fit from values"),
        (lambda: fit(PILFR(1), steady_records(*machine()), start={"Q": 1}), "'Q', which the model lacks"),
        (lambda: fit(PILFR(1), steady_records(*machine()), start={"A": np.eye(3)}), "start of 'A'"),
        (lambda: fit(PILFR(1), steady_records(*machine()), start={"A": 0.5}, weights=[1, 0]), "one above zero"),
        (lambda: fit(PILFR(1).model(2, 2), steady_records(*machine()), start={"A": 0.5}), "has its own start"),
        (lambda: fit(PILFR(1), steady_records(*machine()), start="near"), "'near' is unknown"),
    ],
)
def test_invalid_combinations_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
