"""Call CasADi functions on NumPy arrays through their buffers, without a CasADi matrix on the way in or out."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

BLOCK = 100  # points or steps of one call, which bounds the memory of the mapped function


def map_points(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Evaluate a function at K points; each result has the shape (K, rows, columns).

    Parameters
    ----------
    arguments : arrays, shapes (K, n) or (n,)
        One row for each point, or the same vector at every point.
    """
    count = next(len(a) for a in arguments if np.ndim(a) == 2)
    arrays = [np.ascontiguousarray(np.broadcast_to(a, (count, np.shape(a)[-1])), dtype=float) for a in arguments]
    results = [np.empty((count, function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
    begin = 0
    for length in (BLOCK, count % BLOCK):
        run = function.map(length) if 0 < length <= count - begin else None
        while run is not None and begin + length <= count:
            block = slice(begin, begin + length)
            _call(run, [a[block] for a in arrays], [out[block] for out in results])
            begin += length
    return [out.transpose(0, 2, 1) for out in results]


def accumulate_steps(function: ca.Function, state: np.ndarray, *arguments: np.ndarray) -> list[np.ndarray]:
    """Run K steps of a function whose first result is the next state; each result has the shape (K, rows).

    Parameters
    ----------
    arguments : arrays, shapes (K, n)
        Arguments after the state, one row for each step.
    """
    count, state = len(arguments[0]), np.array(state, dtype=float)
    arrays = [np.ascontiguousarray(a, dtype=float) for a in arguments]
    results = [np.zeros((count, function.size1_out(i))) for i in range(function.n_out())]
    begin = 0
    for length, run in ((BLOCK, function.mapaccum("accumulated", BLOCK)), (1, function)):
        while begin + length <= count:
            block = slice(begin, begin + length)
            _call(run, [state, *(a[block] for a in arrays)], [out[block] for out in results])
            state = results[0][begin + length - 1]
            begin += length
    return results


def _call(function: ca.Function, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    buffer, evaluate = function.buffer()
    for i, a in enumerate(arrays):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, out in enumerate(results):
        if out.size:
            buffer.set_res(i, out.data)
    evaluate()


class Buffered:
    """A function of dense arguments and results that is called many times on the same memory."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [np.zeros((function.size2_in(i), function.size1_in(i))) for i in range(function.n_in())]
        self._results = [np.zeros((function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
        for i, a in enumerate(self._arguments):
            if a.size:
                self._buffer.set_arg(i, a.data)
        for i, out in enumerate(self._results):
            if out.size:
                self._buffer.set_res(i, out.data)

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Evaluate; a result of one column is a vector, else a matrix (rows, columns). Omitted arguments are zero."""
        for own, a in zip(self._arguments, arguments, strict=False):
            own[...] = np.asarray(a).T
        self._evaluate()
        return [out[0].copy() if len(out) == 1 else out.T.copy() for out in self._results]

    @property
    def status(self) -> str:
        """Return CasADi's word for how the last call of a solver ended."""
        return str(self._buffer.stats()["return_status"])
