"""Importing the package is cheap, and its public names arrive when they are used."""

import json
import subprocess
import sys

import pytest

import pilfr_casadi

HEAVY = ("scipy", "control", "matplotlib", "jinja2", "rich", "pydantic", "typer")


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
    assert seconds < 0.3
    assert not {m.split(".")[0] for m in modules} & set(HEAVY)


def test_import_alone_takes_nothing_heavy():
    modules = in_fresh_python("import json, sys, pilfr_casadi; print(json.dumps(sorted(sys.modules)))")
    assert not {m.split(".")[0] for m in modules} & {*HEAVY, "casadi", "numpy"}


def test_public_names_are_listed_and_there():
    assert set(pilfr_casadi.__all__) <= set(dir(pilfr_casadi))
    for name in pilfr_casadi.__all__:
        value = getattr(pilfr_casadi, name)
        assert getattr(value, "__name__", name).rpartition(".")[2] == name
        assert getattr(pilfr_casadi, name) is value


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        pilfr_casadi.fitt  # noqa: B018
