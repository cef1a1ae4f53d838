"""An exported model: one step over a whole sample, `(x, u) -> (x_next, y)`, with names, units and start state.

A model advances by sub-steps and may read the input at the sub-step's end and the time (`Model.reads`). Here the
sub-steps of a sample run in turn, and y is the output at the first. `u` is the input, constant over the sample; if
inputs are interpolated, it also holds the next sample's input. If the equations read the time, the time is the last
entry of x and advances by itself.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers, path_text, write_atomically
from ..data import COURSES, Recording, name_with_unit
from ..models import ParameterSet
from ..simulators import calls_external
from .c_code import make_unique, write_c
from .fmu import FmuContent, write_fmu
from .smoothing import enclose, smooth_kinks

FORMAT, VERSION = "pilfr_casadi function", 1
NAMES = ".names.json"  # appended to the function's file name for the file with the names
LISTED_MEMORY = 6  # memories of a law up to which each is listed by name
INLINE = 4  # sub-steps written out one after the other; more become a loop, which keeps generated C short


class CheckedStep(ca.Function):
    """`(x, u) -> (x_next, y)`, called with numbers or symbols of exactly these sizes, or with several columns of them.

    A plain `casadi.Function` broadcasts one number to a whole state and replaces a missing argument by zero, which
    hides a loop that has lost its state.

    Raises
    ------
    InputError
        In a call, if x or u is missing or has another size.
    """

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Check the arguments and return the function's values."""
        arguments = dict(zip(("x", "u"), given, strict=False)) | named
        if len(given) + len(named) != 2 or set(arguments) != {"x", "u"}:
            raise InputError(f"A step of {self.name()} needs x and u; give both, as in step(x, u).")
        for i, (name, role) in enumerate((("x", "state"), ("u", "input"))):
            size, shape = int(self.size1_in(i)), _shape(arguments[name])
            if not _fits(shape, size):
                count = f"the shape {shape}" if shape else "none" if shape is None else "one number"
                wanted = "1 entry" if size == 1 else f"{size} entries"
                raise InputError(f"The {role} {name} of a step of {self.name()} has {wanted}; {count} was given.")
        return super().__call__(*given, **named)


def _shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of an array of numbers or symbols; None for anything else."""
    if isinstance(value, ca.DM | ca.SX | ca.MX):
        return tuple(value.shape)
    try:
        return None if value is None else np.asarray(value, dtype=float).shape
    except (TypeError, ValueError):
        return None


def _fits(shape: tuple[int, ...] | None, size: int) -> bool:
    if shape is None or len(shape) > 2:
        return False
    if shape == () or size == 0:
        return int(np.prod(shape)) == size
    return shape[0] == size or shape == (1, size)


@dataclass(frozen=True, eq=False)
class Exported:
    """One step of a model, `(x, u) -> (x_next, y)`, in engineering units; operator memory is inside x.

    Attributes
    ----------
    step : casadi.Function
        x (n_x,) and u (n_u,) to x_next (n_x,) and y (n_y,); y belongs to the same sample as x and u. Called from Python
        it refuses other sizes (`CheckedStep`).
    name : str
        The function's name.
    states : dict
        Name of each entry of x -> its index: linear states, then the operators' memory `memory[i,j]` of channel i and
        threshold r[i,j]. For a simulator: its states, then the laws' states, `<port>.q1`, and their memory,
        `<port>.memory1`. `time`, in s, comes last if the equations read it.
    thresholds : dict
        Name of a memory -> half-width of its play or stop, in units of its driving signal.
    inputs, outputs : tuple of str
        Names of the entries of u and y. If inputs are interpolated, u also holds the next inputs, `<input>_next`.
    units : dict
        Known units by name.
    dt : float
        Duration of a step, s.
    smooth : float
        eps of the rounding (`smoothing`); 0 for exact min and max.
    rhs : casadi.Function or None
        `(x, u) -> (xdot, y)`, or `(x, u, t) -> (xdot, y)`, if the model has equations in continuous time.
    start : array, (n_x,), or None
        State that `x0()` returns; None for zero.
    hold : {"zero", "linear", "next"}
        Inter-sample behaviour of the inputs for which the step was made; `drive` collects them from a recording.
    reads : tuple of str
        Signals in `row`, in this order: "u" the inputs, "next" the inputs at the sub-step's end, "t" the time.
    substeps : int
        Number of sub-steps in a step.
    memory_names : tuple of str
        States that are memory of operators, without the shift registers of delays, which move at every step.
    parametric : casadi.Function
        An exact sub-step of scalar expressions, `(x, row, p) -> (x_next, y)`.
    parameters : ParameterSet
        The entries of p with their values.
    """

    parametric: ca.Function
    parameters: ParameterSet
    reads: tuple[str, ...]
    substeps: int
    dt: float
    states: dict[str, int]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    thresholds: dict[str, float]
    memory_names: tuple[str, ...]
    name: str = "model"
    smooth: float = 0.0
    start: np.ndarray | None = None
    units: dict[str, str] = field(default_factory=dict)
    rhs: ca.Function | None = None
    hold: str = "zero"

    @cached_property
    def one(self) -> ca.Function:
        """The sub-step `(x, row) -> (x_next, y)` with the values of the parameters as constants."""
        x, row = (self.parametric.sx_in(i) for i in range(2))
        found = self.parametric(x, row, ca.DM(self.parameters.start))
        return ca.Function("one", [x, row], [ca.densify(e) for e in found], ["x", "row"], ["x_next", "y"])

    @cached_property
    def step(self) -> CheckedStep:
        """The function `(x, u) -> (x_next, y)`."""
        x, u, x_next, y = self._over_sample(self.one)
        return CheckedStep(ca.Function(self.name, [x, u], [x_next, y], ["x", "u"], ["x_next", "y"]))

    def step_with_parameters(self, name: str) -> ca.Function:
        """Make the function `(x, u, p) -> (x_next, y)`; p (n_p,) is the vector of `parameters`."""
        p = (ca.SX if self.substeps <= INLINE else ca.MX).sym("p", self.parameters.size)
        x, u, x_next, y = self._over_sample(self.parametric, p)
        return ca.Function(name, [x, u, p], [x_next, y], ["x", "u", "p"], ["x_next", "y"])

    def _over_sample(self, one: ca.Function, *p: Any) -> tuple[Any, Any, Any, Any]:
        """Run the sub-steps of a sample; return x, u and the expressions of x_next and y."""
        one = smooth_kinks(one, self.smooth) if self.smooth else one
        own = len(self.states) - self.timed
        kind = ca.SX if self.substeps <= INLINE else ca.MX
        x, u = kind.sym("x", len(self.states)), kind.sym("u", len(self.inputs))
        t = x[own] if self.timed else kind(0)
        rows = self._rows(u, t, ca.vertcat)
        if kind is ca.SX:
            state, y = one(x[:own], rows[0], *p)
            for row in rows[1:]:
                state = one(state, row, *p)[0]
        else:
            first = one(x[:own], rows[0], *p)
            run = one.mapaccum(self.substeps - 1)
            state, y = run(first[0], ca.horzcat(*rows[1:]), *p)[0][:, -1], first[1]
        state = ca.vertcat(state, t + self.dt) if self.timed else state
        return x, u, ca.densify(state), ca.densify(y)

    @property
    def timed(self) -> bool:
        """Whether the last entry of x is the time, s."""
        return "t" in self.reads

    @property
    def interpolated(self) -> bool:
        """Whether the second half of u holds the inputs of the next sample."""
        return "next" in self.reads

    def drive(self, recording: Recording) -> np.ndarray:
        """Collect the inputs of the steps along a recording with the model's channels and units, (M, n_u).

        They are the recording's inputs; with `hold="next"` those of the next sample, which act until then; where inputs
        are interpolated, both.
        """
        if self.interpolated:
            return np.hstack([recording.u, recording.u_next])
        return recording.u_next if COURSES[self.hold].begin else recording.u

    def x0(self) -> np.ndarray:
        """Return the start state, (n_x,): `start` if it was given, else zero."""
        return np.zeros(len(self.states)) if self.start is None else self.start.copy()

    def bound(self, x: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """Bound the error of one smoothed step from x and u, in x_next (n_x,) and in y (n_y,).

        With plays or stops in a PI-LFR, y is off by at most `|D_yw| Σ_j w_j eps/2`, the linear states by at most
        `|B_w| Σ_j w_j eps/2`, and the memory of a play by at most eps/2. See `smoothing`.

        Raises
        ------
        InputError
            If x or u has another size or is not finite, or an operation in the equations has no known enclosure.
        """
        x, u = numbers(x, "The state").ravel(), numbers(u, "The input").ravel()
        for role, given, wanted in (("state", x, len(self.states)), ("input", u, len(self.inputs))):
            if given.size != wanted:
                raise InputError(f"{given.size} numbers were given for the {role}; expected {wanted}.")
        one, own = self.one, len(x) - self.timed
        rows = self._rows(u, x[own] if self.timed else 0.0, lambda *columns: np.hstack([np.zeros(0), *columns]))
        exact, enclosure = x[:own], [(v, v) for v in x[:own]]
        output_errors = []
        for row in rows:
            enclosure, y_enclosure = enclose(one, self.smooth, enclosure, [(v, v) for v in row])
            exact, y_exact = (np.asarray(part).ravel() for part in one(exact, row))
            output_errors.append(_largest_error(y_enclosure, y_exact))
        return np.append(_largest_error(enclosure, exact), np.zeros(int(self.timed))), output_errors[0]

    def _rows(self, u: Any, t: Any, stack: Any) -> list[Any]:
        """List the rows that the sub-steps read, for inputs u and time t; `stack` joins signals."""
        n, count = self.substeps, len(self.inputs) // 2 if self.interpolated else len(self.inputs)
        now, after = u[:count], u[count:]
        out = []
        for i in range(n):
            columns = {"t": t + i * self.dt / n, "u": now}
            if self.interpolated:
                columns["u"] = now + (after - now) * (i / n)
                columns["next"] = now + (after - now) * ((i + 1) / n)
            out.append(stack(*(columns[name] for name in self.reads)))
        return out

    def _refuse_external_calls(self) -> None:
        """Refuse to write a step that calls another program."""
        if calls_external(self.one):
            raise InputError(
                "The equations call another program (an FMU or a Python function), which no file can hold; use "
                "`pilfr_casadi.exported` in Python, whose `step` runs them in the same process."
            )

    def names(self) -> dict[str, Any]:
        """Return names, units, step and start state as plain JSON."""
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
            "x0": self.x0().tolist(),
        }

    def serialize(self, path: str | os.PathLike[str]) -> Path:
        """Write the function for `casadi.Function.load`, and names, units, dt and start state to `<path>.names.json`.

        Both files can be read without this package.

        Raises
        ------
        InputError
            If a file cannot be written, or the equations call another program.
        """
        self._refuse_external_calls()
        text = json.dumps(self.names(), indent=1, allow_nan=False) + "\n"
        write_atomically(f"{path_text(path, 'file')}{NAMES}", text)
        with tempfile.TemporaryDirectory() as folder:
            function = Path(folder) / "function"
            self.step.save(str(function))
            return write_atomically(path, function.read_bytes())

    def to_c(self, folder: str | os.PathLike[str]) -> tuple[Path, Path]:
        """Write `<name>.c` and `<name>.h` into a folder: C99 that needs only the C library's mathematics.

        The header declares `<name>_step(x, u, x_next, y)` and `<name>_x0(x)` with sizes and indices as constants.

        Returns
        -------
        tuple of Path
            Source and header.

        Raises
        ------
        InputError
            If the folder cannot be made or written, or the equations call another program.
        """
        self._refuse_external_calls()
        return write_c(folder, self.step, self.names(), self.interpolated)

    def to_fmu(self, path: str | os.PathLike[str], fmi: str = "2.0") -> Path:
        """Write a co-simulation FMU for this platform, with its C source inside.

        A communication step is one sample of `dt` seconds, or several. Fixed parameters of the model are `fixed` in the
        FMU; the others are `tunable` within their bounds. States, with the memory of hysteresis, are the variables
        `state.<name>`: their start values can be set before the initialisation, and the FMU's state saves them. If
        inputs are interpolated, `der(<input>)` is the slope of an input from this sample to the next one; in FMI 2.0
        `fmi2SetRealInputDerivatives` sets it too.

        Parameters
        ----------
        path : path
            File whose name ends in `.fmu`.
        fmi : {"2.0", "3.0"}
            Version of the standard (https://fmi-standard.org).

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If there is no working C compiler, the file cannot be written, or the equations call another program.
        """
        self._refuse_external_calls()
        time = len(self.states) - 1 if self.timed else None
        step = self.step_with_parameters(f"{self.name.rstrip('_')}_casadi")
        return write_fmu(path, FmuContent(step, self.names(), self.parameters, self.interpolated, time), fmi)

    def to_control(self) -> Any:
        """Return the model as a `control.NonlinearIOSystem` in discrete time; dots in names become underscores.

        `control.input_output_response(system, t, u, X0=exported.x0())` runs it, with t in steps of `dt`.
        """
        import control

        def step(x: Any, u: Any) -> Any:
            return self.step(np.atleast_1d(x), np.atleast_1d(u))

        def without_dots(names: Iterable[str]) -> tuple[str, ...]:
            return make_unique(name.replace(".", "_") for name in names)

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
        def list_names(names: Iterable[str]) -> str:
            return ", ".join(name_with_unit(n, self.units.get(n, "")) for n in names) or "none"

        exact = f"smoothed, eps = {self.smooth:g}" if self.smooth else "min and max exact"
        lines = [f"{self.name}: (x, u) -> (x_next, y), a step of {self.dt:g} s, {exact}"]
        memory = [name for name in self.states if re.fullmatch(r".*memory\d+", name)]
        counts = Counter(name.rstrip("0123456789") for name in memory)
        states = [name for name in self.states if counts[name.rstrip("0123456789")] <= LISTED_MEMORY]
        states += [f"{name}1..{n} ({n} states)" for name, n in counts.items() if n > LISTED_MEMORY]
        lines += [f"x: {list_names(states)}", f"u: {list_names(self.inputs)}", f"y: {list_names(self.outputs)}"]
        lines.append(f"rhs in continuous time: {'none, it is sampled' if self.rhs is None else 'yes'}")
        return "\n".join(lines)

    __repr__ = __str__


def _largest_error(enclosure: list[tuple[float, float]], exact: np.ndarray) -> np.ndarray:
    """Compute the largest distance of an enclosure's ends from the exact values."""
    ends = np.array(enclosure, dtype=float).reshape(-1, 2)
    return np.maximum(np.maximum(ends[:, 1] - exact, exact - ends[:, 0]), 0.0)
