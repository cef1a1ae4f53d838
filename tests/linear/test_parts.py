"""Linear parts: a PI-LFR in small and large motions, and a simulator about its working point."""

from dataclasses import replace

import control
import numpy as np
import pytest

from pilfr_casadi import InputError, Parameter, Simulator
from pilfr_casadi.linear import linear_parts
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, Stop, accumulate_steps
from pilfr_casadi.simulators import discretise

DT = 0.1
VALUES = {
    "A": [[0.6, 0.3], [-0.3, 0.6]],
    "B_u": [[1.0], [0.5]],
    "B_w": [[0.1], [-0.2]],
    "C_y": [[1.0, 2.0]],
    "D_yu": [[0.1]],
    "D_yw": [[0.5]],
    "C_z": [[1.0, 0.3]],
    "D_zu": [[0.2]],
    "w": [[0.5, 0.3]],
    "r": [[1.0, 2.0]],
}


def run(model, u):
    p = np.broadcast_to(model.parameters.start, (len(u), model.parameters.size))
    return accumulate_steps(model.closed, np.zeros(model.n_state), u[:, None], p)[1][:, 0]


def linear_run(part, u):
    x, y = np.zeros(len(part.A)), []
    for value in u:
        y.append((part.C @ x + part.D[:, 0] * value)[0])
        x = part.A @ x + part.B[:, 0] * value
    return np.array(y)


@pytest.mark.parametrize("threshold", [1.0, 0.0])
@pytest.mark.parametrize("operator", [Play, Stop])
def test_small_and_large_motions_match_simulations(operator, threshold):
    model = PILFR(2, PrandtlIshlinskii(operator, 2)).model(1, 1, {**VALUES, "r": [[threshold, 2.0]]})
    parts = linear_parts(model, DT)
    u = np.random.default_rng(0).normal(size=60)
    np.testing.assert_allclose(run(model, 1e-4 * u), linear_run(parts["small motions"], 1e-4 * u), atol=1e-12)
    rising = 1e4 * np.arange(1.0, 40.0)  # every operator moves in the same direction
    large, expected = run(model, rising), linear_run(parts["large motions"], rising)
    assert np.max(np.abs(large - expected)) < 1e-4 * np.max(np.abs(large))


def oscillator(power=1):
    return Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos**power - 0.8 * x.vel),
        lambda x, u: dict(position=x.pos, acceleration=u.force - 4 * x.pos),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(k=Parameter(9.0)),
    )


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("substeps", [1, 4])
def test_a_linear_simulator_is_its_own_linear_part(hold, substeps):
    model = discretise(oscillator(), DT, hold, substeps)
    (part,) = linear_parts(model, DT).values()
    exact = control.c2d(control.ss([[0, 1], [-9.0, -0.8]], [[0], [1.0]], [[1.0, 0], [-4, 0]], [[0], [1.0]]), DT)
    np.testing.assert_allclose(part.A, exact.A, atol=2e-4)
    np.testing.assert_allclose(part.B, exact.B, atol=2e-4)
    np.testing.assert_allclose(part.D, exact.D, atol=1e-9)
    f = np.array([0.1, 1.0, 3.0])
    np.testing.assert_allclose(
        part.response(f)[:, 0, 0], control.frequency_response(exact, 2 * np.pi * f).complex[0, 0], rtol=2e-3
    )


def test_a_nonlinear_simulator_is_linearised_about_a_working_point():
    model = discretise(oscillator(3), DT, "zero", 2)
    part = linear_parts(model, DT, np.array([2.0, 0.0]), np.array([72.0]))["linearised"]
    stiffness = 3 * 9 * 2.0**2
    rate = np.log(complex(part.poles[np.argmax(part.poles.imag)])) / DT
    assert abs(rate) == pytest.approx(np.sqrt(stiffness), rel=0.02)


def test_poles_and_zeros_are_those_of_the_transfer_function():
    model = discretise(oscillator(), DT, "zero", 1)
    (part,) = linear_parts(model, DT).values()
    system = control.ss(part.A, part.B, part.C[:1], part.D[:1], DT)
    np.testing.assert_allclose(np.sort_complex(part.poles), np.sort_complex(system.poles()), atol=1e-9)
    np.testing.assert_allclose(np.sort_complex(part.zeros(0, 0)), np.sort_complex(system.zeros()), atol=1e-8)
    assert len(part.zeros(1, 0)) == 2


def test_an_observer_is_refused():
    led = replace(oscillator(), observer=np.zeros((2, 2)))
    with pytest.raises(InputError, match="leave out its observer"):
        linear_parts(discretise(led, DT, "zero", 1), DT)
