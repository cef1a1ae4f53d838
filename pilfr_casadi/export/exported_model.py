"""An exported model: one step as a CasADi function, with everything a controller has to know to use it."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeGuard

import casadi as ca
import numpy as np

from .._base import LARGEST, InputError, is_number, numbers, path_text, write_atomically
from ..data import Recording
from ..engine import make_engine
from ..models import Model
from ..optimise import first_state
from ..simulators import Simulator, choose_substeps, discretise
from .c_code import write_c
from .smoothing import enclosed, smoothed
from .step import Sampled, right_hand_side, sampled

FORMAT, VERSION = "pilfr_casadi function", 1
NAMES = ".names.json"  # appended to the function's file name for the file with the names
LONGEST_NAME = 50  # letters: C tells names apart by their first 63, and the longest ending is "_casadi_release"
DT_TOLERANCE = 1e-4  # relative difference of two steps that are taken as equal, from rounding in files
REST_SAMPLES = 400  # samples of a resting recording from which a simulator's sub-steps are chosen
C_KEYWORDS = frozenset(  # of C and C++
    (  # noqa: SIM905
        "alignas alignof and asm auto bool break case catch char class compl const constexpr continue decltype default "
        "delete do double else enum explicit export extern false float for friend goto if inline int long mutable "
        "namespace new noexcept not nullptr operator or private protected public register reinterpret restrict return "
        "short signed sizeof static struct switch template this throw true try typedef typeid typename union unsigned "
        "using virtual void volatile while xor"
    ).split()
)
C_HEADERS = frozenset(  # of C's library, which a file `<name>.h` would hide
    (  # noqa: SIM905
        "assert complex ctype errno fenv float inttypes iso646 limits locale malloc math memory mex setjmp signal "
        "stdarg stdbool stddef stdint stdio stdlib string strings tgmath threads time uchar unistd wchar wctype"
    ).split()
)


class FittedModel(Protocol):
    """A model with a time step of its own, such as a `Fit`."""

    @property
    def model(self) -> Model:
        """Closed model at its fitted values."""

    @property
    def dt(self) -> float:
        """Duration of a step, s."""

    def initial_state(self, recording: Recording) -> np.ndarray:
        """State with memory at a recording's first sample."""


@dataclass(frozen=True, eq=False)
class Exported:
    """One step of a model, `(x, u) -> (x_next, y)`, in engineering units; operator memory is inside x.

    Attributes
    ----------
    step : casadi.Function
        x (n_x,) and u (n_u,) to x_next (n_x,) and y (n_y,); y belongs to the sample at which x and u are given. Called
        from Python it refuses other sizes (`CheckedStep`).
    states : dict
        Name of each entry of x -> its index: linear states, then the operators' memory `memory[i,j]` of channel i and
        threshold r[i,j]; of a simulator its states, then the laws' own, `<port>.q1`, and their memory,
        `<port>.memory1`; `time`, in s, comes last where the equations read it.
    thresholds : dict
        Name of a memory -> half-width of its play or stop, in units of the signal that drives it.
    inputs, outputs : tuple of str
        Names of the entries of u and y. Where inputs are interpolated, those of the next sample follow, `<input>_next`.
    units : dict
        Unit by name, where it is known.
    dt : float
        Duration of a step, s.
    smooth : float
        eps of the rounding (`smoothing`), 0 where min and max are exact.
    rhs : casadi.Function or None
        `(x, u) -> (xdot, y)`, or `(x, u, t)`, where the model has equations in continuous time.
    """

    step: ca.Function
    start: np.ndarray
    states: dict[str, int]
    thresholds: dict[str, float]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    dt: float
    smooth: float
    rhs: ca.Function | None
    sampled: Sampled

    @property
    def name(self) -> str:
        """The function's name."""
        return str(self.step.name())

    def x0(self) -> np.ndarray:
        """Return the state to start from, (n_x,): that of the recording given as `start`, else zero."""
        return self.start.copy()

    def bound(self, x: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """Bound the difference of one smoothed step from x and u to the exact one: arrays (n_x,) and (n_y,).

        In a PI-LFR model with plays or stops it is never more than `|D_yw| Σ_j w_j eps/2` for y, and for the linear
        states the same with `|B_w|`; a play's memory is off by at most eps/2. See `smoothing`.

        Raises
        ------
        InputError
            If x or u has another size or is not finite, or the equations hold an operation without a known enclosure.
        """
        x, u = numbers(x, "The state").ravel(), numbers(u, "The input").ravel()
        for role, given, wanted in (("state", x, len(self.states)), ("input", u, len(self.inputs))):
            if given.size != wanted:
                raise InputError(f"{given.size} numbers were given for the {role}; expected {wanted}.")
        one, timed = self.sampled.one, self.sampled.timed
        own = len(x) - timed
        rows = self.sampled.rows(u, x[own] if timed else 0.0, lambda *columns: np.hstack([np.zeros(0), *columns]))
        exact, enclosure = x[:own], [(v, v) for v in x[:own]]
        output_error = np.zeros(0)
        for i, row in enumerate(rows):
            found = enclosed(one, self.smooth, enclosure, [(v, v) for v in row])
            true = [np.asarray(part).ravel() for part in one(exact, row)]
            if i == 0:
                output_error = _largest_error(found[1], true[1])
            enclosure, exact = found[0], true[0]
        return np.append(_largest_error(enclosure, exact), np.zeros(int(timed))), output_error

    def names(self) -> dict[str, Any]:
        """Return everything but the function as plain JSON."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "casadi": ca.__version__,
            "name": self.name,
            "dt": self.dt,
            "smooth": self.smooth,
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "states": self.states,
            "thresholds": self.thresholds,
            "units": self.units,
            "x0": self.start.tolist(),
        }

    def serialize(self, path: str | os.PathLike[str]) -> Path:
        """Write the function for `casadi.Function.load`, and names, units, dt and start state as JSON beside it.

        Neither needs this package to be read. The second file is called `<path>.names.json`.

        Raises
        ------
        InputError
            If a file cannot be written.
        """
        text = json.dumps(self.names(), indent=1, allow_nan=False) + "\n"
        write_atomically(f"{path_text(path, 'file')}{NAMES}", text)
        with tempfile.TemporaryDirectory() as folder:
            function = Path(folder) / "function"
            self.step.save(str(function))
            return write_atomically(path, function.read_bytes())

    def to_c(self, folder: str | os.PathLike[str]) -> tuple[Path, Path]:
        """Write `<name>.c` and `<name>.h` into a folder: C99 that needs nothing but the C library's mathematics.

        The header declares `<name>_step(x, u, x_next, y)` and `<name>_x0(x)` with sizes and indices as constants.

        Returns
        -------
        tuple of Path
            Source and header.

        Raises
        ------
        InputError
            If the folder cannot be made or written.
        """
        return write_c(folder, self.step, self.names(), self.sampled.interpolated)

    def to_control(self) -> Any:
        """Return the model as a `control.NonlinearIOSystem` in discrete time; dots in names become underscores.

        `control.input_output_response(system, t, u, X0=exported.x0())` runs it, with t in steps of `dt`.
        """
        import control

        def step(x: Any, u: Any) -> Any:
            return self.step(np.atleast_1d(x), np.atleast_1d(u))

        def without_dots(names: Any) -> list[str]:
            out: list[str] = []
            for name in (n.replace(".", "_") for n in names):
                out.append(next(n for n in (name + k * "_" for k in range(len(out) + 1)) if n not in out))
            return out

        return control.NonlinearIOSystem(
            (lambda t, x, u, params: np.asarray(step(x, u)[0]).ravel()) if self.states else None,
            lambda t, x, u, params: np.asarray(step(x, u)[1]).ravel(),
            inputs=without_dots(self.inputs),
            outputs=without_dots(self.outputs),
            states=without_dots(self.states) if self.states else None,
            dt=self.dt,
            name=self.name,
        )

    def __str__(self) -> str:
        def listed(names: Mapping[str, Any] | tuple[str, ...]) -> str:
            return ", ".join(f"{n} [{self.units[n]}]" if self.units.get(n) else n for n in names) or "none"

        exact = f"smoothed, eps = {self.smooth:g}" if self.smooth else "min and max exact"
        lines = [f"{self.name}: (x, u) -> (x_next, y), a step of {self.dt:g} s, {exact}"]
        lines += [f"x: {listed(self.states)}", f"u: {listed(self.inputs)}", f"y: {listed(self.outputs)}"]
        lines.append(f"rhs in continuous time: {'none, it is sampled' if self.rhs is None else 'yes'}")
        return "\n".join(lines)

    __repr__ = __str__


def exported(
    model: Any,
    *,
    dt: float | None = None,
    hold: str | None = None,
    substeps: int | None = None,
    start: Any = None,
    smooth: float = 0.0,
    name: str = "model",
) -> Exported:
    """Export a model as one step `(x, u) -> (x_next, y)`, with start state, names and units.

    Parameters
    ----------
    model : Fit, Simulator, Model or Diagnosis
        A simulator is taken with the laws in its ports, at its parameters' values; of a diagnosis, the corrected one.
    dt : float
        Duration of a step, s: needed for a simulator and a model; a fit and a diagnosis have theirs.
    hold : {"zero", "linear"}, optional
        Inter-sample behaviour of the inputs, for a simulator; default: its own, else "zero".
    substeps : int, optional
        Runge-Kutta steps a sample, for a simulator; by default chosen from its fastest eigenvalue.
    start : Recording or array, optional
        The state `x0()`: at a recording's first sample, as its `initial` says, or given, with or without memory.
    smooth : float
        eps > 0 rounds min, max, |.| and sign (`smoothing`), for solvers that need derivatives everywhere; the error is
        `Exported.bound`.
    name : str
        Name of the function: up to 50 letters, digits and single underscores, beginning with a letter; no word of C.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        If something is missing or does not fit; one sentence says what.
    """
    _check_name(name)
    if not is_number(smooth) or not 0 <= smooth <= LARGEST:
        raise InputError(
            f"smooth = {smooth!r} was given; give a number, from zero to {LARGEST:g}, in the signals' units."
        )
    if not isinstance(model, Simulator | Model) and not _is_fitted(model):
        if isinstance(model, type) or not callable(getattr(model, "export", None)):
            given = "a class" if isinstance(model, type) else f"a {type(model).__name__}"
            raise InputError(f"{given} was given; give a Fit, a Simulator, a Model or a Diagnosis.")
        if any(option is not None for option in (dt, hold, substeps)):
            raise InputError("A diagnosis has its own step and hold; leave dt, hold and substeps out.")
        corrected: Exported = model.export(name=name, smooth=smooth, start=start)
        return corrected
    rhs = None
    if isinstance(model, Simulator):
        closed, step = _step_of_simulator(model, dt, hold, substeps)
        rhs = right_hand_side(model, f"{name}_rhs")
    else:
        if hold is not None or substeps is not None:
            raise InputError("The model has its own steps; `hold` and `substeps` are for simulators, leave them out.")
        closed, step = _step_of_model(model, dt)
    return Exported(
        step=step.function(name, smoothed(step.one, smooth) if smooth else None),
        start=_start_state(model, closed, step, start),
        states={n: i for i, n in enumerate(step.states)},
        thresholds=step.thresholds,
        inputs=step.inputs,
        outputs=step.outputs,
        units={k: v for k, v in getattr(model, "units", {}).items() if v},
        dt=step.dt,
        smooth=float(smooth),
        rhs=smoothed(rhs, smooth) if rhs is not None and smooth else rhs,
        sampled=step,
    )


def to_casadi(model: Any, name: str = "model", **options: Any) -> ca.Function:
    """Export one step of a model as `casadi.Function (x, u) -> (x_next, y)`, in engineering units.

    Parameters
    ----------
    model : Fit, Simulator, Model or Diagnosis
        The model; its values become constants of the function.
    name : str
        Name of the function: up to 50 letters, digits and single underscores, beginning with a letter; no word of C.
    **options
        Those of `exported`: for a simulator `dt`, `hold`, `substeps`; `smooth`.

    Returns
    -------
    casadi.Function
        `x` (n_x + n_s,) holds the linear states in the order of `fit.model.states`, then the operators' memory: channel
        by channel, and inside a channel in the order of the thresholds `r[i, :]` (the play state, for stops too). `u`
        is (n_u,), `x_next` like `x`, `y` (n_y,). A step takes `fit.dt` s; `fit.initial_state(recording)` is an `x`.
        `exported` gives the same with a map of the states' names, start state and units.

    Raises
    ------
    InputError
        If CasADi does not take the name, or an option does not fit the model.
    """
    return exported(model, name=name, **options).step


def _is_fitted(model: Any) -> TypeGuard[FittedModel]:
    return isinstance(getattr(model, "model", None), Model) and callable(getattr(model, "initial_state", None))


def _step_of_model(model: FittedModel | Model, dt: float | None) -> tuple[Model, Sampled]:
    if isinstance(model, Model):
        return model, sampled(model, _check_duration(dt))
    if dt is not None and dt != model.dt:
        raise InputError(f"dt = {dt!r} was given, but the fit's step is {model.dt:g} s; leave dt out.")
    return model.model, sampled(model.model, model.dt)


def _step_of_simulator(
    model: Simulator, dt: float | None, hold: str | None, substeps: int | None
) -> tuple[Model, Sampled]:
    """Integrate a simulator over one sample."""
    dt, hold = _check_duration(dt), hold or model.hold or "zero"
    if hold not in ("zero", "linear"):
        raise InputError(f"hold = {hold!r} was given; use 'zero' or 'linear'.")
    whole = isinstance(substeps, int | np.integer) and not isinstance(substeps, bool)
    if substeps is not None and not (whole and substeps >= 1):
        raise InputError(f"substeps = {substeps!r} was given; give a whole number, 1 or more.")
    closed = discretise(model, dt, hold, int(substeps or _choose_substeps_at_rest(model, dt)))
    return closed, sampled(closed, dt, model)


def _check_duration(dt: float | None) -> float:
    if not is_number(dt) or not 0 < dt < np.inf:
        raise InputError(f"dt = {dt!r} was given; give the duration of a step in s, above zero.")
    return float(dt)


def _choose_substeps_at_rest(simulator: Simulator, dt: float) -> int:
    """Choose sub-steps a sample from the fastest eigenvalue at rest, at least as many as the laws need."""
    if simulator.discrete:
        return 1
    # a recording needs an input, so a simulator without inputs gets one that its equations do not read
    driven = simulator if simulator.inputs else replace(simulator, inputs=("none",))
    u, y = (np.zeros((REST_SAMPLES, len(names))) for names in (driven.inputs, driven.output_names))
    least = max((getattr(e.law, "substeps", 1) for e in simulator.elements), default=1)
    return max(choose_substeps(driven, [Recording(u, y, dt)]), least)


def _start_state(model: Any, closed: Model, step: Sampled, start: Any) -> np.ndarray:
    """State to start from, (n_x,), of a recording, an array or nothing."""
    n, size = closed.n_state, len(step.states)
    if start is None:
        return np.zeros(size)
    if isinstance(start, Recording):
        if _is_fitted(model):
            state = model.initial_state(start)
        else:
            _check_recording(closed, step, start)
            state = first_state(closed, make_engine(closed), start)
        if not np.all(np.isfinite(state)):
            raise InputError("The state at the recording's first sample is not finite; give another start.")
        return np.append(state, np.zeros(size - n))
    given = numbers(start, "The start state").ravel()
    if given.size not in (len(closed.states), n, size):
        raise InputError(
            f"The start state has {given.size} numbers; give {len(closed.states)} (memory zero) or {size}."
        )
    return np.append(given, np.zeros(size - given.size))


def _check_recording(model: Model, step: Sampled, recording: Recording) -> None:
    if (recording.inputs, recording.outputs) != (model.inputs, model.outputs):
        raise InputError(
            f"The recording has {', '.join((*recording.inputs, *recording.outputs))}, the model "
            f"{', '.join((*model.inputs, *model.outputs))}; they must be the same, in this order."
        )
    if abs(recording.dt / step.dt - 1) > DT_TOLERANCE:
        raise InputError(f"The recording's step is {recording.dt:g} s, that of the export {step.dt:g} s; use one.")


def _check_name(name: Any) -> None:
    """Refuse a function name that CasADi, a file or C does not take."""
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise InputError(
            f"The function name {str(name)[:60]!r} cannot be used; give letters, digits and single underscores."
        )
    if len(name) > LONGEST_NAME:
        raise InputError(f"The function name {name[:20]}... has {len(name)} characters; give at most {LONGEST_NAME}.")
    if name.lower() in C_KEYWORDS | C_HEADERS:
        kind = "a word of C" if name.lower() in C_KEYWORDS else "the name of one of C's headers"
        raise InputError(f"The function name {name!r} is {kind}; give another one.")


def _largest_error(enclosure: list[tuple[float, float]], exact: np.ndarray) -> np.ndarray:
    """Largest distance of an enclosure's ends from the exact values."""
    ends = np.array(enclosure, dtype=float).reshape(-1, 2)
    return np.maximum(np.maximum(ends[:, 1] - exact, exact - ends[:, 0]), 0.0)
