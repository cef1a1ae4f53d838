"""Every example ends in an assertion, every snippet of the README and of docs/ runs as printed, and the site builds."""

import ast
import importlib
import inspect
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import pilfr_casadi as pilfr
from pilfr_casadi.cli import main

ROOT = Path(__file__).parent.parent
DEMO = ROOT / "pilfr_casadi" / "cli" / "demo_data"
EXAMPLES = sorted((ROOT / "examples").rglob("*.py"))
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
PAGES = sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "docs").rglob("*.md"))
QUICK = {  # pages of about a second; all others are slow
    f"docs/howto/{name}.md"
    for name in (
        "fixed_parameters",
        "friction",
        "hold",
        "known_physics",
        "look",
        "numpy",
        "other_domains",
        "own_law",
        "ports",
        "rates",
        "unknown_start",
        "varying_strength",
    )
}
SAID = {
    "docs/start/axis.md": "leaves out Coulomb friction at guide.",
    "docs/start/tank.md": "leaves out dead zone at actuator:pump.",
    "docs/howto/closed_loop.md": "leaves out Coulomb friction at guide.",
    "docs/howto/mujoco.md": "leaves out Coulomb friction at shoulder.",
    "docs/howto/no_input.md": "leaves out Coulomb friction at bearing.",
    "docs/howto/delay.md": "leaves out delay at sensor:x2 and Coulomb friction at ground-m2.",
    "docs/diagnose.md": "leaves out Coulomb friction at ground-m2.",
    "docs/howto/ports.md": "['equation:vel', 'actuator:force', 'sensor:position']",
}
WRITTEN = {
    "docs/diagnose.md": {"report/report.html", "diagnosis/diagnosis.json"},
    "docs/identify.md": {"rig.json", "fit-report/report.html", "rig/model.json", "rig/simulated.csv"},
    "docs/howto/export.md": {"c/rig.c", "c/rig.h", "rig.casadi", "small/model.casadi", "small/c/small.c"},
    "docs/howto/fmu.md": {"plant.fmu", "tiny/plant.fmu"},
    "docs/howto/table.md": {"from-table/diagnosis.json"},
}
LONG = {
    "combined_elements",
    "known_blocks",
    "ordered_thresholds",
    "mpc_piezo",
    "baselines",
    "own_law",
    "diagnose",
    "identify",
    "monotone_envelopes",
    "sparse_weights",
}  # examples of more than some seconds, as all of the gallery but its quickest
QUICK_PICTURES = {"plot_06_first_look", "plot_07_operators"}
COMMAND = "import sys; from pilfr_casadi.cli import main; sys.exit(main())"


def is_long(path):
    return path.stem in LONG or (path.parent.name == "gallery" and path.stem not in QUICK_PICTURES)


@pytest.fixture
def script(monkeypatch, capsys):
    """Run a script in a folder as `python SCRIPT` does, but in this process, and return the words that it prints.

    A process of its own takes seconds to import the package. Modules that lie in the folder are forgotten afterwards.
    """

    def run_script(path, folder):
        before = set(sys.modules)
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            runpy.run_path(str(path), run_name="__main__")
        for name in set(sys.modules) - before:
            if Path(getattr(sys.modules[name], "__file__", None) or ROOT).is_relative_to(folder):
                del sys.modules[name]
        return capsys.readouterr().out

    return run_script


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] if is_long(p) else [], id=p.stem) for p in EXAMPLES]
)
def test_example(path, tmp_path, script):
    script(path, tmp_path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_examples_are_short_and_end_in_an_assertion(path):
    source = path.read_text(encoding="utf-8")
    assert source.count("\n") <= 60
    assert isinstance(ast.parse(source).body[-1], ast.Assert)


def snippets(language, *names):
    """Code blocks of a language in the given documents, in their order."""
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in names]
    return [block for text in texts for block in re.findall(rf"```{language}\n(.*?)```", text, re.S)]


NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LONG_NOTEBOOKS = {"real_machine", "fit_to_mpc"}
# runs the code cells of a notebook in their order and shows the value of each, as a notebook does
SHOW_CELLS = """
import ast, json, sys

names = {"__name__": "__main__"}
for k, cell in enumerate(json.load(open(sys.argv[1], encoding="utf-8"))["cells"]):
    if cell["cell_type"] == "code":
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"cell {k}", "exec"), names)
        if last is not None:
            shown = eval(compile(ast.Expression(last.value), f"cell {k}", "eval"), names)
            for method in ("_repr_html_", "_repr_png_"):
                print(k, method, len(getattr(shown, method)() or "") if hasattr(shown, method) else 0)
"""


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=[pytest.mark.slow] if p.stem in LONG_NOTEBOOKS else [], id=p.stem) for p in NOTEBOOKS],
)
def test_notebook(path, tmp_path):
    if path.stem == "real_machine" and not (Path(os.environ.get("PILFR_DATA", "")) / "dfki_pendulum").is_dir():
        pytest.skip("the recordings of the pendulum are not here; PILFR_DATA names the folder above dfki_pendulum")
    done = subprocess.run(
        [sys.executable, "-c", SHOW_CELLS, path],
        cwd=tmp_path,
        env={**ENVIRONMENT, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"_repr_html_ [1-9]", done.stdout) and re.search(r"_repr_png_ [1-9]", done.stdout)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_small_and_hold_no_results(path):
    content = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    assert len(code) >= 5 and path.stat().st_size < 8000
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
    assert any("assert " in "".join(cell["source"]) for cell in code)


@pytest.fixture
def folder(tmp_path):
    for path in DEMO.iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path)
    return tmp_path


def pilfr_commands(block):
    """The `pilfr` commands of a block as lists of arguments, without comments."""
    lines = [line for line in block.splitlines() if line.startswith("pilfr ")]
    return [line.partition("  #")[0].split()[1:] for line in lines]


def commands(*names):
    """The `pilfr` commands of the documents."""
    return [command for block in snippets("sh", *names) for command in pilfr_commands(block)]


def as_script(name):
    """A page as one script: its Python, and its `pilfr` commands, in their order."""
    parts = ["from pilfr_casadi.cli import main as run_command"]
    for language, block in re.findall(r"```(python|sh)\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), re.S):
        called = (f"assert run_command({command!r}) == 0" for command in pilfr_commands(block))
        parts += [block] if language == "python" else called
    return "\n".join(parts)


# run files have a test of their own
EXECUTED = [name for name in PAGES if name != "docs/studies.md" and (snippets("python", name) or commands(name))]


def run(arguments, folder):
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


@pytest.mark.parametrize("name", ["README.md", *PAGES])
def test_links_lead_somewhere(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        drawn = Path(link)
        if drawn.parent.name == "pictures":  # drawn by the build, each by the function of its name
            assert f"def {drawn.stem}(" in (ROOT / "docs/_tools/pictures.py").read_text(encoding="utf-8"), link
        else:
            assert "://" in link or (ROOT / name).parent.joinpath(link).exists(), link


@pytest.fixture
def few_laws(monkeypatch):
    """Shorten the catalogue to two laws."""
    few = (pilfr.laws.CubicStiffness, pilfr.laws.PreslidingFriction)
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", few)


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_python_of_the_readme(folder, script, request, whole):
    """With a short catalogue, and with the whole one as a reader runs it."""
    if not whole:
        request.getfixturevalue("few_laws")
    (folder / "readme.py").write_text("\n".join(snippets("python", "README.md")), encoding="utf-8")
    said = script(folder / "readme.py", folder)
    assert "friction" in said and (folder / "report" / "report.html").exists()
    assert (folder / "rig.json").exists()


@pytest.mark.usefixtures("blank_figures", "few_laws")
def test_commands_of_the_readme(folder, monkeypatch):
    """In this process and with a short catalogue: the snippet in Python searches the whole one on the same data."""
    monkeypatch.chdir(folder)
    assert commands("README.md")
    for arguments in commands("README.md"):
        assert main(arguments) == 0
    found = json.loads((folder / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))
    assert [e["law"] for e in found["effects"]] == ["coulomb_friction"]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in EXECUTED]
)
def test_snippets_of_a_page(folder, name, script):
    """Every page stands alone: it runs as one script beside the demonstration's files."""
    (folder / "page.py").write_text(as_script(name), encoding="utf-8")
    said = run(["page.py"], folder) if name not in QUICK else script(folder / "page.py", folder)
    assert SAID.get(name, "") in said
    assert all((folder / file).exists() for file in WRITTEN.get(name, ()))
    if name == "docs/howto/constraints.md":  # the path shows what it is for
        table = said.partition("strength  operators")[2].partition("the strongest")[0]
        operators = [int(row.split()[1]) for row in table.splitlines()[1:]]
        assert operators[0] == 10 and operators[-1] < 9


RUN_FILES = snippets("toml", "docs/studies.md")


@pytest.mark.slow
@pytest.mark.parametrize(
    "command, text, files",
    [
        ("run", RUN_FILES[0], {"report.html"}),
        ("campaign", RUN_FILES[1].replace("count = 100", "count = 1"), {"summary.csv", "spread.png", "report.html"}),
    ],
    ids=["run", "campaign"],
)
def test_run_files_of_the_documents(folder, command, text, files):
    assert len(RUN_FILES) == 2 and "count = 100" not in text
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    run(["-c", COMMAND, command, "rig.toml", "--workers", "2"], folder)
    written = {path.name for path in (folder / f"rig-{command}").iterdir()}
    assert {"manifest.json", "results.csv", "model.json", "jobs", *files} <= written


@pytest.mark.slow
def test_the_run_file_with_every_key_runs(folder):
    run(["-c", COMMAND, "run", "every_key.toml"], folder)
    assert (folder / "every_key-run" / "report.html").exists()


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    """Sphinx treats every warning as an error: unknown names, broken links and anchors, pages that no page lists."""
    source, built = tmp_path / "pilfr", tmp_path / "site"
    made = shutil.ignore_patterns("laws", "reference", "pictures", "gallery")  # by an earlier build
    shutil.copytree(ROOT / "docs", source / "docs", ignore=made)
    for part in ("examples", "problems"):
        shutil.copytree(ROOT / part, source / part)
    shutil.copytree(DEMO, source / DEMO.relative_to(ROOT))
    run(["-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", source / "docs", built], tmp_path)
    pages = {path.relative_to(built).as_posix() for path in built.rglob("*.html")}
    public = {name for name in pilfr.__all__ if name != "__version__" and not inspect.ismodule(getattr(pilfr, name))}
    assert {f"reference/api/pilfr_casadi.{name}.html" for name in public} <= pages
    assert {f"laws/{law.id}.html" for law in pilfr.laws.CATALOGUE} <= pages
    for page in pages:  # nothing is loaded from elsewhere
        text = (built / page).read_text(encoding="utf-8")
        assert not re.findall(r"""<(?:script|img|link|iframe)[^>]*(?:src|href)=["'](?:https?:)?//""", text), page
