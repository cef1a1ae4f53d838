"""Fleets: the common physics, the machines that differ or drift, resumption, and the same bytes for any executor."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from browser import in_a_browser, needs_chromium
from command_line import refused, run
from fleet_rig import LAWS, PORT, STIFFNESS, WEAR, machines, recording, rig, write_machines

import pilfr_casadi as pilfr
from pilfr_casadi import report
from pilfr_casadi._base import InputError, close_workers
from pilfr_casadi.cli import main
from pilfr_casadi.report import Page
from pilfr_casadi.studies import Manifest, RunInterrupted, common_physics, read_fleet
from pilfr_casadi.studies.machines import simulator_digest

OPTIONS = {"laws": LAWS, "effects": 1, "sample": 1}
FRICTION = f"{PORT}.F_c"
COMMAND = "import sys; from pilfr_casadi.cli import main; sys.exit(main())"


def contents(out):
    """What is the same in every execution of a fleet."""
    files = {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    return {name: data for name, data in files.items() if name not in ("times.json", ".lock")}


@pytest.fixture(scope="module")
def days():
    return machines()


@pytest.fixture(scope="module")
def found(days, tmp_path_factory, without_drawing):
    """The fleet and its folder; the pages of single diagnoses take long and are tested elsewhere."""
    folder = tmp_path_factory.mktemp("fleet") / "out"
    with pytest.MonkeyPatch.context() as patch, without_drawing():
        patch.setattr(report, "diagnosis_page", lambda diagnosis: Page(diagnosis.verdict, ()))
        return pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=folder), folder


def test_the_common_physics_is_found_and_confirmed(found):
    fleet, _ = found
    assert [(law.port, law.id) for law in fleet.common.laws] == [(PORT, "coulomb_friction")]
    assert fleet.common.probability > 0.9 and fleet.confirmed >= 4
    assert "Coulomb friction" in fleet.summary and "1 differs and 1 drifts." in fleet.summary


@needs_chromium
@pytest.mark.slow
def test_pages_in_a_browser(found, tmp_path):
    fleet, _ = found
    residual = {"seconds": 2.0, "low": [-0.1, 0.0, 0.1], "high": [0.0, 0.1, 0.2], "noise": 0.05}
    residuals = {m.name: residual for m in fleet.machines}
    page = report.fleet_page(fleet.to_dict(), residuals)
    (tmp_path / "report.html").write_text(page.html())
    for seen in in_a_browser(tmp_path / "report.html"):
        assert seen["charts"] == seen["pictures"] == 6  # the map, three values, what is left, a drift
    assert "drifts by −" in page.html()


def test_a_second_fault_is_found_and_named(found):
    fleet, folder = found
    (odd,) = fleet.differing
    assert odd.name == "e" and odd.beyond > 0.9 and odd.ratio > 5 and fleet.machines[0].probability > 0.9
    assert [(e["port"], e["law"]) for e in odd.rest["effects"]] == [(PORT, "cubic_stiffness")]
    assert (folder / odd.report).is_file()
    assert max(m.beyond for m in fleet.machines if m.name != "e") < 0.5


def test_values_are_shared_or_own_and_honest(found):
    fleet, _ = found
    kinds = {v.name: v.kind for v in fleet.values}
    assert kinds["k"] == "per machine" and kinds[FRICTION] == "shared"
    for name in "acd":
        m = fleet[name]
        assert m.values["k"] == pytest.approx(STIFFNESS[name], abs=4 * m.errors["k"]) and m.errors["k"] < 1
        assert m.values[FRICTION] == pytest.approx(5.0, abs=4 * m.errors[FRICTION])
    units = {v.name: v.unit for v in fleet.values}
    assert units["k"] == "N/m" and units[FRICTION] == "N"


def test_wear_is_a_trend_and_no_other_difference(found):
    fleet, _ = found
    (worn,) = fleet.drifting
    assert worn.name == "b" and worn.trends["k"].slope == pytest.approx(-WEAR * STIFFNESS["b"], abs=1.0)
    assert worn.beyond < 0.5 and not any(p > 0.5 for p in worn.differs.values())


def test_a_new_machine_is_judged_against_the_rest(found):
    fleet, folder = found
    for against in (fleet, read_fleet(folder, rig(), laws=LAWS)):
        assert not against.judge("new", recording(1290.0, 90)).reasons
        (reason,) = against.judge("odd", recording(2400.0, 91)).reasons
        assert reason[0].startswith("k = 24") and reason[1] > 0.5
    with pytest.raises(InputError, match="no output"):
        fleet.judge("other", pilfr.Recording(np.ones(30), np.ones(30), 5e-3, inputs=("force",), outputs=("x",)))


def test_the_folder_holds_table_content_and_page(found):
    fleet, folder = found
    with (folder / "fleet.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["machine"] for r in rows] == [m.name for m in fleet.machines]
    assert float(next(r["beyond"] for r in rows if r["machine"] == "e")) > 0.9
    content = json.loads((folder / "fleet.json").read_text())
    assert content["differing"] == ["e"] and content["drifting"] == ["b"]
    page = (folder / "report.html").read_text()
    assert "default-src 'none'" in page and page.count("<script>") == page.count("'sha256-") == 2  # its own, no others
    assert page.count("<img") == 6  # map, three values, what is left, drift
    assert page.count("data-chart=") == 6
    assert fleet.plot()._repr_png_()[:4] == b"\x89PNG"
    assert str(read_fleet(folder, rig(), laws=LAWS)) == str(fleet)


def test_every_machine_has_a_page(found):
    fleet, folder = found
    overview = (folder / "report.html").read_text()
    pages = {}
    for m in fleet.machines:
        assert f'href="{m.page}"' in overview
        page = pages[m.name] = (folder / m.page).read_text()
        scripts = 2 if "data-chart=" in page else 0  # only its own, allowed by their hash
        assert "default-src 'none'" in page and page.count("<script>") == page.count("'sha256-") == scripts
        links = [link for link in re.findall(r'href="([^"]*)"', page) if not link.startswith(("data:", "#"))]
        assert "../../report.html" in links and all((folder / m.page).parent.joinpath(link).is_file() for link in links)
    assert f'href="../../{fleet["e"].report}"' in pages["e"] and "cubic stiffness" in pages["e"]
    assert "As the other machines" in pages["a"] and "0.003" in pages["a"]  # the noise
    # drift and residual, residual, and none of a regular machine
    assert [pages[name].count("<img") for name in "bea"] == [2, 1, 0]
    assert re.search(r"k drifts by [^;]* per recording \(probability 1\)", pages["b"])


def test_a_drift_withdraws_the_diagnosis_of_the_machine_alone(found):
    fleet, folder = found
    entries = Manifest.read(folder, pilfr.studies.FLEET).entries
    (sentence,) = (e["sentence"] for e in entries.values() if e["step"] == "sample")
    assert re.fullmatch(r"Diagnosed alone, it suggests .*; the comparison with the other machines decides\.", sentence)
    assert "per recording (1.00)" in fleet["b"].findings and not fleet["b"].note
    sampled = replace(fleet["b"], report="jobs/sample-b/report.html")
    assert sampled.findings.startswith(fleet["b"].findings) and "is replaced by this finding" in sampled.findings
    assert not replace(fleet["a"], report="jobs/sample-a/report.html").findings


def test_a_drift_is_per_recording_unless_times_are_given(found):
    fleet, _ = found
    worn = machines()["b"]
    (unnamed,), (named,) = (fleet.judge("b", worn, times).reasons for times in (None, [0.0, 10.0]))
    assert unnamed[0].endswith("per recording") and named[0].endswith("per unit of time")
    slopes = [float(re.search(r"drifts by (\S+)", text)[1]) for text in (unnamed[0], named[0])]
    assert slopes[0] == pytest.approx(10 * slopes[1], rel=1e-3)


@pytest.mark.usefixtures("blank_figures")
def test_a_wrong_unit_is_named(found, days, tmp_path):
    """Without a diagnosis, for a new machine, and for one that is added to the fleet."""
    fleet, folder = found
    wrong = [r.with_(y=1e3 * r.y) for r in days["a"]]
    judged = fleet.judge("f", wrong)
    (reason,) = judged.reasons
    assert "position is too large by a factor of 1000, as from a wrong unit" in reason[0]
    assert judged.faults and not judged.rest
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    lines = []
    more = pilfr.fleet(rig(), {**days, "f": wrong}, **OPTIONS, workers=1, out=copy, tell=lines.append)
    assert [line.partition(":")[0] for line in lines if "already" not in line] == ["refit-f", "measure-f", "rest-f"]
    assert "position is too large by a factor of 1000" in more["f"].findings and not more["f"].report
    assert more["f"].faults == read_fleet(copy, rig(), laws=LAWS)["f"].faults == judged.faults
    content = json.loads((copy / "fleet.json").read_text())
    for machine in content["machines"]:
        del machine["faults"]  # as in a file of an earlier release
    (tmp_path / "earlier.json").write_text(json.dumps(content))
    assert not read_fleet(tmp_path / "earlier.json", rig(), laws=LAWS)["f"].faults
    assert [m.name for m in more.drifting] == ["b"]
    assert "position is too large" in (copy / more["f"].page).read_text()


@pytest.mark.usefixtures("blank_figures")
def test_a_report_elsewhere_is_complete(found, tmp_path):
    fleet, folder = found
    fleet.report(tmp_path / "copy")
    whole = contents(folder)
    assert contents(tmp_path / "copy") == {k: v for k, v in whole.items() if k != "manifest.json"}


@pytest.mark.usefixtures("blank_figures")
def test_only_missing_jobs_are_executed_again(found, days, tmp_path, monkeypatch):
    _, folder = found
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    manifest = Manifest.read(copy, pilfr.studies.FLEET)
    for job in ("refit-a", "measure-c"):
        del manifest.content["jobs"][job]
    manifest.write()
    (copy / "fleet.csv").unlink()
    lines, stages = [], []
    monkeypatch.setattr(report, "diagnosis_page", None)  # no diagnosis is due
    pilfr.fleet(
        rig(), days, **OPTIONS, workers=1, out=copy, tell=lines.append, progress=lambda *now: stages.append(now[:3])
    )
    begun = [line for line in lines if line.endswith("already done")]
    assert [line.partition(":")[0] for line in lines if line not in begun] == ["refit-a", "measure-c"]
    assert [re.sub(r"(\w+):.*; ", r"\1 ", line) for line in begun] == [
        "refit 4 of 5 already done",
        "sample 1 of 1 already done",
        "measure 4 of 5 already done",
        "rest 1 of 1 already done",
    ]
    assert stages[:3] == [("refit", 4, 5), ("refit", 5, 5), ("sample", 1, 1)]
    assert contents(copy) == contents(folder)
    (copy / "jobs" / "measure-a" / "residual.json").write_text("{}")
    with pytest.raises(InputError, match="was changed after the fleet wrote it"):
        pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=copy)


def test_a_step_that_ran_out_of_time_needs_a_longer_limit(found, days, tmp_path):
    _, folder = found
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    manifest, lines = Manifest.read(copy, pilfr.studies.FLEET), []
    manifest.content["jobs"]["measure-c"] |= {"status": "TIMED_OUT", "sentence": "too long", "time_limit": 20.0}
    manifest.write()
    again = pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=copy, time_limit=20.0, tell=lines.append)
    assert again["c"].failed == "too long" and all(line.endswith("already done") for line in lines)
    longer = pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=copy, time_limit=60.0)
    assert not longer["c"].failed


def test_an_interrupt_keeps_what_is_done(days, tmp_path, monkeypatch):
    from pilfr_casadi.optimise import GaussNewton

    real, calls = GaussNewton.solve, []

    def stopped(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return real(self, *args, **kwargs)

    monkeypatch.setattr(GaussNewton, "solve", stopped)
    with pytest.raises(RunInterrupted, match=r"2 of \d+ jobs are done"):
        pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=tmp_path / "out")
    assert jobs_in(tmp_path / "out") == 2 and not (tmp_path / "out" / "report.html").exists()


def hypothesis(evidence, *laws, prior=-1.0):
    parameters = {"F": {"value": 2.0, "low": 0.0, "high": None}}
    found = [{"port": p, "law": law, "id": law.lower(), "form": "", "parameters": parameters} for p, law in laws]
    return {"laws": found, "log_evidence": evidence, "log_prior": prior if laws else 0.0}


def sampled(*hypotheses):
    return {"status": "DONE", "hold": "zero", "hypotheses": list(hypotheses)}


def test_finished_jobs_count_only_for_the_same_simulator():
    simulator = rig()
    first, *others = simulator.ports
    changes = [
        {"signals": {"load": lambda x: x[simulator.states[0]]}},
        {"signals": {"load": lambda x: 2 * x[simulator.states[0]]}},
        {"domain": "fluid"},
        {"across": lambda x: 2 * x[simulator.states[0]]},
    ]
    changed = [replace(simulator, ports=(replace(first, **change), *others)) for change in changes]
    digests = [simulator_digest(s) for s in (simulator, *changed)]
    assert len(set(digests)) == len(digests)
    assert simulator_digest(rig()) == digests[0]


def test_evidence_adds_up_over_the_sample():
    one, other, both = ("p", "One"), ("p", "Other"), (("p", "One"), ("q", "Other"))
    sample = {
        "a": sampled(hypothesis(0.0), hypothesis(3.0, one), hypothesis(4.0, other), hypothesis(90.0, *both)),
        "b": sampled(hypothesis(0.0), hypothesis(5.0, one), hypothesis(2.0, other)),
    }
    common, hold = common_physics(sample)
    assert [(law.port, law.law) for law in common.laws] == [one] and hold == "zero"
    assert common.probability == pytest.approx(np.exp(7) / (np.exp(7) + np.exp(5) + 1), rel=1e-6)
    nothing = common_physics({k: sampled(hypothesis(0.0), hypothesis(0.3, one)) for k in "ab"})[0]
    assert nothing.laws == () and nothing.probability > 0.5


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"machines": {"a": None}}, "at least 2 machines"),
        ({"machines": [0, 1]}, "give recordings by name"),
        ({"machines": {"a/b": 0, "c": 0}}, "is named 'a/b'"),
        ({"machines": {"a": 0, "A": 0}}, "upper and lower case"),
        ({"times": {"z": [0, 1]}}, "no machine of the fleet"),
        ({"times": {"a": [0, 1, 2]}}, "3 numbers for 2 recordings"),
        ({"workers": 0}, "workers"),
        ({"executor": 5}, "executor = 5 was given"),
        ({"time_limit": -1}, "time_limit"),
    ],
)
def test_bad_arguments(days, tmp_path, change, says):
    given = {"machines": dict(days), "out": tmp_path / "out", **change}
    with pytest.raises(InputError, match=says):
        pilfr.fleet(rig(), given.pop("machines"), **given)
    assert not (tmp_path / "out").exists()


def test_a_time_limit_that_ends_every_step_says_what_helps(days):
    with pytest.raises(InputError, match=r"time limit of 0.001 s; with a longer one it is done again"):
        pilfr.fleet(rig(), {name: days[name] for name in "ab"}, workers=1, time_limit=0.001)


def test_recordings_that_do_not_fit_are_refused_with_their_machine(days, tmp_path):
    other = pilfr.Recording(np.arange(30.0), np.arange(30.0), 5e-3, inputs=("force",), outputs=("angle",))
    with pytest.raises(InputError, match=r"Machine 'b': .*position"):
        pilfr.fleet(rig(), {"a": days["a"], "b": other}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_commands(tmp_path, days, capsys):
    folder = write_machines(tmp_path, {"a": days["a"], "b": days["b"]})
    rig_file, data, out = folder / "rig.py", folder / "data", folder / "out"
    refused(capsys, "fleet", rig_file, "--out", out, says="give the simulator file, then")
    refused(capsys, "fleet", rig_file, data / "a" / "0.csv", "--out", out, says="is no folder")
    refused(capsys, "fleet", rig_file, data, "--out", data / "out", says="give the results another --out")
    refused(capsys, "fleet", rig_file, data, "--workers", 2, "--dask", "x", "--out", out, says="leave one of them out")
    refused(capsys, "fleet", rig_file, data, "--dask", "nonsense://", "--out", out, says="No Dask scheduler")
    refused(capsys, "fleet", rig_file, data, "--against", folder / "none", says="There is no fleet in")
    (data / "c").mkdir()
    _, said, _ = run(capsys, "fleet", rig_file, data, "--against", folder / "none")
    assert said.count(f"note: {data / 'c'} holds no recording and is left out") == 1
    (data / "b" / "1.csv").write_text("t,force\n0,1\n")
    refused(capsys, "fleet", rig_file, data, "--out", out, says="position")
    (folder / "empty").mkdir()
    refused(capsys, "fleet", rig_file, folder / "empty", "--out", out, says="holds no recording")
    assert not out.exists()
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    shutil.rmtree(data / "b")
    shutil.copytree(data / "a", data / "b")
    refused(capsys, "fleet", rig_file, data, "--out", out, says="precious.txt")
    assert [p.name for p in out.iterdir()] == ["precious.txt"]


def test_a_bad_address_of_a_cluster_is_refused_at_once(tmp_path):
    command = [sys.executable, "-c", COMMAND, "fleet", "rig.py", "data", "--dask", "nonsense", "--out", "out"]
    folder = write_machines(tmp_path, {name: [recording(1200.0, 1)] for name in "ab"})
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=15, check=False)
    assert done.returncode == 2 and not (folder / "out").exists()
    assert done.stderr.startswith("pilfr: No Dask scheduler") and len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_the_bytes_do_not_depend_on_the_executor(days, tmp_path):
    """Pages of diagnoses are made here, in other processes."""
    one = tmp_path / "one"
    pilfr.fleet(rig(), days, **OPTIONS, workers=1, out=one)
    pilfr.fleet(rig(), days, **OPTIONS, workers=2, out=tmp_path / "two")
    with ProcessPoolExecutor(2) as pool:
        pilfr.fleet(rig(), days, **OPTIONS, executor=pool, out=tmp_path / "pool")
    close_workers()
    assert contents(one) == contents(tmp_path / "two") == contents(tmp_path / "pool")


def started(folder, *more):
    command = [sys.executable, "-c", COMMAND, "fleet", "rig.py", "data", "--initial", "zero", "--sample", "1", *more]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def jobs_in(folder):
    path = folder / "manifest.json"
    return len(json.loads(path.read_text())["jobs"]) if path.exists() else 0


def wait_for(folder, count, process):
    deadline = time.monotonic() + 300
    while jobs_in(folder) < count:
        assert time.monotonic() < deadline and process.poll() is None, "it did not happen in time"
        time.sleep(0.05)


@pytest.mark.slow
def test_a_dask_worker_and_the_driver_are_killed(days, tmp_path):
    from distributed import LocalCluster

    folder = write_machines(tmp_path, {name: days[name] for name in "abe"})
    with LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster:
        first = started(folder, "--dask", cluster.scheduler_address, "--out", "killed")
        wait_for(folder / "killed", 2, first)
        os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        wait_for(folder / "killed", 5, first)
        first.kill()
        first.wait()
        assert not (folder / "killed" / "report.html").exists()
        second = started(folder, "--dask", cluster.scheduler_address, "--out", "killed")
        assert second.wait(600) == 0
    assert started(folder, "--workers", "1", "--out", "whole").wait(600) == 0
    assert contents(folder / "killed") == contents(folder / "whole")
    assert main(["fleet", str(folder / "rig.py"), str(folder / "data"), "--against", str(folder / "whole")]) == 0
