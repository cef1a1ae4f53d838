"""The quadratic program of a step inside limits: one Cholesky factorisation, or a conic solver of CasADi."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..models import or_one

SMALLEST_DIVISOR = 1e-300  # keeps quotients of numbers that may be zero finite


class Step(NamedTuple):
    """A quadratic program's step (n,), its multipliers (n + n_g,), and whether it was found."""

    d: np.ndarray
    multipliers: np.ndarray
    good: bool


class QuadraticProgram:
    """Dense quadratic program for a step inside limits.

    The unconstrained step costs one Cholesky factorisation and is the solution if it lies inside all limits. Otherwise
    `ca.conic` is built and finds the active limits.
    """

    def __init__(self, n: int, n_g: int, plugin: str) -> None:
        self._size, self._plugin = (n, n_g), plugin

    @cached_property
    def _solver(self) -> ca.Function:
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
    ) -> Step:
        """Minimise `1/2 d'h d + g'd` over `lbx <= d <= ubx, lba <= a d <= uba`.

        h has a positive diagonal. Solvers have absolute tolerances, so the diagonal and the rows are scaled to one,
        and the step to the steepest slope or, if all slopes are zero, to the violation of the rows at d = 0.
        """
        unit = 1.0 / np.sqrt(np.diag(h))
        a, g = a * unit, g * unit
        row = or_one(np.max(np.abs(a), axis=1, initial=0.0))
        low, high = lba / row, uba / row
        size = float(np.max(np.abs(g))) or float(np.max(np.maximum(low, -high), initial=0.0))
        size = max(size, SMALLEST_DIVISOR)
        rows = a / row[:, None], low / size, high / size
        bounds = lbx / unit / size, ubx / unit / size
        d, multipliers, good = self._solve(h * unit * unit[:, None], g / size, *bounds, *rows)
        return Step(d * size * unit, size * multipliers / np.concatenate([unit, row]), good)

    def _solve(self, h: np.ndarray, g: np.ndarray, *limits: np.ndarray) -> Step:
        lbx, ubx, a, lba, uba = limits
        d = unconstrained_step(h, g)
        if d is not None and np.all((lbx <= d) & (d <= ubx)):
            slack = a @ d
            if np.all((lba <= slack) & (slack <= uba)):
                return Step(d, np.zeros(len(d) + len(slack)), True)
        low, high = np.concatenate([lbx, lba]), np.concatenate([ubx, uba])
        if not np.all((low < np.inf) & (high > -np.inf)):  # an overflow or NaN, at which a plugin raises
            return Step(np.zeros(len(g)), np.zeros(len(g) + len(a)), False)
        out = self._solver(h=h, g=g, lbx=lbx, ubx=ubx, a=a, lba=lba, uba=uba)
        d = np.asarray(out["x"]).ravel()
        multipliers = np.concatenate([np.asarray(out["lam_x"]).ravel(), np.asarray(out["lam_a"]).ravel()])
        return Step(d, multipliers, bool(self._solver.stats()["success"]) and bool(np.all(np.isfinite(d))))


def unconstrained_step(h: np.ndarray, g: np.ndarray) -> np.ndarray | None:
    """Return `-h⁻¹ g` for a positive definite h, else None."""
    from scipy.linalg import cho_factor, cho_solve

    try:
        d = -cho_solve(cho_factor(h, lower=True, check_finite=False), g, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return d if np.all(np.isfinite(d)) else None
