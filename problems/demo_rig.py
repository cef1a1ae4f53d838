"""The rig that the demonstration diagnoses: two masses, and something in it that its simulator does not have.

    m₁ ẍ₁ = F - k₁ x₁ - d₁ ẋ₁ - k₂ (x₁ - x₂) - d₂ (ẋ₁ - ẋ₂),
    m₂ ẍ₂ = k₂ (x₁ - x₂) + d₂ (ẋ₁ - ẋ₂) - w,
    w = σ₀ ζ + σ₁ ζ̇,   ζ̇ = v - σ₀ |v| ζ / (F_c + (F_s - F_c) exp(-(v / v_s)²)),   v = ẋ₂.

The second mass slides with LuGre friction (Canudas de Wit et al. 1995), which is not a formula of the catalogue. The
simulator's parameters are off by up to 15 %.

    python -m problems.demo_rig        writes rig_train.csv and rig_test.csv into pilfr_casadi/cli/demo_data
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pilfr_casadi.data import Recording, multisine

from .simulated_cases import trajectory

DT, SAMPLES, NOISE, FINE = 0.01, 1000, 1e-4, 100
FOLDER = Path(__file__).parent.parent / "pilfr_casadi" / "cli" / "demo_data"
M1, M2, K1, K2, D1, D2 = 1.2, 0.8, 420.0, 900.0, 2.0, 1.5
SIGMA0, SIGMA1, F_C, F_S, V_S = 5000.0, 5.0, 1.1, 1.25, 0.05


def rates(s: np.ndarray, force: float) -> np.ndarray:
    """Derivative of (x₁, v₁, x₂, v₂, ζ)."""
    x1, v1, x2, v2, bristle = s
    g = F_C + (F_S - F_C) * np.exp(-((v2 / V_S) ** 2))
    slip = v2 - SIGMA0 * abs(v2) * bristle / g
    friction = SIGMA0 * bristle + SIGMA1 * slip
    inner = K2 * (x1 - x2) + D2 * (v1 - v2)
    return np.array([v1, (force - K1 * x1 - D1 * v1 - inner) / M1, v2, (inner - friction) / M2, slip])


def record(seed: int, name: str, samples: int = SAMPLES) -> Recording:
    """One experiment from rest: force in N, displacement of the second mass in m."""
    rng = np.random.default_rng(seed)
    force = 9.0 * multisine(samples, f_max=6.0, fs=1 / DT, rng=rng)
    x2 = trajectory(rates, np.zeros(5), force, DT, FINE)[:, 2]
    measured = x2 + NOISE * rng.standard_normal(samples)
    return Recording(force, measured, DT, ("force",), ("x2",), initial="zero", hold="zero", name=name)


def main() -> None:
    """Write the recordings of the demonstration."""
    for seed, name in ((11, "rig_train"), (12, "rig_test")):
        r = record(seed, name)
        table = np.column_stack([r.t, r.u, r.y])
        path = FOLDER / f"{name}.csv"
        np.savetxt(path, table, delimiter=",", header="t,force,x2", comments="", fmt=["%.2f", "%.6g", "%.7g"])
        print(f"{path}: {len(r)} samples, standard deviation of x2 {np.std(r.y):.3g} m")


if __name__ == "__main__":
    main()
