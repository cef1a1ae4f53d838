"""Progress of long work on the terminal (silent where stderr is not one)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int, float], None]]:
    """A callable (stage, done, total, smallest error) that moves a bar while the context lasts."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[best]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int, best: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, best="")
            known = f"best NRMSE {best:.4f}" if math.isfinite(best) else ""
            bar.update(tasks[stage], completed=done, total=total, best=known)

        yield report
