"""Fix known physical sub-matrices: an amplifier with the lag of its data sheet drives an unknown stage."""

import numpy as np

import pilfr_casadi as pilfr

# the amplifier: pole 0.7, gain 1; the stage: a lag and a play of half-width 0.2 between the two
rng = np.random.default_rng(0)
u = pilfr.multisine(2000, f_max=10.0, fs=100.0, rng=rng)
amplifier, q, stage, y = 0.0, 0.0, 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    y[k] = stage
    q = pilfr.play(amplifier, q, 0.2)
    amplifier, stage = 0.7 * amplifier + 0.3 * value, 0.9 * stage + 0.05 * amplifier + 0.15 * q
record = pilfr.Recording(u, y + 0.002 * rng.standard_normal(u.size), dt=0.01, initial="zero")

free = np.nan  # unknown entries; the first state is the amplifier, the second the measured output
known = {"A": [[0.7, 0.0], [free, free]], "B_u": [[0.3], [0.0]], "C_y": [[0.0, 1.0]], "D_yu": 0.0, "D_yw": 0.0}
known |= {"B_w": [[0.0], [free]], "C_z": [[1.0, 0.0]], "D_zu": 0.0}
structure = pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 4), fixed=known, offset=False)
fit = pilfr.fit(structure, record, starts=2)

print(fit)
p = fit.parameters
print(f"A = {p['A'].round(4).tolist()}, NRMSE {fit.nrmse(record):.4f}, noise {0.002 / np.std(y):.4f}")
assert p["A"][0].tolist() == [0.7, 0.0] and abs(p["A"][1, 1] - 0.9) < 0.01 and fit.nrmse(record) < 0.02
