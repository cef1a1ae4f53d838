"""A functional mock-up unit as a CasADi function, and functions that call it, evaluated in a process of the unit.

With a C compiler the unit is an external function of CasADi: a small library, which asks a process of the unit in the
user's process, and calls the unit in a process of the unit. So a function of CasADi that calls the unit can be sent
there with all the points at which it is wanted (`map_points`, `accumulate_steps`). Without a compiler the unit is a
callback of CasADi, which cannot be sent, and each evaluation takes a message and its reply.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, abandoned, build
from ..models import accumulate_steps as accumulate_here, map_points as map_here
from .external import Program, programs, units
from .external_buffers import EXTERNAL_CALLS, bind
from .fmu_instance import FmuSignals
from .fmu_process import evaluate_in_unit, run_in_unit

MOST_LOSSES = 3  # processes that a point's parameters may end before they count as failed
KEPT_FUNCTIONS = 64  # functions of CasADi that are kept for further points
_ASK = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
LIBRARY = """
void (*pilfr_ask)(const double *z, double *r);
static const long long shapes[][3] = {{{shapes}}};

long long {name}_n_in(void) {{ return {n_in}; }}
long long {name}_n_out(void) {{ return 1; }}
const long long *{name}_sparsity_in(long long i) {{ return shapes[i]; }}
const long long *{name}_sparsity_out(long long i) {{ return shapes[{n_in}]; }}

int {name}(const double **arg, double **res, long long *iw, double *w, int mem) {{
  static const long sizes[] = {{{sizes}}};
  double z[{size} + 1] = {{0}}, r[{results} + 1], *at = z;
  int i;
  if (externals) return call_external(0, arg, res);
  for (i = 0; i < {n_in}; at += sizes[i++])
    if (arg[i]) memcpy(at, arg[i], sizes[i] * sizeof(double));
  pilfr_ask(z, r);
  if (res[0]) memcpy(res[0], r, {results} * sizeof(double));
  return 0;
}}
"""


class FmuFunction:
    """A unit as a `casadi.Function` `(t, x, u, p) -> (derivatives, outputs)`; if it fails, its results are NaN.

    Attributes
    ----------
    function : casadi.Function
    failure : str
        How its process failed first.
    """

    def __init__(self, name: str, signals: FmuSignals) -> None:
        self.signals, self.failure = signals, ""
        self._losses: dict[bytes, int] = {}  # lost processes by parameter values
        self._ask = _ASK(self._answer)
        units[name] = signals
        try:
            self.function: ca.Function = _external_function(name, signals, self._ask)
        except InputError:  # no compiler
            self.function = _Callback(name, signals, self.evaluate)

    def _answer(self, z: int, result: int) -> None:
        """Evaluate one point, for the library."""
        found = np.full(self.signals.results, np.nan)
        try:
            found = self.evaluate(ctypes.string_at(z, 8 * sum(self.signals.sizes)))
        except KeyboardInterrupt:  # C cannot raise it; it is raised after the run
            abandoned.mark()
        finally:
            ctypes.memmove(result, found.ctypes.data, found.nbytes)

    def evaluate(self, z: bytes) -> np.ndarray:
        """Evaluate one point in a process of the unit.

        The unit is not called in an abandoned run or by a diverged simulation, nor again with parameters at which it
        has ended `MOST_LOSSES` processes.
        """
        point, none = np.frombuffer(z), np.full(self.signals.results, np.nan)
        if abandoned.pending or not math.isfinite(point.sum()):
            return none
        parameters = point[len(point) - self.signals.sizes[3] :].astype(np.float32).tobytes()
        if self._losses.get(parameters, 0) >= MOST_LOSSES:
            return none
        found, failure = evaluate_in_unit(self.signals, z)
        if found is not None:
            return found
        if not abandoned.pending:  # else an interrupt has ended the process
            self._losses[parameters] = self._losses.get(parameters, 0) + 1
            self.failure = self.failure or failure
        return none


class _Callback(Program):
    """A unit as a callback of CasADi."""

    def __init__(self, name: str, signals: FmuSignals, evaluate: Callable[[bytes], np.ndarray]) -> None:
        self._evaluate = evaluate
        super().__init__(name, signals.sizes, signals.results)

    def eval_buffer(self, arguments: list[memoryview], results: list[memoryview]) -> int:
        """Evaluate one point, for CasADi."""
        np.frombuffer(results[0])[:] = self._evaluate(b"".join(bytes(a) for a in arguments))
        return 0


def _external_function(name: str, signals: FmuSignals, ask: Any) -> ca.Function:
    """Make the external function of a unit, which calls `ask` in this process."""
    shapes = ", ".join(f"{{{n}, 1, 1}}" for n in (*signals.sizes, signals.results))
    sizes = ", ".join(map(str, signals.sizes))
    numbers = {"n_in": len(signals.sizes), "size": sum(signals.sizes), "results": signals.results}
    source = EXTERNAL_CALLS + LIBRARY.format(name=name, shapes=shapes, sizes=sizes, **numbers)
    library = build(source)
    ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "pilfr_ask").value = ctypes.cast(ask, ctypes.c_void_p).value
    _libraries[name] = library, source
    return ca.external(name, str(library))


_libraries: dict[str, tuple[Path, str]] = {}  # of external functions, by name, with their sources


def map_points(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Evaluate a function at K points as `models.map_points` does, in a process of the unit that it calls, if any."""
    found = _run_elsewhere(map_here, function, arguments)
    return found if found is not None else map_here(function, *arguments)


def accumulate_steps(function: ca.Function, state: np.ndarray, *arguments: np.ndarray) -> list[np.ndarray]:
    """Run K steps of a function as `models.accumulate_steps` does, in a process of the unit that it calls, if any."""
    found = _run_elsewhere(accumulate_here, function, (state, *arguments))
    return found if found is not None else accumulate_here(function, state, *arguments)


def _run_elsewhere(
    run: Callable[..., list[np.ndarray]], function: ca.Function, arguments: tuple[np.ndarray, ...]
) -> list[np.ndarray] | None:
    """Run a function in a process of the unit that it calls; None if it calls none, or the process is lost.

    Where the process is lost, single evaluations tell at which points.
    """
    name = _called_unit(function)
    if not name:
        return None
    library, source = _libraries[name]
    if not library.exists():  # the cache has dropped it; the same source gives the same file again
        build(source)
    job = run, _serialized(function), name, units[name], library, arguments
    found: list[np.ndarray] | None = run_in_unit(units[name], _run_here, job)[0]
    return found


@functools.lru_cache(maxsize=KEPT_FUNCTIONS)
def _called_unit(function: ca.Function) -> str:
    """Return the name of the unit that a function calls, or "" if it calls none, or programs that cannot be sent."""
    names = [f.name() for f in function.find_functions()]
    return next((n for n in names if n in _libraries), "") if programs.keys().isdisjoint(names) else ""


@functools.lru_cache(maxsize=KEPT_FUNCTIONS)
def _serialized(function: ca.Function) -> str:
    return str(function.serialize())


@functools.lru_cache(maxsize=KEPT_FUNCTIONS)
def _deserialized(text: str) -> ca.Function:
    return ca.Function.deserialize(text)


def _run_here(
    run: Callable[..., list[np.ndarray]],
    text: str,
    name: str,
    signals: FmuSignals,
    library: Path,
    arguments: tuple[np.ndarray, ...],
) -> list[np.ndarray]:
    """Run a function in this process, of the unit that it calls."""
    units[name] = signals
    function = _deserialized(text)
    bind(ctypes.CDLL(str(library)), (name,))
    return run(function, *arguments)
