"""What was changed in a model file after it was written is noticed: the same model comes back, or one sentence."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from test_export import changed, leaves, one_sentence, signed, some_fit

from pilfr_casadi._base import InputError
from pilfr_casadi.cli.app import main
from pilfr_casadi.identify import load, save
from pilfr_casadi.optimise import Limit

CHANGED = "was changed after it was written .*; restore it, or save the model again"
CASES = ("play", "generalized play", "linear")


@pytest.fixture(scope="module", params=CASES)
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
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    ("written_by", "casadi"): (3, "written_by.casadi is not a text"),
    ("written_by", "pilfr_casadi"): (None, "written_by.pilfr_casadi is not a text"),
    ("model", "states", 0): (1.5, "model.states.0 is not a text"),
    ("parameters", "A", "unit"): ({}, "parameters.A.unit is not a text"),
    ("training", "sentence"): (0, "training.sentence is not a text"),
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
    """A change that came with its own digest."""
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
