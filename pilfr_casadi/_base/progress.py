"""Show the progress of long work on stderr: a bar on a terminal, plain lines elsewhere.

Long work calls `progress(stage, done, total, best)`: the current stage, its finished parts, their total (0 if it is not
known), and the smallest error so far (nan if there is none).
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import Any

from .errors import InputError
from .interrupts import repeated_interrupt

Progress = Callable[[str, int, int, float], None]

NEW_STAGE_LINE = 1.0  # least seconds between plain lines when a new stage begins; quicker work prints nothing
LINE = 10.0  # least seconds between other plain lines, except for the last step of a stage


@dataclass(eq=False)
class Stages:
    """A `Progress` that keeps the smallest error over all stages.

    `prefix` stands before each stage's name, as in "other hold: fits". The reporters made by `under` share `best`.
    """

    report: Progress
    prefix: str = ""
    best: list[float] = field(default_factory=lambda: [math.inf])

    def __call__(self, stage: str, done: int, total: int, best: float = math.inf) -> None:
        """Report that `done` of `total` parts of a stage are finished; `best` is an error found in it."""
        if math.isfinite(best):
            self.best[0] = min(self.best[0], best)
        self.report(f"{self.prefix}{stage}", done, total, self.best[0])

    def interrupted(self) -> None:
        """Report that an interrupt has been handled; a progress bar would raise it again."""
        with suppress(KeyboardInterrupt):
            self("interrupted", 0, 0)

    def under(self, prefix: str) -> Stages:
        """Make a reporter for an inner search; it shares the smallest error."""
        return Stages(self.report, f"{prefix}{self.prefix}", self.best)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a function (stage, done, total, best error) that shows the progress while the context lasts.

    It shows the current stage, its finished parts, the smallest error of all stages, and the time since the context
    began. It raises KeyboardInterrupt if Ctrl-C was pressed and CasADi swallowed the exception.
    """
    state = _State()
    with (
        repeated_interrupt() as repeat,
        _draw_bar(state) if sys.stderr.isatty() else nullcontext(_print_lines(state)) as show,
    ):

        def report(stage: str, done: int, total: int, best: float) -> None:
            state.best = min(state.best, best) if math.isfinite(best) else state.best
            show(stage, done, total)
            repeat()

        yield report


def shown_progress(progress: Progress | bool | None) -> AbstractContextManager[Progress | None]:
    """Return a context that yields a progress bar for True, or the given callable or None; refuse anything else."""
    if progress is not None and not isinstance(progress, bool) and not callable(progress):
        raise InputError(f"progress = {progress!r} was given; give True, or a function of (stage, done, total, error).")
    return progress_bar() if progress is True else nullcontext(progress or None)


@dataclass
class _State:
    """The smallest error so far, and the start of the work in seconds of the monotonic clock."""

    best: float = math.inf
    began: float = field(default_factory=lambda: time.monotonic())

    def text(self) -> str:
        """Describe the smallest error, if there is one, and the time."""
        seconds = int(time.monotonic() - self.began)
        duration = f"{seconds} s" if seconds < 60 else f"{seconds // 60} min {seconds % 60:02d} s"
        return f"best NRMSE {self.best:.4f}, {duration}" if math.isfinite(self.best) else duration


Show = Callable[[str, int, int], None]


def _print_lines(state: _State) -> Show:
    """Print a line after the first step of a stage, about every ten seconds, and after its last step.

    A count of zero is left out. Quick stages print nothing.
    """
    stages: set[str] = set()
    ended: set[str] = set()
    last_line = state.began

    def show(stage: str, done: int, total: int) -> None:
        nonlocal last_line
        now = time.monotonic()
        complete, pending = 0 < total <= done, done == 0 < total
        last_step = complete and stage in stages and stage not in ended
        if not last_step and now - last_line < (LINE if stage in stages or pending else NEW_STAGE_LINE):
            return
        stages.add(stage)
        if complete:
            ended.add(stage)
        last_line = now
        parts = [f"{stage} {_count(done, total) if done else ''}".rstrip(), state.text()]
        print(", ".join(part for part in parts if part), file=sys.stderr, flush=True)

    return show


@contextmanager
def _draw_bar(state: _State) -> Iterator[Show]:
    """Draw one bar, for the current stage."""
    from rich import progress as rich
    from rich.console import Console
    from rich.text import Text

    class StateColumn(rich.ProgressColumn):
        """The smallest error and the time, which advances even if a stage reports nothing."""

        def render(self, task: rich.Task) -> Text:
            return Text(state.text())

    columns: list[Any] = [rich.TextColumn("{task.description}"), rich.BarColumn()]
    columns += [rich.TextColumn("{task.fields[count]}"), StateColumn()]
    with rich.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, count="", visible=False)

        def show(stage: str, done: int, total: int) -> None:
            count = _count(done, total)
            bar.update(task, description=stage, completed=done, total=total or None, count=count, visible=True)

        yield show


def _count(done: int, total: int) -> str:
    return f"{done}/{total}" if total else ""
