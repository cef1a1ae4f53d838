"""The recording: sampled inputs and outputs of one experiment, checked once where data enters.

A :class:`Recording` holds ``M`` samples of ``n_u`` inputs and ``n_y`` outputs on one uniform time grid, and says what a
simulation of it has to know besides: the state it starts from, what the input does between the samples, whether it is
periodic, and how many leading samples are not scored. It never changes once made; everything behind the door trusts it.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from .._base import InputError, listed, signal

__all__ = ["InputError", "Recording", "as_recordings", "check_for_identification", "fingerprint", "listed"]
SAME_STEP = (
    1e-4  # recordings fitted together may differ by this share in `dt` (a time column is written with few digits)
)


HOLDS = ("zero", "linear", None)
INITIALS = ("zero", "estimate", "periodic")


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Sampled inputs and outputs of one experiment; immutable.

    Parameters
    ----------
    u : array, (M, n_u) or (M,)
        Inputs at the samples. Copied; stored as a read-only (M, n_u) array.
    y : array, (M, n_y) or (M,)
        Outputs at the same samples. Copied; stored as a read-only (M, n_y) array. (M, 0) where none was measured:
        such a recording serves as the input of a simulation and is refused by every fit.
    dt : float
        Time from one sample to the next, in seconds.
    inputs, outputs : tuple of str
        Names of the columns; ``u`` or ``u1, u2, ...`` and ``y`` or ``y1, y2, ...`` where left out.
    units : mapping of str to str
        Unit by column name, for figures and reports; columns may be missing.
    period : int, optional
        Samples per period, when the recording is in periodic steady state from sample `skip` on.
    initial : {"estimate", "zero", "periodic"} or array, (nx,)
        State at the first sample: to be estimated, zero, that of the periodic steady state, or given. The memory of an
        operator that never slips in a period is not unique in steady state: periods from rest with zero memory lead to
        the one that is taken, and a fit says so.
    hold : {"zero", "linear"}, optional
        What the input does between the samples: held, or interpolated. ``None`` means not said.
    skip : int
        Leading samples that are simulated but not scored.
    name : str
        Name for messages, tables and figures.

    Raises
    ------
    InputError
        When a value is not a finite real number, or lengths, shapes, names or options do not fit together.
    """

    u: np.ndarray
    y: np.ndarray
    dt: float
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    period: int | None = None
    initial: str | np.ndarray = "estimate"
    hold: str | None = None
    skip: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        u, inputs = signal(self.u, self.inputs, "u", "input", self.label)
        y, outputs = signal(self.y, self.outputs, "y", "output", self.label, none=True)
        if len(u) != len(y):
            raise InputError(
                f"{self.label} has {len(u)} samples of u but {len(y)} of y; give arrays of shape (samples, channels) "
                "with the same number of samples."
            )
        if len(u) < 2:
            raise InputError(
                f"{self.label} has {len(u)} sample(s) and at least 2 are needed; arrays are (samples, channels), "
                "so transpose them if they lie the other way."
            )
        twice = sorted(set(inputs) & set(outputs))
        if twice:
            raise InputError(f"{self.label} names {twice[0]!r} both as an input and as an output; give it one role.")
        strange = sorted(set(self.units) - {*inputs, *outputs})
        if strange:
            raise InputError(
                f"{self.label} gives a unit for {strange[0]!r}; its columns are {listed(inputs + outputs)}."
            )
        check_options(self, len(u))
        initial = self.initial
        if not isinstance(initial, str):
            initial = initial_state(initial, self.label)
        units = MappingProxyType(dict(self.units))
        clean = dict(u=u, y=y, dt=float(self.dt), inputs=inputs, outputs=outputs, units=units, initial=initial)
        for key, value in clean.items():
            object.__setattr__(self, key, value)

    def __reduce__(self) -> tuple[Any, ...]:
        values = [getattr(self, f.name) for f in fields(self)]
        return Recording, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @property
    def begins(self) -> str:
        """What is known of the state at the first sample: "zero", "estimate", "periodic", or "given" as numbers."""
        return self.initial if isinstance(self.initial, str) else "given"

    @property
    def label(self) -> str:
        """How messages call this recording."""
        return f"recording {self.name!r}" if self.name else "the recording"

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return self.u.shape[1]

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return self.y.shape[1]

    @property
    def t(self) -> np.ndarray:
        """Time of the samples from zero on, (M,), in seconds."""
        return np.arange(len(self)) * self.dt

    def __len__(self) -> int:
        return len(self.u)

    def __repr__(self) -> str:
        def channels(names: tuple[str, ...]) -> str:
            return ", ".join(f"{n} [{self.units[n]}]" if n in self.units else n for n in names)

        head = f"Recording {self.name!r}" if self.name else "Recording"
        text = f"{head}: {len(self)} samples, dt {self.dt:.6g} s ({len(self) * self.dt:.4g} s), "
        text += f"inputs {channels(self.inputs)}, outputs {channels(self.outputs) or 'none'}"
        extras = {"period": self.period, "hold": self.hold, "skip": self.skip or None}
        initial = self.begins
        shown = [f"initial {initial}", *(f"{key} {value}" for key, value in extras.items() if value is not None)]
        return f"<{text}, {', '.join(shown)}>"

    def with_(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced, checked anew."""
        return replace(self, **changes)

    def slice(self, start: int | None = None, stop: int | None = None) -> Self:
        """Return the samples from `start` up to `stop`, counted as in a Python slice.

        The state at a later first sample is not the one given for the old first sample, so ``initial`` becomes
        ``"estimate"`` there; ``"periodic"`` stays where a whole period is left.

        Raises
        ------
        InputError
            When fewer than two samples are left.
        """
        first, last, _ = slice(start, stop).indices(len(self))
        if last - first < 2:
            raise InputError(
                f"samples {first} to {last} of {self.label}, which has {len(self)}, are fewer than 2; cut a longer one."
            )
        skip = max(self.skip - first, 0) if self.skip < last else 0
        period = self.period if (self.period or 0) <= last - first - skip else None
        periodic = self.begins == "periodic"
        keeps = period is not None if periodic else first == 0
        initial = self.initial if keeps else "estimate"
        return replace(self, u=self.u[first:last], y=self.y[first:last], period=period, skip=skip, initial=initial)

    def split(self, fraction: float) -> tuple[Self, Self]:
        """Cut in two: the first `fraction` (between 0 and 1) of the samples, and the rest; see :meth:`slice`."""
        if not 0 < fraction < 1:
            raise InputError(f"{self.label} cannot be split at {fraction}; give a fraction between 0 and 1.")
        cut = round(fraction * len(self))
        return self.slice(0, cut), self.slice(cut, None)


def as_recordings(data: "Recording | Iterable[Recording]") -> tuple[Recording, ...]:
    """Take one recording or several, return a tuple.

    Raises
    ------
    InputError
        When there is none, or something else than a recording among them.
    """
    if isinstance(data, Recording):
        return (data,)
    if not isinstance(data, Iterable):
        raise InputError(f"a Recording or a list of them is needed, not {type(data).__name__}; read_csv makes one.")
    recordings = tuple(data)
    for item in recordings:
        if not isinstance(item, Recording):
            raise InputError(f"every item must be a Recording, not {type(item).__name__}; read_csv makes one.")
    if not recordings:
        raise InputError("no recording was given; give at least one.")
    return recordings


def fingerprint(recording: Recording) -> str:
    """Short digest of a recording's numbers and of what is said about its initial state."""
    initial = recording.initial
    kind = f"{initial} {recording.period}".encode() if isinstance(initial, str) else np.asarray(initial).tobytes()
    return hashlib.sha256(recording.u.tobytes() + recording.y.tobytes() + kind).hexdigest()[:16]


def check_for_identification(data: Recording | Iterable[Recording], n_min: int = 2) -> tuple[Recording, ...]:
    """Check that recordings can be fitted together and carry something to fit; return them as a tuple.

    Parameters
    ----------
    data : Recording or iterable of Recording
        What is to be fitted.
    n_min : int
        Smallest number of scored samples over all recordings, e.g. the number of free parameters.

    Raises
    ------
    InputError
        When outputs are missing, names or steps differ, samples are too few, every input or an output is constant.
    """
    recordings = as_recordings(data)
    first = recordings[0]
    for r in recordings:
        if not r.n_y:
            raise InputError(f"{r.label} has no outputs, so nothing can be fitted to it; name the measured columns.")
    for other in recordings[1:]:
        for key in ("inputs", "outputs"):
            a, b = getattr(first, key), getattr(other, key)
            if a != b:
                raise InputError(
                    f"{other.label} has the {key} {listed(b)} and {first.label} has {listed(a)}; "
                    "recordings fitted together need the same, in the same order."
                )
        if abs(other.dt - first.dt) > SAME_STEP * first.dt:
            raise InputError(
                f"{other.label} has a step of {other.dt:g} s and {first.label} one of {first.dt:g} s; "
                "resample them to one step before fitting them together."
            )
    scored = sum(len(r) - r.skip for r in recordings)
    if scored < n_min:
        raise InputError(
            f"there are {scored} scored samples in {len(recordings)} recording(s), but at least {n_min} are needed; "
            "record longer or choose a smaller model."
        )
    if not any(_varies(r.u[:, i]) for r in recordings for i in range(r.n_u)):
        still = "s {} never change" if first.n_u > 1 else " {} never changes"
        raise InputError(
            f"the input{still.format(listed(first.inputs))} in {listed([r.label for r in recordings])}; "
            "nothing can be identified without excitation."
        )
    for i, name in enumerate(first.outputs):
        if not any(_varies(r.y[r.skip :, i]) for r in recordings):
            raise InputError(
                f"the output {name!r} never changes in {listed([r.label for r in recordings])}; check the sensor "
                "or leave this output out."
            )
    return recordings


def _varies(x: np.ndarray) -> bool:
    return bool(np.ptp(x) > 1e-12 * np.max(np.abs(x)))


def initial_state(values: Any, label: str) -> np.ndarray:
    """Return the state at the first sample as a read-only vector."""
    try:
        state = np.array(values, dtype=float)
    except (TypeError, ValueError):
        state = np.empty(0)
    if state.ndim != 1 or state.size == 0 or not np.isfinite(state).all():
        raise InputError(
            f"the initial state of {label} must be a vector of finite numbers, or one of {listed(INITIALS)}."
        )
    state.setflags(write=False)
    return state


def check_options(r: Recording, m: int) -> None:
    """Check the step, `hold`, `initial`, `skip` and `period` of a recording of `m` samples."""
    if not isinstance(r.dt, (int, float, np.number)) or not math.isfinite(r.dt) or r.dt <= 0:
        raise InputError(
            f"{r.label} has a step dt of {r.dt!r}; give the seconds from one sample to the next, above zero."
        )
    if r.hold not in HOLDS:
        raise InputError(f"hold of {r.label} is {r.hold!r}; give 'zero', 'linear' or None.")
    if isinstance(r.initial, str) and r.initial not in INITIALS:
        raise InputError(f"initial of {r.label} is {r.initial!r}; give one of {listed(INITIALS)}, or the state itself.")
    if not _is_count(r.skip) or not 0 <= r.skip < m:
        raise InputError(f"{r.label} was given skip={r.skip!r}; give a number of samples from 0 to {m - 1}.")
    if r.period is not None and (not _is_count(r.period) or not 2 <= r.period <= m - r.skip):
        raise InputError(
            f"{r.label} was given period={r.period!r}; it must be a whole number of samples from 2 to {m - r.skip}, so "
            "that one period lies after the skipped samples."
        )
    if r.begins == "periodic" and r.period is None:
        raise InputError(f"{r.label} was given initial='periodic' but no period; set period=SAMPLES.")


def _is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
