"""Progress shows the stage that runs, what is done of it, the smallest error so far, and the time spent."""

import contextlib
import io
import os
import pty
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise

import numpy as np
import pytest

from pilfr_casadi import PILFR, GaussNewton, Play, PrandtlIshlinskii, Recording, fit
from pilfr_casadi._base import progress_bar

NAN = float("nan")


class Clock:
    """Seconds that a test moves on by hand."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("pilfr_casadi._base.progress.time", clock)
    return clock


def test_lines_tell_each_new_stage_and_every_ten_seconds(clock, capsys):
    reports = [
        (0.5, "linear model", 1, 1, NAN),  # too early for a line
        (2.0, "linear model", 1, 1, 0.5),
        (4.0, "starts", 1, 8, 0.02),
        (6.0, "starts", 2, 8, 0.01),
        (8.0, "linear model", 1, 1, 0.5),  # back to a stage that has its line
        (14.5, "starts", 7, 8, 0.03),  # worse: the best stays
        (15.0, "polish", 0, 0, NAN),  # within a second of the last line
        (85.0, "polish", 0, 0, float("inf")),
    ]
    with progress_bar() as progress:
        for seconds, *news in reports:
            clock.now = 100.0 + seconds
            progress(*news)
    assert capsys.readouterr().err.splitlines() == [
        "linear model 1/1, best NRMSE 0.5000, 2 s",
        "starts 1/8, best NRMSE 0.0200, 4 s",
        "starts 7/8, best NRMSE 0.0100, 14 s",
        "polish, best NRMSE 0.0100, 1 min 25 s",
    ]


def test_lines_never_show_a_count_of_zero_and_end_with_the_last_step(clock, capsys):
    reports = [
        (2.0, "linear model", 0, 200, NAN),  # nothing is done yet
        (4.0, "linear model", 3, 200, 0.5),
        (6.0, "linear model", 90, 200, 0.4),
        (7.0, "linear model", 200, 200, 0.3),  # the last step, soon after the first line
        (7.1, "linear model", 200, 200, 0.3),
        (16.0, "screen", 0, 1, NAN),
        (18.0, "screen", 0, 1, NAN),  # long without a step
    ]
    with progress_bar() as progress:
        for seconds, *news in reports:
            clock.now = 100.0 + seconds
            progress(*news)
    assert capsys.readouterr().err.splitlines() == [
        "linear model 3/200, best NRMSE 0.5000, 4 s",
        "linear model 200/200, best NRMSE 0.3000, 7 s",
        "screen, best NRMSE 0.3000, 18 s",
    ]


def test_quick_work_prints_nothing(clock, capsys):
    with progress_bar() as progress:
        for k in range(5):
            clock.now += 0.1
            progress(f"stage {k}", 0, 1, 0.1)
    assert capsys.readouterr().err == ""


def test_a_fit_reports_its_stages_and_its_best_error_never_rises(capsys, monkeypatch):
    for name in ("NEW_STAGE_LINE", "LINE"):
        monkeypatch.setattr(f"pilfr_casadi._base.progress.{name}", 0.0)
    u = np.sin(np.arange(100) * 0.31) * np.linspace(0.5, 2, 100)
    y = np.cumsum(np.convolve(u, [0.0, 0.5, 0.3])[:100]) * 0.1
    model = PILFR(1, PrandtlIshlinskii(Play, 2))
    fit(model, Recording(u, y, 0.1, initial="zero"), starts=2, progress=True, solver=GaussNewton(max_iterations=3))
    lines = capsys.readouterr().err.splitlines()
    matches = [re.fullmatch(r"([a-z ]+?)( \d+/\d+)?(?:, best NRMSE (\S+))?, \d+ s", line) for line in lines]
    assert all(matches) and {"starts", "polish"} <= {m[1] for m in matches}
    best = [float(m[3]) for m in matches if m[3]]
    assert best and all(later <= earlier for earlier, later in pairwise(best))


SCRIPT = """
import time
from pilfr_casadi._base import progress_bar
with progress_bar() as progress:
    progress("starts", 2, 8, 0.0123)
    time.sleep(0.3)
    progress("polish", 5, 9, 0.5)
    time.sleep(1.3)
"""


def test_a_terminal_shows_one_bar_whose_time_goes_on():
    ours, theirs = pty.openpty()
    process = subprocess.Popen([sys.executable, "-c", SCRIPT], stderr=theirs, env={**os.environ, "COLUMNS": "90"})
    os.close(theirs)
    seen = b""
    with contextlib.suppress(OSError):  # the terminal's end
        while piece := os.read(ours, 4096):
            seen += piece
    os.close(ours)
    assert process.wait() == 0
    drawn = seen.decode()
    for words in ("starts", "2/8", "polish", "5/9", "best NRMSE 0.0123, 0 s", "best NRMSE 0.0123, 1 s"):
        assert words in drawn
    assert "0.5000" not in drawn  # the smallest error, not the latest


def test_an_interrupt_that_was_swallowed_is_raised_again():
    with progress_bar() as progress:
        progress("starts", 1, 2, 0.5)
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            progress("starts", 2, 2, 0.4)
        progress("polish", 1, 1, 0.3)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self):
        return True


def test_a_bar_shows_the_stage_its_count_and_the_smallest_error(monkeypatch):
    drawn = Terminal()
    monkeypatch.setattr("sys.stderr", drawn)
    for name, value in {"COLUMNS": "90", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    with progress_bar() as progress:
        progress("starts", 0, 0, NAN)
        time.sleep(0.2)  # the bar is drawn ten times a second
        assert "starts" in drawn.getvalue() and "NRMSE" not in drawn.getvalue()
        progress("polish", 5, 9, 0.0123)
        progress("polish", 6, 9, 0.5)
        time.sleep(0.2)
    for words in ("polish", "6/9", "best NRMSE 0.0123"):
        assert words in drawn.getvalue()
    assert "0.5000" not in drawn.getvalue()
