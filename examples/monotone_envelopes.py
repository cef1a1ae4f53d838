"""Fit monotone envelopes: a saturating hysteresis with different curves up and down, neither of which can fall."""

import numpy as np

import pilfr_casadi as pilfr

# an actuator that saturates: a generalized play between two different curves, read behind a lag
rng = np.random.default_rng(0)
u = 2.0 * pilfr.multisine(2000, f_max=4.0, fs=100.0, rng=rng)
q, x, y = 0.0, 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    y[k] = x
    q = pilfr.generalized_play(value, q, 0.15, lambda z: np.tanh(0.8 * z), lambda z: 0.9 * np.tanh(1.1 * z) + 0.2)
    x = 0.8 * x + 0.2 * q
record = pilfr.Recording(u, y + 0.005 * rng.standard_normal(u.size), dt=0.01, initial="zero")

operator = pilfr.GeneralizedPlay(neurons=5)  # slopes of the networks are bounded: no envelope can fall
fit = pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(operator, 1)), record, starts=6)
plain = pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 4)), record, starts=3)

print(fit)
z = np.linspace(-2 * np.max(np.abs(u)), 2 * np.max(np.abs(u)), 1000)  # far beyond the range of the recording
curves = {side: operator.envelope(side, z, fit.parameters) for side in ("l", "r")}
print(f"NRMSE with envelopes {fit.nrmse(record):.4f}, four plain plays {plain.nrmse(record):.4f}")
assert all(np.all(np.diff(curve) >= 0) for curve in curves.values()) and fit.nrmse(record) < 0.5 * plain.nrmse(record)
