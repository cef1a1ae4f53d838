"""Identify a rig with a hysteretic spring from one recording, and judge the model on two others."""

import pilfr_casadi as pilfr
from pilfr_casadi.cli.demo import demo_recordings

records = demo_recordings()  # or pilfr.read_csv("train.csv", inputs="u", outputs="x2", initial="zero")

linear = pilfr.fit(pilfr.PILFR(nx=5), records["train"])
fit = pilfr.fit(pilfr.PILFR(nx=5, element=pilfr.PrandtlIshlinskii(pilfr.Play, 10)), records["train"], starts=3)

print(fit)
for name in ("multisine", "sweep"):
    print(f"{name:<10} linear {linear.nrmse(records[name]):.4f}   PI-LFR {fit.nrmse(records[name]):.4f}")

assert fit.nrmse(records["multisine"]) < 0.1 * linear.nrmse(records["multisine"])
