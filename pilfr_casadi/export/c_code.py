"""A step as C: the code that CasADi generates, behind two plain functions and a header with names and indices.

    rig_x0(x);                          the start state
    rig_step(x, u, x_next, y);          arrays of RIG_NX, RIG_NU, RIG_NX, RIG_NY doubles; x_next may be x itself

Names and units of signals come from files. So comments replace all characters that could end them, and constants
replace everything but letters, digits and underscores.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca

from .._base import InputError, make_folder, write_atomically
from ..data import name_with_unit

LONGEST_NAME = 50  # letters: C distinguishes names by their first 63, and the longest ending is "_casadi_release"
C_KEYWORDS = frozenset(  # of C and C++
    (  # noqa: SIM905
        "alignas alignof and asm auto bool break case catch char class compl const constexpr continue decltype default "
        "delete do double else enum explicit export extern false float for friend goto if inline int long mutable "
        "namespace new noexcept not nullptr operator or private protected public register reinterpret restrict return "
        "short signed sizeof static struct switch template this throw true try typedef typeid typename union unsigned "
        "using virtual void volatile while xor"
    ).split()
)
C_HEADERS = frozenset(  # of C's library, which a file `<name>.h` would hide
    (  # noqa: SIM905
        "assert complex ctype errno fenv float inttypes iso646 limits locale malloc math memory mex setjmp signal "
        "stdarg stdbool stddef stdint stdio stdlib string strings tgmath threads time uchar unistd wchar wctype"
    ).split()
)


def check_name(name: Any) -> None:
    """Refuse a function name that CasADi, a file name or C does not allow."""
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise InputError(
            f"The function name {str(name)[:60]!r} cannot be used; give letters, digits and single underscores."
        )
    if len(name) > LONGEST_NAME:
        raise InputError(f"The function name {name[:20]}... has {len(name)} characters; give at most {LONGEST_NAME}.")
    if name.lower() in C_KEYWORDS | C_HEADERS:
        kind = "a C keyword" if name.lower() in C_KEYWORDS else "the name of one of C's headers"
        raise InputError(f"The function name {name!r} is {kind}; give another one.")


def write_c(
    folder: str | os.PathLike[str], step: ca.Function, names: Mapping[str, Any], interpolated: bool
) -> tuple[Path, Path]:
    """Write source and header of a step `(x, u) -> (x_next, y)` with `Exported.names()`; see `Exported.to_c`.

    Both are templates in this folder, `_step.c` and `_step.h`.
    """
    target, name, big = make_folder(folder), names["name"], names["name"].upper()
    inner = f"{name.rstrip('_')}_casadi"
    x, u = (ca.MX.sym(key, step.size1_in(key)) for key in ("x", "u"))
    # a long step holds a loop and is not expanded, only called from a function of the right name
    function = step.expand(inner) if step.is_a("SXFunction") else ca.Function(inner, [x, u], step.call([x, u]))
    entries = {}
    for letter, role in (("X", "states"), ("U", "inputs"), ("Y", "outputs")):
        constants = _make_constant_names(f"{big}_{letter}_", list(names[role]))
        comments = [_clean_comment(_describe_entry(names, entry)) for entry in names[role]]
        entries[letter] = list(zip(constants, comments, strict=True))
    values = {**names, "big": big, "entries": entries, "interpolated": interpolated, "function": function}
    header = write_atomically(target / f"{name}.h", fill_template("_step.h", values))
    values["code"] = generate_code(function)
    return write_atomically(target / f"{name}.c", fill_template("_step.c", values)), header


def generate_code(function: ca.Function) -> str:
    """Generate the C code of a function."""
    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    return _use_all_parameters(generator.dump())


def fill_template(template: str, values: Mapping[str, Any]) -> str:
    """Fill a template of this folder."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(__package__, ""),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(values)


def _use_all_parameters(code: str) -> str:
    """Mark the parameters of CasADi's functions as used, because -Wextra warns about unused ones."""

    def mark_used(match: re.Match[str]) -> str:
        names = [parameter.split()[-1] for parameter in match[1].split(",")]
        return "\n  ".join([match[0], " ".join(f"(void){name};" for name in names)])

    return re.sub(r"^[^\n]*\(([^()\n]*\bint mem)\) \{$", mark_used, code, flags=re.MULTILINE)


def make_unique(names: Iterable[str]) -> tuple[str, ...]:
    """Append underscores to names that are taken already."""
    out: list[str] = []
    for name in names:
        while name in out:
            name += "_"
        out.append(name)
    return tuple(out)


def _describe_entry(names: Mapping[str, Any], name: str) -> str:
    text = name_with_unit(name, names["units"].get(name, ""))
    return f"{text}, r = {names['thresholds'][name]:.6g}" if name in names["thresholds"] else text


def _clean_comment(text: str) -> str:
    """Replace all characters of a text that could end, open or continue a comment."""
    kept = "".join(c if c.isprintable() and c not in "\\?" else "_" for c in text[:200])
    while "*/" in kept or "/*" in kept:
        kept = kept.replace("*/", "* ").replace("/*", " *")
    return kept.strip("/")


def _make_constant_names(prefix: str, names: Sequence[str]) -> list[str]:
    """Make a distinct constant of each name, of letters, digits and underscores."""
    out: list[str] = []
    for name in names:
        plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name.upper()[:60]).strip("_")
        while "__" in plain:
            plain = plain.replace("__", "_")
        options = (prefix + (plain or "_") + ("" if k == 1 else f"_{k}") for k in range(1, len(names) + 2))
        out.append(next(c for c in options if c not in out))
    return out
