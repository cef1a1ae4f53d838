"""
A first look at a recording
===========================

Plot every channel over time and over frequency. Here the input ends at 6 Hz, and above about 15 Hz the output is noise.
"""

from importlib.resources import files

import pilfr_casadi as pilfr

data = files("pilfr_casadi") / "cli" / "demo_data"
recording = pilfr.read_csv(data / "rig_train.csv", inputs="force", outputs="x2", units={"force": "N", "x2": "m"})
whole = recording.plot()

# %%
# Cut out a part, remove the noise above 15 Hz and halve the rate. The same filter acts on both channels.

quiet = recording.cut(2.0, 8.0).filter(15.0).resample(0.02)
part = quiet.plot()
print(quiet)
assert len(quiet) == 300 and quiet.begins == "estimate"
