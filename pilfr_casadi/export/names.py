"""Names that an exported function may have: in CasADi, as a file and in C, where it begins every name."""

from __future__ import annotations

from typing import Any

import casadi as ca

from .._base import InputError

LONGEST = 50  # C tells names apart by their first 63 characters, and the longest ending is "_casadi"
KEYWORDS = frozenset(  # of C and C++
    (  # noqa: SIM905
        "alignas alignof and asm auto bool break case catch char class compl const constexpr continue decltype default "
        "delete do double else enum explicit export extern false float for friend goto if inline int long mutable "
        "namespace new noexcept not nullptr operator or private protected public register reinterpret restrict return "
        "short signed sizeof static struct switch template this throw true try typedef typeid typename union unsigned "
        "using virtual void volatile while xor"
    ).split()
)
HEADERS = frozenset(  # of C's library; `<name>.h` would stand in their way
    (  # noqa: SIM905
        "assert complex ctype errno fenv float inttypes iso646 limits locale malloc math memory mex setjmp signal "
        "stdarg stdbool stddef stdint stdio stdlib string strings tgmath threads time uchar unistd wchar wctype"
    ).split()
)


def check_name(name: Any) -> None:
    """Refuse a function name that CasADi, a file or C does not take.

    Raises
    ------
    InputError
        That says why.
    """
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise InputError(
            f"The function name {str(name)[:60]!r} cannot be used; give letters, digits and single underscores."
        )
    if len(name) > LONGEST:
        raise InputError(f"The function name {name[:20]}... has {len(name)} characters; give at most {LONGEST}.")
    if name.lower() in KEYWORDS | HEADERS:
        what = "a word of C" if name.lower() in KEYWORDS else "the name of one of C's headers"
        raise InputError(f"The function name {name!r} is {what}; give another one.")
