"""A simulator from a user's Python file, run in a namespace of its own; its errors become one sentence with the line.

The file is the user's own program and runs as such. It leaves nothing behind: no bytecode files, and no modules of its
folder in `sys.modules`.
"""

from __future__ import annotations

import os
import sys
import traceback
import types
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .._base import InputError, listed
from .adapters import as_simulator
from .simulator import Simulator

LONGEST = 240  # characters of another program's message
VARIABLE = "simulator"


def load_simulator(path: str | os.PathLike[str]) -> Simulator:
    """Run a simulator file and return what it calls `simulator`.

    Parameters
    ----------
    path : path
        A Python file that sets the variable `simulator` to a `Simulator` (or to what `as_simulator` accepts). It may
        import modules that lie beside it.

    Returns
    -------
    Simulator

    Raises
    ------
    InputError
        If the file cannot be read, does not run, or defines no simulator; with the line where there is one.
    """
    return as_simulator(simulator_variable(path))


def simulator_variable(path: str | os.PathLike[str]) -> Any:
    """What a simulator file calls `simulator`, as it stands there; see `load_simulator`.

    Raises
    ------
    InputError
        As there.
    """

    def checked(path: Path, module: types.ModuleType) -> None:
        names = [n for n, v in vars(module).items() if isinstance(v, Simulator) and not n.startswith("_")]
        if VARIABLE not in vars(module):
            there = f"it calls a Simulator {names[0]!r}; rename it" if names else "end with simulator = Simulator(...)"
            raise InputError(f"{path} does not set the variable {VARIABLE!r}: {there}.")
        try:
            as_simulator(vars(module)[VARIABLE])
        except InputError as error:
            raise InputError(f"In {path}, the variable {VARIABLE!r}: {error}") from error

    return user_variable(path, VARIABLE, "the simulator", checked)


def user_variable(
    path: str | os.PathLike[str],
    name: str,
    what: str,
    check: Callable[[Path, types.ModuleType], None] | None = None,
) -> Any:
    """What a user's Python file calls `name`; `what` it is, in sentences.

    Raises
    ------
    InputError
        If the file cannot be read, does not run, does not set the variable, or `check` refuses it.
    """
    path = Path(path)
    code = _compiled(path, _source(path, what), what)
    module = types.ModuleType(f"_{name}_{''.join(c if c.isalnum() else '_' for c in path.stem)}")
    module.__file__ = str(path)
    with _own_imports(path.resolve().parent, module):
        try:
            exec(code, module.__dict__)
        except (Exception, SystemExit) as error:
            raise InputError(_sentence(path, error, what)) from error
        if check is not None:
            check(path, module)
        if name not in vars(module):
            raise InputError(f"{path} does not set the variable {name!r}; end with {name} = ...")
    return vars(module)[name]


def _source(path: Path, what: str) -> bytes:
    if path.is_dir():
        raise InputError(f"{path} is a folder; give {what}'s Python file.")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"The {what.removeprefix('the ')} file {path} cannot be read ({error.strerror}); check its name."
        ) from None


def _compiled(path: Path, source: bytes, what: str) -> Any:
    try:
        return compile(source, str(path), "exec", dont_inherit=True)
    except SyntaxError as error:
        place = f"{path}, line {error.lineno}" if error.lineno else str(path)
        shown = f" in `{error.text.strip()}`" if error.text and error.text.strip() else ""
        raise InputError(f"{place}: {_tidy(error.msg)}{shown}; correct it.") from None
    except (ValueError, RecursionError, MemoryError) as error:  # null bytes, too deep
        raise InputError(f"{path} is not a Python file ({_tidy(str(error))}); give {what}'s.") from None


@contextmanager
def _own_imports(folder: Path, module: types.ModuleType) -> Iterator[None]:
    """The file's folder can be imported from; neither bytecode nor modules of it stay."""
    before, wrote, where = set(sys.modules), sys.dont_write_bytecode, str(folder)
    sys.dont_write_bytecode = True
    sys.path.insert(0, where)
    sys.modules[module.__name__] = module
    try:
        with warnings.catch_warnings():  # np.sin(symbol) works, and casadi's remark on it is not for the user's eyes
            warnings.filterwarnings("ignore", category=FutureWarning, module="casadi")
            yield
    finally:
        sys.dont_write_bytecode = wrote
        if where in sys.path:
            sys.path.remove(where)
        for name in set(sys.modules) - before:
            origin = getattr(sys.modules[name], "__file__", None)
            if origin and Path(origin).resolve().is_relative_to(folder) and not _installed(Path(origin)):
                del sys.modules[name]


def _installed(path: Path) -> bool:
    """Whether a module belongs to an environment that lies below the file's folder, or to this package."""
    package = Path(__file__).resolve().parents[1]
    return "site-packages" in path.parts or path.resolve().is_relative_to(package)


def _sentence(path: Path, error: BaseException, what: str) -> str:
    """What went wrong, with the deepest line of the user's file."""
    line = _line(path, error)
    place = f"{path}, line {line}" if line else str(path)
    if isinstance(error, InputError):
        return f"{place}: {_tidy(str(error))}"
    if isinstance(error, SystemExit):
        return f"{place}: the file ends the program; let it only define {what}."
    if isinstance(error, SyntaxError):  # in a module that the file imports
        return f"{place}: {Path(error.filename or '').name}, line {error.lineno}: {_tidy(error.msg)}; correct it."
    said = _tidy(str(error)).rstrip(".")
    return f"{place}: {type(error).__name__}{f': {said}' if said else ''}; correct the file."


def _line(path: Path, error: BaseException) -> int | None:
    """Deepest line of the file on the way to an error, that of the first cause if there are several."""
    found, seen = None, set[int]()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        lines = [number for frame, number in traceback.walk_tb(error.__traceback__) if _inside(frame, path)]
        found = lines[-1] if lines else found
        following = error.__cause__ or error.__context__
        if following is None:
            break
        error = following
    return found


def _inside(frame: Any, path: Path) -> bool:
    return bool(frame.f_code.co_filename == str(path))


def _tidy(text: str) -> str:
    """One line; of long messages, as CasADi writes them, the beginning."""
    text = " ".join(text.split())
    return text if len(text) <= LONGEST else listed([text[:LONGEST].rsplit(" ", 1)[0]]) + " ..."
