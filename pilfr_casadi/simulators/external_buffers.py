"""Memory by which compiled C calls other programs: arguments are copied in, results out.

`_external.h` has the other side. Each thread has buffers of its own.
"""

from __future__ import annotations

import ctypes
import functools
import threading
from pathlib import Path
from typing import Any

import numpy as np

from .._base import abandoned, build
from .external import PythonFunction, programs, units
from .fmu_instance import evaluation

EXTERNAL_CALLS = Path(__file__).with_name("_external.h").read_text(encoding="utf-8")


class _External(ctypes.Structure):
    """`external_t` of `_external.h`."""

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


def bind(library: ctypes.CDLL, names: tuple[str, ...]) -> None:
    """Pass this thread's buffers of programs to a library's `pilfr_bind`; all libraries of a thread share them.

    `names` are keys of `external.programs` in the order of the calls.
    """
    table = (_External * len(names))(*(_buffer(name) for name in names))
    library.pilfr_bind(table)
    _thread.table = table  # the library reads it until the next call


_thread = threading.local()


def _buffer(name: str) -> _External:
    buffers = _thread.__dict__.setdefault("buffers", {})
    if name not in buffers:
        buffers[name] = _make_buffer(name)
    found: _External = buffers[name][0]
    return found


def _make_buffer(name: str) -> tuple[_External, list[object]]:
    """Make a buffer with memory for arguments and results; return it and everything that must stay alive."""
    if name not in units:
        function = programs[name]
        assert isinstance(function, PythonFunction)
        return _make_python_buffer(function)
    signals = units[name]
    found = evaluation(signals)
    address = ctypes.addressof(found.structure)
    arguments, results = (found.arguments, list(signals.sizes)), ([found.result], [signals.results])
    made, tables = _fill_structure(_unit_caller(), address, arguments, results)
    return made, [found, tables]


def _make_python_buffer(function: PythonFunction) -> tuple[_External, list[object]]:
    """Make a buffer by which generated C calls a Python function directly."""
    arguments = [np.zeros(n) for n in function.sizes]
    result = np.zeros(function.size)

    def evaluate(_: int | None) -> None:
        try:
            result[:] = function.evaluate(arguments)
        except KeyboardInterrupt:  # C cannot raise it; the engine does after the run
            result[:] = np.nan
            abandoned.mark()

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
def _unit_caller() -> int | None:
    """Build the function that evaluates a functional mock-up unit; return its address."""
    library = ctypes.CDLL(str(build(Path(__file__).with_name("_fmu.c").read_text(encoding="utf-8"))))
    return ctypes.cast(library.fmu_evaluate, ctypes.c_void_p).value
