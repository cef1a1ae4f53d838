"""CasADi functions called on NumPy arrays through their buffers: no matrix object on the way in or out."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

BLOCK = 100  # steps a call


def mapped(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Results of a function at K points, each of shape (K, rows, columns).

    Parameters
    ----------
    arguments : arrays, shapes (K, n) or (n,)
        One a point, or the same at every point.
    """
    count = next(len(a) for a in arguments if np.ndim(a) == 2)
    given = [np.ascontiguousarray(np.broadcast_to(a, (count, np.shape(a)[-1])), dtype=float) for a in arguments]
    found = [np.empty((count, function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
    at = 0
    for length in (BLOCK, count % BLOCK):
        run = function.map(length) if 0 < length <= count - at else None
        while run is not None and at + length <= count:
            now = slice(at, at + length)
            _call(run, [a[now] for a in given], [out[now] for out in found])
            at += length
    return [out.transpose(0, 2, 1) for out in found]


def accumulated(function: ca.Function, state: np.ndarray, *arguments: np.ndarray) -> list[np.ndarray]:
    """Results of K steps of a function from a state, its first result being the next step's state, each (K, rows).

    Parameters
    ----------
    arguments : arrays, shapes (K, n)
        After the state, one a step.
    """
    count, state = len(arguments[0]), np.array(state, dtype=float)
    given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
    found = [np.zeros((count, function.size1_out(i))) for i in range(function.n_out())]
    at = 0
    for length, run in ((BLOCK, function.mapaccum("accumulated", BLOCK)), (1, function)):
        while at + length <= count:
            now = slice(at, at + length)
            _call(run, [state, *(a[now] for a in given)], [out[now] for out in found])
            state = found[0][at + length - 1]
            at += length
    return found


def _call(function: ca.Function, given: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> None:
    buffer, evaluate = function.buffer()
    for i, a in enumerate(given):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, out in enumerate(found):
        if out.size:
            buffer.set_res(i, out.data)
    evaluate()


class Buffered:
    """A function of dense arguments and results that is called again and again, on the same memory."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffer, self._evaluate = function.buffer()
        self._given = [np.zeros((function.size2_in(i), function.size1_in(i))) for i in range(function.n_in())]
        self._found = [np.zeros((function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
        for i, a in enumerate(self._given):
            if a.size:
                self._buffer.set_arg(i, a.data)
        for i, out in enumerate(self._found):
            if out.size:
                self._buffer.set_res(i, out.data)

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Results, a vector where there is one column, else a matrix (rows, columns); what is not given is zero."""
        for own, a in zip(self._given, arguments, strict=False):
            own[...] = np.asarray(a).T
        self._evaluate()
        return [out[0].copy() if len(out) == 1 else out.T.copy() for out in self._found]

    @property
    def success(self) -> bool:
        """Whether a solver found its solution."""
        return bool(self._buffer.stats()["success"])
