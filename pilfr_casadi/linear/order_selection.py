r"""Selection of the order of a linear model: identify every order on one part of the data, judge it on the other.

The recommended order `n` is the smallest whose error on the held-out part is within a margin `m` of the best,

.. math:: \min \{ n : e(n) \le (1 + m) \min_k e(k) \},

where `e` is the simulation error over the standard deviation, Krikelis et al. (2024), Eq. 27, for recordings, and the
weighted error of the response for a BLA. The models come from `subspace`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from .._base import InputError, Progress, whole
from ..data import Recording, check_for_identification
from .bla import BLA
from .subspace import ROUNDING, FrequencyProblem, SubspaceProblem, TimeProblem

Array = np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class OrderSelection:
    """Errors of linear models of several orders, and the recommended order.

    Parameters
    ----------
    orders : tuple of int
        Orders tried.
    train, validation : array, (n_orders,)
        Error relative to the data: simulation error over standard deviation (Krikelis et al. (2024), Eq. 27, averaged
        over outputs) for recordings, weighted error of the response for a BLA; on the part used to identify and on the
        held-out part.
    recommended : int
        Smallest order whose validation error is within `margin` of the best.
    margin : float
        The margin, as a share of the best error.
    singular_values : array
        Singular values of the training part, largest first; they drop at the order of the system.
    """

    orders: tuple[int, ...]
    train: Array
    validation: Array
    recommended: int
    margin: float
    singular_values: Array

    def __repr__(self) -> str:
        rows = [f"{'order':>5}  {'train':>10}  {'validation':>10}"]
        for n, a, b in zip(self.orders, self.train, self.validation, strict=True):
            rows.append(f"{n:>5}  {a:>10.3e}  {b:>10.3e}{'  <- recommended' if n == self.recommended else ''}")
        return "\n".join([*rows, f"smallest order within {100 * self.margin:g} % of the best on the validation part"])


def select_order(
    data: BLA | Recording | Iterable[Recording],
    orders: Iterable[int] = range(1, 11),
    margin: float = 0.05,
    offset: bool = False,
    progress: Progress | None = None,
) -> OrderSelection:
    """Identify models of several orders on one part of the data and judge them on the other.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        Held out are every second frequency of a BLA, the last 30 % of the samples of a single recording, or the last
        30 % of several recordings, at least one.
    orders : iterable of int
        Orders to try; orders too high for the data are left out, unless all are.
    margin : float
        The recommended order is the smallest whose validation error is at most ``1 + margin`` times the best.
    offset : bool
        For recordings: as for :func:`time_subspace`.
    progress : callable, optional
        Called with ("choosing the order", done, total, nan).

    Returns
    -------
    OrderSelection

    Raises
    ------
    InputError
        If there is no order, an order is not a whole number above zero, or the data are too few for it.
    """
    tried = sorted({whole(n, "the order nx", 1) for n in orders})
    if not tried or margin < 0:
        raise InputError(
            f"orders {tried} with a margin of {margin}: give at least one order and a margin of 0 or more."
        )
    train: SubspaceProblem
    validation: SubspaceProblem
    if isinstance(data, BLA):
        train, validation = (FrequencyProblem(data, True, slice(k, None, 2)) for k in (0, 1))
    else:
        records = check_for_identification(data)
        if len(records) == 1:
            records = records[0].slice(records[0].skip).split(0.7)
        n_train = max(1, min(len(records) - 1, round(0.7 * len(records))))
        train, validation = TimeProblem(records[:n_train], offset), TimeProblem(records[n_train:], offset)
    tried = [n for n in tried if train.least_rows(n) <= train.most_rows] or tried[:1]
    models = train.solve(tried, None, progress)
    train_error, error = (np.array([part.error(m) for m in models]) for part in (train, validation))
    good_enough = max((1 + margin) * np.min(error), ROUNDING)
    recommended = next(n for n, e in zip(tried, error, strict=True) if e <= good_enough)
    values = train.range_space(min(20, train.most_rows)).values
    return OrderSelection(tuple(tried), train_error, error, recommended, margin, values)
