"""C source of a model's step with its derivatives, written out by CasADi, and of the time loops that call it.

Most partial derivatives of a state-space model are parameters, signals or constants themselves. The loops look these
up; only the others are written out as code. What depends on parameters alone is evaluated once a run.

The slopes of a state-space model with many operators are looked up in tables, whose zeros cost nothing. Those of a step
of several stages, of which nearly none is ever zero, are written out term by term.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import one_at_a_time
from .sensitivities import BLOCKS, TARGETS, Linearization

_SOURCES = {"x": 0, "s": 1, "z": 2, "w": 3}
_VALUES = ("constant", "p", "fixed", "u", "x", "s", "z", "w", "c", "computed")


@dataclass(frozen=True, eq=False)
class _Code:
    """What is written out in C, and where the kernel finds the nonzeros of each block.

    Attributes
    ----------
    functions : dict
        `fixed` (p -> f), what depends on parameters alone, evaluated once a run; `step`; and `computed`, the nonzeros
        that are neither constants nor parameters nor signals, each once.
    at : dict
        Where each of `_VALUES` begins in the stack of values, and its `end`.
    entries : dict
        The place in the stack of each nonzero, in the order of the block's pattern.
    """

    functions: dict[str, ca.Function]
    constants: list[float]
    at: dict[str, int]
    entries: dict[tuple[str, str], list[int]]

    @classmethod
    def of(cls, linear: Linearization) -> _Code:
        """Sort the nonzeros by where they come from."""
        symbol = linear.symbols()
        stepped = linear.step(*(symbol[k] for k in linear.step.name_in()))
        blocks = linear.blocks(symbol)
        (*found,), names, fixed = ca.extract_parametric([*stepped, *blocks.values()], symbol["p"], {})
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

        def given(function: ca.Function) -> list[Any]:
            return [symbol[k] for k in (*function.name_in(), "fixed")]

        places = {key: [place(e) for e in block.nonzeros()] for key, block in blocks.items()}
        rest = ca.vertcat(ca.SX(0, 1), *(e for _, e in computed.values()))
        functions = {
            "fixed": ca.Function("pilfr_fixed", [symbol["p"]], [ca.vertcat(ca.SX(0, 1), *fixed)]),
            "step": ca.Function("pilfr_step", given(linear.step), ca.cse(stepped)),
            "computed": ca.Function("pilfr_computed", given(linear.partial), [rest]),
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
    """The C source of one structure: CasADi's code for the step, the term tables, and a `model_t` that names them."""
    code = _Code.of(linear)
    at, sizes = code.at, linear.sizes
    options = {"with_header": False, "main": False, "indent": 0, "casadi_int": "long long"}
    generator = ca.CodeGenerator("generated", options)
    for function in code.functions.values():
        generator.add(function)
    lines = [f"static const double constants[] = {{{', '.join(map(repr, code.constants)) or '0'}}};"]
    staged, most = sizes["c"] > 0, 0
    for target in TARGETS if not staged else ():
        n = sizes[target]
        terms: list[list[str]] = [[] for _ in range(n)]
        directly: list[list[str]] = [[] for _ in range(n)]
        for source, i, j, value in _entries(linear, code, target):
            if source == "p":
                directly[i].append(f"{{{j},{value}}}")
            else:
                terms[i].append(f"{{{_SOURCES[source]},{j},{value}}}")
        lines += [*_table(f"term_{target}", "term_t", f"row_{target}", terms)]
        lines += [*_table(f"direct_{target}", "direct_t", f"direct_row_{target}", directly)]
        most = max(most, sum(map(len, terms)))
    entries = {f: f"pilfr_{f}" for f in code.functions} | {"constants": "constants"}
    if staged:
        written, direct, n_rows = _written(linear, code)
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
    return "\n".join([generator.dump(), _text("_kernel.h"), *lines, f"const model_t pilfr_model = {{{model}}};\n"])


def _entries(linear: Linearization, code: _Code, target: str) -> Iterator[tuple[str, int, int, int]]:
    """(source, row, column, where its value is) of the slopes of a target."""
    for source in TARGETS[target]:
        pattern = linear.partial.sparsity_out(BLOCKS.index((target, source)))
        for i, j, value in zip(*pattern.get_triplet(), code.entries[target, source], strict=True):
            yield source, i, j, value


def _written(linear: Linearization, code: _Code) -> tuple[list[str], list[str], int]:
    """C code of the slopes of all rows, its direct entries {row, parameter, value}, and how many rows these have.

    The code works on a few columns at a time. What depends on a parameter directly is entered into rows of its own, in
    the same place at every step.
    """
    sizes = linear.sizes
    rows = {target: [list[str]() for _ in range(sizes[target])] for target in TARGETS}
    own: dict[tuple[str, int], int] = {}
    direct = list[str]()
    for target in TARGETS:
        for source, i, j, value in _entries(linear, code, target):
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


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _table(name: str, kind: str, starts: str, rows: list[list[str]]) -> tuple[str, str]:
    """C tables of the entries of all rows, one after the other, and of where each row begins."""
    first = np.cumsum([0, *map(len, rows)]).tolist()
    flat = ",".join(entry for row in rows for entry in row) or "{0}"
    begins = ",".join(map(str, first))
    return f"static const {kind} {name}[] = {{{flat}}};", f"static const int {starts}[] = {{{begins}}};"


def loops_code() -> str:
    """The C source of the time loops."""
    return "\n".join((_text("_kernel.h"), _text("_kernel.c")))
