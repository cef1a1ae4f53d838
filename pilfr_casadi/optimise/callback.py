"""A CasADi Function whose value is computed in Python, for solvers that call back.

An exception must not cross a solver's C++ frames: CasADi would turn it into a failed evaluation and forget it. It is
handed to `failed` instead, the solver sees NaN, and whoever called the solver decides what becomes of it. Ctrl-C may
strike between two calls back, where CasADi swallows it as well: `handled_interrupt` turns it into a call.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np


class Callback(ca.Callback):
    """A CasADi Function around a Python function.

    Parameters
    ----------
    name : str
        Name of the Function.
    inputs, outputs : mapping of str to casadi.Sparsity
        Names and shapes; the order counts.
    function : callable
        Takes one flat array an input, returns one value an output.
    failed : callable
        Takes what `function` raised.
    """

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, ca.Sparsity],
        outputs: Mapping[str, ca.Sparsity],
        function: Callable[..., Sequence[Any]],
        failed: Callable[[BaseException], None],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self._function, self._failed = function, failed
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Number of inputs."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        """Name of input i."""
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        """Name of output i."""
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of input i."""
        return self._inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Shape of output i."""
        return self._outputs[i][1]

    def eval(self, arguments: Sequence[Any]) -> Sequence[Any]:
        """Values of the outputs, NaN where the function raised."""
        try:
            return self._function(*(np.asarray(a).ravel() for a in arguments))
        except BaseException as error:
            self._failed(error)
            return [ca.DM(sparsity, np.nan) for _, sparsity in self._outputs]


@contextlib.contextmanager
def handled_interrupt(handle: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C calls `handle` in place of raising KeyboardInterrupt; in the main thread, where nobody else handles it."""
    ours = threading.current_thread() is threading.main_thread()
    ours = ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, lambda *_: handle())
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
