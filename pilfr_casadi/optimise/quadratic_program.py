"""The dense quadratic program inside a Gauss-Newton step: an unconstrained step first, a conic solver where needed."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np


class QuadraticProgram:
    """Dense QP; solves for a step inside limits.

    Where the unconstrained step lies inside all of them it is the solution, for the price of a Cholesky factorisation.
    Else `ca.conic`, built when it is first needed, finds out which limits hold it.
    """

    def __init__(self, n: int, n_g: int, plugin: str) -> None:
        self._size, self._plugin = (n, n_g), plugin

    @cached_property
    def _solve(self) -> ca.Function:
        (n, n_g), plugin = self._size, self._plugin
        structure = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(n_g, n)}
        quiet = {"daqp": {}, "qrqp": {"print_iter": False, "print_header": False, "print_info": False}}.get(plugin, {})
        return ca.conic("qp", plugin, structure, {**quiet, "error_on_fail": False})

    def __call__(
        self,
        h: np.ndarray,
        g: np.ndarray,
        lbx: np.ndarray,
        ubx: np.ndarray,
        a: np.ndarray,
        lba: np.ndarray,
        uba: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Minimise `1/2 d'h d + g'd` over `lbx <= d <= ubx, lba <= a d <= uba`: d, multipliers, whether found.

        h has a positive diagonal. A solver's tolerances are absolute: it gets unit diagonal and rows, and the step in
        units of the steepest slope or, where there is none, of what the rows lack at d = 0.
        """
        unit = 1.0 / np.sqrt(np.diag(h))
        a, g = a * unit, g * unit
        row = np.max(np.abs(a), axis=1, initial=0.0)
        row = np.where(row > 0, row, 1.0)
        low, high = lba / row, uba / row
        size = float(np.max(np.abs(g))) or float(np.max(np.maximum(low, -high), initial=0.0))
        size = max(size, 1e-300)
        rows = a / row[:, None], low / size, high / size
        d, multipliers, good = self._solved(
            h * unit * unit[:, None], g / size, lbx / unit / size, ubx / unit / size, *rows
        )
        return d * size * unit, size * multipliers / np.concatenate([unit, row]), good

    def _solved(self, h: np.ndarray, g: np.ndarray, *limits: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """The same as it stands."""
        lbx, ubx, a, lba, uba = limits
        d = unconstrained(h, g)
        if d is not None and np.all((lbx <= d) & (d <= ubx)):
            slack = a @ d
            if np.all((lba <= slack) & (slack <= uba)):
                return d, np.zeros(len(d) + len(slack)), True
        low, high = np.concatenate([lbx, lba]), np.concatenate([ubx, uba])
        if not np.all((low < np.inf) & (high > -np.inf)):  # too far away for numbers, or none: a plugin would raise
            return np.zeros(len(g)), np.zeros(len(g) + len(a)), False
        out = self._solve(h=h, g=g, lbx=lbx, ubx=ubx, a=a, lba=lba, uba=uba)
        d = np.asarray(out["x"]).ravel()
        multipliers = np.concatenate([np.asarray(out["lam_x"]).ravel(), np.asarray(out["lam_a"]).ravel()])
        return d, multipliers, bool(self._solve.stats()["success"]) and bool(np.all(np.isfinite(d)))


def unconstrained(h: np.ndarray, g: np.ndarray) -> np.ndarray | None:
    """`-h⁻¹ g` for a positive definite h, else None."""
    from scipy.linalg import cho_factor, cho_solve

    try:
        d = -cho_solve(cho_factor(h, lower=True, check_finite=False), g, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return d if np.all(np.isfinite(d)) else None
