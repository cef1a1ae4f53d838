"""Progress of long work on stderr: a bar on a terminal, plain lines anywhere else.

Long work reports to a callable `progress(stage, done, total, best)`: the stage that runs, the parts of it that are
done, their total (0 where it is not known), and the smallest error so far (nan where there is none).
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

NEW_STAGE_LINE = 1.0  # least seconds between plain lines when a new stage begins; quicker work stays silent
LINE = 10.0  # least seconds between other plain lines, the last step of a stage excepted


@dataclass(eq=False)
class Stages:
    """A `Progress` that keeps the smallest error over all stages.

    Attributes
    ----------
    report : callable
        Called with (stage, done, total, smallest error so far).
    prefix : str
        Stands before each stage's name, as in "other hold: fits".
    best : list of float
        The smallest error, shared with the reporters made by `under`.
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
        """Make a reporter for a search inside the search; it shares the smallest error."""
        return Stages(self.report, f"{prefix}{self.prefix}", self.best)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a function (stage, done, total, best error) that shows the progress while the context lasts.

    It shows the stage that runs, the parts done, the smallest error of all stages so far, and the time spent since the
    context began. It raises KeyboardInterrupt if Ctrl-C was pressed and CasADi swallowed the exception.
    """
    shown = _Shown()
    with repeated_interrupt() as repeat, _bar(shown) if sys.stderr.isatty() else nullcontext(_lines(shown)) as show:

        def report(stage: str, done: int, total: int, best: float) -> None:
            shown.best = min(shown.best, best) if math.isfinite(best) else shown.best
            show(stage, done, total)
            repeat()

        yield report


def shown_progress(progress: Progress | bool | None) -> AbstractContextManager[Progress | None]:
    """Make a context whose value work reports to: a progress bar for True, the callable, or None.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if progress is not None and not isinstance(progress, bool) and not callable(progress):
        raise InputError(f"progress = {progress!r} was given; give True, or a function of (stage, done, total, error).")
    return progress_bar() if progress is True else nullcontext(progress or None)


@dataclass
class _Shown:
    """The smallest error so far, and when the work began (seconds of the monotonic clock)."""

    best: float = math.inf
    began: float = field(default_factory=lambda: time.monotonic())

    def best_text(self) -> str:
        return f"best NRMSE {self.best:.4f}" if math.isfinite(self.best) else ""

    def time_text(self) -> str:
        seconds = int(time.monotonic() - self.began)
        return f"{seconds} s" if seconds < 60 else f"{seconds // 60} min {seconds % 60:02d} s"


Show = Callable[[str, int, int], None]


def _lines(shown: _Shown) -> Show:
    """Print a line when a stage has its first step done, about every ten seconds, and when its last step is done.

    A count that stands at zero is left out, and so are all lines of stages that are quick.
    """
    stages: set[str] = set()
    ended: set[str] = set()
    last_line = shown.began

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
        parts = [f"{stage} {_count(done, total) if done else ''}".rstrip(), shown.best_text(), shown.time_text()]
        print(", ".join(part for part in parts if part), file=sys.stderr, flush=True)

    return show


@contextmanager
def _bar(shown: _Shown) -> Iterator[Show]:
    """Draw one bar, of the stage that runs."""
    from rich import progress as rich
    from rich.console import Console
    from rich.text import Text

    class State(rich.ProgressColumn):
        """The smallest error and the time, which goes on when a stage reports nothing."""

        def render(self, task: rich.Task) -> Text:
            return Text(", ".join(part for part in (shown.best_text(), shown.time_text()) if part))

    columns: list[Any] = [rich.TextColumn("{task.description}"), rich.BarColumn()]
    columns += [rich.TextColumn("{task.fields[count]}"), State()]
    with rich.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, count="", visible=False)

        def show(stage: str, done: int, total: int) -> None:
            count = _count(done, total)
            bar.update(task, description=stage, completed=done, total=total or None, count=count, visible=True)

        yield show


def _count(done: int, total: int) -> str:
    return f"{done}/{total}" if total else ""
