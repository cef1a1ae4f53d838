"""A parameter of the simulator that varies with a signal: closed in, found, named, drawn."""

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import InputError
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench, port_signals
from pilfr_casadi.diagnose.fits.evidence import log_prior
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.proof import placebo
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.laws import (
    VARIATIONS,
    CoulombFriction,
    CubicStiffness,
    Delay,
    VaryingParameter,
    heated,
    strengths_over,
    varying,
)

DT, SAMPLES = 5e-3, 1500
R, L, K, J, C = 1.3, 0.04, 0.08, 2e-3, 6e-3


def motor(resistance=lambda x, u, p: p.R, **free):
    """A motor whose winding has a constant resistance, unless another one is given."""
    return pilfr.Simulator(
        lambda x, u, p: {
            "i": (u.voltage - resistance(x, u, p) * x.i - p.K * x.w) / L,
            "w": (p.K * x.i - p.c * x.w) / J,
        },
        lambda x: {"current": x.i, "speed": x.w},
        states=("i", "w"),
        inputs=("voltage", "temperature"),
        parameters={
            "R": pilfr.Parameter(1.0, bounds=(0.2, 5.0), unit="Ohm"),
            "K": pilfr.Parameter(0.07, bounds=(0.02, 0.3), unit="N m/A"),
            "c": pilfr.Parameter(4e-3, bounds=(0.0, 0.1), unit="N m s"),
            **free,
        },
        ports=(pilfr.Port("bearing", {"w": -1 / J}, lambda x: x.w, lambda x: x.w, "N m", "rad/s"),),
        units={"temperature": "degC"},
    )


def warm(x, u, p):
    """A resistance that grows by 40 % from 20 to 80 degC."""
    return R * (1 + 0.4 * (u.temperature - 20) / 60)


def blank(seed, temperature):
    """A recording without outputs: a multisine of the voltage, and a temperature at both ends."""
    rng = np.random.default_rng(seed)
    voltage = 6.0 * pilfr.multisine(SAMPLES, f_max=8.0, fs=1 / DT, rng=rng)
    course = np.linspace(*temperature, SAMPLES) + 3 * np.sin(np.arange(SAMPLES) / 200)
    return pilfr.Recording(
        np.column_stack([voltage, course]), np.zeros((SAMPLES, 2)), DT, ("voltage", "temperature"),
        ("current", "speed"), initial="zero", hold="zero",
    )  # fmt: skip


def recorded(seed, temperature):
    """A recording of the machine that grows warm, with noise of 1 %."""
    true = motor(warm).with_parameters({"K": K, "c": C})
    r = blank(seed, temperature)
    y = true.simulate(r)
    return r.with_(y=y + 0.01 * y.std(axis=0) * np.random.default_rng(seed + 1).standard_normal(y.shape))


@pytest.mark.parametrize("profile", VARIATIONS[:2])
def test_a_varying_parameter_equals_equations_that_write_it_out(profile):
    """In the middle of the range the parameter has its own value; at the ends it is changed by c and c_high."""
    law = varying("temperature", profile)().at({"c": 0.3, "c_high": 0.3, "low": 20, "high": 80}
                                               if profile == "bend" else {"c": 0.3, "low": 20, "high": 80})  # fmt: skip
    closed = motor().with_element("parameter:R", law)

    def resistance(x, u, p):
        share = (u.temperature - 50) / 30
        return p.R + 0.3 * (share**2 if profile == "bend" else share)

    r = blank(1, (25, 75))
    np.testing.assert_allclose(closed.simulate(r), motor(resistance).simulate(r), rtol=1e-9)


def test_a_parameter_may_vary_with_a_state():
    """The signal is a state of the run, not of the recording."""
    law = varying("w")().at({"c": 0.02, "low": -10.0, "high": 10.0})
    closed, r = motor().with_element("parameter:R", law), blank(2, (20, 30))
    written = motor(lambda x, u, p: p.R + 0.02 * x.w / 10)
    np.testing.assert_allclose(closed.simulate(r), written.simulate(r), rtol=1e-9)


def warm_motor(heat, resistance=lambda x, p: p.R, friction=lambda x, p: p.c):
    """Write a motor with a slow state `q`, which `heat` drives."""
    return pilfr.Simulator(
        lambda x, u, p: {
            "i": (u.voltage - resistance(x, p) * x.i - p.K * x.w) / L,
            "w": (p.K * x.i - friction(x, p) * x.w) / J,
            "q": (heat(x) - x.q) / 1.5,
        },
        lambda x: {"current": x.i, "speed": x.w},
        states=("i", "w", "q"),
        inputs=("voltage", "temperature"),
        parameters=dict(motor().parameters),
    )


def test_a_parameter_may_follow_the_heat_of_a_signal():
    """The law has a slow state of its own, which the square of the current drives from a cold start."""
    law = heated("i")().at({"c": 0.4, "T": 1.5, "s_2": 4.0})
    closed, r = motor().with_element("parameter:R", law), blank(2, (20, 30))
    written = warm_motor(lambda x: x.i**2 / 4.0, resistance=lambda x, p: p.R + 0.4 * x.q)
    np.testing.assert_allclose(closed.simulate(r), written.simulate(r), rtol=1e-9)


def test_a_positive_parameter_falls_exponentially_with_the_heat():
    """As viscous friction of warm oil: it stays positive, whatever the heat."""
    law = heated("w")().at({"c": -1e-3, "T": 1.5, "s_2": 100.0})
    closed, r = motor().with_element("parameter:c", law), blank(2, (20, 30))
    written = warm_motor(lambda x: x.w**2 / 100.0, friction=lambda x, p: p.c * ca.exp(-1e-3 * x.q / p.c))
    np.testing.assert_allclose(closed.simulate(r), written.simulate(r), rtol=1e-9)
    p, change = ca.SX.sym("p"), ca.SX.sym("change")
    slope = ca.Function(
        "slope", [p, change], [ca.gradient(heated("w")().varied(p, change, 0.0), ca.vertcat(p, change))]
    )
    assert all(np.all(np.isfinite(np.array(slope(*at)))) for at in ((0, -1), (0, 0), (0, -1e-9), (1, -1e3), (1, 1)))
    parameters = {**motor().parameters, "c": pilfr.Parameter(4e-3)}  # of any sign
    signed = motor().with_parameters(parameters).with_element("parameter:c", law)
    assert not np.allclose(closed.simulate(r), signed.simulate(r), rtol=1e-3)


@pytest.mark.slow
def test_the_heat_of_the_current_is_named():
    """Nobody records the temperature; the current heats the winding."""
    true = motor().with_element("parameter:R", heated("i")().at({"c": 0.4, "T": 1.5, "s_2": 4.0}))
    r = blank(2, (20, 30))
    found = pilfr.diagnose(motor(), r.with_(y=true.simulate(r)), laws=[Delay, VaryingParameter], workers=1)
    assert found.sentence == "The simulator leaves out variation of R with the heat of i."


def test_a_varying_parameter_stays_within_its_bounds():
    """A line that would lead below zero ends at the lower bound."""
    law = varying("temperature")().at({"c": -5.0, "low": 20.0, "high": 80.0})
    closed, r = motor().with_element("parameter:R", law), blank(2, (30, 75))
    written = motor(lambda x, u, p: ca.fmin(ca.fmax(p.R - 5.0 * (u.temperature - 50) / 30, 0.2), 5.0))
    np.testing.assert_allclose(closed.simulate(r), written.simulate(r), rtol=1e-9)


def test_only_a_variation_stands_at_a_parameter():
    """A force has no place there, a variation has none elsewhere, and a matrix has no port."""
    with pytest.raises(InputError, match="cannot stand in a parameter at 'parameter:R'"):
        motor().with_element("parameter:R", CubicStiffness())
    with pytest.raises(InputError, match="cannot stand in parallel at 'bearing'"):
        motor().with_element("bearing", varying("w")())
    with pytest.raises(InputError, match="no port 'parameter:gone'"):
        motor().with_element("parameter:gone", varying("w")())
    with pytest.raises(InputError, match="no port 'parameter:G'"):
        motor(G=pilfr.Parameter(np.eye(2))).with_element("parameter:G", varying("w")())
    with pytest.raises(InputError, match="profile = 'cubic' was given; give 'tilt', 'bend'"):
        varying("w", "cubic")


@pytest.fixture(scope="module")
def diagnosis():
    """Diagnosis of a motor whose resistance grows with a recorded temperature, by some of the laws."""
    tried = [CoulombFriction, Delay, VaryingParameter]
    train, test = recorded(3, (20, 80)), recorded(5, (75, 25))
    return pilfr.diagnose(motor(), train, test=test, laws=tried, effects=1, hold="zero", workers=1)


@pytest.mark.slow
def test_the_parameter_and_its_signal_are_named(diagnosis):
    """The answer says what varies with what, by how much, and predicts the test to the noise."""
    (effect,) = diagnosis.effects
    assert (effect.port, effect.law, effect.form) == ("parameter:R", "varying_parameter", "scheduled by temperature")
    assert diagnosis.sentence == "The simulator leaves out variation of R with temperature."
    assert effect.confidence > 0.9
    low, high = (effect.parameters[k]["value"] for k in ("low", "high"))
    rise = (high - low) / 60 * 0.4 * R
    assert effect.parameters["c"]["value"] == pytest.approx(rise / 2, rel=0.02)
    assert effect.parameters["low"]["unit"] == "degC"
    assert diagnosis.errors["test"]["after"] < 0.011 < 0.03 < diagnosis.errors["test"]["before"]
    assert "where the change is added to R" in str(diagnosis)
    assert effect.placebo["own"] > 0.5 > effect.placebo["unrelated"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_corrected_simulator_is_exported_and_reported(diagnosis, tmp_path):
    """It is an exported step like any other, and the report draws the parameter over its signal."""
    r, step, x = recorded(7, (30, 70)), diagnosis.to_casadi(), None
    y, x = [], np.zeros(step.size1_in(0))
    for u in r.u[:50]:
        x, now = step(x, u)
        y.append(now.full().ravel())
    np.testing.assert_allclose(y, diagnosis.simulate(r)[:50], atol=1e-9)
    page = diagnosis.report(tmp_path).read_text()
    assert "How R varies with temperature." in page
    assert "variation of R with temperature" in page
    assert "varying(&#39;temperature&#39;, &#39;tilt&#39;)" in page or "varying('temperature', 'tilt')" in page


def test_a_search_finds_the_parameter_and_its_signal():
    bench = Workbench.of(motor(), [recorded(3, (20, 80))], "zero")
    floor = Floor(0.01 * bench.scale, "estimated")
    tried = (CoulombFriction, VaryingParameter)
    found = Search(bench, bench.fit(motor()), floor, tried, 1, Stages(lambda *_: None), aligned=True).run(1)
    (placed,) = found.best.laws
    assert (placed.port, placed.law.id, placed.law.form) == (
        "parameter:R",
        "varying_parameter",
        "scheduled by temperature",
    )
    assert found.best.mean_square**0.5 < 0.011


def test_a_curve_starts_as_the_variation_that_it_refines():
    """A curve through the values of a parabola is that parabola, inside the range and along its tangents outside."""
    bend, curve = (varying("w", profile)() for profile in ("bend", "curve"))
    own = {"c": -0.3, "c_high": 0.7, "low": -2.0, "high": 6.0}
    signal = np.linspace(-3.0, 8.0, 40)
    parabola = strengths_over(bend.at(own), own, signal)["c"]
    values = curve.starts_as(bend, own)
    np.testing.assert_allclose(strengths_over(curve, values, signal)["c"], parabola, atol=1e-12)
    assert parabola[-1] > own["c_high"] + 0.2  # it goes on outside


def test_a_law_s_own_values_are_no_ports():
    """They are parameters of the closed simulator, but no equation of the user's reads them."""
    rubs = motor().with_element("bearing", CoulombFriction().at({"F_c": 0.05}))
    with pytest.raises(InputError, match=r"no port 'parameter:bearing\.F_c'"):
        rubs.with_element("parameter:bearing.F_c", varying("temperature")())


def test_the_range_of_a_state_is_in_the_state_s_unit():
    """An output may have the name of a state, and its values in another unit."""
    simulator = pilfr.Simulator(
        lambda x, u, p: {"i": (u.voltage - p.R * x.i) / L},
        lambda x: {"i": 1000 * x.i},
        states=("i",),
        inputs=("voltage",),
        parameters={"R": pilfr.Parameter(1.0, unit="Ohm")},
        units={"i": "mA", "voltage": "V"},
    )
    law = varying("i")().at({"c": 0.1, "low": -4.0, "high": 4.0})
    shown = str(simulator.with_element("parameter:R", law))
    assert "parameter:R.high = 4 [i]" in shown
    assert "parameter:R.c = 0.1 Ohm" in shown


def test_the_placebo_of_a_variation_with_time_has_another_time():
    """The change, shifted by half a recording, hardly explains what the change itself does."""
    r = blank(2, (20, 30)).slice(0, 600).with_(initial="zero")
    law = varying("t")().at({"c": 0.4, "low": 0.0, "high": 3.0})
    true = motor().with_element("parameter:R", law)
    bench = Workbench.of(motor(), [r.with_(y=true.simulate(r))], "zero")
    own, unrelated = placebo(bench, bench.run(bench.simulator, {}, [np.zeros(2)]), "parameter:R", law)
    assert own > 0.9 > 0.5 > unrelated


def test_a_variation_that_no_search_tried_has_a_finite_prior():
    """Replications and predictions weigh laws without the list of a search."""
    assert np.isfinite(log_prior(motor().with_element("parameter:R", varying("w")()).elements, {}))


@pytest.mark.parametrize("named", ["input", "state"])
def test_a_law_that_varies_with_time_does_so_also_where_a_signal_has_the_name_t(named):
    def tank(flow, height):
        return pilfr.Simulator(
            lambda x, u, p: {height: u[flow] - p.a * x[height]},
            lambda x: {"level": x[height]},
            (height,),
            (flow,),
            {"a": pilfr.Parameter(1.0)},
        )

    own = ("t", "h") if named == "input" else ("q", "t")
    law = varying("t")().at({"c": 0.5, "low": 0.0, "high": 10.0})
    blank = pilfr.Recording(
        np.sin(np.arange(200)), np.zeros(200), 0.05, ("q",), ("level",), initial="zero", hold="zero"
    )
    usual = tank("q", "h").with_element("parameter:a", law).simulate(blank)
    r = blank.with_(inputs=own[:1])
    true = tank(*own).with_element("parameter:a", law)
    assert np.allclose(true.simulate(r), usual)
    bench = Workbench.of(tank(*own), [r.with_(y=usual)], "zero")
    fitted = bench.run(true, {}, [np.zeros(1)])
    assert np.allclose(port_signals(bench, fitted, "parameter:a").inputs["t"], r.clock)
