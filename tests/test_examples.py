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
    for path in (ROOT / "pilfr_casadi" / "cli" / "demo_data").iterdir():
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


def test_the_run_file_with_every_key_has_every_key_and_runs(tmp_path, monkeypatch):
    from pilfr_casadi.studies import read_run
    from pilfr_casadi.studies.tables import Table

    copy_demo_data(tmp_path)
    path = tmp_path / "every_key.toml"
    tables = []
    begin = Table.__init__
    monkeypatch.setattr(Table, "__init__", lambda self, *given: (begin(self, *given), tables.append(self))[0])
    read_run(path)
    text = path.read_text()
    assert len(tables) > 8 and max(map(len, text.splitlines())) <= 120
    for table in tables:
        if table.name in ("data.columns", "seeds", "grid"):
            continue
        part = text.split(f"[{table.name}]")[1].partition("\n[")[0] if table.name else text.partition("\n[")[0]
        for key in table.known:
            assert re.search(rf"^(# )?{key} = |^(# )?\[{key}\]", text if not table.name else part, re.M), key
    code = "import sys; from pilfr_casadi.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "run", path.name], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert done.returncode == 0 and (tmp_path / "every_key-run" / "report.html").exists(), done.stderr


@pytest.mark.parametrize("command", ["run", "campaign"])
def test_the_help_names_the_run_file_with_every_key(capsys, command):
    from pilfr_casadi.cli.app import main

    with pytest.raises(SystemExit):
        main([command, "--help"])
    shown = "".join(capsys.readouterr().out.partition("Every key")[2].partition(":")[2].split())
    assert Path(shown).samefile(ROOT / "pilfr_casadi" / "cli" / "demo_data" / "every_key.toml")


def test_snippets_of_the_readme(tmp_path):
    copy_demo_data(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert snippets
    script = tmp_path / "readme.py"
    script.write_text("\n".join(snippets))
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = done.stdout.partition("strength  operators")[2].partition("the strongest")[0]
    operators = [int(row.split()[1]) for row in table.splitlines()[1:]]
    assert operators[0] == 10 and operators[-1] < 9  # the path shows what it is for
