"""Run files: the same numbers again, nothing done twice, interrupted runs go on, changes are noticed."""

import contextlib
import json
import os
import re
import shutil
import signal
import time

import numpy as np
import pytest
import run_files
from command_line import refused, sentence, write_csv
from run_files import PYTHON, RUN, command, contents

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.cli import EVERY_KEY, main
from pilfr_casadi.optimise import Status
from pilfr_casadi.studies import ModelTable, RunTable, SolverTable, input_digests, jobs_of, read_run


@pytest.fixture
def folder(tmp_path):
    return run_files.prepared(tmp_path, RUN, ("train", "held", "test"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder whose run is complete, in rig-run; not to be changed."""
    folder = run_files.prepared(tmp_path_factory.mktemp("finished"), RUN, ("train", "held", "test"))
    assert pilfr.run(folder / "rig.toml").done == ("seed-0", "seed-1", "seed-2")
    return folder


@pytest.fixture
def done(finished, tmp_path):
    """A copy of it that a test may change."""
    return shutil.copytree(finished, tmp_path / "done")


def changed(folder, old, new):
    """The run file with one passage replaced."""
    return run_files.changed(folder, (old, new), text=RUN)


def test_no_more_workers_than_starts_are_begun(folder, monkeypatch):
    begun = []
    pool = "pilfr_casadi.cli.studies.worker_pool"
    monkeypatch.setattr(pool, lambda count: begun.append(count) or contextlib.nullcontext())
    more = ("seeds = [0, 1, 2]", "seeds = [0]\nworkers = 900"), ("starts = 1", "starts = 2")
    assert main(["run", str(run_files.changed(folder, *more, text=RUN))]) == 0
    assert begun == [2]


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_run_gives_the_same_bytes_twice_and_skips_what_is_done(folder, drawn, request):
    if not drawn:
        request.getfixturevalue("blank_figures")
    first = pilfr.run(changed(folder, "seeds = [0, 1, 2]\nreport = false", "seeds = [0, 1]\nreport = true"))
    assert first.done == ("seed-0", "seed-1") and first.skipped == ()
    before = contents(first.folder)
    report = (first.folder / "report.html").stat().st_mtime_ns
    again = pilfr.run(folder / "rig.toml")
    assert again.done == () and again.skipped == first.done and contents(again.folder) == before
    assert (first.folder / "report.html").stat().st_mtime_ns == report
    other = pilfr.run(folder / "rig.toml", out=folder / "other")
    assert contents(other.folder) == before and "report.html" in before  # all of it, the manifest and the page too
    times = [json.loads((f / "times.json").read_text()) for f in (first.folder, other.folder)]
    assert times[0] != times[1] and all(t > 0 for t in times[0].values()) and first.fit.seconds > 0
    none = pilfr.run(changed(folder, "seeds = [0, 1, 2]", "seeds = [0, 1]"), out=folder / "none")
    models = {k: v for k, v in before.items() if k not in ("report.html", "manifest.json")}
    assert {k: v for k, v in contents(none.folder).items() if k != "manifest.json"} == models


@pytest.mark.usefixtures("blank_figures")
def test_the_files_of_a_run(done):
    folder = done
    result = pilfr.run(changed(folder, "report = false", "report = true"))
    manifest = json.loads((result.folder / "manifest.json").read_text())
    assert set(manifest["inputs"]) == {"train.csv", "held.csv", "test.csv"}
    assert {"pilfr_casadi", "casadi", "numpy", "scipy", "python"} <= set(manifest["versions"])
    assert [manifest["jobs"][f"seed-{k}"]["seed"] for k in range(3)] == [0, 1, 2]
    assert set(manifest["files"]) >= {"model.json", "results.csv", "report.html", "jobs/seed-2/model.json"}
    rows = (result.folder / "results.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 3 and sum(row.split(",")[2] == "1" for row in rows[1:]) == 3
    loaded = pilfr.load(result.folder / "model.json")
    test = pilfr.read(folder / "test.csv", "u", "y", initial="zero")
    by_test = {s.job: s.nrmse for s in result.scores if s.role == "test"}
    assert loaded.nrmse(test) == by_test[result.chosen]
    held = {s.job: s.nrmse for s in result.scores if s.role == "validation"}
    assert held[result.chosen] == min(held.values())
    assert "<html" in (result.folder / "report.html").read_text().lower()


def test_the_numbers_do_not_depend_on_the_executor_or_on_other_seeds(folder):
    from concurrent.futures import ThreadPoolExecutor

    alone = pilfr.run(changed(folder, "[0, 1, 2]", "1"), out=folder / "alone")
    with ThreadPoolExecutor(2) as pool:
        both = pilfr.run(changed(folder, "[0, 1, 2]", "[0, 1]"), out=folder / "both", executor=pool)
    name = "jobs/seed-1/model.json"
    assert (alone.folder / name).read_bytes() == (both.folder / name).read_bytes()


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGINT])
def test_an_interrupted_run_continues_with_the_same_result(folder, finished, kind):
    out = folder / "rig-run"
    process = command(folder, "run")
    deadline = time.monotonic() + 60
    while not (out / "jobs" / "seed-0" / "model.json").exists() and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(kind)
    _, err = process.communicate(timeout=60)
    assert process.returncode == (130 if kind == signal.SIGINT else -signal.SIGKILL), err
    if kind == signal.SIGINT:
        assert "Interrupted" in sentence(err) and "continues from there" in sentence(err)
    assert not (out / "results.csv").exists()
    result = pilfr.run(folder / "rig.toml")
    assert result.done and len(result.done) + len(result.skipped) == 3
    assert contents(out) == contents(finished / "rig-run")


def test_ending_between_a_file_and_its_manifest_is_no_tampering(folder, monkeypatch):
    from pilfr_casadi.studies import folder as module

    changed(folder, "[0, 1, 2]", "[0]")
    out, real, calls = folder / "rig-run", module.Manifest.write, []
    whole = contents(pilfr.run(folder / "rig.toml", out=folder / "whole").folder)

    def dies(manifest):
        calls.append(1)
        if len(calls) == 1 + len(cuts):
            cuts.append(1)
            raise OSError("power cut")
        real(manifest)

    cuts, ended = [], False
    monkeypatch.setattr(module.Manifest, "write", dies)
    while not ended:  # each time a little further
        calls.clear()
        try:
            pilfr.run(folder / "rig.toml")
            ended = True
        except OSError as error:
            assert str(error) == "power cut"
    assert len(cuts) > 3 and contents(out) == whole


def test_a_changed_file_runs_again_just_what_depends_on_it(done):
    folder = done
    first = pilfr.run(folder / "rig.toml")
    models = {p: p.stat().st_mtime_ns for p in first.folder.glob("jobs/*/model.json")}
    write_csv(folder / "test.csv", seed=9, m=400)
    second = pilfr.run(folder / "rig.toml")
    assert second.done == () and {p: p.stat().st_mtime_ns for p in models} == models
    old, new = ({(s.job, s.role): s.nrmse for s in r.scores} for r in (first, second))
    assert all((old[k] == new[k]) == (k[1] != "test") for k in old)
    write_csv(folder / "train.csv", seed=8, m=400)
    assert len(pilfr.run(folder / "rig.toml").done) == 3
    changed(folder, "seeds = [0, 1, 2]", "seeds = [0, 1, 2, 7]")
    assert pilfr.run(folder / "rig.toml").done == ("seed-7",)
    changed(folder, "starts = 1", "starts = 2")
    assert len(pilfr.run(folder / "rig.toml").done) == 3


def test_a_recording_that_is_changed_and_restored_leaves_the_bytes_of_the_first_run(done):
    folder = done
    first = pilfr.run(folder / "rig.toml")
    before, test = contents(first.folder), (folder / "test.csv").read_bytes()
    write_csv(folder / "test.csv", seed=9, m=400)
    other = pilfr.run(folder / "rig.toml")
    assert len(other.manifest["scores"]) == len(first.manifest["scores"]) and contents(first.folder) != before
    (folder / "test.csv").write_bytes(test)
    assert pilfr.run(folder / "rig.toml").done == () and contents(first.folder) == before


def test_the_same_content_under_another_key_order_is_the_same_job(folder):
    run = read_run(folder / "rig.toml")
    text = RUN.replace('structure = "hammerstein"\nnx = 1\n', 'nx = 1\nstructure = "hammerstein"\n')
    (folder / "rig.toml").write_text(text)
    other = read_run(folder / "rig.toml")
    keys = [[j.key for j in jobs_of(r, input_digests(r))] for r in (run, other)]
    assert keys[0] == keys[1] and len(set(keys[0])) == 3


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    "name", ["model.json", "jobs/seed-0/model.json", "results.csv", "manifest.json", "report.html"]
)
def test_tampering_is_noticed(capsys, done, name):
    folder, out = done, done / "rig-run"
    changed(folder, "seeds = [0, 1, 2]\nreport = false", f"seeds = 0\nreport = {str(name == 'report.html').lower()}")
    pilfr.run(folder / "rig.toml")
    text = (out / name).read_text()
    assert "0" in text
    (out / name).write_text(text.replace("0", "1", 1))
    before = (out / name).read_bytes()
    refused(capsys, "run", folder / "rig.toml", says=(name, "restore", "--overwrite"))
    assert (out / name).read_bytes() == before  # nothing is overwritten without being asked
    assert main(["run", str(folder / "rig.toml"), "--overwrite"]) == 0


def test_a_missing_model_is_made_again(done):
    folder = done
    first = pilfr.run(folder / "rig.toml")
    before = contents(first.folder)
    shutil.rmtree(first.folder / "jobs" / "seed-1")
    again = pilfr.run(folder / "rig.toml")
    assert again.done == ("seed-1",) and contents(again.folder) == before


@pytest.mark.parametrize(
    "old, new, says",
    [
        ("nx = 1", "nX = 1", "[model] has an unknown key 'nX'; did you mean 'nx'?"),
        ("nx = 1", "", "'nx' in [model] is missing; give the number of states"),
        ("starts = 1", "stars = 1", "[solver] has an unknown key 'stars'; did you mean 'starts'?"),
        ("nx = 1", "nx = 'one'", ("'nx' in [model] is 'one'", "whole number")),
        ("operators = 3", "operators = -3", "-3"),
        ("operators = 3", "operators = true", "True"),
        ('"train.csv"', '"nowhere.csv"', ("'train' in [data]: there is no file", "nowhere.csv; check the name")),
        ('"train.csv"', '"pipe.csv"', ("'train' in [data]", "pipe.csv is a pipe or a device")),
        ('test = "test.csv"', 'test = "train.csv"', "given twice"),
        ("seeds = [0, 1, 2]", "seeds = [0, 0]", "different whole numbers"),
        ("seeds = [0, 1, 2]", "seeds = [0, 0.5]", "different whole numbers"),
        ("seeds = [0, 1, 2]", "seeds = [0", "is not a TOML file"),
        ("seeds = [0, 1, 2]", "sedes = 3", "the run has an unknown key 'sedes'; did you mean 'seeds'?"),
        ('"hammerstein"', '"hamerstein"', "'hammerstein'"),
        ('outputs = "y"', 'outputs = "z"', "z"),
        ('outputs = "y"', "outputs = 3", "a name, or a list of names"),
        ('initial = "zero"', 'initial = "nil"', "nil"),
        ('initial = "zero"', 'initial = "periodic"\nperiod = 40', ("does not repeat after 40 samples", "period")),
        ("[solver]", "[solver]\ntime_limit = 3", "max_iterations"),
        ("[solver]", '[solver]\nname = "newton"', "'gauss-newton' or 'ipopt'"),
        ("[solver]", "[constraints]\nspectral_radius = -1\n[solver]", "'spectral_radius'"),
        ("[solver]", "[constraints]\ndc_gain = 'two'\n[solver]", "dc_gain"),
        ("[solver]", "[constraints]\nown = [1]\n[solver]", "'own'"),
        ("[solver]", "[regularization]\nl1 = -1\n[solver]", "'l1'"),
        ("[solver]", "[regularization]\nprune = true\n[solver]", "'prune' in [regularization] goes with 'l1'"),
        ("nx = 1", "nx = 500", "at least"),
        ("nx = 1", "nx = 5000", "'nx' in [model] is 5000; give a whole number from 0 to 1000"),
        ("nx = 1", f"nx = {'9' * 400}", "'nx' in [model] is 999"),
        ("starts = 1", "starts = 1000000000000", "'starts' in [solver] is 1000000000000; give a whole number"),
        ('initial = "zero"', f"skip = {10**30}", "'skip' in [data] is 1000"),
        ("report = false", "report = 0", "'report' is 0; give true or false"),
        ("report = false", "workers = 99999999", "'workers' is 99999999; give a whole number from 1 to 1024"),
        ("[solver]", "[regularization]\npath = 3\n[solver]", "'path'"),
        ("[solver]", "[regularization]\npath = [true]\n[solver]", "'path' in [regularization] is [True]"),
        ("[solver]", "[regularization]\npath = [0.0]\n[solver]", "strengths above zero"),
        ("nx = 1", "nx = 1\nfix = { A = [[0.9, 0.1]] }", "The fixed value of 'A' has the shape (1, 2)"),
        ("nx = 1", "nx = 1\nbounds = { w = [[0.0, 0.1], 1.0] }", "The lower bound of 'w' has the shape (2,)"),
        ("nx = 1", "nx = 1\npriors = { A = [[0.9, 0.1], 1.0] }", "The mean of the prior of 'A' has the shape (2,)"),
        ("[solver]", "[constraints]\ndc_gain = [1.0, 2.0]\n[solver]", "dc_gain have the shape (2,)"),
        ("[solver]", "[constraints]\ndc_gain = { value = 1.0, slope = 'a' }\n[solver]", "slope of a dc_gain is a"),
        ("[solver]", "[constraints]\nordered_thresholds = [1]\n[solver]", "ordered_thresholds"),
        ("[solver]", "[constraints]\nordered_thresholds = -1\n[solver]", "[constraints]: A gap of -1"),
        ('validation = ["held.csv"]', "regularisation = 3", "unknown key 'regularisation'"),
        ("operators = 3", "operators = 3\nbounds = { w = [2, 1] }", "infeasible"),
        ("operators = 3", "operators = 3\nfix = { E = 1.0 }", "'E'"),
    ],
)
def test_bad_input_gets_one_sentence(capsys, folder, old, new, says):
    os.mkfifo(folder / "pipe.csv")
    refused(capsys, "run", changed(folder, old, new), says=says)
    assert not (folder / "rig-run" / "results.csv").exists()


def test_the_example_of_a_run_file_has_every_key():
    """Each key of the schema stands in its table of every_key.toml, commented out where it excludes another."""
    text = EVERY_KEY.read_text()
    assert max(map(len, text.splitlines())) <= 120
    tables = {name: field.annotation for name, field in RunTable.model_fields.items()}
    tables = {name: kind for name, kind in tables.items() if hasattr(kind, "model_fields") and name != "grid"}
    tables |= {"": RunTable, "model": ModelTable, "solver": SolverTable}
    assert len(tables) == 7
    for name, kind in tables.items():
        part = text.split(f"[{name}]")[1].partition("\n[")[0] if name else text
        for key in kind.model_fields:
            assert re.search(rf"^(# )?{key} = |^(# )?\[{key}\]", part, re.M), (name, key)


def test_constraints_that_cannot_be_met_get_one_sentence(capsys, folder):
    text = "fix = { A = 0.95, B_u = 0.0, D_yu = 0.0, C_z = 0.0, D_zu = 1.0 }"
    more = f"operators = 3\n{text}\n[constraints]\nspectral_radius = 0.9"
    refused(capsys, "run", changed(folder, "operators = 3", more), says=("spectral radius <= 0.9", "infeasible"))
    gain = "[constraints]\nspectral_radius = 0.5\ndc_gain = { value = 1e9, within = 1.0 }\n[solver]"
    text = RUN.replace(
        "operators = 3", "operators = 3\nbounds = { w = [0, 1], B_w = [0, 1], C_y = [0, 1], D_yw = [0, 1] }"
    )
    (folder / "rig.toml").write_text(text.replace("[solver]", gain))
    assert main(["run", str(folder / "rig.toml")]) == 1  # nothing is wrong with the file, there is no usable result
    err = sentence(capsys.readouterr().err)
    assert all(word in err for word in ("no job meets its constraints", "DC gain", "off by")), err
    with pytest.raises(InputError, match="no job meets its constraints"):
        pilfr.run(folder / "rig.toml")


def test_other_bad_places(capsys, folder, tmp_path):
    refused(capsys, "run", folder / "none.toml", says=("cannot be read", "none.toml; check the name"))
    for name in ("pipe.toml", "pipe.py"):  # reading one would wait forever
        os.mkfifo(folder / name)
        refused(capsys, "run", folder / name, says=f"{name} is a pipe or a device")
    refused(capsys, "run", folder / "rig.toml", "--out", folder / "train.csv", says="train.csv")
    (folder / "mine").mkdir()
    (folder / "mine" / "model.json").write_text("{}")
    refused(capsys, "run", folder / "rig.toml", "--out", folder / "mine", says=("model.json", "no manifest"))
    assert (folder / "mine" / "model.json").read_text() == "{}"
    refused(capsys, "run", folder / "rig.toml", "--workers", "0", says="--workers 0")


@pytest.mark.parametrize("out", ["..", "../..", ".", "", "/tmp", "x/../..", "../other", "a/../../other", "\\u0000"])
def test_a_run_file_writes_only_below_its_own_folder(capsys, folder, out):
    inner = folder / "inner"
    inner.mkdir()
    for name in ("train", "held", "test"):
        shutil.copy(folder / f"{name}.csv", inner)
    (inner / "rig.toml").write_text(f'out = "{out}"\n' + RUN)
    before = sorted(folder.rglob("*"))
    refused(capsys, "run", inner / "rig.toml", says=("'out' is", "not below the folder of the run file", "--out"))
    assert sorted(folder.rglob("*")) == before


def test_a_link_does_not_lead_out_of_the_folder(capsys, folder):
    inner = folder / "inner"
    inner.mkdir()
    for name in ("train", "held", "test"):
        shutil.copy(folder / f"{name}.csv", inner)
    (folder / "elsewhere").mkdir()
    (inner / "way").symlink_to(folder / "elsewhere")
    (inner / "rig.toml").write_text('out = "way"\n' + RUN)
    refused(capsys, "run", inner / "rig.toml", says="not below the folder of the run file")
    assert not list((folder / "elsewhere").iterdir())


@pytest.mark.parametrize("more", [(), ("--overwrite",)])
def test_foreign_content_is_not_written_over(capsys, folder, more):
    (folder / "mine").mkdir()
    (folder / "mine" / "thesis.tex").write_text("years of work")
    (folder / "mine" / "model.json").write_text("{}")
    refused(
        capsys, "run", folder / "rig.toml", "--out", folder / "mine", *more, says=("thesis.tex", "no manifest of a run")
    )
    assert sorted(p.name for p in (folder / "mine").iterdir()) == ["model.json", "thesis.tex"]
    refused(
        capsys,
        "run",
        folder / "rig.toml",
        "--out",
        folder,
        *more,
        says=("holds the run file", "give the results another folder"),
    )
    refused(capsys, "run", folder / "rig.toml", "--out", folder.parent, *more, says="holds the run file")
    assert not (folder / "manifest.json").exists() and not (folder.parent / "manifest.json").exists()


def test_an_empty_folder_and_leftovers_of_a_killed_process_are_accepted(folder):
    changed(folder, "[0, 1, 2]", "[0]")
    (folder / "empty").mkdir()
    assert pilfr.run(folder / "rig.toml", out=folder / "empty").done == ("seed-0",)
    (folder / "left").mkdir()
    (folder / "left" / ".lock").touch()
    (folder / "left" / ".manifest.json.0123abcd.tmp").write_text("{")
    (folder / "left" / "jobs" / "seed-0").mkdir(parents=True)
    (folder / "left" / "jobs" / "seed-0" / ".model.json.0123abcd.tmp").write_text("{")
    left = pilfr.run(folder / "rig.toml", out=folder / "left", overwrite=True)
    assert left.done == ("seed-0",) and contents(left.folder) == contents(folder / "empty")


def test_times_that_are_damaged_do_not_matter(folder):
    changed(folder, "[0, 1, 2]", "[0]")
    out = pilfr.run(folder / "rig.toml").folder
    (out / "times.json").write_text("[1")
    again = pilfr.run(folder / "rig.toml")
    assert again.done == () and again.fit.seconds == 0.0


def test_two_runs_do_not_share_a_folder(capsys, folder):
    from pilfr_casadi.studies import lock_folder

    (folder / "rig-run").mkdir()
    with lock_folder(folder / "rig-run"):
        refused(capsys, "run", folder / "rig.toml", says="Another run is at work")


def test_a_python_file_does_the_same_with_objects(folder):
    (folder / "mine.py").write_text(PYTHON)
    first = pilfr.run(folder / "mine.py")
    assert first.fit.parameters["A"].item() <= 0.79 and first.fit.status is not Status.INFEASIBLE
    assert pilfr.run(folder / "mine.py").skipped == ("seed-0",)
    (folder / "mine.py").write_text(PYTHON.replace("0.79", "0.78"))
    again = pilfr.run(folder / "mine.py")
    assert again.done == ("seed-0",) and again.fit.parameters["A"].item() <= 0.78
    (folder / "mine.py").write_text("ran = {}")
    with pytest.raises(InputError, match="does not set the variable 'run'"):
        pilfr.run(folder / "mine.py")
    (folder / "mine.py").write_text("run = 1 / 0")
    with pytest.raises(InputError, match=r"mine.py, line 1: ZeroDivisionError"):
        pilfr.run(folder / "mine.py")


def test_starts_at_the_best_linear_approximation(capsys, folder):
    """As `linear="bla"` in Python, of periodic training recordings; of others one sentence."""
    wave = np.random.default_rng(3).normal(size=100)
    write_csv(folder / "train.csv", m=300, u=np.tile(wave, 3))
    bla = ('start = "plain"', 'linear = "bla"')
    refused(capsys, "run", changed(folder, *bla), says=("periodic training recordings", "'period' in [data]"))
    periodic = RUN.replace("[0, 1, 2]", "[0]").replace("operators = 3", "operators = 1")
    periodic = periodic.replace('"zero"', '"zero"\nskip = 100\nperiod = 100')
    (folder / "rig.toml").write_text(periodic.replace(*bla).replace("period = 100", "period = 90"))
    refused(capsys, "run", folder / "rig.toml", says="not whole periods of 90 samples")
    grid = periodic.replace('start = "plain"\n', "") + '\n[grid]\nlinear = ["bla", "output-error"]'
    (folder / "rig.toml").write_text(grid)
    result = pilfr.run(folder / "rig.toml")
    assert set(result.done) == {"linear-bla_seed-0", "linear-output-error_seed-0"}
    train = pilfr.read(folder / "train.csv", "u", "y", initial="zero", skip=100, period=100)
    for linear, options in (("bla", {"linear": "bla"}), ("output-error", {})):
        own = pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 1)), train, starts=1, **options)
        found = pilfr.load(result.folder / "jobs" / f"linear-{linear}_seed-0" / "model.json")
        assert np.array_equal(found.model.parameters.start, own.model.parameters.start)
    (folder / "rig.toml").write_text(grid.replace("nx = 1\noperators = 1", "lags = 1").replace("hammerstein", "narx"))
    refused(capsys, "run", folder / "rig.toml", says="linear = 'bla' is not for a NARX or NOE")
    both = grid.replace('structure = "hammerstein"', "lags = 1\nhidden = 2") + '\nstructure = ["lfr", "narx"]'
    (folder / "rig.toml").write_text(both)
    cells = [cell.values for cell in read_run(folder / "rig.toml").cells]
    assert cells == [{"structure": "lfr", "linear": k} for k in ("bla", "output-error")] + [{"structure": "narx"}]


def test_regularization_in_a_run(folder):
    text = RUN.replace("[0, 1, 2]", "0").replace("operators = 3", "operators = 4")
    (folder / "rig.toml").write_text(text + "\n[regularization]\npath = [1e-4, 1e-3]\n")
    sparse = pilfr.run(folder / "rig.toml")
    assert 1 <= sparse.manifest["jobs"]["seed-0"]["operators_used"] <= 3
    write_csv(folder / "test.csv", seed=5, m=400)
    assert pilfr.run(folder / "rig.toml").done == ()  # a path never looks at the test
    write_csv(folder / "held.csv", seed=6, m=400)
    assert pilfr.run(folder / "rig.toml").done == ("seed-0",)  # but at the validation


@pytest.mark.parametrize("content", ["[]", "3", "null", "{", '"text"'])
def test_a_bad_manifest_gets_one_sentence(capsys, folder, content):
    (folder / "rig-run").mkdir()
    (folder / "rig-run" / "manifest.json").write_text(content)
    refused(capsys, "run", folder / "rig.toml", says="manifest.json is not a manifest of a run; restore it")
