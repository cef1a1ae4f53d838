"""The element of a fitted simulator that an effect is, and how it acts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_example import rig as spring_rig
from diagnosis_rig import recordings, rig

from pilfr_casadi import Recording
from pilfr_casadi.diagnose import Effect, Workbench, law_signals
from pilfr_casadi.diagnose.faults.offsets import Offset
from pilfr_casadi.diagnose.result_text import NamelessLaw
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, LinearStiffness, LossyContact, ViscousDamping
from pilfr_casadi.report.diagnosis_tables import element_of, measure_action, nameless_blocks
from pilfr_casadi.report.page import Text


def test_an_effect_is_found_behind_an_offset():
    simulator = rig().with_element("actuator:force", Offset()).with_element("ground-m1", CoulombFriction({"F_c": 1.0}))
    fitted = Workbench.of(simulator, recordings(count=1), "zero").run(simulator, {}, [np.zeros(4)])
    here, elsewhere = (Effect(port, "coulomb_friction", 0.9, "", "", {}, ()) for port in ("ground-m1", "m1-m2"))
    assert element_of(fitted, here) == 1
    assert element_of(fitted, elsewhere) is None


@pytest.mark.parametrize(
    ("law", "units", "rows"),
    [
        (CubicStiffness({"k_3": 1e5}), ("N", "m"), ("force", "energy taken per cycle, mean", "stiffness", "damping")),
        (CoulombFriction({"F_c": 1.0}), ("N", "m"), ("force", "energy taken per cycle, mean", "damping")),
        (CubicStiffness({"k_3": 1e5}), ("m^3/s", "m"), ("force or flow",)),
    ],
)
def test_energy_stiffness_and_damping_are_told_where_they_mean_something(law, units, rows):
    plain = rig()
    ports = [replace(p, unit=units[0], across_unit=units[1], domain="") for p in plain.ports]
    simulator = replace(plain, ports=tuple(ports)).with_element("ground-m1", law)
    bench = Workbench.of(simulator, recordings(count=1), "zero")
    fitted = bench.run(simulator, {}, [np.zeros(4)])
    action = measure_action(bench, fitted, Effect("ground-m1", law.id, 0.9, "", "", {}, ()), 0)
    told = [row[0].removeprefix("equivalent ").removeprefix("largest ") for row in action.table.rows]
    assert tuple(told) == rows


def test_the_equivalent_damping_takes_the_energy_of_the_law():
    """A contact that loses energy: in a motion that is not periodic, its force and the speed are correlated anyhow."""
    law = LossyContact({"k_c": 2e4, "g": 0.0, "b": 0.2})
    simulator = rig().with_element("ground-m1", law)
    bench = Workbench.of(simulator, recordings(count=1), "zero")
    fitted = bench.run(simulator, {}, [np.zeros(4)])
    effect = Effect("ground-m1", law.id, 0.9, "", "", {}, ())
    rows = {row[0]: row[1] for row in measure_action(bench, fitted, effect, 0).table.rows}
    z, dz, w = law_signals(bench, fitted, 0, 0)
    up = np.flatnonzero((z[:-1] < np.mean(z)) & (z[1:] >= np.mean(z)))
    z, dz, w = (v[up[0] : up[-1] + 1] for v in (z, dz, w))  # whole cycles, but for parts of a sample
    energy = float(np.sum((w[1:] + w[:-1]) / 2 * np.diff(z)))
    assert energy > 0 and rows["equivalent stiffness"] > 0
    square = np.sum((dz[1:] + dz[:-1]) / 2 * np.diff(z))
    assert rows["equivalent damping"] == pytest.approx(energy / square, rel=0.02)
    assert rows["energy taken per cycle, mean"] == pytest.approx(energy / (len(up) - 1), rel=0.02)


@pytest.mark.parametrize(
    ("law", "d", "damping"),
    [
        (LinearStiffness({"k_1": 200.0}), 4.0, 0.0),
        (LinearStiffness({"k_1": 200.0}), 30.0, None),
        (ViscousDamping({"c_1": 3.0}), 4.0, 3.0),
        (ViscousDamping({"c_1": 3.0}), 30.0, 3.0),
    ],
)
def test_what_a_spring_stores_is_no_damping(law, d, damping):
    """After a step the spring stays compressed; with much damping there is no whole cycle."""
    simulator = spring_rig(400.0, d).with_element("ground", law)
    u = np.where(np.arange(300) < 20, 0.0, 20.0)[:, None]
    r = Recording(u, np.zeros((300, 1)), 0.01, ("force",), ("pos",), initial="zero", hold="zero")
    bench = Workbench.of(simulator, [r.with_(y=simulator.simulate(r))], "zero")
    fitted = bench.run(simulator, {}, [np.zeros(2)])
    action = measure_action(bench, fitted, Effect("ground", law.id, 0.9, "", "", {}, ()), 0)
    rows = {row[0]: row[1] for row in action.table.rows}
    assert rows.get("equivalent damping") == (damping if damping is None else pytest.approx(damping, abs=1e-3))


def test_what_speaks_against_a_law_without_a_sure_name_is_a_sentence():
    law = NamelessLaw("dry friction at ground", "w = F_c sign(v)", "as fitted it helps the motion", {}, "")
    blocks = nameless_blocks(SimpleNamespace(nameless_laws=[law], effects=()))
    assert [b.text for b in blocks if isinstance(b, Text)] == [
        "Dry friction at ground:",
        "As fitted it helps the motion.",
    ]
