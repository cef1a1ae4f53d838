"""Python functions as equations without symbols: every evaluation calls them with numbers (`external`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Named
from .external import NOMINAL, PythonFunction, call_external, equal_state, external

KEPT_JACOBIANS = 16  # Jacobians in the cache: all directions of a step's stages reuse them


@dataclass(frozen=True)
class Numeric:
    """How to differentiate a function that is called with numbers.

    Parameters
    ----------
    jacobian : callable, optional
        `jacobian(t, x, u, p)` returns the derivatives of the function's values, one row each, by x, by u, and by the
        entries of p in the order of the parameters. By default differences replace it.
    nominal : mapping, optional
        Size of a state, an input or a parameter by name, which scales its differences if its value is smaller; by
        default 0.001.
    """

    jacobian: Callable[..., Any] | None = None
    nominal: Mapping[str, float] = field(default_factory=dict)


class BlackBox:
    """The dynamics or outputs of a simulator as a function of `z = (t, x, u, p)` that is called with numbers.

    Parameters
    ----------
    function : callable
        From z (n,) to the values, (m,).
    called : str
        Its name in messages.
    rows : tuple of str
        Names of its values.
    names : sequence of tuples of str
        Names of states, inputs and parameters.
    jacobian : callable, optional
        From z to the derivatives by x, u and p, shape (m, n - 1).
    nominal : array, (n,)
        Sizes of z, which scale the differences if z is smaller.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], np.ndarray],
        called: str,
        rows: tuple[str, ...],
        names: Sequence[tuple[str, ...]],
        jacobian: Callable[[np.ndarray], np.ndarray] | None,
        nominal: np.ndarray,
    ) -> None:
        self._arguments = function, called, rows, names, jacobian, nominal
        self.called, self.rows, self.names = called, rows, names
        self.program = PythonFunction(function, (len(nominal),), len(rows))
        self.slope = None if jacobian is None else _make_slope(jacobian, len(nominal), len(rows))
        by_slope = None if self.slope is None else (lambda z, s: call_external(self.slope, z, s))
        self.function = external(lambda z: call_external(self.program, z), nominal, len(rows), by_slope)
        self.points: list[tuple[np.ndarray, np.ndarray]] = []  # z and the values there
        self.equal: dict[str, str] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild it in another process, where nothing has been called yet."""
        return BlackBox, self._arguments, {"points": self.points, "equal": self.equal}

    def find_equal_states(self) -> None:
        """Note the values that equal a state at all `points`; the equations then use the state instead."""
        z, found = (np.array(part) for part in zip(*self.points, strict=True))
        states = z[:, 1 : 1 + len(self.names[0])]
        for row, values in zip(self.rows, found.T, strict=True):
            if same := equal_state(values, states, self.names[0]):
                self.equal[row] = same

    @property
    def program_calls(self) -> dict[str, int]:
        """Number of calls by the function's name."""
        return {self.called: self.program.calls}

    @property
    def program_failures(self) -> dict[str, str]:
        """First error by the function's name; empty if it has not failed."""
        return {} if self.program.failure is None else {self.called: repr(self.program.failure)}

    @property
    def note(self) -> str:
        """Number of calls and first failure, in words."""
        source = "finite differences" if self.slope is None else f"the given Jacobian, called {self.slope.calls} times"
        text = f"{self.called}: called {self.program.calls} times; its derivatives come from {source}"
        return text if self.program.failure is None else f"{text}; it failed first with {self.program.failure!r}"

    def __call__(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Return the expressions of the values by name."""
        parts = (ca.vec(kind[n]) for kind, names in zip((x, u, p), self.names, strict=True) for n in names)
        found: Any = call_external(self.function, ca.vertcat(t, *parts)) if len(self.equal) < len(self.rows) else None
        return {n: x[self.equal[n]] if n in self.equal else found[i] for i, n in enumerate(self.rows)}


def _make_slope(jacobian: Callable[[np.ndarray], np.ndarray], n: int, m: int) -> PythonFunction:
    """Make `(z, s) -> J(z) s` without the derivative by time; recent Jacobians are cached."""
    cache: dict[bytes, np.ndarray] = {}

    def along(z: np.ndarray, s: np.ndarray) -> np.ndarray:
        key = z.tobytes()
        if key not in cache:
            found = np.asarray(jacobian(z), dtype=float)
            if found.shape != (m, n - 1):
                raise InputError(f"The Jacobian has the shape {found.shape}; give {(m, n - 1)}: columns of x, u and p.")
            while len(cache) >= KEPT_JACOBIANS:
                cache.pop(next(iter(cache)), None)
            cache[key] = found
        return cache[key] @ s[1:]

    return PythonFunction(along, (n, n), m)


def nominal_sizes(given: Mapping[str, float], names: Sequence[str], sizes: Sequence[int]) -> np.ndarray:
    """Stack the sizes of z from sizes by name; `sizes` are the numbers of entries of all names."""
    for name, value in given.items():
        if name not in names or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise InputError(
                f"nominal = {{{name!r}: {value!r}}} was given; give a positive size by the name of a state, an input "
                "or a parameter."
            )
    found = [np.full(size, given.get(n, NOMINAL)) for n, size in zip(names, sizes, strict=True)]
    return np.concatenate([np.ones(1), *found])
