"""One BLAS thread where fits run side by side."""

import json
import os
import subprocess
import sys

SCRIPT = """
import json
from pilfr_casadi._base import one_blas_thread

@one_blas_thread
def limited():
    import scipy.linalg  # late: with a BLAS of its own
    from threadpoolctl import threadpool_info
    return [found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"]

print(json.dumps(limited()))
"""


def test_every_blas_is_limited_to_one_thread_whenever_it_is_loaded():
    free = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, env=free)
    counts = json.loads(done.stdout)
    assert counts and set(counts) == {1}
