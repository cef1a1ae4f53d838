"""The Prandtl-Ishlinskii element: a weighted sum of operators, channel by channel."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from random_models import OPERATORS, reference_step

from pilfr_casadi._base import InputError
from pilfr_casadi.models import GeneralizedPlay, Parameter, ParameterSet, Play, PrandtlIshlinskii, Stop


def values_of(element, seed):
    rng = np.random.default_rng(seed)
    out = {k: np.array(p.value) for k, p in element.parameters().items()}
    out["w"], out["r"] = rng.uniform(0, 1, out["w"].shape), rng.uniform(0, 1, out["r"].shape)
    return out


def as_function(element):
    parameters = element.parameters()
    z, s, p = ca.SX.sym("z", element.channels), ca.SX.sym("s", element.memory), ca.SX.sym("p", parameters.size)
    return ca.Function("element", [z, s, p], element.step(z, s, parameters.symbols(p))), parameters


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("channels, n", [(1, 1), (1, 5), (3, 2)])
def test_eq_16_is_the_weighted_sum_of_every_channel(operator, channels, n):
    element = PrandtlIshlinskii(operator, n, channels)
    step, parameters = as_function(element)
    values, rng = values_of(element, 0), np.random.default_rng(1)
    p, state = parameters.pack(values), np.zeros(channels * n)
    memory = np.zeros((channels, n))
    for _ in range(20):
        z = rng.normal(size=channels)
        w, state = (np.asarray(a).ravel() for a in step(z, state, p))
        expected = np.zeros(channels)
        for i in range(channels):
            for j in range(n):
                v, memory[i, j] = reference_step(operator, z[i], memory[i, j], values["r"][i, j], values, i)
                expected[i] += values["w"][i, j] * v
        np.testing.assert_allclose(w, expected, atol=1e-14)
        np.testing.assert_allclose(state, memory.ravel(), atol=1e-14)


@pytest.mark.parametrize("operator", OPERATORS)
def test_size_and_bounds(operator):
    element = PrandtlIshlinskii(operator, 4, channels=2)
    p = element.parameters()
    assert element.memory == 8
    assert p["w"].value.shape == p["r"].value.shape == (2, 4)
    for name in ("w", "r"):
        assert (p[name].bounds[0] == 0).all()
        assert np.isinf(p[name].bounds[1]).all()
    assert len(np.unique(p["r"].value[0])) == 4  # identical thresholds stay identical forever
    np.testing.assert_allclose(p["w"].value.sum(axis=1), 1.0)


def test_a_class_and_an_instance_are_equivalent():
    assert PrandtlIshlinskii(Play, 3) == PrandtlIshlinskii(Play(), 3)
    assert PrandtlIshlinskii(GeneralizedPlay(neurons=5), 3).parameters()["gamma_l_a"].value.shape == (1, 5)


def test_envelopes_start_close_to_the_identity_and_bounded_below():
    p = PrandtlIshlinskii(GeneralizedPlay, 3).parameters()
    z = np.linspace(-3, 3, 50)
    named = {k: np.array(v.value) for k, v in p.items()}
    for side in ("l", "r"):
        assert np.max(np.abs(GeneralizedPlay().envelope(side, z, named) - z)) < 0.05
        for name in ("a0", "a", "b"):
            assert (p[f"gamma_{side}_{name}"].bounds[0] == 0).all()


def test_user_defined_envelopes_have_parameters():
    bent = GeneralizedPlay(
        gamma_l=lambda z, p: p["bend"] * z, gamma_r=lambda z, p: z, extra=ParameterSet({"bend": Parameter(1.5)})
    )
    step, parameters = as_function(PrandtlIshlinskii(bent, 2))
    assert tuple(parameters) == ("w", "r", "bend")
    p = parameters.pack({"w": [[1.0, 0.0]], "r": [[0.5, 0.5]], "bend": 2.0})
    w, _ = step(3.0, [0.0, 0.0], p)
    assert float(w) == 2.0 * 3.0 - 0.5


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.01, 0.5))
def test_rounding_is_a_parameter_that_is_fixed_at_zero(z, q, eps):
    step, parameters = as_function(PrandtlIshlinskii(Stop, 1, rounded=True))
    exact, _ = as_function(PrandtlIshlinskii(Stop, 1))
    assert parameters["eps"].fixed.all()
    assert parameters["eps"].value == 0.0
    p = parameters.pack({"r": [[0.5]]})
    plain = exact(z, q, [1.0, 0.5])
    for a, b in zip(step(z, q, p), plain, strict=True):
        assert float(a) == pytest.approx(float(b), abs=1e-15)
    off = step(z, q, parameters.pack({"r": [[0.5]], "eps": eps}))
    assert abs(float(off[0]) - float(plain[0])) <= eps / 4 + 1e-15


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: PrandtlIshlinskii(Play, 0), "n of a Prandtl-Ishlinskii element is 0; give a whole number"),
        (lambda: PrandtlIshlinskii(Play, 3, channels=0), "channels of a Prandtl-Ishlinskii element is 0"),
        (lambda: PrandtlIshlinskii(int, 3), "use Play, Stop or GeneralizedPlay"),
        (lambda: PrandtlIshlinskii("play", 3), "use Play, Stop or GeneralizedPlay"),
        (lambda: PrandtlIshlinskii(Play, 2.5), "whole number"),
    ],
)
def test_invalid_elements_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
