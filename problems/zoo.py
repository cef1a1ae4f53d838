"""A zoo of small, seeded identification problems that carry their answers; every solver faces every one of them.

Truth is simulated in plain NumPy (the rig by the exact simulator of `masing`), apart from the package's engines. Noise is
white, and the fit starts from what a user would have: a perturbed or identified linear model with the element's way into
the loop shut (`B_w = D_yw = 0`, Krikelis et al. (2024), Eq. 24), or physical parameters 20 % off.

Run ``python -m problems.zoo`` for the table of both solvers on all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi.elements import PrandtlIshlinskii
from pilfr_casadi.gauss_newton import GaussNewton
from pilfr_casadi.ipopt import Ipopt
from pilfr_casadi.lfr import PILFR, hammerstein, wiener
from pilfr_casadi.model import Model, close_loop, open_model
from pilfr_casadi.multisines import multisine
from pilfr_casadi.operators import GeneralizedPlay, Play, Stop
from pilfr_casadi.parameters import Parameter, ParameterSet
from pilfr_casadi.problem import Problem
from pilfr_casadi.recording import Recording
from pilfr_casadi.start import grid_start, unit_states
from pilfr_casadi.subspace import subspace_matrices

from . import masing

Blocks = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Case:
    """One problem with its answer.

    Attributes
    ----------
    model : Model
        Closed model at the values where every solver starts.
    recordings : tuple of Recording
        Training data.
    clean : tuple of array, (M, n_y)
        True outputs of each recording, without noise.
    truth : dict
        True parameters by name, where the model is of the truth's own form and they are unique.
    exact : bool
        Whether the model class holds the truth, so that a global minimum lies at or below `floor`.
    """

    model: Model
    recordings: tuple[Recording, ...]
    clean: tuple[np.ndarray, ...]
    truth: Mapping[str, Any] = field(default_factory=dict)
    exact: bool = True

    def problem(self, **options: Any) -> Problem:
        """The simulation-error problem; options go to `Problem`."""
        return Problem(self.model, self.recordings, **options)

    @property
    def floor(self) -> float:
        """Cost of the truth, `1/2 mean(noise² / σ_y²)`; the noise level."""
        scale = np.std(np.concatenate([r.y[r.skip :] for r in self.recordings]), axis=0)
        pairs = zip(self.recordings, self.clean, strict=True)
        noise = np.concatenate([((r.y - y) / scale)[r.skip :].ravel() for r, y in pairs])
        return float(0.5 * np.mean(noise**2))


def simulate_lfr(blocks: Blocks, u: np.ndarray, law: Callable[[Any, Any], Any]) -> np.ndarray:
    """Eq. 15 in NumPy from rest: `law(z, memory) -> (w, memory)` with memory None at first; returns y (M, n_y)."""
    b = blocks
    x, memory, y = np.zeros(len(b["A"])), None, np.empty((len(u), len(b["C_y"])))
    for k, u_k in enumerate(u):
        w, memory = law(b["C_z"] @ x + b["D_zu"] @ u_k, memory)
        y[k] = b["C_y"] @ x + b["D_yu"] @ u_k + b["D_yw"] @ w
        x = b["A"] @ x + b["B_u"] @ u_k + b["B_w"] @ w
    return y


def plays(w: np.ndarray, r: np.ndarray) -> Callable[[Any, Any], Any]:
    """Plays with weights and thresholds (n_w, N), each at rest first."""

    def law(z: np.ndarray, q: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        q = np.zeros_like(r) if q is None else q
        q = np.maximum(z[:, None] - r, np.minimum(z[:, None] + r, q))
        return np.sum(w * q, axis=1), q

    return law


def _record(u: np.ndarray, y: np.ndarray, rng: np.random.Generator, level: float, dt: float = 0.01) -> Recording:
    noise = level * np.std(y, axis=0) * rng.standard_normal(y.shape)
    return Recording(u=u, y=y + noise, dt=dt, initial="zero", hold="zero")


def _excitation(rng: np.random.Generator, n: int, n_u: int = 1, f_max: float = 5.0) -> np.ndarray:
    """Multisines of unit deviation under a slow envelope, which makes nested loops of many sizes, (n, n_u)."""
    envelope = 0.6 + 0.4 * np.sin(np.linspace(0.0, 3.0 * np.pi, n))
    return np.column_stack([envelope * multisine(n, f_max, 100.0, rng) for _ in range(n_u)])


def identified(structure: PILFR, record: Recording, rng: np.random.Generator) -> Model:
    """The start a user gets: an identified linear model, a random direction of z, thresholds on a grid, `B_w = 0`."""
    a, b, c, d = subspace_matrices([record], structure.nx)
    linear = {"A": a, "B_u": b, "C_y": c, "D_yu": d, "y_0": np.zeros(record.n_y)}
    scaled, states = unit_states(linear, [record.u])
    values = grid_start(structure, scaled, [record.u], states, rng)
    return structure.model(record.n_u, record.n_y, values, inputs=record.inputs, outputs=record.outputs)


def lti(seed: int = 0) -> Case:
    """A resonance and a lag, two outputs, no element; the start is 10 % off in every entry."""
    rng = np.random.default_rng(seed)
    a, b = np.array([[0.95, 0.2, 0.0], [-0.2, 0.92, 0.0], [0.0, 0.1, 0.8]]), np.array([[0.1], [0.3], [0.2]])
    c, d = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.3]]), np.zeros((2, 1))
    none = {"C_z": np.zeros((0, 3)), "D_zu": np.zeros((0, 1)), "B_w": np.zeros((3, 0)), "D_yw": np.zeros((2, 0))}
    linear = {"A": a, "B_u": b, "C_y": c, "D_yu": d}
    u = _excitation(rng, 1000, f_max=20.0)
    y = simulate_lfr(linear | none, u, lambda z, q: (z, q))
    start = {k: v * (1 + 0.1 * rng.uniform(-1, 1, v.shape)) for k, v in linear.items()}
    start["A"] = 0.95 * start["A"]
    return Case(PILFR(3).model(1, 2, start), (_record(u, y, rng, 0.01),), (y,))


def backlash_loop(seed: int = 0) -> Case:
    """A position servo that measures its load behind a backlash: `z` the motor, `w` the load, closed by the controller."""
    rng = np.random.default_rng(seed)
    gain, r = 0.3, 0.1
    blocks = {
        "A": np.array([[0.85, 0.0], [0.12, 1.0]]),
        "B_u": np.array([[gain], [0.0]]),
        "B_w": np.array([[-gain], [0.0]]),
        "C_y": np.zeros((1, 2)),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.ones((1, 1)),
        "C_z": np.array([[0.0, 1.0]]),
        "D_zu": np.zeros((1, 1)),
    }
    u = _excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(np.ones((1, 1)), np.full((1, 1), r)))
    record = _record(u, y, rng, 0.01)
    parameters = ParameterSet(
        {
            "lag": Parameter(0.7, bounds=(0.0, 0.999)),
            "gain": Parameter(0.2, bounds=(0.0, 10.0)),
        }
    )

    def step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
        return ca.vertcat(p["lag"] * x[0] + p["gain"] * (u - w), x[1] + 0.12 * x[0]), w

    servo = open_model(step, lambda x, u, p: x[1], parameters, n_x=2, n_u=1, n_w=1, states=("speed", "motor"))
    closed = close_loop(servo, PrandtlIshlinskii(Play, 1))
    values = closed.parameters.change(w={"value": np.ones((1, 1)), "fixed": True}, r={"value": np.zeros((1, 1))})
    truth = {"lag": 0.85, "gain": gain, "r": r}
    return Case(closed.with_parameters(values), (record,), (y,), truth)


def _layer(rng: np.random.Generator, n: int, reach: float, channels: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Weights and thresholds of a layer of plays, first threshold zero, (channels, n)."""
    r = reach * (np.arange(n) + rng.uniform(0.0, 0.3, (channels, n))) / n
    r[:, 0] = 0.0
    return rng.uniform(0.3, 1.0, (channels, n)) / n, r


def pi_hammerstein(seed: int = 0) -> Case:
    """An actuator with hysteresis before a resonance; three plays, fitted by three from a grid."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 3, 1.5)
    blocks = {
        "A": np.array([[0.9, 0.3], [-0.3, 0.9]]),
        "B_u": np.zeros((2, 1)),
        "B_w": np.array([[0.1], [0.3]]),
        "C_y": np.array([[1.0, 0.2]]),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.zeros((1, 1)),
        "C_z": np.zeros((1, 2)),
        "D_zu": np.ones((1, 1)),
    }
    u = _excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = _record(u, y, rng, 0.01)
    return Case(identified(hammerstein(2, PrandtlIshlinskii(Play, 3), offset=False), record, rng), (record,), (y,))


def pi_wiener(seed: int = 0) -> Case:
    """A resonance read through a sensor with hysteresis; six plays at known thresholds, two of them idle."""
    rng = np.random.default_rng(seed)
    r = np.array([[0.0, 0.1, 0.25, 0.5, 0.8, 1.2]])
    w = np.array([[0.3, 0.3, 0.0, 0.2, 0.3, 0.0]])
    blocks = {
        "A": np.array([[0.9, 0.3], [-0.3, 0.9]]),
        "B_u": np.array([[0.1], [0.3]]),
        "B_w": np.zeros((2, 1)),
        "C_y": np.zeros((1, 2)),
        "D_yu": np.zeros((1, 1)),
        "D_yw": np.ones((1, 1)),
        "C_z": np.array([[0.8, 0.2]]),
        "D_zu": np.zeros((1, 1)),
    }
    u = _excitation(rng, 1200)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = _record(u, y, rng, 0.01)
    structure = wiener(2, PrandtlIshlinskii(Play, 6), offset=False)
    structure = replace(structure, fixed={**structure.fixed, "r": r})
    return Case(identified(structure, record, rng), (record,), (y,), {"w": w})


def mimo_lfr(seed: int = 0) -> Case:
    """Two inputs, two outputs, two channels of hysteresis in feedback around two coupled resonances."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 2, 1.0, channels=2)
    a = np.zeros((4, 4))
    for i, (radius, angle) in enumerate(((0.93, 0.15), (0.9, 0.35))):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * turn
    a[0, 3] = 0.05
    blocks = {
        "A": a,
        "B_u": np.array([[0.05, 0.0], [0.2, 0.05], [0.0, 0.1], [0.05, 0.3]]),
        "B_w": np.array([[0.0, 0.0], [-0.12, 0.0], [0.0, 0.0], [0.0, -0.15]]),
        "C_y": np.array([[1.0, 0.0, 0.2, 0.0], [0.0, 0.1, 1.0, 0.0]]),
        "D_yu": np.zeros((2, 2)),
        "D_yw": np.zeros((2, 2)),
        "C_z": np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
        "D_zu": np.zeros((2, 2)),
    }
    u = _excitation(rng, 1500, n_u=2)
    y = simulate_lfr(blocks, u, plays(w, r))
    record = _record(u, y, rng, 0.01)
    return Case(identified(PILFR(4, PrandtlIshlinskii(Play, 2, channels=2), offset=False), record, rng), (record,), (y,))


def asymmetric(seed: int = 0) -> Case:
    """A static actuator whose loop bends on one side only: generalized plays between two unlike envelopes, Eq. 7."""
    rng = np.random.default_rng(seed)
    w, r = _layer(rng, 3, 0.8)
    truth = {"left": 0.5, "right": 0.1, "knee": 1.5, "shift": 0.4}

    def law(z: np.ndarray, q: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        q = np.zeros_like(r) if q is None else q
        bend = np.tanh(truth["knee"] * z - truth["shift"])[:, None]
        low = z[:, None] + truth["left"] * bend - r
        high = z[:, None] + truth["right"] * bend + r
        q = np.maximum(low, np.minimum(np.maximum(high, low), q))
        return np.sum(w * q, axis=1), q

    through = {"C_z": np.zeros((1, 0)), "D_zu": np.ones((1, 1)), "D_yw": np.ones((1, 1)), "D_yu": np.zeros((1, 1))}
    empty = {"A": np.zeros((0, 0)), "B_u": np.zeros((0, 1)), "B_w": np.zeros((0, 1)), "C_y": np.zeros((1, 0))}
    u = _excitation(rng, 1000)
    y = simulate_lfr(through | empty, u, law)
    extra = ParameterSet(
        {
            "left": Parameter(0.2, bounds=(0.0, 2.0)),
            "right": Parameter(0.2, bounds=(0.0, 2.0)),
            "knee": Parameter(1.0, bounds=(0.1, 5.0)),
            "shift": Parameter(0.0, bounds=(-2.0, 2.0)),
        }
    )
    operator = GeneralizedPlay(
        gamma_l=lambda z, p: z + p["left"] * ca.tanh(p["knee"] * z - p["shift"]),
        gamma_r=lambda z, p: z + p["right"] * ca.tanh(p["knee"] * z - p["shift"]),
        extra=extra,
    )
    start = {"w": np.full((1, 3), 1 / 3), "r": np.array([[0.0, 0.3, 0.6]])}
    fixed = {"D_zu": 1.0, "D_yw": 1.0, "D_yu": 0.0}
    model = PILFR(0, PrandtlIshlinskii(operator, 3), fixed, offset=False).model(1, 1, start)
    return Case(model, (_record(u, y, rng, 0.01),), (y,), truth | {"w": w, "r": r})


def rig_with_open_spring(stops: int = 10) -> Model:
    """The rig's own equations (Krikelis et al. (2024), Eq. 25) in steps of Runge-Kutta, stops on a fixed grid for its spring.

    The spring's force is held over a step, so it is read at the middle of it, `z = x1 + h v1 / 2`.
    """
    rig, h = masing.MasingRig(), 1.0 / masing.FS
    physical = {
        "k1": Parameter(1.2 * rig.k1, "N/m", (200.0, 4000.0)),
        "d1": Parameter(0.8 * rig.d1, "N s/m", (0.0, 100.0)),
        "k2": Parameter(0.8 * rig.k2, "N/m", (2000.0, 40000.0)),
        "d2": Parameter(1.2 * rig.d2, "N s/m", (0.0, 200.0)),
    }

    def rates(x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
        link = p["k2"] * (x[0] - x[2]) + p["d2"] * (x[1] - x[3])
        ground = p["k1"] * x[0] + p["d1"] * x[1] + w
        return ca.vertcat(x[1], -(ground + link) / rig.m1, x[3], (u + link) / rig.m2)

    def step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
        a = rates(x, u, w, p)
        b = rates(x + h / 2 * a, u, w, p)
        c = rates(x + h / 2 * b, u, w, p)
        d = rates(x + h * c, u, w, p)
        return x + h / 6 * (a + 2 * b + 2 * c + d), x[2]

    def port(x: Any, u: Any, p: dict[str, Any]) -> Any:
        return x[0] + h / 2 * x[1]

    names = ("x1", "v1", "x2", "v2")
    model = open_model(step, port, ParameterSet(physical), n_x=4, n_u=1, n_w=1, states=names, outputs=("x2",))
    model = close_loop(model, PrandtlIshlinskii(Stop, stops))
    r = np.linspace(0.0, 1.2e-3, stops + 1)[1:]
    r, w = masing.stop_elements(stops, float(r[-1]), rig.K, rig.r_u)
    start = {"w": {"value": np.full((1, stops), np.mean(w))}, "r": {"value": r[None, :], "fixed": True}}
    return model.with_parameters(model.parameters.change(**start))


def masing_grey(seed: int = 0) -> Case:
    """The rig of `masing` with its hysteretic spring's port open: physical parameters 20 % off, weights all alike."""
    data = masing.benchmark(seed)
    record = data.records["train"].slice(0, 2048)
    rig = masing.MasingRig()
    truth = {name: getattr(rig, name) for name in ("k1", "d1", "k2", "d2")}
    return Case(rig_with_open_spring(), (record,), (data.truth["train"].x2[:2048, None],), truth, exact=False)


CASES: dict[str, Callable[..., Case]] = {
    "lti": lti,
    "backlash_loop": backlash_loop,
    "pi_hammerstein": pi_hammerstein,
    "pi_wiener": pi_wiener,
    "mimo_lfr": mimo_lfr,
    "asymmetric": asymmetric,
    "masing_grey": masing_grey,
}
