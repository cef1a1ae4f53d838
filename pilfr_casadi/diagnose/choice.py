"""Choosing among fitted candidates.

The criterion of a candidate is `½ n ln(mse) + ½ k ln n` with mse the geometric mean of the errors on the fitted part
and on the rest, k its parameters and n an effective number of samples, which shrinks with the residual's correlation
time: where model error dominates, neighbouring samples say the same thing. Laws that can imitate others have to beat
them by a clear factor first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .candidate import Candidate
from .kinship import CONTAINS, handicap, imitates

# rivals whose error is within this share, and which take away this share of the mean square that the winner does,
# cannot be told apart: under loud noise the first alone would hold for nearly any
LIKE, AS_MUCH = 0.03, 0.995
CLEARLY = 1.1  # times the error above the floor of a friction that falls with speed, of a hysteresis that does better
NEARLY = 1.25  # times the error of a law that is hardly what its name says, of one that is
TRACE = 5e-6  # of the mean square without any law, which is next to nothing
CARRIED = 1.5  # times the error of a mode beside the path, of the carried mass that it may stand for


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
    common : tuple of str, optional
        All sensors and the law, where the same in each of them does as well as the winner.
    """

    winner: Candidate
    alike: tuple[Candidate, ...]
    gain: float
    remains: float
    margin: float
    common: tuple[str, str] | None = None


def _near(candidate: Candidate, winner: Candidate, before: float) -> bool:
    """Whether a law does as well; `before` is the mean square error without any."""
    return candidate.error < (1 + LIKE) * winner.error and _as_much(candidate, winner, before)


def _as_much(candidate: Candidate, winner: Candidate, before: float) -> bool:
    """Whether a law takes away as much of the mean square."""
    return bool(before - candidate.error**2 >= AS_MUCH * (before - winner.error**2))


def _within_steps(candidate: Candidate, winner: Candidate, before: float, floor: float) -> bool:
    """Whether all that one of two frictions at a port leaves is next to what steps make of a force that turns round."""
    both = candidate.knee and winner.knee and candidate.port == winner.port
    return bool(both and candidate.error**2 - floor < TRACE * before)


def _fits(candidate: Candidate, winner: Candidate) -> bool:
    """Whether a law at the same port follows everything as well, fitted to everything."""
    return candidate.port == winner.port and candidate.full < (1 + LIKE) * winner.full


def dry_instead(winner: Candidate, ranked: Sequence[Candidate], floor: float) -> Candidate | None:
    """Dry friction, where what falls with speed is chosen and hysteresis, which knows of no speed, is clearly nearer.

    Then it is the contact's bend before it slides (Dahl 1968) that the fall imitates.
    """
    if winner.law.id != "stribeck_friction":
        return None
    there = [c for c in ranked if c.port == winner.port]
    most = (winner.error**2 - floor) / CLEARLY**2
    nearer = any(c.law.id == "hysteresis" and max(c.error**2 - floor, 0.05 * floor) < most for c in there)
    dry = [c for c in there if c.law.id == "coulomb_friction" and not c.doubtful and c.error < NEARLY * winner.error]
    return dry[0] if nearer and dry else None


def choose(candidates: Sequence[Candidate], without: tuple[float, float], floor: float, n: float) -> Choice | None:
    """The winner among candidates; `without` are the errors of the simulator alone, `floor` the noise, all squared."""
    usable = [c for c in candidates if np.isfinite(c.error)]
    if not usable:
        return None

    def excess(c: Candidate) -> float:
        # a handicap counts for what lies above the floor: at the floor nothing is left to imitate
        noise = min(floor, c.error**2)
        return float(np.sqrt(noise + (c.error**2 - noise) * handicap(c.law) ** 2))

    def key(c: Candidate) -> float:
        return float(np.log(excess(c)) + 0.5 * c.size * np.log(n) / n)

    def fewest(winner: Candidate) -> Candidate:
        """What does as well as one with fewer parameters, and is no more doubtful."""
        close = [c for c in ranked if c.size < winner.size]
        close = [c for c in close if _near(c, winner, before) or _within_steps(c, winner, before, floor)]
        return min((c for c in close if c.doubtful <= winner.doubtful), key=lambda c: (c.size, key(c)), default=winner)

    ranked = sorted(usable, key=key)
    winner = ranked[0]
    before = float(np.sqrt(without[0] * without[1]))
    winner = fewest(winner)
    as_small = [c for c in ranked if c.size <= winner.size and not c.at_bound]
    free = [c for c in as_small if _near(c, winner, before) or _fits(c, winner)]
    if winner.at_bound and free:  # what does as well without being held back
        winner = min(free, key=lambda c: (c.size, key(c)))
    plain = [c for c in ranked if c.port == winner.port and not c.doubtful and c.error < NEARLY * winner.error]
    if winner.doubtful and plain:  # what does nearly as well and is what its name says
        winner = fewest(plain[0])
    for rival in ranked[1:]:
        if not rival.doubtful and imitates(winner, rival, floor):
            winner = rival
            break
    dry = dry_instead(winner, ranked, floor)
    winner, given_up = (winner, None) if dry is None else (dry, winner.name)
    carried = [c for c in ranked if c.law.form == "attached mass" and c.error < CARRIED * winner.error]
    if winner.law.form == "mode" and carried and _as_much(carried[0], winner, before):
        winner = carried[0]  # any pair of a pole and a zero is a mode: a part that is carried along is one
    modes = [c for c in reversed(ranked) if c.law.form == "mode" and c.error < (1 + LIKE) * winner.error]
    beside = modes if winner.law.form == "attached mass" else []
    if winner.law.id == "drift":  # what an actuator's would have to be tuned for, a sensor's is by itself
        slow = [c for c in ranked if c.law.id == "drift" and c.port.startswith("sensor:") and c.size <= winner.size]
        winner = next((c for c in slow if _near(c, winner, before)), winner)
    gain = n * (0.5 * np.log(before) - np.log(winner.error)) - 0.5 * winner.size * np.log(n)
    first = {c.name: c for c in reversed(ranked) if c.name != winner.name}  # the best of each name
    no_larger = [c for c in reversed(ranked) if c.name in first and _near(c, winner, before) and c.size <= winner.size]
    alike = {c.name: c for c in (*beside, *no_larger) if c.name != winner.name}
    ports, margin = {winner.port, *(port for port, _ in alike)}, np.inf
    for c in first.values():
        ratio = c.error / winner.error
        # friction that hardly falls may come a little nearer than one that does not
        least = 1 / NEARLY if c.doubtful and c.knee and winner.knee else 1 - LIKE
        contains = winner.law.id in CONTAINS.get(c.law.id, ()) and ratio > least
        refines = c.name == given_up or (c.size > winner.size and _within_steps(winner, c, before, floor))
        refines = refines or (c.port in ports and (_near(c, winner, before) or contains))
        if c.name not in alike and not refines:  # nor a refinement of what cannot be told from the winner
            margin = min(margin, max(ratio, float(np.exp(key(c) - key(winner)))))
    remains = (winner.error**2 - floor) / max(before - floor, 1e-300)
    return Choice(winner, tuple(alike.values())[::-1], float(gain), float(np.clip(remains, 0, 1)), float(margin))
