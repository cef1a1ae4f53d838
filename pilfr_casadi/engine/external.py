"""Generated C that calls other programs (`simulators.leaves`), for which CasADi cannot write code.

CasADi leaves a gap where a function is a program of its own. `fill_gaps` fills it with a call of a buffer, and `bind`
passes the buffers of a thread to a library. A functional mock-up unit is called only in a process of its own, which
runs the whole library.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import io
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._base import abandoned
from ..simulators import PythonFunction, evaluation, leaves, units

HEAD = r"(/\* (?P<name>\w+):\([^\n]*\n[^\n]*\{\n)"  # comment and first line of a generated function
GAP = re.compile(HEAD + r" *#error Code generation not supported[^\n]*\n *return 0;")
CALL = re.compile(HEAD + r" *return call_external\(")
GAP_WARNING = "cannot be code generated"


class _External(ctypes.Structure):
    """`external_t` of `_fill_structure.h`."""

    _fields_ = [
        ("evaluate", ctypes.c_void_p),
        ("buffer", ctypes.c_void_p),
        ("n_arg", ctypes.c_long),
        ("n_res", ctypes.c_long),
        ("arg", ctypes.POINTER(ctypes.c_void_p)),
        ("res", ctypes.POINTER(ctypes.c_void_p)),
        ("arg_size", ctypes.POINTER(ctypes.c_long)),
        ("res_size", ctypes.POINTER(ctypes.c_long)),
    ]


def fill_gaps(code: str) -> str:
    """Let the gaps in generated code call the programs of `leaves`."""
    numbers: dict[str, int] = {}
    return GAP.sub(
        lambda gap: f"{gap[1]}  return call_external({numbers.setdefault(gap['name'], len(numbers))}, arg, res);", code
    )


def external_names(code: str) -> tuple[str, ...]:
    """List the programs that filled code calls, by their number in the calls."""
    return tuple(dict.fromkeys(found["name"] for found in CALL.finditer(code)))


@contextlib.contextmanager
def suppress_gap_warnings() -> Iterator[None]:
    """Suppress CasADi's warnings about these gaps; print all other messages afterwards."""
    screen, messages = sys.stderr, io.StringIO()
    with contextlib.redirect_stderr(messages):
        yield
    for line in messages.getvalue().splitlines():
        if GAP_WARNING not in line:
            print(line, file=screen)


def bind(library: ctypes.CDLL, names: tuple[str, ...], build: Callable[[str], Path]) -> None:
    """Pass this thread's buffers of programs to a library's `pilfr_bind`; all libraries of a thread share them.

    `names` are keys of `leaves` in the order of the calls; `build` compiles C source and returns the library's path.
    """
    table = (_External * len(names))(*(_buffer(name, build) for name in names))
    library.pilfr_bind(table)
    _thread.table = table  # the library reads it until the next call


_thread = threading.local()


def _buffer(name: str, build: Callable[[str], Path]) -> _External:
    buffers = _thread.__dict__.setdefault("buffers", {})
    if name not in buffers:
        buffers[name] = _make_buffer(name, build)
    found: _External = buffers[name][0]
    return found


def _make_buffer(name: str, build: Callable[[str], Path]) -> tuple[_External, list[object]]:
    """Make a buffer with memory for arguments and results; return it and everything that must stay alive."""
    if name not in units:
        function = leaves[name]
        assert isinstance(function, PythonFunction)
        return _make_python_buffer(function)
    signals = units[name]
    found = evaluation(signals)
    address = ctypes.addressof(found.structure)
    arguments, results = (found.arguments, list(signals.sizes)), ([found.result], [signals.results])
    made, tables = _fill_structure(_unit_caller(build), address, arguments, results)
    return made, [found, tables]


def _make_python_buffer(function: PythonFunction) -> tuple[_External, list[object]]:
    """Make a buffer by which generated C calls a Python function directly."""
    arguments = [np.zeros(n) for n in function.sizes]
    result = np.zeros(function.size)

    def evaluate(_: int | None) -> None:
        try:
            result[:] = function.evaluate(arguments)
        except KeyboardInterrupt:  # C cannot raise it; the engine does after the run
            result[:], abandoned.pending = np.nan, True

    callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(evaluate)
    address = ctypes.cast(callback, ctypes.c_void_p).value
    made, tables = _fill_structure(address, 0, (arguments, list(function.sizes)), ([result], [function.size]))
    return made, [callback, arguments, result, tables]


def _fill_structure(
    evaluate: int | None,
    buffer: int,
    arguments: tuple[list[np.ndarray], list[int]],
    results: tuple[list[np.ndarray], list[int]],
) -> tuple[_External, list[object]]:
    """Fill the structure; return it and its tables, which must stay alive."""
    tables: list[Any] = [(ctypes.c_void_p * len(a))(*(m.ctypes.data for m in a)) for a, _ in (arguments, results)]
    tables += [(ctypes.c_long * len(n))(*n) for _, n in (arguments, results)]
    return _External(evaluate, buffer, len(arguments[1]), len(results[1]), *tables), tables


@functools.cache
def _unit_caller(build: Callable[[str], Path]) -> int | None:
    """Build the function that evaluates a functional mock-up unit; return its address."""
    library = ctypes.CDLL(str(build(Path(__file__).with_name("_fmu.c").read_text(encoding="utf-8"))))
    return ctypes.cast(library.fmu_evaluate, ctypes.c_void_p).value
