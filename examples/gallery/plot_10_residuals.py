"""
Is anything left in the residual?
=================================

A sensor is 30 ms late. The residual of the refitted simulator still depends on the input; with the delay in the
simulator it does not.
"""

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Simulator
from pilfr_casadi.laws import Delay

stage = Simulator(
    lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos - p.d * x.vel),
    lambda x: dict(position=x.pos),
    states=("pos", "vel"),
    inputs=("force",),
    parameters=dict(k=Parameter(100.0, bounds=(20, 500)), d=Parameter(2.0, bounds=(0.1, 20))),
)
late = stage.with_element("sensor:position", Delay().at({"T": 0.03}))

rng = np.random.default_rng(0)
force = np.repeat(rng.normal(size=500), 4)
blank = pilfr.Recording(force, np.zeros(2000), 0.01, "force", "position", initial="zero", hold="zero")
y = late.simulate(blank)
train = blank.with_(y=y + 0.02 * np.std(y) * rng.normal(size=y.shape))

models = {"no delay": pilfr.fit(stage, train), "with delay": pilfr.fit(late, train)}
compared = pilfr.compare(train, models)
print(compared)
tests = compared.plot("residuals")
assert compared.nrmse["with delay"] < 0.5 * compared.nrmse["no delay"]
