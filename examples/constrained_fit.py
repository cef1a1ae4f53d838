"""Constrain stability and gain: a Hammerstein model with an exact bound on its poles and a known DC gain."""

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


def rise(p):
    """Compute the first sample of the step response; any expression of the named parameters can be bounded."""
    return (p["C_y"] @ p["B_w"] + p["D_yw"]) * ca.sum2(p["w"])


structure = pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 4))
mine = pilfr.Constraint(rise, lower=0.0, upper=0.205, name="first rise")
fit = pilfr.fit(structure, record, starts=2, stable=0.899, constraints=[pilfr.dc_gain(2.0), mine])

print(fit)  # which constraints are active, with their multipliers
for limit in fit.limits:
    print(f"{limit.name:<50} {limit.value: .6f}  {'active' if limit.active else ''}  {limit.multiplier:.3g}")
p = fit.parameters
gain = p["C_y"] @ np.linalg.solve(np.eye(1) - p["A"], p["B_w"] @ p["w"].sum(1)) + p["D_yw"] @ p["w"].sum(1)
print(f"DC gain {gain.item():.9f}, pole {p['A'].item():.9f}, NRMSE {fit.nrmse(record):.4f}")
assert max(abs(np.linalg.eigvals(p["A"]))) <= 0.899  # exactly, not up to a tolerance
assert abs(gain.item() - 2.0) < 1e-6 and fit.nrmse(record) < 0.02
