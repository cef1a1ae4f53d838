"""Verbs of objects whose work is done in a later folder: the one table of what reaches forward.

A folder imports only folders before it. A recording that draws itself, or a fit that writes its report, is a matter of
spelling: the method says in one line `return later("plot_recording")(self)`, and the folder is imported when a user
calls it.
"""

import importlib
from collections.abc import Callable
from typing import Any

LATER_VERBS = {  # verb -> the folder whose face has it
    "compare": "identify",
    "diagnosis_card": "report",
    "diagnosis_report": "report",
    "fit_card": "report",
    "fit_report": "report",
    "comparison_card": "report",
    "plot_recording": "plots",
    "recording_card": "report",
    "simulator_card": "report",
    "simulator_nrmse": "identify",
}


def later(verb: str) -> Callable[..., Any]:
    """Return a function of a later folder's face, by its name in `LATER_VERBS`."""
    folder = importlib.import_module(f"..{LATER_VERBS[verb]}", __package__)
    return getattr(folder, verb)
