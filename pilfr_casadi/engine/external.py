"""Generated C that calls other programs: `simulators.leaves` in place of the code that CasADi cannot write.

CasADi leaves a gap where a function is a program of its own. `fill_gaps` lets that code call the function's buffer
(`casadi.FunctionBuffer`), and `bind` gives the buffers of a thread to a library. Without CasADi's entry point for
buffers the virtual machine has to be used.
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

from ..simulators import FmuInstance, PythonFunction, leaves, units

ENTRY = "_ZN6casadi21_function_buffer_evalEPv"  # casadi::_function_buffer_eval(void*), as compilers of Unix name it
HEAD = r"(/\* (?P<name>\w+):\([^\n]*\n[^\n]*\{\n)"  # comment and first line of a generated function
GAP = re.compile(HEAD + r" *#error Code generation not supported[^\n]*\n *return 0;")
CALL = re.compile(HEAD + r" *return call_external\(")
REMARK = "cannot be code generated"


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


@functools.cache
def entry_point() -> int | None:
    """Find the address of CasADi's function that evaluates a buffer; None where it is not there."""
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
def without_remarks() -> Iterator[None]:
    """Keep CasADi's remarks about these gaps from the screen."""
    screen, kept = sys.stderr, io.StringIO()
    with contextlib.redirect_stderr(kept):
        yield
    for line in kept.getvalue().splitlines():
        if REMARK not in line:
            print(line, file=screen)


def bind(library: ctypes.CDLL, names: tuple[str, ...], build: Callable[[str], Path]) -> None:
    """Give this thread's buffers of programs to a library's `pilfr_bind`; all libraries that it calls share them.

    `names` are those of `leaves` in their order; `build` compiles C source and returns the path of the library.
    """
    table = (_External * len(names))(*(_buffer(name, build) for name in names))
    library.pilfr_bind(table)
    _of_this_thread.table = table  # the library reads it until the next call


_of_this_thread = threading.local()


def _buffer(name: str, build: Callable[[str], Path]) -> _External:
    buffers = _of_this_thread.__dict__.setdefault("buffers", {})
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
        made, tables = _external(_unit_caller(build), address, (unit.arguments, n_arg), (unit.results, n_res))
        return made, [lease, tables]
    if isinstance(function, PythonFunction):
        return _call_python(function)
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
    made, tables = _external(entry_point(), get(buffer._self(), None), *memory)
    return made, [buffer, memory, tables]


class _Lease:
    """An instance of a unit for one thread; after the thread's end it serves another one."""

    free: ClassVar[dict[str, list[FmuInstance]]] = {}

    def __init__(self, name: str, unit: FmuInstance) -> None:
        self.name, self.unit = name, unit

    @classmethod
    def take(cls, name: str) -> _Lease | None:
        """Return an instance that is free, or a new one; None if the unit refuses."""
        try:
            return cls(name, cls.free.setdefault(name, []).pop())
        except IndexError:
            unit = units[name].instantiate()
            return None if unit is None else cls(name, unit)

    def __del__(self) -> None:
        self.free[self.name].append(self.unit)


def _call_python(function: PythonFunction) -> tuple[_External, list[object]]:
    """Let generated C call a Python function without a detour by CasADi."""
    arguments = [np.zeros(n) for n in function.sizes]
    result = np.zeros(function.size)

    def evaluate(_: int | None) -> None:
        result[:] = function.evaluate(arguments)

    callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(evaluate)
    address = ctypes.cast(callback, ctypes.c_void_p).value
    made, tables = _external(address, 0, (arguments, list(function.sizes)), ([result], [function.size]))
    return made, [callback, arguments, result, tables]


def _shapes(function: ca.Function) -> tuple[tuple[int, Callable[[int], int]], tuple[int, Callable[[int], int]]]:
    return (function.n_in(), function.nnz_in), (function.n_out(), function.nnz_out)


def _external(
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
