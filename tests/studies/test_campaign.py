"""Campaigns: the same numbers over any executor, nothing lost or doubled when workers or the driver are killed."""

import csv
import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from command_line import sentence, write_csv
from run_files import ALONE, PYTHON, changed, command, contents, prepared

import pilfr_casadi as pilfr
from pilfr_casadi._base import Clock, InputError, close_workers, time_limit, workers
from pilfr_casadi.cli import main
from pilfr_casadi.studies import Manifest, RunInterrupted

SLOW = """
import os, pathlib, time, tomllib
from pilfr_casadi.identify import DEFAULT_SOLVER

class Slow:
    def __init__(self, folder):
        self.folder = folder

    def solve(self, problem, start=None, report=None):
        if problem.model.element is not None and problem.model.element.n == 3:
            try:
                os.mkdir(f"{self.folder}/taken")  # by the first of all jobs with three operators
            except FileExistsError:
                pass
            else:
                TROUBLE
        return DEFAULT_SOLVER.solve(problem, start)

run = tomllib.loads(pathlib.Path("FOLDER/rig.toml").read_text())
run["solver"]["name"] = Slow("FOLDER")
run["campaign"] = {"time_limit": 10.0}
"""


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two worker processes of one thread."""
    from distributed import LocalCluster

    with LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address=":0") as local:
        yield local


def rows(out):
    with (out / "results.csv").open() as file:
        return list(csv.DictReader(file))


def compared(out):
    """Every model and the table of errors: what a run and a campaign have in common."""
    return {k: v for k, v in contents(out).items() if k not in ("manifest.json", "summary.csv", "spread.png")}


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """What `pilfr run` makes of the same file, one job after the other in one process."""
    return compared(pilfr.run(prepared(tmp_path_factory.mktemp("serial")) / "rig.toml").folder)


@pytest.mark.slow
def test_the_numbers_do_not_depend_on_the_executor(tmp_path, serial):
    """Neither do the bytes of the picture, which is drawn here."""
    folder = prepared(tmp_path)
    own = pilfr.campaign(folder / "rig.toml", out=folder / "own").folder
    with ProcessPoolExecutor(2) as pool:
        given = pilfr.campaign(folder / "rig.toml", out=folder / "given", executor=pool).folder
    close_workers()
    assert compared(own) == serial and contents(own) == contents(given)
    assert (own / "spread.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_dask_gives_the_same_numbers(folder, serial, cluster):
    with cluster.get_client() as client:
        assert compared(pilfr.campaign(folder / "rig.toml", executor=client.get_executor()).folder) == serial
    close_workers()


def test_the_output_of_a_campaign(folder, capsys):
    few = ("count = 4", "count = 3")
    long = f"{'long' * 25}.csv"
    (folder / "test.csv").rename(folder / long)
    names = ("test.csv", long)
    assert main(["campaign", str(changed(folder, ALONE, few, names))]) == 0
    said = capsys.readouterr().out
    assert "2 cells x 3 seeds" in said and "6 jobs done now" in said
    assert "chosen on the training recordings" in said  # two structures, and nothing to judge them by
    shown = {
        tuple(line.split()[:3]): line.split()[7] for line in said.splitlines() if line.startswith(f"{long} (test)")
    }
    table = rows(folder / "rig-campaign")
    with (folder / "rig-campaign" / "summary.csv").open() as file:
        summary = {(r["recording"], r["operators"]): r for r in csv.DictReader(file)}
    for n in "13":
        errors = [float(r["nrmse"]) for r in table if r["operators"] == n and r["role"] == "test"]
        row = summary[long, n]
        assert len(errors) == 3 and row["failed"] == "0" and float(row["median"]) == np.median(errors)
        assert float(row["upper_quartile"]) == np.percentile(errors, 75)
        assert shown[long, "(test)", n] == f"{np.median(errors):.4f}"  # nothing is cut off, however long the line
    more = pilfr.campaign(changed(folder, ALONE, few, names, ("[1, 3]", "[1, 2, 3]")))  # a grid that grows
    assert len(more.done) == 3 and len(more.skipped) == 6


def test_a_recording_may_be_named_as_a_fold(folder):
    (folder / "train.csv").rename(folder / "fold 1.csv")
    result = pilfr.campaign(changed(folder, ALONE, ("train.csv", "fold 1.csv"), ("count = 4", "count = 1")))
    assert {s.recording: s.failed for s in result.summary} == {"fold 1.csv": 0, "test.csv": 0}


@pytest.mark.slow
def test_a_worker_and_the_driver_are_killed(folder, serial, cluster):
    out, first = folder / "rig-campaign", command(folder, "campaign", "--dask", cluster.scheduler_address)
    wait_for(lambda: len(list(out.glob("jobs/*/model.json"))) >= 1)
    os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
    wait_for(lambda: len(list(out.glob("jobs/*/model.json"))) >= 3)
    wait_for((out / "results.csv").exists)
    first.kill()
    first.communicate()
    assert len(rows(out)) in range(2, 17, 2)  # it can be read at any time, and is never half there
    second = command(folder, "campaign", "--dask", cluster.scheduler_address)
    _, err = second.communicate(timeout=60)
    assert second.returncode == 0, err
    assert compared(out) == serial
    jobs = [(r["job"], r["recording"]) for r in rows(out)]
    assert len(jobs) == len(set(jobs)) == 16


def children(pid):
    done = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(p) for p in done.stdout.split()]


def alive(pid):
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().split()[2] != "Z"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_processes_are_killed_and_none_is_left_behind(folder, serial):
    out, driver = folder / "rig-campaign", command(folder, "campaign")
    wait_for(lambda: len(list(out.glob("jobs/*/model.json"))) >= 1)
    hands = children(driver.pid)
    assert hands
    os.kill(hands[0], signal.SIGKILL)  # its job is done again by another
    wait_for(lambda: len(list(out.glob("jobs/*/model.json"))) >= 3)
    hands = children(driver.pid)
    driver.kill()
    driver.communicate()
    wait_for(lambda: not any(map(alive, hands)))
    assert pilfr.campaign(folder / "rig.toml").done
    assert compared(out) == serial


@pytest.mark.slow
def test_an_interrupted_campaign_continues(folder, serial, capsys):
    path, out = folder / "mine.py", folder / "mine-campaign"
    path.write_text(SLOW.replace("TROUBLE", "time.sleep(600)").replace("FOLDER", str(folder)).replace("10.0", "600.0"))
    driver = command(folder, "campaign", run_file=path.name)
    wait_for(lambda: (folder / "taken").exists() and list(out.glob("jobs/*/model.json")))
    driver.send_signal(signal.SIGINT)  # one job is done at least, and one hangs: the campaign cannot have ended
    _, err = driver.communicate(timeout=30)
    assert driver.returncode == 130 and "continues from there" in sentence(err)
    assert {r["job"] for r in rows(out)} == {p.parent.name for p in out.glob("jobs/*/model.json")}
    assert main(["campaign", str(path)]) == 0
    assert "jobs done before" in capsys.readouterr().out
    assert compared(out) == serial


@pytest.fixture
def heard():
    """Ctrl-C is heard, even where a shell runs the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_after_the_jobs_says_that_they_are_done(folder, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("pilfr_casadi.studies.execution"), "summarise", interrupted)
    assert main(["campaign", str(changed(folder, ALONE, ("count = 4", "count = 1")))]) == 130
    assert "2 of 2 jobs are done" in capsys.readouterr().err
    assert len({r["job"] for r in rows(folder / "rig-campaign")}) == 2


@pytest.mark.usefixtures("heard")
def test_ctrl_c_ends_a_child_that_is_about_to_start(folder, monkeypatch):
    begin, ended = workers.WorkerProcess.__init__, threading.Event()

    def late(self):
        assert ended.wait(60)
        begin(self)

    def ends():
        close()
        ended.set()

    close = workers.close_workers
    monkeypatch.setattr(workers.WorkerProcess, "__init__", late)
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.studies.executor"), "close_workers", ends)
    (folder / "mine.py").write_text(SLOW.replace("TROUBLE", "time.sleep(600)").replace("FOLDER", str(folder)))
    with pytest.raises(RunInterrupted), time_limit(0.5, Clock()):
        pilfr.campaign(folder / "mine.py")
    assert ended.is_set() and not workers._children
    assert not [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor")]  # nor can one begin later


@pytest.mark.parametrize(
    "what, status",
    [
        pytest.param("time.sleep(600)", "TIMED_OUT", marks=pytest.mark.slow),
        ("os.kill(os.getpid(), 9)", ""),
        pytest.param("os.rmdir(f'{self.folder}/taken'); os.kill(os.getpid(), 9)", "LOST", marks=pytest.mark.slow),
        pytest.param("raise ValueError(7)", "FAILED", marks=pytest.mark.slow),
    ],
)
def test_a_job_that_hangs_dies_or_fails_does_not_stop_the_others(folder, what, status):
    (folder / "mine.py").write_text(SLOW.replace("TROUBLE", what).replace("FOLDER", str(folder)))
    result = pilfr.campaign(folder / "mine.py")
    failed = [k for k, e in result.manifest["jobs"].items() if e["status"] == status]
    assert sorted(result.failed) == sorted(failed) and len(result.done) == 8
    assert len(failed) == {"": 0, "LOST": 4}.get(status, 1)  # what dies is tried again, three times in all
    if status in ("TIMED_OUT", "FAILED"):
        assert sum(r["nrmse"] == "nan" for r in rows(result.folder)) == 1
        assert max(s.failure_rate for s in result.summary) == 0.25
        assert pilfr.campaign(folder / "mine.py").done == ()


def test_more_time_or_another_worker_tries_again(folder):
    few = ("count = 4", "count = 2"), ("[1, 3]", "[1]")
    first = pilfr.campaign(changed(folder, ALONE, *few))
    manifest = Manifest.read(first.folder)
    entries = manifest.content["jobs"]
    a, b = first.done[:2]
    entries[a] |= {"status": "TIMED_OUT", "time_limit": 20.0}
    entries[b] |= {"status": "LOST"}
    manifest.write()
    limited = changed(folder, *few, ("[grid]", "[campaign]\ntime_limit = 20.0\n[grid]"))
    assert pilfr.campaign(limited).done == (b,)
    longer = changed(folder, *few, ("[grid]", "[campaign]\ntime_limit = 50\n[grid]"))
    assert pilfr.campaign(longer).done == (a,)


@pytest.mark.slow
def test_cross_validation_recommends_a_structure(folder):
    path = changed(
        folder,
        ALONE,
        ("count = 4", "count = 1"),
        ("report = false", "folds = 2\nreport = false"),
        ("[1, 3]", "[0, 2, 5]"),
    )
    result = pilfr.campaign(path)
    chosen = result.selection
    assert chosen.names[chosen.cell] == "operators 2" and "recommended" in repr(chosen) and not result.note
    assert chosen.errors[0] > 3 * chosen.errors[1]  # a linear model cannot follow
    assert len(result.done) == 3 * 2 + 1 and result.chosen.startswith("operators-2_seed")
    held = [s for s in result.summary if s.role == "held"]
    assert [s.jobs for s in held] == [2, 2, 2] and pilfr.campaign(path).done == ()
    assert pilfr.run(path, out=folder / "run").selection.errors == chosen.errors


def test_models_that_explain_nothing_count_as_failed(folder, capsys):
    """A constant output is a minimum, which a solver may call converged; of a start it is a failure."""
    shut = ("nx = 1", "nx = 1\nbounds = { w = [0.0, 0.0] }")
    assert main(["campaign", str(changed(folder, ALONE, ("count = 4", "count = 2"), shut, ("[1, 3]", "[3]")))]) == 1
    out, err = capsys.readouterr()
    assert out.count("The model explains nothing of the training recordings") == 2 and "explains nothing" in err
    result = pilfr.campaign(folder / "rig.toml")
    assert result.done == () and {s.failure_rate for s in result.summary} == {1.0}
    assert all(s.quartiles[0] == pytest.approx(1.0, rel=1e-3) for s in result.summary if s.role == "train")


def test_a_validation_recording_recommends_one_too(folder):
    write_csv(folder / "held.csv", seed=7, m=400)
    result = pilfr.campaign(
        changed(
            folder,
            ALONE,
            ("count = 4", "count = 1"),
            ('test = "test.csv"', 'validation = "held.csv"'),
            ("[1, 3]", "[0, 2, 6]"),
        )
    )
    assert result.selection.names[result.selection.cell] == "operators 2"
    assert result.chosen.startswith("operators-2")


def test_objects_of_a_python_file_are_sent(folder, monkeypatch):
    path = folder / "mine.py"
    path.write_text(PYTHON.replace("report=False", "report=False, workers=2"))
    assert compared(pilfr.campaign(path).folder) == compared(pilfr.run(path).folder)
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    with pytest.raises(InputError, match="cannot be sent to other processes"):
        pilfr.campaign(path, overwrite=True)
