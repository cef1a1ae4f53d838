"""Whether a second effect is believed, which what the first leaves, and chance, may look like."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..laws import display_name
from .choice import Choice
from .gates import Gate
from .kinship import FLEXIBLE
from .linearise import linearised
from .own_shape import own_shape
from .proof import mean_nrmse
from .verdict import CLEAR, LITTLE, named
from .workbench import Fitted

if TYPE_CHECKING:
    from .search import Search

MOSTLY = 0.5  # share of the rest that a second effect may leave
NEARLY_ALL = 0.1  # the same beside another law at its port, or where it improves little of what it has not seen
UNSEEN, NO_WORSE = 0.7, 1.1  # shares of the mean square on the unseen part that a second effect may leave


def believed(search: Search, choice: Choice, unseen: float, number: int) -> bool:
    """Whether an effect beside `number` others is one; `unseen` is the mean square before on what is not fitted."""
    if not _stands(search, choice, unseen) or only_drifts(search, choice):
        return False
    return number > 1 or not own_shape(search, choice.winner)


def _stands(search: Search, choice: Choice, unseen: float) -> bool:
    """Whether most of what is left goes, and what is not fitted improves.

    That part may see little of it: a law that imitates none and takes most away overall need only not do worse there,
    and one that takes nearly all away and is far ahead of its rivals need only do better.
    """
    winner = choice.winner
    left = (winner.full - search.floor2) / max(search.base.cost - search.floor2, 1e-300)
    clear = choice.remains < MOSTLY and winner.tail < UNSEEN * unseen
    sure = winner.law.id not in FLEXIBLE and left < MOSTLY and winner.tail < NO_WORSE * unseen
    ahead = left < NEARLY_ALL and choice.margin > CLEAR and winner.tail < unseen
    return clear or sure or ahead


def not_named(search: Search) -> tuple[Gate, ...]:
    """Notes on effects whose names are not sure beside the first: they are closed in, and not named."""
    told, gates = named(search), []
    for choice in search.accepted:
        if choice not in told:
            port, law = choice.winner.name
            sentence = (
                f"Beside it something more is missing: {display_name(law)} at {port} brings the error to "
                f"{mean_nrmse(search.bench, search.base):.3g} of the outputs' deviation. What it is is not sure: it is "
                "in the corrected simulator, but not named."
            )
            gates.append(Gate(port, "unsure", law, sentence, False))
    return tuple(gates)


def only_drifts(search: Search, choice: Choice) -> bool:
    """Whether a law that imitates others stands at a sensor behind a free integrator, whose drift it can follow.

    What leaves next to nothing does more than that.
    """
    at_sensor = choice.winner.port.startswith("sensor:")
    if choice.winner.law.id not in FLEXIBLE or not at_sensor or choice.remains < LITTLE:
        return False
    a = linearised(search.bench, search.without)[1][0].mean[0]
    return bool(np.any(np.abs(np.linalg.eigvals(a) - 1) < 1e-6))


def mends(search: Search, before: Fitted) -> bool:
    """Whether a law does no more than mend another at its port, or one that imitates others as it does itself.

    It leaves too much of what was left.
    """
    left = (search.base.cost - search.floor2) / max(before.cost - search.floor2, 1e-300)
    found = search.found()
    ports, ids = {e.port for e in found}, [e.law.id for e in found]
    alike = len(set(ids)) < len(ids) and set(ids) <= set(FLEXIBLE)
    return (len(ports) < len(found) or alike) and left > NEARLY_ALL
