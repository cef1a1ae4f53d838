"""The engine that runs generated C: a model's step, called from the time loops of `_kernel.c`.

Most partial derivatives of a state-space model are parameters, signals or constants themselves. The loops look these
up. Only the others become code, and expressions of parameters alone are evaluated once per run. The slopes of models
with many operators are sparse, so the loops read them from tables. The slopes of a step of several stages are hardly
ever zero and are written out term by term.

Where a step calls another program, CasADi leaves a gap in the code for a callback, and calls an external function by
its name. Both are made to call a buffer, and `simulators.bind` passes the buffers of a thread to a library. A
functional mock-up unit is called only in a process of its own, which runs the whole library.

The loops are built once, a model's library once per structure; `_base.c_compiler` keeps both. Without a
working C compiler `make_engine` falls back to the virtual machine of `sensitivities`. It gives the same numbers, bit by
bit on x86-64, because neither engine fuses products and sums there.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import io
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import LOOPS, InputError, abandoned, build, compiler, one_at_a_time
from ..models import Model
from ..simulators import EXTERNAL_CALLS, FmuSignals, bind, calls_external, run_in_unit, units
from .sensitivities import BLOCKS, TARGETS, Engine, Linearization, VirtualMachine, linearize

_SOURCES = {"x": 0, "s": 1, "z": 2, "w": 3}
_VALUES = ("constant", "p", "fixed", "u", "x", "s", "z", "w", "c", "computed")

# in generated code: the heads of exported functions, and the tests for absent arguments and results
ENTRY = re.compile(r"CASADI_SYMBOL_EXPORT int pilfr_\w+\(const casadi_real\*\* arg")
ABSENT_ARGUMENT = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
ABSENT_RESULT = re.compile(r"if \(res\[\d+\]!=0\) ")
# and the calls of other programs: the gap or the call that CasADi writes, and the call that takes its place
HEAD = r"(/\* (?P<name>\w+):\([^\n]*\n[^\n]*\{\n)"  # comment and first line of a generated function
GAP_LINE = r"#error Code generation not supported[^\n]*"
EXTERNAL_LINE = r"if \((?P=name)\(arg, res, iw, w, mem\)\) return 1;"
GAP = re.compile(HEAD + rf" *({GAP_LINE}|{EXTERNAL_LINE})\n *return 0;")
CALL = re.compile(HEAD + r" *return call_external\(")
GAP_WARNING = "cannot be code generated"


@dataclass(frozen=True, eq=False)
class _Code:
    """Code of a step, and the places of the nonzeros of each block in the kernel's stack of values.

    The functions are `fixed` (p -> f), the expressions of parameters alone, evaluated once per run; `step`; and
    `computed`, the nonzeros that are neither constants nor parameters nor signals, without repetition. `at` holds the
    start of each of `_VALUES` in the stack, and the stack's end. `entries` holds the place in the stack of each
    nonzero, in the order of the block's pattern.
    """

    functions: dict[str, ca.Function]
    constants: list[float]
    at: dict[str, int]
    entries: dict[tuple[str, str], list[int]]

    @classmethod
    def of(cls, linear: Linearization) -> _Code:
        """Sort the nonzeros of a linearization by their source."""
        symbol = linear.symbols()
        stepped = linear.step(*(symbol[k] for k in linear.step.name_in()))
        blocks = linear.blocks(symbol)
        found, names, fixed = [*stepped, *blocks.values()], [], []
        if not calls_external(linear.step):  # extraction loses symbols between calls
            (*found,), names, fixed = ca.extract_parametric(found, symbol["p"], {})
        stepped, blocks = found[: len(stepped)], dict(zip(blocks, found[len(stepped) :], strict=True))
        symbol["fixed"] = ca.vertcat(ca.SX(0, 1), *names)
        known = {e.element_hash(): (k, i) for k, v in symbol.items() for i, e in enumerate(v.elements())}
        constants: dict[float, int] = {}
        computed: dict[int, tuple[int, Any]] = {}

        def place(e: Any) -> tuple[str, int]:
            if e.is_constant():
                return "constant", constants.setdefault(float(e), len(constants))
            if e.element_hash() in known:
                return known[e.element_hash()]
            return "computed", computed.setdefault(e.element_hash(), (len(computed), e))[0]

        def arguments_of(function: ca.Function) -> list[Any]:
            return [symbol[k] for k in (*function.name_in(), "fixed")]

        places = {key: [place(e) for e in block.nonzeros()] for key, block in blocks.items()}
        rest = ca.vertcat(ca.SX(0, 1), *(e for _, e in computed.values()))
        functions = {
            "fixed": ca.Function("pilfr_fixed", [symbol["p"]], [ca.vertcat(ca.SX(0, 1), *fixed)]),
            "step": ca.Function("pilfr_step", arguments_of(linear.step), ca.cse(stepped)),
            "computed": ca.Function("pilfr_computed", arguments_of(linear.partial), [rest]),
        }
        sizes = {"fixed": len(names), "constant": len(constants), "computed": len(computed)}
        at, end = {}, 0
        for k in _VALUES:
            at[k] = end
            end += {**linear.sizes, **sizes}[k]
        entries = {key: [at[k] + i for k, i in each] for key, each in places.items()}
        return cls(functions, list(constants), {**at, "end": end}, entries)


@one_at_a_time
def source_code(linear: Linearization) -> str:
    """Write the C source of one structure: CasADi's code for the step, the term tables, and a `model_t` of both."""
    code = _Code.of(linear)
    at, sizes = code.at, linear.sizes
    options = {"with_header": False, "main": False, "indent": 0, "casadi_int": "long long"}
    generator = ca.CodeGenerator("generated", options)
    with _suppress_gap_warnings() if calls_external(linear.step) else contextlib.nullcontext():
        for function in code.functions.values():
            generator.add(function)
        generated = generator.dump()
    lines = [f"static const double constants[] = {{{', '.join(map(repr, code.constants)) or '0'}}};"]
    staged, most = sizes["c"] > 0, 0
    for target in TARGETS if not staged else ():
        n = sizes[target]
        terms: list[list[str]] = [[] for _ in range(n)]
        directly: list[list[str]] = [[] for _ in range(n)]
        for source, i, j, value in _list_entries(linear, code, target):
            if source == "p":
                directly[i].append(f"{{{j},{value}}}")
            else:
                terms[i].append(f"{{{_SOURCES[source]},{j},{value}}}")
        lines += [*_write_table(f"term_{target}", "term_t", f"row_{target}", terms)]
        lines += [*_write_table(f"direct_{target}", "direct_t", f"direct_row_{target}", directly)]
        most = max(most, sum(map(len, terms)))
    entries = {f: f"pilfr_{f}" for f in code.functions} | {"constants": "constants"}
    if staged:
        written, direct, n_rows = _write_slopes(linear, code)
        lines += [*written, f"static const entered_t direct[] = {{{','.join(direct) or '{0}'}}};"]
        entries |= {"slopes": "slopes", "direct": "direct", "n_direct": str(len(direct))}
        entries["n_direct_rows"] = str(n_rows)
    else:
        entries |= {f"of_{t}": f"{{row_{t}, term_{t}, direct_row_{t}, direct_{t}}}" for t in TARGETS if t != "c"}
    entries |= {f"n_{k}": str(sizes[k]) for k in ("x", "s", "z", "y", "u", "p")}
    entries |= {f"at_{k}": str(at[k]) for k in _VALUES if k != "constant"}
    entries |= {"n_fixed": str(at["u"] - at["fixed"]), "n_values": str(at["end"]), "n_terms": str(most)}
    entries |= {"stride": str(linear.substeps), "sz_w": str(1 + max(f.sz_w() for f in code.functions.values()))}
    # a diagonal s_s lets the memory's slopes be advanced in place
    entries["keeps"] = str(int(linear.partial.sparsity_out(BLOCKS.index(("s", "s"))).is_diag()))
    model = ", ".join(f".{name} = {value}" for name, value in entries.items())
    lines = [_read_source("_kernel.h"), *lines, f"const model_t pilfr_model = {{{model}}};\n"]
    generated = _drop_uncalled(generated)
    if not calls_external(linear.step):
        return "\n".join([_drop_absence_tests(generated), *lines])
    return "\n".join([EXTERNAL_CALLS, _fill_gaps(generated), *lines])


def _fill_gaps(code: str) -> str:
    """Let the gaps and the external functions in generated code call other programs."""
    numbers: dict[str, int] = {}
    return GAP.sub(
        lambda gap: f"{gap[1]}  return call_external({numbers.setdefault(gap['name'], len(numbers))}, arg, res);", code
    )


def _external_names(code: str) -> tuple[str, ...]:
    """List the programs that filled code calls, by their number in the calls."""
    return tuple(dict.fromkeys(found["name"] for found in CALL.finditer(code)))


@contextlib.contextmanager
def _suppress_gap_warnings() -> Iterator[None]:
    """Suppress CasADi's warnings about these gaps; print all other messages afterwards."""
    screen, messages = sys.stderr, io.StringIO()
    with contextlib.redirect_stderr(messages):
        yield
    for line in messages.getvalue().splitlines():
        if GAP_WARNING not in line:
            print(line, file=screen)


def _drop_uncalled(generated: str) -> str:
    """Drop functions that nobody calls, such as CasADi's descriptions: a third of the compiler's work."""
    kept, depth = list[str](), 0  # braces that are open in a dropped definition
    for line in generated.splitlines():
        if depth or (line.startswith("CASADI_SYMBOL_EXPORT ") and not ENTRY.match(line)):
            depth += line.count("{") - line.count("}")
        else:
            kept.append(line)
    return "\n".join(kept)


def _drop_absence_tests(generated: str) -> str:
    """Drop the tests for absent arguments and results, because the loops pass all of them."""
    return ABSENT_RESULT.sub("", ABSENT_ARGUMENT.sub(r"arg[\1][\2]", generated))


def _list_entries(linear: Linearization, code: _Code, target: str) -> Iterator[tuple[str, int, int, int]]:
    """Yield (source, row, column, place of the value) of the slopes of a target."""
    for source in TARGETS[target]:
        pattern = linear.partial.sparsity_out(BLOCKS.index((target, source)))
        for i, j, value in zip(*pattern.get_triplet(), code.entries[target, source], strict=True):
            yield source, i, j, value


def _write_slopes(linear: Linearization, code: _Code) -> tuple[list[str], list[str], int]:
    """Write C code of the slopes of all rows; return it, its direct entries {row, parameter, value}, and their rows.

    The code works on a few columns at a time. Direct derivatives by a parameter have rows of their own, at the same
    places in every step.
    """
    sizes = linear.sizes
    rows = {target: [list[str]() for _ in range(sizes[target])] for target in TARGETS}
    own: dict[tuple[str, int], int] = {}
    direct = list[str]()
    for target in TARGETS:
        for source, i, j, value in _list_entries(linear, code, target):
            if source != "p":
                factor = repr(code.constants[value]) if value < code.at["p"] else f"v[{value}]"
                rows[target][i].append(f"{source}{j}" if factor == "1.0" else f"{factor} * {source}{j}")
                continue
            if (target, i) not in own:
                own[target, i] = len(own)
                rows[target][i].append(f"AT(direct, {own[target, i]})")
            direct.append(f"{{{own[target, i]},{j},{value}}}")
    lines = [f"const lane_t {source}{j} = AT({source}, {j});" for source in ("x", "s") for j in range(sizes[source])]
    for target, name in (("z", "z"), ("w", "w"), ("s", "s_"), ("c", "c"), ("x", "x_"), ("y", "y_")):
        lines += [f"const lane_t {name}{i} = {' + '.join(row) or 'NONE'};" for i, row in enumerate(rows[target])]
    stores = [f"AT({k}_next, {i}) = {k}_{i};" for k in ("s", "x") for i in range(sizes[k])]
    stores += [f"if (y) AT(y, {i}) = y_{i};" for i in range(sizes["y"])]
    read = ("const double *v", *(f"const double *{k}" for k in ("x", "s", "direct")))
    arguments = ", ".join([*read, *(f"double *{k}" for k in ("s_next", "x_next", "y")), "long ld"])
    head = f"OPTIMISED static void slopes({arguments}) {{ for (long j = 0; j < ld; j += WIDTH) {{"
    return [head, *lines, *stores, "} }"], direct, len(own)


def _read_source(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _write_table(name: str, kind: str, starts: str, rows: list[list[str]]) -> tuple[str, str]:
    """Write C tables of the entries of all rows, one after the other, and of the start of each row."""
    first = np.cumsum([0, *map(len, rows)]).tolist()
    flat = ",".join(entry for row in rows for entry in row) or "{0}"
    begins = ",".join(map(str, first))
    return f"static const {kind} {name}[] = {{{flat}}};", f"static const int {starts}[] = {{{begins}}};"


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p:
    return ctypes.c_void_p() if array is None else ctypes.c_void_p(array.ctypes.data)


@functools.cache
def _load(library: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(f"The compiled model cannot be loaded ({error}); use engine='vm'.") from error


def _build_loops() -> Path:
    """Return the library of the time loops."""
    return build("\n".join((_read_source("_kernel.h"), _read_source("_kernel.c"))), LOOPS)


@dataclass(frozen=True)
class _Runs:
    """Runs of a library that holds a model's step.

    `programs` are the names of the programs that it calls; `unit` is the one that is a functional mock-up unit, if any.
    """

    loops: Path
    library: Path
    sizes: dict[str, int]
    substeps: int
    programs: tuple[str, ...]
    unit: FmuSignals | None

    def _call(self, name: str, *arguments: Any) -> None:
        library = _load(self.library)
        if self.unit is not None:
            units.update(dict.fromkeys(self.programs, self.unit))
        if self.programs:
            bind(library, self.programs)
        model = ctypes.byref(ctypes.c_char.in_dll(library, "pilfr_model"))
        failed = getattr(_load(self.loops), name)(model, *arguments)
        abandoned.raise_pending()
        if failed:
            raise MemoryError("the compiled model found no memory for its slopes")

    def simulate(self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool) -> tuple[np.ndarray, ...]:
        """Run the model; results as of `Engine.simulate`."""
        y, state, *more = self.simulation_results(u, state, signals)
        z, w = more or (None, None)
        self._call("pilfr_simulate", ctypes.c_long(len(u)), *map(_pointer, (u, p, state, y, z, w)))
        return (y, state, *more)

    def simulation_results(self, u: np.ndarray, state: np.ndarray, signals: bool) -> tuple[np.ndarray, ...]:
        """Make the arrays of a simulation, NaN but for a copy of the state."""
        m, n = len(u) // self.substeps, self.sizes
        more = [np.full((m, n["z"]), np.nan) for _ in range(2)] if signals else []
        return np.full((m, n["y"]), np.nan), state.copy(), *more

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Run the model with derivatives; results as of `Engine.sensitivity`."""
        y, jac, state, slope = self.sensitivity_results(u, state, seed)
        before, after = map(_pointer, (u, p, state, slope, columns)), map(_pointer, (y, jac))
        n_c = ctypes.c_long(seed.shape[1])
        self._call("pilfr_sensitivity", ctypes.c_long(len(u)), *before, n_c, *after)
        return y, jac, state, slope

    def sensitivity_results(
        self, u: np.ndarray, state: np.ndarray, seed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Make the arrays of a run with derivatives, NaN but for copies of the state and its slope."""
        shape = len(u) // self.substeps, self.sizes["y"]
        return np.full(shape, np.nan), np.full((*shape, seed.shape[1]), np.nan), state.copy(), seed.copy()


class Compiled:
    """Generated C behind the `Engine` protocol; threads may share it.

    A model that calls a functional mock-up unit runs in a process of the unit; if that fails, the results are NaN.
    """

    def __init__(self, model: Model) -> None:
        self.linear = linearize(model)
        self._source = source_code(self.linear)
        programs = _external_names(self._source)
        unit = next((units[name] for name in programs if name in units), None)
        loops, library = _build_loops(), build(self._source)
        self.runs = _Runs(loops, library, self.linear.sizes, self.linear.substeps, programs, unit)
        if unit is None:
            assert _load(loops) and _load(library)

    def _run_in_unit(self, unit: FmuSignals, run: Callable[..., Any], *arguments: np.ndarray | bool) -> Any:
        """Run in a process of the unit; build libraries again that the cache has dropped, which a new process loads."""
        if not (self.runs.loops.exists() and self.runs.library.exists()):
            self.runs = replace(self.runs, loops=_build_loops(), library=build(self._source))
        return run_in_unit(unit, run, (self.runs, *arguments))[0]

    def _arguments(self, u: np.ndarray, p: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, ...]:
        n = self.linear.sizes
        u = np.ascontiguousarray(u, dtype=float).reshape(len(u), n["u"])
        p = np.ascontiguousarray(p, dtype=float).reshape(n["p"])
        return u, p, np.array(state, dtype=float).reshape(n["x"] + n["s"])

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """See `Engine.simulate`."""
        u, p, state = self._arguments(u, p, state)
        if self.runs.unit is None:
            return self.runs.simulate(u, p, state, signals)
        found = self._run_in_unit(self.runs.unit, _Runs.simulate, u, p, state, signals)
        return found or tuple(a * np.nan for a in self.runs.simulation_results(u, state, signals))

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `Engine.sensitivity`."""
        u, p, state = self._arguments(u, p, state)
        seed = np.array(seed, dtype=float, order="C").reshape(len(state), seed.shape[1])
        column = np.ascontiguousarray(columns, dtype=ctypes.c_long).reshape(len(p))
        if self.runs.unit is None:
            return self.runs.sensitivity(u, p, state, seed, column)
        found = self._run_in_unit(self.runs.unit, _Runs.sensitivity, u, p, state, seed, column)
        y, jac, state, slope = found or (a * np.nan for a in self.runs.sensitivity_results(u, state, seed))
        return y, jac, state, slope


def make_engine(model: Model, engine: str = "auto") -> Engine:
    """Make the engine for a closed model: "c", "vm", or "auto" (C where there is a compiler that works)."""
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
