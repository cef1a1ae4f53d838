"""Ctrl-C, time limits and workers: a run ends soon, keeps what it has, and leaves no process behind."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import pilfr_casadi
from pilfr_casadi._base import Clock, deferred_interrupt, time_limit, unwrapped_interrupt, worker_pool

TRAIN = Path(pilfr_casadi.__file__).parent / "cli" / "demo_data" / "train.csv"
PILFR = [sys.executable, "-c", "import sys; from pilfr_casadi.cli import main; sys.exit(main(sys.argv[1:]))"]
linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are counted in /proc")


def test_an_interrupt_is_deferred():
    steps = []
    with pytest.raises(KeyboardInterrupt), deferred_interrupt():
        signal.raise_signal(signal.SIGINT)
        steps.append("went on")
    assert steps == ["went on"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_only_interrupts_are_unwrapped():
    with pytest.raises(KeyboardInterrupt), unwrapped_interrupt():
        raise SystemError("of an extension") from KeyboardInterrupt()
    with pytest.raises(SystemError, match="another"), unwrapped_interrupt():
        raise SystemError("another") from ValueError()


def test_a_time_limit_interrupts_only_what_it_limits():
    clock = Clock()
    with pytest.raises(KeyboardInterrupt), time_limit(0.05, clock):
        time.sleep(20)
    assert clock.expired
    clock = Clock()
    with time_limit(0.2, clock):
        pass
    time.sleep(0.4)
    assert not clock.expired and threading.active_count() < 20


def test_a_time_limit_holds_where_ctrl_c_is_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt), time_limit(0.05, Clock()):
            time.sleep(20)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("leave", ["done", "interrupted", "cancelled"])
def test_no_worker_is_left(leave):
    before = set(multiprocessing.active_children())
    began = time.monotonic()
    try:
        with worker_pool(2) as pool:
            assert pool.submit(abs, -3).result() == 3
            if leave != "done":
                tasks = [pool.submit(time.sleep, 60) for _ in range(9)]
                for task in tasks if leave == "cancelled" else ():
                    task.cancel()
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        assert leave != "done"
    while set(multiprocessing.active_children()) - before:
        assert time.monotonic() - began < 20
        time.sleep(0.05)
    with worker_pool(1) as nothing:
        assert nothing is None


def session(leader):
    """Processes of a session that are alive, by number."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(entry.name))
    return found


def struck(arguments, until, number=signal.SIGINT):
    """Run a command, signal its whole process group once `until(process)`; status, stdout, stderr, processes."""
    ours = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, and a command inherits that
    try:
        process = subprocess.Popen(
            [*PILFR, *map(str, arguments)],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    finally:
        signal.signal(signal.SIGHUP, ours)
    try:
        end = time.monotonic() + 60
        while not until(process):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        os.killpg(process.pid, number)
        out, err = process.communicate(timeout=60)
        end = time.monotonic() + 10
        while (left := session(process.pid)) and time.monotonic() < end:
            time.sleep(0.05)
        return process.returncode, out, err, left
    finally:
        for number in {process.pid, *session(process.pid)}:
            try:
                os.kill(number, signal.SIGKILL)
            except ProcessLookupError:
                continue
        process.wait()


@linux
@pytest.mark.parametrize(
    ("pause", "number"),
    [
        (0.0, signal.SIGINT),
        (0.5, signal.SIGINT),
        (0.5, signal.SIGTERM),
        (0.5, getattr(signal, "SIGHUP", None)),
        pytest.param(2.5, signal.SIGINT, marks=pytest.mark.slow),  # a model and its report are written
        pytest.param(2.5, signal.SIGTERM, marks=pytest.mark.slow),
    ],
)
def test_the_first_signal_ends_a_run_with_workers(tmp_path, pause, number):
    """Struck `pause` seconds after its workers have begun."""
    out_dir, since = tmp_path / "out", []

    def until(process):
        if not since and len(session(process.pid)) >= 3:
            since.append(time.monotonic())
        return since and time.monotonic() - since[0] >= pause

    names = ("--inputs", "u", "--outputs", "x2", "--initial", "zero", "--nx", 5, "--starts", 500, "--workers", 2)
    status, out, err, left = struck(("fit", TRAIN, *names, "--out", out_dir), until, number)
    assert status == 130 and left == []
    assert "Traceback" not in err and "Exception" not in err
    written = (out_dir / "model.json").exists()
    assert ("before there was anything to write" in err) == (not written)
    if written:
        assert "interrupted" in out
        assert json.loads((out_dir / "model.json").read_text())["parameters"]["A"]


@linux
def test_workers_end_with_a_process_that_is_killed():
    program = (
        "from pilfr_casadi._base import worker_pool\nimport time\n"
        "with worker_pool(3) as pool:\n"
        "    tasks = [pool.submit(time.sleep, 60) for _ in range(3)]\n    print('ready', flush=True)\n"
        "    tasks[0].result()"
    )
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n" and len(session(process.pid)) == 4
        process.kill()
        end = time.monotonic() + 10
        while (left := session(process.pid)) and time.monotonic() < end:
            time.sleep(0.05)
        for number in left:
            os.kill(number, signal.SIGKILL)
    assert not left


@linux
@pytest.mark.slow
def test_ctrl_c_in_the_demo_writes_the_best_so_far(tmp_path):
    """Struck once three processes are at work and the linear model, which takes a fraction of that, may be there."""
    began = time.monotonic()

    def until(process):
        return len(session(process.pid)) >= 3 and time.monotonic() - began > 3

    status, out, err, left = struck(("demo", "--workers", 2, "--out", tmp_path), until)
    assert status == 130 and left == [] and "Traceback" not in err
    written = (tmp_path / "model.json").exists()
    assert ("before there was anything to write" in err) == (not written)
    assert written == ("interrupted" in out.lower())
