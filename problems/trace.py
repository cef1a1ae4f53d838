"""Files and functions of the package that one call of `fit` or `diagnose` passes (`python -m problems.trace`).

An engineer who wants to follow a call has to read these files. The calls are counted with `sys.setprofile` in this
process and in its threads; imports, which pass every module once, are made before.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pilfr_casadi as pilfr

FOLDER = Path(pilfr.__file__).parent


def passed(call: Callable[[], Any]) -> set[tuple[str, str]]:
    """(file, function) of the package that a call passes; the call is made twice, and the second one is counted."""
    call()
    found: set[tuple[str, str]] = set()

    def note(frame: Any, event: str, argument: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(FOLDER)):
            found.add((str(Path(code.co_filename).relative_to(FOLDER)), code.co_qualname))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return found


def fit() -> Callable[[], Any]:
    """Read the demonstration's recording; return the call that identifies ten plays from it, with two starts."""
    folder = next(FOLDER.rglob("train.csv")).parent
    train = pilfr.read_csv(folder / "train.csv", inputs="u", outputs="x2", initial="zero")
    model = pilfr.PILFR(nx=5, element=pilfr.PrandtlIshlinskii(pilfr.Play, 10))
    return lambda: pilfr.fit(model, train, starts=2, seed=0)


def diagnose() -> Callable[[], Any]:
    """Read the demonstration's rig and recordings; return the call that diagnoses it."""
    from pilfr_casadi.simulators import load_simulator

    folder = next(FOLDER.rglob("rig_train.csv")).parent
    known = {"inputs": "force", "outputs": "x2", "initial": "zero", "hold": "zero"}
    train, test = (pilfr.read_csv(folder / f"rig_{name}.csv", **known) for name in ("train", "test"))
    simulator = load_simulator(folder / "rig.py")
    return lambda: pilfr.diagnose(simulator, train, test=test)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how many files and functions each verb passes, by folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verbs", nargs="*", default=["fit", "diagnose"], help="fit, diagnose")
    for verb in parser.parse_args(arguments).verbs:
        found = passed({"fit": fit, "diagnose": diagnose}[verb]())
        files = {name for name, _ in found}
        folders = Counter(str(Path(name).parent) for name in files)
        print(f"{verb}: {len(files)} files, {len(found)} functions")
        print("  " + ", ".join(f"{folder} {count}" for folder, count in sorted(folders.items())))


if __name__ == "__main__":
    main()
