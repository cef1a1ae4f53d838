"""Constraints, bounds and priors: a Hammerstein model with a known DC gain and a bounded spectral radius."""

import casadi as ca
import numpy as np

import pilfr_casadi as pilfr

# a stack with a play of half-width 0.2 behind a lag; its DC gain for a fully slipping play is 2
rng = np.random.default_rng(0)
u = pilfr.multisine(2000, f_max=5.0, fs=100.0, rng=rng)
q, x, y = 0.0, 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    q = pilfr.play(value, q, 0.2)
    y[k] = x
    x = 0.9 * x + 0.2 * q
record = pilfr.Recording(u, y + 0.01 * rng.standard_normal(u.size), dt=0.01, initial="zero")


def dc_gain(p):
    """Gain of the linear part times the slope of the fully slipping element."""
    eye = ca.DM.eye(p["A"].shape[0])
    return (p["C_y"] @ ca.solve(eye - p["A"], p["B_w"]) + p["D_yw"]) * ca.sum2(p["w"])


known_gain = pilfr.Constraint(dc_gain, lower=2.0, upper=2.0, name="DC gain = 2")
structure = pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 4))
fit = pilfr.fit(structure, record, starts=2, stable=0.95, constraints=[known_gain])

print(fit)
p = {name: ca.DM(value) for name, value in fit.parameters.items()}
print(f"DC gain {float(dc_gain(p)):.9f}, pole {fit.parameters['A'].item():.4f}, NRMSE {fit.nrmse(record):.4f}")
assert abs(float(dc_gain(p)) - 2.0) < 1e-6
assert fit.nrmse(record) < 0.02
