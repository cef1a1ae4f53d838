"""
Small motions, large motions
============================

A machine with dry friction is stiff in small motions, in which nothing slips, and soft in large motions. A fitted
PI-LFR contains both linear models; the response measured at one amplitude lies between them.
"""

from importlib.resources import files

import pilfr_casadi as pilfr

data = files("pilfr_casadi") / "cli" / "demo_data" / "rig_train.csv"
train = pilfr.read_csv(data, inputs="force", outputs="x2", initial="zero", hold="zero")
fit = pilfr.fit(pilfr.PILFR(nx=4, element=pilfr.PrandtlIshlinskii(pilfr.Play, 6)), train, starts=2)
diagram = fit.plot(train, "bode")

# %%
# The first mode is slower and less damped if all operators slip.

poles = fit.plot(train, "poles")
parts = fit.linear_parts()
static = {name: abs(part.response([0.05])[0, 0, 0]) for name, part in parts.items()}
print({name: f"{value:.2e} m/N" for name, value in static.items()})
assert static["small motions"] < 0.8 * static["large motions"]
