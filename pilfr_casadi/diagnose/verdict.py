"""Choosing among fitted candidates, and how sure the choice is.

The criterion of a candidate is `½ n ln(mse) + ½ k ln n` with mse the geometric mean of the errors on the fitted part and
on the rest, k its parameters and n an effective number of samples, which shrinks with the residual's correlation time:
where model error dominates, neighbouring samples say the same thing. Laws that can imitate others have to beat them by a
clear factor first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .explain import Candidate

LIKE = 0.03  # rivals whose error is within this share cannot be told apart
# (a flexible law, what it imitates) -> factor by which its error must be smaller; "*" is any other law at that port
FLEXIBLE: dict[str, float] = {
    "hysteresis": 1.25,
    "static_curve": 1.1,
    "extra_mode": 1.15,
    "stribeck_friction": 1.05,
    "periodic_force": 1.1,
}
IMITATES = {("hysteresis", "coulomb_friction"): 1.4}
FORMS = {"mode": 1.15, "off-centre": 1.05, "asymmetric": 1.05, "power": 1.1, "polynomial": 1.05, "attached mass": 1.1}


@dataclass(frozen=True, eq=False)
class Choice:
    """The winner with its rivals.

    Attributes
    ----------
    gain : float
        Criterion gained over the simulator without any law, in nats.
    remains : float
        Share of the excess over the floor that the winner leaves.
    margin : float
        Smallest ratio of a true rival's error to the winner's.
    """

    winner: Candidate
    alike: tuple[Candidate, ...]
    gain: float
    remains: float
    margin: float


def handicap(candidate: Candidate) -> float:
    """Factor on the error of a law that can imitate others."""
    return FLEXIBLE.get(candidate.law.id, 1.0) * FORMS.get(candidate.law.form, 1.0)


def weighted(candidate: Candidate, n: float) -> float:
    """Criterion per effective sample, as a logarithm of the error."""
    return float(np.log(candidate.error) + 0.5 * candidate.size * np.log(n) / n)


def choose(
    candidates: Sequence[Candidate], without: tuple[float, float], floor: float, n: float
) -> Choice | None:
    """The winner among candidates; `without` are the errors of the simulator alone, `floor` the noise, all squared."""
    usable = [c for c in candidates if np.isfinite(c.error)]
    if not usable:
        return None

    def excess(c: Candidate) -> float:
        # a handicap counts for what lies above the floor: at the floor nothing is left to imitate
        above = max(c.error**2 - floor, 1e-4 * floor)
        return float(np.sqrt(floor + above * handicap(c) ** 2))

    def key(c: Candidate) -> float:
        return float(np.log(excess(c)) + 0.5 * c.size * np.log(n) / n)

    ranked = sorted(usable, key=key)
    winner = ranked[0]
    close = [c for c in ranked if c.error < (1 + LIKE) * winner.error and c.size < winner.size]
    if close:  # what does as well with fewer parameters
        winner = min(close, key=lambda c: (c.size, key(c)))
    for rival in ranked[1:]:
        if rival.port == winner.port and rival.law.id != winner.law.id:
            needed = IMITATES.get((winner.law.id, rival.law.id), 0.0)
            if needed and rival.error < needed * winner.error:
                winner = rival
                break
    before = float(np.sqrt(np.sqrt(without[0] * without[1])))
    gain = n * (np.log(before) - np.log(winner.error)) - 0.5 * winner.size * np.log(n)
    alike, margin = [], np.inf
    seen = {winner.name}
    for c in ranked:
        if c.name in seen:
            continue
        seen.add(c.name)
        ratio = c.error / winner.error
        if ratio < 1 + LIKE and c.size <= winner.size:
            alike.append(c)
        elif not (c.port == winner.port and ratio < 1 + LIKE):  # a refinement of the winner is no rival
            margin = min(margin, max(ratio, excess(c) / excess(winner)))
    remains = (winner.error**2 - floor) / max(before**2 - floor, 1e-300)
    return Choice(winner, tuple(alike), float(gain), float(np.clip(remains, 0, 1)), float(margin))


def confidence(choice: Choice) -> float:
    """How sure the name is: from the margin over true rivals, lowered by what stays unexplained."""
    rivals = 1 + len(choice.alike)
    lead = 1 - np.exp(-8 * np.log(max(min(choice.margin, 10.0), 1.0)))
    return float(np.clip(lead * (1 - choice.remains) / rivals, 0.0, 0.99))
