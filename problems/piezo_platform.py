"""A piezo-driven motion platform: what a measured one of its kind would say, from documented physics.

It stands in for the confidential recordings of Krikelis et al. (2024), Sec. 7, with their excitation and sampling. The
actuator is the electromechanical model of Goldfarb & Celanovic (1997), IEEE Control Systems 17(3): the amplifier drives
charge q through its resistance into the Maxwell slip elements (`v_m = Σ k_j S_rj[q]`, many stops) in series with the
capacitance, whose voltage pushes the platform; the displacement x at the actuator acts back on the charge,

    τ dq/dt = u - v_m(q) - v_t,    v_t = q - T x,    force = T v_t      (capacitance and static stiffness are one).

So the hysteresis sits in a loop with the mechanics: nearly, not quite, a Hammerstein system. The platform is a sum of
modes, `η'' + 2 ζ ω η' + ω² η = ω² force`, which the actuator moves by `Σ a η` and the capacitive sensor sees as
`Σ s η`. Creep follows the displacement at the sensor through slow first-order lags (Adriaens, de Koning & Banning 2000,
IEEE/ASME Trans. Mechatronics 5). The sensor adds white noise. The input is held between samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pilfr_casadi.data import Recording, multisine

FS = 10_000.0  # Hz
N_PERIOD = 8192
PERIODS = 5
REALIZATIONS = 10
UNITS = {"voltage": "V", "displacement": "µm"}


@dataclass(frozen=True)
class Platform:
    """Parameters of the platform.

    Attributes
    ----------
    modes : tuple of (Hz, share of critical damping, share of the actuator's static displacement, of the sensor's)
    lag : float
        Time constant of amplifier and capacitance, s.
    coupling : float
        T: displacement pushes back the charge.
    stiffness : float
        Of all Maxwell elements together for the smallest motion, in units of the capacitance's.
    spread : float
        Mean threshold of the elements, V; their stiffness thins out exponentially with the threshold.
    elements : int
        How many.
    creep : tuple of (share of the displacement, time constant in s)
    gain : float
        µm a volt, at the sensor.
    noise : float
        Standard deviation of the sensor, µm.
    """

    modes: tuple[tuple[float, float, float, float], ...] = (
        (172.0, 0.012, 0.03, 0.05),
        (404.0, 0.010, 0.06, 0.10),
        (561.0, 0.012, 0.03, -0.05),
        (738.0, 0.010, 0.04, 0.06),
        (1618.0, 0.005, 0.25, 0.35),
        (1742.0, 0.004, 0.35, 0.42),
        (4100.0, 0.010, 0.24, 0.07),
    )
    lag: float = 5e-5
    coupling: float = 0.5
    stiffness: float = 0.6
    spread: float = 6.0
    elements: int = 100
    creep: tuple[tuple[float, float], ...] = ((0.04, 0.02), (0.04, 0.2), (0.04, 2.0))
    gain: float = 0.1
    noise: float = 0.198

    def steady(self, u: np.ndarray, substeps: int = 8, settle: int = 3) -> np.ndarray:
        """Displacement (µm) without noise over one period, in periodic steady state.

        Parameters
        ----------
        u : array, shape (experiments, period)
            One period of each experiment's voltage, V.
        substeps : int
            Steps per sample.
        settle : int
            Periods that are run before.
        """
        from scipy.linalg import expm

        h, n = 1 / (FS * substeps), len(u)
        f, zeta, actuator, sensor = np.array(self.modes).T
        omega = 2 * np.pi * f
        a = np.zeros((len(f), 3, 3))  # of each mode: displacement, velocity, force held over a step
        a[:, 0, 1], a[:, 1, 0], a[:, 1, 1], a[:, 1, 2] = 1.0, -(omega**2), -2 * zeta * omega, omega**2
        (x_x, x_v, x_f), (v_x, v_v, v_f) = np.moveaxis(expm(a * h)[:, :2], 0, -1)
        r = self.spread * np.linspace(0, 5, self.elements + 1)[1:]
        k = np.exp(-r / self.spread)
        k *= self.stiffness / k.sum()
        slope = 1.0 + self.stiffness
        gain = -np.expm1(-slope * h / self.lag) / slope
        q, memory, x, v = np.zeros(n), np.zeros((n, len(r))), np.zeros((n, len(f))), np.zeros((n, len(f)))
        out = np.empty_like(u)
        for period in range(settle + 1):
            for i in range(u.shape[1]):
                if period == settle:
                    out[:, i] = x @ sensor
                for _ in range(substeps):
                    v_t = q - self.coupling * (x @ actuator)
                    stopped = self.stiffness * q - memory @ k
                    q = q + gain * (u[:, i] - stopped - v_t)
                    np.clip(memory, q[:, None] - r, q[:, None] + r, out=memory)
                    force = self.coupling * v_t[:, None]
                    x, v = x_x * x + x_v * v + x_f * force, v_x * x + v_v * v + v_f * force
        return self.gain / self.coupling * self._crept(out)

    def _crept(self, y: np.ndarray) -> np.ndarray:
        """The periodic signal with what creeps after it."""
        s = 2j * np.pi * np.fft.rfftfreq(y.shape[1], 1 / FS)
        response = 1 + sum(share / (1 + s * tau) for share, tau in self.creep)
        return np.fft.irfft(response * np.fft.rfft(y, axis=1), y.shape[1], axis=1)


@dataclass(frozen=True, eq=False)
class Measurement:
    """Steady periods of every realization, and what a user makes of them.

    Attributes
    ----------
    recordings : tuple of Recording
        One for each realization, `PERIODS` periods of it.
    """

    recordings: tuple[Recording, ...]

    def averaged(self) -> list[Recording]:
        """One period of each realization, the mean over the measured ones."""
        out = []
        for r in self.recordings:
            assert r.period is not None
            y = r.y.reshape(-1, r.period, r.n_y).mean(axis=0)
            out.append(r.with_(u=r.u[: r.period], y=y))
        return out

    def floor(self) -> float:
        """Deviation of the averaged outputs' noise over the output's, from what differs between periods."""
        variance, power = 0.0, 0.0
        for r, mean in zip(self.recordings, self.averaged(), strict=True):
            periods = r.y.reshape(-1, len(mean), r.n_y)
            variance += float(np.mean(np.var(periods, axis=0, ddof=1))) / len(periods)
            power += float(np.var(mean.y))
        return float(np.sqrt(variance / power))


def measure(
    f_max: float,
    seed: int = 0,
    *,
    rms: float = 10.0,
    realizations: int = REALIZATIONS,
    n_period: int = N_PERIOD,
    platform: Platform | None = None,
) -> Measurement:
    """Multisines (Eq. 18) from 0 to `f_max` Hz, of `rms` V, each measured over `PERIODS` steady periods."""
    platform, rng = platform or Platform(), np.random.default_rng([seed, round(f_max)])
    u = np.array([rms * multisine(n_period, f_max, FS, rng) for _ in range(realizations)])
    y = platform.steady(u)
    recordings = []
    for k in range(realizations):
        noisy = np.tile(y[k], PERIODS) + platform.noise * rng.standard_normal(PERIODS * n_period)
        r = Recording(
            np.tile(u[k], PERIODS), noisy, 1 / FS, ("voltage",), ("displacement",), UNITS, n_period, "periodic"
        )
        recordings.append(r.with_(hold="zero", name=f"realization {k + 1}"))
    return Measurement(tuple(recordings))
