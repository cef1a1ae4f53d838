"""The package's face: its names, its help, and the types that a user's script sees."""

import pydoc
import subprocess
import sys
from pathlib import Path

import pilfr_casadi as pilfr

ROOT = Path(__file__).parent.parent
SCRIPT = """\
import pilfr_casadi as pilfr

train = pilfr.read_csv("train.csv", inputs="u", outputs="y")
fit = pilfr.fit(pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 3)), train)
reveal_type(fit)
reveal_type(fit.nrmse(train))
reveal_type(pilfr.diagnose)
reveal_type(pilfr.laws.CoulombFriction)
pilfr.no_such_name
"""


def test_about_forty_names():
    folders = {p.name for p in Path(pilfr.__file__).parent.iterdir() if p.is_dir()}
    assert 35 <= len(set(pilfr.__all__) - folders) <= 45


def test_help_begins_with_what_a_user_needs():
    said = pydoc.render_doc(pilfr, renderer=pydoc.plaintext)[:2500]
    for name in ("Simulator", "diagnose", "PILFR", "fit", "read_csv", "pilfr.laws"):
        assert name in said


def test_old_spellings_still_work():
    assert pilfr.to_plays is pilfr.models.to_plays
    assert pilfr.standard_errors is pilfr.identify.standard_errors
    assert "to_plays" not in pilfr.__all__


def test_a_verb_stays_a_function_when_its_folder_is_imported():
    code = "import pilfr_casadi.diagnose.result, pilfr_casadi as pilfr; assert callable(pilfr.diagnose)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_a_users_script_sees_types(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "mypy", str(tmp_path / "script.py")]  # finds what `make lint` has just read
    said = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False).stdout
    revealed = [line.split('"')[1] for line in said.splitlines() if "Revealed type" in line]
    assert len(revealed) == 4, said
    assert revealed[0].endswith(".Fit") and "Any" not in revealed[1]
    assert revealed[2].endswith("Diagnosis") and "CoulombFriction" in revealed[3]
    assert 'has no attribute "no_such_name"' in said
