"""An instance of a functional mock-up unit for model exchange, in its continuous-time mode, for calls from generated C.

CasADi's own instances need half a microsecond for an evaluation, ten times as long as a small unit.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import hashlib
import io
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

OK = 1  # largest status of a successful call, with or without a warning
FUNCTIONS = {  # of the functions that an evaluation calls
    2: ("fmi2SetTime", "fmi2SetContinuousStates", "fmi2GetDerivatives", "fmi2SetReal", "fmi2GetReal"),
    3: (
        "fmi3SetTime",
        "fmi3SetContinuousStates",
        "fmi3GetContinuousStateDerivatives",
        "fmi3SetFloat64",
        "fmi3GetFloat64",
    ),
}
_LOGGER = ctypes.CFUNCTYPE(None)  # called with any arguments, which it ignores
_log = _LOGGER(lambda: None)


class _Callbacks(ctypes.Structure):
    """`fmi2CallbackFunctions`."""

    _fields_ = [
        ("logger", _LOGGER),
        ("allocate", ctypes.c_void_p),
        ("release", ctypes.c_void_p),
        ("finished", ctypes.c_void_p),
        ("environment", ctypes.c_void_p),
    ]


class _Fmu(ctypes.Structure):
    """`fmu_t` of the engine's `_fmu.c`."""

    _fields_ = [
        ("version", ctypes.c_int),
        ("instance", ctypes.c_void_p),
        *((name, ctypes.c_void_p) for name in ("set_time", "set_states", "get_derivatives")),
        *((name, ctypes.c_void_p) for name in ("set_values", "get_values")),
        *((name, ctypes.c_size_t) for name in ("n_x", "n_u", "n_p", "n_y")),
        *((name, ctypes.c_void_p) for name in ("u_ref", "p_ref", "y_ref")),
        *((name, ctypes.c_void_p) for name in ("t", "x", "u", "p", "derivatives", "y", "last_p")),
    ]


@dataclass(frozen=True, eq=False)
class FmuFile:
    """An unpacked unit with the facts that an instance needs: version, token, program, value references by role."""

    folder: Path
    version: int
    token: str
    binary: str
    references: Mapping[str, Sequence[int]]  # of "x", "u", "p" and "y"

    def instantiate(self) -> FmuInstance | None:
        """Make an instance in continuous-time mode; None if the unit refuses."""
        library = _load_library(self.folder / self.binary)
        instantiate = _instantiate_2 if self.version == 2 else _instantiate_3
        instance = instantiate(library, self)
        return None if instance is None else FmuInstance(library, instance, self)


class FmuInstance:
    """An instance, with the memory for its arguments `t, x, u, p` and results `derivatives, outputs`."""

    def __init__(self, library: ctypes.CDLL, instance: int, file: FmuFile) -> None:
        sizes = {k: len(v) for k, v in file.references.items()}
        self.arguments = [np.zeros(max(n, 1)) for n in (1, sizes["x"], sizes["u"], sizes["p"])]
        self.results = [np.zeros(max(n, 1)) for n in (sizes["x"], sizes["y"])]
        self._last = np.full(max(sizes["p"], 1), np.nan)
        self._references = [np.array([*file.references[k], 0], dtype=np.uint32) for k in ("u", "p", "y")]
        addresses = [ctypes.cast(getattr(library, name), ctypes.c_void_p).value for name in FUNCTIONS[file.version]]
        arrays: list[np.ndarray] = [*self._references, *self.arguments, *self.results, self._last]
        memory = [a.ctypes.data for a in arrays]
        counts = [sizes[k] for k in ("x", "u", "p", "y")]
        self.structure = _Fmu(file.version, instance, *addresses, *counts, *memory)


def unpack(path: Path, folder: Path | None = None) -> tuple[Path, str]:
    """Unpack a file into a private folder, once in this process; return the folder and a digest of the file.

    `folder` names a folder into which another process has unpacked it.
    """
    content = path.read_bytes()
    key = hashlib.sha256(content).hexdigest()
    if folder is not None:
        _folders[key] = folder
    if key not in _folders:
        folder = Path(tempfile.mkdtemp(prefix="pilfr-fmu-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            archive.extractall(folder)
        _folders[key] = folder
    return _folders[key], key


@functools.cache
def _load_library(path: Path) -> ctypes.CDLL:
    return ctypes.CDLL(str(path))


def _resource_folder(library: ctypes.CDLL) -> Path:
    return Path(library._name).parents[2] / "resources"


def _call(library: ctypes.CDLL, name: str, *arguments: Any) -> bool:
    function = getattr(library, name)
    function.restype = ctypes.c_int
    return bool(function(*arguments) <= OK)


def _instantiate_2(library: ctypes.CDLL, file: FmuFile) -> int | None:
    libc = ctypes.CDLL(None)
    addresses = (ctypes.cast(f, ctypes.c_void_p) for f in (libc.calloc, libc.free))
    callbacks = _Callbacks(_log, *addresses, None, None)
    _callbacks.append(callbacks)
    make = library.fmi2Instantiate
    make.restype = ctypes.c_void_p
    where = _resource_folder(library).as_uri().encode()
    instance = make(b"unit", 0, file.token.encode(), where, ctypes.byref(callbacks), 0, 0)
    if not instance:
        return None
    c, zero = ctypes.c_void_p(instance), ctypes.c_double(0.0)
    information = (ctypes.c_double * 8)()  # fmi2EventInfo: five flags and a time
    done = (
        _call(library, "fmi2SetupExperiment", c, 0, zero, zero, 0, zero)
        and _call(library, "fmi2EnterInitializationMode", c)
        and _call(library, "fmi2ExitInitializationMode", c)
        and _call(library, "fmi2NewDiscreteStates", c, ctypes.byref(information))
        and _call(library, "fmi2EnterContinuousTimeMode", c)
    )
    return int(instance) if done else None


def _instantiate_3(library: ctypes.CDLL, file: FmuFile) -> int | None:
    make = library.fmi3InstantiateModelExchange
    make.restype = ctypes.c_void_p
    no, zero = ctypes.c_bool(False), ctypes.c_double(0.0)
    where = str(_resource_folder(library)).encode()
    instance = make(b"unit", file.token.encode(), where, no, no, None, _log)
    if not instance:
        return None
    c, flags = ctypes.c_void_p(instance), [ctypes.c_bool() for _ in range(5)]
    following = ctypes.c_double()
    done = (
        _call(library, "fmi3EnterInitializationMode", c, no, zero, zero, no, zero)
        and _call(library, "fmi3ExitInitializationMode", c)
        and _call(library, "fmi3UpdateDiscreteStates", c, *map(ctypes.byref, flags), ctypes.byref(following))
        and _call(library, "fmi3EnterContinuousTimeMode", c)
    )
    return int(instance) if done else None


_folders: dict[str, Path] = {}  # by digest
_callbacks: list[Any] = []  # kept alive for the instances that call them
