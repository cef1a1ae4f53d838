"""Machines that are unstable: refused where no fit can follow them, and not where they swing within bounds."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator
from pilfr_casadi._base import InputError
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.preparation import prepare
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import discretise

DT, SAMPLES = 0.02, 600


def pendulum(a=20.0, sign=1.0):
    """Its angle is measured from the upper position; with another sign, from the lower."""
    return Simulator(
        lambda x, u, p: {"q": x.v, "v": sign * p.a * ca.sin(x.q) - p.d * x.v + u.f},
        lambda x: {"y": x.q},
        states=("q", "v"),
        inputs=("f",),
        parameters={"a": Parameter(a, bounds=(5, 80)), "d": Parameter(1.0, bounds=(0, 10))},
    )


def fell(gain=1.0):
    """Let go near the upper position, and driven."""
    rng, t = np.random.default_rng(0), np.arange(SAMPLES) * DT
    phases = rng.uniform(0, 6.28, 20)
    u = 5 / 3 * np.sum(np.cos(2 * np.pi * np.linspace(0.2, 2.5, 20)[:, None] * t + phases[:, None]), axis=0)[:, None]
    blank = Recording(u, u, DT, ("f",), ("y",), hold="zero")
    model = discretise(pendulum(), DT, "zero", 6)
    y = make_engine(model).simulate(model.drive(blank), model.parameters.start, np.array([0.1, 0.0]))[0]
    y = y + 1e-3 * np.std(y) * rng.standard_normal(y.shape)
    return blank.with_(y=gain * y, initial=[0.1, 0.0])


@pytest.mark.parametrize(("gain", "finding"), [(-1.0, "sign"), (180 / np.pi, "unit")])
def test_a_pendulum_that_falls_from_its_upper_position_is_followed_and_faults_are_told(gain, finding):
    ready = prepare(pendulum(21.0), [fell(gain)], None, "auto")
    assert [g.finding for g in ready.gates] == [finding]
    assert ready.without.cost**0.5 < 2e-3


def balanced():
    """Kept near the upper position by a controller that the simulator does not know."""
    loop = Simulator(
        lambda x, u, p: {"q": x.v, "v": 20 * ca.sin(x.q) - x.v + u.r - 60 * x.q - 8 * x.v},
        lambda x, u: {"y": x.q, "f": u.r - 60 * x.q - 8 * x.v},
        states=("q", "v"),
        inputs=("r",),
    )
    reference = np.random.default_rng(1).standard_normal((SAMPLES, 1))
    blank = Recording(reference, np.zeros((SAMPLES, 2)), DT, ("r",), ("y", "f"), initial="zero", hold="zero")
    y = loop.simulate(blank)
    return Recording(y[:, 1:], y[:, :1], DT, ("f",), ("y",), initial="zero", hold="zero")


def test_what_an_unstable_simulator_is_far_from_is_refused():
    with pytest.raises(InputError, match=r"runs away .* times the outputs' deviation; it is unstable .* put the contr"):
        pilfr.check(pendulum(), balanced())


def test_a_fit_that_an_interrupt_has_ended_is_not_refused():
    bench = Workbench.of(pendulum(), [balanced()], "zero")
    half = bench.run(pendulum(), {"d": 0.1}, [np.array([0.1, 0.0])])
    with pytest.raises(InputError, match="runs away"):
        bench.check_followed(half)
    bench.interrupt.pressed = True
    bench.check_followed(half)


def test_what_a_simulator_swings_about_or_a_stable_one_is_far_from_is_not_refused():
    assert pilfr.check(pendulum(sign=-1.0), balanced())
    other = pendulum(40.0)
    held = other.with_parameters({k: replace(p, fixed=True) for k, p in other.parameters.items()})
    assert pilfr.check(held, fell())
