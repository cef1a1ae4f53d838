"""Importing the package is cheap, and its public names arrive when they are used."""

import json
import subprocess
import sys

import pytest

import pilfr_casadi

HEAVY = ("scipy", "control", "matplotlib", "jinja2", "rich")


def in_fresh_python(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_import_is_cheap():
    seconds, modules = in_fresh_python(
        "import json, sys, time, casadi, numpy\n"
        "before = set(sys.modules); start = time.perf_counter()\n"
        "import pilfr_casadi\n"
        "print(json.dumps([time.perf_counter() - start, sorted(set(sys.modules) - before)]))"
    )
    assert seconds < 0.5
    assert not {m.split(".")[0] for m in modules} & set(HEAVY)


def test_import_alone_takes_nothing_heavy():
    modules = in_fresh_python("import json, sys, pilfr_casadi; print(json.dumps(sorted(sys.modules)))")
    assert not {m.split(".")[0] for m in modules} & {*HEAVY, "casadi", "numpy"}


def test_public_names_are_listed_and_there():
    assert {"Recording", "InputError", "read_csv", "nrmse", "multisine", "tukey_realizations"} <= set(
        pilfr_casadi.__all__
    )
    assert set(pilfr_casadi.__all__) <= set(dir(pilfr_casadi))
    for name in pilfr_casadi.__all__:
        value = getattr(pilfr_casadi, name)
        assert value.__name__ == name
        assert getattr(pilfr_casadi, name) is value


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        pilfr_casadi.fitt  # noqa: B018


def test_a_verb_wins_over_the_module_it_is_named_after():
    names = in_fresh_python(
        "import json, sys, pilfr_casadi\n"
        "from importlib.machinery import ModuleSpec\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        return ModuleSpec(name, self) if name == 'pilfr_casadi.verb' else None\n"
        "    def create_module(self, spec): return None\n"
        "    def exec_module(self, module): exec('def verb(): return 1\\ndef other(): return 2', module.__dict__)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "pilfr_casadi._EXPORTS['verb'] = 'verb'\n"
        "from pilfr_casadi.verb import other\n"
        "from pilfr_casadi import verb\n"
        "print(json.dumps([other(), pilfr_casadi.verb(), verb()]))"
    )
    assert names == [2, 1, 1]
