"""Check before solve: known blind spots are found, well excited rigs are clear, and the numbers hold in simulation."""

import importlib
import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from cart import cart
from diagnosis_example import recorded, rig as spring_rig

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator, check, multisine
from pilfr_casadi.diagnose.excitation import single_frequency
from pilfr_casadi.diagnose.identifiability import Tie
from pilfr_casadi.diagnose.proof import ranges_left, share_at_new_frequencies
from pilfr_casadi.laws import CATALOGUE, CoulombFriction, CubicDamping, CubicStiffness, Root
from pilfr_casadi.models import close_loop
from problems.blind_spots import DT, NOISE, SAMPLES, controls, noise_like, plain, record, rigs

MASS = plain()


class Checked(dict):
    """Rigs and what is found of them by their names, each checked when it is asked for."""

    def __missing__(self, name):
        rig = next(rig for rig in [*rigs(), *controls()] if rig.name == name)
        self[name] = rig, check(rig.simulator, rig.train)
        return self[name]


@pytest.fixture(scope="module")
def some():
    return Checked()


@pytest.fixture(scope="module")
def checked(some):
    """All rigs."""
    return {rig.name: some[rig.name] for rig in [*rigs(), *controls()]}


@pytest.fixture(scope="module")
def mass():
    """A recording of a mass on a spring, and what is found by it."""
    given = record(MASS, noise_like(1))
    return given, check(MASS, given)


@pytest.mark.slow
def test_blind_spots_of_twenty_rigs_are_told(checked):
    known = [rig.name for rig in rigs()]
    assert len(known) == 20
    missed = [name for name in known if not checked[name][0].told(checked[name][1])]
    assert len(missed) <= 1, missed


def test_well_excited_rigs_have_no_blind_spot(some):
    for rig in controls():
        found = some[rig.name][1]
        assert not found.blind_spots, (rig.name, [b.sentence for b in found.blind_spots])
        assert all(p.status == "identifiable" for p in found.parameters)


@pytest.mark.slow
def test_it_takes_little_time(checked):
    assert np.median([found.seconds for _, found in checked.values()]) < 3.0


@pytest.mark.slow
def test_every_answer_prints_and_is_standard_json(checked):
    for rig, found in checked.values():
        assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["next_record"]
        assert "next record: " in str(found)
        for spot in found.blind_spots:
            assert spot.sentence in str(found) and spot.sentence[0].strip() and spot.sentence.endswith("."), rig.name


def test_a_diagnosis_tells_the_same_blind_spots(some):
    rig, found = some["free scale"]
    diagnosis = pilfr.diagnose(rig.simulator, rig.train, laws=(), workers=1)
    assert [b.sentence for b in diagnosis.blind_spots] == [b.sentence for b in found.blind_spots]
    assert all(b.sentence in str(diagnosis) for b in found.blind_spots)
    assert diagnosis.blind_spots[0].sentence in str(diagnosis).splitlines()[1]
    assert json.loads(json.dumps(diagnosis.to_dict()))["blind_spots"][0]["kind"] == found.blind_spots[0].kind


def test_a_further_record_is_named_by_the_gravest_blind_spot(some):
    says = {
        "one amplitude": "several frequencies and amplitudes of force",
        "one push": "A slow triangle of force",
        "one temperature": "temperature varies",
        "sensor upstream": "slow triangle",
        "offset of an integrator": "begins at rest",
        "two gains": "another sensor, such as one of x, to separate gain and k_sensor",
        "free scale": "measure m separately",
        "no thermometer": "another sensor",
        "two ports at one joint": "measures the force at bearing",
    }
    for name, words in says.items():
        rig, found = some[name]
        assert rig.told(found) and words in found.next_record, (name, found.next_record)
        assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["next_record"] == found.next_record
        assert "next record: " in str(found) and all(spot.sentence in str(found) for spot in found.blind_spots)


def test_a_sensor_that_parts_two_parameters_is_proposed():
    """A motor's gain and its gear are a product at the output, and apart at the shaft between them."""
    train = Simulator(
        lambda x, u, p: {"shaft": (p.gain * u.u - x.shaft) / 0.2, "load": (p.gear * x.shaft - x.load) / 0.3},
        lambda x: {"y": x.load},
        states=("shaft", "load"),
        inputs=("u",),
        parameters={"gain": Parameter(3.0, bounds=(1, 9)), "gear": Parameter(0.5, bounds=(0.1, 2))},
    )
    found = check(train, record(train, noise_like(3)))
    assert [t.only_as for t in found.ties] == [("gain*gear",)]
    assert "such as one of shaft," in found.next_record


def gained(law, parameters):
    """A lag with a gain that is a function of parameters."""
    return Simulator(
        lambda x, u, p: {"x": (law(p) * u.u - x.x) / p.T},
        lambda x: {"y": x.x},
        states=("x",),
        inputs=("u",),
        parameters={**parameters, "T": Parameter(0.2, bounds=(0.02, 2))},
    )


WIDE = Parameter(3.0, bounds=(0.5, 20))
FREE = Parameter(2.0)


@pytest.mark.parametrize(
    ("law", "parameters", "only_as"),
    [
        (lambda p: p.E * p.b * p.h**3, {"E": WIDE, "b": WIDE, "h": Parameter(1.0, bounds=(0.5, 2))}, "E*b*h^3"),
        (lambda p: p.a - p.b, {"a": Parameter(5.0, bounds=(1, 9)), "b": WIDE}, "a - b"),
        (lambda p: p.a + p.b + p.c, {"a": WIDE, "b": WIDE, "c": Parameter(0.0, bounds=(-1, 1))}, "a + b + c"),
        (lambda p: p.a * p.b * p.c * p.d * p.e, dict.fromkeys("abcde", WIDE), "a*b*c*d*e"),
        (lambda p: p.g / p.l, {"g": FREE, "l": FREE}, "l/g"),
        (lambda p: p.k * p.r**2, {"k": FREE, "r": FREE}, "k*r^2"),
        (lambda p: p.a * p.b, {"a": Parameter(-3.0, bounds=(-9, -1)), "b": WIDE}, "a*b"),
        (
            lambda p: p.a * p.b / (p.a + p.b),
            {"a": Parameter(3.0, bounds=(1, 9)), "b": Parameter(6.0, bounds=(1, 20))},
            "",
        ),
    ],
)
def test_combinations_are_written_with_whole_exponents(law, parameters, only_as):
    simulator = gained(law, parameters)
    found = check(simulator, record(simulator, noise_like(2)), laws=())
    assert [set(t.names) for t in found.ties] == [set(parameters)]
    assert found.ties[0].only_as == ((only_as,) if only_as else ())
    assert {p.name: p.status for p in found.parameters}["T"] == "identifiable"


def test_two_products_are_two_ties():
    simulator = gained(lambda p: p.a * p.b, {"a": WIDE, "b": WIDE, "c": WIDE, "d": WIDE})
    simulator = Simulator(
        simulator.dynamics,
        lambda x, p: {"y": x.x, "z": 0.1 * p.c * p.d + x.x},
        states=("x",),
        inputs=("u",),
        parameters=simulator.parameters,
    )
    found = check(simulator, record(simulator, noise_like(2)), laws=())
    assert {t.only_as for t in found.ties} == {("a*b",), ("c*d",)}


def test_an_offset_without_bounds_is_identifiable_in_any_unit():
    simulator = Simulator(
        lambda x, u: {"x": 5 * (u.u - x.x)},
        lambda x, p: {"y": 1e6 * x.x + p.offset},
        states=("x",),
        inputs=("u",),
        parameters={"offset": Parameter(0.0)},
    )
    found = check(simulator, record(simulator, noise_like(2), initial="estimate"), laws=())
    assert [p.status for p in found.parameters] == ["identifiable"]


def test_a_parameter_that_only_a_port_reads_is_not_called_dead():
    simulator = Simulator(
        lambda x, u, p: {"x": p.g * u.u - 3 * x.x},
        lambda x: {"y": x.x},
        states=("x",),
        inputs=("u",),
        parameters={"g": WIDE, "share": Parameter(0.5, bounds=(0, 1))},
        ports=Port("valve", lambda p: {"x": -p.share}, lambda x: x.x),
    )
    found = check(simulator, record(simulator, noise_like(2)))
    assert {p.name: p.status for p in found.parameters} == {"g": "identifiable", "share": "port"}
    assert not found.blind_spots and "only with a law at its port" in str(found)


def test_what_only_the_refit_leaves_dead_is_said_to_be_alive_as_given():
    def stopped(k):
        return Simulator(
            lambda x, u, p: {
                "q": x.v,
                "v": u.f - p.k * x.q - 2 * x.v - p.k_stop * ca.fmax(x.q - 0.05, 0.0),
            },
            lambda x: {"y": x.q},
            states=("q", "v"),
            inputs=("f",),
            parameters={"k": Parameter(k, bounds=(5, 500)), "k_stop": Parameter(100.0, bounds=(10, 1000))},
        )

    found = check(stopped(10.0), record(stopped(100.0), noise_like(2)))
    sentence = next(b.sentence for b in found.blind_spots if b.kind == "dead")
    assert "before the refit, the outputs do react to k_stop" in sentence


def test_a_free_decay_shows_what_is_alive_as_given():
    """A run from rest would stand still."""

    def stopped(k):
        return Simulator(
            lambda x, u, p: {"q": x.v, "v": u.f - p.k * x.q - 2 * x.v - p.k_stop * ca.fmax(x.q - 0.05, 0.0)},
            lambda x: {"y": x.q},
            states=("q", "v"),
            inputs=("f",),
            parameters={"k": Parameter(k, bounds=(5, 500)), "k_stop": Parameter(100.0, bounds=(10, 1000))},
        )

    rest = np.zeros(SAMPLES)
    blank = Recording(rest, rest, DT, ("f",), ("y",), initial=[0.0, 0.45], hold="zero")
    y = stopped(100.0).simulate(blank)
    decay = blank.with_(y=y + 1e-4 * np.random.default_rng(0).standard_normal(y.shape), initial="estimate")
    dead = next(b for b in check(stopped(40.0), decay).blind_spots if "k_stop" in b.names)
    assert "before the refit, the outputs do react to k_stop" in dead.sentence


def test_a_wrong_unit_with_which_every_run_diverges_is_told():
    swelling = Simulator(
        lambda x, u, p: {"q": u.f - p.a * x.q + x.q**3},
        lambda x: {"y": x.q},
        states=("q",),
        inputs=("f",),
        parameters={"a": Parameter(5.0, bounds=(1, 20))},
    )
    right = record(swelling, noise_like(1))
    found = check(swelling, right.with_(u=1e3 * right.u))
    assert [b.names for b in found.blind_spots if b.kind == "recording-fault"] == [("f",)]
    assert found.error < 0.1
    with pytest.raises(InputError, match="diverges"):
        check(swelling, right.with_(u=1e3 * np.cumsum(np.abs(right.u), axis=0)))


def test_a_simulator_that_does_not_follow_is_said_to_be_rough():
    given = record(MASS, noise_like(1))
    found = check(MASS, given.with_(y=given.y[::-1]))
    assert found.blind_spots[0].kind == "rough" and "check its values and units" in found.next_record
    assert "large physics is missing, which `pilfr diagnose` finds out" in found.next_record
    assert "detectable from" not in str(found) and "look the same" not in str(found)


def test_a_switch_is_not_to_be_given_another_amplitude():
    on_off = noise_like(1)
    on_off = np.where(on_off > np.median(on_off), 1.0, 0.0)
    found = check(MASS, record(MASS, on_off))
    assert found.switches == ("force",) and "amplitude of force" not in found.next_record
    assert not [b for b in found.blind_spots if b.kind == "one-amplitude" and "actuator:force" in b.names]
    both = check(MASS, record(MASS, 2 * on_off - 1))  # a test signal of two levels may have another size
    assert not both.switches


def test_an_error_above_the_noise_is_told_first():
    given = record(MASS, noise_like(1))
    bent = check(MASS, given.with_(y=given.y + 0.3 * np.abs(given.y)), laws=())
    assert str(bent).startswith("refitted: error") and "What is missing may distort the refitted values" in str(bent)
    assert "Something is missing" not in str(check(MASS, given, laws=()))


def test_a_law_of_the_rate_needs_more_than_a_held_input():
    port = Port("coil", into={"y": 1.0}, across=lambda x, u: u.u, unit="V", across_unit="A")
    simulator = gained(lambda p: p.g, {"g": WIDE})
    simulator = Simulator(
        simulator.dynamics, lambda x: {"y": x.x}, ("x",), ("u",), parameters=simulator.parameters, ports=(port,)
    )
    given = record(simulator, noise_like(2))
    for hold in ("zero", "linear"):
        found = check(simulator, given.with_(hold=hold), laws=[CubicStiffness, CubicDamping])
        why = {r.law: r.why for r in found.laws if r.port == "coil"}
        assert ("its coordinate jumps and has no rate" in why["cubic_damping"]) is (hold == "zero")


def test_a_refit_that_ends_at_a_bound_is_marked():
    simulator = gained(lambda p: p.g, {"g": WIDE})
    held = gained(lambda p: p.g, {"g": Parameter(2.0, bounds=(1.0, 2.5))})
    found = check(held, record(simulator, noise_like(2)))
    assert [p.name for p in found.parameters if p.at_bound] == ["g"] and "yes, at its bound" in str(found)


def test_an_input_that_no_equation_reads_is_no_port():
    simulator = gained(lambda p: p.g, {"g": WIDE})
    idle = Simulator(
        simulator.dynamics, simulator.outputs, ("x",), ("u", "temperature"), parameters=simulator.parameters
    )
    found = check(idle, record(idle, np.column_stack([noise_like(2), noise_like(3)])))
    assert not found.blind_spots and "actuator:temperature" not in {r.port for r in found.laws}
    assert found.idle_inputs == ("temperature",)
    assert "inputs that the equations do not read: temperature; a diagnosis tries" in str(found)


def test_standard_errors_are_those_of_many_noises(mass):
    first, found = mass
    clean = MASS.simulate(first)
    rng, values = np.random.default_rng(5), []
    for _ in range(8):
        noisy = first.with_(y=clean + NOISE * np.std(clean) * rng.standard_normal(clean.shape))
        values.append([p.value for p in check(MASS, noisy, laws=()).parameters])
    for row, spread in zip(found.parameters, np.std(values, axis=0, ddof=1), strict=True):
        assert 0.5 < row.std / spread < 2.0, row.name  # eight draws determine it to a quarter


@pytest.mark.parametrize("law", [CubicStiffness, CoulombFriction])
def test_a_law_of_the_strength_named_moves_the_outputs_as_much_as_is_detected(law):
    """Ten times that strength, without noise: a refit leaves ten detection limits."""
    given = record(MASS, noise_like(1, 10.0))
    found = check(MASS, given, laws=[law])
    row = next(r for r in found.laws if r.port == "mount" and r.law == law.id)
    name, value, _ = row.strength
    shape = {} if law is CubicStiffness else {"v_0": 0.06 * np.quantile(np.abs(np.gradient(given.y[:, 0], DT)), 0.99)}
    world = close_loop(MASS, law({name: 10 * value, **shape}), "mount")
    y = world.simulate(given)
    noise = found.noise["deviation"]["position"]
    left = check(MASS, given.with_(y=y), laws=[law]).error * np.std(y) * np.sqrt(SAMPLES) / noise
    assert 32.9 / 2 < left < 32.9 * 2


def test_a_second_amplitude_and_reversals_are_counted():
    both = [record(MASS, noise_like(1, a)) for a in (1.0, 4.0)]
    rows = {e.port: e for e in check(MASS, both, laws=()).excitation}
    assert rows["mount"].reversals > 50 and rows["mount"].amplitudes > 1
    assert rows["mount"].unit == "m"


def test_one_sine_is_one_amplitude_of_one_frequency():
    t, sine = DT * np.arange(SAMPLES), lambda f, t: 30 * np.sin(2 * np.pi * f * t)
    cut = record(MASS, 5 + sine(0.7, t + 0.3))  # the ends cut two swings short
    found = check(MASS, cut, laws=())
    assert next(e for e in found.excitation if e.port == "actuator:force").amplitudes == 1
    (spot,) = (b for b in found.blind_spots if b.kind == "one-frequency")
    assert spot.names == ("force",) and "force has a single frequency, 0.7 Hz" in spot.sentence
    assert found.next_record == "One with several frequencies and amplitudes of force, such as a multisine."
    for others in ([sine(0.7, t) + sine(1.9, t) / 3], [sine(0.7, t), sine(1.9, t)]):
        several = check(MASS, [record(MASS, u) for u in others], laws=())
        assert "one-frequency" not in {b.kind for b in several.blind_spots}


def test_reversals_and_amplitudes_of_steps_are_counted():
    steps = np.repeat([0.0, 30.0, 0.0, 60.0, 10.0, 40.0], SAMPLES // 6)
    row = next(e for e in check(MASS, record(MASS, steps), laws=()).excitation if e.port == "actuator:force")
    assert (row.reversals, row.amplitudes, row.rests) == (4, 3, 6)  # swings of 30, 50 and 60
    stairs = np.repeat([50.0, 20, 25, 80, 70], [310, 130, 185, 60, 215])
    row = next(e for e in check(MASS, record(MASS, stairs), laws=()).excitation if e.port == "actuator:force")
    assert (row.reversals, row.amplitudes, row.rests) == (2, 3, 5)  # swings of 30, 60 and 10


@pytest.mark.parametrize(
    ("levels", "each", "rests"),
    [([0, 1, 2, 3, 4, 3, 2, 1, 0], 60, 9), (range(12), 50, 12), ([0, 1, 0, 1, 1, 0] * 25, 4, 0)],
)
def test_steps_are_rests_if_they_are_long(levels, each, rests):
    steps = 10 * np.repeat(np.array(levels, dtype=float), each)
    row = next(e for e in check(MASS, record(MASS, steps), laws=()).excitation if e.port == "actuator:force")
    assert row.rests == rests


def test_holds_between_ramps_are_rests():
    ramps = np.concatenate([np.linspace(0, 40, 50), np.full(SAMPLES - 50, 40.0)])
    found = check(MASS, record(MASS, ramps, initial="estimate"), laws=())
    row = next(e for e in found.excitation if e.port == "actuator:force")
    assert (row.reversals, row.rests) == (0, 1)


def test_simulators_that_cannot_be_followed_get_a_sentence():
    falling = Simulator(
        lambda x, u: {"q": x.v, "v": 400 * x.q + u.f},
        lambda x: {"y": x.q},
        states=("q", "v"),
        inputs=("f",),
    )
    drive = noise_like(1)
    r = Recording(drive, drive, DT, ("f",), ("y",), hold="zero")
    with pytest.raises(InputError, match=r"put the controller into the simulator"):
        check(falling, r)


def test_wrong_input_gets_a_sentence():
    given = record(MASS, noise_like(1))
    with pytest.raises(InputError, match="hold is 'cubic'; give 'zero'"):
        check(MASS, given, hold="cubic")
    with pytest.raises(InputError, match="give classes of laws"):
        check(MASS, given, laws=[CoulombFriction()])
    with pytest.raises(InputError, match="give a Simulator"):
        check("rig.py", given)
    with pytest.raises(InputError, match="never changes"):
        check(MASS, given.with_(y=np.ones(SAMPLES)))
    with pytest.raises(InputError, match="has no outputs"):
        check(MASS, given.with_(y=np.zeros((SAMPLES, 0)), outputs=()))


def test_a_stated_start_that_the_first_sample_contradicts_is_told():
    given = record(MASS, noise_like(1), begin=[0.3, 0.0])
    found = check(MASS, given)
    assert found.blind_spots[0].names == ("initial state",) and found.starts == ("at zero, here estimated",)
    assert "would begin at 0, but its first sample is 0.3" in str(found)
    assert found.next_record.startswith("State how the recordings begin")


def test_a_step_of_a_constant_input_has_one_amplitude_at_a_time():
    """The input is there from the first sample on; another size of it, or another start, tells amplitude from time."""
    given = record(MASS, np.full(SAMPLES, 2.0), initial="estimate")
    found = check(MASS, given)
    assert {"constant-input", "one-path"} <= {spot.kind for spot in found.blind_spots}
    assert found.next_record.startswith("One in which force varies, or one from another start")
    other = check(MASS, [given, record(MASS, np.full(SAMPLES, 1.0), initial="estimate")])
    assert not {"constant-input", "one-path"} & {spot.kind for spot in other.blind_spots}


def test_a_wrong_start_is_told_beside_a_fault_of_a_channel():
    u = 20 * multisine(600, f_max=1.5, fs=50.0, rng=np.random.default_rng(0))
    given = Recording(u, 0 * u, 0.02, ("force",), ("pos",), initial=[0.5, 0.0], hold="zero")
    y = cart().simulate(given)
    y = y + 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    found = check(cart(), given.with_(y=-y, initial="zero"))
    assert "check wiring, sign and unit" in found.next_record and "State how the recordings begin" in found.next_record


def test_hold_and_start_are_told(mass):
    given, found = mass
    assert found.hold == "zero" and found.starts == ("at zero",)
    unsaid = check(MASS, given.with_(hold=None, initial="estimate"), laws=())
    assert unsaid.hold == "" and "not stated" in str(unsaid) and unsaid.starts == ("estimated",)


@pytest.mark.parametrize("hold", [None, "linear"])
def test_a_simulator_in_discrete_time_reads_inputs_at_the_samples(mass, hold):
    slow = Simulator(
        lambda x, u, p: {"pos": p.a * x.pos + u[mass[0].inputs[0]]},
        lambda x: {mass[0].outputs[0]: x.pos},
        ("pos",),
        mass[0].inputs,
        parameters={"a": Parameter(0.9, bounds=(0.1, 1))},
        discrete=True,
    )
    given = mass[0].with_(initial="zero", hold=hold)
    found = check(slow, given.with_(y=slow.simulate(given) + given.y * 1e-3), laws=())
    assert found.hold == found.hold_taken == "zero"


def test_an_unstated_hold_is_the_one_that_fits_better(mass):
    given, _ = mass
    for hold in ("zero", "linear"):
        y = MASS.simulate(given.with_(hold=hold))
        unsaid = check(MASS, given.with_(y=y + 1e-3 * given.y, hold=None), laws=())
        assert (unsaid.hold, unsaid.hold_taken) == ("", hold)


def test_noise_from_periods_is_told_as_such():
    u = np.tile(multisine(500, f_max=8.0, fs=1 / DT, rng=np.random.default_rng(0)), 4)
    given = record(MASS, u).slice(500, 2000).with_(initial="periodic", period=500)
    found = check(MASS, given, laws=())
    assert found.noise["source"] == "from the periods"
    assert found.noise["share"]["position"] == pytest.approx(NOISE, rel=0.2)


def test_laws_of_ones_own_and_other_systems():
    given = record(MASS, noise_like(1))
    rows = check(MASS, given, laws=[CubicStiffness]).laws
    assert {r.law for r in rows} == {"cubic_stiffness"} and {r.port for r in rows} == {"mount"}
    control = pytest.importorskip("control")
    system = control.ss([[0, 1], [-100, -2]], [[0], [1]], [[1, 0]], [[0]], inputs="force", outputs="position")
    assert check(system, given, laws=()).parameters


def test_matrix_parameters_are_told_entry_by_entry():
    simulator = Simulator(
        lambda x, u, p: {"x": p.g[0] * u.u - p.g[1] * x.x},
        lambda x: {"y": x.x},
        states=("x",),
        inputs=("u",),
        parameters={"g": Parameter([2.0, 3.0], unit="1/s", bounds=(0.5, 9))},
        ports=Port("valve", {"x": -1.0}, lambda x: x.x),
    )
    found = check(simulator, record(simulator, noise_like(4)))
    assert len(found.parameters) == 2 and all(p.status == "identifiable" for p in found.parameters)


def test_every_law_of_the_catalogue_is_in_the_table(mass):
    _, found = mass
    for port in MASS.all_ports():
        wanted = {law.id for law in CATALOGUE if port.admits(law)}
        assert {r.law for r in found.laws if r.port == port.name} == wanted


def test_its_name_stays_a_function():
    importlib.import_module("pilfr_casadi.diagnose.blind_spots")
    assert pilfr.check is check and "without fitting a law" in check.__doc__


@pytest.mark.parametrize(
    ("only_as", "said"),
    [("3*Cm + 2*Cw", "their sum (3*Cm + 2*Cw)"), ("Cm*Cw", "their product (Cm*Cw)"), ("Cm - 2*Cw", "Cm - 2*Cw")],
)
def test_a_tie_is_called_by_its_kind(only_as, said):
    assert Tie(("Cm", "Cw"), (only_as,)).sentence == f"Cm and Cw can be identified only as {said}."


def test_unscored_samples_are_no_noise():
    """What a recording leaves out may be anything."""
    given = record(MASS, noise_like(1)).with_(skip=20)
    wild = given.y.copy()
    wild[:20] += np.random.default_rng(0).standard_normal((20, wild.shape[1])) * np.ptp(wild)
    told, quiet = (check(MASS, r).noise["share"] for r in (given.with_(y=wild), given))
    assert told == pytest.approx(quiet, rel=1e-3)


def test_a_test_inside_the_trained_range_leaves_nothing():
    """Nor does a channel that rests."""
    rng, rest = np.random.default_rng(0), np.full((400, 1), 0.1)
    trained = np.hstack([rng.uniform(-1, 1, (400, 1)), rest])
    assert ranges_left(trained, np.hstack([0.5 * trained[:, :1], rest * (1 + 1e-12)])) == []
    ((channel, value, limit),) = ranges_left(trained, np.hstack([2 * trained[:, :1], rest]))
    assert channel == 0 and abs(value) == pytest.approx(2 * abs(limit), rel=0.02)
    assert share_at_new_frequencies([trained[:, 0]], [rest[:, 0]], 0.1) == 0.0


def test_few_samples_have_no_single_frequency():
    rng = np.random.default_rng(0)
    assert not any(single_frequency([rng.standard_normal(n)], 0.1) for n in (2, 3, 5, 12) for _ in range(20))


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_the_parameter_that_imitates_a_law_is_named_in_any_unit_of_the_force(scale):
    guide = Port("guide", {"vel": -scale}, lambda x: x.pos)
    drive = 10 * np.repeat(np.random.default_rng(0).standard_normal(SAMPLES // 10), 10)
    found = check(plain([guide]), record(plain(), drive, initial="estimate"))
    rows = {row.law: row.why for row in found.laws if row.port == "guide" and row.status == "followed"}
    assert rows == {"linear_stiffness": "k", "viscous_damping": "d"}


def test_a_law_can_be_told_from_a_parameter_if_one_of_its_forms_can():
    """A root of the charge looks like the straight open-circuit voltage of the simulator; a free curve does not."""
    cell = Simulator(
        lambda x, u, p: {"soc": -u.current / 17000.0},
        lambda x, u, p: {"voltage": p.E0 + p.E1 * x.soc - p.R * u.current},
        states=("soc",),
        inputs=("current",),
        parameters={"E0": Parameter(3.2), "E1": Parameter(0.9), "R": Parameter(0.02)},
        ports=(Port("ocv", {"voltage": 1.0}, lambda x: x.soc, unit="V", across_unit="1"),),
    )
    rng = np.random.default_rng(0)
    current = np.repeat(rng.uniform(-2.0, 8.0, 60), 40)[:, None]
    still = Recording(current, np.zeros((len(current), 1)), 1.0, ["current"], ["voltage"], initial=[0.9], hold="zero")
    noisy = still.with_(y=cell.simulate(still) + 1e-3 * rng.standard_normal((len(current), 1)))
    (root,) = (r for r in check(cell, noisy, laws=[Root]).laws if r.port == "ocv")
    assert root.status == "followed"
    found = check(cell, noisy)
    (curve,) = (r for r in found.laws if r.port == "ocv" and r.law == "static_curve")
    assert curve.status == "detectable"
    assert not [b for b in found.blind_spots if b.kind == "followed" and "static_curve" in b.names and "ocv" in b.names]


def test_a_channel_in_another_unit_is_told():
    simulator = replace(spring_rig(), units={"pos": "m"})
    found = pilfr.check(simulator, recorded(spring_rig(), 0).with_(units={"pos": "mm"}))
    assert found.conversions == (
        "pos is recorded in mm, and the simulator has it in m: its values were multiplied by 0.001.",
    )
    assert f"\nunits: {found.conversions[0]}\n" in str(found)
    assert not pilfr.check(spring_rig(), recorded(spring_rig(), 0)).conversions


def test_a_refit_that_is_far_off_is_not_said_to_have_no_blind_spot():
    true = spring_rig().with_element("ground", CubicStiffness().at({"k_3": 2e3}))
    tight = replace(spring_rig(), parameters={"k": Parameter(400.0, bounds=(350, 402)), "d": Parameter(4.0)})
    found = pilfr.check(tight, recorded(true, 0), laws=())
    found = replace(found, blind_spots=())
    assert "No blind spot was found near the refitted values, which what is missing may distort." in str(found)
    assert next(p for p in found.parameters if p.name == "k").at_bound
    assert "None yet: k came out at a bound" in found.next_record
