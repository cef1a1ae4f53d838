"""Every law of the catalogue: its derivatives, both engines, its force along a signal, and what it says of itself."""

import doctest
import importlib
import inspect
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import approx_fprime

import pilfr_casadi.laws as laws
from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator
from pilfr_casadi.engine import VirtualMachine, compiler, make_engine
from pilfr_casadi.laws import (
    CATALOGUE,
    FINER,
    BoucWen,
    Clearance,
    CubicStiffness,
    Delay,
    ElasticDrive,
    GeneralizedHysteresis,
    HertzContact,
    Local,
    Mode,
    PiecewiseStiffness,
    PreslidingStribeckFriction,
    Relaxation,
    StopHysteresis,
    StribeckFriction,
    behind_gap,
    count_columns,
    hysteresis_layer,
    readable_unit,
    unit_forces,
)
from pilfr_casadi.linear import with_output_injection
from pilfr_casadi.models import Named
from pilfr_casadi.simulators import discretise

DT, M, RUN = 0.01, 240, 120  # step, samples of the local signals, samples of a simulation
EVERY = (*CATALOGUE, *(finer for kinds in FINER.values() for finer in kinds))
COMPILED = (CubicStiffness, StopHysteresis, BoucWen, Delay, StribeckFriction, Mode)  # one of each kind of step
T = np.arange(M) * DT
Z = 0.8 * np.sin(2 * np.pi * 1.3 * T) + 0.5 * np.sin(2 * np.pi * 3.1 * T + 1) + 0.05
LOCAL = Local(
    Z, np.gradient(Z, DT), DT, (M,), np.inf, readers=("z",), revolution=2 * np.pi, term=lambda z, dz: 60 * z + dz
)
DRIVEN = replace(LOCAL, term=lambda z, dz: -20 * np.cos(9 * T))


def simulator():
    def dynamics(x, u, p):
        return {"pos": x.vel, "vel": (u.force - 60 * x.pos - p.d * x.vel) / 1.2}

    ground = Port(
        "ground", {"vel": -1 / 1.2}, lambda x: x.pos, lambda x: x.vel, "N", "m", term=lambda z, dz, p: 60 * z + p.d * dz
    )
    drive = replace(ground, name="drive", term=lambda u: -u.force)
    ports, own = (ground, drive), {"d": Parameter(1.0)}
    return Simulator(dynamics, lambda x: {"y": x.pos}, ("pos", "vel"), ("force",), own, ports=ports)


def local_of(law):
    """The signals at the port where a law is tried."""
    return DRIVEN if isinstance(law, ElasticDrive) else LOCAL


def dose(kind, number=0):
    """A law with a shape from its own grid and strengths that matter."""
    law = kind()
    shapes = list(law.shapes(local_of(law)))
    law = law.at(shapes[min(number, len(shapes) - 1)])
    law = law.at({k: 1.03 * v for k, v in law.values.items()})  # off the kinks of a law's own grid
    law = law.at({}, law.bounds(local_of(law)))
    strengths = {}
    for name in law.strength:
        value = np.asarray(law.parameters()[name].value)
        strengths[name] = 0.3 * np.ones(value.shape) if value.ndim else 0.3
    return law.at(strengths)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(3)
    u = 20 * np.interp(T, T[::6], rng.standard_normal(len(T[::6])))[:RUN]
    return Recording(u, np.zeros(RUN), DT, ("force",), ("y",), initial="zero")


def model_of(kind, hold):
    port = "drive" if issubclass(kind, ElasticDrive) else "ground" if "parallel" in kind.places else "sensor:y"
    return discretise(simulator().with_element(port, dose(kind)), DT, hold, 2)


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.__name__)
def test_derivatives_and_engines(kind, record):
    model = model_of(kind, "linear")
    vm, drive, p = VirtualMachine(model), model.drive(record), model.parameters.start
    state = np.zeros(model.n_state)
    seed, place = np.zeros((model.n_state, len(p))), np.arange(len(p))
    y, jac, *_ = vm.sensitivity(drive, p, state, seed, place)
    assert np.all(np.isfinite(y)) and np.all(np.isfinite(jac))
    assert np.array_equal(y, vm.simulate(drive, p, state)[0])
    if compiler() and kind in COMPILED:
        c = make_engine(model, "c")
        np.testing.assert_allclose(c.simulate(drive, p, state)[0], y, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(c.sensitivity(drive, p, state, seed, place)[1], jac, rtol=1e-7, atol=1e-9)
    weight = np.random.default_rng(0).standard_normal(len(y))

    def projected(values):
        return float(weight @ vm.simulate(drive, values, state)[0][:, 0])

    slopes = approx_fprime(p, projected, 1e-6 * np.maximum(np.abs(p), 1e-3))
    exact = np.einsum("k,kp->p", weight, jac[:, 0])
    np.testing.assert_allclose(exact, slopes, rtol=2e-3, atol=2e-3 * np.max(np.abs(slopes)))


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", (CubicStiffness, StopHysteresis, BoucWen, Delay))
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_slopes_by_way_of_the_stages_where_an_observer_leads_and_columns_are_left_out(kind, hold, record):
    model = with_output_injection(model_of(kind, hold), np.array([[0.3], [2.0]]))
    drive, rng = model.drive(record.with_(y=0.1 * record.u)), np.random.default_rng(4)
    p = np.where(model.parameters.start == 0, 0.7, model.parameters.start)
    place = np.append(-1, np.arange(len(p) - 1))[rng.permutation(len(p))]
    state = 0.1 * rng.standard_normal(model.n_state)
    seed = rng.standard_normal((model.n_state, len(p) + 3))
    compiled = make_engine(model, "c")
    assert compiled.linear.sizes["c"] == 3 * (2 + kind().order)
    found, expected = (e.sensitivity(drive, p, state, seed, place) for e in (compiled, VirtualMachine(model)))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * np.max(np.abs(b)))


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.__name__)
def test_the_force_is_linear_in_the_strengths(kind):
    law = dose(kind)
    shapes = list(law.shapes(local_of(law)))
    found = unit_forces(law, local_of(law), shapes)
    assert found.shape == (M, len(shapes), count_columns(law))
    assert np.all(np.isfinite(found))
    assert np.all(np.ptp(found, axis=0).max(axis=1) > 0), "a shape on the grid gives no force that changes"
    same = np.isclose(found, np.roll(found, 1, axis=1)).all(axis=(0, 2))
    assert len(shapes) == 1 or not np.any(same), "two shapes of the grid are the same"


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.__name__)
def test_a_law_speaks_of_itself(kind):
    law = dose(kind)
    own = law.parameters()
    assert set(own) == set(law.units) or set(own) <= set(law.units)
    assert set(law.strength) <= set(own)
    assert len(law.sentence.split()) > 3 and "=" in law.equation
    assert any(letter.isdigit() for letter in law.source), "no citation"
    assert inspect.getdoc(kind)
    assert all("[" not in readable_unit(unit, "N", "m") for unit in law.units.values())
    assert set(law.places) <= {"parallel", "series", "sensor"} and law.places
    for name, (low, high) in law.bounds(LOCAL).items():
        assert name in own
        assert np.all(np.asarray(low) <= np.asarray(high))
    reach, inside = 1e-3 * LOCAL.reach, []
    for shape in kind().shapes(LOCAL):
        limits = kind().at(shape).bounds(LOCAL)
        pairs = [(np.asarray(v), *limits.get(k, (-np.inf, np.inf))) for k, v in shape.items()]
        inside.append(all(np.all((v >= low - reach) & (v <= high + reach)) for v, low, high in pairs))
    assert any(inside), "no shape of the grid lies inside the bounds"


def test_what_moves_memory_twice_by_the_same_signal_changes_nothing():
    """The integration moves memory on at the begin of a step and reads it again at the same signal."""
    for kind in EVERY:
        law = dose(kind)
        if not hasattr(law, "step") or law.shifts:
            continue
        p = {name: ca.DM(q.value) for name, q in law.parameters().items()}
        rng = np.random.default_rng(1)
        for z in (-0.7, 0.0, 0.4):
            first = law.step(ca.DM(z), ca.DM(0.3 * rng.standard_normal(law.memory)), p)
            again = law.step(ca.DM(z), first[1], p)
            np.testing.assert_allclose(np.asarray(again[1]), np.asarray(first[1]), rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(float(again[0]), float(first[0]), rtol=1e-9, atol=1e-12)


def test_a_law_needs_no_more_than_its_units_starts_ranges_and_force():
    class Magnet(laws.Law):
        id, equation = "magnet", "w = c / (g - z)^2 + b z"
        units = {"c": "w*z^2", "g": "z", "b": "w/z", "wide": "z"}
        starts = {"g": ("high", 1.2, 3.0), "wide": lambda at: at.middle + at.half * np.array([0.1, 0.2])}
        ranges = {"g": ("high", 1.05, 10.0), "wide": lambda at: (0.0, at.high)}

    assert Magnet.strength == ("c", "b")
    high, middle, half = LOCAL.high, LOCAL.middle, LOCAL.half
    tried = [(g, wide) for g in (1.2 * high, 3.0 * high) for wide in (middle + half * 0.1, middle + half * 0.2)]
    assert [(s["g"], s["wide"]) for s in Magnet().shapes(LOCAL)] == tried
    assert Magnet().bounds(LOCAL) == {"g": (1.05 * high, 10.0 * high), "wide": (0.0, high)}
    assert {k: float(p.value) for k, p in Magnet().parameters().items()} == {"c": 0.0, "g": 1.0, "b": 0.0, "wide": 1.0}


def test_the_catalogue_has_no_law_twice():
    assert len({(kind.id, kind.form, kind.places) for kind in CATALOGUE}) == len(CATALOGUE)
    assert set(laws.__all__) >= {"CATALOGUE", "Law"}


@pytest.mark.parametrize(
    ("kind", "values", "doubtful"),
    [
        (laws.Power, {"a": 37.0, "n": 1.002}, True),
        (laws.Power, {"a": 0.2, "n": 0.5}, False),
        (laws.Orifice, {"a": 0.2, "z_t": 0.1}, False),
        (laws.SlackCoupling, {"k_g": 0.0, "c_g": 2.0, "g": 0.1}, True),
        (laws.SlackCoupling, {"k_g": 30.0, "c_g": 0.0, "g": 0.1}, False),
        (laws.DirectionalFriction, {"F_c": 0.0, "F_0": -199.0, "c_0": 0.3, "v_0": 0.1}, True),
        (laws.AsymmetricFriction, {"F_c": 2.0, "F_0": -199.0, "v_0": 0.1}, False),
    ],
)
def test_a_law_whose_own_part_has_vanished_is_doubtful(kind, values, doubtful):
    assert kind().doubtful(values) is doubtful


@pytest.mark.parametrize(("T", "doubtful"), [(5.0, False), (20.0, True)])
def test_creep_at_its_longest_time_constant_is_doubtful(T, doubtful):
    law = Relaxation().at({}, {"T": (0.05, 20.0)})
    assert law.doubtful({"k_v": 3.0, "T": T}) is doubtful


@pytest.mark.parametrize(("slow", "doubtful"), [({"k_2": 2.0, "T_2": 5.0}, False), ({"k_2": -2.99, "T_2": 1.01}, True)])
def test_creep_whose_two_parts_pull_against_each_other_is_doubtful(slow, doubtful):
    assert laws.TwoStageRelaxation().doubtful({"k_1": 3.0, "T_1": 1.0, **slow}) is doubtful


@pytest.mark.parametrize(
    ("values", "doubtful"),
    [
        ({"F_c": 1.0, "F_e": 0.4, "v_s": 0.1, "v_0": 0.002}, False),
        ({"F_c": 1.0, "F_e": 0.02, "v_s": 0.1, "v_0": 0.002}, True),  # a fall that is slight
        ({"F_c": 1.0, "F_e": 0.4, "v_s": 0.01, "v_0": 0.001}, True),  # is over at once
        ({"F_c": 1.0, "F_e": 0.4, "v_s": 1.0, "v_0": 0.002}, True),  # goes on over all speeds
        ({"F_c": 1.0, "F_e": 0.4, "v_s": 0.1, "v_0": 0.1}, True),  # is as narrow as the knee
        ({"F_c": 1.0, "F_e": 0.4, "v_s": 0.1, "v_0": 0.02}, False),  # peaks beyond the knee, 30 % above F_c
        ({"F_c": 1.0, "F_e": 0.1, "v_s": 0.1, "v_0": 0.05}, True),  # begins at the knee, which hides it
    ],
)
def test_friction_that_hardly_falls_is_no_stribeck_friction(values, doubtful):
    law = laws.StribeckFriction().at(values, {"v_s": (0.01, 1.0)})
    assert law.doubtful(values) is doubtful


@pytest.mark.parametrize(("n", "doubtful"), [(1.3, False), (1.5, True), (1.1, True)])
def test_no_free_convection_has_a_power_at_the_bounds(n, doubtful):
    law = laws.Convection().at({}, {"n": (1.1, 1.5)})
    assert law.doubtful({"h": 1.0, "n": n}) is doubtful


def test_plays_beside_a_bend_that_does_it_all_are_hardly_a_hysteresis():
    law = GeneralizedHysteresis().at({}, {"r": (1e-5, 0.97)})
    plays = {"r": np.linspace(0.0, 0.9, 6), "a_2": 0.0, "a_3": 0.0, "b_2": 0.3}
    assert law.doubtful({**plays, "w": np.full(6, 0.005)})
    assert not law.doubtful({**plays, "w": np.full(6, 0.1)})
    assert law.doubtful({**plays, "w": np.full(6, 0.1), "r": np.full(6, 0.97)})  # plays that never move


def test_plays_of_one_threshold_in_place_of_the_signal_are_hardly_more_than_a_backlash():
    law = laws.PlayHysteresis()
    narrow = {"w": np.array([-1.0, 0.45, 0.0, 0.55, 0.0, 0.0]), "r": np.array([0.02, 17.2, 222.0, 15.4, 90.0, 240.0])}
    assert law.doubtful(narrow)
    assert not law.doubtful({**narrow, "w": np.array([-0.6, 0.45, 0.0, 0.55, 0.0, 0.0])})  # beside the signal
    assert not law.doubtful({**narrow, "w": np.array([-1.0, 0.45, 0.1, 0.45, 0.0, 0.0])})  # of all sizes
    wide = {**narrow, "w": np.array([-1.0, 0.45, 1e-4, 0.55, 0.0, 0.0])}
    bent = GeneralizedHysteresis().at({}, {"r": (1e-3, 240.0)})
    assert law.doubtful(wide) and bent.doubtful({**wide, "a_2": 0.0, "a_3": 0.0, "b_2": 0.0})


@pytest.mark.parametrize("plain", (laws.PlayHysteresis, GeneralizedHysteresis))
def test_more_plays_begin_near_those_that_they_refine(plain):
    (finer,) = FINER[plain]
    few = plain().at({"w": np.array([-0.4, 0.3, 0.2, 0.1, 0.1, 0.05]), "r": np.linspace(0.0, 0.5, 6)})
    few = few.at({k: p.value for k, p in few.parameters().items()})
    (start,) = finer.finer_starts(few, LOCAL)
    more = finer().at(start, finer().bounds(LOCAL))
    one, other = (unit_forces(law, LOCAL, [{}])[:, 0, : law.n] @ law.parameters()["w"].value for law in (few, more))
    assert all(np.shape(more.parameters()[k].value) == (11,) for k in ("w", "r"))
    assert np.std(one - other) < 0.1 * np.std(one)


@pytest.mark.parametrize("kind", (StribeckFriction, PreslidingStribeckFriction))
def test_friction_that_falls_over_all_speeds_is_hardly_larger_at_rest(kind):
    law = kind().at({}, {"v_s": (0.01, 2.0)})
    sharp = {"v_0": 0.01, "r": 0.001, **dict.fromkeys(kind.strength, 1.0)}
    assert law.doubtful({"v_s": 2.0, **sharp}) and not law.doubtful({"v_s": 0.5, **sharp})


@pytest.mark.parametrize("kind", (laws.PreslidingFriction, PreslidingStribeckFriction))
def test_friction_that_springs_back_over_much_of_the_travel_is_hardly_friction(kind):
    law = kind().at({}, kind().bounds(LOCAL))
    slight, much = (
        {"r": share * LOCAL.half, "v_s": 0.1, **dict.fromkeys(kind.strength, 1.0)} for share in (0.03, 0.14)
    )
    assert law.doubtful(much) and not law.doubtful(slight)


@pytest.mark.parametrize("kind", (laws.CoulombFriction, laws.AsymmetricFriction, laws.DirectionalFriction))
def test_friction_that_reverses_over_most_speeds_is_hardly_dry(kind):
    law, own = kind().at({}, {"v_0": (0.002, 0.5)}), dict.fromkeys(kind.units, 1.0)
    assert law.doubtful({**own, "v_0": 0.3}) and not law.doubtful({**own, "v_0": 0.1})


@pytest.mark.parametrize(
    ("law", "widest"), [(laws.CoulombFriction, 0.5), (laws.DirectionalFriction, 0.5), (StribeckFriction, 0.3)]
)
def test_a_broad_reversal_is_told(law, widest):
    """The largest speed is 1 m/s, and the limits of the reversal are shares of it."""
    placed = law().at({"v_0": 0.05}, {"v_0": (1e-3, widest)})
    assert "over 20% of the largest speed" in placed.remark({"v_0": 0.2})
    assert placed.remark({"v_0": 0.05}) == ""
    assert law().remark({"v_0": 0.2}) == ""  # nobody knows the speed


def test_a_mode_that_is_damped_more_than_machines_are_is_hardly_a_mode():
    law = Mode().at({}, {"D": (1e-3, 1.0), "W": (1.0, 800.0)})
    assert law.doubtful({"D": 1.0, "W": 50.0}) and not law.doubtful({"D": 0.1, "W": 50.0})
    assert law.doubtful({"D": 0.1, "W": 800.0}) and law.doubtful({"D": 0.1, "W": 1.0})  # not seen


@pytest.mark.parametrize("kind", (laws.Creep, laws.TwoStageCreep))
def test_creep_of_a_signal_goes_on_in_its_direction_and_is_no_lag(kind):
    """In the longest time constant, at most as much as at once follows within the recordings."""
    bounds = kind().bounds(LOCAL)
    for name in kind.strength:
        least, most = bounds[name]
        assert least == 0.0 and most * (1 - np.exp(-0.5)) == pytest.approx(1.0)
    assert all(bounds[name][1] == 2 * LOCAL.duration for name in kind.units if name.startswith("T"))


def test_a_bouc_wen_actuator_with_hardly_a_loop_is_doubted():
    law = laws.BoucWenActuator(limits=laws.BoucWenActuator().bounds(LOCAL))
    shape = {"b": 0.8, "q_0": LOCAL.half, "s": 0.5, "n": 1.0}
    assert law.doubtful({**shape, "k_h": 5e-4}) and not law.doubtful({**shape, "k_h": 0.2})


def test_steps_too_long_for_bouc_wen_do_not_run_away():
    """A motion faster than what it was fitted to; the step's length alone, for q itself stays within q_0."""
    law, p = BoucWen(), {"q_0": 1.0, "s": 0.9, "n": 0.9}

    def rate(q):
        return float(ca.evalf(law.flow(6.0, ca.DM(q), p)))

    q = 0.0
    for _ in range(30):
        k = [rate(q)]
        for share in (0.5, 0.5, 1.0):
            k.append(rate(q + share * k[-1]))
        q += (k[0] + 2 * k[1] + 2 * k[2] + k[3]) / 6
    assert 0.5 < q < 8.0


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"values": {"banana": 1}}, "The law 'clearance' has no parameter 'banana'; its parameters are k_g, g."),
        ({"values": {"k": 1.0}}, "has no parameter 'k'; its parameters are k_g, g"),
        ({"limits": {"gap": (0, 1)}}, "has no parameter 'gap'; its parameters are k_g, g"),
        ({"values": {"g": "wide"}}, "values of the law 'clearance' hold g = 'wide'; give finite numbers"),
        ({"values": {"g": np.nan}}, "hold g = nan; give finite numbers"),
        ({"values": [1.0]}, r"The values of the law 'clearance' are \[1.0\]; give a dict by parameter name"),
        ({"limits": {"g": 1.0}}, r"limits of the law 'clearance' hold g = 1.0; give a pair \(lower, upper\)"),
        ({"limits": {"g": (2.0, 1.0)}}, "give a pair .* of increasing numbers"),
        ({"values": {"g": 1.0}, "limits": {"g": (2.0, 3.0)}}, r"has g = 1.0, outside of its limits 2.0 to 3.0; widen"),
    ],
)
def test_values_that_a_law_cannot_have(given, says):
    with pytest.raises(InputError, match=says):
        Clearance(**given)


@pytest.mark.parametrize("kind", [laws.LimitedTerm, laws.AsymmetricSaturation])
def test_a_lower_limit_above_the_upper_one_is_refused(kind):
    with pytest.raises(InputError, match=r"has low = 2.0 above high = 1.0; give them in order"):
        kind({"low": 2.0, "high": 1.0})


def test_a_layer_refuses_weights_for_another_number_of_plays():
    with pytest.raises(InputError, match=r"has 6 values of w; 3 were given. Give one number for all, or one for each."):
        StopHysteresis().at({"w": [1.0, 2.0, 3.0]}).parameters()
    assert StopHysteresis().at({"w": 2.0}).parameters()["w"].value == pytest.approx(np.full(6, 2.0))


def test_a_layer_of_no_operators_is_refused():
    for n in (0, 2.5):
        with pytest.raises(InputError, match="give a whole number, 1 or more"):
            hysteresis_layer("stop", n, False)


def test_hysteresis_behind_a_gap_keeps_the_gap():
    law = behind_gap(StopHysteresis)()
    assert list(law.at(next(iter(law.shapes(LOCAL)))).parameters()) == ["w", "r", "g"]
    assert np.all(np.isfinite(unit_forces(law, LOCAL, list(law.shapes(LOCAL))[:1])))


@pytest.mark.parametrize(
    "name",
    [
        "laws.base",
        "models.parameters",
        "models.elements",
        "models.pilfr",
        "models.model",
        "simulators.ports",
        "simulators.simulator",
    ],
)
def test_the_examples_in_docstrings_run(name):
    found = doctest.testmod(importlib.import_module(f"pilfr_casadi.{name}"))
    assert found.attempted > 0 and found.failed == 0


def test_old_spellings_in_a_law_of_ones_own_work():
    class Wall(laws.Law):
        id = "wall"
        equation = "w = k z"
        units = {"k": "w/z"}
        ranges = {"k": ("stiffest", 0.0, 0.5)}

        def force(self, z, p):
            return p.k * z

        def applies(self, local):
            return "never"

    local = laws.Local(np.linspace(-1, 1, 5), np.ones(5), 0.1, (5,), max_stiffness=8.0)
    assert Wall().why_not(local) == "never"
    assert Wall().bounds(local) == {"k": (0.0, 4.0)}


def test_a_rectifying_sensor_sees_no_signs():
    law, z = laws.Rectified(), np.linspace(-2.0, 2.0, 9)
    both, one = (Local(z=signal, dz=np.ones(9), dt=0.1, lengths=(9,)) for signal in (z, np.abs(z)))
    (force,) = unit_forces(law, both, [{"n": 1.5, "b": 0.1}])[:, 0].T
    np.testing.assert_allclose(z + force, np.abs(z) ** 1.5 + 0.1, atol=1e-9)
    assert law.why_not(one) and not law.why_not(both)


@pytest.mark.parametrize("law", [kind() for kind in EVERY if kind.turns])
def test_a_memory_of_turning_points_is_not_tried_where_the_signal_does_not_turn(law):
    rise, back = np.linspace(-1.0, 1.0, 200), np.linspace(1.0, 0.5, 50)
    once = Local(z=rise, dz=np.ones(200), dt=0.1, lengths=(200,))
    both = Local(z=np.r_[rise, back], dz=np.r_[np.ones(200), -np.ones(50)], dt=0.1, lengths=(250,))
    again = Local(z=np.r_[rise, rise], dz=np.ones(400), dt=0.1, lengths=(200, 200))
    assert "turn" in law.why_not(once) and not law.why_not(both) and not law.why_not(again)


@pytest.mark.parametrize("domain", ["thermal", "fluid", "electrical"])
def test_nothing_deflects_or_speeds_where_heat_fluid_or_current_flows(domain):
    mechanical = {"spring", "stiffness", "deflection", "damper", "damping", "speed", "contact"}
    for law in laws.CATALOGUE:
        admitted = "parallel" in law.places and domain not in law.absent and (not law.domains or domain in law.domains)
        if admitted and not law.in_line:
            words = set(re.findall(r"\w+", law.sentences.get(domain, law.sentence)))
            assert not mechanical & words, (law.id, law.form)


def test_a_free_curve_goes_on_along_its_tangents():
    """Inside its range it is the sum of the Chebyshev polynomials from the second degree on, zero at zero."""
    law, rng = laws.FreeCurve(), np.random.default_rng(0)
    values = {"c": rng.standard_normal(8), "z_m": 0.2, "z_h": 0.5}
    z = np.linspace(-1.5, 1.5, 301)

    def curve(at):
        return np.polynomial.chebyshev.chebval((at - 0.2) / 0.5, [0, 0, *values["c"]])

    w = np.array([float(law.force(float(at), Named("p", values))) for at in z])
    inside = np.abs(z - 0.2) <= 0.5
    assert np.allclose(w[inside], curve(z[inside]) - curve(0.0), rtol=0, atol=1e-12)
    for end, side in ((-0.3, z < -0.3), (0.7, z > 0.7)):
        slope = (curve(end + 1e-6) - curve(end - 1e-6)) / 2e-6
        assert np.allclose(w[side], curve(end) - curve(0.0) + slope * (z[side] - end), rtol=1e-6, atol=1e-6)


def test_a_steep_curve_is_a_free_one_with_an_exponential_at_either_end():
    law, rng = laws.SteepCurve(), np.random.default_rng(0)
    z = np.linspace(2.0, 4.0, 101)
    local = Local(z=z, dz=np.ones(101), dt=0.1, lengths=(101,))
    (middle,) = laws.FreeCurve().shapes(local)
    found = laws.FreeCurve().at({"c": rng.standard_normal(8), **middle})
    starts = list(law.finer_starts(found, local))
    assert {start["s"] for start in starts} == {-1.0, 1.0}

    def force(one, values, at):
        return np.array([float(one.force(float(x), Named("p", values))) for x in at])

    for start in starts:
        assert np.allclose(force(law, start, z), force(found, found.values, z), rtol=0, atol=1e-12)
    alone = {**starts[0], "c": np.zeros(8), "a": 2.0, "e": 0.1, "s": 1.0}
    low, half = middle["z_m"] - middle["z_h"], middle["z_h"]
    exponential = 2.0 * np.exp(-(z - low) / (0.1 * half))
    inside = z > low
    got = force(law, alone, z)
    assert np.allclose((got - got[-1])[inside], (exponential - exponential[-1])[inside], rtol=0, atol=1e-9)
    beyond = force(law, alone, [low - 0.2, low - 0.1, low])
    assert np.diff(beyond) == pytest.approx([-2.0 / half] * 2)


def test_a_free_curve_is_free_where_the_signal_was_alone():
    """Between zero and the recorded range nothing would determine it; it is zero at zero all the same."""
    law, z = laws.FreeCurve(), np.linspace(5.0, 10.0, 50)
    (shape,) = law.shapes(Local(z=z, dz=np.ones(50), dt=0.1, lengths=(50,)))
    assert shape["z_m"] - shape["z_h"] == pytest.approx(5, abs=0.1)
    values = {"c": np.ones(8), **shape}
    w = np.array([float(law.force(at, Named("p", values))) for at in (0.0, 2.0, 4.0, 5.0)])
    assert w[0] == pytest.approx(0, abs=1e-12) and np.diff(w) / [2, 2, 1] == pytest.approx([w[3] / 5] * 3)


@pytest.mark.parametrize(
    "kind", [kind for kind in CATALOGUE if "as_base" in vars(kind)], ids=lambda kind: kind.__name__
)
def test_a_form_that_contains_its_base_equals_it_where_it_starts(kind):
    z = np.linspace(-1.0, 1.0, 201)
    local = Local(z, np.ones(201), 0.01, (201,))
    plain = kind.__base__()
    shape = next(iter(plain.shapes(local)))
    own = {**dict.fromkeys(plain.strength, 1.0), **shape}
    start, *_ = kind.finer_starts(plain.at(own), local)
    form = unit_forces(kind(), local, [start])[:, 0]
    np.testing.assert_allclose(form, unit_forces(plain, local, [shape])[:, 0], atol=1e-9)
    assert set(start) == set(kind.units) and all(start[name] == 1.0 for name in kind.strength)
    assert kind.extends(type(plain)) and not kind.extends(kind)


def test_a_value_of_another_unit_is_no_start_value():
    """The strengths of a contact in a line and of one between curved bodies have one name."""
    line = PiecewiseStiffness().at({"k_c": 600.0, "g": 0.02})
    assert next(HertzContact.finer_starts(line, LOCAL)) == {"g": 0.02}


def test_only_the_class_itself_knows_its_base():
    """A law that is derived from a form which contains its base does not contain that form in the same way."""
    assert not laws.SkewSaturation.extends(laws.AsymmetricSaturation)
