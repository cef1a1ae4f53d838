"""Diagnoses of real recordings, and of the paper's rig: what has to be named, and how well the rest is followed."""

import pytest

from problems import emps, masing_diagnosis, piezo_diagnosis, silverbox, tanks
from problems.measured_data import measured

pytestmark = pytest.mark.slow


def folder_of(name):
    folder = measured(name)
    if folder is None:
        pytest.skip(f"the recordings of {name} are not beside the repository; see PILFR_DATA")
    return folder


def named(diagnosis):
    assert diagnosis.verdict == "missing-physics", diagnosis.sentence
    return [(e.port, e.law) for e in diagnosis.effects]


def close(diagnosis, law, port):
    """Whether a law stands at a port of the corrected simulator, named or said to be among the closest."""
    return (port, law) in [(e.port, e.law.id) for e in diagnosis.corrected.elements]


def test_axis_lacks_friction():
    diagnosis, errors = emps.run(folder_of("emps"))
    assert close(diagnosis, "coulomb_friction", "axis") or close(diagnosis, "stribeck_friction", "axis")
    assert errors["after"]["test"] <= 8.0
    assert errors["after"]["closed loop"] <= 0.1


def test_silverbox_lacks_a_cubic_stiffness_and_its_input_is_band_limited():
    """A stiffness k + c v^2 is a cubic stiffness."""
    diagnosis, errors = silverbox.run(folder_of("silverbox"))
    assert diagnosis.hold == "band-limited"
    assert named(diagnosis)[0] in [("feedback", "cubic_stiffness"), ("parameter:k", "varying_parameter")]
    assert errors["after"]["arrow"] <= 0.6
    assert errors["after"]["arrow inside"] <= 0.3
    assert errors["before"]["arrow"] > 10


@pytest.fixture(scope="module")
def tanks_found():
    return {root: tanks.run(folder_of("cascaded_tanks"), root) for root in (False, True)}


def test_tanks_overflow(tanks_found):
    diagnosis, errors = tanks_found[True]
    assert close(diagnosis, "piecewise_stiffness", "upper-tank")
    assert errors["after"]["test"] < 0.5 * errors["before"]["test"]


def test_tanks_are_followed_as_well_as_published_models_do(tanks_found):
    assert tanks_found[True][1]["after"]["test"] <= 0.20


def test_tanks_with_linear_outflow_are_followed_better(tanks_found):
    diagnosis, errors = tanks_found[False]
    assert "upper-tank" in diagnosis.sentence
    assert errors["after"]["test"] <= 0.7 * errors["before"]["test"]


@pytest.mark.xfail(reason="a pump that gives less at a high level imitates the overflow, and is preferred")
def test_tanks_with_linear_outflow_overflow_too(tanks_found):
    assert close(tanks_found[False][0], "piecewise_stiffness", "upper-tank")


@pytest.fixture(scope="module")
def piezo_found():
    return piezo_diagnosis.run(folder_of("piezo_dbo"))


def test_piezo_stack_has_hysteresis(piezo_found):
    diagnosis, errors = piezo_found
    ports = [port for port, law in named(diagnosis) if law == "hysteresis"]
    assert ports and ports[0] in ("actuator:u_control_V", "sensor:y_disp_um")  # the simulator is a gain
    assert errors["before"] > 5
    assert errors["after"] < 0.5 * errors["before"]


@pytest.mark.xfail(reason="generalized plays with creep follow the nested loops to 2.6 % of the range")
def test_piezo_stack_is_followed(piezo_found):
    assert piezo_found[1]["after"] <= 2.2


@pytest.mark.parametrize("seed", [0, 1])
def test_rig_without_its_spring(seed):
    diagnosis, errors = masing_diagnosis.run(seed)
    assert named(diagnosis) == [("ground-m1", "hysteresis")]
    assert max(abs(v) for v in masing_diagnosis.off(diagnosis).values()) <= 3.0
    assert max(errors["after"].values()) <= 0.006
