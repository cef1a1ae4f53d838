"""The recording: sampled inputs and outputs of one experiment, checked once where data enters.

A :class:`Recording` holds ``M`` samples of ``n_u`` inputs and ``n_y`` outputs on one uniform time grid, and everything
else that a simulation needs: the initial state, the input between the samples, the period, and the number of leading
samples that are not scored. It is immutable, and all code that receives one trusts it.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from .._base import REPAIR, InputError, is_number, is_whole, later, listed, positive, real_array, usable
from .columns import name_with_unit
from .holds import becomes_mean, hold_at, known_hold
from .preprocessing import butterworth, change_step, remove_trend
from .units import conversion

SAME_STEP = 1e-4  # relative difference up to which two steps count as the same; written times have few digits
LONGEST_STEP = 1e30  # s, and its inverse the shortest one: rates are squared, and no experiment is outside
INITIALS = ("zero", "estimate", "periodic")


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Sampled inputs and outputs of one experiment; immutable.

    Parameters
    ----------
    u : array, (M, n_u) or (M,)
        Inputs at the samples. Copied; stored as a read-only (M, n_u) array. (M, 0) is a recording without inputs, such
        as a free decay; it suits a simulator without inputs.
    y : array, (M, n_y) or (M,)
        Outputs at the same samples. Copied; stored as a read-only (M, n_y) array. With (M, 0), no measured output, a
        recording can be simulated but not fitted.
    dt : float
        Time from one sample to the next, in seconds.
    inputs, outputs : tuple of str
        Names of the columns; by default ``u`` or ``u1, u2, ...`` and ``y`` or ``y1, y2, ...``.
    units : mapping of str to str
        Unit by column name, for figures and reports; not every column needs one.
    period : int, optional
        Samples per period, if the recording is in periodic steady state from sample `skip` on.
    initial : {"estimate", "zero", "periodic"} or array, (nx,)
        State at the first sample: estimated, zero, periodic steady state, or given as numbers. In steady state the
        memory of an operator that never slips in a period is not unique; the memory reached from rest with zero memory
        is used, and `fit` reports this.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        Input between the samples: held, interpolated linearly, without content above half the sampling rate, as
        behind an anti-alias filter, or at the value of the later sample, as in logs of means over the interval that
        ends at each time. ``None`` leaves it open.
    skip : int
        Leading samples that are simulated but not scored.
    name : str
        Name for messages, tables and figures.
    start : float
        Time of the first sample in seconds, for equations and laws that read the time; a piece cut out of a recording
        keeps that recording's time.

    Raises
    ------
    InputError
        If a value is not a finite real number, or lengths, shapes, names or options do not fit together.
    """

    u: np.ndarray
    y: np.ndarray = None  # type: ignore[assignment]  # required; `_signal` reports its absence
    dt: float = None  # type: ignore[assignment]  # required too
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    period: int | None = None
    initial: str | np.ndarray = "estimate"
    hold: str | None = None
    skip: int = 0
    name: str = ""
    start: float = 0.0

    def __post_init__(self) -> None:
        u, inputs = _channels(self.u, self.inputs, "u", "input", self.label)
        y, outputs = _channels(self.y, self.outputs, "y", "output", self.label)
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
        both = sorted(set(inputs) & set(outputs))
        if both:
            raise InputError(f"{self.label} names {both[0]!r} both as an input and as an output; give it one role.")
        _check_options(self, len(u))
        for name in self.units:
            if name not in inputs + outputs:
                raise InputError(f"{self.label} gives a unit for {name!r}; its columns are {listed(inputs + outputs)}.")
        initial = self.initial
        if not isinstance(initial, str):
            initial = _initial_state(initial, self.label)
        units = MappingProxyType(dict(self.units))
        clean = dict(u=u, y=y, dt=float(self.dt), inputs=inputs, outputs=outputs, units=units, initial=initial)
        for key, value in clean.items():
            object.__setattr__(self, key, value)

    def __reduce__(self) -> tuple[Any, ...]:
        values = [getattr(self, f.name) for f in fields(self)]
        return Recording, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @property
    def begins(self) -> str:
        """Kind of initial state: "zero", "estimate", "periodic", or "given" if it is numbers."""
        return self.initial if isinstance(self.initial, str) else "given"

    @property
    def label(self) -> str:
        """Name of this recording in messages."""
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

    @property
    def clock(self) -> np.ndarray:
        """Time of the samples from `start` on, (M,), in seconds, which equations and laws read."""
        return self.start + self.t

    @property
    def wraps(self) -> bool:
        """Whether it repeats in whole periods, so that the last period's first sample follows the last sample."""
        return self.period is not None and len(self) % self.period == 0

    @property
    def u_next(self) -> np.ndarray:
        """Inputs of the next samples, (M, n_u); without a period the last sample follows itself."""
        return self._one_later(self.u)

    @property
    def y_next(self) -> np.ndarray:
        """Outputs of the next samples, (M, n_y); see `u_next`."""
        return self._one_later(self.y)

    def _one_later(self, values: np.ndarray) -> np.ndarray:
        after = values[len(self) - self.period] if self.period and self.wraps else values[-1]
        return np.vstack([values[1:], after])

    def __len__(self) -> int:
        return len(self.u)

    def __repr__(self) -> str:
        def channels(names: tuple[str, ...]) -> str:
            return ", ".join(name_with_unit(n, self.units.get(n, "")) for n in names) or "none"

        head = f"Recording {self.name!r}" if self.name else "Recording"
        text = f"{head}: {len(self)} samples, dt {self.dt:.6g} s ({len(self) * self.dt:.4g} s), "
        text += f"inputs {channels(self.inputs)}, outputs {channels(self.outputs)}"
        extras = {"period": self.period, "hold": self.hold, "skip": self.skip or None}
        initial = self.begins
        shown = [f"initial {initial}", *(f"{key} {value}" for key, value in extras.items() if value is not None)]
        return f"<{text}, {', '.join(shown)}>"

    def plot(self) -> Any:
        """Draw every channel over time and over frequency.

        Returns
        -------
        matplotlib.figure.Figure
        """
        return later("plots.plot_recording")(self)

    def _repr_html_(self) -> str:
        return str(later("report.recording_card")(self))

    def with_(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced; it is checked again."""
        return replace(self, **changes)

    def in_units(self, wanted: Mapping[str, str]) -> Self:
        """Convert channels to other units; channels whose unit is unknown, here or in `wanted`, stay as they are.

        Parameters
        ----------
        wanted : mapping of str to str
            Units by channel, such as the `units` of a simulator.

        Raises
        ------
        InputError
            If a unit measures something else.
        """
        factors = {name: self.factor_to(wanted, name) for name in (*self.inputs, *self.outputs)}
        changed = {name: wanted[name] for name, factor in factors.items() if factor != 1}
        if not changed:
            return self
        u, y = (v * [factors[n] for n in own] for v, own in ((self.u, self.inputs), (self.y, self.outputs)))
        return replace(self, u=u, y=y, units={**self.units, **changed})

    def in_order(self, inputs: Sequence[str], outputs: Sequence[str]) -> Self:
        """Return the recording with these of its channels alone, in this order."""
        if (self.inputs, self.outputs) == (tuple(inputs), tuple(outputs)):
            return self
        u, y = self.u[:, list(map(self.inputs.index, inputs))], self.y[:, list(map(self.outputs.index, outputs))]
        units = {name: unit for name, unit in self.units.items() if name in (*inputs, *outputs)}
        return replace(self, u=u, y=y, inputs=tuple(inputs), outputs=tuple(outputs), units=units)

    def factor_to(self, wanted: Mapping[str, str], name: str) -> float:
        """Return the factor from a channel's unit to the wanted one; 1 if a unit or the conversion is unknown."""
        unit, other = self.units.get(name, ""), wanted.get(name, "")
        factor = conversion(unit, other)
        if factor is not None and np.isnan(factor):
            raise InputError(
                f"{self.label} has {name!r} in {unit}, and the simulator has it in {other}; give the values in "
                f"{other}, or correct the unit that is wrong."
            )
        return 1.0 if factor is None else factor

    def slice(self, start: int | None = None, stop: int | None = None) -> Self:
        """Return the samples from `start` up to `stop`, counted as in a Python slice.

        A piece that begins later has another initial state, so its ``initial`` becomes ``"estimate"``; ``"periodic"``
        is kept if a whole period is left.

        Raises
        ------
        InputError
            If a number is not whole, or fewer than two samples are left.
        """
        for value, name in ((start, "start"), (stop, "stop")):
            if value is not None and not is_whole(value, -np.inf):
                raise InputError(f"{name}={value!r} was given; give the number of a sample, or use cut for seconds.")
        first, last, _ = slice(start, stop).indices(len(self))
        if last - first < 2:
            raise InputError(
                f"samples {first} to {last} of {self.label}, which has {len(self)}, are fewer than 2; cut a longer one."
            )
        skip = max(self.skip - first, 0) if self.skip < last else 0
        period = self.period if (self.period or 0) <= last - first - skip else None
        keeps_initial = period is not None if self.begins == "periodic" else first == 0
        initial = self.initial if keeps_initial else "estimate"
        return replace(
            self,
            u=self.u[first:last],
            y=self.y[first:last],
            period=period,
            skip=skip,
            initial=initial,
            start=self.start + first * self.dt,
        )

    def split(self, fraction: float) -> tuple[Self, Self]:
        """Cut in two: the first `fraction` (between 0 and 1) of the samples, and the rest; see :meth:`slice`."""
        if not (is_number(fraction) and 0 < fraction < 1):
            raise InputError(f"{self.label} cannot be split at {fraction!r}; give a fraction between 0 and 1.")
        cut = round(fraction * len(self))
        return self.slice(0, cut), self.slice(cut, None)

    def cut(self, start: float | None = None, stop: float | None = None) -> Self:
        """Return the samples from `start` up to `stop`, both in seconds after the first sample; see :meth:`slice`.

        Raises
        ------
        InputError
            If a time is not a number within the recording, or fewer than two samples are left.
        """
        last = len(self) * self.dt
        for value, name in ((start, "start"), (stop, "stop")):
            if value is not None and not (is_number(value) and 0 <= value <= last * (1 + SAME_STEP)):
                raise InputError(f"{name}={value!r} was given; {self.label} lasts from 0 to {last:g} s.")
        first, after = (None if v is None else round(v / self.dt) for v in (start, stop))
        return self.slice(first, after)

    def detrend(self, kind: str = "constant", channels: Sequence[str] | str | None = None) -> Self:
        """Subtract the mean (`"constant"`) or a straight line (`"linear"`) from all channels or from `channels`.

        A linear or a PI-LFR model is fitted about a working point. A simulator needs the original signals, because the
        working point of a nonlinear machine belongs to its physics. An initial state of zero or given as numbers
        becomes invalid and is estimated.

        Raises
        ------
        InputError
            If the kind or a channel is unknown.
        """
        return self._edit_channels(lambda values: remove_trend(values, kind), channels)

    def filter(
        self,
        cutoff: float | tuple[float, float],
        kind: str = "lowpass",
        order: int = 4,
        channels: Sequence[str] | str | None = None,
    ) -> Self:
        """Filter all channels, or `channels`, forwards and backwards, which cancels the phase.

        If inputs and outputs are filtered alike, a linear model still relates them. A model with hysteresis or friction
        does not: its memory turns at the extremes of the signal, which a filter rounds off. For such a model filter
        only above the band in which the machine moves, and use no high-pass. A filtered input is no longer held
        between samples, so `hold="zero"` becomes `"linear"`. An initial state of zero or given as numbers becomes
        invalid and is estimated.

        Parameters
        ----------
        cutoff : float, or two floats for a band
            Frequency in Hz where the gain is one half.
        kind : {"lowpass", "highpass", "bandpass", "bandstop"}
        order : int
            Order of the Butterworth filter, which runs twice.
        channels : names, optional
            By default all inputs and outputs.

        Raises
        ------
        InputError
            If a cutoff is not below the Nyquist frequency, there are too few samples, or a name is unknown.
        """
        edited = self._edit_channels(lambda values: butterworth(values, self.dt, cutoff, kind, order), channels)
        smooth = self.hold == "zero" and set(self._select(channels)) & set(self.inputs)
        return replace(edited, hold="linear" if smooth else self.hold)

    def resample(self, dt: float) -> Self:
        """Resample to another step in seconds; an anti-alias filter precedes a longer step.

        If `hold` is `"zero"` and the levels of the inputs usually last at least a new step, an input becomes its mean
        over each new step, and is held; else it becomes `"linear"`. If `hold` is `"next"`, an input becomes its mean
        over the new step that ends at each sample, as a slower logger writes it. `skip` covers the same time as
        before. A period that is not a whole number of new samples is dropped.

        Raises
        ------
        InputError
            If the step is not a positive number, or too long.
        """
        positive(dt, "dt", "the new step in seconds")
        u, y = (change_step(values, self.dt, dt) for values in (self.u, self.y))
        if u is self.u:
            return self
        hold = self.hold
        if self.n_u and all(becomes_mean(hold, self.t, column, dt) for column in self.u.T):
            times = np.arange(len(u)) * dt
            u = np.column_stack([hold_at(self.t, column, times, dt, hold) for column in self.u.T])
        elif self.n_u and hold == "zero":
            hold = "linear"
        skip = min(int(np.ceil(self.skip * self.dt / dt * (1 - SAME_STEP))), len(u) - 2)
        period = round((self.period or 0) * self.dt / dt)
        whole = period >= 2 and abs(period * dt - (self.period or 0) * self.dt) < SAME_STEP * dt
        kept = period if whole and period <= len(u) - skip else None
        initial = "estimate" if self.begins == "periodic" and kept is None else self.initial
        return replace(self, u=u, y=y, dt=dt, skip=skip, period=kept, initial=initial, hold=hold)

    def to_frame(self) -> Any:
        """Return a pandas `DataFrame` with a column for each input and output over the index `t`, in seconds.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        try:
            from pandas import DataFrame, Index
        except ImportError:
            raise InputError("pandas is not installed; install it with `pip install pilfr-casadi[frames]`.") from None
        names = (*self.inputs, *self.outputs)
        return DataFrame(np.hstack([self.u, self.y]), columns=list(names), index=Index(self.t, name="t"))

    def _edit_channels(self, edit: Callable[[np.ndarray], np.ndarray], channels: Sequence[str] | str | None) -> Self:
        """Return a copy with some channels edited; its initial state is estimated unless it is periodic."""
        every = (*self.inputs, *self.outputs)
        chosen = self._select(channels)
        for name in chosen:
            if name not in every:
                raise InputError(f"{self.label} has no channel {name!r}; it has {listed(every)}.")
        values = np.hstack([self.u, self.y])
        where = [every.index(name) for name in chosen]
        if where:
            values[:, where] = edit(values[:, where])
        initial = self.initial if self.begins == "periodic" else "estimate"
        return replace(self, u=values[:, : self.n_u], y=values[:, self.n_u :], initial=initial)

    def _select(self, channels: Sequence[str] | str | None) -> tuple[str, ...]:
        """Return the given channels as a tuple of names; None stands for all of them."""
        return (*self.inputs, *self.outputs) if channels is None else as_tuple(channels)


def as_tuple(given: Any) -> tuple[Any, ...]:
    """Return one object or several as a tuple; a text is one object."""
    try:
        return (given,) if isinstance(given, str) else tuple(given)
    except TypeError:
        return (given,)


def default_names(letter: str, n: int) -> tuple[str, ...]:
    """Return the names of n signals that have none, such as ("u",) or ("u1", "u2")."""
    return (letter,) if n == 1 else tuple(f"{letter}{i + 1}" for i in range(n))


def as_recordings(data: "Recording | Iterable[Recording]") -> tuple[Recording, ...]:
    """Return one recording or several as a tuple.

    Raises
    ------
    InputError
        If there is none, or one of them is not a recording.
    """
    recordings: tuple[Any, ...] = (data,)
    if isinstance(data, Iterable) and not isinstance(data, Mapping | np.ndarray):
        recordings = tuple(data)
    for item in recordings:
        if not isinstance(item, Recording):
            raise InputError(
                f"give a Recording or a list of them, not {type(item).__name__}; Recording(u, y, dt) makes one "
                "from arrays, read_csv from a file."
            )
    if not recordings:
        raise InputError("no recording was given; give at least one.")
    return recordings


def fingerprint(recording: Recording) -> str:
    """Return a short digest of a recording's numbers, its initial state, and the time at which it starts."""
    initial = recording.initial
    kind = f"{initial} {recording.period}".encode() if isinstance(initial, str) else np.asarray(initial).tobytes()
    kind += f" {recording.start!r}".encode() if recording.start else b""
    return hashlib.sha256(recording.u.tobytes() + recording.y.tobytes() + kind).hexdigest()[:16]


def check_for_identification(
    data: Recording | Iterable[Recording], n_min: int = 2, excited: bool = True
) -> tuple[Recording, ...]:
    """Check that recordings can be fitted together, and return them as a tuple.

    They need outputs that change, the same names and step, samples of their own, and together `n_min` scored samples,
    such as the number of free parameters. With `excited`, at least one input has to change.
    """
    recordings = as_recordings(data)
    labels = _distinct_labels(recordings)
    first = recordings[0]
    for label, r in zip(labels, recordings, strict=True):
        if not r.n_y:
            raise InputError(f"{label} has no outputs, so nothing can be fitted to it; name the measured columns.")
    for label, other in zip(labels[1:], recordings[1:], strict=True):
        for key in ("inputs", "outputs"):
            a, b = getattr(first, key), getattr(other, key)
            if a != b:
                raise InputError(
                    f"{label} has the {key} {listed(b)} and {labels[0]} has {listed(a)}; "
                    "recordings fitted together need the same, in the same order."
                )
        if abs(other.dt - first.dt) > SAME_STEP * first.dt:
            raise InputError(
                f"{label} has a step of {other.dt:g} s and {labels[0]} one of {first.dt:g} s; "
                "resample them to one step before fitting them together."
            )
    scored = sum(len(r) - r.skip for r in recordings)
    if scored < n_min:
        raise InputError(
            f"there are {scored} scored samples in {len(recordings)} recording(s), but at least {n_min} are needed; "
            "record longer or choose a smaller model."
        )
    if excited and moves_freely(recordings):
        raise InputError(
            f"{_name_inputs(first.inputs)} in {listed(labels)}; a model from input to output needs an input that "
            "changes. For a decay or a coast-down, use a simulator, with `pilfr diagnose` or `fit` in Python."
        )
    for i, name in enumerate(first.outputs):
        if not any(_varies(r.y[r.skip :, i]) for r in recordings):
            raise InputError(
                f"the output {name!r} never changes in {listed(labels)}; check the sensor or leave this output out."
            )
    seen = dict[str, str]()
    for label, r in zip(labels, recordings, strict=True):
        if (first_label := seen.setdefault(fingerprint(r), label)) != label:
            raise InputError(f"{label} holds the same samples as {first_label}; leave one of them out.")
    return recordings


def moves_freely(recordings: Sequence[Recording]) -> bool:
    """Tell whether no input ever changes, so that motion comes from the starts alone, as in a decay."""
    return not any(_varies(column) for r in recordings for column in r.u.T)


def _distinct_labels(recordings: Sequence[Recording]) -> list[str]:
    """Return the recordings' names in messages, with a number, from 1 on, where several have the same or none."""
    counts = Counter(r.name for r in recordings)
    return [
        r.label if counts[r.name] == 1 else f"recording {number}" + (f" ({r.name!r})" if r.name else "")
        for number, r in enumerate(recordings, 1)
    ]


def _name_inputs(inputs: Sequence[str]) -> str:
    """Say that the inputs never change, or that there are none."""
    if not inputs:
        return "there is no input"
    return f"the inputs {listed(inputs)} never change" if len(inputs) > 1 else f"the input {inputs[0]} never changes"


def _varies(x: np.ndarray) -> bool:
    return bool(np.ptp(x) > 1e-12 * np.max(np.abs(x)))


def _channels(values: Any, names: Any, letter: str, role: str, label: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a signal as a read-only (M, n) copy, and its names; n may be zero."""
    array = _signal(values, letter, label)
    n = array.shape[1]
    names = as_tuple(names)
    if not names and n:
        names = default_names(letter, n)
    if len(names) != n:
        raise InputError(f"{label} has {n} {role} column(s) but {len(names)} name(s) {listed(names)}; give one each.")
    if not all(isinstance(name, str) and name for name in names) or len(set(names)) != n:
        raise InputError(f"the {role} names {names} of {label} must be texts, distinct and not empty.")
    unusable = ~usable(array)
    if unusable.any():
        k, i = np.argwhere(unusable)[0]
        raise InputError(f"sample {k} of {role} {names[i]!r} in {label} is {array[k, i]}; {REPAIR}.")
    array.setflags(write=False)
    return array, names


def _signal(values: Any, letter: str, label: str) -> np.ndarray:
    """Return a copy of the samples as (M, n) floats."""
    if values is None:
        raise InputError(f"{label} lacks {letter}; give Recording(u, y, dt) with arrays of shape (samples, channels).")
    if isinstance(values, Mapping):
        raise InputError(
            f"{letter} of {label} is a {type(values).__name__} with the keys {listed(list(values))}; give one array of "
            "shape (samples, channels), with numpy.column_stack for several channels."
        )
    if hasattr(values, "toarray"):
        raise InputError(f"{letter} of {label} is a sparse matrix; give a full array, from its method toarray().")
    array = real_array(values)
    if array is None:
        raise InputError(f"{letter} of {label} is not an array of real numbers; give one of shape (samples, channels).")
    if array.ndim not in (1, 2):
        raise InputError(
            f"{letter} of {label} has the shape {array.shape}; give an array of shape (samples, channels), and "
            "a recording for each experiment."
        )
    return array[:, None] if array.ndim == 1 else array


def _initial_state(values: Any, label: str) -> np.ndarray:
    """Return the state at the first sample as a read-only vector."""
    state = real_array(values)
    if state is None or state.ndim != 1 or state.size == 0 or not np.isfinite(state).all():
        raise InputError(
            f"the initial state of {label} must be a vector of finite numbers, or one of {listed(INITIALS)}."
        )
    state.setflags(write=False)
    return state


def _check_options(r: Recording, m: int) -> None:
    """Check the step, `start`, `hold`, `initial`, `skip` and `period` of a recording of `m` samples."""
    positive(r.dt, f"{r.label}: dt", "the seconds from one sample to the next")
    if not 1 / LONGEST_STEP <= r.dt <= LONGEST_STEP:
        raise InputError(
            f"{r.label} was given dt={r.dt:g}; give seconds from {1 / LONGEST_STEP:g} to {LONGEST_STEP:g}."
        )
    if not (is_number(r.start) and np.isfinite(r.start)):
        raise InputError(f"start of {r.label} is {r.start!r}; give the time of its first sample in seconds.")
    known_hold(r.hold, f"hold of {r.label}")
    if isinstance(r.initial, str) and r.initial not in INITIALS:
        raise InputError(f"initial of {r.label} is {r.initial!r}; give one of {listed(INITIALS)}, or the state itself.")
    if not is_whole(r.skip, 0, m - 1):
        raise InputError(f"{r.label} was given skip={r.skip!r}; give a number of samples from 0 to {m - 1}.")
    if r.period is not None and not is_whole(r.period, 2, m - r.skip):
        raise InputError(
            f"{r.label} was given period={r.period!r}; it must be a whole number of samples from 2 to {m - r.skip}, so "
            "that one period lies after the skipped samples."
        )
    if r.begins == "periodic" and r.period is None:
        raise InputError(f"{r.label} was given initial='periodic' but no period; set period=SAMPLES.")
    if not isinstance(r.units, Mapping) or not all(isinstance(unit, str) for unit in r.units.values()):
        raise InputError(f"units of {r.label} is {r.units!r}; give a mapping from column to unit, as in {{'u': 'N'}}.")
