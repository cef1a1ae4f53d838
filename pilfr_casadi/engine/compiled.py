"""The engine that runs generated C: a model's step, called from the time loops of `_kernel.c`.

The loops are built once; a model's library is built once a structure. Both are kept in a private per-user cache, keyed
by source, compiler, processor and CasADi version, in folders by the key's first letters: a cache of many thousands is
not listed as a whole. A file name holds a digest of its content, so that a damaged library is built anew. A cache
directory that others can write to is not used. Without a working C compiler `make_engine` falls back to the virtual
machine of `sensitivities`, which gives the same numbers.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
import warnings
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Model
from .generated import loops_code, source_code
from .sensitivities import Engine, VirtualMachine, linearize

# without contraction the generated step gives the very numbers of the virtual machine: what slips, slips in both
COMMON = ("-fPIC", "-shared", "-std=gnu11", "-fno-math-errno", "-ffp-contract=off")
FLAGS = (("-march=native", *COMMON), COMMON)  # the second where the first is not understood
# long straight lines take seconds to optimise and gain nothing from it, unlike the loops; each output is asked whether
# it is wanted, and to thread thousands of such jumps takes GCC minutes
PLAIN, LOOPS = ("-O1", "-fno-thread-jumps"), ("-O2",)
KEPT = 40  # libraries in each of the cache's 256 folders: some hundred megabytes
WRITTEN = 64  # states with memory up to which slopes written out fit the nearest cache
PATIENCE = 600.0  # seconds for one compilation
_failures: dict[str, str] = {}  # what did not compile is not tried again by this process


@functools.cache
def compiler() -> str | None:
    """Path of the C compiler: `$CC`, cc, gcc or clang; None where there is none or `PILFR_COMPILER=none` is set."""
    if os.environ.get("PILFR_COMPILER") == "none":
        return None
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and (path := shutil.which(name)):
            return path
    return None


@functools.cache
def _machine(cc: str) -> str:
    """What a compiled library depends on besides its source."""
    try:
        version = subprocess.run([cc, "--version"], capture_output=True, text=True, check=False).stdout
    except OSError as error:
        version = str(error)
    cpu = platform.machine() + platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(errors="replace").splitlines()
        cpu += "".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    return "|".join((cc, version, cpu, ca.__version__, str(FLAGS), platform.platform()))


def _private(directory: Path) -> bool:
    """Whether a directory belongs to this user and nobody else can write to it, nor put another in its place."""
    try:
        info, above = directory.lstat(), directory.parent.stat()
    except OSError:
        return False
    others = stat.S_IWGRP | stat.S_IWOTH
    mine = not hasattr(os, "getuid") or info.st_uid == os.getuid()
    kept = not above.st_mode & stat.S_IWOTH or above.st_mode & stat.S_ISVTX
    return stat.S_ISDIR(info.st_mode) and mine and not info.st_mode & others and bool(kept)


@functools.cache
def cache_directory() -> Path:
    """The private cache, `$XDG_CACHE_HOME/pilfr_casadi` or `~/.cache/pilfr_casadi`; else one for this process alone."""
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        directory = base / "pilfr_casadi"
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        directory.mkdir(mode=0o700, exist_ok=True)
        if _private(directory) and os.access(directory, os.W_OK | os.X_OK):
            return directory
    except (OSError, RuntimeError):
        pass
    temporary = tempfile.mkdtemp(prefix="pilfr-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def _digest(library: Path) -> str:
    return hashlib.sha256(library.read_bytes()).hexdigest()[:16]


def _shelf(key: str) -> Path:
    """The folder of a library."""
    return cache_directory() / key[:2]


def _thin(shelf: Path) -> None:
    """Keep a folder's most recently used libraries; one that is loaded stays so without its file."""
    with contextlib.suppress(OSError):
        for library in sorted(shelf.glob("*.so"), key=lambda p: p.stat().st_mtime)[:-KEPT]:
            library.unlink()


def _compile(cc: str, source: str, key: str, level: tuple[str, ...]) -> Path:
    """Compile under another name first, so that a library is never half there."""
    with tempfile.TemporaryDirectory(dir=cache_directory()) as folder:
        c_file, partial = Path(folder) / "model.c", Path(folder) / "model.so"
        c_file.write_text(source, encoding="utf-8")
        for some, flags in zip((level, level[:1]), FLAGS, strict=True):
            command = [cc, *some, *flags, str(c_file), "-o", str(partial), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
            if not done.returncode and partial.exists():
                library = _shelf(key) / f"{key}-{_digest(partial)}.so"
                library.parent.mkdir(mode=0o700, exist_ok=True)
                os.replace(partial, library)
                _thin(library.parent)
                return library
    raise OSError((done.stderr.strip().splitlines() or ["it wrote no library"])[0][:300])


def build(source: str, level: tuple[str, ...] = PLAIN) -> Path:
    """The library of a source, from the cache or compiled.

    Raises
    ------
    InputError
        If there is no compiler, or it does not work.
    """
    cc = compiler()
    if cc is None:
        raise InputError("No C compiler was found; install one (cc, gcc or clang) or use engine='vm'.")
    key = hashlib.sha256("\n".join((source, *level, _machine(cc))).encode()).hexdigest()[:32]
    for library in _shelf(key).glob(f"{key}-*.so"):
        if library.stem == f"{key}-{_digest(library)}":
            with contextlib.suppress(OSError):
                os.utime(library)  # used now
            return library
        library.unlink(missing_ok=True)
    if key not in _failures:
        try:
            return _compile(cc, source, key, level)
        except (OSError, subprocess.TimeoutExpired) as error:
            _failures[key] = str(error)
    raise InputError(
        f"The C compiler {cc} could not build the model ({_failures[key]}); "
        "repair it, name another in CC, or use engine='vm'."
    )


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p:
    return ctypes.c_void_p() if array is None else ctypes.c_void_p(array.ctypes.data)


def _loaded(library: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(f"The compiled model cannot be loaded ({error}); use engine='vm'.") from error


@functools.cache
def _loops(_cache: Path) -> ctypes.CDLL:
    """The time loops, once a cache."""
    return _loaded(build(loops_code(), LOOPS))


class Compiled:
    """Generated C behind the `Engine` protocol; it keeps nothing between calls, so threads may share it."""

    def __init__(self, model: Model) -> None:
        self.linear = linearize(model, staged=model.n_state <= WRITTEN)
        self.loops = _loops(cache_directory())
        self.library = _loaded(build(source_code(self.linear)))
        self.model = ctypes.byref(ctypes.c_char.in_dll(self.library, "pilfr_model"))

    def _call(self, name: str, *arguments: Any) -> None:
        if getattr(self.loops, name)(self.model, *arguments):
            raise MemoryError("the compiled model found no memory for its slopes")

    def _arguments(self, u: np.ndarray, p: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, ...]:
        n = self.linear.sizes
        u = np.ascontiguousarray(u, dtype=float).reshape(len(u), n["u"])
        p = np.ascontiguousarray(p, dtype=float).reshape(n["p"])
        y = np.empty((len(u) // self.linear.substeps, n["y"]))
        return u, p, np.array(state, dtype=float).reshape(n["x"] + n["s"]), y

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """See `Engine.simulate`."""
        u, p, state, y = self._arguments(u, p, state)
        more = [np.empty((len(y), self.linear.sizes["z"])) for _ in range(2)] if signals else []
        z, w = more or (None, None)
        self._call("pilfr_simulate", ctypes.c_long(len(u)), *map(_pointer, (u, p, state, y, z, w)))
        return (y, state, *more)

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `Engine.sensitivity`."""
        u, p, state, y = self._arguments(u, p, state)
        n_c = seed.shape[1]
        slope = np.array(seed, dtype=float, order="C").reshape(len(state), n_c)
        column = np.ascontiguousarray(columns, dtype=ctypes.c_long).reshape(len(p))
        jac = np.empty((*y.shape, n_c))
        before, after = map(_pointer, (u, p, state, slope, column)), map(_pointer, (y, jac))
        self._call("pilfr_sensitivity", ctypes.c_long(len(u)), *before, ctypes.c_long(n_c), *after)
        return y, jac, state, slope


def make_engine(model: Model, engine: str = "auto") -> Engine:
    """The engine for a closed model: "c", "vm", or "auto" (C where there is a compiler that works).

    Raises
    ------
    InputError
        If the engine is unknown, or "c" is asked for without a compiler that works.
    """
    if engine not in ("auto", "c", "vm"):
        raise InputError(f"The engine {engine!r} is unknown; use 'auto', 'c' or 'vm'.")
    if engine == "vm" or (engine == "auto" and compiler() is None):
        return VirtualMachine(model)
    try:
        return Compiled(model)
    except InputError as error:
        if engine == "c":
            raise
        warnings.warn(f"{error} The slower virtual machine is used.", RuntimeWarning, stacklevel=2)
        return VirtualMachine(model)
