"""Physical domains: inferred from units, and the laws that a port of each domain admits."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Port, Simulator, laws
from pilfr_casadi.simulators import infer_domain


@pytest.mark.parametrize(
    ("force", "coordinate", "domain"),
    [
        ("N", "m", "mechanical"),
        ("N m", "rad", "mechanical"),
        ("kN", "mm", "mechanical"),
        ("mN·m", "deg", "mechanical"),
        ("m/s^2", "m", "mechanical"),
        ("N", "", "mechanical"),
        ("W", "K", "thermal"),
        ("kW", "°C", "thermal"),
        ("K/s", "K", "thermal"),
        ("A", "V", "electrical"),
        ("mV", "A", "electrical"),
        ("A", "V s", "electrical"),
        ("V", "1", "electrical"),
        ("V", "soc", "electrical"),
        ("m^3/s", "Pa", "fluid"),
        ("m³/s", "m", "fluid"),
        ("l/min", "bar", "fluid"),
        ("kg/s", "kPa", "fluid"),
        ("Pa", "m^3/s", "fluid"),
        ("", "", "unknown"),
        ("level/s", "level", "unknown"),
        ("m/s", "m", "unknown"),
        ("N", "A", "unknown"),
        ("V", "m^0.5", "electrical"),
        ("W", "", "unknown"),
    ],
)
def test_a_domain_follows_from_two_units(force, coordinate, domain):
    assert infer_domain(force, coordinate) == domain
    assert Port("port", {"x": 1.0}, lambda x: x.x, unit=force, across_unit=coordinate).domain == domain


def port(unit="", across_unit="", domain=""):
    return Port("port", {"x": -1.0}, lambda x: x.x, None, unit, across_unit, domain=domain)


def rig(*ports):
    return Simulator(
        lambda x, u: {"x": u.drive - x.x}, lambda x: {"y": x.x}, states=("x",), inputs=("drive",), ports=ports
    )


@pytest.mark.parametrize(
    "law", [laws.Mode, laws.QuadraticDrag, laws.CubicDamping, laws.DirectionalDamping, laws.Clearance]
)
def test_heat_has_no_inertia_no_drag_and_no_gap(law):
    assert port("N", "m").admits(law) and port().admits(law) and not port("W", "K").admits(law)


@pytest.mark.parametrize("law", [laws.LinearStiffness, laws.ViscousDamping, laws.Relaxation])
def test_general_laws_have_words_of_their_own_for_heat(law):
    own = law.sentences["thermal"]
    for one in (law, laws.scheduled(law, "u"), laws.scaled(law, "u")):
        assert port("W", "K").admits(one) and "heat" in one.sentences["thermal"] and "heat" not in one.sentence
        assert one.sentence.removeprefix(law.sentence) == one.sentences["thermal"].removeprefix(own)


def test_the_user_may_state_the_domain():
    assert port("level/s", "level", "fluid").domain == "fluid"
    assert port("N", "m", "unknown").domain == "unknown"
    with pytest.raises(InputError, match="The domain of port 'port' is 'optical'; give mechanical, thermal"):
        port(domain="optical")


def test_special_laws_are_for_their_own_domain_alone():
    special = {law for law in laws.CATALOGUE if law.special}
    assert {laws.Radiation, laws.Diode, laws.SaturatingInductance, laws.FreeCurve} <= special
    at = {name: {law for law in laws.CATALOGUE if port(domain=name).admits(law)} for name in ("mechanical", "unknown")}
    everywhere = {k for k in laws.CATALOGUE if "parallel" in k.places and not k.in_line}  # no unit: z may be an angle
    assert not at["mechanical"] & special and not at["unknown"] & special
    assert at["mechanical"] == at["unknown"] == everywhere - special
    assert port("N m", "rad").admits(laws.Gravity) and port("N m", "deg").admits(laws.WholeGravity)
    assert not port("N", "m").admits(laws.Gravity) and not port("N m", "1").admits(laws.Gravity)
    assert port("W", "K").admits(laws.Radiation) and not port("A", "V").admits(laws.Radiation)
    assert port("A", "mV").admits(laws.Diode) and not port("V", "1").admits(laws.Diode)
    assert port("V", "A").admits(laws.Overpotential) and not port("A", "V").admits(laws.Overpotential)
    assert port("A", "V").admits(laws.Clamp) and port("m^3/s", "Pa").admits(laws.FreeCurve)


def test_friction_is_mechanical_and_hysteresis_is_everywhere():
    for domain in ("thermal", "electrical", "fluid"):
        here = port(domain=domain)
        assert not here.admits(laws.CoulombFriction) and not here.admits(laws.behind_gap(laws.CoulombFriction))
        assert here.admits(laws.StopHysteresis) and here.admits(laws.Orifice) and here.admits(laws.CubicStiffness())


def test_a_signal_belongs_to_the_domain_that_all_ports_share():
    thermal, fluid = port("W", "K"), Port("valve", {"x": 1.0}, lambda x: x.x, unit="m^3/s", across_unit="Pa")
    assert rig(thermal).port("actuator:drive").domain == rig(thermal).port("sensor:y").domain == "thermal"
    assert rig(thermal, fluid).port("actuator:drive").domain == "unknown"
    assert rig().port("sensor:y").domain == "unknown"
    assert rig(fluid).port("actuator:drive").admits(laws.Exponential)
    assert not rig().port("actuator:drive").admits(laws.Exponential)


def test_a_law_may_be_closed_in_at_any_port():
    """The domain decides what a diagnosis tries, not what a user may build."""
    closed = pilfr.close_loop(rig(port()), laws.Radiation().at({"G": 0.1}), "port")
    still = pilfr.Recording(np.zeros(20), np.zeros(20), 0.1, ("drive",), ("y",), initial="zero")
    np.testing.assert_allclose(closed.simulate(still), 0.0)
