"""A smoother that finds an unknown force from outputs, along a run of a simulator.

The force may change by a random step each sample,

    Δx⁺ = A Δx + B Δw,   w⁺ = w + ε,   y_measured - y = C Δx + D Δw + noise,

and everything is estimated from all outputs, past and future (Rauch, Tung & Striebel 1965, AIAA J. 3(8)). The variances
of ε and of the noise (the given one or more) are the likeliest of a few.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..diagnose import over_samples
from ..linear import measurement_update

LOUDER = (1.0, 3.0, 9.0)  # factors on the noise
TRIED = np.logspace(-4.0, 0.5, 10)  # random steps of the force, in units of what the residual calls for


@dataclass(frozen=True, eq=False)
class UnknownForce:
    """The linear system that is smoothed, state [Δx; Δw] in units of its own size.

    f (M, n, n), h (M, n_y, n), outputs e (M, n_y) in units of the noise; w's known change `steps` (M,); `unit` (n,).
    """

    f: np.ndarray
    h: np.ndarray
    e: np.ndarray
    steps: np.ndarray
    unit: np.ndarray
    constant: bool

    @classmethod
    def of(
        cls,
        blocks: list[np.ndarray],
        error: np.ndarray,
        noise: np.ndarray,
        held: np.ndarray,
        states: np.ndarray,
        n: int,
    ) -> UnknownForce:
        """Compose the sub-steps of each sample, the force held over it."""
        m, n_x, n_y = len(error), states.shape[1], error.shape[1]
        a, b, c, d = blocks
        constant = np.allclose(a, a[0], rtol=1e-9, atol=1e-12)
        f, g = over_samples(a, b, n)
        g, c, d = g[:, :, 0], c[::n], d[::n, :, 0]
        noise = np.maximum(noise, 1e-6 * np.std(error, axis=0) + 1e-300)
        x, total = np.zeros(n_x), 0.0  # how strongly a lasting unit force shows
        for _ in range(min(m, 500)):
            total += float(np.sum(((c[0] @ x + d[0]) / noise) ** 2))
            x = f[0] @ x + g[0]
        response = np.sqrt(total / min(m, 500)) if np.isfinite(total) else 0.0
        spread = float(np.sqrt(np.mean((error / noise) ** 2)))
        size = max(spread / response if response > 0 else 0.0, float(np.std(held)), 1e-300)
        size = size if response > 0 else 0.0
        unit = np.append(np.maximum(np.std(states, axis=0), 1e-12), size)
        whole, seen = np.zeros((m, n_x + 1, n_x + 1)), np.zeros((m, n_y, n_x + 1))
        whole[:, :n_x, :n_x], whole[:, :n_x, n_x], whole[:, n_x, n_x] = f, g, 1.0
        seen[:, :, :n_x], seen[:, :, n_x] = c, d
        divided = np.where(unit > 0, unit, 1.0)
        return cls(
            whole / divided[:, None] * unit,
            seen * unit / noise[:, None],
            error / noise,
            np.append(-np.diff(held), 0.0) / divided[-1],
            unit,
            bool(constant),
        )

    def likeliest(self) -> tuple[float, float] | None:
        """Random step of the force and factor on the noise that make the errors likeliest; None where it is unseen."""
        if not self.unit[-1] > 0:
            return None
        length = min(len(self.e), 1200)
        found = [(self._filter(q, r, length)[0], (float(q), r)) for q in TRIED for r in LOUDER]
        usable = [v for v in found if np.isfinite(v[0])]
        return min(usable)[1] if usable else None

    def _filter(self, q: float, r: float, length: int) -> tuple[float, list[tuple[Any, ...]]]:
        """Minus twice the log likelihood, and predicted and filtered means and covariances."""
        n = len(self.unit)
        s, p = np.zeros(n), np.diag(np.append(np.full(n - 1, 0.01), 25.0))
        cost = 0.0
        kept: list[tuple[Any, ...]] = []
        for k in range(length):
            h = self.h[k]
            v, gain, p_at = measurement_update(p, h, r**2 * np.eye(len(h)))
            innovation = self.e[k] - h @ s
            cost += float(innovation @ np.linalg.solve(v, innovation)) + float(np.linalg.slogdet(v)[1])
            s_at = s + gain @ innovation
            p_at = (p_at + p_at.T) / 2
            kept.append((s, p, s_at, p_at))
            f = self.f[k]
            s, p = f @ s_at, f @ p_at @ f.T
            s[-1] += self.steps[k]
            p[-1, -1] += q**2
        return cost, kept

    def smooth(self, q: float, r: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Changes of states (M, n_x) and force (M,), and the force's standard deviation (M,)."""
        kept = self._filter(q, r, len(self.e))[1]
        m, n = len(kept), len(self.unit)
        mean, variance = np.empty((m, n)), np.empty(m)
        s, p = kept[-1][2], kept[-1][3]
        mean[-1], variance[-1] = s, p[-1, -1]
        for k in range(m - 2, -1, -1):
            ahead, p_ahead, at, p_at = kept[k + 1][0], kept[k + 1][1], kept[k][2], kept[k][3]
            gain = np.linalg.lstsq(p_ahead, self.f[k] @ p_at, rcond=1e-13)[0].T
            s, p = at + gain @ (s - ahead), p_at + gain @ (p - p_ahead) @ gain.T
            mean[k], variance[k] = s, p[-1, -1]
        mean *= self.unit
        return mean[:, :-1], mean[:, -1], np.sqrt(np.maximum(variance, 0.0)) * self.unit[-1]
