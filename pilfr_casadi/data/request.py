"""What a reader is asked for, checked on its own and against the columns of a file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import InputError, listed
from .timebase import TIME_NAMES, refuse_other_unit, step_of, time_column

Names = Sequence[str] | str


@dataclass(frozen=True)
class Request:
    """What is wanted from a file."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    columns: Mapping[str, str]
    dt: float | None
    time_tolerance: float | None
    options: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not self.inputs:
            raise InputError("a recording needs at least one input; name its column.")
        known = {*self.inputs, *self.outputs, *TIME_NAMES}
        for name in self.columns:
            if name not in known:
                raise InputError(
                    f"a column is given for {name!r}, which is none of the inputs {listed(self.inputs)}, the "
                    f"outputs {listed(self.outputs)}, or t; correct the name."
                )
        if self.dt is not None and not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"dt={self.dt!r} was given; give the seconds from one sample to the next, above zero.")

    def column(self, name: str) -> str:
        """The column of an input, an output or the time."""
        return self.columns.get(name, name)

    def found_in(self, names: Sequence[str]) -> int:
        """How many of the columns that are wanted are among those."""
        return sum(self.column(name) in names for name in (*self.inputs, *self.outputs))

    def locate(self, names: Sequence[str], source: str) -> tuple[str | None, list[str]]:
        """Return the time column, if any, and those of the inputs and outputs."""
        mapped = [self.columns[name] for name in TIME_NAMES if name in self.columns]
        time = time_column(names, mapped[0] if mapped else None, source)
        wanted = [self.column(name) for name in (*self.inputs, *self.outputs)]
        both = sorted({*map(self.column, self.inputs)} & {*map(self.column, self.outputs)})
        if both:
            raise InputError(f"{source}: column {both[0]!r} is taken both for an input and for an output; correct one.")
        for role, column in zip((*self.inputs, *self.outputs), wanted, strict=True):
            if column not in names:
                hint = (
                    f"map it, as in columns={{'{role}': 'COLUMN'}}" if len(names) > 1 else "separate columns by commas"
                )
                raise InputError(f"{source} has no column {column!r}; it has {listed(names)}: {hint}.")
        for name in [*wanted, time] if time else wanted:
            if list(names).count(name) > 1:
                raise InputError(f"{source} has {list(names).count(name)} columns named {name!r}; rename all but one.")
        if time is None and self.dt is None:
            refuse_other_unit(names, source)
            raise InputError(
                f"{source} has no time column; it has {listed(names)}: name one {' or '.join(TIME_NAMES)}, in "
                "seconds, or state the step with dt=STEP."
            )
        return time, wanted

    def step(self, t: np.ndarray | None, time: str | None, source: str, place: Callable[[int], str]) -> float:
        """Seconds from one sample to the next, by the times of a file or as given."""
        if t is None:
            assert self.dt is not None
            return float(self.dt)
        return step_of(t, f"{source}: column {time!r}", place, dt=self.dt, tolerance=self.time_tolerance)


def request_of(
    inputs: Names,
    outputs: Names,
    *,
    columns: Mapping[str, str] | None = None,
    dt: float | None = None,
    time_tolerance: float | None = None,
    **recording_options: Any,
) -> Request:
    """The request that a reader's arguments make; a single name stands for itself."""
    inputs, outputs = ((n,) if isinstance(n, str) else tuple(n) for n in (inputs, outputs))
    return Request(inputs, outputs, dict(columns or {}), dt, time_tolerance, recording_options)
