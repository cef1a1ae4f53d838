"""
Compensate a hysteresis
=======================

Identify a piezo stage and invert its model: the resulting voltages lead it along a wanted path, without a sensor.
"""

import numpy as np

import pilfr_casadi as pilfr

r = np.linspace(0.3, 60, 200)
w = 0.35 * np.exp(-r / 20) / np.sum(np.exp(-r / 20))


def stage(voltage):
    """200 Maxwell elements on the voltage, then a lag; position in µm."""
    q, y, out = np.zeros(200), 0.0, np.zeros(len(voltage))
    for k, u in enumerate(voltage):
        out[k] = y
        q = np.clip(q, u - r, u + r)
        y += 0.4 * (0.12 * (u - w @ (u - q)) - y)
    return out


rng = np.random.default_rng(0)
voltage = 50 + 16 * pilfr.multisine(3000, f_max=100.0, fs=1000.0, rng=rng)
voltage = np.clip(voltage * np.minimum(1, np.arange(3000) / 200), 0, 100)
measured = stage(voltage) + 0.001 * rng.normal(size=3000)
train = pilfr.Recording(voltage, measured, 1e-3, "voltage", "position", initial="zero", name="stage")

t = np.arange(600) * 1e-3
path = np.minimum(1, t / 0.1) * (5 + 2 * np.sin(2 * np.pi * 10 * t))
reached = {}
for name, element in (("linear", None), ("hysteresis", pilfr.PrandtlIshlinskii(pilfr.Play, 10))):
    fit = pilfr.fit(pilfr.PILFR(1, element), train, starts=2)
    reached[name] = stage(pilfr.control.feedforward(fit, train, limits=(0.0, 100.0)).inputs(path).ravel())

wanted = pilfr.Recording(path, path, 1e-3, "path", "position", name="path", units={"position": "µm"})
lines = [(f"inverse of the {name} model", y[:, None]) for name, y in reached.items()]
figure = pilfr.plots.plot_comparison(wanted, lines)
off = {name: float(np.std((y - path)[150:])) for name, y in reached.items()}
print(off)
assert off["hysteresis"] < 0.3 * off["linear"]
