"""`--laws` and `--effects` choose what is tried; names are ids or classes, and an unknown one is refused."""

import json

from command_line import refused, run

from pilfr_casadi.diagnose import check_laws
from pilfr_casadi.laws import CATALOGUE, CoulombFriction, Lag


def test_an_id_stands_for_all_forms_and_a_class_name_for_one():
    assert check_laws(["lag", "Lag", CoulombFriction]) == (Lag, CoulombFriction)
    assert check_laws(["coulomb_friction"]) == tuple(law for law in CATALOGUE if law.id == "coulomb_friction")


def test_check_lists_the_given_laws_alone(capsys, files):
    given = ("check", files / "rig.py", files / "rig_train.csv", "--initial", "zero", "--hold", "zero")
    status, _, _ = run(capsys, *given, "--laws", "cubic_stiffness,Lag", "--out", files / "out")
    found = json.loads((files / "out" / "check.json").read_text(encoding="utf-8"))
    assert status == 0 and {row["law"] for row in found["laws"]} == {"cubic_stiffness", "extra_mode"}


def test_an_unknown_law_is_refused_with_the_nearest_names(capsys, files):
    for command in ("check", "diagnose"):
        given = (command, files / "rig.py", files / "rig_train.csv", "--laws", "coulomb_frictoin")
        refused(capsys, *given, says=("'coulomb_frictoin'", "did you mean coulomb_friction"))
    refused(capsys, "check", files / "rig.py", files / "rig_train.csv", "--laws", "lagg", says="did you mean Lag")


def test_a_diagnosis_looks_for_as_many_effects_as_are_asked_for(capsys, files):
    given = ("diagnose", files / "rig.py", files / "rig_train.csv", "--initial", "zero", "--hold", "zero")
    options = (
        "--laws",
        "CubicStiffness,CoulombFriction",
        "--effects",
        "1",
        "--workers",
        "1",
        "--out",
        files / "out",
    )
    status, out, _ = run(capsys, *given, *options)
    found = json.loads((files / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    assert status == 0 and "writing the report took" in out
    assert len(found["effects"]) <= 1
    assert {row["law"] for row in found["candidates"]} <= {"cubic_stiffness", "coulomb_friction", "offset"}
