"""`pilfr export`: a saved model, or a simulator's file, as one step for CasADi or as C."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from .._base import InputError
from ..export import NAMES, exported
from ..identify import load
from ..simulators import load_simulator
from .app import DONE


def run_export(options: argparse.Namespace) -> int:
    """Write a model's step as a serialized CasADi function with its names, or as C."""
    simulated = Path(options.model).suffix.lower() == ".py"
    source: Any = load_simulator(options.model) if simulated else load(options.model)
    for key in ("dt", "hold"):
        if getattr(options, key) is not None and not simulated:
            raise InputError(f"--{key} was given, but a saved model has its own step; leave it out.")
    if simulated and options.dt is None:
        raise InputError("A simulator has no step of its own; give --dt SECONDS.")
    step = exported(source, dt=options.dt, hold=options.hold, smooth=options.smooth, name=options.name)
    out = Path(options.out)
    if options.c:
        code, header = step.to_c(options.out)
        print(f"C source: {code}\nheader: {header}")
        return DONE
    if out.is_dir() or not out.parent.is_dir() or not os.access(out.parent, os.W_OK):
        raise InputError(f"--out {options.out} cannot be written; give a file in a folder that exists.")
    names = out.with_name(out.name + NAMES)
    if Path(options.model).resolve() in (out.resolve(), names.resolve()):
        raise InputError(f"--out {options.out} would overwrite the model; give another file.")
    step.serialize(out)
    print(f"casadi function: {options.out}\nnames of its signals: {names}")
    return DONE
