"""Find polynomial equations of a program that is called with numbers.

The candidates are all products of at most `HIGHEST_DEGREE` arguments and reciprocals of arguments that are never zero
(masses, time constants). Least squares at random points give their coefficients, and negligible terms are dropped, as
in sparse identification (Brunton, Proctor & Kutz 2016, PNAS 113). There is no noise: at other points, whose sizes span
decades, the equations must agree with the program to six digits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

HIGHEST_DEGREE = 4  # a cubic spring times its stiffness
MOST_TERMS = 1500  # candidates, for which a fit takes seconds
POINTS_PER_TERM = 2  # random points for each candidate
CHECKED_POINTS = 200
NEGLIGIBLE = 1e-7  # share of the largest term of a row below which a term is dropped
AGREE = 1e-6  # allowed relative difference from the program at the checked points
COEFFICIENT_DIGITS = 8  # so that the derivative of a position is exactly the speed


def find_polynomials(
    evaluate: Callable[[np.ndarray], np.ndarray],
    draw: Callable[[int, bool], np.ndarray],
    reciprocals: Sequence[int],
) -> ca.Function | None:
    """Find the equations `z -> r` from evaluations.

    Parameters
    ----------
    evaluate : callable
        From points z (K, n) to r (K, m); NaN where it fails.
    draw : callable
        From a number K and whether sizes shall span decades to random points z, (K, n).
    reciprocals : sequence of int
        Arguments that are never zero.

    Returns
    -------
    casadi.Function
        `z -> r`; None if the program has no such equations.
    """
    checked = draw(CHECKED_POINTS, True)
    wanted = evaluate(checked)
    if not np.all(np.isfinite(wanted)):
        return None
    n, inverse = checked.shape[1], list(reciprocals)
    for degree in range(1, HIGHEST_DEGREE + 1):
        if math.comb(n + len(inverse) + degree, degree) > MOST_TERMS:
            return None
        terms = _list_terms(n, inverse, degree)
        z = draw(POINTS_PER_TERM * len(terms) + n, False)
        rows = _fit_coefficients(_evaluate_terms(z, inverse, terms), evaluate(z))
        if rows is None:
            return None
        values = _evaluate_terms(checked, inverse, terms)
        sizes = np.abs(values) @ np.abs(rows)
        if np.all(np.abs(values @ rows - wanted) <= AGREE * sizes):
            return _make_function(n, inverse, terms, rows)
    return None


def _list_terms(n: int, inverse: Sequence[int], degree: int) -> list[tuple[int, ...]]:
    """List products as tuples of variables; n + k is the reciprocal of `inverse[k]`, never multiplied by it."""
    all_of = range(n + len(inverse))
    products = (c for d in range(degree + 1) for c in itertools.combinations_with_replacement(all_of, d))
    pairs = [(j, n + k) for k, j in enumerate(inverse)]
    return [c for c in products if not any(a in c and b in c for a, b in pairs)]


def _evaluate_terms(z: np.ndarray, inverse: Sequence[int], terms: Sequence[tuple[int, ...]]) -> np.ndarray:
    variables = np.hstack([z, 1 / z[:, inverse]])
    return np.stack([np.prod(variables[:, list(term)], axis=1) for term in terms], axis=1)


def _fit_coefficients(columns: np.ndarray, values: np.ndarray) -> np.ndarray | None:
    """Fit the coefficients of few terms, (n_terms, m); None if a value is not finite."""
    if not np.all(np.isfinite(values)):
        return None
    size = np.max(np.abs(columns), axis=0)
    size[size == 0] = 1.0
    first = np.linalg.lstsq(columns / size, values, rcond=None)[0]
    out = np.zeros_like(first)
    for i, row in enumerate(first.T):
        kept = np.abs(row) > NEGLIGIBLE * np.max(np.abs(row))
        if np.any(kept):
            found = np.linalg.lstsq(columns[:, kept] / size[kept], values[:, i], rcond=None)[0] / size[kept]
            out[kept, i] = [float(f"{c:.{COEFFICIENT_DIGITS}g}") for c in found]
    return out


def _make_function(n: int, inverse: Sequence[int], terms: Sequence[tuple[int, ...]], rows: np.ndarray) -> ca.Function:
    z = ca.SX.sym("z", n)
    variables = [*ca.vertsplit(z), *(1 / z[j] for j in inverse)]
    found = []
    for row in rows.T:
        total = ca.SX(0.0)
        for k in np.flatnonzero(row).tolist():
            product = ca.SX(row[k])
            for j in terms[k]:
                product = product * variables[j]
            total = total + product
        found.append(total)
    return ca.Function("polynomials", [z], [ca.vertcat(*found)], ["z"], ["r"])
