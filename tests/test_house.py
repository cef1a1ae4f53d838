"""The rule of imports: a folder imports only folders before it, and nothing imports in a circle."""

import ast
import importlib
import re
from pathlib import Path

import pytest

import pilfr_casadi
from pilfr_casadi._base import later

PACKAGE = Path(pilfr_casadi.__file__).parent
ORDER = [
    "_base",
    "data",
    "models",
    "laws",
    "simulators",
    "engine",
    "linear",
    "optimise",
    "export",
    "plots",
    "identify",
    "diagnose",
    "control",
    "report",
    "studies",
    "cli",
]
INSIDE = {"diagnose": ["fits", "faults", "search", ""]}  # folders of a folder, in the same order; "" for its own files


def files():
    """Every file of the package by its path without suffix, faces by the name of their folder."""
    found = {p.relative_to(PACKAGE).with_suffix("").as_posix(): p for p in sorted(PACKAGE.rglob("*.py"))}
    return {name.removesuffix("/__init__"): path for name, path in found.items() if "demo_data" not in name}


FILES = files()


def imported(name):
    """(line, file of the package) for every import in a file, lazy and typing ones included."""
    path = FILES[name]
    package = list(path.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert not any(a.name.startswith("pilfr_casadi") for a in node.names), f"{name}:{node.lineno}"
        if not isinstance(node, ast.ImportFrom):
            continue
        assert node.level or not (node.module or "").startswith("pilfr_casadi"), f"{name}:{node.lineno}"
        if not node.level:
            continue
        base = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
        module = "/".join(base) or "__init__"
        for alias in node.names:
            inside = "/".join([*base, alias.name])
            yield node.lineno, inside if inside in FILES else module


def test_the_folders_are_those_of_the_order():
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"} == set(ORDER)
    assert {p.name for p in PACKAGE.glob("*.py")} == {"__init__.py", "__main__.py"}


@pytest.mark.parametrize("folder", ORDER)
def test_a_folder_imports_only_folders_before_it(folder):
    wrong = []
    for name in FILES:
        if name.partition("/")[0] != folder:
            continue
        for line, target in imported(name):
            there = target.partition("/")[0]
            if there not in ORDER or ORDER.index(there) > ORDER.index(folder):
                wrong.append(f"{name}.py:{line} imports {target}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("folder", INSIDE)
def test_a_folder_inside_another_imports_only_those_before_it(folder):
    order, wrong = INSIDE[folder], []
    inside = {name: name.split("/")[1:-1] for name in FILES if name.startswith(f"{folder}/")}
    where = {name: parts[0] if parts else "" for name, parts in inside.items()}
    where |= {f"{folder}/{sub}": sub for sub in order if sub}
    assert set(where.values()) == set(order)
    for name, own in where.items():
        for line, target in imported(name):
            if order.index(where.get(target, order[0])) > order.index(own):
                wrong.append(f"{name}.py:{line} imports {target}")
    assert not wrong, "\n".join(wrong)


def test_other_folders_are_reached_through_their_faces():
    wrong = [
        f"{name}.py:{line} imports {target}"
        for name in FILES
        if name != "__init__"
        for line, target in imported(name)
        if "/" in target and target.partition("/")[0] != name.partition("/")[0] and target != "_base/lazy"
    ]
    assert not wrong, "\n".join(wrong)


def calls_forward():
    """(folder, verb, statements of the method) for every method that calls `later`."""
    texts = {name: path.read_text(encoding="utf-8") for name, path in FILES.items()}
    for name in (name for name, text in texts.items() if "later(" in text):
        for node in ast.walk(ast.parse(texts[name])):
            if isinstance(node, ast.FunctionDef):
                for call in ast.walk(node):
                    if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "later":
                        body = node.body[1:] if ast.get_docstring(node) else node.body
                        yield name.partition("/")[0], ast.literal_eval(call.args[0]), body


def test_what_reaches_forward_is_a_verb_in_one_line():
    found = list(calls_forward())
    assert found
    for folder, verb, body in found:
        there, name = verb.split(".")
        assert ORDER.index(folder) <= ORDER.index(there), verb
        assert len(body) == 1 and isinstance(body[0], ast.Return), verb
        assert later(verb) is getattr(importlib.import_module(f"pilfr_casadi.{there}"), name)


def circles(graph):
    """Strongly connected groups of more than one file (Tarjan 1972)."""
    index, low, stack, found = {}, {}, [], []

    def visit(v):
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in graph[v]:
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in stack:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            group = [stack.pop()]
            while group[-1] != v:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for v in graph:
        if v not in index:
            visit(v)
    return found


def test_nothing_imports_in_a_circle():
    graph = {name: {t for _, t in imported(name) if t != name} for name in FILES}
    found = circles(graph)
    assert not found, "\n".join(" - ".join(c) for c in found)


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_matplotlib_is_imported_by_plots_alone():
    for name, path in FILES.items():
        if not name.startswith("plots"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not any(m.split(".")[0] in ("matplotlib", "problems") for m in modules), f"{name}:{node.lineno}"


@pytest.mark.parametrize("folder", ["", *ORDER])
def test_faces_have_what_they_list(folder):
    module = __import__(f"pilfr_casadi.{folder}".strip("."), fromlist=["__all__"])
    assert module.__doc__
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = module.no_such_name


@pytest.mark.parametrize("folder", ORDER)
def test_files_that_a_face_names_exist(folder):
    """A word in backticks in a face's docstring is a file of the folder, or a public name."""
    module = __import__(f"pilfr_casadi.{folder}", fromlist=["__all__"])
    known = {"pilfr", *ORDER, *(name.rpartition("/")[2] for name in FILES if name.startswith(f"{folder}/"))}
    words = re.findall(r"`([a-z][a-z_]{2,})(?:\.py)?`", module.__doc__)
    wrong = [w for w in words if w not in known and w not in module.__all__ and not hasattr(pilfr_casadi, w)]
    assert not wrong, f"{folder}/__init__.py: {', '.join(wrong)}"
