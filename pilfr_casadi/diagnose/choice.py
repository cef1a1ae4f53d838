"""Choosing among fitted candidates.

The criterion of a candidate is `½ n ln(mse) + ½ k ln n` with mse the geometric mean of the errors on the fitted part
and on the rest, k its parameters and n an effective number of samples, which shrinks with the residual's correlation
time: where model error dominates, neighbouring samples say the same thing. Laws that can imitate others have to beat
them by a clear factor first.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..simulators import in_series
from .candidate import Candidate
from .kinship import CONTAINS, handicap, imitates

# rivals whose error is within this share, and which take away this share of the mean square that the winner does,
# cannot be told apart: under loud noise the first alone would hold for nearly any
LIKE, AS_MUCH = 0.03, 0.995
CLEARLY = 1.1  # times the error above the floor of a friction that falls with speed, of a hysteresis that does better
NEARLY = 1.25  # times the error of a law that is hardly what its name says, of one that is
TRACE = 5e-6  # of the mean square without any law, which is next to nothing
CARRIED = 1.5  # times the error of a mode beside the path, or of a creeping signal, of the part that it may stand for
ABOVE = 1.15  # times the noise that is left by what does not follow everything


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

    @property
    def readings(self) -> int:
        """Of how many kinds of physics, which are one and the same to the recordings, one is named."""
        creeps = {in_series(c.port) for c in (self.winner, *self.alike) if c.law.id == "creep"}
        return 2 if self.common or (self.winner.law.id == "creep" and len(creeps) > 1) else 1


@dataclass(frozen=True, eq=False)
class _Contest:
    """Candidates with finite errors, and what they are measured by: all squared but `n`, the effective samples."""

    ranked: Sequence[Candidate]
    before: float  # without any law
    floor: float
    n: float

    @classmethod
    def of(cls, candidates: Sequence[Candidate], before: float, floor: float, n: float) -> _Contest:
        """Ranked by the criterion."""
        contest = cls(candidates, before, floor, n)
        return replace(contest, ranked=sorted(candidates, key=contest.key))

    def key(self, c: Candidate) -> float:
        """The criterion a sample; a handicap counts for what lies above the floor, where something is to imitate."""
        noise = min(self.floor, c.error**2)
        excess = float(np.sqrt(noise + (c.error**2 - noise) * handicap(c.law) ** 2))
        return float(np.log(excess) + 0.5 * c.size * np.log(self.n) / self.n)

    def near(self, c: Candidate, winner: Candidate) -> bool:
        """Whether a law does as well."""
        return c.error < (1 + LIKE) * winner.error and self.as_much(c, winner)

    def as_much(self, c: Candidate, winner: Candidate) -> bool:
        """Whether a law takes away as much of the mean square."""
        return bool(self.before - c.error**2 >= AS_MUCH * (self.before - winner.error**2))

    def within_steps(self, c: Candidate, winner: Candidate) -> bool:
        """Whether all that one of two frictions at a port leaves is what steps make of a force that turns round."""
        both = c.knee and winner.knee and c.port == winner.port
        return bool(both and c.error**2 - self.floor < TRACE * self.before)

    def fewest(self, winner: Candidate) -> Candidate:
        """What does as well as one with fewer parameters, and is no more doubtful."""
        close = [c for c in self.ranked if c.size < winner.size and c.doubtful <= winner.doubtful]
        close = [c for c in close if self.near(c, winner) or self.within_steps(c, winner)]
        return min(close, key=lambda c: (c.size, self.key(c)), default=winner)

    def winner(self) -> Candidate:
        """The first, unless another is preferred for what it is."""
        winner = self.held_by_nothing(self.fewest(self.ranked[0]))
        plain = [c for c in self.there(winner) if not c.doubtful and c.error < NEARLY * winner.error]
        if winner.doubtful and plain:  # what does nearly as well and is what its name says
            winner = self.fewest(plain[0])
        rivals = (c for c in self.ranked[1:] if not c.doubtful and imitates(winner, c, self.floor))
        return next(rivals, winner)

    def held_by_nothing(self, winner: Candidate) -> Candidate:
        """Instead of a law that a bound holds back, what does as well without."""
        as_small = [c for c in self.ranked if c.size <= winner.size and not c.at_bound]
        free = [c for c in as_small if self.near(c, winner) or _fits(c, winner)]
        return min(free, key=lambda c: (c.size, self.key(c))) if winner.at_bound and free else winner

    def there(self, winner: Candidate) -> list[Candidate]:
        """Candidates at the winner's port."""
        return [c for c in self.ranked if c.port == winner.port]

    def of_its_kind(self, winner: Candidate) -> Candidate:
        """Of laws that are one another's special case, the one to speak of."""
        carried = [c for c in self.ranked if c.law.form == "attached mass" and c.error < CARRIED * winner.error]
        if winner.law.form == "mode" and carried and self.as_much(carried[0], winner):
            return carried[0]  # any pair of a pole and a zero is a mode: a part that is carried along is one
        if winner.law.id == "drift":  # what an actuator's would have to be tuned for, a sensor's is by itself
            slow = [c for c in self.ranked if c.law.id == "drift" and c.port.startswith("sensor:")]
            return next((c for c in slow if c.size <= winner.size and self.near(c, winner)), winner)
        if winner.law.id == "creep" and in_series(winner.port):
            return next((c for c in self.ranked if self._relaxes(c, winner)), winner)
        return winner

    def _relaxes(self, c: Candidate, winner: Candidate) -> bool:
        """Whether a part relaxes as well as a signal creeps: the commoner of the two, and one transfer function.

        Where neither follows all there is, the one that a few time constants bring nearer is nearer by chance.
        """
        if c.law.id != "creep" or in_series(c.port) or c.size > winner.size:
            return False
        by_chance = winner.error**2 > ABOVE**2 * self.floor and c.error < CARRIED * winner.error
        return self.near(c, winner) or (by_chance and self.as_much(c, winner))

    def best_form(self, winner: Candidate) -> Candidate:
        """The named law in a form that is far nearer fitted to everything: the first part may not have asked for it."""
        forms = [c for c in self.ranked if c.name == winner.name and not c.doubtful and not c.at_bound]
        forms = [c for c in forms if not self.within_steps(winner, c)]
        forms = [c for c in forms if c.full < winner.full / NEARLY**2 and c.error < NEARLY * winner.error]
        return min(forms, key=lambda c: c.full, default=winner)

    def alike(self, winner: Candidate) -> dict[tuple[str, str], Candidate]:
        """What no larger does as well, by name, the least near first."""
        modes = [c for c in self.ranked[::-1] if c.law.form == "mode" and c.error < (1 + LIKE) * winner.error]
        beside = modes if winner.law.form == "attached mass" else []
        no_larger = [c for c in self.ranked[::-1] if self.near(c, winner) and c.size <= winner.size]
        return {c.name: c for c in (*beside, *no_larger) if c.name != winner.name}

    def margin(self, winner: Candidate, alike: Collection[tuple[str, str]], given_up: tuple[str, str] | None) -> float:
        """Smallest ratio of a true rival's error: none is a refinement of what cannot be told from the winner."""
        ports, margin = {winner.port, *(port for port, _ in alike)}, np.inf
        for c in {c.name: c for c in self.ranked[::-1]}.values():  # the best of each name
            if c.name in (winner.name, given_up, *alike) or self._refines(c, winner, ports):
                continue
            ratio = max(c.error / winner.error, float(np.exp(self.key(c) - self.key(winner))))
            if np.isfinite(c.full) and np.isfinite(winner.full):  # what cannot follow everything is refuted by that
                ratio = max(ratio, (c.full / max(winner.full, 1e-300)) ** 0.5)
            margin = min(margin, ratio)
        return float(margin)

    def _refines(self, c: Candidate, winner: Candidate, ports: Collection[str]) -> bool:
        if c.size > winner.size and self.within_steps(winner, c):
            return True
        # friction that hardly falls may come a little nearer than one that does not
        least = 1 / NEARLY if c.doubtful and c.knee and winner.knee else 1 - LIKE
        contains = winner.law.id in CONTAINS.get(c.law.id, ()) and c.error > least * winner.error
        return c.port in ports and (self.near(c, winner) or contains)


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
    before = float(np.sqrt(without[0] * without[1]))
    contest = _Contest.of(usable, before, floor, n)
    found = contest.winner()
    dry = dry_instead(found, contest.ranked, floor)
    winner = contest.of_its_kind(contest.best_form(dry or found))
    alike = contest.alike(winner)
    gain = n * (0.5 * np.log(before) - np.log(winner.error)) - 0.5 * winner.size * np.log(n)
    remains = (winner.error**2 - floor) / max(before - floor, 1e-300)
    margin = contest.margin(winner, alike, found.name if dry else None)
    return Choice(winner, tuple(alike.values())[::-1], float(gain), float(np.clip(remains, 0, 1)), margin)
