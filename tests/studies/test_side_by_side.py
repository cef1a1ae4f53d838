"""Jobs of any kind side by side: code of the user's own script, failures, and lost processes."""

import subprocess
import sys

SCRIPT = """
import os
import time
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
    if job.id == "slow":
        time.sleep(2)
    return Outcome({"status": "DONE", "sentence": f"{job.id} in another process: {os.getpid() != PARENT}"})

PARENT = os.getpid()

if __name__ == "__main__":
    jobs = [Job(name) for name in NAMES]
    batches = list(run_side_by_side(work, jobs, Effort(2, retries=1)))
    print("an empty batch:", [] in batches)
    found = [pair for batch in batches for pair in batch]
    for job, outcome in sorted(found, key=lambda pair: pair[0].id):
        print(job.id, outcome.entry["status"], outcome.entry["sentence"])
"""


def execute(folder, *names):
    """Execute the script with these jobs; return its lines."""
    script = folder / "script.py"
    script.write_text(SCRIPT.replace("NAMES", repr(names)))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    return done.stdout.splitlines()


def test_functions_of_the_script_that_runs_are_sent(tmp_path):
    bad, dies, good = execute(tmp_path, "good", "bad", "dies")[1:]
    assert bad == "bad FAILED Failed: ValueError: no"
    assert dies.startswith("dies LOST Failed: its worker was lost in every trial")
    assert good == "good DONE good in another process: True"


def test_while_a_job_is_at_work_the_caller_may_report_the_time(tmp_path):
    lines = execute(tmp_path, "slow")
    assert lines == ["an empty batch: True", "slow DONE slow in another process: True"]
