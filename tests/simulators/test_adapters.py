"""A user's simulator file: its rights, no traces after it has run, and one sentence for every error in it."""

import os
import sys

import pytest

from pilfr_casadi import InputError, Simulator
from pilfr_casadi.simulators import load_simulator

RIG = '''"""A mass on a spring."""
from pilfr_casadi import Parameter, Port, Simulator


def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m)


def outputs(x, u, p):
    return dict(position=x.pos)


simulator = Simulator(
    dynamics, outputs, states=("pos", "vel"), inputs=("force",),
    parameters=dict(m=Parameter(2.0, fixed=True), k=Parameter(1100.0, bounds=(500, 3000)), d=Parameter(15.0)),
    ports=(Port("ground", into=lambda p: dict(vel=-1 / p.m), across=lambda x: x.pos),),
)
'''


def write(tmp_path, text=RIG, *changes):
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "rig.py"
    path.write_text(text)
    return path


def test_a_simulator_is_loaded_and_nothing_is_left_behind(tmp_path):
    (tmp_path / "springs.py").write_text("K = 1100.0\n")
    path = write(tmp_path, RIG, ("1100.0", "K"), ("from pilfr", "from springs import K\nfrom pilfr"))
    before, where, wrote = set(sys.modules), list(sys.path), sys.dont_write_bytecode
    simulator = load_simulator(path)
    assert isinstance(simulator, Simulator) and simulator.output_names == ("position",)
    assert float(simulator.parameters["k"].value) == 1100.0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rig.py", "springs.py"]
    assert "springs" not in sys.modules and not any("rig" in n for n in set(sys.modules) - before)
    assert sys.path == where and sys.dont_write_bytecode == wrote
    (tmp_path / "springs.py").write_text("K = 1200.0\n")
    assert float(load_simulator(path).parameters["k"].value) == 1200.0


def test_two_files_of_one_name_do_not_mix(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder, k in ((one, "900.0"), (two, "800.0")):
        folder.mkdir()
        write(folder, RIG, ("1100.0", k))
    assert [float(load_simulator(f / "rig.py").parameters["k"].value) for f in (one, two)] == [900.0, 800.0]


def test_a_file_finds_its_own_folder_from_any_other(tmp_path, monkeypatch):
    path = write(tmp_path, RIG + "\nimport os\n\nassert os.path.isabs(__file__), __file__\n")
    monkeypatch.chdir(tmp_path)
    assert load_simulator(path.name).states == ("pos", "vel")


def test_a_file_does_not_move_the_program_to_another_folder(tmp_path):
    here = os.getcwd()
    load_simulator(write(tmp_path, f"import os\n\nos.chdir({str(tmp_path)!r})\n{RIG}"))
    assert os.getcwd() == here


def test_a_dataclass_may_be_defined_in_the_file(tmp_path):
    extra = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    extra += "@dataclass\nclass A:\n    b: int = 1\n"
    assert load_simulator(write(tmp_path, extra + RIG)).states == ("pos", "vel")


def test_numpy_functions_work_on_symbols(tmp_path):
    assert load_simulator(write(tmp_path, RIG, ("p.k * x.pos", "__import__('numpy').tanh(p.k * x.pos)"))).inputs


ERRORS = {
    "syntax": (("def dynamics(x, u, p):", "def dynamics(x, u, p)"), ("line 5", "':'", "def dynamics(x, u, p)")),
    "indentation": (("    return dict(position", "return dict(position"), ("line 10",)),
    "no simulator": (("simulator = Simulator(", "rig = Simulator("), ("'simulator'", "'rig'")),
    "nothing defined": (("simulator = Simulator(", "_ = Simulator("), ("'simulator'", "simulator = Simulator(...)")),
    "something else": (("\n)\n", "\n)\nsimulator = 3\n"), ("'simulator'", "int")),
    "exception at import": (('"""A mass', '1 / 0\n"""A mass'), ("line 1", "ZeroDivisionError")),
    "missing module": (("from pilfr", "import notthere\nfrom pilfr"), ("line 2", "notthere")),
    "undefined name": (("p.k * x.pos", "stiffness * x.pos"), ("line 6", "stiffness")),
    "state without derivative": (("pos=x.vel, ", ""), ("derivative", "'pos'")),
    "derivative of no state": (("dict(pos=", "dict(acc=x.vel, pos="), ("'acc'", "pos, vel")),
    "unknown parameter": (("p.k * x.pos", "p.kk * x.pos"), ("line 6", "'kk'", "m, k, d")),
    "unknown state": (("p.d * x.vel", "p.d * x.speed"), ("line 6", "'speed'", "pos, vel")),
    "unknown input": (("u.force", "u.f"), ("line 6", "'f'", "force")),
    "port into an unknown state": (("dict(vel=-1", "dict(velocity=-1"), ("'ground'", "'velocity'", "pos, vel")),
    "port across an unknown state": (("lambda x: x.pos", "lambda x: x.gap"), ("line 16", "'gap'", "'ground'")),
    "port asks for something else": (("lambda x: x.pos", "lambda v: v"), ("'v'", "'ground'")),
    "twice the same state": (('("pos", "vel")', '("pos", "pos")'), ("unique",)),
    "no dict": (("return dict(position=x.pos)", "return x.pos"), ("dict",)),
    "branch on a symbol": (("p.k * x.pos", "(p.k * x.pos if x.pos > 0 else 0)"), ("line 6", "casadi.if_else")),
    "math on a symbol": (("p.k * x.pos", "__import__('math').sin(x.pos)"), ("'vel'", "ca.sin")),
    "own symbol": (("p.k * x.pos", "__import__('casadi').SX.sym('extra')"), ("extra",)),
    "value outside bounds": (("1100.0", "100.0"), ("line 15", "bounds")),
    "parameter as a number": (("Parameter(15.0)", "15.0"), ("'d'", "Parameter")),
    "file ends the program": (('"""A mass', 'raise SystemExit\n"""A mass'), ("line 1", "ends the program")),
    "null byte": (('"""A mass', '"""A \0mass'), ("rig.py",)),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_in_the_file_become_one_sentence(tmp_path, case):
    change, says = ERRORS[case]
    path = write(tmp_path, RIG, change)
    with pytest.raises(InputError) as caught:
        load_simulator(path)
    message = str(caught.value)
    assert message.startswith((str(path), f"In {path}")) and "\n" not in message and len(message) < 400
    for word in says:
        assert word in message, message
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_in_a_neighbour_is_named(tmp_path):
    (tmp_path / "springs.py").write_text("K = = 1\n")
    with pytest.raises(InputError, match=r"rig.py, line 2: springs.py, line 1: .*syntax"):
        load_simulator(write(tmp_path, RIG, ("from pilfr", "import springs\nfrom pilfr")))
    (tmp_path / "springs.py").write_text("raise OSError('no such bench')\n")
    with pytest.raises(InputError, match=r"rig.py, line 2: OSError: no such bench"):
        load_simulator(tmp_path / "rig.py")


def test_files_that_are_none(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_simulator(tmp_path / "nowhere.py")
    with pytest.raises(InputError, match="is a folder"):
        load_simulator(tmp_path)
