"""Jobs of any kind side by side: code of the user's own script, failures, and lost processes."""

import subprocess
import sys

SCRIPT = """
import os
from dataclasses import dataclass
from pilfr_casadi.studies import Effort, Outcome, run_side_by_side

@dataclass(frozen=True)
class Job:
    id: str
    key: str = ""
    parameters = {}

def work(job):
    if job.id == "bad":
        raise ValueError("no")
    if job.id == "dies":
        os._exit(3)
    return Outcome({"status": "DONE", "sentence": f"{job.id} in another process: {os.getpid() != PARENT}"})

PARENT = os.getpid()

if __name__ == "__main__":
    jobs = [Job(name) for name in ("good", "bad", "dies")]
    found = [pair for batch in run_side_by_side(work, jobs, Effort(2, retries=1)) for pair in batch]
    for job, outcome in sorted(found, key=lambda pair: pair[0].id):
        print(job.id, outcome.entry["status"], outcome.entry["sentence"])
"""


def test_functions_of_the_script_that_runs_are_sent(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    bad, dies, good = done.stdout.splitlines()
    assert bad == "bad FAILED Failed: ValueError: no"
    assert dies.startswith("dies LOST Failed: its worker was lost in every trial")
    assert good == "good DONE good in another process: True"
