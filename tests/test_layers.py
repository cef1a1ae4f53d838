"""Imports only go down: the layers of the package, held by parsing every file."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "pilfr_casadi"

# A file imports from its own layer and from those with a lower number. A new file takes its place here.
LAYERS = {
    0: (
        "checks",
        "recording",
        "signals",
        "multisines",
        "arrays",
        "expressions",
        "metrics",
        "parameters",
        "readers",
        "request",
        "csv_table",
        "array_files",
        "timebase",
        "interrupts",
        "magnitude",
        "periods",
        "stack",
        "threads",
        "progress",
        "hand",
    ),
    1: ("operators", "elements", "envelope", "products", "combined", "laws"),
    2: ("model", "simulator", "integration", "substeps"),
    3: (
        "simulate",
        "sensitivities",
        "observer",
        "generated",
        "compiled",
        "bla",
        "local_polynomial",
        "lti",
        "order_selection",
        "subspace",
        "subspace_problem",
        "subspace_frequency",
        "subspace_time",
    ),
    4: (
        "lfr",
        "conversion",
        "orbit",
        "residual_noise",
        "gauge",
        "normal_form",
        "placement",
        "start",
        "envelopes",
        "modal",
        "problem",
        "layout",
        "penalties",
        "slopes",
        "nlp",
        "constraints",
        "known",
        "stability",
        "baselines",
    ),
    5: (
        "gauss_newton",
        "quadratic_program",
        "ipopt",
        "ipopt_settings",
        "callback",
        "damping",
        "scaling",
        "solution",
        "exactness",
        "costless",
        "feasible",
        "exact_penalty",
        "told",
        "tightening",
        "lifted",
        "schur",
        "limits",
    ),
    6: (
        "asked",
        "fit",
        "ways",
        "fitted",
        "job",
        "outcome",
        "open_memory",
        "reached_gain",
        "linear_model",
        "lagged_fit",
        "early_stopping",
        "repetition",
        "penalty",
        "thinning",
        "sparse",
        "structures",
        "known_blocks",
        "multistart",
        "search",
        "export",
        "feedback",
        "plots",
        "accepted",
        "load_simulator",
        "response_bound",
    ),
    7: ("diagnose", "report"),  # a diagnosis writes its own report
    8: ("cli", "commands", "runs", "diagnose_command", "export_command", "simulate_command", "option_values", "demo"),
}
LAYER_OF = {name: layer for layer, names in LAYERS.items() for name in names}
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py" and p.parent.name != "demo_data")


def module_of(path: Path) -> str:
    """The file's or sub-package's name right below the package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> list[tuple[int, str, list[str]]]:
    """(line, absolute module, names) of every import in a file, wherever it stands."""
    package = ("pilfr_casadi", *path.relative_to(PACKAGE).parts[:-1])
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            found.append((node.lineno, module, [alias.name for alias in node.names]))
    return found


def targets(module: str, names: list[str]) -> list[str]:
    """Which files right below the package an import reaches."""
    parts = module.split(".")
    if parts[0] != "pilfr_casadi":
        return []
    return [parts[1]] if len(parts) > 1 else [name for name in names if name != "__version__"]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down(path):
    own = module_of(path)
    assert own in LAYER_OF, f"{path.name} has no layer yet: put {own!r} into LAYERS in tests/test_layers.py"
    for line, module, names in imported(path):
        place = f"{path.name}:{line}"
        assert "*" not in names, f"{place}: star import"
        top = module.split(".")[0]
        assert top not in ("problems", "tests", "examples"), f"{place}: the package must not know {top}"
        if top in ("matplotlib", "mpl_toolkits"):
            assert own == "plots", f"{place}: matplotlib is imported in plots.py only"
        assert module != "pilfr_casadi" or names, f"{place}: import from the file that defines the name"
        for target in targets(module, names):
            assert target in LAYER_OF, f"{place}: {target!r} has no layer; put it into LAYERS in tests/test_layers.py"
            assert LAYER_OF[target] <= LAYER_OF[own], (
                f"{place}: {own} (layer {LAYER_OF[own]}) imports {target} (layer {LAYER_OF[target]}) from above"
            )


def test_every_public_name_has_its_file():
    import pilfr_casadi

    for name, submodule in pilfr_casadi._EXPORTS.items():
        assert submodule in LAYER_OF, f"{name} is exported from {submodule!r}, which has no layer"
        assert (PACKAGE / f"{submodule}.py").exists() or (PACKAGE / submodule / "__init__.py").exists()


def test_the_rules_can_fail(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path)
    bad = {
        "recording.py": "from .model import Model",
        "model.py": "def f():\n    import matplotlib.pyplot",
        "cli.py": "from numpy import *",
        "fit.py": "from problems.masing import truth",
        "report.py": "from pilfr_casadi.unheard import x",
        "newcomer.py": "import numpy",
    }
    for name, text in bad.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(AssertionError, match=name.removesuffix(".py")):
            test_imports_go_down(tmp_path / name)
    (tmp_path / "simulator.py").write_text("from . import recording\nfrom .model import Model\nimport casadi as ca")
    test_imports_go_down(tmp_path / "simulator.py")
