"""Combine plays at the input with products and an envelope in the feedback: a resonance that falls with the level."""

import numpy as np

import pilfr_casadi as pilfr

PERIOD = 1000


def machine(u):
    """Simulate a resonance that softens with amplitude, behind an actuator with play: two periods in steady state."""
    x, v, q, out = 0.0, 0.0, 0.0, []
    for force in np.tile(u, 6):
        q = max(force - 0.05, min(force + 0.05, q))  # the actuator's play
        v += 0.1 * (0.8 * force + 0.2 * q - 0.1 * v - (1.0 - 0.1 * np.tanh(x * x)) * x)
        x += 0.1 * v
        out.append(x)
    return np.array(out[-2 * PERIOD :])


rng = np.random.default_rng(0)
records = []
for level in (0.1, 0.25, 0.4, 0.3):
    u = pilfr.multisine(PERIOD, f_max=0.5, fs=10.0, rng=rng)
    u = level * u / np.std(u)
    y = machine(u) + 0.002 * rng.normal(size=2 * PERIOD)
    records.append(pilfr.Recording(np.tile(u, 2), y, 0.1, period=PERIOD, initial="periodic", name=f"level {level}"))
*train, test = records

linear = pilfr.fit(pilfr.PILFR(2, offset=False), train)
v = linear.parameters
element = pilfr.Combined(
    [
        pilfr.Part("envelope", pilfr.Envelope(1), reads=(0,)),
        pilfr.Part("products", pilfr.Products(1, (2, 3)), reads=(0,)),
        pilfr.Part("input", pilfr.PrandtlIshlinskii(pilfr.Play, 2), reads=(1,), writes=(0,)),
    ]
)
idle = np.array([[np.nan, 0.0]])  # channel 1 is the input and has no direct effect
fixed = {"C_z": [[np.nan, np.nan], [0, 0]], "D_zu": [[0.0], [1.0]], "B_w": np.vstack([idle, idle]), "D_yw": idle}
fixed |= {"envelope_reach": 10.0, "products_reach": 10.0}
start = {name: v[name] for name in ("A", "B_u", "C_y", "D_yu")}
start |= {"B_w": np.hstack([0.1 * v["B_u"], 0 * v["B_u"]]), "C_z": np.vstack([v["C_y"], 0 * v["C_y"]])}
start |= {"envelope_rate": 0.02, "input_r": [[0.03, 0.1]], "input_w": [[0.1, 0.1]]}
weights = pilfr.noise_weights(train)  # relative to the size of each level, and smaller where periods differ
found = pilfr.fit(pilfr.PILFR(2, element, fixed, offset=False), train, start=start, weights=weights)

print(f"linear {linear.nrmse(test):.4f}, combined {found.nrmse(test):.4f} of the test recording's deviation")
bound = pilfr.response_bound(found, 2.0)
print(bound)
assert found.nrmse(test) < 0.2 * linear.nrmse(test)
assert bound.guaranteed
