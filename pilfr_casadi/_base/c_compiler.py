"""Compile C source to libraries, and keep them in a private per-user cache.

Keys are the source, the compiler, the processor and the CasADi version; folders have the key's first letters as names,
so that listings stay short. A file name holds a digest of its content, so a damaged library is built again. A cache
directory that others can write to is not used.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
from platformdirs import user_cache_path

from .errors import InputError

# without fused multiply-adds the generated step equals the virtual machine's bit by bit, so the same operators slip
COMMON = ("-fPIC", "-shared", "-std=gnu11", "-fno-math-errno", "-ffp-contract=off")
COMPILER_FLAGS = (("-march=native", *COMMON), COMMON)  # the second if the compiler refuses the first
# optimising long straight-line code takes seconds and gains nothing, unlike the loops; code that calls other programs
# tests for every output whether it is wanted, and GCC needs minutes to thread thousands of such jumps
PLAIN, LOOPS = ("-O1", "-fno-thread-jumps"), ("-O2",)
KEPT_LIBRARIES = 40  # libraries in each of the cache's 256 folders: some hundred megabytes in all
COMPILATION_SECONDS = 600.0  # longest time for one compilation
_failures: dict[str, str] = {}  # errors of sources that did not compile; this process does not try them again


@functools.cache
def compiler() -> str | None:
    """Find the C compiler: `$CC`, cc, gcc or clang; None if there is none or `PILFR_COMPILER=none` is set."""
    if os.environ.get("PILFR_COMPILER") == "none":
        return None
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and (path := shutil.which(name)):
            return path
    return None


@functools.cache
def _describe_machine(cc: str) -> str:
    """Describe the compiler and processor that a library depends on besides its source."""
    try:
        version = subprocess.run([cc, "--version"], capture_output=True, text=True, check=False).stdout
    except OSError as error:
        version = str(error)
    cpu = platform.machine() + platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(errors="replace").splitlines()
        cpu += "".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    return "|".join((cc, version, cpu, ca.__version__, str(COMPILER_FLAGS), platform.platform()))


def _is_private(directory: Path) -> bool:
    """Tell whether a directory belongs to this user, and nobody else can write to it or replace it."""
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
    """Return the private per-user cache; if it cannot be made or is not private, one for this process alone.

    `platformdirs` names it: `~/.cache/pilfr_casadi` on Linux. `XDG_CACHE_HOME` moves it on every system.
    """
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        directory = Path(home) / "pilfr_casadi" if home else user_cache_path("pilfr_casadi", appauthor=False)
        directory.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        directory.mkdir(mode=0o700, exist_ok=True)
        if _is_private(directory) and os.access(directory, os.W_OK | os.X_OK):
            return directory
    except (OSError, RuntimeError):
        pass
    temporary = tempfile.mkdtemp(prefix="pilfr-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def _digest(library: Path) -> str:
    return hashlib.sha256(library.read_bytes()).hexdigest()[:16]


def _cache_folder(key: str) -> Path:
    return cache_directory() / key[:2]


def _compile(cc: str, source: str, key: str, level: tuple[str, ...]) -> Path:
    """Compile to a temporary file and rename it, so that a library is never incomplete."""
    choices = [(*some, *flags) for some, flags in zip((level, level[:1]), COMPILER_FLAGS, strict=True)]
    _cache_folder(key).mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_directory()) as folder:
        partial = run_compiler(cc, source, Path(folder), *choices)
        library = _cache_folder(key) / f"{key}-{_digest(partial)}.so"
        os.replace(partial, library)
    with contextlib.suppress(OSError):  # keep the most recently used
        for old in sorted(library.parent.glob("*.so"), key=lambda p: p.stat().st_mtime)[:-KEPT_LIBRARIES]:
            old.unlink()
    return library


def run_compiler(cc: str, source: str, folder: Path, *choices: Sequence[str]) -> Path:
    """Compile C source to a library in a folder with the first choice of options that works; else raise OSError."""
    (folder / "model.c").write_text(source, encoding="utf-8")
    library = folder / "model.so"
    for options in choices:
        command = [os.path.abspath(cc), *options, "model.c", "-o", library.name, "-lm"]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=COMPILATION_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise OSError(str(error)) from error
        if not done.returncode and library.exists():
            return library
    raise OSError((done.stderr.strip().splitlines() or ["it wrote no library"])[0][:300])


def build(source: str, level: tuple[str, ...] = PLAIN) -> Path:
    """Return the library of a source, from the cache or compiled."""
    cc = compiler()
    if cc is None:
        raise InputError("No C compiler was found; install one (cc, gcc or clang) or use engine='vm'.")
    key = hashlib.sha256("\n".join((source, *level, _describe_machine(cc))).encode()).hexdigest()[:32]
    for library in _cache_folder(key).glob(f"{key}-*.so"):
        if library.stem == f"{key}-{_digest(library)}":
            with contextlib.suppress(OSError):
                os.utime(library)  # used now
            return library
        library.unlink(missing_ok=True)
    if key not in _failures:
        try:
            return _compile(cc, source, key, level)
        except OSError as error:
            _failures[key] = str(error)
    raise InputError(
        f"The C compiler {cc} could not build the model ({_failures[key]}); "
        "repair it, name another in CC, or use engine='vm'."
    )
