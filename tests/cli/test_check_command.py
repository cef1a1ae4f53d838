"""`pilfr check`: a whole run from files, and one plain sentence with exit status 2 for what cannot be used."""

import json
import re

import numpy as np
from command_line import refused, run


def test_findings_are_printed_and_written(capsys, files):
    given = ("check", files / "rig.py", files / "rig_train.csv", "--initial", "zero", "--hold", "zero")
    status, out, err = run(capsys, *given, "--out", files / "out")
    assert status == 0 and not err
    for words in ("parameter", "k2", "detectable from (rms)", "ground-m1", "reversals", "noise", "next record: "):
        assert words in out
    assert re.search(r"noise \(.*\): x2 \S+ m\n", out)
    found = json.loads((files / "out" / "check.json").read_text(encoding="utf-8"))
    assert found["hold"] == "zero" and found["starts"] == ["at zero"]
    assert {p["name"] for p in found["parameters"]} == {"k1", "k2", "d1", "d2"}
    assert {e["port"] for e in found["excitation"]} >= {"ground-m1", "m1-m2", "actuator:force", "sensor:x2"}
    refused(capsys, *given, "--out", files / "out", says="exists already")
    assert run(capsys, *given, "--out", files / "out", "--overwrite")[0] == 0


def test_nothing_is_written_without_out(capsys, files):
    before = sorted(files.iterdir())
    assert run(capsys, "check", files / "rig.py", files / "rig_train.csv")[0] == 0
    assert sorted(files.iterdir()) == before


def test_wrong_files_get_a_sentence(capsys, files):
    rig, train = files / "rig.py", files / "rig_train.csv"
    refused(capsys, "check", train, rig, says="is not a simulator file")
    refused(capsys, "check", rig, says="No training recording was given")
    refused(capsys, "check", rig, rig, says="given as a recording")
    refused(capsys, "check", rig, train, train, says="given twice")
    refused(capsys, "check", rig, train, "--inputs", "force", says="its own names")
    refused(capsys, "check", rig, files / "none.csv", says="none.csv")
    refused(capsys, "check", files / "none.py", train, says="none.py")
    (files / "other.csv").write_text("t,torque,x2\n0,0,0\n0.1,1,1\n", encoding="utf-8")
    refused(capsys, "check", rig, files / "other.csv", says="force")


def test_an_unstable_simulator_gets_a_sentence(capsys, files):
    (files / "falling.py").write_text(
        "from pilfr_casadi import Simulator\n"
        "simulator = Simulator(lambda x, u: dict(q=x.v, v=400 * x.q + u.force), lambda x: dict(x2=x.q),\n"
        "                      states=('q', 'v'), inputs=('force',))\n",
        encoding="utf-8",
    )
    refused(capsys, "check", files / "falling.py", files / "rig_train.csv", says=("unstable", "controller"))


def test_a_simulator_without_free_parameters_is_reported(capsys, files):
    text = (files / "rig.py").read_text(encoding="utf-8")
    fixed = text + (
        "\nfrom dataclasses import replace\n"
        "held = {name: replace(p, fixed=True) for name, p in simulator.parameters.items()}\n"
        "simulator = simulator.with_parameters(held)\n"
    )
    (files / "fixed.py").write_text(fixed, encoding="utf-8")
    status, out, _ = run(capsys, "check", files / "fixed.py", files / "rig_train.csv", "--initial", "zero")
    assert status == 0 and "no free parameter" in out


def test_a_constant_input_is_reported(capsys, files):
    t = np.arange(300) * 0.01
    rows = "\n".join(f"{a:.2f},5,{b:.6f}" for a, b in zip(t, 0.01 * (1 - np.cos(6 * t)), strict=True))
    (files / "still.csv").write_text(f"t,force,x2\n{rows}\n", encoding="utf-8")
    status, out, _ = run(capsys, "check", files / "rig.py", files / "still.csv", "--initial", "zero")
    assert status == 0 and "Constant in all recordings: force." in out
