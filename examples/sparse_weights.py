"""Fit sparse weights: an L1 penalty removes operators, the others are fitted again; validation selects the number."""

import numpy as np

import pilfr_casadi as pilfr


def record(seed):
    """Simulate a drive with three plays behind a lag."""
    rng = np.random.default_rng(seed)
    u = pilfr.multisine(2000, f_max=5.0, fs=100.0, rng=rng)
    memory, x, y = np.zeros(3), 0.0, np.zeros_like(u)
    for k, value in enumerate(u):
        y[k] = x
        memory = pilfr.play(value, memory, np.array([0.1, 0.5, 1.0]))
        x = 0.8 * x + 0.2 * np.array([0.5, 0.3, 0.2]) @ memory
    return pilfr.Recording(u, y + 0.005 * rng.standard_normal(u.size), dt=0.01, initial="zero")


train, validation, test = record(0), record(1), record(2)
full = pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 10)), train, starts=3)
path = pilfr.regularization_path(full, train, validation)  # the test record plays no part

print(path)
sparse = path.fit
print(sparse)
print(f"on the test record: {path.operators[0]} operators {full.nrmse(test):.4f}, {path.operators[path.recommended]} ")
print(f"operators {sparse.nrmse(test):.4f}; thresholds {np.sort(sparse.parameters['r'][0]).round(3)}")
assert path.operators[path.recommended] <= 5 and sparse.nrmse(test) < 1.1 * full.nrmse(test)
