"""
A filter and a hysteresis do not commute
========================================

The same filter on inputs and outputs preserves the relation of a linear machine. A play reverses at the extremes of its
input, and a filter rounds them off, so the relation of a machine with play is lost.
"""

import numpy as np

import pilfr_casadi as pilfr

rng, dt = np.random.default_rng(0), 0.01
u = 2 * pilfr.multisine(3000, f_max=10.0, fs=1 / dt, rng=rng)
linear, played, memory = np.zeros(3000), np.zeros(3000), 0.0
for k in range(1, 3000):
    memory = float(np.clip(memory, u[k - 1] - 1.0, u[k - 1] + 1.0))
    linear[k] = 0.9 * linear[k - 1] + 0.1 * u[k - 1]
    played[k] = 0.9 * played[k - 1] + 0.1 * memory
machines = {"linear": linear, "play": played}

# %%
# Fit each machine with its true structure, to the raw recordings and to recordings after a low-pass at 4 Hz.

structures = {"linear": pilfr.PILFR(1), "play": pilfr.PILFR(1, pilfr.PrandtlIshlinskii(pilfr.Play, 6))}
errors = {}
for name, y in machines.items():
    recorded = pilfr.Recording(u, y, dt, initial="zero", name=name)
    for label, r in (("as recorded", recorded), ("filtered", recorded.filter(4.0).cut(1.0, 29.0))):
        fit = pilfr.fit(structures[name], r, starts=2)
        errors[name, label] = fit.train_nrmse[0]
print({", ".join(case): f"{error:.1e}" for case, error in errors.items()})

# %%
# No play explains the filtered recording of the machine with play.

lost = pilfr.compare(r, {"play, filtered": fit}).plot()
assert errors["linear", "filtered"] < 1e-2 < errors["play", "filtered"]
