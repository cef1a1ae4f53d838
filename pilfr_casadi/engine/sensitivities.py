"""Sensitivities of the simulated output by a matrix-form recursion, from one linearised symbolic step.

With `z = h(x, u, p)`, `(w, s⁺) = e(z, s, p)`, `(x⁺, y) = f(x, u, w, p)` and capitals for derivatives with respect to
the estimated parameters and the initial state:

    Z  = h_x X + h_p,          W = e_z Z + e_s S + e_p,      S⁺ = g_z Z + g_s S + g_p,
    X⁺ = f_x X + f_w W + f_p,  Y = y_x X + y_w W + y_p.

A step of several stages has sparse derivatives if they are written with its intermediate values c:
`c = k(x, u, w, c, p)`, where each entry depends on earlier ones only, and `x⁺ = f(x, u, w, c, p)`. Then the recursion
also carries `C = k_x X + k_w W + k_c C + k_p`, row by row.

`Linearization` holds the step and its partial derivatives; both engines run on it: `VirtualMachine` here (CasADi only,
a few samples unrolled at a time) and the generated C of `compiled.py`. The record is never differentiated as a whole,
so time and memory are linear in its length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np

from .._base import abandoned, one_at_a_time, unwrapped_interrupt
from ..models import Model
from ..simulators import calls_external

TARGETS = {
    "z": ("x", "p"),
    "w": ("z", "s", "p"),
    "s": ("z", "s", "p"),
    "c": ("x", "w", "c", "p"),
    "x": ("x", "w", "c", "p"),
    "y": ("x", "w", "p"),
}
# largest number of states and memory for which the slopes of the intermediate values fit the processor's fastest cache
MOST_STAGED = 64
BLOCKS = tuple((target, source) for target, sources in TARGETS.items() for source in sources)


@dataclass(frozen=True, eq=False)
class Linearization:
    """Step of a model with all its partial derivatives."""

    step: ca.Function  # (x, s, u, p) -> (x_next, s_next, y, z, w, c)
    partial: ca.Function  # (x, s, z, w, c, u, p) -> z_x, z_p, ...: a sparse matrix for each (target, source) of BLOCKS
    sizes: dict[str, int]  # of x, s, z, w, c, u, p and y
    substeps: int = 1  # steps per sample

    def symbols(self) -> dict[str, Any]:
        """Make symbols x, s, z, w, c, u, p."""
        return {k: ca.SX.sym(k, n) for k, n in self.sizes.items() if k != "y"}

    def blocks(self, values: dict[str, Any]) -> dict[tuple[str, str], Any]:
        """Evaluate the partial derivatives at values of x, s, z, w, c, u, p."""
        found = self.partial(*(values[k] for k in self.partial.name_in()))
        return dict(zip(BLOCKS, found, strict=True))


@one_at_a_time
def linearize(model: Model) -> Linearization:
    """Differentiate one step of a closed model symbolically, with its intermediate values if it has any."""
    x, s, u, p = model.symbols()
    z_now = model.port(x, u, p)
    w_now, s_now = model.memory(z_now, s, p)
    x_now, y_now = model.step(x, u, w_now, p)
    stages = model.stages if model.n_state <= MOST_STAGED else None
    c = ca.SX.sym("c", stages.size1_in(4) if stages else 0)
    c_now = stages(x, u, w_now, p, c)[0] if stages else c
    outputs = ca.cse([x_now, s_now, y_now, z_now, w_now, c_now])
    names = ["x_next", "s_next", "y", "z", "w", "c"]
    step = ca.Function("pilfr_step", [x, s, u, p], outputs, ["x", "s", "u", "p"], names)
    z, w = ca.SX.sym("z", model.n_w), ca.SX.sym("w", model.n_w)
    w_out, s_next = model.memory(z, s, p)
    x_next, y = model.step(x, u, w, p)
    by_c, x_next = stages(x, u, w, p, c)[1:] if stages else (c, x_next)
    value = {"z": model.port(x, u, p), "w": w_out, "s": s_next, "c": by_c, "x": x_next, "y": y}
    symbol = {"x": x, "s": s, "z": z, "w": w, "c": c, "u": u, "p": p}
    # calls of other programs have derivatives along directions only
    options = {"helper_options": {"ad_weight": 0.0}} if calls_external(step) else {}
    blocks = [ca.jacobian(value[target], symbol[source], options) for target, source in BLOCKS]
    names = [f"{target}_{source}" for target, source in BLOCKS]
    partial = ca.Function("pilfr_partial", list(symbol.values()), ca.cse(blocks), list(symbol), names)
    sizes = {k: int(v.shape[0]) for k, v in symbol.items()}
    return Linearization(step, partial, {**sizes, "y": model.n_y}, model.substeps)


class Engine(Protocol):
    """Run of a model over a stretch of samples; both engines give the same numbers, bit by bit on x86-64.

    u has one row per step, `Model.substeps` per sample; outputs, derivatives and signals have one row per sample.
    """

    linear: Linearization

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """u (M, n_u), p (n_p,), state (n_x + n_s,) -> y (M, n_y), next state, and z, w (M, n_w) if `signals`."""

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `simulate`, with derivatives.

        seed (n_x + n_s, n_c) is the state's derivative, columns (n_p,) gives each parameter's own column or -1
        -> y, J (M, n_y, n_c), next state, next seed; the caller may change all of them.
        """


def _advance(slope: dict[str, Any], block: dict[tuple[str, str], Any], target: str) -> Any:
    """Compute the transposed slopes of a target, summed in the order of the generated C so that all bits agree."""
    direct = block[target, "p"]
    total = ca.MX.zeros(*direct.shape)
    for source in TARGETS[target][:-1]:
        if (target, source) != ("c", "c") and block[target, source].nnz():
            total = ca.mac(slope[source], block[target, source], total)
    if target == "c":
        return _complete_stages(total, block["c", "c"], direct)
    return total + ca.densify(direct) if direct.nnz() else total


def _complete_stages(total: Any, by_stages: Any, direct: Any) -> Any:
    """Complete the transposed slopes of the intermediate values in turn, because each needs the earlier ones."""
    columns = ca.horzsplit(total) if total.shape[1] else []
    for i in range(len(columns)):
        before = by_stages[:, i]
        for k, j in enumerate(before.sparsity().row()):
            columns[i] = columns[i] + before.nz[k] * columns[j]
        if direct[:, i].nnz():
            columns[i] = columns[i] + ca.densify(direct[:, i])
    return ca.horzcat(total[:, :0], *columns)


class VirtualMachine:
    """The engine that needs no compiler: CasADi's virtual machine, a few samples unrolled in each call.

    The slopes are carried transposed, one row per column of J: products then run along their long side.
    """

    block = 32

    def __init__(self, model: Model) -> None:
        self.linear = linearize(model)
        self._functions: dict[tuple[int, int, bytes], ca.Function] = {}

    def _simulator(self, length: int) -> ca.Function:
        """`(u, p, state) -> (y, z, w, next state)`, one column per sample."""
        key = (length, -1, b"")
        if key not in self._functions:
            n, stride = self.linear.sizes, self.linear.substeps
            u, p = ca.MX.sym("u", n["u"], length * stride), ca.MX.sym("p", n["p"])
            first = ca.MX.sym("state", n["x"] + n["s"])
            x, s, signals = first[: n["x"]], first[n["x"] :], []
            for k in range(length * stride):
                x, s, *now, _ = self.linear.step(x, s, u[:, k], p)
                if k % stride == 0:
                    signals.append(now)
            columns = [ca.horzcat(*each) for each in zip(*signals, strict=True)]
            self._functions[key] = ca.Function("simulate", [u, p, first], [*columns, ca.vertcat(x, s)])
        return self._functions[key]

    def _sensitivity(self, length: int, n_c: int, columns: np.ndarray) -> ca.Function:
        """`(u, p, state, slope) -> (y, J, next state, next slope)`; slope (n_c, n_x + n_s), J (n_c, n_y) per sample."""
        key = (length, n_c, columns.tobytes())
        if key not in self._functions:
            n, stride, linear = self.linear.sizes, self.linear.substeps, self._transposed(n_c, columns)
            u, p = ca.MX.sym("u", n["u"], length * stride), ca.MX.sym("p", n["p"])
            first = ca.MX.sym("state", n["x"] + n["s"])
            x, s, y, jac = first[: n["x"]], first[n["x"] :], [], []
            slopes = ca.MX.sym("slope", n_c, n["x"] + n["s"])
            slope = {"x": slopes[:, : n["x"]], "s": slopes[:, n["x"] :]}
            for k in range(length * stride):
                x, s, y_k, *found = linear(x, s, u[:, k], p)
                block, following = dict(zip(BLOCKS, found, strict=True)), dict[str, Any]()
                for target in TARGETS:
                    (slope if target in ("z", "w", "c") else following)[target] = _advance(slope, block, target)
                slope = following
                if k % stride == 0:
                    y.append(y_k)
                    jac.append(slope["y"])
            outputs = [ca.horzcat(*y), ca.horzcat(*jac), ca.vertcat(x, s), ca.horzcat(slope["x"], slope["s"])]
            self._functions[key] = ca.Function("sensitivity", [u, p, first, slopes], outputs)
        return self._functions[key]

    def _transposed(self, n_c: int, columns: np.ndarray) -> ca.Function:
        """`(x, s, u, p) -> (x_next, s_next, y, blocks)`, transposed; blocks of p have one row per column of J."""
        value, used = self.linear.symbols(), np.flatnonzero(columns >= 0)
        select = ca.DM.triplet(columns[used].tolist(), used.tolist(), ca.DM.ones(len(used)), n_c, len(columns))
        arguments = [value[k] for k in ("x", "s", "u", "p")]
        *following, value["z"], value["w"], value["c"] = self.linear.step(*arguments)
        blocks = self.linear.blocks(value)
        turned = [ca.mtimes(select, b.T) if source == "p" else b.T for (_, source), b in blocks.items()]
        return ca.Function("linear", arguments, ca.cse([*following, *turned]))

    def _run(
        self,
        build: Callable[[int], ca.Function],
        u: np.ndarray,
        p: np.ndarray,
        out: list[np.ndarray],
        carried: list[np.ndarray],
    ) -> list[np.ndarray]:
        """Fill `out`, one row per sample, block by block; return the arrays carried from block to block."""
        u, p = np.ascontiguousarray(u, dtype=float), np.ascontiguousarray(p, dtype=float)
        at, stride, following = 0, self.linear.substeps, [np.empty_like(a) for a in carried]
        for length in (max(self.block // stride, 1), 1):
            if (at + length) * stride > len(u):
                continue
            buffer, evaluate = build(length).buffer()
            buffer.set_arg(1, p.data)
            while (at + length) * stride <= len(u):
                buffer.set_arg(0, u[at * stride : (at + length) * stride].data)
                for i, array in enumerate(out):
                    buffer.set_res(i, array[at : at + length].data)
                for i, (before, after) in enumerate(zip(carried, following, strict=True)):
                    buffer.set_arg(2 + i, before.data)
                    buffer.set_res(len(out) + i, after.data)
                with unwrapped_interrupt():
                    evaluate()
                abandoned.raise_pending()
                carried, following = following, carried
                at += length
        return carried

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """See `Engine.simulate`."""
        y, z, w = (np.empty((len(u) // self.linear.substeps, self.linear.sizes[k])) for k in ("y", "z", "w"))
        (state,) = self._run(self._simulator, u, p, [y, z, w], [np.array(state, dtype=float)])
        return (y, state, z, w) if signals else (y, state)

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `Engine.sensitivity`."""
        n_y, n_c, columns = self.linear.sizes["y"], seed.shape[1], np.asarray(columns, dtype=int)
        m = len(u) // self.linear.substeps
        y, jac = np.empty((m, n_y)), np.empty((m, n_y, n_c))
        carried = [np.array(state, dtype=float), np.array(seed, dtype=float, order="C")]
        state, slope = self._run(lambda m: self._sensitivity(m, n_c, columns), u, p, [y, jac], carried)
        return y, jac, state, slope
