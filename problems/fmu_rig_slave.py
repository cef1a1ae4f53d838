"""The rig of `fmu_rig` as a unit for co-simulation, built by PythonFMU: it steps by Runge-Kutta, states are outputs."""

from collections.abc import Sequence
from typing import Any

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

MASSES = (1.2, 0.8)
STATES = ("pos1", "vel1", "pos2", "vel2")


class Rig(Fmi2Slave):
    """Two masses on springs; the friction in the guide is missing."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.k1, self.k2, self.d1, self.d2 = 380.0, 1000.0, 2.3, 1.3
        self.pos1 = self.vel1 = self.pos2 = self.vel2 = 0.0
        self.force = self.guide_force = self.power = 0.0
        for name in ("k1", "k2", "d1", "d2"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))
        for name in ("force", "guide_force"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in (*STATES, "power"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def rates(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Derivatives of the states."""
        pos1, vel1, pos2, vel2 = state
        inner = self.k2 * (pos1 - pos2) + self.d2 * (vel1 - vel2)
        outer = self.k1 * pos1 + self.d1 * vel1
        return vel1, (self.force + self.guide_force - outer - inner) / MASSES[0], vel2, inner / MASSES[1]

    def do_step(self, current_time: float, step_size: float) -> bool:
        """One Runge-Kutta step."""
        x = [getattr(self, name) for name in STATES]
        moved, total = x, [0.0] * 4
        for share, weight in ((0.5, 1 / 6), (0.5, 1 / 3), (1.0, 1 / 3), (0.0, 1 / 6)):
            slope = self.rates(moved)
            moved = [a + share * step_size * k for a, k in zip(x, slope, strict=True)]
            total = [a + weight * k for a, k in zip(total, slope, strict=True)]
        for name, a, k in zip(STATES, x, total, strict=True):
            setattr(self, name, a + step_size * k)
        self.power = self.force**2
        return True
