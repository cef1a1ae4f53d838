"""What tests of run files share: files in a folder, the command in a process of its own, what is written."""

import json
import os
import subprocess
import sys
from pathlib import Path

from command_line import write_csv

import pilfr_casadi as pilfr

RUN = """
seeds = [0, 1, 2]
report = false

[data]
inputs = "u"
outputs = "y"
initial = "zero"
train = "train.csv"
validation = ["held.csv"]
test = "test.csv"

[model]
structure = "hammerstein"
nx = 1
operators = 3

[solver]
start = "plain"
starts = 1
"""
DATA = """
[data]
inputs = "u"
outputs = "y"
initial = "zero"
train = "train.csv"
test = "test.csv"
"""
CAMPAIGN = f"""
seeds = {{ first = 0, count = 4 }}
report = false
workers = 2
{DATA}
[model]
structure = "hammerstein"
nx = 1

[grid]
operators = [1, 3]

[solver]
start = "plain"
starts = 1
"""
ALONE = ("workers = 2", "workers = 1")  # a campaign in this process, without the second that each worker takes to begin
PYTHON = """
import pilfr_casadi as pilfr
run = dict(
    report=False,
    data=dict(inputs="u", outputs="y", initial="zero", train="train.csv"),
    model=pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 2)),
    solver=dict(name=pilfr.GaussNewton(tolerance=1e-4), starts=1),
    constraints=dict(own=[pilfr.Constraint(lambda p: p["A"], upper=0.79, name="pole", exact=True)]),
)
"""


def prepared(folder, text=CAMPAIGN, names=("train", "test")):
    """The folder with recordings and the run file rig.toml."""
    for seed, name in enumerate(names):
        write_csv(folder / f"{name}.csv", seed=seed, m=400)
    (folder / "rig.toml").write_text(text)
    return folder


def changed(folder, *changes, text=CAMPAIGN):
    """The run file with passages of the text replaced."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "rig.toml").write_text(text)
    return folder / "rig.toml"


def command(folder, kind, *more, run_file="rig.toml"):
    """The command in a process of its own, which hears Ctrl-C even where a shell runs the tests in the background."""
    hears = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{hears}; import sys; from pilfr_casadi.cli import main; sys.exit(main())"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(pilfr.__file__).parent.parent)}
    arguments = [sys.executable, "-c", code, kind, run_file, *more]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(arguments, cwd=folder, env=environment, **pipes)


def contents(out):
    """What is the same in every execution of a run."""
    found = {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    assert json.loads(found.pop("times.json")).keys() == {p.name for p in out.glob("jobs/*")}
    assert found.pop(".lock") == b"" and {"manifest.json", "model.json", "results.csv"} <= found.keys()
    return found
