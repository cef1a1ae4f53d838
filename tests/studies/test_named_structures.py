"""Baselines by their names, in run files, campaigns and on the command line."""

import csv

import pytest
from command_line import fit_arguments, refused, run
from run_files import DATA

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.cli import main
from pilfr_casadi.models import ALL_OPTIONS, STRUCTURE_OPTIONS, STRUCTURES, named_structure
from pilfr_casadi.studies import read_run

TEXT = f"""
report = false
{DATA}
[model]
MODEL

[solver]
starts = 1
max_iterations = 15
"""


def written(folder, model, more=""):
    (folder / "rig.toml").write_text(TEXT.replace("MODEL", model) + more)
    return folder / "rig.toml"


@pytest.mark.parametrize(
    "said, expected",
    [
        ("nx = 2", pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 20))),
        ("nx = 2\noperators = 0", pilfr.PILFR(2)),
        ('structure = "ssnn"\nnx = 2\nhidden = 3\noffset = false', pilfr.ssnn(2, 3, offset=False)),
        ('structure = "network_lfr"\nnx = 2\nchannels = 2', pilfr.network_lfr(2, channels=2)),
        ('structure = "narx"\nlags = 2', pilfr.NARX(2)),
        ('structure = "noe"\nlags = 3\nhidden = 4\ninput_lags = 1', pilfr.NOE(3, 4, 1)),
    ],
)
def test_a_name_stands_for_the_structure(folder, said, expected):
    (cell,) = read_run(written(folder, said)).cells
    assert type(cell.model) is type(expected) and repr(cell.model) == repr(expected)


def test_fix_and_bounds_add_to_those_of_a_network():
    one = named_structure("ssnn", nx=2, hidden=3, fix={"D_yu": 0.0}, bounds={"A": (-1, 1)})
    assert set(one.fixed) == {*pilfr.ssnn(2, 3).fixed, "D_yu"} and one.bounds == {"A": (-1, 1)}
    assert {"lags", "nx"} < ALL_OPTIONS == {k for takes in STRUCTURE_OPTIONS.values() for k in takes}


def test_a_run_fits_the_same_model_as_the_function(folder):
    said = 'structure = "noe"\nlags = 2\nhidden = 3'
    found = pilfr.run(written(folder, said)).fit
    train = pilfr.read(folder / "train.csv", "u", "y", initial="zero")
    options = {"starts": 1, "solver": pilfr.GaussNewton(max_iterations=15, tolerance=1e-4)}
    assert found.train_nrmse == pilfr.fit(pilfr.NOE(2, 3), train, **options).train_nrmse


@pytest.mark.slow
def test_a_campaign_compares_structures_with_their_own_options(folder):
    grid = f"[grid]\nstructure = {list(STRUCTURES)}\n"
    model = "nx = 1\noperators = 2\noperator = 'stop'\nhidden = 2\nlags = 2"
    result = pilfr.campaign(written(folder, model, grid).rename(folder / "all.toml"))
    assert not result.failed and result.done == tuple(f"structure-{s}_seed-0" for s in STRUCTURES)
    rows = list(csv.DictReader((result.folder / "results.csv").read_text().splitlines()))
    errors = {r["structure"]: float(r["nrmse"]) for r in rows if r["role"] == "test"}
    assert errors["lfr"] == min(errors.values()) and len(errors) == len(STRUCTURES)
    models = {cell.values["structure"]: cell.model for cell in read_run(folder / "all.toml").cells}
    assert models["narx"] == pilfr.NARX(2, 2) and models["lfr"].element.operator == pilfr.Stop()
    seeds = "seeds = [0, 1]\n" + written(folder, 'structure = "ssnn"\nnx = 1\nhidden = 2').read_text()
    (folder / "two.toml").write_text(seeds)
    assert len({s.nrmse for s in pilfr.campaign(folder / "two.toml").scores if s.role == "train"}) == 2


def test_combinations_that_mean_the_same_model_are_one_cell(folder):
    grid = """[grid]
structure = ["lfr", "hammerstein", "ssnn", "narx"]
nx = [1, 2]
operator = ["play", "generalized_play"]
operators = [0, 3]
neurons = [2, 4]
hidden = [2]
lags = [1, 2]
start = ["plain", "grid"]
"""
    cells = read_run(written(folder, "offset = false", grid)).cells
    assert len({(repr(cell.model), str(cell.search)) for cell in cells}) == len(cells)
    counts = {s: sum(cell.values["structure"] == s for cell in cells) for s in ("lfr", "hammerstein", "ssnn", "narx")}
    # with 3 operators: plays, or generalized plays of 2 or 4 neurons, from 2 starts; linear models are in the first
    assert counts == {"lfr": 2 * (1 + 3 * 2), "hammerstein": 2 * 3 * 2, "ssnn": 2 * 2, "narx": 2}
    assert {"structure": "lfr", "nx": 2, "operators": 0} in [cell.values for cell in cells]
    assert {"structure": "narx", "hidden": 2, "lags": 2} in [cell.values for cell in cells]


def test_a_campaign_does_each_model_once_and_leaves_columns_empty(folder, capsys):
    grid = '[grid]\nstructure = ["narx", "lfr", "wiener"]\noperators = [0, 2]\n'
    grid += 'operator = ["play", "stop"]\nlags = [1, 2]\n'
    path = written(folder, "nx = 1\nhidden = 2", grid)
    assert main(["campaign", str(path)]) == 0
    said = capsys.readouterr().out
    assert "7 cells x 1 seeds" in said and "7 jobs done now" in said
    rows = list(csv.DictReader((folder / "rig-campaign" / "results.csv").read_text().splitlines()))
    assert [k for k in rows[0] if k in ("structure", "operator", "operators", "lags")] == list(list(rows[0])[3:7])
    linear = {tuple(r[k] for k in ("structure", "operator", "lags")) for r in rows if r["operators"] == "0"}
    assert linear == {("lfr", "", "")}
    assert {(r["lags"], r["operators"]) for r in rows if r["structure"] == "narx"} == {("1", ""), ("2", "")}
    summary = list(csv.DictReader((folder / "rig-campaign" / "summary.csv").read_text().splitlines()))
    assert len(summary) == 2 * 7 and {r["jobs"] for r in summary} == {"1"}
    assert pilfr.campaign(path).done == ()


@pytest.mark.parametrize(
    "model, says",
    [
        ('structure = "narx"\nnx = 2', "'lags' in [model] is missing; give the number of past outputs"),
        ('structure = "ssnn"\nhidden = 2', "'nx' in [model] is missing; give the number of states"),
        ('structure = "noe"\nlags = 0', "'lags' in [model] is 0; give a whole number from 1"),
        ('structure = "noe"\nlags = 2\nnx = 1', "'nx' in [model] is not for structure = 'noe', which takes lags"),
        ('structure = "ssnn"\nnx = 2\noperators = 3', "'operators' in [model] is not for structure = 'ssnn'"),
        ("nx = 2\nhidden = 3", "'hidden' in [model] is not for structure = 'lfr'"),
        ('structure = "rnn"\nnx = 2', "'structure' in [model] is 'rnn'; give 'lfr'"),
        ('structure = "narx"\nlags = 2\n[constraints]\nspectral_radius = 0.9', "'spectral_radius' in [constraints]"),
        (
            'structure = "narx"\nlags = 2\n[constraints]\ndc_gain = 2.0',
            "[constraints]: dc_gain applies to linear models",
        ),
        (
            '[grid]\nstructure = ["lfr", "ssnn"]\nnx = [1]\n[constraints]\ndc_gain = 2.0',
            "[constraints]: dc_gain applies to",
        ),
        ('[grid]\nstructure = ["narx"]\nlags = [1]\nstart = ["paper"]', "start = 'paper' is not for a NARX or NOE"),
        ('structure = "narx"\nlags = 2\n[constraints]\nordered_thresholds = true', "'r'"),
        ('structure = "narx"\nlags = 2\n[regularization]\nl1 = 1e-3', "leave l1 out"),
        ('structure = "ssnn"\nnx = 1\nhidden = 2\n[regularization]\nl1 = 1e-3', "'w'"),
        ('structure = "noe"\nlags = 2\n[grid]\nlags = [1, "two"]', "'lags' in [model] is 'two'"),
        ('[grid]\nstructure = ["narx", "noe"]\nlags = [1, 2]\nnx = [1]', "'nx' in [model] is not for structure"),
        ('[grid]\noperator = ["play", "stop"]\nnx = [1]\nneurons = [2]', "'neurons' in [model] goes with operator"),
    ],
)
def test_bad_options_get_one_sentence(folder, model, says):
    with pytest.raises(InputError) as found:
        pilfr.run(written(folder, model))
    assert says in str(found.value) and "\n" not in str(found.value)


def test_the_command_line_fits_them_too(capsys, folder):
    data = ("fit", folder / "train.csv", "--inputs", "u", "--outputs", "y", "--initial", "zero", "--starts", 1)
    tested = ("--test", folder / "test.csv", "--out", folder / "out", "--overwrite", "--hidden", 2)
    for options in (("noe", "--lags", 2), ("network_lfr", "--nx", 1, "--fix", "D_yu=0")):
        status, out, err = run(capsys, *data, *tested, "--structure", *options)
        assert status == 0, err
        assert "NRMSE on test" in out and (folder / "out" / "report.html").exists()
    assert pilfr.load(folder / "out" / "model.json").structure == named_structure(
        "network_lfr", nx=1, hidden=2, fix={"D_yu": 0.0}
    )


def test_unfit_options_of_the_command_get_one_sentence(capsys, folder):
    arguments = fit_arguments(folder / "train.csv", folder)
    refused(capsys, *arguments, "--structure", "ssnn", says="--operators is not for --structure ssnn; leave it out.")
    few = [a for a in arguments if a not in ("--operators", 3)]
    refused(capsys, *few, "--lags", 2, says="--lags is not for --structure lfr")
    refused(capsys, *few, "--structure", "narx", "--lags", 2, says="--nx is not for --structure narx")
    bare = [a for a in few if a not in ("--nx", 1)]
    refused(capsys, *bare, "--structure", "narx", says="--structure narx needs --lags")
    refused(capsys, *bare, "--structure", "noe", "--lags", 0, says="--lags 0 was given; give a whole number from 1")
    refused(capsys, *bare, "--structure", "noe", "--lags", 2, "--bound", "w=0:1", says="--bound is not for")


def test_too_many_lags_and_a_start_of_another_kind_are_refused(capsys, folder):
    data = ("fit", folder / "train.csv", "--inputs", "u", "--outputs", "y", "--out", folder / "out")
    refused(capsys, *data, "--structure", "narx", "--lags", 2000, says="give at most 20000 parameters")
    path = written(folder, 'structure = "noe"\nlags = 2')
    path.write_text(path.read_text().replace("[solver]", '[solver]\nstart = "plain"'))
    refused(capsys, "run", path, says="start = 'plain' is not for a NARX or NOE")
    path.write_text(path.read_text().replace('structure = "noe"\nlags = 2', "lags = 2\nnx = 1\noperators = 1"))
    path.write_text(path.read_text() + "[grid]\nstructure = ['noe', 'lfr']\n")  # left out where it is for the others
    assert [cell.search["start"] for cell in read_run(path).cells] == ["grid", "plain"]
