"""Generated C that calls other programs (`simulators.leaves`), for which CasADi cannot write code.

CasADi leaves a gap where a function is a program of its own. `fill_gaps` fills it with a call of the function's buffer
(`casadi.FunctionBuffer`), and `bind` passes the buffers of a thread to a library. Without CasADi's entry point for
buffers, only the virtual machine can run the model.
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
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .._base import abandoned
from ..simulators import FmuInstance, PythonFunction, leaves, units

ENTRY = "_ZN6casadi21_function_buffer_evalEPv"  # casadi::_function_buffer_eval(void*), as compilers of Unix name it
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


@functools.cache
def entry_point() -> int | None:
    """Find the address of CasADi's function that evaluates a buffer; None if there is none."""
    for suffix in (".so", ".dylib"):
        with contextlib.suppress(OSError, AttributeError):
            library = ctypes.CDLL(str(Path(ca.__file__).with_name(f"libcasadi{suffix}")))
            return ctypes.cast(getattr(library, ENTRY), ctypes.c_void_p).value
    return None


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
    function = leaves[name]
    if name in units and (lease := _Lease.take(name)) is not None:
        n_arg, n_res = ([size(i) for i in range(n)] for n, size in _shapes(function))
        unit = lease.unit
        address = ctypes.addressof(unit.structure)
        made, tables = _fill_structure(_unit_caller(build), address, (unit.arguments, n_arg), (unit.results, n_res))
        return made, [lease, tables]
    if isinstance(function, PythonFunction):
        return _make_python_buffer(function)
    buffer, _ = function.buffer()
    memory = []
    for (count, size), put in zip(_shapes(function), (buffer.set_arg, buffer.set_res), strict=True):
        sizes = [size(i) for i in range(count)]
        arrays = [np.zeros(max(n, 1)) for n in sizes]
        for i, array in enumerate(arrays):
            put(i, array.data)
        memory.append((arrays, sizes))
    get = ctypes.pythonapi.PyCapsule_GetPointer
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    made, tables = _fill_structure(entry_point(), get(buffer._self(), None), *memory)
    return made, [buffer, memory, tables]


class _Lease:
    """An instance of a unit for one thread; after the thread's end another thread takes it."""

    free: ClassVar[dict[str, list[FmuInstance]]] = {}

    def __init__(self, name: str, unit: FmuInstance) -> None:
        self.name, self.unit = name, unit

    @classmethod
    def take(cls, name: str) -> _Lease | None:
        """Take a free instance, or a new one; None if the unit refuses."""
        try:
            return cls(name, cls.free.setdefault(name, []).pop())
        except IndexError:
            unit = units[name].instantiate()
            return None if unit is None else cls(name, unit)

    def __del__(self) -> None:
        self.free[self.name].append(self.unit)


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


def _shapes(function: ca.Function) -> tuple[tuple[int, Callable[[int], int]], tuple[int, Callable[[int], int]]]:
    return (function.n_in(), function.nnz_in), (function.n_out(), function.nnz_out)


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
