"""Laws made of laws: behind a gap, scaled by a signal, two in one port; and a rig that hides one of each."""

import importlib

import casadi as ca
import numpy as np
import pytest
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import InputError
from pilfr_casadi.diagnose import add_scaled_laws
from pilfr_casadi.diagnose.fits.screen import start_values
from pilfr_casadi.laws import (
    CATALOGUE,
    SCHEDULES,
    BoucWen,
    CoulombFriction,
    CubicStiffness,
    Drift,
    Feedthrough,
    Gain,
    Local,
    Power,
    PowerWithGain,
    PreslidingFriction,
    Relaxation,
    Saturation,
    SoftClearance,
    StopHysteresis,
    UnreadInput,
    ViscousDamping,
    behind_gap,
    carried,
    heated,
    likely_profiles,
    scaled,
    scheduled,
    unit_forces,
    varying,
)
from pilfr_casadi.models import Named

DT, SAMPLES = 2e-3, 3000


def rig(k=900.0, d=6.0, push=0.0):
    """A mass on a spring; the coil's voltage is recorded, and nobody knows what it does unless it pushes."""
    return pilfr.Simulator(
        lambda x, u, p: {
            "pos": x.vel,
            "vel": (u.force + (push * u.voltage if push else 0) - p.k * x.pos - p.d * x.vel) / 2.0,
        },
        lambda x: {"position": x.pos},
        states=("pos", "vel"),
        inputs=("force", "voltage"),
        parameters={
            "k": pilfr.Parameter(k, bounds=(100, 5000)),
            "d": pilfr.Parameter(d, bounds=(0, 100)),
        },
        ports=(pilfr.Port("damper", {"vel": -0.5}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    )


def recorded(true, seed):
    """A recording of the true machine from rest."""
    rng = np.random.default_rng(seed)
    force = 30.0 * pilfr.multisine(SAMPLES, f_max=10.0, fs=1 / DT, rng=rng)
    voltage = 2.0 + np.repeat(rng.uniform(-1.5, 2.0, SAMPLES // 250), 250)
    blank = pilfr.Recording(
        np.column_stack([force, voltage]), np.zeros(SAMPLES), DT, ("force", "voltage"), ("position",),
        initial="zero", hold="zero",
    )  # fmt: skip
    y = outputs_of(true, blank, substeps=8)
    return blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "values", "form"),
    [
        (scaled(CoulombFriction, "voltage"), {"F_c": 3.0, "v_0": 5e-3}, "smooth, scaled by voltage"),
        (behind_gap(CoulombFriction), {"F_c": 9.0, "v_0": 5e-3, "g": 0.012}, "smooth, behind a gap"),
    ],
    ids=("scaled", "behind a gap"),
)
def test_a_composed_law_is_found(law, values, form):
    true = rig().with_element("damper", law().at(values))
    found = pilfr.diagnose(rig(1000.0, 7.5), recorded(true, 0), test=recorded(true, 1))
    assert [(e.port, e.law, e.form) for e in found.effects] == [("damper", "coulomb_friction", form)]
    assert found.effects[0].confidence > 0.8
    assert found.errors["test"]["after"] < 0.02 * found.errors["test"]["before"]
    for name in set(values) - {"v_0"}:
        assert found.effects[0].parameters[name]["value"] == pytest.approx(values[name], rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "values"),
    [
        (
            scheduled(PreslidingFriction, "voltage"),
            {"k_t": 600.0, "k_t_high": 3000.0, "r": 0.002, "low": 0.5, "high": 4},
        ),
        (
            scheduled(CoulombFriction, "z"),
            {"F_c": 0.5, "F_c_high": 5.0, "v_0": 5e-3, "low": -0.15, "high": 0.15},
        ),
    ],
    ids=("with an input", "with the coordinate"),
)
def test_friction_that_varies_with_a_signal_is_found(law, values):
    """The equations read the voltage already, so that only a part of the friction follows it."""
    true = rig(push=4.0).with_element("damper", law().at(values))
    found = pilfr.diagnose(rig(1000.0, 7.5, push=4.0), recorded(true, 0), test=recorded(true, 1))
    assert [(e.port, e.law) for e in found.effects] == [("damper", "coulomb_friction")], str(found)
    assert law.scheduled_by in found.effects[0].form.partition("scheduled by ")[2]
    assert found.errors["test"]["after"] < 0.05 * found.errors["test"]["before"]


@pytest.mark.parametrize(
    ("kind", "by", "values", "ends"),
    [
        (CoulombFriction, "voltage", {"F_c": 1.0, "F_c_high": 5.0, "v_0": 5e-3}, (0.5, 4.0)),
        pytest.param(
            *(CoulombFriction, "z", {"F_c": 0.5, "F_c_high": 5.0, "v_0": 5e-3}, (-0.15, 0.15)), marks=pytest.mark.slow
        ),
        pytest.param(
            *(CoulombFriction, "t", {"F_c": 1.0, "F_c_high": 5.0, "v_0": 5e-3}, (0.0, 5.998)), marks=pytest.mark.slow
        ),
        pytest.param(ViscousDamping, "t", {"c_1": 2.0, "c_1_high": 12.0}, (0.0, 5.998), marks=pytest.mark.slow),
    ],
    ids=("friction with an input", "friction with the position", "friction with the time", "damping with the time"),
)
def test_a_strength_that_varies_is_found_with_its_signal(kind, by, values, ends):
    law = scheduled(kind, by)().at({**values, "low": ends[0], "high": ends[1]})
    train = recorded(rig(push=4.0).with_element("damper", law), 0)
    found = pilfr.diagnose(rig(1000.0, 7.5, push=4.0), train, laws=(kind,), effects=1)
    assert [(e.port, e.law) for e in found.effects] == [("damper", kind.id)], str(found)
    assert found.effects[0].form.endswith(f"scheduled by {by}")
    assert found.errors["train"]["after"] < 1.1e-3


def test_a_law_with_states_of_its_own_may_vary():
    """With equal strengths at both ends of the signal it is the plain law."""
    own = {"k_h": 300.0, "q_0": 0.005, "s": 0.5, "n": 1.0}
    ends = {"k_h_high": 300.0, "low": 0.0, "high": 4.0}
    blank = recorded(rig(), 0)
    plain, varying = BoucWen().at(own), scheduled(BoucWen, "voltage")().at({**own, **ends})
    a, b = (rig().with_element("damper", law).simulate(blank) for law in (plain, varying))
    assert np.allclose(a, b, rtol=1e-9) and np.std(a) > 0


@pytest.mark.parametrize(
    ("shown", "from_zero", "usable"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_a_strength_varies_with_the_position_where_that_is_known(shown, from_zero, usable):
    z = np.linspace(-1.0, 2.0, 50)
    local = Local(z, np.ones(50), 0.1, (50,), readers=("z",) * shown, from_zero=(from_zero,))
    assert (not scheduled(CoulombFriction, "z")().why_not(local)) is usable


def test_a_scheduled_law_is_the_law_where_the_signal_stands_still():
    values = {"k_t": 400.0, "k_t_high": 800.0, "r": 0.004, "low": 0.0, "high": 4.0}
    law, plain = (
        scheduled(PreslidingFriction, "voltage")().at(values),
        PreslidingFriction().at({"k_t": 500.0, "r": 0.004}),
    )
    r = recorded(rig(), 3)
    still = r.with_(u=np.column_stack([r.u[:, 0], np.ones(len(r))]))
    y = outputs_of(rig().with_element("damper", law), still, substeps=8)
    np.testing.assert_allclose(y, outputs_of(rig().with_element("damper", plain), still, substeps=8), atol=1e-12)
    assert law.parameters()["low"].fixed and law.parameters()["k_t_high"].unit == "w/z"


def test_forces_of_a_scheduled_law_at_unit_strength_add_up():
    rng = np.random.default_rng(0)
    z, u = np.cumsum(rng.standard_normal(200)) / 10, rng.uniform(1, 3, 200)
    local = Local(z, np.gradient(z, 0.1), 0.1, (200,), inputs={"p": u})
    for by, signal in (("p", u), ("z", z)):
        law = scheduled(CoulombFriction, by)()
        shape = next(iter(law.shapes(local)))
        columns = unit_forces(law, local, [shape])[:, 0]
        bare = unit_forces(CoulombFriction(), local, [{"v_0": shape["v_0"]}])[:, 0, 0]
        share = (signal - signal.min()) / np.ptp(signal)
        np.testing.assert_allclose(columns, bare[:, None] * np.column_stack([1 - share, share]), atol=1e-12)


def test_the_profile_of_a_strength_passes_its_values():
    """At both ends and in the middle it has the values; outside a parabola goes on in a line."""
    values = {"c_1": 2.0, "low": 10.0, "high": 30.0}
    dz, p = (
        3.0,
        {"linear": {"c_1_high": 8.0}, "quadratic": {"c_1_mid": 3.0, "c_1_high": 8.0}, "exponential": {"ratio": 4.0}},
    )
    expected = {
        "linear": (2.0, 5.0, 8.0, 11.0),
        "quadratic": (2.0, 3.0, 8.0, 15.0),
        "exponential": (2.0, 4.0, 8.0, 16.0),
    }
    for profile, own in p.items():
        law = scheduled(ViscousDamping, "heat", profile)()
        given = Named("parameter", values | own)
        found = [law.force(z=0.0, dz=dz, u=Named("input", {"heat": ca.DM(heat)}), p=given) for heat in (10, 20, 30, 40)]
        np.testing.assert_allclose(np.ravel(found), dz * np.array(expected[profile]), rtol=1e-12)


@pytest.mark.parametrize(
    ("profile", "more"), [("linear", ["c_1_high"]), ("quadratic", ["c_1_mid", "c_1_high"]), ("exponential", ["ratio"])]
)
def test_a_strength_that_hardly_varies_is_doubtful(profile, more):
    law, own = scheduled(ViscousDamping, "heat", profile)(), {"c_1": 2.0, "low": 10.0, "high": 30.0}
    base = {name: 1.0 if name == "ratio" else 2.0 for name in more}
    for factor, doubtful in ((1.05, True), (1.2, False)):
        values = {**own, **base, more[-1]: base[more[-1]] * factor}
        assert law.doubtful(values) is doubtful


@pytest.mark.parametrize("profile", SCHEDULES)
def test_operators_vary_each_by_itself(profile):
    """A layer of stops has a weight of each operator at each value of the signal."""
    kind = scheduled(StopHysteresis, "z", profile)
    z = np.linspace(-1.0, 1.0, 50)
    local = Local(z, np.ones(50), 0.1, (50,), readers=("z",))
    shape = next(iter(kind().shapes(local)))
    columns = unit_forces(kind(), local, [shape])[:, 0]
    values = start_values(kind(), shape, np.arange(1.0, 1 + columns.shape[1]))
    law = kind().at(values)
    assert all(law.parameters()[name].value.shape == (6,) for name in kind.strength)
    assert law.doubtful(values) in (True, False) and columns.shape == (50, 6 * len(kind.strength))
    line = {k: shape[k] for k in ("r", "low", "high")} | {"w": np.ones(6), "w_high": 2 * np.ones(6)}
    (start,) = kind.finer_starts(scheduled(StopHysteresis, "z")().at(line), local)
    assert all(np.shape(start[name]) == (6,) for name in kind.strength)


def test_the_operators_of_a_layer_vary_together():
    """Each by itself, their strengths over the position could imitate any curve and friction."""
    assert likely_profiles(StopHysteresis) == ("exponential",)
    assert set(likely_profiles(CoulombFriction)) == set(SCHEDULES)
    assert scheduled(StopHysteresis, "z", "exponential").strength == StopHysteresis.strength


def test_there_is_no_other_profile():
    with pytest.raises(InputError, match="'cubic' was given; give 'linear', 'quadratic', 'exponential'"):
        scheduled(ViscousDamping, "heat", "cubic")


@pytest.mark.parametrize("profile", SCHEDULES)
def test_one_profile_starts_as_another(profile):
    """A strength that varies in a line starts in every profile with the same values at the ends of the range."""
    rng = np.random.default_rng(1)
    z, heat = np.cumsum(rng.standard_normal(300)) / 10, rng.uniform(10, 30, 300)
    local = Local(z, np.gradient(z, 0.1), 0.1, (300,), inputs={"heat": heat})
    ends = {"low": heat.min(), "high": heat.max()}
    line = scheduled(ViscousDamping, "heat")().at({"c_1": 2.0, "c_1_high": 8.0, **ends})
    kind = scheduled(ViscousDamping, "heat", profile)
    (start,) = kind.finer_starts(line, local)
    strength = [k for k in kind.strength if k in start]
    force = unit_forces(kind(), local, [start])[:, 0] @ [float(start[k]) for k in strength]
    for end in (heat.argmin(), heat.argmax()):
        assert force[end] == pytest.approx((2.0 if end == heat.argmin() else 8.0) * local.dz[end], rel=1e-9)


def test_a_scaled_law_is_the_law_times_the_signal():
    """Half the strength at twice the voltage is the same; and it is not nothing."""
    law, half = (scaled(PreslidingFriction, "voltage")().at({"k_t": k, "r": 0.004}) for k in (400.0, 200.0))
    r = recorded(rig(), 3)
    y = outputs_of(rig().with_element("damper", law), r, substeps=8)
    again = outputs_of(rig().with_element("damper", half), r.with_(u=r.u * [1.0, 2.0]), substeps=8)
    np.testing.assert_allclose(y, again, atol=1e-12)
    assert np.std(y - outputs_of(rig(), r, substeps=8)) > 0.05 * np.std(y)
    assert law.parameters()["k_t"].unit == "w/z/[voltage]"


@pytest.mark.parametrize("kind", [CoulombFriction, PreslidingFriction, CubicStiffness], ids=lambda k: k.__name__)
def test_beyond_the_gap_a_law_is_its_own(kind):
    """Pulled to z, the law feels z - g; inside the gap nothing."""
    law = behind_gap(kind)().at({name: 1.0 for name in kind.units} | {"g": 0.5})
    p = pilfr.ParameterSet(law.parameters())
    values = type("P", (), {k: float(v.value) for k, v in p.items()} | {"__getitem__": lambda s, k: getattr(s, k)})()
    for z, beyond, rate in ((2.0, 1.5, 0.3), (-2.0, -1.5, 0.3), (0.25, 0.0, 0.0)):
        if hasattr(kind, "step"):
            got, expected = law.step(z, 0.0, values)[0], kind().step(beyond, 0.0, values)[0]
        else:
            have = {"dz": 0.3} if "dz" in kind.reads() else {}
            own = {"z": beyond} if "z" in kind.reads() else {"dz": rate}
            got, expected = law.force(z=z, **{"dz": 0.3} | have, p=values), kind().force(**own, p=values)
        assert float(ca.DM(got)) == pytest.approx(float(ca.DM(expected)), abs=1e-8)


def test_two_laws_in_one_port_act_together():
    """A cube and a friction in one port are the two in two equal ports."""
    cube, rub = CubicStiffness().at({"k_3": 3e5}), CoulombFriction().at({"F_c": 3.0, "v_0": 5e-3})
    both = recorded(rig().with_element("damper", cube).with_element("damper", rub), 5)
    again = recorded(rig().with_element("damper", rub).with_element("damper", cube), 5)
    alone = recorded(rig().with_element("damper", cube), 5)
    np.testing.assert_allclose(both.y, again.y, atol=1e-12)
    assert np.std(both.y - alone.y) > 0.05 * np.std(both.y)


def test_only_inputs_that_no_equation_reads_are_tried_as_scales():
    assert rig().idle_inputs == ("voltage",)
    assert pilfr.diagnose.__doc__ and scaled(CoulombFriction, "voltage") is scaled(CoulombFriction, "voltage")


@pytest.mark.parametrize(
    ("compose", "sentence"),
    [
        (lambda: scaled("coulomb_friction", "voltage"), "made of a class of laws"),
        (lambda: scaled(Saturation, "voltage"), "stands in series"),
        (lambda: scheduled(Saturation, "voltage"), "stands in series"),
        (lambda: behind_gap(Relaxation), "states of its own"),
        (lambda: behind_gap(SoftClearance), "a gap of its own"),
        (lambda: behind_gap(Drift), "reads more than z and dz"),
        (lambda: scaled(CoulombFriction, ""), "by = '' was given; give the name of a signal"),
        (lambda: scheduled(CoulombFriction, ""), "by = '' was given; give the name of a signal"),
        (lambda: varying(""), "by = '' was given; give the name of a signal"),
        (lambda: heated(""), "by = '' was given; give the name of a signal"),
        (lambda: carried(""), "by = '' was given; give the name of a signal"),
    ],
)
def test_what_cannot_be_composed_is_said(compose, sentence):
    with pytest.raises(InputError, match=sentence):
        compose()


def test_an_input_that_the_equations_do_not_read_may_act_itself(monkeypatch):
    """A load was recorded and left out of the simulator; it acts at the damper's port."""
    true = rig().with_element("damper", scaled(UnreadInput, "voltage")().at({"a": 3.0}))
    few = (CoulombFriction, UnreadInput)
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", few)
    found = pilfr.diagnose(rig(1000.0, 7.5), recorded(true, 0), effects=1, workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("damper", "unread_input", "voltage")], str(found)
    assert found.effects[0].parameters["a"]["value"] == pytest.approx(3.0, rel=0.01)
    assert "voltage acts here; it is recorded" in str(found)


def test_an_input_that_the_equations_do_not_read_may_disturb_a_sensor(monkeypatch):
    """A sensor that drifts with a recorded signal is right at another level of the signal than zero."""
    drift = scheduled(UnreadInput, "voltage")().at({"a": -0.012, "a_high": 0.03, "low": 0.5, "high": 4.0})
    true = rig().with_element("sensor:position", drift)
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", (UnreadInput,))
    found = pilfr.diagnose(rig(1000.0, 7.5), recorded(true, 0), effects=1, workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [
        ("sensor:position", "unread_input", "voltage, with an offset")
    ], str(found)
    own = {name: entry["value"] for name, entry in found.effects[0].parameters.items()}
    assert (own["a_high"] - own["a"]) / (own["high"] - own["low"]) == pytest.approx(0.042 / 3.5, rel=0.02)


def test_a_wrong_gain_is_named_where_no_parameter_can_take_it(monkeypatch):
    few = (Gain, Power, PowerWithGain, Saturation)
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", few)
    true = rig().with_element("actuator:force", Gain().at({"g": 0.06}))
    found = pilfr.diagnose(rig(1000.0, 7.5), recorded(true, 0), workers=1)
    assert [e.law for e in found.effects] == ["gain"], str(found)
    named = {found.effects[0].port, *(port for port, _ in found.effects[0].indistinguishable)}
    assert named == {"actuator:force", "sensor:position"}  # of a linear machine with one of each
    assert found.effects[0].confidence > 0.8
    assert found.effects[0].parameters["g"]["value"] == pytest.approx(0.06, rel=0.02)


def test_an_input_may_reach_a_sensor_directly(monkeypatch):
    """As the drop at a series resistance that a battery's simulator leaves out."""
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", (Saturation,))
    true = rig().with_element("sensor:position", scaled(Feedthrough, "force")().at({"a": 2e-4}))
    found = pilfr.diagnose(rig(1000.0, 7.5), recorded(true, 0), effects=1, workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("sensor:position", "feedthrough", "force")], str(found)
    assert found.effects[0].parameters["a"]["value"] == pytest.approx(2e-4, rel=0.02)


def test_an_input_is_not_led_to_its_own_channel():
    """There, feedthrough is a gain."""
    ports = {port.name for port in rig().all_ports() if port.admits(scaled(Feedthrough, "force"))}
    assert ports == {"actuator:voltage", "sensor:position"}


def test_a_worker_tries_the_input_that_the_equations_do_not_read():
    """There, classes that were made at run time are others of the same name."""
    other = type(CATALOGUE[-1].__name__, (CATALOGUE[-1],), {})
    tried = add_scaled_laws((*CATALOGUE[:-1], other), rig())
    assert [law.form for law in tried if law.id == "unread_input"] == ["voltage", "voltage, with an offset"]
