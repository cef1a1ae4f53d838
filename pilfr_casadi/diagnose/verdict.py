"""Choosing among fitted candidates, and how sure the choice is.

The criterion of a candidate is `½ n ln(mse) + ½ k ln n` with mse the geometric mean of the errors on the fitted part
and on the rest, k its parameters and n an effective number of samples, which shrinks with the residual's correlation
time: where model error dominates, neighbouring samples say the same thing. Laws that can imitate others have to beat
them by a clear factor first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .candidate import Candidate
from .floor import swells_with
from .gates import Gate
from .kinship import CONTAINS, handicap, imitates
from .proof import mean_nrmse
from .ringing import ringing

if TYPE_CHECKING:
    from .search import Search
    from .workbench import Fitted

AT_FLOOR, WELL_ABOVE = 1.15, 3.0  # times the floor that counts as being at it, and as being far from it
QUANTISED, SOMEWHAT, COLOURED = 2.0, 4.0, 9.0  # times a measured floor, and an estimated one, that noise may be
LOUD, SILENT = 0.05, 0.01  # largest coloured noise, and what a force may explain of it
QUIET, CHANCE = 0.01, 0.05  # the same for noise that nobody minds: by chance a force explains that much
HINT = 0.1  # share of a residual that a flexible force has to explain to count
PARTLY, STILL = 0.09, 0.3  # of the excess left, and of it explainable: a name that only comes near
LITTLE = 0.02  # of the excess left, with rivals near and a force that explains most of it
MAINLY = 0.6  # of it explainable: whatever the rivals, the name is wrong or incomplete
# times the winner's error (twice the mean square) that every rival's is, for a name that only comes near to be given
CLEAR = 1.4
DRIVEN = 0.5  # share of a name's confidence where it takes a parameter at its bound
# times the noise, and times the fitted part's error on the rest, that halve it; more does not, for a good sensor knows
# of no model error and an integrator drifts
FAR_OFF, FAR_AHEAD = 16.0, 4.0
SLIGHT = 3e-3  # share of the whole excess that halves the confidence of an effect which explains no more
UNSURE = 0.5  # confidence below which a name is called likely
# confidence below which two names, or one that leaves much and has rivals near, are no answer
HARDLY = 0.1
CURES = 1e-3  # share of the mean square that a fault leaves which was the mismatch, whatever else there is
HALVED = 3.0  # times the error of a fault put right that an effect has to take away to be named before the fault
PURE = 0.05  # share of model error in a residual that is taken for noise
MOST_OPEN = 0.4  # share of the excess that no named law may leave
# rivals whose error is within this share, and which take away this share of the mean square that the winner does,
# cannot be told apart: under loud noise the first alone would hold for nearly any
LIKE, AS_MUCH = 0.03, 0.995
NEARLY = 1.25  # times the error of a law that is hardly what its name says, of one that is
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


def _fits(candidate: Candidate, winner: Candidate) -> bool:
    """Whether a law at the same port follows everything as well, fitted to everything."""
    return candidate.port == winner.port and candidate.full < (1 + LIKE) * winner.full


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

    ranked = sorted(usable, key=key)
    winner = ranked[0]
    before = float(np.sqrt(without[0] * without[1]))
    close = [c for c in ranked if _near(c, winner, before) and c.size < winner.size]
    if close:  # what does as well with fewer parameters
        winner = min(close, key=lambda c: (c.size, key(c)))
    as_small = [c for c in ranked if c.size <= winner.size and not c.at_bound]
    free = [c for c in as_small if _near(c, winner, before) or _fits(c, winner)]
    if winner.at_bound and free:  # what does as well without being held back
        winner = min(free, key=lambda c: (c.size, key(c)))
    plain = [c for c in ranked if c.port == winner.port and not c.doubtful and c.error < NEARLY * winner.error]
    if winner.doubtful and plain:  # what does nearly as well and is what its name says
        winner = plain[0]
    for rival in ranked[1:]:
        if not rival.doubtful and imitates(winner, rival, floor):
            winner = rival
            break
    carried = [c for c in ranked if c.law.form == "attached mass" and c.error < CARRIED * winner.error]
    if winner.law.form == "mode" and carried and _as_much(carried[0], winner, before):
        winner = carried[0]  # any pair of a pole and a zero is a mode: a part that is carried along is one
    beside = [c for c in reversed(ranked) if c.law.form == "mode" and winner.law.form == "attached mass"]
    beside = [c for c in beside if c.error < (1 + LIKE) * winner.error]
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
        contains = winner.law.id in CONTAINS.get(c.law.id, ()) and ratio > 1 - LIKE
        if c.name in alike or (c.port in ports and (_near(c, winner, before) or contains)):
            continue  # a refinement of the winner, or of what cannot be told from it, is no rival
        else:
            margin = min(margin, max(ratio, float(np.exp(key(c) - key(winner)))))
    remains = (winner.error**2 - floor) / max(before - floor, 1e-300)
    return Choice(winner, tuple(alike.values())[::-1], float(gain), float(np.clip(remains, 0, 1)), float(margin))


def left_open(search: Search) -> tuple[float, float]:
    """Share of the excess over the floor that is left, and the share of the residual that a flexible force explains."""
    floor = search.floor2
    share = (search.base.cost - floor) / max(search.without.cost - floor, 1e-300)
    return float(np.clip(share, 0, 1)), max(search.open_after.values(), default=0.0)


def _like_noise(search: Search, times: float) -> bool:
    """Whether a residual so many times the floor can be noise: coloured, or repeated as quantisation is."""
    most = CHANCE if search.without.cost < QUIET**2 else SILENT
    unexplained = max(search.open_before.values(), default=0.0) < most
    if search.floor.source != "estimated":
        return times < QUANTISED and unexplained
    return times < SOMEWHAT or (times < COLOURED and unexplained and search.without.cost < LOUD**2)


def _swells(search: Search) -> bool:
    """Whether the residual swells with the inputs, the outputs or their rates."""
    records = search.bench.recordings
    signals = [np.column_stack([r.u, r.y, np.gradient(r.y, axis=0)])[r.skip :] for r in records]
    rest = [e[r.skip :] for e, r in zip(search.without.residual, records, strict=True)]
    return swells_with(rest, signals)


def judge(search: Search, gates: Sequence[Gate]) -> tuple[str, str]:
    """Verdict and its sentence."""
    accepted = [p.choice for p in search.passes if p.accepted and p.choice is not None]
    remains, still = left_open(search)
    faults = [g for g in gates if g.fault]
    cured = min((g.left for g in faults), default=1.0) < CURES
    if cured and search.without.cost < HALVED**2 * search.base.cost:  # next to the fault an effect is nothing
        return "recording-fault", faults[0].sentence
    if accepted and explains(accepted, remains, still):
        words = " and ".join(f"{c.winner.law.id.replace('_', ' ')} at {c.winner.port}" for c in accepted)
        common = next((c.common for c in accepted if c.common), None)
        words += f", or every sensor has the same ({common[0]}), as from the logger's filters" if common else ""
        sure = [confidence(c, search) for c in accepted]
        alone = len(accepted) == 1 and (accepted[0].margin > CLEAR or remains < PARTLY)
        if alone or max(sure) > HARDLY:
            return "missing-physics", (
                f"The simulator leaves out {words}."
                if min(sure) > UNSURE
                else f"The simulator most likely leaves out {words}; the name is not certain."
            )
    where = max(search.open_before, key=lambda k: search.open_before[k], default="")
    error, floor = search.without.cost**0.5, search.floor2**0.5
    open_now = max(search.open_before.values(), default=0.0)
    hum = [g for g in gates if g.finding == "tone" and not accepted]
    quiet = error * max(1 - sum(1 - g.left for g in hum), 0.0) ** 0.5
    like_noise = _like_noise(search, quiet / floor)
    own = ringing(search.bench, search.without) if like_noise or not accepted else None
    bare = quiet < AT_FLOOR * floor or (like_noise and own is None and not _swells(search))
    if faults and (bare or (open_now < HINT and not accepted) or cured):
        return "recording-fault", faults[0].sentence
    if bare and open_now < HINT:
        beside = f" but a steady tone in {' and '.join(g.channel for g in hum)}" if hum else ""
        return "complete", (
            f"Nothing is missing{beside}: refitted, the simulator follows the recordings to {_said(search):.3g} of the "
            f"outputs' deviation, and no force at any port explains any of the rest."
        )
    if not accepted:
        rings = (
            f"; what is left swings at the simulator's own {own:.3g} Hz, as from a force not recorded or a value that "
            "varies in time"
            if own
            else ""
        )
        at = f"; a force at {where} could explain {open_now:.0%} of the rest" if open_now > HINT else ""
        noise = search.floor.nrmse(search.bench.scale)
        return "unexplained", (
            f"Something is missing and no law of the catalogue explains it: refitted, the simulator is off by "
            f"{_said(search):.3g} of the outputs' deviation, the noise is about {noise:.3g}{at}{rings}."
        )
    near = accepted[0].winner
    port = near.port
    if search.open_before.get(port, 0.0) < 0.5 * search.open_before.get(where, 0.0):
        port = where
    return "unexplained", (
        f"Something is missing, most likely at {port}, and no law of the catalogue explains it: the nearest, "
        f"{near.law.id.replace('_', ' ')} at {near.port}, leaves {remains:.0%} of the excess, and a flexible force "
        f"explains {still:.0%} of what it leaves."
    )


def _said(search: Search) -> float:
    """Error of the refitted simulator, as the tables give it."""
    return mean_nrmse(search.bench, search.without)


def explains(accepted: Sequence[Choice], remains: float, still: float) -> bool:
    """Whether what is named leaves little, or nothing that a force explains."""
    margin = min(c.margin for c in accepted)
    most = PARTLY if margin > CLEAR else LITTLE
    near = (still > MAINLY and remains > most) or (still > STILL and remains > PARTLY and margin < CLEAR)
    return not near and remains <= MOST_OPEN


def confidence(choice: Choice, search: Search) -> float:
    """How sure the law's name is: from the margin over true rivals, lowered by what stays unexplained.

    At the noise floor a small margin over thousands of samples says more than the same margin where model error rules.
    A tie between ports does not lower it, a tie between laws does, and so do a mismatch of which it is a slight part
    (the error of another effect may be that), a residual that stays many times the noise, an error on what is not
    fitted far above that on what is, values at which the law is hardly what its name says, and a bound that holds a
    parameter of the law or of the simulator back short of the noise (other than zero, where a damper is that friction
    has replaced).
    """
    winner, (remains, still) = choice.winner, left_open(search)
    error2 = max(winner.error**2, 1e-300)
    above = float(np.clip(1 - search.floor2 / error2, PURE, 1.0))
    lead = 1 - np.exp(-8 / above * np.log(max(min(choice.margin, 10.0), 1.0)))
    still *= min(1.0, remains / 0.03)  # of next to nothing, all may be explainable
    doubt = 1 / (1 + (remains / 0.15) ** 2) / (1 + (still / 0.3) ** 2)
    times2, unseen2 = search.base.cost / search.floor2, winner.tail / max(winner.head, 1e-300)
    doubt /= (1 + min(times2 / FAR_OFF**2, 1.0)) * (1 + float(np.clip((unseen2 - 1) / FAR_AHEAD**2, 0.0, 1.0)))
    share = _share(choice, search)
    doubt *= share / (share + SLIGHT * (1 - share))
    others = len({c.law.id for c in choice.alike} - {winner.law.id})
    pressed = (times2 > AT_FLOOR**2 and strained(search.base)) or (times2 > WELL_ABOVE**2 and winner.held_back)
    driven = DRIVEN if pressed or winner.doubtful else 1.0
    return float(np.clip(driven * lead * doubt / (1 + others), 0.0, 0.99))


def _share(choice: Choice, search: Search) -> float:
    """Share of the excess that was there when an effect was looked for."""
    there = next((p.before for p in search.passes if p.choice is choice), (search.without.cost,) * 2)
    excess = float(np.sqrt(there[0] * there[1])) - search.floor2
    return float(np.clip(excess / max(search.without.cost - search.floor2, 1e-300), 0.0, 1.0))


def strained(fitted: Fitted) -> bool:
    """Whether one of the simulator's own free parameters stands at a bound other than zero."""
    prefixes = tuple(e.prefix for e in fitted.simulator.elements)
    for name, p in fitted.simulator.parameters.items():
        own = not name.startswith(prefixes)
        if own and np.any(fitted.at_bound(name) & (fitted.values[name] != 0) & ~p.fixed):
            return True
    return False
