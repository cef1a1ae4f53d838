"""The contract of diagnosis.json: its schema, and a check of the part of JSON Schema that it uses."""

import json
from pathlib import Path

import numpy as np

SCHEMA = json.loads((Path(__file__).parent / "diagnosis.schema.json").read_text())


def problems(value, schema, where="$"):
    """What in a JSON value breaks the part of JSON Schema that the contract uses."""
    schema = SCHEMA["$defs"][schema["$ref"].rsplit("/", 1)[1]] if "$ref" in schema else schema
    out = []
    if "anyOf" in schema and all(problems(value, option) for option in schema["anyOf"]):
        out.append(f"{where}: none of the options")
    if "const" in schema and value != schema["const"]:
        out.append(f"{where}: not {schema['const']}")
    if "enum" in schema and value not in schema["enum"]:
        out.append(f"{where}: {value!r} not in {schema['enum']}")
    if "type" in schema:
        kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        types_ = {
            "object": dict,
            "array": list,
            "string": str,
            "number": (int, float),
            "null": type(None),
            "boolean": bool,
        }
        if not any(isinstance(value, types_[k]) and not (k == "number" and isinstance(value, bool)) for k in kinds):
            out.append(f"{where}: {type(value).__name__} is not {kinds}")
    if isinstance(value, int | float) and not schema.get("minimum", -np.inf) <= value <= schema.get("maximum", np.inf):
        out.append(f"{where}: {value} out of range")
    if isinstance(value, dict):
        out += [f"{where}: no {key}" for key in schema.get("required", ()) if key not in value]
        for key, item in value.items():
            more = schema.get("additionalProperties")
            inner = schema.get("properties", {}).get(key, more if isinstance(more, dict) else None)
            out += problems(item, inner, f"{where}.{key}") if inner else []
    if isinstance(value, list) and "items" in schema:
        out += [p for i, item in enumerate(value) for p in problems(item, schema["items"], f"{where}[{i}]")]
    return out
