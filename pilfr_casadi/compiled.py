"""The engine that runs generated C: the symbolic step, written out by CasADi, inside the time loops of `_kernel.c`.

A library is built once a structure and kept in a private per-user cache, keyed by source, compiler, processor and CasADi
version. A cache directory that others can write to is not used. Without a C compiler `make_engine` falls back to
`sensitivities.VirtualMachine`, which gives the same numbers.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np

from .model import Model
from .recording import InputError
from .sensitivities import TARGETS, Engine, Linearization, VirtualMachine, linearize

FLAGS = ("-O3", "-march=native", "-fPIC", "-shared", "-std=c11", "-fno-math-errno")
LANE = 8
_SOURCES = {"x": 0, "s": 1, "z": 2, "w": 3, "p": 4}


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
def _machine() -> str:
    """What a compiled library depends on besides its source."""
    version = subprocess.run([compiler() or "cc", "--version"], capture_output=True, text=True, check=False).stdout
    cpu = platform.machine() + platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(errors="replace").splitlines()
        cpu += "".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    return "|".join((version, cpu, ca.__version__, " ".join(FLAGS), platform.platform()))


def _private(directory: Path) -> bool:
    """Whether a directory belongs to this user and nobody else can write to it."""
    try:
        info = directory.lstat()
    except OSError:
        return False
    mine = not hasattr(os, "getuid") or info.st_uid == os.getuid()
    return stat.S_ISDIR(info.st_mode) and mine and not info.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@functools.cache
def cache_directory() -> Path:
    """The private cache, `$XDG_CACHE_HOME/pilfr_casadi` or `~/.cache/pilfr_casadi`; a fresh temporary one where that is not safe."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    directory = base / "pilfr_casadi"
    try:
        base.mkdir(parents=True, exist_ok=True)
        directory.mkdir(mode=0o700, exist_ok=True)
    except OSError:
        return Path(tempfile.mkdtemp(prefix="pilfr-"))
    return (
        directory if _private(directory) and os.access(directory, os.W_OK) else Path(tempfile.mkdtemp(prefix="pilfr-"))
    )


def source_code(linear: Linearization) -> str:
    """The whole C source for one structure: CasADi's code for the step, the term tables, and the time loops."""
    generator = ca.CodeGenerator(
        "generated", {"with_header": False, "main": False, "indent": 0, "casadi_int": "long long"}
    )
    generator.add(linear.step)
    generator.add(linear.function)
    n = linear.sizes
    sizes = [max(linear.step.sz_iw(), linear.function.sz_iw()), max(linear.step.sz_w(), linear.function.sz_w())]
    sizes += [max(linear.step.sz_arg(), linear.function.sz_arg()), max(linear.step.sz_res(), linear.function.sz_res())]
    lines = [
        f"#define {key} {size + 1}" for key, size in zip(("SZ_IW", "SZ_W", "SZ_ARG", "SZ_RES"), sizes, strict=True)
    ]
    lines += [f"#define N_{key.upper()} {n[key]}" for key in ("x", "s", "z", "y", "u", "p")]
    lines.append("typedef struct { int source, index, nonzero; } term_t;")
    at, most = 0, 0
    for target, sources in TARGETS.items():
        terms: list[list[str]] = [[] for _ in range(n[target])]
        for source in sources:
            row, col = linear.patterns[target, source].get_triplet()
            for i, j in zip(row, col, strict=True):
                terms[i].append(f"{{{_SOURCES[source]},{j},{at}}}")
                at += 1
        first = np.concatenate([[0], np.cumsum([len(t) for t in terms])]).astype(int)
        most = max([most, *(len(t) for t in terms)])
        flat = [t for row_terms in terms for t in row_terms] or ["{0,0,0}"]
        lines.append(f"static const int ROW_{target}[] = {{{','.join(map(str, first))}}};")
        lines.append(f"static const term_t TERM_{target}[] = {{{','.join(flat)}}};")
    diagonal = linear.patterns["s", "s"].is_diag()
    lines += [f"#define N_NZ {at}", f"#define MAX_TERMS {most}", f"#define DIAGONAL {int(diagonal)}"]
    kernel = (Path(__file__).with_name("_kernel.c")).read_text()
    return "\n".join([generator.dump(), *lines, kernel])


def build(source: str) -> Path:
    """Compile, or take from the cache, the library of a source; written under another name first, so never half there."""
    cc = compiler()
    if cc is None:
        raise InputError("No C compiler was found; install one (cc, gcc or clang) or use engine='vm'.")
    key = hashlib.sha256("\n".join((source, cc, _machine())).encode()).hexdigest()[:32]
    library = cache_directory() / f"{key}.so"
    if library.exists():
        return library
    with tempfile.TemporaryDirectory(dir=cache_directory()) as folder:
        c_file, partial = Path(folder) / "model.c", Path(folder) / "model.so"
        c_file.write_text(source)
        done = subprocess.run(
            [cc, *FLAGS, str(c_file), "-o", str(partial), "-lm"], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"The C compiler {cc} failed on generated code: {done.stderr.strip()[:500]}")
        os.replace(partial, library)
    return library


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class Compiled:
    """Generated C behind the `Engine` protocol."""

    def __init__(self, model: Model) -> None:
        self.linear = linearize(model)
        self.library = ctypes.CDLL(str(build(source_code(self.linear))))

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """See `Engine.simulate`."""
        n, length = self.linear.sizes, len(u)
        u, p = np.ascontiguousarray(u, dtype=float), np.ascontiguousarray(p, dtype=float)
        state, y = np.array(state, dtype=float), np.empty((length, n["y"]))
        z, w = (np.empty((length, n["z"])) for _ in range(2)) if signals else (None, None)
        null = ctypes.c_void_p()
        more = [null if a is None else _pointer(a) for a in (z, w)]
        self.library.pilfr_simulate(
            ctypes.c_long(length), _pointer(u), _pointer(p), _pointer(state), _pointer(y), *more
        )
        return (y, state, z, w) if z is not None and w is not None else (y, state)

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `Engine.sensitivity`."""
        n, length, n_c = self.linear.sizes, len(u), seed.shape[1]
        ld = -(-max(n_c, 1) // LANE) * LANE
        u, p = np.ascontiguousarray(u, dtype=float), np.ascontiguousarray(p, dtype=float)
        state, y = np.array(state, dtype=float), np.empty((length, n["y"]))
        slope = np.zeros((len(state), ld))
        slope[:, :n_c] = seed
        col = np.ascontiguousarray(columns, dtype=ctypes.c_long)
        jac = np.empty((length, n["y"], ld))
        scratch = np.zeros((2 * n["z"] + n["x"] + n["s"], ld))
        arrays = [_pointer(a) for a in (u, p, state, slope, col)]
        rest = [_pointer(a) for a in (y, jac, scratch)]
        self.library.pilfr_sensitivity(ctypes.c_long(length), *arrays, ctypes.c_long(ld), *rest)
        return y, jac[:, :, :n_c], state, slope[:, :n_c].copy()


def make_engine(model: Model, engine: str = "auto") -> Engine:
    """The engine for a closed model: "c", "vm", or "auto" (C where there is a compiler).

    Raises
    ------
    InputError
        If the engine is unknown, or "c" is asked for without a compiler.
    """
    if engine not in ("auto", "c", "vm"):
        raise InputError(f"The engine {engine!r} is unknown; use 'auto', 'c' or 'vm'.")
    if engine == "vm" or (engine == "auto" and compiler() is None):
        return VirtualMachine(model)
    return Compiled(model)
