"""How large a parameter is, judged by its neighbours: what a unit of it is worth where its own value is zero.

An entry's size is `sqrt(largest of its row × largest of its column)`: never less than the entry itself, and in the
units of the entry wherever rows or columns have units that are alike.
"""

from __future__ import annotations

import numpy as np


class Neighbours:
    """The rows, columns and matrices that labels such as `A[0,1]` belong to.

    Parameters
    ----------
    labels : tuple of str
        One for each entry.
    """

    def __init__(self, labels: tuple[str, ...]) -> None:
        keys = [_place(label) for label in labels]
        self._row, self._column, self._name = (
            np.unique([key[k] for key in keys], return_inverse=True)[1] if keys else np.zeros(0, dtype=int)
            for k in range(3)
        )

    def sizes(self, values: np.ndarray) -> np.ndarray:
        """Size of each entry by its row and column, shape (n,)."""
        values = np.abs(values)
        return np.sqrt(_largest(values, self._row)) * np.sqrt(_largest(values, self._column))

    def largest(self, values: np.ndarray) -> np.ndarray:
        """The largest value of the matrix that each entry belongs to, shape (n,)."""
        return _largest(values, self._name)


def _place(label: str) -> tuple[str, str, str]:
    name, _, inside = label.partition("[")
    indices, _, rest = inside.partition("]")
    row, _, column = indices.partition(",")
    return f"{name}{rest} {row}", f"{name}{rest} ,{column}", name + rest


def _largest(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    out = np.zeros(int(group.max(initial=-1)) + 1)
    np.maximum.at(out, group, values)
    return np.asarray(out[group])


def or_one(scale: np.ndarray) -> np.ndarray:
    """The scales, one in the place of zero."""
    return np.where(scale > 0, scale, 1.0)
