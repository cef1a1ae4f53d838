"""An instance of a functional mock-up unit for model exchange, called directly; each process has at most one.

Parameters are changed where the standard allows it: tunable ones in event mode, fixed ones by a restart with new
initial values. A unit that reports an error is restarted before the next evaluation. An evaluation with an error gives
NaN.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

OK, DISCARD = 1, 2  # statuses of FMI: up to 1 success, perhaps with a warning; 2 a refused value; above an error
MOST_ITERATIONS = 100  # updates of discrete states in one event
_LOGGER = ctypes.CFUNCTYPE(None)  # called with any arguments, which it ignores
_log = _LOGGER(lambda: None)
_RESTART = ctypes.CFUNCTYPE(ctypes.c_int)
calls = np.zeros(1, dtype=np.int64)  # begun and ended calls of units in this process: odd while one has not returned


class UnitError(Exception):
    """A unit cannot be evaluated at all."""


class _Callbacks(ctypes.Structure):
    """`fmi2CallbackFunctions`."""

    _fields_ = [
        ("logger", _LOGGER),
        ("allocate", ctypes.c_void_p),
        ("release", ctypes.c_void_p),
        ("finished", ctypes.c_void_p),
        ("environment", ctypes.c_void_p),
    ]


class _EventInfo(ctypes.Structure):
    """`fmi2EventInfo`."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("update_needed", "terminate", "nominals_changed", "states_changed")),
        ("next_time_defined", ctypes.c_int),
        ("next_time", ctypes.c_double),
    ]


class _Fmu(ctypes.Structure):
    """`fmu_t` of `_fmu.c`."""

    _fields_ = [
        ("version", ctypes.c_int),
        ("instance", ctypes.c_void_p),
        ("failed", ctypes.c_void_p),
        ("calls", ctypes.c_void_p),
        ("restart", _RESTART),
        *((name, ctypes.c_void_p) for name in ("set_time", "set_states", "get_derivatives")),
        *((name, ctypes.c_void_p) for name in ("set_values", "get_values")),
        *((name, ctypes.c_void_p) for name in ("enter_events", "update_states", "leave_events")),
        *((name, ctypes.c_void_p) for name in ("reset", "set_up", "enter_initialisation", "leave_initialisation")),
        *((name, ctypes.c_size_t) for name in ("n_x", "n_u", "n_p", "n_y", "n_t")),
        *((name, ctypes.c_void_p) for name in ("u_ref", "p_ref", "y_ref")),
        *((name, ctypes.c_void_p) for name in ("t", "x", "u", "p", "derivatives", "y", "last_p")),
    ]


@dataclass(frozen=True)
class FmuFile:
    """An unpacked unit with the facts that an instance needs: version, token, program, parameters."""

    folder: Path
    version: int
    token: str
    binary: str
    parameters: tuple[int, ...]  # value references, those of tunable ones first
    tunable: int  # number of tunable parameters; a change of the others takes a restart


@dataclass(frozen=True)
class FmuSignals:
    """The part of a unit that is evaluated: its file, number of states, and value references."""

    file: FmuFile
    states: int
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of t, x, u and p."""
        return 1, self.states, len(self.inputs), len(self.file.parameters)

    @property
    def results(self) -> int:
        """Number of derivatives and outputs."""
        return self.states + len(self.outputs)


class FmuInstance:
    """The instance of a file in this process, in continuous-time mode."""

    def __init__(self, file: FmuFile) -> None:
        self.file = file
        self.handle = ctypes.c_void_p()
        self.failed = np.zeros(1, dtype=np.intc)
        self.last = np.full(len(file.parameters), np.nan)  # parameters that the instance has
        self.references = np.array([*file.parameters, 0], dtype=np.uint32)
        self.has_time_event = False
        with _counted():
            self.library = ctypes.CDLL(str(file.folder / file.binary))
            self._instantiate()
            if not self._initialise(None):
                raise UnitError("it cannot be initialised")

    def function(self, name: str) -> Any:
        """Return a function of the unit by its name without the version."""
        if self.file.version == 3:
            name = {
                "SetReal": "SetFloat64",
                "GetReal": "GetFloat64",
                "GetDerivatives": "GetContinuousStateDerivatives",
                "NewDiscreteStates": "UpdateDiscreteStates",
            }.get(name, name)
        found = getattr(self.library, f"fmi{self.file.version}{name}")
        found.restype = ctypes.c_int
        return found

    def address(self, name: str) -> int | None:
        """Return the address of a function of the unit; none of one that its version does not have."""
        if self.file.version == 3 and name == "SetupExperiment":
            return None
        return ctypes.cast(self.function(name), ctypes.c_void_p).value

    def call(self, name: str, *arguments: Any) -> int:
        """Call a function of the unit; return its status."""
        return int(self.function(name)(self.handle, *arguments))

    def arguments(self, references: np.ndarray | None, count: int, values: np.ndarray) -> list[Any]:
        """List the arguments for some values: of the states, or of variables with references."""
        size = ctypes.c_size_t(count)
        if references is None:
            return [_address(values), size]
        return [_address(references), size, _address(values), *[size] * (self.file.version == 3)]

    def _set(self, parameters: np.ndarray) -> int:
        return self.call("SetReal", *self.arguments(self.references, len(parameters), parameters))

    def _instantiate(self) -> None:
        resources = self.file.folder / "resources"
        token, make = self.file.token.encode(), self.library
        if self.file.version == 2:
            libc = ctypes.CDLL(None)
            addresses = (ctypes.cast(f, ctypes.c_void_p) for f in (libc.calloc, libc.free))
            self._callbacks = _Callbacks(_log, *addresses, None, None)
            make.fmi2Instantiate.restype = ctypes.c_void_p
            where, given = resources.as_uri().encode(), ctypes.byref(self._callbacks)
            found = make.fmi2Instantiate(b"unit", 0, token, where, given, 0, 0)
        else:
            make.fmi3InstantiateModelExchange.restype = ctypes.c_void_p
            no = ctypes.c_bool(False)
            where = f"{resources}/".encode()
            found = make.fmi3InstantiateModelExchange(b"unit", token, where, no, no, None, _log)
        if not found:
            raise UnitError("it makes no instance")
        self.handle.value = found

    def _initialise(self, parameters: np.ndarray | None) -> bool:
        """Enter continuous-time mode by way of initialisation mode, with or without values of parameters."""
        no, zero = ctypes.c_bool(False), ctypes.c_double(0.0)
        if self.file.version == 2:
            status = [self.call("SetupExperiment", 0, zero, zero, 0, zero), self.call("EnterInitializationMode")]
        else:
            status = [self.call("EnterInitializationMode", no, zero, zero, no, zero)]
        if parameters is not None and len(parameters) and max(status) <= OK:
            status.append(self._set(parameters))
        if max(status) <= OK:
            status.append(self.call("ExitInitializationMode"))
        if max(status) <= OK:
            status += [self._update_states(), self.call("EnterContinuousTimeMode")]
        return max(status) <= OK

    def _update_states(self) -> int:
        """Update the discrete states in event mode until they are settled."""
        for _ in range(MOST_ITERATIONS):
            if self.file.version == 2:
                information = _EventInfo()
                status = self.call("NewDiscreteStates", ctypes.byref(information))
                needed, timed = information.update_needed, information.next_time_defined
            else:
                flags, following = [ctypes.c_bool() for _ in range(5)], ctypes.c_double()
                status = self.call("NewDiscreteStates", *map(ctypes.byref, flags), ctypes.byref(following))
                needed, timed = flags[0].value, flags[4].value
            self.has_time_event |= bool(timed)
            if status > OK or not needed:
                break
        return status

    def set_parameters(self, parameters: np.ndarray) -> int:
        """Change the parameters; return the status."""
        n = self.file.tunable
        if self.failed[0] or parameters[n:].tobytes() != self.last[n:].tobytes():
            return self.restart(parameters)
        steps = (
            lambda: self.call("EnterEventMode"),
            lambda: self._set(parameters[:n]),
            self._update_states,
            lambda: self.call("EnterContinuousTimeMode"),
        )
        return next((status for step in steps if (status := step()) > OK), 0)

    def restart(self, parameters: np.ndarray) -> int:
        """Reset and initialise the unit with values of parameters; a unit that cannot be reset gets a new instance."""
        if self.call("Reset") <= OK and self._initialise(parameters):
            return 0
        free = getattr(self.library, f"fmi{self.file.version}FreeInstance")
        free.restype = None
        free(self.handle)
        try:
            self._instantiate()
        except UnitError:
            os._exit(1)  # the next evaluation starts a new process
        return 0 if self._initialise(parameters) else DISCARD + 1


class FmuEvaluation:
    """Evaluations `z = (t, x, u, p) -> (derivatives, outputs)` of an instance, with the memory for both."""

    def __init__(self, instance: FmuInstance, signals: FmuSignals) -> None:
        self.instance, self.signals = instance, signals
        self.z = np.zeros(sum(signals.sizes))
        self.arguments = np.split(self.z, np.cumsum(signals.sizes)[:-1])
        self.result = np.zeros(max(signals.results, 1))
        self._references = [np.array([*refs, 0], dtype=np.uint32) for refs in (signals.inputs, signals.outputs)]
        self._restart = _RESTART(lambda: instance.restart(self.arguments[3]))
        named = ("SetTime", "SetContinuousStates", "GetDerivatives", "SetReal", "GetReal")
        events = ("EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode")
        starts = ("Reset", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode")
        addresses = [instance.address(name) for name in (*named, *events, *starts)]
        memory = [a.ctypes.data for a in (self._references[0], instance.references, self._references[1])]
        memory += [a.ctypes.data for a in self.arguments]
        memory += [self.result.ctypes.data, self.result.ctypes.data + 8 * signals.states, instance.last.ctypes.data]
        self.structure = _Fmu(
            instance.file.version,
            ctypes.addressof(instance.handle),
            instance.failed.ctypes.data,
            calls.ctypes.data,
            self._restart,
            *addresses,
            *signals.sizes[1:],
            len(signals.outputs),
            instance.file.tunable,
            *memory,
        )

    @functools.cached_property
    def _steps(self) -> list[Callable[[], int]]:
        """Calls of the unit for one evaluation, with the addresses of their arguments."""
        instance, signals = self.instance, self.signals
        _, x, u, _ = self.arguments
        n_x, n_u, n_y = signals.states, len(signals.inputs), len(signals.outputs)
        time = ctypes.c_double.from_address(self.z.ctypes.data)
        steps: list[Callable[[], int]] = [functools.partial(instance.function("SetTime"), instance.handle, time)]
        for name, references, count, values in (
            ("SetContinuousStates", None, n_x, x),
            ("SetReal", self._references[0], n_u, u),
            ("GetDerivatives", None, n_x, self.result),
            ("GetReal", self._references[1], n_y, self.result[n_x:]),
        ):
            if count:
                arguments = instance.arguments(references, count, values)
                steps.append(functools.partial(instance.function(name), instance.handle, *arguments))
        return steps

    def evaluate(self, z: np.ndarray) -> np.ndarray:
        """Evaluate one point, as `_fmu.c` does."""
        instance = self.instance
        self.z[:] = z
        with _counted():
            status = self._evaluate()
        instance.failed[0] = status > DISCARD
        if status > OK:
            self.result[:] = np.nan
        return self.result[: self.signals.results]

    def _evaluate(self) -> int:
        instance, parameters = self.instance, self.arguments[3]
        if instance.failed[0] or parameters.tobytes() != instance.last.tobytes():
            status = instance.set_parameters(parameters)
            instance.last[:] = parameters
            if status > OK:
                return DISCARD + 1  # the mode is unknown
        return next((status for step in self._steps if (status := step()) > OK), 0)


@contextlib.contextmanager
def _counted() -> Iterator[None]:
    calls[0] += 1
    try:
        yield
    finally:
        calls[0] += 1


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


@functools.cache
def _instance(file: FmuFile) -> FmuInstance:
    return FmuInstance(file)


@functools.cache
def evaluation(signals: FmuSignals) -> FmuEvaluation:
    """Return the evaluations of a unit in this process, which has one instance of it."""
    return FmuEvaluation(_instance(signals.file), signals)


def unpack(path: Path) -> tuple[Path, str]:
    """Unpack a file into a private folder, once in this process; return the folder and a digest of the file."""
    content = path.read_bytes()
    key = hashlib.sha256(content).hexdigest()
    if key not in _folders:
        _remove_folders_of_killed_processes()
        folder = Path(tempfile.mkdtemp(prefix=_folder_prefix()))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            archive.extractall(folder)
        _folders[key] = folder
    return _folders[key], key


_folders: dict[str, Path] = {}  # by digest


def _folder_prefix() -> str:
    return f"pilfr-fmu-{os.getpid()}-"


def _remove_folders_of_killed_processes() -> None:
    """Remove folders of units whose process was killed, so that it could not remove them itself."""
    for folder in Path(tempfile.gettempdir()).glob("pilfr-fmu-*-*") if os.name == "posix" else ():
        number = folder.name.split("-")[2]
        try:
            os.kill(int(number), 0)
        except (ValueError, PermissionError):  # not of this package, or a process of somebody else
            continue
        except ProcessLookupError:
            shutil.rmtree(folder, ignore_errors=True)


def owns_folder(folder: Path) -> bool:
    """Tell whether this process has unpacked a file into a folder, and not the process that forked it."""
    return folder.name.startswith(_folder_prefix())
