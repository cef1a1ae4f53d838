"""Every example runs and ends in an assertion; every Python snippet of the README runs."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path, tmp_path):
    source = path.read_text()
    assert source.count("\n") <= 60
    assert isinstance(ast.parse(source).body[-1], ast.Assert)
    done = subprocess.run([sys.executable, path], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def copy_demo_data(folder):
    for path in (ROOT / "pilfr_casadi" / "demo_data").iterdir():
        if path.is_file():
            shutil.copy(path, folder)


RUN_FILES = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.S)


@pytest.mark.parametrize(
    "command, text, files",
    [
        ("run", RUN_FILES[0], {"report.html"}),
        ("campaign", RUN_FILES[1].replace("count = 100", "count = 1"), {"summary.csv", "spread.png", "report.html"}),
    ],
)
def test_run_files_of_the_readme(tmp_path, command, text, files):
    copy_demo_data(tmp_path)
    (tmp_path / "rig.toml").write_text(text)
    code = "import sys; from pilfr_casadi.cli import main; sys.exit(main())"
    arguments = [sys.executable, "-c", code, command, "rig.toml", "--workers", "2"]
    done = subprocess.run(arguments, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    written = {path.name for path in (tmp_path / f"rig-{command}").iterdir()}
    assert {"manifest.json", "results.csv", "model.json", "jobs", *files} <= written
    assert len(RUN_FILES) == 2 and "count = 100" not in text


def test_snippets_of_the_readme(tmp_path):
    copy_demo_data(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert snippets
    script = tmp_path / "readme.py"
    script.write_text("\n".join(snippets))
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
