"""
Small motions, large motions
============================

A machine with hysteresis is stiff in small motions, where nothing slips, and soft in large ones. A fitted PI-LFR holds
both linear models; the response measured at one amplitude lies between them.
"""

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.laws import BoucWen

stage = Simulator(
    lambda x, u: dict(pos=x.vel, vel=u.force - 400 * x.pos - 3 * x.vel),
    lambda x: dict(position=x.pos),
    states=("pos", "vel"),
    inputs=("force",),
    parameters=dict(unused=Parameter(0.0, fixed=True)),
    ports=Port("mount", dict(vel=-1.0), lambda x: x.pos, lambda x: x.vel),
).with_element("mount", BoucWen().at({"k_h": 900.0, "q_0": 0.01, "s": 0.5, "n": 1.0}))

rng = np.random.default_rng(0)
force = 12 * pilfr.multisine(2000, f_max=12.0, fs=100.0, rng=rng)
blank = pilfr.Recording(force, np.zeros(2000), 0.01, "force", "position", initial="zero", hold="zero")
train = blank.with_(y=stage.simulate(blank) + 2e-5 * rng.normal(size=(2000, 1)))

fit = pilfr.fit(pilfr.PILFR(nx=3, element=pilfr.PrandtlIshlinskii(pilfr.Play, 8)), train, starts=2)
print(fit)
diagram = fit.plot(train, "bode")

# %%
poles = fit.plot(train, "poles")
parts = fit.linear_parts()
static = [float(np.abs(part.response(np.array([0.1]))[0, 0, 0])) for part in parts.values()]
print(f"static compliance, small and large motions: {static[0]:.2e}, {static[1]:.2e} m/N")
assert static[0] < 0.8 * static[1]
