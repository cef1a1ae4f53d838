"""Sensitivities of the simulated output by a matrix-form recursion, from one linearised symbolic step.

With `z = h(x, u, p)`, `(w, s⁺) = e(z, s, p)`, `(x⁺, y) = f(x, u, w, p)` and capitals for derivatives with respect to the
estimated parameters and the initial state:

    Z  = h_x X + h_p,          W = e_z Z + e_s S + e_p,      S⁺ = g_z Z + g_s S + g_p,
    X⁺ = f_x X + f_w W + f_p,  Y = y_x X + y_w W + y_p.

`Linearization` holds the partial derivatives' patterns and one Function that gives their nonzeros; both engines run on it:
`VirtualMachine` here (CasADi only, `mapaccum` in blocks, so memory stays small) and the generated C of `compiled.py`.
The record is never differentiated as a whole: time and memory are linear in its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from .model import Model

TARGETS = {"z": ("x", "p"), "w": ("z", "s", "p"), "s": ("z", "s", "p"), "x": ("x", "w", "p"), "y": ("x", "w", "p")}


@dataclass(frozen=True, eq=False)
class Linearization:
    """One step with all its partial derivatives.

    Attributes
    ----------
    step : casadi.Function
        `(x, s, u, p) -> (x_next, s_next, y, z, w)`.
    function : casadi.Function
        `(x, s, u, p) -> (x_next, s_next, y, nonzeros)`.
    patterns : dict
        (target, source) -> casadi.Sparsity, in the order in which the nonzeros are stacked.
    """

    step: ca.Function
    function: ca.Function
    patterns: dict[tuple[str, str], ca.Sparsity]
    sizes: dict[str, int]


def linearize(model: Model) -> Linearization:
    """Differentiate one step of a closed model symbolically."""
    x, s, u, p = model.symbols()
    z, w = ca.SX.sym("z", model.n_w), ca.SX.sym("w", model.n_w)
    w_out, s_next = model.memory(z, s, p)
    x_next, y = model.step(x, u, w, p)
    value = {"z": model.port(x, u, p), "w": w_out, "s": s_next, "x": x_next, "y": y}
    symbol = {"x": x, "s": s, "z": z, "w": w, "p": p}
    patterns, nonzeros = {}, []
    for target, sources in TARGETS.items():
        for source in sources:
            block = ca.jacobian(value[target], symbol[source])
            patterns[target, source] = block.sparsity()
            nonzeros.append(ca.vertcat(*block.nonzeros()) if block.nnz() else ca.SX(0, 1))
    partial = ca.Function("partial", [x, s, z, w, u, p], [ca.vertcat(*nonzeros)])
    z_now = model.port(x, u, p)
    w_now, s_now = model.memory(z_now, s, p)
    x_now, y_now = model.step(x, u, w_now, p)
    names = ["x", "s", "u", "p"]
    step = ca.Function(
        "pilfr_step", [x, s, u, p], [x_now, s_now, y_now, z_now, w_now], names, ["x_next", "s_next", "y", "z", "w"]
    )
    outputs = ca.cse([x_now, s_now, y_now, partial(x, s, z_now, w_now, u, p)])
    function = ca.Function("pilfr_linear", [x, s, u, p], outputs, names, ["x_next", "s_next", "y", "nonzeros"])
    sizes = {
        "x": model.n_x,
        "s": model.n_s,
        "z": model.n_w,
        "w": model.n_w,
        "y": model.n_y,
        "u": model.n_u,
        "p": p.shape[0],
    }
    return Linearization(step, function, patterns, sizes)


class Engine(Protocol):
    """What runs a model over a stretch of samples; both ways of running give the same numbers."""

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """u (M, n_u), p (n_p,), state (n_x + n_s,) -> y (M, n_y), next state, and z, w (M, n_w) if `signals`."""

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `simulate`, with derivatives.

        seed (n_x + n_s, n_c) is the state's derivative, columns (n_p,) gives each parameter's column or -1
        -> y, J (M, n_y, n_c), next state, next seed.
        """


class VirtualMachine:
    """The engine that needs no compiler: `mapaccum` over blocks in CasADi's virtual machine."""

    block = 64

    def __init__(self, model: Model) -> None:
        self.linear = linearize(model)
        self._maps: dict[tuple[int, int, bytes], ca.Function] = {}

    def _simulator(self, length: int) -> ca.Function:
        key = (length, 0, b"simulate")
        if key not in self._maps:
            n = self.linear.sizes
            x, s, u, p = (ca.SX.sym(k, n[k]) for k in ("x", "s", "u", "p"))
            x_next, s_next, y, z, w = self.linear.step(x, s, u, p)
            step = ca.Function("sim", [ca.vertcat(x, s), u, p], [ca.vertcat(x_next, s_next), y, z, w])
            self._maps[key] = step.mapaccum("sim", length, 1)
        return self._maps[key]

    def _sensitivity(self, length: int, n_c: int, columns: np.ndarray) -> ca.Function:
        key = (length, n_c, columns.tobytes())
        if key not in self._maps:
            n = self.linear.sizes
            n_state = n["x"] + n["s"]
            accumulated = ca.MX.sym("a", n_state, 1 + n_c)
            u, p = ca.MX.sym("u", n["u"]), ca.MX.sym("p", n["p"])
            used = np.flatnonzero(columns >= 0)
            select = ca.DM.triplet(used.tolist(), columns[used].tolist(), ca.DM.ones(len(used)), n["p"], n_c)
            x, s = accumulated[: n["x"], 0], accumulated[n["x"] :, 0]
            x_next, s_next, y, nonzeros = self.linear.function(x, s, u, p)
            block, at = {}, 0
            for key_block, pattern in self.linear.patterns.items():
                count = pattern.nnz()
                block[key_block] = ca.MX(pattern, nonzeros[at : at + count]) if count else ca.MX(*pattern.shape)
                at += count
            slope = {"x": accumulated[: n["x"], 1:], "s": accumulated[n["x"] :, 1:], "p": select}
            result = {}
            for target, sources in TARGETS.items():
                total = ca.MX(n[target], n_c)
                for source in sources:
                    if block[target, source].nnz():
                        total = total + ca.mtimes(block[target, source], slope[source])
                if target in ("z", "w"):
                    slope[target] = total
                result[target] = total
            following = ca.vertcat(
                ca.horzcat(x_next, ca.densify(result["x"])), ca.horzcat(s_next, ca.densify(result["s"]))
            )
            step = ca.Function("sens", [accumulated, u, p], [following, y, ca.densify(result["y"])])
            self._maps[key] = step.mapaccum("sens", length, 1)
        return self._maps[key]

    def _blocks(self, length: int) -> list[tuple[int, int]]:
        return [(a, min(a + self.block, length)) for a in range(0, length, self.block)]

    def simulate(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, signals: bool = False
    ) -> tuple[np.ndarray, ...]:
        """See `Engine.simulate`."""
        n = self.linear.sizes
        y, z, w = np.empty((len(u), n["y"])), np.empty((len(u), n["w"])), np.empty((len(u), n["w"]))
        for a, b in self._blocks(len(u)):
            states, y_b, z_b, w_b = self._simulator(b - a)(state, u[a:b].T, p)
            state = np.asarray(states[:, -1]).ravel()
            y[a:b], z[a:b], w[a:b] = np.asarray(y_b).T, np.asarray(z_b).T, np.asarray(w_b).T
        return (y, state, z, w) if signals else (y, state)

    def sensitivity(
        self, u: np.ndarray, p: np.ndarray, state: np.ndarray, seed: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `Engine.sensitivity`."""
        n = self.linear.sizes
        n_c, length = seed.shape[1], len(u)
        y, jac = np.empty((length, n["y"])), np.empty((length, n["y"], n_c))
        accumulated = np.asfortranarray(np.column_stack([state, seed]))
        columns = np.asarray(columns, dtype=int)
        for a, b in self._blocks(length):
            buffer, evaluate = self._sensitivity(b - a, n_c, columns).buffer()
            u_b, p_b = (
                np.asfortranarray(u[a:b].T, dtype=float),
                np.repeat(np.asarray(p, dtype=float)[None, :], b - a, axis=0),
            )
            following = np.empty((n["x"] + n["s"], (1 + n_c) * (b - a)), order="F")
            y_b, j_b = np.empty((n["y"], b - a), order="F"), np.empty((n["y"], n_c * (b - a)), order="F")
            for i, array in enumerate((accumulated.ravel(order="F"), u_b.ravel(order="F"), p_b.ravel())):
                buffer.set_arg(i, memoryview(array))
            for i, array in enumerate((following, y_b, j_b)):
                buffer.set_res(i, memoryview(array.reshape(-1, order="F")))
            evaluate()
            accumulated = np.asfortranarray(following[:, -(1 + n_c) :])
            y[a:b] = y_b.T
            jac[a:b] = j_b.T.reshape(b - a, n_c, n["y"]).transpose(0, 2, 1)
        return y, jac, accumulated[:, 0].copy(), accumulated[:, 1:].copy()
