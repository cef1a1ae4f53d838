"""Run a user's Python file, such as a simulator file or a run file.

The file is the user's own program and runs in a namespace of its own. It leaves no bytecode files and no modules of its
folder in `sys.modules`, and its errors become one sentence with the line.
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

from .._base import InputError, existing_file, one_line


def user_variable(
    path: str | os.PathLike[str],
    name: str,
    what: str,
    check: Callable[[Path, types.ModuleType], None] | None = None,
) -> Any:
    """Run a user's Python file and return its variable `name`; messages call it `what`."""
    path = Path(path)
    code = _compile(path, _read(path, what), what)
    module = types.ModuleType(f"_{name}_{''.join(c if c.isalnum() else '_' for c in path.stem)}")
    module.__file__ = str(path.absolute())  # as Python does, so that a library beside the file is found
    with _isolate_imports(path.resolve().parent, module):
        try:
            exec(code, module.__dict__)
        except (Exception, SystemExit) as error:
            raise InputError(_describe_error(path, error, what)) from error
        if check is not None:
            check(path, module)
        if name not in vars(module):
            raise InputError(f"{path} does not set the variable {name!r}; end with {name} = ...")
    return vars(module)[name]


def _read(path: Path, what: str) -> bytes:
    if path.is_dir():
        raise InputError(f"{path} is a folder; give {what}'s Python file.")
    try:
        return (existing_file(path) if path.exists() else path).read_bytes()
    except OSError as error:
        raise InputError(
            f"The {what.removeprefix('the ')} file {path} cannot be read ({error.strerror}); check its name."
        ) from None


def _compile(path: Path, source: bytes, what: str) -> Any:
    try:
        return compile(source, str(path), "exec", dont_inherit=True)
    except SyntaxError as error:
        place = f"{path}, line {error.lineno}" if error.lineno else str(path)
        shown = f" in `{error.text.strip()}`" if error.text and error.text.strip() else ""
        raise InputError(f"{place}: {one_line(error.msg)}{shown}; correct it.") from None
    except (ValueError, RecursionError, MemoryError) as error:  # null bytes, too deep
        raise InputError(f"{path} is not a Python file ({one_line(str(error))}); give {what}'s.") from None


@contextmanager
def _isolate_imports(folder: Path, module: types.ModuleType) -> Iterator[None]:
    """Allow imports from the file's folder; remove its modules and return to the working folder afterwards."""
    before, wrote, where, here = set(sys.modules), sys.dont_write_bytecode, str(folder), os.getcwd()
    sys.dont_write_bytecode = True
    sys.path.insert(0, where)
    sys.modules[module.__name__] = module
    try:
        with warnings.catch_warnings():  # np.sin(symbol) works; casadi's warning would confuse the user
            warnings.filterwarnings("ignore", category=FutureWarning, module="casadi")
            yield
    finally:
        os.chdir(here)  # paths of the command line are relative to it
        sys.dont_write_bytecode = wrote
        if where in sys.path:
            sys.path.remove(where)
        for name in set(sys.modules) - before:
            origin = getattr(sys.modules[name], "__file__", None)
            if origin and Path(origin).resolve().is_relative_to(folder) and not _is_installed(Path(origin)):
                del sys.modules[name]


def _is_installed(path: Path) -> bool:
    """Tell whether a module belongs to an environment below the file's folder, or to this package."""
    package = Path(__file__).resolve().parents[1]
    return "site-packages" in path.parts or path.resolve().is_relative_to(package)


def _describe_error(path: Path, error: BaseException, what: str) -> str:
    """Describe the error with the deepest line of the user's file."""
    line = _find_line(path, error)
    place = f"{path}, line {line}" if line else str(path)
    if isinstance(error, InputError):
        return f"{place}: {one_line(str(error))}"
    if isinstance(error, SystemExit):
        return f"{place}: the file ends the program; let it only define {what}."
    if isinstance(error, SyntaxError):  # in a module that the file imports
        return f"{place}: {Path(error.filename or '').name}, line {error.lineno}: {one_line(error.msg)}; correct it."
    said = one_line(str(error)).rstrip(".")
    return f"{place}: {type(error).__name__}{f': {said}' if said else ''}; correct the file."


def _find_line(path: Path, error: BaseException | None) -> int | None:
    """Find the deepest line of the file in the traceback of an error, or of its first cause."""
    found, seen = None, set[int]()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        steps = traceback.walk_tb(error.__traceback__)
        lines = [number for frame, number in steps if frame.f_code.co_filename == str(path)]
        found = lines[-1] if lines else found
        error = error.__cause__ or error.__context__
    return found
