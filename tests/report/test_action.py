"""The element of a fitted simulator that an effect is, and how it acts."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import recordings, rig

from pilfr_casadi.diagnose import Effect, Workbench, law_signals
from pilfr_casadi.diagnose.faults.offsets import Offset
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, LossyContact
from pilfr_casadi.report.diagnosis_tables import element_of, measure_action


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
    energy = float(np.sum((w[1:] + w[:-1]) / 2 * np.diff(z)))
    assert energy > 0 and rows["equivalent stiffness"] > 0
    assert rows["equivalent damping"] == pytest.approx(energy / np.sum((dz[1:] + dz[:-1]) / 2 * np.diff(z)))
