r"""The hysteretic (extended Masing) spring of Krikelis et al. (2024), Eq. 26, as an exact law.

Eq. 26 with n = 1 integrates in closed form. Virgin loading follows the odd curve ``f(x) = r_u (1 - exp(-K x / r_u))``,
x >= 0, and a branch that leaves a reversal point (x_r, f_r) is the same curve doubled, ``f_r + 2 f((x - x_r) / 2)``
(Masing). A branch that comes back to the reversal point before its own closes a minor loop: both points are forgotten
and the older branch goes on as if nothing had been (Madelung); one that leaves the first reversal point x_r rejoins the
virgin curve at -x_r. The stack of open reversal points is the whole memory, and the force is exact for any path. The
same spring is the Prandtl model ``int_0^inf w(r) S_r[x] dr`` of stops S_r with
``w(r) = -f''(r) = (K^2 / r_u) exp(-K r / r_u)``.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple


class Branch(NamedTuple):
    """The curve the spring moves on, ``f0 - gain * expm1(rate * (x - x0))``, until x passes `close`."""

    x0: float
    f0: float
    gain: float
    rate: float
    close: float

    def force(self, x: float) -> float:
        """Force on this curve at x."""
        return self.f0 - self.gain * math.expm1(self.rate * (x - self.x0))


@dataclass(frozen=True)
class MasingSpring:
    """Immutable state of the spring of Krikelis et al. (2024), Eq. 26, n = 1.

    Attributes
    ----------
    K : float
        Initial stiffness, N/m.
    r_u : float
        Ultimate strength, N.
    x : float
        Present elongation, m.
    direction : int
        Sign of the last movement; 1 for a spring that has not moved.
    turns : tuple of (float, float)
        Open reversal points (x, force), oldest first.
    """

    K: float
    r_u: float
    x: float = 0.0
    direction: int = 1
    turns: tuple[tuple[float, float], ...] = ()

    @property
    def branch(self) -> Branch:
        """Curve of the next movement in the present direction, with the elongation that closes its loop."""
        if not self.turns:
            return Branch(
                0.0, 0.0, self.direction * self.r_u, -self.direction * self.K / self.r_u, self.direction * math.inf
            )
        x0, f0 = self.turns[-1]
        close = self.turns[-2][0] if len(self.turns) > 1 else -x0
        return Branch(x0, f0, self.direction * 2.0 * self.r_u, -self.direction * self.K / (2.0 * self.r_u), close)

    @property
    def force(self) -> float:
        """Spring force, N."""
        return self.branch.force(self.x)

    def turn(self) -> "MasingSpring":
        """Reverse on the spot: the present point becomes a reversal point."""
        turned = replace(self, direction=-self.direction, turns=(*self.turns, (self.x, self.force)))
        return turned._wipe_out()

    def move(self, x: float) -> "MasingSpring":
        """Move monotonically to elongation x, m, however far, and forget the loops closed on the way."""
        if x == self.x:
            return self
        spring = self if (x > self.x) == (self.direction > 0) else self.turn()
        return replace(spring, x=x)._wipe_out()

    def _wipe_out(self) -> "MasingSpring":
        spring = self
        while spring.turns and spring.direction * (spring.x - spring.branch.close) >= 0.0:
            spring = replace(spring, turns=spring.turns[:-2])
        return spring
