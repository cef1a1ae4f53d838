"""What a search comes to: the verdict after other readings of it, what is named, and the simulator that shows it."""

from __future__ import annotations

from dataclasses import dataclass

from .choice import Choice
from .clipping import clipped_input
from .correction import Correction, as_named, find_correction
from .gates import Gate
from .held import held_value
from .proof import mean_nrmse
from .search import Search
from .second_effect import not_named
from .undeclared import beyond_the_ports
from .varying import varying
from .verdict import UNSURE, confidence, judge, left_open, named
from .workbench import Fitted


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What is told of a search.

    Attributes
    ----------
    fitted : Fitted
        The simulator with what was found, or refitted where nothing was.
    named : list of Choice
        The effects that are named; others may be closed in.
    let_go : str
        The held parameter that does what a law was named for.
    correction : Correction
        What `fitted` consists of beside the refit.
    """

    verdict: str
    sentence: str
    gates: tuple[Gate, ...]
    fitted: Fitted
    named: list[Choice]
    correction: Correction
    let_go: str = ""


def concluded(search: Search, gates: tuple[Gate, ...]) -> Conclusion:
    """The verdict, unless a value that is held or an input that was clipped says the same; notes where none is sure."""
    verdict, sentence = judge(search, gates)
    unfinished = search.interrupted  # what comes below only adds to an answer that is there
    held = held_value(search) if verdict in ("missing-physics", "unexplained") and not unfinished else None
    if held is not None:
        return Conclusion("complete", held.sentence, gates, held.fitted, [], as_named(search, held.fitted), held.name)
    refit = as_named(search, search.without)
    if (lost := _lost_input(search, verdict)) is not None:
        return Conclusion("recording-fault", lost.sentence, (*gates, lost), search.without, [], refit)
    if verdict == "missing-physics":
        correction, fitted = find_correction(search, named=True)
        sentence = f"{sentence} {correction.sentence}" if correction.learned else sentence
        return Conclusion(verdict, sentence, (*gates, *not_named(search)), fitted, named(search), correction)
    if verdict == "unexplained":
        gates = (*gates, *beyond_the_ports(search), *varying(search))
    if unfinished and verdict != "recording-fault":
        sentence = (
            "The search was interrupted before it came to an answer; refitted, the simulator is off by "
            f"{mean_nrmse(search.bench, search.without):.3g} of the outputs' deviation."
        )
    elif verdict == "unexplained":
        correction, fitted = find_correction(search)
        return Conclusion(verdict, f"{sentence} {correction.sentence}", gates, fitted, [], correction)
    return Conclusion(verdict, sentence, gates, search.without, [], refit)


def _lost_input(search: Search, verdict: str) -> Gate | None:
    """The clipped input that a mismatch without a sure name comes from."""
    sure = verdict == "missing-physics" and min(confidence(c, search) for c in search.accepted) >= UNSURE
    if sure or verdict not in ("missing-physics", "unexplained"):
        return None
    remains = left_open(search)[0] if verdict == "missing-physics" else 1.0
    return clipped_input(search.bench, search.without, remains)
