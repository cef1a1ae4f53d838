r"""Real modes in continuous time of a discrete linear model.

.. math:: A_c = \log(A) / \Delta t, \qquad B_c = \left(\int_0^{\Delta t} e^{A_c s} ds\right)^{-1} B
   \quad\text{(inputs held)},

with the first-order-hold counterpart where inputs are interpolated (Franklin, Powell & Workman 1998, Digital Control of
Dynamic Systems, Sec. 4.3 and 6.3). A pair of eigenvalues `-ζ ω ± j ω √(1 - ζ²)` becomes a displacement `q` and its rate
`v`,

.. math:: \dot q = v + b_q u, \qquad \dot v = -\omega^2 q - 2 ζ ω v + b_v u, \qquad y = c_q q + c_v v,

and a real eigenvalue `-r` the equation `q' = -r q + b u`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from .._base import InputError
from ..data import COURSES

Array = np.ndarray
FASTEST = 0.9  # share of the Nyquist frequency above which an eigenvalue has no reliable continuous counterpart
ILL_CONDITIONED = 1e5  # condition number above which a pair's eigenvectors are not reliable


@dataclass(frozen=True, eq=False)
class Mode:
    """A real mode: one eigenvalue, or a conjugate pair.

    Attributes
    ----------
    value : complex
        Eigenvalue in rad/s: of a pair the one with positive imaginary part, of two real ones the faster.
    into : array, shape (1 or 2, n_u)
        Gains of the inputs on q (and v).
    out : array, shape (n_y, 1 or 2)
        Gains of q (and v) in the outputs.
    spring : (float, float), optional
        For two real eigenvalues -a and -b combined: a b and a + b.
    """

    value: complex
    into: Array
    out: Array
    spring: tuple[float, float] | None = None

    @property
    def second_order(self) -> bool:
        """Whether it has a displacement and a rate."""
        return bool(len(self.into) == 2)

    def label(self, slowest: float) -> str:
        """Return the frequency in Hz as a name, for a pair the undamped natural one; zero below `slowest` rad/s."""
        rate = np.sqrt(abs(self.spring[0])) if self.spring else abs(self.value)
        return f"{rate / (2 * np.pi):.3g} Hz" if rate > slowest else "0 Hz"


def to_continuous(a: Array, b: Array, c: Array, d: Array, dt: float, hold: str) -> tuple[Array, Array, Array, Array]:
    """Convert a discrete state space to continuous time, for held or interpolated inputs, or next values.

    Parameters
    ----------
    a, b, c, d : array
        Shapes (n, n), (n, n_u), (n_y, n), (n_y, n_u).
    dt : float
        Sampling interval, s.
    hold : {"zero", "linear", "next"}

    Raises
    ------
    InputError
        If an eigenvalue lies on the negative real axis, or too near the Nyquist frequency or zero.
    """
    from scipy.linalg import expm, logm

    n = len(a)
    if not n:
        return a, b, c, d
    values = np.linalg.eigvals(a)
    angle = np.abs(np.angle(values))
    if np.any(angle > FASTEST * np.pi) or np.any(np.abs(values) < 1e-4):
        raise InputError("The model has a mode too fast for its step; simulate at a shorter step.")
    with warnings.catch_warnings():  # logm warns of errors of 1e-11
        warnings.simplefilter("ignore", RuntimeWarning)
        a_c = np.real(logm(a)) / dt
    # ∫ e^{A s} ds and ∫ e^{A (Δ - s)} s ds / Δ in one exponential (Van Loan, 1978)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n], block[:n, n : 2 * n], block[n : 2 * n, 2 * n :] = a_c * dt, np.eye(n) * dt, np.eye(n)
    whole = expm(block)
    gamma_1, gamma_2 = whole[:n, n : 2 * n], whole[:n, 2 * n :]
    # x⁺ = A x + (Γ₁ - Γ) B u + Γ B u⁺ is x⁺ = A x' + B_d u with x' = x - Γ B u:  B_d = (Γ₁ - Γ + A Γ) B
    course = COURSES[hold]
    gamma = gamma_1 if course.begin else gamma_2 if course.end else 0 * gamma_1
    b_c = np.linalg.solve(gamma_1 - gamma + a @ gamma, b)
    return a_c, b_c, c, d - c @ gamma @ b_c


def modes(a: Array, b: Array, c: Array) -> list[Mode]:
    """Split a state space into real modes, slowest first."""
    values, right = np.linalg.eig(a)
    left = np.linalg.inv(right)
    out: list[Mode] = []
    for k, value in enumerate(values):
        if value.imag < -1e-9 * abs(value):
            continue
        into, seen = left[k] @ b, c @ right[:, k]
        if abs(value.imag) <= 1e-9 * abs(value):
            scale = _unit(np.real(into[None, :]))
            out.append(Mode(complex(value.real), np.real(into[None, :]) / scale, np.real(seen[:, None]) * scale))
            continue
        pair = [k, int(np.argmin(np.abs(values - np.conj(value))))]
        others = np.setdiff1d(np.arange(len(values)), pair)
        # a nearly double eigenvalue has no reliable eigenvectors; its part is the complement of the others
        poor = np.linalg.cond(right[:, pair]) > ILL_CONDITIONED
        part = np.eye(len(a)) - right[:, others] @ left[others] if poor else right[:, pair] @ left[pair]
        out.append(_pair(np.real(part), complex(value), a, b, c))
    return sorted(_combine_real_modes(out), key=lambda mode: abs(mode.value))


def _pair(part: Array, value: complex, a: Array, b: Array, c: Array) -> Mode:
    """Write a pair as displacement and rate, `q' = v`, `v' = -|value|² q + 2 Re(value) v + u`, in its part of states.

    The strongest input enters v alone: v is the coordinate along `b`, and q along `A b - 2 Re(value) b`, both projected
    on the part.
    """
    force = part @ b
    size = np.linalg.norm(force, axis=0)
    if not np.any(size > 0):
        force, size = part, np.linalg.norm(part, axis=0)  # no input enters: any direction will do
    strongest = force[:, np.argmax(size)]
    basis = np.column_stack([a @ strongest - 2 * value.real * strongest, strongest])
    entering = np.linalg.lstsq(basis, part @ b, rcond=None)[0]
    scale = _unit(entering[1:])
    return Mode(value, entering / scale, c @ basis * scale)


def _combine_real_modes(found: list[Mode]) -> list[Mode]:
    """Combine two real modes with equal inputs and cancelling jumps to a mass: `q'' = -a b q - (a + b) q' + u`."""
    real = [mode for mode in found if not mode.second_order]
    if len(real) != 2 or not np.allclose(real[0].into, real[1].into, rtol=0.0, atol=0.02):
        return found
    (one, two), jump = real, real[0].out + real[1].out
    if np.max(np.abs(jump)) > 0.02 * np.max(np.abs(one.out)):
        return found
    a, b = -one.value.real, -two.value.real
    into, out = np.vstack([0 * one.into, one.into]), np.column_stack([one.out * b + two.out * a, jump])
    rest = [mode for mode in found if mode.second_order]
    return [*rest, Mode(complex(-max(a, b, key=abs)), into, out, (a * b, a + b))]


def _unit(into: Array) -> float:
    """Return the scale that makes the largest gain of the inputs one."""
    largest = into.ravel()[np.argmax(np.abs(into))]
    return float(largest) if largest else 1.0
