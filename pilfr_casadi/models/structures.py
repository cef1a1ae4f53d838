"""Black-box models to compare a PI-LFR with, and every structure by its name.

Each baseline is a linear model closed by a `StaticNetwork` (a `PILFR`) with some blocks fixed:

- `ssnn`: `x⁺ = A x + B u + W_x tanh(V_x [x; u] + b_x)`, `y = C x + D u + W_y tanh(V_y [x; u] + b_y) + y_0`, a linear
  model beside two networks with one hidden layer, one for the state and one for the output (Suykens et al. 1995,
  Schoukens 2021). With one neuron a channel, the first half of the channels enters the state, the second the output;
- `network_lfr`: one network in the port of a linear model, `w = Σ gain_j tanh(slope_j z + bias_j)`;
- `NARX`, `NOE`: `y(k+1) = f(y(k), …, y(k-n_a+1), u(k), …, u(k-n_b+1))`, with `f` a linear part and one hidden layer.
  The state holds the past of y and u, so `A` is a shift except in its first rows. For one-step training the model reads
  the measured output (`read_measured_output`); in use, and in the training of a NOE, it reads its own output.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, is_number, whole
from ..data import Recording
from .elements import PrandtlIshlinskii, StaticNetwork
from .model import Model, model_functions
from .operators import GeneralizedPlay, Play, Stop
from .parameters import Parameter, ParameterSet, check_size, or_one
from .pilfr import PILFR, hammerstein, wiener

Array = np.ndarray
NEURONS = {"gain": 1.0, "slope": 1.0}  # one neuron a channel: its weights are the linear blocks
SHARE = "read"  # name of the parameter: share of the measured output that a step reads


def ssnn(nx: int, hidden: int = 15, offset: bool = True) -> PILFR:
    """Make a state-space neural network: `hidden` neurons for the next state and as many for the output.

    Parameters
    ----------
    nx : int
        States.
    hidden : int
        Neurons of each of the two networks.
    offset : bool
        Estimate the constant `y_0`.

    Returns
    -------
    PILFR
        A structure for `fit` like any other; it starts as the linear model of the same order.

    Raises
    ------
    InputError
        If a number is not whole or too small.
    """
    state = np.repeat([1.0, 0.0], StaticNetwork(hidden).hidden)
    fixed = {"B_w": np.where(state == 1, np.nan, 0.0), "D_yw": np.where(state == 1, 0.0, np.nan)}
    return PILFR(nx, StaticNetwork(1, 2 * hidden), {**fixed, **NEURONS}, offset=offset)


def network_lfr(nx: int, hidden: int = 15, channels: int = 1, offset: bool = True) -> PILFR:
    """Make a linear model of nx states with a static network of `hidden` neurons per channel in its port.

    Raises
    ------
    InputError
        If a number is not whole or too small.
    """
    return PILFR(nx, StaticNetwork(hidden, channels), offset=offset)


@dataclass(frozen=True)
class Lagged:
    """A model of past outputs and inputs: the common part of `NARX` and `NOE`."""

    lags: int
    hidden: int = 10
    input_lags: int | None = None
    validation: float = 0.0
    linear: bool = True

    def __post_init__(self) -> None:
        for name in ("lags", "hidden", "input_lags"):
            if name != "input_lags" or self.input_lags is not None:
                whole(getattr(self, name), name, 1)
        check_size("A model", self.hidden * max(self.lags, self.input_lags or 1) ** 2)
        share = self.validation
        if not is_number(share) or not 0 <= share < 1:
            raise InputError(f"validation = {share!r} was given; give the share to hold back, 0 or more and below 1.")

    @property
    def element(self) -> StaticNetwork:
        """The neurons, one per channel."""
        return StaticNetwork(1, self.hidden)

    def unknowns(self, n_u: int, n_y: int) -> int:
        """Count the free parameters without building the model, which takes long for many lags."""
        past = self.lags * n_y + (self.input_lags or self.lags) * n_u
        return self.hidden * (past + 1 + n_y) + n_y * (past * self.linear + 1)

    def structure(self, n_u: int, n_y: int) -> PILFR:
        """Make the LFR whose state is `[y(k), …, y(k-n_a+1), u(k-1), …, u(k-n_b+1)]` and whose output is `y(k)`."""
        past_y, past_u = self.lags * n_y, ((self.input_lags or self.lags) - 1) * n_u
        nx, own = past_y + past_u, np.nan if self.linear else 0.0
        a, b, w = np.zeros((nx, nx)), np.zeros((nx, n_u)), np.zeros((nx, self.hidden))
        a[:n_y], b[:n_y], w[:n_y] = own, own, np.nan
        a[n_y:past_y, : past_y - n_y] = np.eye(past_y - n_y)
        if past_u:
            b[past_y : past_y + n_u] = np.eye(n_u)
            a[past_y + n_u :, past_y : nx - n_u] = np.eye(past_u - n_u)
        fixed = {"A": a, "B_u": b, "B_w": w, "C_y": np.eye(n_y, nx), "D_yu": 0.0, "D_yw": 0.0}
        return PILFR(nx, self.element, {**fixed, **NEURONS})

    def model(self, n_u: int, n_y: int) -> Model:
        """Build the closed model for n_u inputs and n_y outputs; its values are zero."""
        return self.structure(n_u, n_y).model(n_u, n_y)


@dataclass(frozen=True)
class NARX(Lagged):
    """Nonlinear autoregressive model, trained to predict one step ahead and used in free run.

    Parameters
    ----------
    lags : int
        Past outputs, n_a.
    hidden : int
        Neurons.
    input_lags : int, optional
        Past inputs, n_b; as many as `lags` by default. The input acts from the next sample on.
    validation : float
        Share of the training data held back for validation; training stops when the one-step error on it no longer
        falls. 0 uses all data for training.
    linear : bool
        Whether a linear part stands beside the neurons.

    Raises
    ------
    InputError
        If a number is not whole or too small, or the share is not in [0, 1).
    """


@dataclass(frozen=True)
class NOE(Lagged):
    """Nonlinear output-error model: a NARX trained in simulation, with early stopping.

    Every start is trained as a NARX first; then the share of the measured output that it reads is lowered to zero.

    Parameters
    ----------
    lags, hidden, input_lags, linear
        As for `NARX`.
    validation : float
        Share of the training data held back for validation; training stops when the simulation error on it no longer
        falls, and the point of the lowest error is returned. 0 uses all data for training.

    Raises
    ------
    InputError
        As for `NARX`.
    """

    validation: float = 0.25


def _lagged_states(model: Lagged, recording: Recording, level: Array) -> Array:
    """Collect the states (M, nx) along a recording, from outputs minus their mean (n_y,); zero before its start."""
    m, past = len(recording), [(recording.y - level, k) for k in range(model.lags)]
    past += [(recording.u, k) for k in range(1, model.input_lags or model.lags)]
    return np.hstack([np.vstack([np.zeros((min(k, m), x.shape[1])), x[: max(m - k, 0)]]) for x, k in past])


def lagged_start(
    model: Lagged, structure: PILFR, recordings: Sequence[Recording], rng: np.random.Generator
) -> dict[str, Array]:
    """Estimate a linear one-step predictor by least squares, and draw neurons without effect in random directions.

    Directions are drawn in units of the standard deviation of each past signal.
    """
    level = np.mean(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
    level = level if structure.offset else np.zeros_like(level)
    states = [_lagged_states(model, r, level) for r in recordings]
    n_y, n_u = recordings[0].n_y, recordings[0].n_u
    rows = np.concatenate([np.hstack([x, r.u])[r.skip : -1] for x, r in zip(states, recordings, strict=True)])
    targets = np.concatenate([(r.y - level)[r.skip + 1 :] for r in recordings])
    size = or_one(np.std(rows, axis=0))
    a, b = np.zeros((structure.nx, structure.nx)), np.zeros((structure.nx, n_u))
    if model.linear:
        predictor = (np.linalg.lstsq(rows / size, targets, rcond=1e-8)[0] / size[:, None]).T
        a[:n_y], b[:n_y] = predictor[:, : structure.nx], predictor[:, structure.nx :]
    element = structure.element
    assert isinstance(element, StaticNetwork)
    directions = rng.uniform(-1, 1, (element.channels, rows.shape[1])) / size
    directions /= np.maximum(np.std(rows @ directions.T, axis=0), 1e-300)[:, None]
    known = {name: np.nan_to_num(structure.fixed[name]) for name in ("A", "B_u")}
    blocks = {"A": a + known["A"], "B_u": b + known["B_u"], "y_0": level}
    blocks |= {"C_z": directions[:, : structure.nx], "D_zu": directions[:, structure.nx :]}
    return blocks | neurons_over(structure, element, rows @ directions.T, rng)


def neurons_over(structure: PILFR, element: StaticNetwork, z: np.ndarray, rng: np.random.Generator) -> dict[str, Array]:
    """Draw gains, slopes and biases of neurons that bend within 1.5 deviations of the mean of z (M, channels)."""
    shape = (element.channels, element.hidden)
    size = or_one(np.std(z, axis=0))[:, None]
    slope = rng.uniform(1, 3, shape) / size
    slope = np.broadcast_to(np.asarray(structure.fixed.get("slope", slope), dtype=float), shape)
    middle = np.mean(z, axis=0)[:, None] + rng.uniform(-1.5, 1.5, shape) * size
    return {"gain": rng.uniform(-1, 1, shape), "slope": slope, "bias": -slope * middle}


def read_measured_output(model: Model, share: float = 1.0) -> Model:
    """Make a NARX or NOE model read the measured output y.

    Its first states, the outputs minus `y_0`, become `x + share (y - ŷ)` before each step. A share of one predicts one
    step ahead, a share of zero simulates; the share is a fixed parameter.

    Raises
    ------
    InputError
        If the model's first states are not its outputs.
    """
    n_y, values = model.n_y, {k: p.value for k, p in model.parameters.items()}
    plain = {"C_y": np.eye(n_y, model.n_x), "D_yu": 0.0, "D_yw": 0.0}
    if not all(name in values and np.all(values[name] == value) for name, value in plain.items()):
        raise InputError("Only a NARX or NOE can read the measured output; its first states are its outputs.")
    parameters = model.parameters | ParameterSet({SHARE: Parameter(share, fixed=True)})
    x, _, u, _ = model.symbols()
    w, y, p = ca.SX.sym("w", model.n_w), ca.SX.sym("y", n_y), ca.SX.sym("p", parameters.size)
    own, both = p[: model.parameters.size], ca.vertcat(u, y)
    z, s = ca.SX.sym("z", model.n_w), ca.SX(0, 1)
    element = [z, s, *model.memory(z, s, own)]
    _, y_hat = model.step(x, u, ca.SX.zeros(model.n_w), own)
    corrected = ca.vertcat(x[:n_y] + p[-1] * (y - y_hat), *(x[i] for i in range(n_y, model.n_x)))
    x_next, _ = model.step(corrected, u, w, own)
    return replace(
        model,
        **model_functions(x, both, w, p, [x_next, y_hat], model.port(corrected, u, own), element),
        parameters=parameters,
        reads=("u", "y"),
    )


OPERATORS: dict[str, Any] = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}
HYSTERETIC_OPTIONS = ("nx", "operators", "operator", "channels", "neurons", "offset", "fix", "bounds", "priors")
LAGGED = {"narx": NARX, "noe": NOE}
# options of each structure
STRUCTURE_OPTIONS: dict[str, tuple[str, ...]] = {
    "lfr": HYSTERETIC_OPTIONS,
    "hammerstein": HYSTERETIC_OPTIONS,
    "wiener": HYSTERETIC_OPTIONS,
    "ssnn": ("nx", "hidden", "offset", "fix", "bounds", "priors"),
    "network_lfr": ("nx", "hidden", "channels", "offset", "fix", "bounds", "priors"),
    "narx": ("lags", "hidden", "input_lags"),
    "noe": ("lags", "hidden", "input_lags"),
}
STRUCTURES = tuple(STRUCTURE_OPTIONS)
ALL_OPTIONS = frozenset(name for takes in STRUCTURE_OPTIONS.values() for name in takes)


def named_structure(structure: str = "lfr", **given: Any) -> PILFR | Lagged:
    """Build a structure of `STRUCTURES` with the options of `STRUCTURE_OPTIONS`, at least `nx` or `lags`.

    Omitted options have the structure's defaults. `operators` is 20 by default, and 0 makes a linear model; `neurons`
    selects the generalized play.
    """
    if structure in LAGGED:
        return LAGGED[structure](**given)
    element: dict[str, Any] = {k: given[k] for k in ("hidden", "channels") if k in given}
    form = {k: given[k] for k in ("bounds", "priors", "offset") if k in given}
    if "hidden" in STRUCTURE_OPTIONS[structure]:
        base = ssnn(given["nx"], **element) if structure == "ssnn" else network_lfr(given["nx"], **element)
    else:
        base = _hysteretic(structure, given)
    return PILFR(given["nx"], base.element, {**base.fixed, **given.get("fix", {})}, **form)


def _hysteretic(structure: str, given: Mapping[str, Any]) -> PILFR:
    """Build a PI-LFR, PI-Hammerstein or PI-Wiener model, linear without operators."""
    neurons, n = given.get("neurons"), given.get("operators", 20)
    kind = OPERATORS[given.get("operator", "play")] if neurons is None else GeneralizedPlay(neurons)
    element = PrandtlIshlinskii(kind, n, given.get("channels", 1)) if n else None
    if structure == "lfr" or element is None:
        return PILFR(given["nx"], element)
    return {"hammerstein": hammerstein, "wiener": wiener}[structure](given["nx"], element)
