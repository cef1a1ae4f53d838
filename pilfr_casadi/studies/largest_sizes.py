"""The largest sizes that a run file or the command line may ask for: what is larger never ends, or fills the memory.

They are far above every model that makes sense, so that nobody meets one but by a slip of the finger. One home for both
doors: the schema of run files and the options of `pilfr fit`.
"""

from __future__ import annotations

LARGEST_SIZE = {
    "nx": 1_000,  # states: A alone has 1e6 parameters, and the Gauss-Newton matrix 1e12 entries
    "operators": 10_000,  # a channel: the Jacobian of the paper's 6144 samples has 1 GB then
    "channels": 100,  # of the element: each has all its operators
    "neurons": 1_000,  # of an envelope
    "hidden": 10_000,  # neurons of a network: as operators
    "lags": 10_000,  # samples: a recording must be longer, as the fit says
    "input_lags": 10_000,
    "starts": 1_000_000,  # 12 days at a second each
    "seed": 2**63 - 1,  # the largest integer of 64 bits
    "max_iterations": 1_000_000,
    "folds": 10_000,
    "retries": 1_000,
    "workers": 1_024,  # processes: each takes 100 MB and more
}
MOST_JOBS = 100_000  # of a run: the manifest names each, about 300 bytes a job, and is written after every one
MOST_SAMPLES = 10**9  # of a period, or left out: 8 GB a channel
