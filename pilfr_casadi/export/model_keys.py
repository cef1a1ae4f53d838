"""Which keys and plain entries a model file has: what `save` never writes is not silently passed over."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from .saving import HISTORY

if TYPE_CHECKING:
    from .checked_json import ModelFile

EACH = "*"  # every entry of a list or a table
SOLVE = ("iterations", "cost", "violation", "seconds")
ELEMENT = ("kind", "operator", "n", "channels", "rounded", "neurons", "expressions", "degrees", "hidden")
KEYS: dict[tuple[str, ...], tuple[str, ...]] = {
    (): ("format", "version", "written_by", "model", "structure", "parameters", "linear", "initial_states", "training"),
    ("written_by",): ("pilfr_casadi", "casadi"),
    ("model",): ("dt", "inputs", "outputs", "states", "memory"),
    ("model", "inputs", EACH): ("name", "unit"),
    ("model", "outputs", EACH): ("name", "unit"),
    ("structure",): ("nx", "offset", "element", "fixed", "bounds", "priors"),
    ("structure", "element"): (*ELEMENT, "parts"),
    ("structure", "element", "parts", EACH): ("name", "element", "reads", "writes"),
    ("structure", "element", "parts", EACH, "element"): ELEMENT,
    ("parameters", EACH): ("value", "std", "unit"),
    ("training",): (
        *("status", "sentence", "message", "nrmse", "linear_nrmse", "seconds", "active", "limits", "solve"),
        *("variables", "multipliers", "history", "starts", "noise", "weights"),
    ),
    ("training", "limits", EACH): ("name", "kind", "value", "lower", "upper", "multiplier", "active", "met"),
    ("training", "solve"): SOLVE,
    ("training", "history"): HISTORY,
    ("training", "starts", EACH): ("seed", "error", "status", "note", "drawn", *SOLVE),
}
TEXTS = (  # that are written for people and for other programs; nothing is built from them
    ("written_by", EACH),
    ("model", "states", EACH),
    ("parameters", EACH, "unit"),
    ("training", "active", EACH),
    ("training", "sentence"),
)


def check_keys(file: ModelFile) -> None:
    """Refuse keys that no model file has, and texts that are none.

    Raises
    ------
    InputError
        That names the key and its table.
    """
    for path, known in KEYS.items():
        for where, value in _at(file.content, path):
            unknown = sorted(set(value) - set(known)) if isinstance(value, dict) else []
            if unknown:
                file.damaged(f"it has the unknown key {unknown[0][:40]!r}{where and f' in {where}'}")
    for path in TEXTS:
        for where, value in _at(file.content, path):
            if not isinstance(value, str):
                file.damaged(f"{where} is not a text")


def _at(value: Any, path: tuple[str, ...], where: str = "") -> Iterator[tuple[str, Any]]:
    """What is found at a path, with its place in words; nothing where the tables on the way are none."""
    if not path:
        yield where, value
    elif path[0] == EACH and isinstance(value, list | dict):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _at(item, path[1:], f"{where}.{str(key)[:40]}")
    elif isinstance(value, dict) and path[0] in value:
        yield from _at(value[path[0]], path[1:], f"{where}.{path[0]}" if where else path[0])
