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


def test_run_file_of_the_readme(tmp_path):
    copy_demo_data(tmp_path)
    (text,) = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    (tmp_path / "rig.toml").write_text(text)
    code = "import sys; from pilfr_casadi.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "run", "rig.toml"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    written = {path.name for path in (tmp_path / "rig-run").iterdir()}
    assert {"manifest.json", "results.csv", "model.json", "report.html", "jobs"} <= written


def test_snippets_of_the_readme(tmp_path):
    copy_demo_data(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert snippets
    script = tmp_path / "readme.py"
    script.write_text("\n".join(snippets))
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
