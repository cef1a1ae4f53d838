"""Model files restore a model to the last digit or fail, and later changes to a file are noticed."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from exported_fits import CASES, changed, leaves, one_sentence, own_model, recording_for, signed, some_fit
from hypothesis import HealthCheck, given, settings, strategies as st

from pilfr_casadi import InputError, Limit, Recording, fit, load, save
from pilfr_casadi._base import write_atomically
from pilfr_casadi.cli import main
from pilfr_casadi.models import PILFR, GeneralizedPlay, Play, PrandtlIshlinskii
from pilfr_casadi.optimise import Status


@pytest.fixture(scope="module")
def real_fit():
    """A small identification with everything a fit has."""
    rng = np.random.default_rng(0)
    u = np.sin(np.arange(300) / 9.0) * np.linspace(0.2, 1.5, 300)
    play = np.zeros(300)
    for k in range(1, 300):
        play[k] = max(u[k] - 0.3, min(u[k] + 0.3, play[k - 1]))
    y = 2 * u + play + 0.01 * rng.normal(size=300)
    train = Recording(u, y, 0.01, units={"u": "V"})
    return fit(PILFR(1, PrandtlIshlinskii(Play, 3)), train, starts=2, engine="vm"), train


@pytest.mark.parametrize("case", CASES)
def test_a_saved_model_simulates_to_the_last_digit(case, tmp_path):
    before = some_fit(case)
    save(before, tmp_path / "model.json")
    after = replace(load(tmp_path / "model.json"), engine="vm")
    for name, value in before.parameters.items():
        assert np.array_equal(after.parameters[name], value)
        assert np.array_equal(after.model.parameters[name].bounds, before.model.parameters[name].bounds)
        assert np.array_equal(after.model.parameters[name].fixed, before.model.parameters[name].fixed)
        assert np.array_equal(after.errors[name], before.errors[name], equal_nan=True)
    data = recording_for(before)
    assert np.array_equal(after.simulate(data), before.simulate(data))
    assert after.nrmse(data) == before.nrmse(data)
    assert after.structure.fixed.keys() == before.structure.fixed.keys()
    for name in ("dt", "units", "labels", "active", "train_nrmse", "seconds"):
        assert getattr(after, name) == getattr(before, name)
    assert after.model.states == before.model.states
    assert np.array_equal(after.solution.theta, before.solution.theta)
    assert np.array_equal(after.solution.multipliers, before.solution.multipliers)
    assert (after.solution.history, after.status, after.solution.message) == (
        before.solution.history,
        before.status,
        "told",
    )
    assert np.array_equal(after.initial["0123456789abcdef"], before.initial["0123456789abcdef"])
    save(after, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "model.json").read_bytes()


def test_pydantic_is_loaded_only_to_read_a_model():
    code = (
        "import sys, pilfr_casadi as pilfr; pilfr.fit, pilfr.load, pilfr.exported; sys.exit('pydantic' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_real_fit_comes_back(real_fit, tmp_path):
    before, train = real_fit
    before.save(tmp_path / "model.json")
    after = replace(load(tmp_path / "model.json"), engine="vm")
    assert str(after) == str(before)
    assert after.nrmse(train) == before.nrmse(train) == pytest.approx(before.train_nrmse[0], rel=1e-12)
    assert [c.error for c in after.candidates] == [c.error for c in before.candidates]
    assert all(np.array_equal(after.linear.parameters[k].value, p.value) for k, p in before.linear.parameters.items())
    assert all(np.array_equal(after.errors[k], e, equal_nan=True) for k, e in before.errors.items())
    assert after.to_casadi()(np.zeros(4), [1.0])[1] == before.to_casadi()(np.zeros(4), [1.0])[1]


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=9, max_size=9))
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_finite_number_survives(tmp_path, numbers):
    before = some_fit()
    values = before.model.parameters.change(A={"value": np.reshape(numbers, (3, 3))})
    save(replace(before, model=before.model.with_parameters(values)), tmp_path / "model.json")
    after = load(tmp_path / "model.json").parameters["A"].ravel()
    assert after.tobytes() == np.array(numbers).tobytes()


def test_the_file_is_standard_json_with_everything_asked_for(tmp_path):
    save(some_fit(), tmp_path / "model.json")

    def refuse(name):
        raise AssertionError(f"{name} is not standard JSON")

    content = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert (content["format"], content["version"]) == ("pilfr_casadi model", 2)
    assert content["written_by"] == {"pilfr_casadi": "0.1.0", "casadi": ca.__version__}
    assert content["model"]["inputs"] == [{"name": "a", "unit": "V"}]
    assert content["structure"]["element"] == {
        "kind": "prandtl_ishlinskii",
        "operator": "play",
        "n": 4,
        "channels": 1,
        "rounded": False,
    }
    assert content["training"]["nrmse"] == [0.01, None]
    assert content["training"]["sentence"] == Status.MAX_ITERATIONS.value
    assert set(content["parameters"]["w"]) == {"value", "std", "unit"}


class Interruption(Exception):
    """Errors that may interrupt a write."""


@pytest.mark.parametrize("name", ["replace", "fsync", "fdopen"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), Interruption()])
def test_a_write_that_fails_leaves_the_old_file(name, error, tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    save(some_fit(), path)
    old = path.read_bytes()

    def fail(*arguments):
        if name == "fdopen":
            os.write(arguments[0], b'{"format": "pilfr')  # half of it is on disk already
            os.close(arguments[0])
        raise error

    monkeypatch.setattr(os, name, fail)
    with pytest.raises(InputError if isinstance(error, OSError) else type(error)) as raised:
        save(some_fit(seed=3), path)
    monkeypatch.undo()
    if isinstance(error, OSError):
        assert "No space left" in one_sentence(raised)
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == ["model.json"]
    assert load(path).nrmse


def test_where_a_file_cannot_be_written(tmp_path):
    for path, words in {tmp_path: "is a folder", tmp_path / "no" / "model.json": "does not exist"}.items():
        with pytest.raises(InputError, match=words) as error:
            save(some_fit(), path)
        one_sentence(error)


def test_written_files_follow_links_and_the_users_mask(tmp_path):
    mask = os.umask(0o027)
    try:
        write_atomically(tmp_path / "real.txt", "one")
    finally:
        os.umask(mask)
    assert (tmp_path / "real.txt").stat().st_mode & 0o777 == 0o640
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    write_atomically(tmp_path / "link.txt", b"two")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "two"


DAMAGE = {
    "format": (("format",), "other", "not a model file"),
    "version": (("version",), 3, "version 3 .* reads versions 1 and 2"),
    "no version": (("version",), ..., "version null"),
    "operator": (
        ("structure", "element", "operator"),
        "preisach",
        "unknown operator 'preisach'; known are play, stop, generalized_play",
    ),
    "element": (("structure", "element", "kind"), "bouc_wen", "element 'bouc_wen'"),
    "negative weight": (("parameters", "w", "value", 0, 0), -0.1, "parameter 'w' lies outside its bounds"),
    "infinite": (("parameters", "A", "value", 0, 0), "inf", "'A' holds \"inf\", which is not a finite number"),
    "null": (("parameters", "A", "value", 0, 0), None, "'A' holds null"),
    "true": (("parameters", "A", "value", 0, 0), True, "'A' holds true"),
    "text": (("parameters", "r", "value", 0, 1), "0.1", "'r' holds"),
    "integer beyond every float": (("parameters", "A", "value", 0, 0), 10**400, "not a finite number"),
    "missing parameter": (("parameters", "B_w"), ..., "'B_w' is missing"),
    "missing value": (("parameters", "B_w", "value"), ..., "'B_w' holds null"),
    "unknown parameter": (("parameters", "k"), {"value": 1.0}, "parameter 'k', which its model lacks"),
    "shape": (
        ("parameters", "A", "value"),
        [[1.0, 2.0], [3.0, 4.0]],
        r"'A' has 4 numbers in the shape \(2, 2\), expected \(3, 3\)",
    ),
    "ragged": (("parameters", "A", "value"), [[1.0, 2.0, 3.0], [4.0, 5.0], [6.0, 7.0, 8.0, 9.0]], "'A' has 9 numbers"),
    "states": (("structure", "nx"), 10**9, "expected"),
    "operators": (("structure", "element", "n"), 10**12, "expected"),
    "channels": (("structure", "element", "channels"), 0, "expected"),
    "negative": (("structure", "nx"), -1, "'nx' is negative"),
    "step": (("model", "dt"), 0.0, "the step dt is 0 s"),
    "names": (("model", "outputs"), [], "names of inputs and outputs"),
    "status": (("training", "status"), "FINE", "status 'FINE' is unknown"),
    "no training": (("training",), ..., "'training' is missing"),
    "fixed": (("structure", "fixed", "D_yu"), 0.5, "'D_yu' differs from the value that the structure fixes"),
    "bounds": (("structure", "bounds", "w"), [1.0, 0.0], "infeasible"),
    "unknown bound": (("structure", "bounds", "q"), [1.0, 0.0], "no parameter 'q'"),
    "own equations": (("structure",), None, "give the model as `model=`"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_file_is_one_sentence(case, tmp_path):
    path, value, words = DAMAGE[case]
    save(some_fit(), tmp_path / "model.json")
    content = changed(json.loads((tmp_path / "model.json").read_text()), path, value)
    (tmp_path / "model.json").write_text(json.dumps(signed(content)))
    with pytest.raises(InputError, match=words) as error:
        load(tmp_path / "model.json")
    assert str(tmp_path / "model.json") in one_sentence(error)


def test_a_byte_order_mark_before_a_model_is_no_damage(tmp_path):
    save(some_fit(), tmp_path / "model.json")
    (tmp_path / "marked.json").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "model.json").read_bytes())
    plain, marked = (load(tmp_path / name).parameters for name in ("model.json", "marked.json"))
    assert all(np.array_equal(plain[name], marked[name]) for name in plain)


def test_what_is_not_a_model_file_is_one_sentence(tmp_path):
    save(some_fit(), tmp_path / "good.json")
    good = (tmp_path / "good.json").read_bytes()
    files = {
        "empty": (b"", "is empty"),
        "blank": (b" \n ", "is empty"),
        "half": (good[: len(good) // 2], "is incomplete"),
        "binary": (bytes(range(256)), "not text"),
        "rig.py": (b"simulator = None", "is a simulator in Python; read it by"),
        "plant.fmu": (b"PK", "is a functional mock-up unit, not a saved model; read it by .*from_fmu"),
        "arm.xml": (b"<mujoco/>", "is a mechanism for MuJoCo, not a saved model; read it by .*from_mujoco"),
        "csv": (b"t,u,y\n0,1,2\n", "not valid JSON"),
        "list": (b"[1, 2]", "not a model file"),
        "deep": (b"[" * 100_000, "not a model file"),
        "nan": (good.replace(b'"dt": ', b'"dt": NaN, "old": ', 1), "holds NaN"),
        "overflow": (good.replace(b'"dt": ', b'"dt": 1e999, "old": ', 1), "not a finite number"),
    }
    for name, (content, words) in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=words) as error:
            load(tmp_path / name)
        one_sentence(error)
    for path, words in {
        tmp_path / "missing": "there is no file .*/missing; check the name and the folder",
        tmp_path: "is a directory; give the file inside it",
        "a\0b": "or a Path",
    }.items():
        with pytest.raises(InputError, match=words) as error:
            load(path)
        one_sentence(error)


def test_an_enormous_or_forbidden_file_is_not_read(tmp_path):
    with open(tmp_path / "huge.json", "wb") as file:
        file.truncate(10**12)  # takes no space on disk
    with pytest.raises(InputError, match="1000000 MB") as error:
        load(tmp_path / "huge.json")
    one_sentence(error)
    if hasattr(os, "geteuid") and os.geteuid() != 0:
        (tmp_path / "secret.json").touch(mode=0)
        with pytest.raises(InputError, match="cannot be read") as error:
            load(tmp_path / "secret.json")
        one_sentence(error)


def test_a_file_cut_off_anywhere_is_one_sentence(tmp_path):
    save(some_fit("no states"), tmp_path / "model.json")
    text = (tmp_path / "model.json").read_text()
    for length in range(0, len(text.rstrip()), 61):
        (tmp_path / "cut.json").write_text(text[:length])
        with pytest.raises(InputError, match=r"incomplete|empty|not valid") as error:
            load(tmp_path / "cut.json")
        one_sentence(error)


JUNK = (None, True, -1, 0, 3, 1e308, 10**400, "", "x", "inf", [], {}, [[1.0]], [None], {"value": 1}, ...)


@given(st.data())
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_tampered_file_loads_or_is_one_sentence(tmp_path, data):
    case = data.draw(st.sampled_from(["generalized play", "stops, two channels", "linear"]))
    if not (tmp_path / case).exists():
        save(some_fit(case), tmp_path / case)
    content = json.loads((tmp_path / case).read_text())
    for _ in range(data.draw(st.integers(1, 2))):
        paths = [p for p in leaves(content) if p]
        content = changed(content, data.draw(st.sampled_from(paths)), data.draw(st.sampled_from(JUNK)))
    (tmp_path / "tampered.json").write_text(json.dumps(signed(content)))
    try:
        fitted = load(tmp_path / "tampered.json")
    except InputError as error:
        assert "\n" not in str(error) and str(error).endswith(".")
    else:
        assert all(np.all(np.isfinite(v)) for v in fitted.parameters.values())
        assert fitted.simulate(recording_for(replace(fitted, engine="vm"), 5)).shape == (5, fitted.model.n_y)


def test_a_model_of_own_equations_is_saved_by_its_values(tmp_path):
    model = own_model()
    fitted = model.with_parameters(
        model.parameters.change(k={"value": 1 / 3}, r={"value": np.array([[0.1, 0.2, 0.7]])})
    )
    before = replace(some_fit(), model=fitted, structure=None, initial={}, errors={"k": np.array(0.1)}, linear=None)
    before.save(tmp_path / "own.json")
    assert json.loads((tmp_path / "own.json").read_text())["parameters"]["k"] == {
        "value": 1 / 3,
        "std": 0.1,
        "unit": "N/m",
    }
    with pytest.raises(InputError, match="own equations, not the equations; give the model as `model=`") as error:
        load(tmp_path / "own.json")
    one_sentence(error)
    after = replace(load(tmp_path / "own.json", model=own_model()), engine="vm")
    data = recording_for(after)
    assert after.structure is None and after.parameters["k"] == 1 / 3
    assert np.array_equal(after.simulate(data), replace(before, engine="vm").simulate(data))
    for wrong in (own_model(4), CASES["linear"][0].model(2, 1), CASES["linear"][0].model(1, 1)):
        with pytest.raises(InputError, match="does not fit the model given") as error:
            load(tmp_path / "own.json", model=wrong)
        one_sentence(error)


def test_envelopes_of_ones_own_need_the_structure(tmp_path):
    operator = GeneralizedPlay(gamma_l=lambda z, p: z + z**3 / 9, gamma_r=lambda z, p: z)
    structure = PILFR(1, PrandtlIshlinskii(operator, 2))
    model = structure.model(1, 1, {"A": 0.5, "B_u": 1.0, "C_z": 1.0, "D_yw": 1.0, "r": [[0.1, 0.3]]})
    before = replace(some_fit(), model=model, structure=structure, initial={}, errors={})
    before.save(tmp_path / "model.json")
    with pytest.raises(InputError, match="expressions of your own, which a file cannot hold") as error:
        load(tmp_path / "model.json")
    one_sentence(error)
    after = replace(load(tmp_path / "model.json", model=structure), engine="vm")
    data = recording_for(after)
    assert after.structure is structure
    assert np.array_equal(after.simulate(data), before.simulate(data))
    assert np.ptp(after.simulate(data)) > 0


CHANGED = "was changed after it was written .*; restore it, or save the model again"
DIGEST_CASES = ("play", "generalized play", "linear")


@pytest.fixture(scope="module", params=DIGEST_CASES)
def written(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "model.json"
    save(some_fit(request.param), path)
    return path


def loads_the_same_or_refuses(written, text, name="tampered.json"):
    path = written.with_name(name)
    path.write_bytes(text)
    try:
        fitted = load(path)
    except InputError as error:
        assert "\n" not in str(error) and str(error).endswith("."), error
        return False
    save(fitted, path)
    assert path.read_bytes() == written.read_bytes()
    return True


@given(st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_character_changed_is_refused_or_changes_nothing(written, data):
    text = bytearray(written.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text) - 1))
        kind = data.draw(st.sampled_from(["other", "digit", "out", "in"]))
        if kind == "out":
            del text[at]
        elif kind == "in":
            text.insert(at, data.draw(st.integers(0, 255)))
        else:
            text[at] = data.draw(st.integers(0, 255) if kind == "other" else st.sampled_from(b"0123456789"))
    loads_the_same_or_refuses(written, bytes(text))


def test_every_digit_of_the_numbers_counts(written):
    text, noticed = written.read_bytes(), 0
    begin, end = text.index(b'"parameters"'), text.index(b'"initial_states"')
    digits = [k for k in range(begin, end) if text[k : k + 1].isdigit()]
    for at in digits[:: len(digits) // 40]:
        altered = text[:at] + b"%d" % ((text[at] - 47) % 10) + text[at + 1 :]
        refused = not loads_the_same_or_refuses(written, altered)
        noticed += refused
        assert refused == (json.loads(altered) != json.loads(text))  # a 17th digit may name the same number
    assert noticed > 35


@given(st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_key_out_and_any_value_changed_is_refused(written, data):
    content = json.loads(written.read_text())
    path = data.draw(st.sampled_from([p for p in leaves(content) if p]))
    value = data.draw(st.sampled_from([..., None, True, 0, 1, 2.5, "", "x", [], {}]))
    altered = changed(content, path, value)
    same = json.dumps(altered) == json.dumps(content)
    assert loads_the_same_or_refuses(written, json.dumps(altered).encode()) == same


def test_a_changed_number_is_said_to_be_one(written):
    content = json.loads(written.read_text())
    for altered in (
        changed(content, ("parameters", "A", "value", 0, 0), 0.123),
        changed(content, ("sha256",), "0" * 64),
        changed(content, ("sha256",), ...),
        changed(changed(content, ("version",), 1), ("parameters", "A", "value", 0, 0), 0.123),
    ):
        written.with_name("other.json").write_text(json.dumps(altered))
        with pytest.raises(InputError, match=CHANGED) as error:
            load(written.with_name("other.json"))
        assert str(written.with_name("other.json")) in one_sentence(error)


def test_the_layout_of_the_text_does_not_count(written):
    content = json.loads(written.read_text())
    for text in (json.dumps(content), json.dumps(content, indent=4), json.dumps(content, separators=(",", ":"))):
        assert loads_the_same_or_refuses(written, text.encode())


def test_the_order_of_the_variables_counts(written):
    content = json.loads(written.read_text())
    table = content["training"]["variables"]
    altered = changed(content, ("training", "variables"), dict(reversed(table.items())))
    assert not loads_the_same_or_refuses(written, json.dumps(altered).encode())


def test_files_from_before_the_digest_are_read(written):
    content = changed(changed(json.loads(written.read_text()), ("sha256",), ...), ("version",), 1)
    says = r"carries no digest \(it has version 1 .*changes made to it .* cannot be noticed; save the model again"
    with pytest.warns(UserWarning, match=says):
        assert loads_the_same_or_refuses(written, json.dumps(content).encode())
    older = changed(changed(content, ("training", "limits"), ...), ("training", "linear_nrmse"), ...)
    with pytest.warns(UserWarning, match=says):
        assert loads_the_same_or_refuses(written, json.dumps(older).encode())


@pytest.mark.filterwarnings("default")
def test_a_command_warns_of_a_file_without_a_digest_in_one_line(written, capsys):
    content = changed(changed(json.loads(written.read_text()), ("sha256",), ...), ("version",), 1)
    path = written.with_name("older.json")
    path.write_text(json.dumps(content))
    assert main(["export", str(path), "--out", str(path.with_name("older.casadi"))]) == 0
    said = capsys.readouterr().err
    assert said.startswith("pilfr: warning: The file ") and "carries no digest" in said and said.count("\n") == 1


@pytest.mark.parametrize("version", [True, 1.0, 2.0, "2", None, [2], {}, 3, 0, -1, 10**400])
def test_versions_that_are_none(written, version):
    content = signed(changed(json.loads(written.read_text()), ("version",), version))
    written.with_name("other.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"has version .* reads versions 1 and 2") as error:
        load(written.with_name("other.json"))
    one_sentence(error)


UNKNOWN = {
    (): "unknown key 'more';",
    ("model",): "unknown key 'more' in model",
    ("structure",): "unknown key 'more' in structure",
    ("structure", "element"): "unknown key 'more' in structure.element",
    ("parameters", "A"): "unknown key 'more' in parameters.A",
    ("training",): "unknown key 'more' in training",
    ("training", "solve"): "unknown key 'more' in training.solve",
    ("training", "history"): "unknown key 'more' in training.history",
    ("model", "inputs", 0): "unknown key 'more' in model.inputs.0",
}
WRONG = {
    ("written_by", "casadi"): (3, "written_by.casadi is not a text but 3"),
    ("written_by", "pilfr_casadi"): (None, "written_by.pilfr_casadi is not a text"),
    ("model", "states", 0): (1.5, "model.states.0 is not a text but 1.5"),
    ("parameters", "A", "unit"): ({}, "parameters.A.unit is not a text but a table"),
    ("training", "sentence"): (0, "training.sentence is not a text"),
    ("model", "memory"): ([3], "model.memory is not a whole number but a list"),
    ("structure", "bounds", "w"): ([0.0], "structure.bounds.w is not a pair but a list"),
    ("training", "seconds"): (None, "training.seconds is not a finite number but null"),
    ("structure", "element", "rounded"): (0, "structure.element.rounded is not true or false but 0"),
    ("training", "multipliers"): ([0.0], r"it has 1 multipliers of \d+ variables and constraints"),
    ("training", "variables"): ({}, "multipliers of 0 variables"),
}


@pytest.mark.parametrize("path", UNKNOWN)
def test_unknown_keys_are_refused(path, tmp_path):
    refused(tmp_path, (*path, "more"), 1, UNKNOWN[path])


@pytest.mark.parametrize("path", WRONG)
def test_entries_of_the_wrong_kind_or_length_are_refused(path, tmp_path):
    refused(tmp_path, path, *WRONG[path])


def refused(tmp_path, path, value, words):
    """Change the content and its digest."""
    save(some_fit(), tmp_path / "model.json")
    content = signed(changed(json.loads((tmp_path / "model.json").read_text()), path, value))
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=words) as error:
        load(tmp_path / "model.json")
    one_sentence(error)


def test_a_key_given_twice_is_refused(tmp_path):
    save(some_fit(), tmp_path / "model.json")
    text = (tmp_path / "model.json").read_text()
    (tmp_path / "model.json").write_text(text.replace('"version": 2', '"version": 2, "version": 2'))
    with pytest.raises(InputError, match="the key 'version' twice") as error:
        load(tmp_path / "model.json")
    one_sentence(error)


def test_multipliers_of_constraints_come_back_and_those_of_another_problem_are_left_out(tmp_path):
    n = len(some_fit().solution.theta)
    one = Limit("spectral radius", "constraint", 0.9, -np.inf, 0.9, 0.1, active=True)
    for more, kept in ((1, n + 1), (0, 0), (2, 0)):
        fitted = some_fit(limits=(one,), multipliers=np.arange(n + more))
        save(fitted, tmp_path / "model.json")
        after = load(tmp_path / "model.json")
        assert len(after.solution.multipliers) == kept and after.limits == (one,)
