"""The model: one symbolic step with a port, and closing the loop around an element.

An open model is `z = h(x, u, p)`, `(x⁺, y) = f(x, u, w, p)`; an element is `(w, s⁺) = e(z, s, p)`. `z` does not
depend on `w` (`D_zw = 0` in Krikelis et al. (2024), Eq. 15), so a step is explicit. `close_loop` joins the two; the
state of the closed model is `[x; s]`, the element's memory included.

`map_points`, `accumulate_steps` and `Buffered` call CasADi functions on NumPy arrays through their buffers, without a
CasADi matrix on the way in or out.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, abandoned, listed
from ..data import COURSES, Recording, default_names, interpolate_band_limited
from .elements import Element
from .parameters import Parameter, ParameterSet

LEAST_SCALE = 0.1  # factor of a sensor below which an observer trusts it less
BLOCK = 100  # points or steps of one call, which bounds the memory of the mapped function
StepExpression = Callable[[Any, Any, Any, dict[str, Any]], tuple[Any, Any]]
PortExpression = Callable[[Any, Any, dict[str, Any]], Any]


def _check_names(names: tuple[str, ...], n: int, letter: str) -> tuple[str, ...]:
    if not names:
        return default_names(letter, n)
    if len(names) != n:
        raise InputError(f"{len(names)} names were given for {n} signals ({', '.join(names)}); give one name each.")
    return tuple(names)


@dataclass(frozen=True, eq=False)
class Model:
    """A discrete-time model, open (`element is None` and `n_w > 0`) or closed.

    The state of a closed model is `[x; s]`: the states of the step, then the memory of the element.

    Attributes
    ----------
    step : casadi.Function
        `(x, u, w, p) -> (x_next, y)`; shapes (n_x,), (n_u,), (n_w,), (n_p,) -> (n_x,), (n_y,).
    port : casadi.Function
        `(x, u, p) -> z`, shape (n_w,).
    memory : casadi.Function
        `(z, s, p) -> (w, s_next)`, the element; without one it has no memory and `w = 0`.
    parameters : ParameterSet
        All parameters, the element's included.
    reads : tuple of {"u", "next", "t", "y", "sampled"}
        Signals in the columns of the step's u; see `drive`.
    substeps : int
        Steps within a sample; outputs are taken at the first of them.
    stages : casadi.Function, optional
        `(x, u, w, p, c) -> (values of c, c by c, x_next by c)`: the step by way of intermediate values c (n_c,), where
        each depends only on earlier ones. Its derivatives are sparse, the derivatives of `step` are dense.
    resting : casadi.Function, optional
        `(x, u, p) -> state`: the whole state from the states in `states` alone, as if their signals had stood still
        before; without it, the rest is zero.
    begin_alike : tuple of int
        For each entry of the state, the number of the unknown that it is if the initial state is unknown; entries with
        the same number begin alike. By default each entry has its own.
    hold : {"zero", "linear", "band-limited", "next"}
        Course of the inputs between samples; see `Recording.hold`. All but "zero" need a step that reads "next"; for
        such a step "linear" takes the place of "zero".
    """

    step: ca.Function
    port: ca.Function
    memory: ca.Function
    parameters: ParameterSet
    element: Element | None
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    reads: tuple[str, ...] = ("u",)
    substeps: int = 1
    stages: ca.Function | None = None
    resting: ca.Function | None = None
    begin_alike: tuple[int, ...] = ()
    hold: str = "zero"

    def __post_init__(self) -> None:
        if "next" in self.reads and not COURSES[self.hold].end:
            object.__setattr__(self, "hold", "linear")

    @cached_property
    def initial_basis(self) -> np.ndarray:
        """Matrix B (n_state, n) of an unknown initial state B v with the unknowns v (n,); see `begin_alike`."""
        numbers = np.array(self.begin_alike or range(self.n_state), dtype=int)
        return np.eye(int(np.max(numbers, initial=-1)) + 1)[numbers]

    def initial_unknowns(self, state: np.ndarray) -> np.ndarray:
        """Return the unknowns (n,) of an initial state (n_state,): of entries that begin alike, the first."""
        return np.asarray(state)[np.argmax(self.initial_basis, axis=0)] if self.n_state else np.zeros(0)

    def in_order(self, recording: Recording) -> Recording:
        """Return a recording with its channels in the model's order if it has the model's names; else as it is."""
        outputs = self.outputs if recording.outputs else ()
        same = (set(recording.inputs), set(recording.outputs)) == (set(self.inputs), set(outputs))
        return recording.in_order(self.inputs, outputs) if same else recording

    def drive(self, recording: Recording) -> np.ndarray:
        """Collect the signals that the step reads along a recording, (M * substeps, n_u), in the order of `reads`.

        `u` is the input at the start of a sub-step and `next` at its end, both by the `hold` between samples, `t` the
        time in s (see `Recording.start`), `y` the measured output, interpolated linearly, and `sampled` one where a
        sample is taken and zero in the sub-steps after it.
        """
        n, m = self.substeps, len(recording)
        share = np.tile(np.arange(n) / n, m)[:, None]
        columns = []
        for signal in self.reads:
            if signal == "t":
                columns.append(recording.start + (np.repeat(np.arange(m), n)[:, None] + share) * recording.dt)
            elif signal == "sampled":
                columns.append((share == 0).astype(float))
            elif signal == "y":
                now, after = (np.repeat(v, n, axis=0) for v in (recording.y, recording.y_next))
                columns.append(now + (after - now) * share)
            elif self.hold == "band-limited":
                known = recording.wraps or recording.begins == "periodic"
                fine = interpolate_band_limited(recording.u, n, recording.period if known else None)
                columns.append(fine[1:] if signal == "next" else fine[:-1])
            else:
                now, after = (np.repeat(v, n, axis=0) for v in (recording.u, recording.u_next))
                columns.append(COURSES[self.hold].between(now, after, share + (1 / n if signal == "next" else 0.0)))
        return np.ascontiguousarray(np.hstack(columns)) if len(columns) != 1 else columns[0]

    def rest_at(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Compute the whole state (n_state,) from its first entries x; see `resting`.

        u (n_u,) are the first inputs; p are the model's parameters, which further ones may follow.
        """
        whole = np.zeros(self.n_state)
        if self.resting is not None and len(x) < self.n_state:
            whole = self.resting(x[: len(self.states)], u, p[: self.resting.size1_in(2)]).full().ravel()
        return np.append(x[: self.n_state], whole[len(x) :])

    def first_state(self, recording: Recording) -> np.ndarray:
        """Return the state (n_state,) that a recording gives at its first sample; zero if it gives none.

        Raises
        ------
        InputError
            If the number of values given fits neither the states nor the states with memory.
        """
        if isinstance(recording.initial, str):
            return np.zeros(self.n_state)
        given = np.asarray(recording.initial, dtype=float).ravel()
        if given.size not in (len(self.states), self.n_state):
            expected = " or ".join(map(str, dict.fromkeys((len(self.states), self.n_state))))
            numbers = "1 number" if given.size == 1 else f"{given.size} numbers"
            order = f"; the states are {listed(self.states)}" if self.states else ""
            raise InputError(f"An initial state of {numbers} was given; expected {expected}{order}.")
        return self.rest_at(given, recording.u[0], self.parameters.start)

    @cached_property
    def n_x(self) -> int:
        """States without memory; see `n_state`."""
        return int(self.step.size1_in(0))

    @cached_property
    def n_u(self) -> int:
        """Columns that the step reads: the inputs, unless `reads` says otherwise."""
        return int(self.step.size1_in(1))

    @cached_property
    def n_w(self) -> int:
        """Channels of the port."""
        return int(self.step.size1_in(2))

    @cached_property
    def n_y(self) -> int:
        """Outputs."""
        return int(self.step.size1_out(1))

    @cached_property
    def n_s(self) -> int:
        """Memory states of the element."""
        return int(self.memory.size1_in(1))

    @property
    def n_state(self) -> int:
        """Entries of the whole state [x; s]."""
        return self.n_x + self.n_s

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Make fresh symbols x, s, u, p of this model's sizes."""
        sizes = (("x", self.n_x), ("s", self.n_s), ("u", self.n_u), ("p", self.parameters.size))
        x, s, u, p = (ca.SX.sym(name, n) for name, n in sizes)
        return x, s, u, p

    @cached_property
    def closed(self) -> ca.Function:
        """`(x, u, p) -> (x_next, y)` with `x = [x; s]`: the whole step as one Function."""
        x, s, u, p = self.symbols()
        z = self.port(x, u, p)
        w, s_next = self.memory(z, s, p)
        x_next, y = self.step(x, u, w, p)
        state = ca.vertcat(x, s)
        return ca.Function("closed", [state, u, p], [ca.vertcat(x_next, s_next), y], ["x", "u", "p"], ["x_next", "y"])

    def with_parameters(self, parameters: ParameterSet) -> Model:
        """Copy with other start values, bounds or fixed flags of the same parameters."""
        if tuple(parameters) != tuple(self.parameters) or parameters.size != self.parameters.size:
            raise InputError("The parameters given do not match the model's; change values with `parameters.change`.")
        return replace(self, parameters=parameters)


def model_functions(
    x: Any, u: Any, w: Any, p: Any, step: Sequence[Any], z: Any, element: Sequence[Any]
) -> dict[str, ca.Function]:
    """Make the functions of a `Model` from its symbols x, u, w, p and expressions of them.

    `step` holds the expressions (x_next, y) and `z` the signal of the port; `element` holds the symbols (z, s) and the
    expressions (w, s_next) of them and p.
    """
    return {
        "step": ca.Function("step", [x, u, w, p], step, ["x", "u", "w", "p"], ["x_next", "y"]),
        "port": ca.Function("port", [x, u, p], [z], ["x", "u", "p"], ["z"]),
        "memory": ca.Function("memory", [*element[:2], p], element[2:], ["z", "s", "p"], ["w", "s_next"]),
    }


def open_model(
    step: StepExpression,
    port: PortExpression,
    parameters: ParameterSet,
    *,
    n_x: int,
    n_u: int,
    n_w: int,
    states: tuple[str, ...] = (),
    inputs: tuple[str, ...] = (),
    outputs: tuple[str, ...] = (),
) -> Model:
    """Make an open model from Python expressions `step(x, u, w, p) -> (x_next, y)` and `port(x, u, p) -> z`.

    Parameters
    ----------
    step, port : callable
        Expressions of CasADi symbols x (n_x, 1), u (n_u, 1), w (n_w, 1) and p, which maps names to matrices.
    parameters : ParameterSet
        Parameters that the expressions read.
    n_x, n_u, n_w : int
        States, inputs, and channels of the port (0: no port, `port` is not called).
    states, inputs, outputs : tuple of str
        Names; signals without names are numbered.

    Raises
    ------
    InputError
        If an expression has another number of rows than there are states or channels, or names are too few or too many.

    Examples
    --------
    >>> from pilfr_casadi import Parameter, Play, PrandtlIshlinskii
    >>> lag = open_model(lambda x, u, w, p: (p["a"] * x + u - w, x), lambda x, u, p: x,
    ...                  ParameterSet({"a": Parameter(0.9)}), n_x=1, n_u=1, n_w=1)
    >>> close_loop(lag, PrandtlIshlinskii(Play, 3)).n_state
    4
    """
    x, u, w = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u), ca.SX.sym("w", n_w)
    vector = ca.SX.sym("p", parameters.size)
    named = parameters.symbols(vector)
    x_next, y = (ca.SX(e) for e in step(x, u, w, named))
    z = ca.SX(port(x, u, named)) if n_w else ca.SX(0, 1)
    for name, expression, rows in (("next state", x_next, n_x), ("port's signal z", z, n_w)):
        if expression.shape != (rows, 1):
            raise InputError(f"The {name} has the shape {expression.shape}; expected ({rows}, 1).")
    z_in, s = ca.SX.sym("z", n_w), ca.SX(0, 1)
    return Model(
        **model_functions(x, u, w, vector, [x_next, y], z, [z_in, s, ca.SX(n_w, 1), s]),
        parameters=parameters,
        element=None,
        states=_check_names(states, n_x, "x"),
        inputs=_check_names(inputs, n_u, "u"),
        outputs=_check_names(outputs, int(y.shape[0]), "y"),
    )


def close_loop(model: Any, element: Element, port: str | None = None) -> Any:
    """Put an element into a model's port, or into the named port of a simulator.

    Parameters
    ----------
    model : Model or Simulator
    element : Element or Law
    port : str, optional
        Name of the simulator's port; a model has one port, without a name.

    Returns
    -------
    Model or Simulator
        The closed model or simulator.

    Raises
    ------
    InputError
        If the port is already closed or unknown, or the element has another number of channels.
    """
    if not hasattr(element, "parameters"):
        raise InputError(f"{element!r} was given to close_loop; give an element or a law with values.")
    if not isinstance(model, Model):
        if port is None or not hasattr(model, "with_element"):
            raise InputError("An element is put into an open Model, or into a Simulator with `port=` its port's name.")
        return model.with_element(port, element)
    if model.element is not None:
        raise InputError("The model's port is closed already; close an open model.")
    if element.channels != model.n_w:
        raise InputError(
            f"The element has {element.channels} channels, the model's port has {model.n_w}; give as many."
        )
    parameters = model.parameters | element.parameters()
    vector = ca.SX.sym("p", parameters.size)
    own = vector[: model.parameters.size]
    x, _, u, _ = model.symbols()
    z, w, s = ca.SX.sym("z", model.n_w), ca.SX.sym("w", model.n_w), ca.SX.sym("s", element.memory)
    w_out, s_next = element.step(z, s, parameters.symbols(vector))
    return replace(
        model,
        **model_functions(x, u, w, vector, model.step(x, u, w, own), model.port(x, u, own), [z, s, w_out, s_next]),
        parameters=parameters,
        element=element,
        stages=None,
        resting=None,
    )


def inject_outputs(
    model: Model,
    gain: np.ndarray,
    strength: Mapping[str, Parameter] | None = None,
    scales: ca.Function | None = None,
) -> Model:
    """Add `γ K (y_measured - y) / c` to the next state of a closed model, which then reads the measured outputs.

    Parameters
    ----------
    gain : array, shape (k, n_y)
        K; it acts on the first k states, never on memory.
    strength : mapping of one Parameter, optional
        γ and its name. Without it γ is 1 in the sub-step at which a sample is taken and 0 in the sub-steps after it.
    scales : casadi.Function, optional
        c (n_y,) as `p -> c`; all 1 by default. A sensor that reads c times as much shall not make the observer forget
        c times as fast.
    """
    x, s, u, p = model.symbols()
    sizes = (("z", model.n_w), ("w", model.n_w), ("measured", model.n_y), ("gamma", 1))
    z, w, measured, gamma = (ca.SX.sym(name, n) for name, n in sizes)
    if strength:
        parameters, vector = model.parameters | strength, ca.vertcat(p, gamma)
        reads, read = (*model.reads, "y"), ca.vertcat(u, measured)
    else:
        parameters, vector = model.parameters, p
        reads, read = (*model.reads, "y", "sampled"), ca.vertcat(u, measured, gamma)
    full = np.zeros((model.n_x, model.n_y))
    full[: len(gain)] = gain[: model.n_x]
    following, y = model.step(x, u, w, p)
    error = measured - y
    if scales is not None:  # a sensor that reads hardly anything says little about the states
        scale = scales(p)
        error = error * scale / ca.fmax(scale**2, LEAST_SCALE**2)
    pushed = gamma * (ca.DM(full) @ error)
    stages = model.stages
    if stages is not None:
        c = ca.SX.sym("c", stages.size1_in(4))
        values, by_c, end = stages(x, u, w, p, c)
        stages = ca.Function("stages", [x, read, w, vector, c], [values, by_c, end + pushed])
    element = [z, s, *model.memory(z, s, p)]
    return replace(
        model,
        **model_functions(x, read, w, vector, [following + pushed, y], model.port(x, u, p), element),
        parameters=parameters,
        reads=reads,
        stages=stages,
    )


def map_points(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Evaluate a function at K points; each result has the shape (K, rows, columns).

    Parameters
    ----------
    arguments : arrays, shapes (K, n) or (n,)
        One row for each point, or the same vector at every point.
    """
    function, count = _dense(function), next(len(a) for a in arguments if np.ndim(a) == 2)
    arrays = [np.ascontiguousarray(np.broadcast_to(a, (count, np.shape(a)[-1])), dtype=float) for a in arguments]
    results = [np.empty((count, function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
    whole = count - count % BLOCK
    for begin in range(0, whole, BLOCK):
        block = slice(begin, begin + BLOCK)
        _call(_map_block(function), [a[block] for a in arrays], [out[block] for out in results])
    for k in range(whole, count):  # for a large function a map of another length would take longer to make
        _call(function, [a[k] for a in arrays], [out[k] for out in results])
    return [out.transpose(0, 2, 1) for out in results]


@functools.lru_cache(maxsize=256)
def _dense(function: ca.Function) -> ca.Function:
    """Give a function dense results: of a sparse one, a buffer gets the stored entries alone."""
    if all(function.sparsity_out(i).is_dense() for i in range(function.n_out())):
        return function
    arguments = function.mx_in()
    return ca.Function(function.name(), arguments, [ca.densify(found) for found in function.call(arguments)])


@functools.lru_cache(maxsize=16)
def _map_block(function: ca.Function) -> ca.Function:
    """Map a function over a block of points; this takes long for hundreds of states."""
    return function.map(BLOCK)


def accumulate_steps(function: ca.Function, state: np.ndarray, *arguments: np.ndarray) -> list[np.ndarray]:
    """Run K steps of a function whose first result is the next state; each result has the shape (K, rows).

    Parameters
    ----------
    arguments : arrays, shapes (K, n)
        Arguments after the state, one row for each step.
    """
    count, state = len(arguments[0]), np.array(state, dtype=float)
    blocks = -(-count // BLOCK)  # the last one is filled up, because single steps cost far more
    more = blocks * BLOCK - count
    filled = (np.concatenate([a, np.repeat(a[-1:], more, axis=0)], dtype=float) for a in arguments)
    arrays = list(map(np.ascontiguousarray, filled))
    results = [np.zeros((blocks * BLOCK, function.size1_out(i))) for i in range(function.n_out())]
    run = _accumulate_block(_dense(function))
    for begin in range(0, blocks * BLOCK, BLOCK):
        block = slice(begin, begin + BLOCK)
        _call(run, [state, *(a[block] for a in arrays)], [out[block] for out in results])
        state = results[0][begin + BLOCK - 1]
    return [out[:count] for out in results]


@functools.lru_cache(maxsize=256)
def _accumulate_block(function: ca.Function) -> ca.Function:
    return function.mapaccum("accumulated", BLOCK)


def _call(function: ca.Function, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    buffer, evaluate = function.buffer()
    _connect(buffer, arrays, results)
    evaluate()
    abandoned.raise_pending()


def _connect(buffer: Any, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    """Make a function's buffer read its arguments from arrays and write its results into others."""
    for i, a in enumerate(arrays):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, out in enumerate(results):
        if out.size:
            buffer.set_res(i, out.data)


class Buffered:
    """A function of dense arguments, to be called many times on the same memory."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function = _dense(function)
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [np.zeros((function.size2_in(i), function.size1_in(i))) for i in range(function.n_in())]
        self._results = [np.zeros((function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
        _connect(self._buffer, self._arguments, self._results)

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Evaluate; a result of one column is a vector, else a matrix (rows, columns). Omitted arguments are zero."""
        for own, a in zip(self._arguments, arguments, strict=False):
            own[...] = np.asarray(a).T
        self._evaluate()
        abandoned.raise_pending()
        return [out[0].copy() if len(out) == 1 else out.T.copy() for out in self._results]

    @property
    def status(self) -> str:
        """CasADi's return status of the last call of a solver."""
        return str(self._buffer.stats()["return_status"])
