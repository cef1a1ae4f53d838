"""Recorded rates that do not belong to the recorded coordinate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.diagnose.faults.rates import find_wrong_rates
from pilfr_casadi.diagnose.fits.workbench import Workbench
from pilfr_casadi.simulators import Numeric, from_function

DT, TAU = 0.02, 0.2
T = DT * np.arange(1500)
POSITION = 0.2 * np.sin(0.6 * T) + 0.05 * np.sin(1.7 * T + 1)
SPEED = np.gradient(POSITION, DT)


def filtered(v: np.ndarray, tau: float = TAU) -> np.ndarray:
    """Filter with a lag of first order."""
    out = np.zeros_like(v)
    for k in range(1, len(v)):
        out[k] = out[k - 1] + DT / tau * (v[k - 1] - out[k - 1])
    return out


SPINDLE = Simulator(
    lambda x, u, p: {},
    lambda x, u, p: {"current": p.d * u.speed + p.g},
    states=(),
    inputs=("position", "speed"),
    parameters={"d": Parameter(1.0), "g": Parameter(1.0)},
    ports=(Port("spindle", into={"current": 1}, across=lambda u: u.position, rate=lambda u: u.speed),),
)
MASS = Simulator(
    lambda x, u, p: {"position": x.speed, "speed": u.force - p.d * x.speed},
    lambda x: {"position": x.position, "speed": x.speed},
    states=("position", "speed"),
    inputs=("force",),
    parameters={"d": Parameter(1.0)},
)


def sentences(simulator: Simulator, *columns: list[list[np.ndarray]]) -> list[str]:
    """Return the notes on recordings, each given by the columns of u and of y."""
    noise, recordings = np.random.default_rng(0), []
    for pair in columns:
        u, y = (np.column_stack([v + 1e-4 * noise.standard_normal(len(v)) for v in each]) for each in pair)
        recordings.append(pilfr.Recording(u, y, DT, inputs=simulator.inputs, outputs=simulator.output_names))
    return [gate.sentence for gate in find_wrong_rates(Workbench.of(simulator, recordings, "zero", "auto"))]


def test_a_filtered_speed_is_late() -> None:
    (found,) = sentences(SPINDLE, [[POSITION, filtered(SPEED)], [SPEED]])
    assert found.startswith("speed follows the derivative of position 0.2 s late, as from a filter. Laws that depend")
    assert found.endswith("wrong names: compute it as the derivative of position.")
    (found,) = sentences(MASS, [[SPEED], [POSITION, filtered(SPEED)]])
    assert found.startswith("speed follows the derivative of position 0.2 s late")
    assert found.endswith("wrong names: leave speed out of the simulator's outputs.")


@pytest.mark.parametrize("delay", [0.2, 0.4])
def test_a_delayed_speed_of_one_frequency_has_no_other_unit(delay: float) -> None:
    """A lag of first order would also lose amplitude, so that a factor made up for it."""
    position, speed = np.sin(2 * T), 2 * np.cos(2 * (T - delay))
    first = [[position[:5], 2 * np.cos(2 * T[:5])], [speed[:5]]]
    (found,) = sentences(SPINDLE, [[position, speed], [speed]], first)
    assert found.startswith(f"speed follows the derivative of position {delay} s late, as from a filter.")


def test_no_factor_is_told_where_a_lag_and_a_delay_need_different_ones() -> None:
    """Three filters in a row take more amplitude than a delay does, and less than one lag that is as late."""
    (found,) = sentences(SPINDLE, [[POSITION, filtered(filtered(filtered(SPEED, 0.3), 0.3), 0.3)], [SPEED]])
    assert found.startswith("speed follows the derivative of position 1.01 s late, as from a filter.")


@pytest.mark.parametrize("read", [True, False])
def test_a_command_is_no_rate_unless_a_port_reads_it(read: bool) -> None:
    """An actuator that moves more than it is told is physics of the actuator."""
    port = Port("slide", into={"position": -1}, across=lambda x: x.position, rate=lambda u: u.speed)
    cart = Simulator(
        lambda x, u: {"position": u.speed},
        lambda x: {"position": x.position},
        states=("position",),
        inputs=("speed",),
        ports=(port,) if read else (),
    )
    found = sentences(cart, [[SPEED], [1.5 * POSITION]])
    assert [text[:15] for text in found] == ["speed is 0.667 "] * read


def test_another_program_is_not_called() -> None:
    called = list[float]()

    def swing(t: float, x: Any, u: Any, p: Any) -> list[float]:
        called.append(float(p["k"]))
        return [x[1], u[0] - p["k"] * x[0] - 2 * x[1]]

    names = {"states": ("pos", "vel"), "inputs": "force", "parameters": {"k": Parameter(40.0, bounds=(20, 80))}}
    simulator = from_function(swing, ("pos", "vel"), numeric=Numeric(), **names)
    r = pilfr.Recording(SPEED, np.zeros((1500, 2)), DT, "force", ("pos", "vel"), hold="linear", initial="zero")
    y = simulator.simulate(r)
    r = r.with_(y=np.column_stack([y[:, 0], filtered(y[:, 1])]))
    bench = Workbench.of(simulator, [r], "linear", "auto")
    called.clear()
    (found,) = find_wrong_rates(bench)
    assert found.sentence.startswith("vel follows the derivative of pos 0.201 s late") and not called


@pytest.mark.parametrize(("factor", "words"), [(57.3, "57.3"), (-1.0, "-1")])
def test_a_speed_in_another_unit(factor: float, words: str) -> None:
    (found,) = sentences(SPINDLE, [[POSITION, factor * SPEED], [SPEED]])
    assert found.startswith(f"speed is {words} times the derivative of position, as from another unit or sign.")


def test_a_right_rate_and_an_unrelated_one_are_not_noted() -> None:
    assert not sentences(SPINDLE, [[POSITION, SPEED], [SPEED]])
    assert not sentences(SPINDLE, [[POSITION, np.sin(3 * T)], [SPEED]])
    assert not sentences(MASS, [[SPEED], [POSITION, SPEED]])
    drifting = POSITION + 0.01 * np.cumsum(SPEED**2) * DT + 0.1 * T  # an offset of the rate is no other rate
    assert not sentences(SPINDLE, [[drifting, SPEED], [SPEED]])


def test_a_steady_motion_without_noise_tells_nothing_of_its_rate() -> None:
    u = np.column_stack([T, np.full(len(T), 57.3)])
    r = pilfr.Recording(u, np.ones((len(T), 1)), DT, inputs=SPINDLE.inputs, outputs=SPINDLE.output_names)
    assert not find_wrong_rates(Workbench.of(SPINDLE, [r], "zero", "auto"))


def test_friction_that_helps_the_motion_points_to_a_reversed_sign() -> None:
    every = slice(None, None, 3)
    friction = 0.5 * np.tanh(SPEED / 0.005)
    for sign in (1, -1):
        r = pilfr.Recording(
            np.column_stack([POSITION, SPEED])[every],
            (sign * (friction + 0.3 * SPEED) + 1 + 0.05 * np.sin(7 * T) + 0.2 * np.sin(0.2 * T))[every, None],
            3 * DT,
            inputs=SPINDLE.inputs,
            outputs=SPINDLE.output_names,
            hold="zero",
        )
        found = pilfr.diagnose(SPINDLE, r, laws=("coulomb_friction",), effects=1, workers=1)
        if found.nameless is None:
            pytest.fail(str(found))
        assert ("as fitted it helps the motion" in str(found)) is (sign < 0)
