"""Faults of recordings, each a small object that corrects it and says so; they are found before laws are searched.

`gates` is what a finding is, and the one rule that accepts it. The faults: `channels` (sign, unit or gain, exchange),
`offsets` (of channels, and wrong initial states), `samples` (glitches, stale and clipped samples, unsettled periods),
`tones`, `timing` (shift, clock) and `lost_samples`. `preparation._Checks.run` calls those that need a refit; to add
one, call it there. `pipeline` calls `tones` and looks for clipped inputs. `check` calls its own few (`blind_spots`).
"""
