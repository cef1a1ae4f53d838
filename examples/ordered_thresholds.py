"""Order the thresholds: operators keep their order and a distance, so that weights can be compared between fits."""

import numpy as np

import pilfr_casadi as pilfr

# backlash of three gears in parallel behind a lag
rng = np.random.default_rng(0)
u = pilfr.multisine(2000, f_max=5.0, fs=100.0, rng=rng)
memory, x, y = np.zeros(3), 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    y[k] = x
    memory = pilfr.play(value, memory, np.array([0.1, 0.4, 0.8]))
    x = 0.8 * x + 0.2 * np.array([0.5, 0.3, 0.2]) @ memory
record = pilfr.Recording(u, y + 0.003 * rng.standard_normal(u.size), dt=0.01, initial="zero")

structure = pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 5))
free = pilfr.fit(structure, record, starts=2)
fit = pilfr.fit(structure, record, starts=2, constraints=[pilfr.ordered("r", gap=0.1)])

print(fit)
print(f"thresholds {fit.parameters['r'][0].round(3)}, without the constraint {free.parameters['r'][0].round(3)}")
print(f"NRMSE {fit.nrmse(record):.4f}, without the constraint {free.nrmse(record):.4f}")
assert np.all(np.diff(fit.parameters["r"][0]) >= 0.1) and fit.nrmse(record) < 1.1 * free.nrmse(record)
