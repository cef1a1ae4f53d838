"""An exported model: one step as a CasADi Function, with all that a controller has to know to use it."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from .c_code import write_c
from .files import path_text, write_atomically
from .sampled import Sampled
from .smoothing import enclosed

FORMAT, VERSION = "pilfr_casadi function", 1
NAMES = ".names.json"  # what the file with the names adds to that of the function


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
        `<port>.memory1`; `time`, in s, comes last where the equations know it.
    thresholds : dict
        Name of a memory -> half-width of its play or stop, in units of the signal that drives it.
    inputs, outputs : tuple of str
        What the entries of u and y are. Where inputs are interpolated, those of the next sample follow, `<input>_next`.
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
        """The state to start from, (n_x,): that of the recording the export was asked to start at, else zero."""
        return self.start.copy()

    def bound(self, x: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """How far one smoothed step from x and u can be from the exact one: arrays (n_x,) and (n_y,).

        In a PI-LFR model with plays or stops it is never more than `|D_yw| Σ_j w_j eps/2` for y, and for the linear
        states the same with `|B_w|`; a play's memory is off by at most eps/2. See `smoothing`.

        Raises
        ------
        InputError
            If x or u has another size or is not finite, or the equations hold an operation of which nothing is known.
        """
        x, u = numbers(x, "The state").ravel(), numbers(u, "The input").ravel()
        for what, given, wanted in (("state", x, len(self.states)), ("input", u, len(self.inputs))):
            if given.size != wanted:
                raise InputError(f"{given.size} numbers were given for the {what}; expected {wanted}.")
        one, timed = self.sampled.one, self.sampled.timed
        own = len(x) - timed
        rows = self.sampled.rows(u, x[own] if timed else 0.0, lambda *columns: np.hstack([np.zeros(0), *columns]))
        exact, enclosure = x[:own], [(v, v) for v in x[:own]]
        errors: list[np.ndarray] = []
        for i, row in enumerate(rows):
            found = enclosed(one, self.smooth, enclosure, [(v, v) for v in row])
            true = [np.asarray(part).ravel() for part in one(exact, row)]
            if i == 0:
                errors.append(_reach(found[1], true[1]))
            enclosure, exact = found[0], true[0]
        return np.append(_reach(enclosure, exact), np.zeros(int(timed))), errors[0]

    def names(self) -> dict[str, Any]:
        """All but the function, as plain JSON."""
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
        write_atomically(
            f"{path_text(path, 'file')}{NAMES}", json.dumps(self.names(), indent=1, allow_nan=False) + "\n"
        )
        return write_atomically(path, _saved(self.step))

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
        return write_c(folder, self.step, self.names(), "next" in self.sampled.reads)

    def to_control(self) -> Any:
        """The model as a `control.NonlinearIOSystem` in discrete time; dots in names become underscores.

        `control.input_output_response(system, t, u, X0=exported.x0())` runs it, with t in steps of `dt`.
        """
        import control

        def both(x: Any, u: Any) -> Any:
            return self.step(np.atleast_1d(x), np.atleast_1d(u))

        def named(names: Any) -> list[str]:
            out: list[str] = []
            for name in (n.replace(".", "_") for n in names):
                out.append(next(n for n in (name + k * "_" for k in range(len(out) + 1)) if n not in out))
            return out

        return control.NonlinearIOSystem(
            (lambda t, x, u, params: np.asarray(both(x, u)[0]).ravel()) if self.states else None,
            lambda t, x, u, params: np.asarray(both(x, u)[1]).ravel(),
            inputs=named(self.inputs),
            outputs=named(self.outputs),
            states=named(self.states) if self.states else None,
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


def _reach(enclosure: list[tuple[float, float]], exact: np.ndarray) -> np.ndarray:
    ends = np.array(enclosure, dtype=float).reshape(-1, 2)
    return np.maximum(np.maximum(ends[:, 1] - exact, exact - ends[:, 0]), 0.0)


def _saved(function: ca.Function) -> bytes:
    """What `casadi.Function.save` writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "function"
        function.save(str(path))
        return path.read_bytes()
