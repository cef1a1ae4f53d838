"""Whatever is wrong with the arguments of an export is one plain sentence; what is odd but usable compiles."""

import ctypes
import re
import subprocess
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_export import one_sentence, some_fit
from test_exported_models import mass_on_spring

from pilfr_casadi import exported, load
from pilfr_casadi._base import InputError
from pilfr_casadi.engine import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")
NOT_PATHS = [None, 3, b"x", "", "a\0b", ["a"], "x" * 5000]


def refused(call, words=None):
    with pytest.raises(InputError, match=words) as error:
        call()
    text = one_sentence(error)
    assert len(text) < 500, text
    return text


@pytest.mark.parametrize("eps", [1e200, np.inf, -1.0, "a", None, True])
def test_rounding_that_cannot_be_used(eps):
    refused(lambda: some_fit().export(smooth=eps), "give a number, from zero to 1e\\+100")


def test_what_cannot_be_bounded_has_no_bound():
    found = some_fit().export(smooth=1e100)
    states, outputs = found.bound(np.full(len(found.states), 1e200), [1e200])
    assert not np.any(np.isnan(states)) and not np.any(np.isnan(outputs))


@pytest.mark.parametrize("path", NOT_PATHS, ids=[str(k) for k in range(len(NOT_PATHS))])
def test_paths_that_are_none(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fitted = some_fit()
    found = fitted.export(name="rig")
    for call in (found.to_c, found.serialize, fitted.save, load):
        refused(lambda call=call: call(path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (None, "letters, digits"),
        (3, "letters, digits"),
        ("Ä", "letters, digits"),
        ("a-b", "letters, digits"),
        ("_a", "letters, digits"),
        ("x" * 51, "has 51 characters; give at most 50"),
        ("x" * 5000, "has 5000 characters"),
        ("double", "a word of C"),
        ("Register", "a word of C"),
        ("class", "a word of C"),
        ("math", "one of C's headers"),
        ("stdio", "one of C's headers"),
    ],
)
def test_names_that_cannot_be_used(name, words):
    refused(lambda: some_fit().export(name=name), words)


@needs_compiler
@pytest.mark.parametrize("name", ["x", "exp", "main", "arg", "now", "i", "casadi_real", "NULL", "rig_", "a" * 50])
def test_odd_names_compile_beside_each_other_and_step(name, tmp_path):
    found = some_fit().export(name=name)
    source, _ = found.to_c(tmp_path)
    user = f'#include "{name}.h"\nint used(void) {{ double x[{name.upper()}_NX]; {name}_x0(x); return x[0] == 0.0; }}\n'
    (tmp_path / "user.c").write_text(user)
    library = tmp_path / "both.so"
    strict = ["-std=c99", "-O1", "-Wall", "-Werror", "-Wno-unused", "-shared", "-fPIC", f"-I{tmp_path}"]
    subprocess.run([compiler(), *strict, source, tmp_path / "user.c", "-o", library, "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    assert code.used() == 1
    x, u, following, y = (np.zeros(n) for n in (7, 1, 7, 1))
    u[0] = 0.3
    pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (x, u, following, y)]
    getattr(code, f"{name}_step")(*pointers)
    expected = found.step(np.zeros(7), 0.3)
    assert np.array_equal(following, np.asarray(expected[0]).ravel()) and y[0] == float(expected[1])


@needs_compiler
def test_signals_that_differ_only_in_what_c_does_not_allow_keep_their_own_index(tmp_path):

    structure = some_fit("stops, two channels").structure
    names = {"inputs": ("a-b", "a b"), "outputs": ("µ", "?", "A_B")}
    model = structure.model(2, 3, **names)
    found = replace(some_fit("stops, two channels"), model=model, units={"a-b": "*/ int evil; /*"}).export(name="rig")
    _, header = found.to_c(tmp_path)
    for kind, count in (("U", 2), ("Y", 3), ("X", len(found.states))):
        lines = [line.split() for line in header.read_text().splitlines() if line.startswith(f"#define RIG_{kind}_")]
        assert [int(line[2]) for line in lines] == list(range(count))
        assert len({line[1] for line in lines}) == count
    subprocess.run([compiler(), "-std=c99", "-Werror", "-fsyntax-only", "-xc", header], check=True)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ("a", "numbers"),
        ({}, "numbers"),
        ([[1], [2, 3]], "numbers"),
        (np.zeros(7) * 1j, "numbers"),
        (["1"] * 7, "numbers"),
        ([np.nan] * 7, "not finite"),
        ([1.0], "has 1 numbers; give 3"),
        (np.zeros(8), "has 8 numbers"),
    ],
)
def test_start_states_that_are_none(start, words):
    assert "start state" in refused(lambda: some_fit().export(start=start), words)


@pytest.mark.parametrize(
    "options",
    [
        {"smooth": True},
        {"smooth": None},
        {"smooth": np.nan},
        {"smooth": [1.0]},
        {"substeps": "a"},
        {"substeps": [2]},
        {"substeps": True},
        {"substeps": 1.5},
        {"dt": True},
        {"dt": "a"},
        {"hold": 3},
    ],
    ids=str,
)
def test_options_that_are_none(options):
    refused(lambda: exported(mass_on_spring(), **({"dt": 0.02} | options)), next(iter(options)))


@pytest.mark.parametrize(
    ("x", "u", "words"),
    [
        ("a", 0.0, "The state"),
        ([np.nan] * 7, 0.0, "The state"),
        (np.zeros(7), None, "The input"),
        (np.zeros(7), [0.0, 1.0], "2 numbers were given for the input; expected 1"),
    ],
)
def test_bounds_where_there_are_no_numbers(x, u, words):
    refused(lambda: some_fit().export(smooth=0.1).bound(x, u), words)


@pytest.mark.parametrize(
    "given, words",
    [
        (([0, 0], [1]), "The state x of a step of model has 7 entries; the shape (2,) was given."),
        ((0.0, [1]), "has 7 entries; one number was given."),
        ((np.zeros((2, 7)), [1]), "the shape (2, 7)"),
        ((np.zeros(7), [1, 2]), "The input u of a step of model has 1 entry; the shape (2,)"),
        ((np.zeros(7), None), "The input u"),
        ((np.zeros(7),), "needs x and u"),
        ((np.zeros(7), 1, 2), "needs x and u"),
        ((ca.SX.sym("x", 2), 1.0), "the shape (2, 1)"),
    ],
)
def test_a_step_refuses_what_does_not_fit(given, words):
    refused(lambda: some_fit().export().step(*given), re.escape(words))


def test_a_step_takes_what_fits():
    step, x = some_fit().export().step, np.linspace(0.1, 0.7, 7)
    refused(lambda: step(x=x), "needs x and u")
    following, y = (np.asarray(v) for v in step(x, 0.3))
    for other in (step(x[None], [0.3]), step(ca.DM(x), ca.DM(0.3)), tuple(step(x=x, u=0.3).values())):
        assert np.array_equal(np.asarray(other[0]).ravel(), following.ravel()) and float(other[1]) == y.item()
    assert step(np.tile(x[:, None], 3), np.full((1, 3), 0.3))[0].shape == (7, 3)
    assert step(ca.MX.sym("x", 7), ca.MX.sym("u"))[1].shape == (1, 1)
