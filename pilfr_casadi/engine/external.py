"""Generated C that calls other programs (`simulators.leaves`), for which CasADi cannot write code.

CasADi leaves a gap where a function is a callback, and calls an external function by its name. `fill_gaps` lets both
call a buffer, and `simulators.bind` passes the buffers of a thread to a library. A functional mock-up unit is called
only in a process of its own, which runs the whole library.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Iterator

HEAD = r"(/\* (?P<name>\w+):\([^\n]*\n[^\n]*\{\n)"  # comment and first line of a generated function
GAP_LINE = r"#error Code generation not supported[^\n]*"
EXTERNAL_LINE = r"if \((?P=name)\(arg, res, iw, w, mem\)\) return 1;"
GAP = re.compile(HEAD + rf" *({GAP_LINE}|{EXTERNAL_LINE})\n *return 0;")
CALL = re.compile(HEAD + r" *return call_external\(")
GAP_WARNING = "cannot be code generated"


def fill_gaps(code: str) -> str:
    """Let the gaps and the external functions in generated code call the programs of `leaves` and `units`."""
    numbers: dict[str, int] = {}
    return GAP.sub(
        lambda gap: f"{gap[1]}  return call_external({numbers.setdefault(gap['name'], len(numbers))}, arg, res);", code
    )


def external_names(code: str) -> tuple[str, ...]:
    """List the programs that filled code calls, by their number in the calls."""
    return tuple(dict.fromkeys(found["name"] for found in CALL.finditer(code)))


@contextlib.contextmanager
def suppress_gap_warnings() -> Iterator[None]:
    """Suppress CasADi's warnings about these gaps; print all other messages afterwards."""
    screen, messages = sys.stderr, io.StringIO()
    with contextlib.redirect_stderr(messages):
        yield
    for line in messages.getvalue().splitlines():
        if GAP_WARNING not in line:
            print(line, file=screen)
