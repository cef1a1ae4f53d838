"""What is wrong with a campaign's file, folder, cluster or workers is said in one sentence."""

import contextlib
import os
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest
from command_line import refused, sentence
from run_files import ALONE, changed

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.cli import main
from pilfr_casadi.models import named_structure
from pilfr_casadi.studies import Cell, Manifest, executor, reasons, seeds_advice


@pytest.mark.parametrize(
    "old, new, says",
    [
        ("[grid]", "[grid]\nnodes = [1, 2]", ("unknown key 'nodes'", "operators")),
        ("[1, 3]", "3", "'operators' in [grid] is 3; give a list of different values"),
        ("[1, 3]", "[3, 3]", "different values"),
        ("count = 4", "count = 1e9", "'count' in [seeds] is 1000000000.0; give a whole number from 1 to 100000"),
        ("count = 4", "count = 1000000000", "'count' in [seeds] is 1000000000; give a whole number from 1 to 100000"),
        ("count = 4", "count = 60000", "grid, seeds and folds make 120000 jobs; give at most 100000"),
        ("count = 4", f"count = {'9' * 5000}", "is not a TOML file"),
        ("[1, 3]", "[3, 999999999]", "'operators' in [model] is 999999999; give a whole number from 0 to 10000"),
        ("[1, 3]", "[3, 'many']", "'operators' in [model] is 'many'"),
        ("[1, 3]", "[]", "list of different values"),
        ('structure = "hammerstein"', 'structure = "lti"', "for a linear model give 'lfr' with operators = 0"),
        ("count = 4", "number = 4", "unknown key 'number'"),
        ("count = 4", "count = 0", "'count' in [seeds] is 0"),
        ("[grid]", "[campaign]\nlimit = 3\n[grid]", "unknown key 'limit'"),
        ("[grid]", "[campaign]\ntime_limit = -3\n[grid]", "'time_limit' in [campaign] is -3"),
        ("report = false", "folds = 1", "'folds' is 1"),
        ("report = false", "folds = 90", "too few for 90 folds"),
        ('"plain"', '"grid"', "4 seeds were given, but no start is random, so every seed gives the same model"),
        ("nx = 1", "nx = 1\nfix = { A = 0.5 }\nbounds = { A = [0.6, 0.7] }", ("no job gave a model", "outside")),
    ],
)
def test_bad_input_gets_one_sentence(capsys, folder, old, new, says):
    refused(capsys, "campaign", changed(folder, (old, new), ALONE), says=says)


def test_bad_workers_get_one_sentence(folder):
    for call in (pilfr.campaign, pilfr.run):
        with pytest.raises(InputError, match="executor = 5 was given"):
            call(folder / "rig.toml", executor=5)
    with pytest.raises(InputError, match="workers is True; give a whole number"):
        pilfr.campaign(folder / "rig.toml", workers=True)


def test_bad_folders_and_places_get_one_sentence(capsys, folder, monkeypatch):
    path = folder / "rig.toml"
    monkeypatch.setattr(executor, "SCHEDULER_TIMEOUT", 2.0)
    refused(capsys, "campaign", path, "--out", folder / "train.csv", says="train.csv")
    refused(capsys, "campaign", path, "--out", "/proc/nowhere", says="cannot be written")
    refused(capsys, "campaign", path, "--dask", "tcp://127.0.0.1:1", says=("No Dask scheduler", "127.0.0.1:1"))
    refused(capsys, "campaign", path, "--dask", "nonsense://", says="No Dask scheduler")
    refused(capsys, "campaign", path, "--dask", "tcp://127.0.0.1:1", "--workers", "2", says="leave one of them out")
    refused(capsys, "campaign", path, "--time-limit", "0", says="--time-limit 0")
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(capsys, "campaign", path, "--dask", "tcp://127.0.0.1:1", says="pilfr-casadi[dask]")


def test_results_of_another_version_get_one_sentence(capsys, folder):
    out = pilfr.campaign(changed(folder, ALONE, ("count = 4", "count = 1"))).folder
    manifest = Manifest.read(out)
    manifest.content["versions"]["pilfr_casadi"] = "0.0.1"
    manifest.write()
    refused(capsys, "campaign", folder / "rig.toml", says=("results of pilfr_casadi 0.0.1", "--overwrite"))
    (out / "manifest.json").write_text('{"format": "pilfr_casadi run", "version": 7}')
    refused(capsys, "campaign", folder / "rig.toml", says=("manifest", "--overwrite"))
    assert main(["campaign", str(changed(folder, ALONE, ("count = 4", "count = 1"))), "--overwrite"]) == 0


def test_unfit_workers_get_one_sentence(folder, monkeypatch):
    with ProcessPoolExecutor(1) as pool, contextlib.suppress(Exception):
        pool.submit(os._exit, 1).result()
    with pytest.raises(InputError, match="The executor has stopped"):
        pilfr.campaign(folder / "rig.toml", executor=pool)
    real = executor.versions
    monkeypatch.setattr(executor, "versions", lambda: {**real(), "casadi": "9.9"})
    with pytest.raises(InputError, match=r"A worker has casadi 3.* and this process 9\.9"):
        pilfr.campaign(folder / "rig.toml")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(InputError, match="The workers cannot start a job"):
        pilfr.campaign(folder / "rig.toml")


def test_each_reason_for_missing_models_is_printed_once(capsys, folder):
    two = ("count = 4", "count = 2")
    gain = "[constraints]\ndc_gain = { value = 1e9, within = 1.0 }\n[grid]"
    bounds = "nx = 1\nbounds = { A = [-0.5, 0.5], w = [0, 1], B_w = [0, 1], C_y = [0, 1], D_yw = [0, 1] }"
    path = changed(folder, ALONE, two, ("[grid]\noperators = [1, 3]", gain + "\noperators = [2]"), ("nx = 1", bounds))
    for kind in ("run", "campaign"):
        assert main([kind, str(path)]) == 1
        out, err = capsys.readouterr()
        assert "off by" not in out and out.count("no model (infeasible)") == 2
        assert "no job meets its constraints" in sentence(err) and "off by" in err


def test_reasons_are_grouped():
    entries = {"a": {"sentence": "X."}, "b": {"sentence": "Y."}, "c": {"sentence": "X."}}
    assert reasons(entries, ("a", "b", "c")) == ["a and 1 more: X.", "b: Y."]


@pytest.mark.parametrize(
    "structure, starts, says",
    [
        ("lfr", 4, ""),
        ("lfr", 2, "every seed gives the same model; use one seed, start = 'paper' in [solver], or 3 starts or more"),
        (
            "hammerstein",
            1,
            "every seed gives the same model; use one seed, start = 'paper' in [solver], or 2 starts or more",
        ),
        ("hammerstein", 2, ""),
        ("ssnn", 1, ""),
    ],
)
def test_seeds_advice_is_given_only_if_it_applies(structure, starts, says):
    own = {"hidden": 2} if structure == "ssnn" else {"operators": 3}
    cell = Cell({}, named_structure(structure, nx=1, **own), {"start": "grid", "starts": starts})
    assert seeds_advice(cell).endswith(says) and bool(seeds_advice(cell)) == bool(says)
    assert seeds_advice(Cell({}, cell.model, {"start": "plain", "starts": starts})) == ""
