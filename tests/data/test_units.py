"""Units as they are written: dimensions, conversions, and recordings in other units than the simulator's."""

from dataclasses import replace

import numpy as np
import pytest
from cart import cart

import pilfr_casadi as pilfr
from pilfr_casadi.data import conversion, dimension, insert_units, revolution_in
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.simulators import unit_notes


@pytest.mark.parametrize(
    ("unit", "wanted", "factor"),
    [
        ("mm", "m", 1e-3),
        ("Ncm", "N m", 1e-2),
        ("kNm", "N m", 1e3),
        ("deg", "rad", np.pi / 180),
        ("rpm", "rad/s", np.pi / 30),
        ("l/min", "m^3/s", 1e-3 / 60),
        ("mm/s", "m/s", 1e-3),
        ("bar", "kPa", 100.0),
        ("µm", "um", 1.0),
        ("N*m", "Nm", 1.0),
        ("%", "1", 1e-2),
        ("rev/s", "rad/s", 2 * np.pi),
        ("rpm", "Hz", None),
        ("Hz", "rad/s", None),
        ("g", "m/s^2", None),
        ("C", "°C", None),
        ("N/(m/s)", "N s/m", None),
        ("ct", "rad", None),
        ("m·s⁻¹", "mm/s", 1e3),
        ("m^2", "mm^2", 1e6),
        ("counts", "rad", None),
        ("", "m", None),
        ("counts", "counts", 1.0),
    ],
)
def test_a_unit_is_converted_to_another(unit, wanted, factor):
    assert conversion(unit, wanted) == (factor if factor is None else pytest.approx(factor, rel=1e-11))


@pytest.mark.parametrize(("unit", "wanted"), [("V", "m"), ("°C", "K"), ("°F", "degC"), ("degF", "K"), ("m", "m/s")])
def test_units_without_a_factor(unit, wanted):
    assert np.isnan(conversion(unit, wanted))


def test_dimensions_and_revolutions_are_read():
    assert dimension("N s/m") == dimension("kg/s") == (1, 0, -1, 0, 0)
    assert dimension("level") is None
    assert revolution_in("mrad") == pytest.approx(2e3 * np.pi)
    assert revolution_in("deg") == 360
    assert np.isnan(revolution_in("%"))


@pytest.fixture(scope="module")
def recorded():
    """A cart with friction, recorded in mm and in kN; the simulator has m and N."""
    u = 10 * pilfr.multisine(400, f_max=3.0, fs=20.0, rng=np.random.default_rng(1))
    units = {"force": "kN", "pos": "mm"}
    blank = pilfr.Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    y = cart().with_element("ground", CoulombFriction().at({"F_c": 3.0, "v_0": 0.01})).simulate(blank)
    noise = 1e-3 * np.std(y) * np.random.default_rng(0).standard_normal(y.shape)
    return blank.with_(u=u / 1e3, y=1e3 * (y + noise), units=units)


def test_the_conversion_of_a_recording_is_reported(recorded):
    stated = replace(cart(), units={"force": "N", "pos": "m"})
    found = pilfr.diagnose(stated, recorded, laws=(CoulombFriction,), workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("ground", "coulomb_friction")]
    assert found.effects[0].parameters["F_c"]["value"] == pytest.approx(3.0, rel=0.05)
    notes = [g.sentence for g in found.gates if g.finding == "conversion"]
    assert "pos is recorded in mm, and the simulator has it in m: its values were multiplied by 0.001." in notes
    assert found.nrmse(recorded) == pytest.approx(found.errors["train"]["after"], rel=1e-6)


def test_an_unknown_unit_is_reported(recorded):
    """Nothing converts it, so that the values may be far off."""
    stated = replace(cart(), units={"force": "N", "pos": "furlong"})
    notes = unit_notes(stated.units, recorded)
    assert notes["pos"] == (
        "pos is recorded in mm, and the simulator has it in furlong; no conversion is known, so that its values were "
        "taken as they are."
    )


def test_a_unit_of_something_else_is_refused(recorded):
    stated = replace(cart(), units={"pos": "V"})
    with pytest.raises(pilfr.InputError, match="has 'pos' in mm, and the simulator has it in V; give the values in V"):
        pilfr.diagnose(stated, recorded, laws=(CoulombFriction,), workers=1)


@pytest.mark.parametrize(
    ("unit", "force", "coordinate", "written"),
    [
        ("w", "m³/s", "m", "m³/s"),
        ("w*s/z", "N", "m", "N s/m"),
        ("w/z^3", "N m", "rad", "N m/rad^3"),
        ("w*s^3/z^3", "PWM", "rpm s", "PWM/rpm^3"),
        ("w/z", "N", "N", ""),
        ("1/z", "N", "m/s", "s/m"),
        ("w/z^n", "N", "rad/s", "N/(rad/s)^n"),
        ("[speed]^2", "N", "m", "[speed]^2"),
        ("w/z^2", "[w]", "m/(s rad)", "[w] s^2 rad^2/m^2"),
        ("w/z", "N", "m/(s/rad)", "N/(m/(s/rad))"),
    ],
)
def test_units_are_inserted_and_equal_symbols_collected(unit, force, coordinate, written):
    assert insert_units(unit, {"w": force, "z": coordinate}) == written


@pytest.fixture(scope="module")
def stated(recorded):
    """The simulator in m and N, and the same recording in its units."""
    simulator = replace(cart(), units={"force": "N", "pos": "m"})
    return simulator, recorded.with_(u=1e3 * recorded.u, y=recorded.y / 1e3, units=simulator.units)


def test_a_recording_is_converted_by_channel(recorded, stated):
    simulator, own = stated
    found = recorded.in_units(simulator.units)
    assert found.units == simulator.units
    np.testing.assert_allclose(np.hstack([found.u, found.y]), np.hstack([own.u, own.y]), rtol=1e-12)
    assert own.in_units(simulator.units) is own
    assert own.in_units({"pos": "furlong"}) is own
    with pytest.raises(pilfr.InputError, match="has 'pos' in mm, and"):
        recorded.in_units({"pos": "V"})


def test_observers_compensators_and_exports_use_the_units_of_the_model(recorded, stated):
    simulator, own = stated
    fitted = pilfr.fit(simulator, own)
    for model in (simulator, fitted, simulator.matched(own) and pilfr.exported(simulator, dt=own.dt, start=own)):
        one, other = (pilfr.control.kalman_filter(model, r) for r in (own, recorded))
        np.testing.assert_allclose(one.R, other.R, rtol=1e-6)
        np.testing.assert_allclose(one.spread, other.spread, rtol=1e-6)
    one, other = (pilfr.control.feedforward(fitted, r) for r in (own, recorded))
    assert one.limits == pytest.approx(other.limits)
    shifted = [r.slice(100, 300) for r in (own, recorded)]
    one, other = (pilfr.exported(simulator, dt=own.dt, start=r).x0() for r in shifted)
    np.testing.assert_allclose(one, other, rtol=1e-6)


def test_a_diagnosis_takes_recordings_in_any_unit(recorded, stated):
    simulator, own = stated
    found = pilfr.diagnose(simulator, recorded, laws=(CoulombFriction,), workers=1)
    one, other = (pilfr.control.kalman_filter(found, r) for r in (own, recorded))
    np.testing.assert_allclose(one.R, other.R, rtol=1e-6)
    shifted = [r.slice(100, 300) for r in (own, recorded)]
    np.testing.assert_allclose(*(found.export(start=r).x0() for r in shifted), rtol=1e-6)
    np.testing.assert_allclose(found.simulate(own), found.simulate(recorded), rtol=1e-9)
    np.testing.assert_allclose(found.matched(recorded).y, own.y, rtol=1e-12)


def test_weights_and_figures_of_a_fit_use_the_units_of_the_model(recorded, stated):
    simulator, own = stated
    fitted = pilfr.fit(simulator, [recorded, own.slice(0, 300)], weights=[2.0, 1.0])
    assert pilfr.fit(fitted, [recorded, own.slice(0, 300)]).options.weights == fitted.options.weights
    drawn = [fitted.plot(r).axes[0].lines[0].get_ydata() for r in (own, recorded)]
    np.testing.assert_allclose(*drawn, rtol=1e-9)
    drawn = [fitted.plot(r, "bode").axes[0].lines[0].get_ydata() for r in (own, recorded)]
    np.testing.assert_allclose(*drawn, rtol=1e-6)


def test_a_fit_without_a_simulator_keeps_the_units_of_its_training(recorded, stated):
    _, own = stated
    fitted = pilfr.fit(pilfr.PILFR(2), own)
    assert fitted.nrmse(recorded) == pytest.approx(fitted.nrmse(own), rel=1e-6)
    mixed = pilfr.fit(pilfr.PILFR(2), [own, recorded.slice(0, 300)])
    assert mixed.train_nrmse[1] < 2 * mixed.train_nrmse[0]
    unknown = replace(own.slice(0, 300), units={})
    assert pilfr.fit(pilfr.PILFR(2), [unknown, own]).nrmse(recorded) == pytest.approx(
        pilfr.fit(pilfr.PILFR(2), [unknown, own]).nrmse(own), rel=1e-6
    )


def test_values_without_a_unit_count_as_in_the_units_of_the_simulator(recorded, stated):
    simulator, own = stated
    fitted = pilfr.fit(simulator, replace(own, units={}))
    assert fitted.units == simulator.units
    one, other = (pilfr.control.kalman_filter(pilfr.exported(fitted), r) for r in (own, recorded))
    np.testing.assert_allclose(one.R, other.R, rtol=1e-6)


def test_a_simulation_does_not_need_the_units_of_the_outputs(stated):
    simulator, own = stated
    np.testing.assert_array_equal(simulator.simulate(replace(own, units={"pos": "V"})), simulator.simulate(own))
