"""
A linear model and one with hysteresis
======================================

The rig of Krikelis et al. (2024) has two masses and a hysteretic spring; one input and one output are recorded. Both
models are compared on a recording that was not used for fitting.
"""

from importlib.resources import files

import pilfr_casadi as pilfr

data, known = files("pilfr_casadi") / "cli" / "demo_data", {"inputs": "u", "outputs": "x2", "initial": "zero"}
train, test = pilfr.read_csv(data / "train.csv", **known), pilfr.read_csv(data / "multisine.csv", **known)
linear = pilfr.fit(pilfr.PILFR(nx=5), train)
fit = pilfr.fit(pilfr.PILFR(nx=5, element=pilfr.PrandtlIshlinskii(pilfr.Play, 10)), train, starts=2)

compared = pilfr.compare(test, {"linear": linear, "PI-LFR": fit})
print(compared)
beside = compared.plot()

# %%
# The identified loop, without its mean slope, and the weights of the plays over their thresholds.

loop = pilfr.plots.loop(fit, test, bare=True)
weights = pilfr.plots.weights(fit, test)
assert compared.nrmse["PI-LFR"] < 0.1 * compared.nrmse["linear"]
