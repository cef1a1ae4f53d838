"""Recorded rates that do not belong to the recorded coordinate."""

from __future__ import annotations

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.diagnose.faults.rates import find_wrong_rates
from pilfr_casadi.diagnose.fits.workbench import Workbench

DT, TAU = 0.02, 0.2
T = DT * np.arange(1500)
POSITION = 0.2 * np.sin(0.6 * T) + 0.05 * np.sin(1.7 * T + 1)
SPEED = np.gradient(POSITION, DT)


def filtered(v: np.ndarray) -> np.ndarray:
    """Filter with a lag of first order."""
    out = np.zeros_like(v)
    for k in range(1, len(v)):
        out[k] = out[k - 1] + DT / TAU * (v[k - 1] - out[k - 1])
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


def sentences(simulator: Simulator, u: list[np.ndarray], y: list[np.ndarray]) -> list[str]:
    noise = np.random.default_rng(0)
    columns = [np.column_stack([v + 1e-4 * noise.standard_normal(len(v)) for v in each]) for each in (u, y)]
    r = pilfr.Recording(*columns, DT, inputs=simulator.inputs, outputs=simulator.output_names)
    return [gate.sentence for gate in find_wrong_rates(Workbench.of(simulator, [r], "zero", "auto"))]


def test_a_filtered_speed_is_late() -> None:
    (found,) = sentences(SPINDLE, [POSITION, filtered(SPEED)], [SPEED])
    assert found.startswith("speed follows the derivative of position 0.2 s late, as from a filter. Laws that depend")
    (found,) = sentences(MASS, [SPEED], [POSITION, filtered(SPEED)])
    assert found.startswith("speed follows the derivative of position 0.2 s late")


@pytest.mark.parametrize(("factor", "words"), [(57.3, "57.3"), (-1.0, "-1")])
def test_a_speed_in_another_unit(factor: float, words: str) -> None:
    (found,) = sentences(SPINDLE, [POSITION, factor * SPEED], [SPEED])
    assert found.startswith(f"speed is {words} times the derivative of position, as from another unit or sign.")


def test_a_right_rate_and_an_unrelated_one_are_not_noted() -> None:
    assert not sentences(SPINDLE, [POSITION, SPEED], [SPEED])
    assert not sentences(SPINDLE, [POSITION, np.sin(3 * T)], [SPEED])
    assert not sentences(MASS, [SPEED], [POSITION, SPEED])
    drifting = POSITION + 0.01 * np.cumsum(SPEED**2) * DT + 0.1 * T  # an offset of the rate is no other rate
    assert not sentences(SPINDLE, [drifting, SPEED], [SPEED])


def test_friction_that_helps_the_motion_points_to_a_reversed_sign() -> None:
    friction = 0.5 * np.tanh(SPEED / 0.005)
    for sign in (1, -1):
        r = pilfr.Recording(
            np.column_stack([POSITION, SPEED]),
            (sign * (friction + 0.3 * SPEED) + 1 + 0.05 * np.sin(7 * T) + 0.2 * np.sin(0.2 * T))[:, None],
            DT,
            inputs=SPINDLE.inputs,
            outputs=SPINDLE.output_names,
        )
        found = pilfr.diagnose(SPINDLE, r, laws=("coulomb_friction",), effects=1, workers=1, time_limit=20)
        if found.nameless is None:
            pytest.fail(str(found))
        assert ("as fitted it helps the motion" in str(found)) is (sign < 0)
