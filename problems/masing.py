r"""The paper's benchmark as an exact simulator: a two-mass rig on a hysteretic (extended Masing) spring.

Source: Krikelis et al. (2024), Sec. 6: rig Eq. 25, numbers Table 1; the spring is in `masing_spring`.

Between events (a reversal of x1, a loop that closes) the right-hand side is smooth, so a fixed Runge-Kutta step that
stays on one branch is of fourth order; the few steps with an event inside are cut at it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from pilfr_casadi._base import InputError

from .masing_spring import Branch, MasingSpring

MAX_EVENTS = 20  # within one substep


@dataclass(frozen=True)
class MasingRig:
    """Physical parameters of the rig, Krikelis et al. (2024), Table 1; in kg, N/m, N s/m and N."""

    m1: float = 2.27
    m2: float = 2.86
    k1: float = 1100.0
    d1: float = 15.0
    k2: float = 1.1e4
    d2: float = 19.9
    K: float = 3000.0
    r_u: float = 0.8

    @property
    def spring(self) -> MasingSpring:
        """The hysteretic spring before it has ever moved."""
        return MasingSpring(self.K, self.r_u)

    def matrices(self, *, virgin_spring: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Continuous-time linear model of Eq. 25 with states (x1, v1, x2, v2), input u and output x2.

        Parameters
        ----------
        virgin_spring : bool
            Put a linear spring of the initial stiffness K in the place of the hysteretic one; otherwise leave it out.

        Returns
        -------
        A, B, C, D : array, (4, 4), (4, 1), (1, 4), (1, 1)
            In the order in which ``control.ss`` takes them.
        """
        m1, m2, d1, k2, d2 = self.m1, self.m2, self.d1, self.k2, self.d2
        k1 = self.k1 + (self.K if virgin_spring else 0.0)
        first = [-(k1 + k2) / m1, -(d1 + d2) / m1, k2 / m1, d2 / m1]
        second = [k2 / m2, d2 / m2, -k2 / m2, -d2 / m2]
        A = np.array([[0.0, 1.0, 0.0, 0.0], first, [0.0, 0.0, 0.0, 1.0], second])
        return A, np.array([[0.0], [0.0], [0.0], [1.0 / m2]]), np.array([[0.0, 0.0, 1.0, 0.0]]), np.zeros((1, 1))


@dataclass(frozen=True, eq=False)
class Motion:
    """True motion of the rig at the samples: x1, x2 in m, v1, v2 in m/s, spring force k_H in N; each (M,)."""

    x1: np.ndarray
    v1: np.ndarray
    x2: np.ndarray
    v2: np.ndarray
    k_H: np.ndarray


State = tuple[float, float, float, float]
Stepper = Callable[[State, float, float, float, Branch], State]


def stepper(rig: MasingRig) -> Stepper:
    """Classical Runge-Kutta step of Eq. 25 along one branch; the force starts at u, N, and changes by du, N/s."""
    A, B, _, _ = rig.matrices(virgin_spring=False)
    (p1, p2, p3, p4), (q1, q2, q3, q4) = A[1].tolist(), A[3].tolist()
    b, m1, expm1 = float(B[3, 0]), rig.m1, math.expm1

    def step(state: State, h: float, u: float, du: float, branch: Branch) -> State:
        x0, f0, gain, rate, _ = branch
        f0, gain, half = f0 / m1, gain / m1, 0.5 * h
        x1, v1, x2, v2 = state
        a1 = p1 * x1 + p2 * v1 + p3 * x2 + p4 * v2 - f0 + gain * expm1(rate * (x1 - x0))
        a2 = q1 * x1 + q2 * v1 + q3 * x2 + q4 * v2 + b * u
        u += half * du
        xb, vb, yb, wb = x1 + half * v1, v1 + half * a1, x2 + half * v2, v2 + half * a2
        b1 = p1 * xb + p2 * vb + p3 * yb + p4 * wb - f0 + gain * expm1(rate * (xb - x0))
        b2 = q1 * xb + q2 * vb + q3 * yb + q4 * wb + b * u
        xc, vc, yc, wc = x1 + half * vb, v1 + half * b1, x2 + half * wb, v2 + half * b2
        c1 = p1 * xc + p2 * vc + p3 * yc + p4 * wc - f0 + gain * expm1(rate * (xc - x0))
        c2 = q1 * xc + q2 * vc + q3 * yc + q4 * wc + b * u
        u += half * du
        xd, vd, yd, wd = x1 + h * vc, v1 + h * c1, x2 + h * wc, v2 + h * c2
        d1 = p1 * xd + p2 * vd + p3 * yd + p4 * wd - f0 + gain * expm1(rate * (xd - x0))
        d2 = q1 * xd + q2 * vd + q3 * yd + q4 * wd + b * u
        h /= 6.0
        return (
            x1 + h * (v1 + 2.0 * (vb + vc) + vd),
            v1 + h * (a1 + 2.0 * (b1 + c1) + d1),
            x2 + h * (v2 + 2.0 * (wb + wc) + wd),
            v2 + h * (a2 + 2.0 * (b2 + c2) + d2),
        )

    return step


def advance(
    step: Stepper, spring: MasingSpring, start: State, h: float, u: float, du: float
) -> tuple[MasingSpring, State]:
    """Go on for the time h, cutting the step at every reversal and at every loop that closes."""
    end = start
    for _ in range(MAX_EVENTS):
        branch, sign, cut = spring.branch, spring.direction, h
        end = step(start, h, u, du, branch)
        turning = sign * end[1] < 0.0
        if turning:
            cut = _crossing(1, 0.0, step, start, h, u, du, branch)
            end = step(start, cut, u, du, branch)
        if sign * (end[0] - branch.close) >= 0.0:
            cut = _crossing(0, branch.close, step, start, cut, u, du, branch)
            _, v1, x2, v2 = step(start, cut, u, du, branch)
            spring, start = spring.move(branch.close), (branch.close, v1, x2, v2)
        elif turning:
            x1, _, x2, v2 = end
            spring, start = replace(spring, x=x1).turn(), (x1, 0.0, x2, v2)
        else:
            break
        h, u = h - cut, u + cut * du
    return spring, end


def _crossing(
    entry: int, level: float, step: Stepper, start: State, h: float, u: float, du: float, branch: Branch
) -> float:
    """Time in [0, h] at which an entry of the state crosses a level: secant rule, Illinois variant."""
    lo, hi = 0.0, h
    f_lo, f_hi = start[entry] - level, step(start, h, u, du, branch)[entry] - level
    if f_lo * f_hi >= 0.0:  # there from the start
        return 0.0
    for _ in range(100):
        mid = hi - f_hi * (hi - lo) / (f_hi - f_lo)
        f_mid = step(start, mid, u, du, branch)[entry] - level
        if f_mid * f_hi < 0.0:
            lo, f_lo = hi, f_hi
        else:
            f_lo *= 0.5
        if f_mid == 0.0 or abs(mid - hi) <= 1e-12 * h:
            return mid
        hi, f_hi = mid, f_mid
    return hi


def simulate(u: ArrayLike, fs: float, *, rig: MasingRig | None = None, substeps: int = 8, hold: str = "zero") -> Motion:
    """Simulate the rig from rest.

    Parameters
    ----------
    u : array_like, (M,) or (M, 1)
        Force on mass 2, N.
    fs : float
        Sampling frequency, Hz.
    rig : MasingRig, optional
        Parameters; those of Table 1 by default.
    substeps : int
        Runge-Kutta steps per sample. At 120 Hz the default leaves an error of x2 below 1e-5 of its standard deviation,
        each doubling 16 times less; two reversals inside one substep go unseen.
    hold : {"zero", "linear"}
        Whether the force is held or interpolated between the samples.

    Returns
    -------
    Motion
        State and spring force at the samples, before the force of that sample has acted.

    Raises
    ------
    InputError
        For an input that is not one finite column, or an option out of its range.
    """
    force = np.asarray(u, float)
    force = force[:, 0] if force.ndim == 2 and force.shape[1] == 1 else force
    if force.ndim != 1 or not force.size or not np.isfinite(force).all():
        raise InputError(
            f"the rig has one force, but u has shape {force.shape} or is not finite; pass one column of it."
        )
    if hold not in ("zero", "linear"):
        raise InputError(f"hold is {hold!r}; use 'zero' or 'linear' for a force held or interpolated between samples.")
    if substeps < 1 or not fs > 0.0:
        raise InputError(f"{substeps} substeps at {fs} Hz cannot be simulated; both must be positive.")
    rig = rig or MasingRig()
    step, spring, h = stepper(rig), rig.spring, 1.0 / (fs * substeps)
    rates = np.zeros(force.size) if hold == "zero" else np.append(np.diff(force), 0.0) * fs
    branch, sign = spring.branch, spring.direction
    state: State = (0.0, 0.0, 0.0, 0.0)
    rows = []
    try:
        for u_k, du in zip(force.tolist(), rates.tolist(), strict=True):
            rows.append((*state, branch.force(state[0])))
            for i in range(substeps):
                u_i = u_k + i * h * du
                end = step(state, h, u_i, du, branch)
                if sign * end[1] < 0.0 or sign * (end[0] - branch.close) >= 0.0:
                    spring, end = advance(step, spring, state, h, u_i, du)
                    branch, sign = spring.branch, spring.direction
                state = end
    except OverflowError as error:
        raise InputError(f"steps of {h:g} s are too long for this rig and input; take more substeps.") from error
    return Motion(*np.array(rows).T.copy())
