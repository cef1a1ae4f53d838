"""Elements out of a model file; sizes are compared with the numbers that are there before anything is built."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from typing import Any

from ..models import (
    Combined,
    Element,
    Envelope,
    GeneralizedPlay,
    Part,
    Play,
    PrandtlIshlinskii,
    Products,
    StaticNetwork,
    Stop,
)
from .checked_json import ModelFile

OPERATORS = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}
PARTS = 100  # a file with more combined elements is none of ours


def element_of(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str = "") -> Element:
    """The element that a table describes; its parameters in the file are called `prefix + name`."""
    kind = str(table.get("kind"))
    build = {
        "prandtl_ishlinskii": _layer,
        "static_network": _network,
        "envelope": _envelope,
        "products": _products,
        "combined": _combined if not prefix else None,
    }.get(kind)
    if build is None:
        file.fail(f"has the element {kind[:40]!r}, which a file cannot hold; give the model as `model=`")
    return build(file, table, parameters, prefix)


def _value(file: ModelFile, parameters: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> None:
    """Refuse a parameter that is not in the file with this shape."""
    file.array(file.table(dict(parameters), name).get("value"), shape, f"parameter {name!r}")


def _layer(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str) -> PrandtlIshlinskii:
    name = file.text(table, "operator")
    if name not in OPERATORS:
        file.fail(f"has the unknown operator {name[:40]!r}; known are {', '.join(OPERATORS)}")
    n, channels = file.count(table, "n"), file.count(table, "channels")
    for key in ("w", "r"):
        _value(file, parameters, prefix + key, (channels, n))
    operator: Any = OPERATORS[name]()
    if name == "generalized_play":
        if file.rows(table, "expressions"):
            file.fail(
                "has envelopes that are expressions of your own, which a file cannot hold; give the model as `model=`"
            )
        neurons = file.count(table, "neurons")
        for key in ("a", "b", "d"):
            _value(file, parameters, f"{prefix}gamma_l_{key}", (channels, neurons))
        operator = file.build(GeneralizedPlay, neurons)
    return file.build(PrandtlIshlinskii, operator, n, channels, file.entry(table, "rounded", bool, "true or false"))


def _network(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str) -> StaticNetwork:
    hidden, channels = file.count(table, "hidden"), file.count(table, "channels")
    for key in ("gain", "slope", "bias"):
        _value(file, parameters, prefix + key, (channels, hidden))
    return file.build(StaticNetwork, hidden, channels)


def _envelope(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str) -> Envelope:
    channels = file.count(table, "channels")
    _value(file, parameters, f"{prefix}knee", (channels,))
    return file.build(Envelope, channels)


def _products(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str) -> Products:
    channels = file.count(table, "channels")
    degrees = tuple(file.count({"degree": d}, "degree") for d in file.rows(table, "degrees"))
    _value(file, parameters, f"{prefix}reach", (channels,))
    terms = sum(comb(channels + d - 1, d) for d in set(degrees) if d <= PARTS)
    _value(file, parameters, f"{prefix}gain", (channels, terms))
    return file.build(Products, channels, degrees)


def _combined(file: ModelFile, table: dict[str, Any], parameters: Mapping[str, Any], prefix: str) -> Combined:
    rows = file.rows(table, "parts")
    if len(rows) > PARTS:
        file.damaged(f"it combines {len(rows)} elements")
    parts = []
    for row in rows:
        name = file.text(row, "name")
        element = element_of(file, file.table(row, "element"), parameters, f"{name}_")
        reads, writes = (tuple(file.count({key: c}, key) for c in file.rows(row, key)) for key in ("reads", "writes"))
        parts.append(file.build(Part, name, element, reads, writes))
    return file.build(Combined, tuple(parts), file.count(table, "channels"))
