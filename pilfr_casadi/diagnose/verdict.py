"""What a search comes to: the verdict with its sentence, and how sure a name is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..laws import display_name
from ..simulators import in_series
from .choice import Choice
from .floor import swells_with
from .gates import Gate
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
HARDLY = 0.2  # confidence below which names that leave something, with rivals near, are no answer
CURES = 1e-3  # share of the mean square that a fault leaves which was the mismatch, whatever else there is
HALVED = 3.0  # times the error of a fault put right that an effect has to take away to be named before the fault
AS_NEAR = 1.5  # times what a surrogate misses of the simulation itself, within which nothing can be said
HELPLESS = 0.9  # error of a refitted simulator that follows next to nothing
PURE = 0.05  # share of model error in a residual that is taken for noise
MOST_OPEN = 0.4  # share of the excess that no named law may leave


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
    if search.stand_in_error and _said(search) < AS_NEAR * search.stand_in_error:
        return "complete", (
            f"Nothing is seen that the simulation lacks: refitted, what stands for it follows the recordings to "
            f"{_said(search):.3g} of the outputs' deviation, and the simulation itself to {search.stand_in_error:.3g}."
        )
    accepted = search.accepted
    remains, still = left_open(search)
    faults = [g for g in gates if g.fault]
    cured = min((g.left for g in faults), default=1.0) < CURES
    if cured and search.without.cost < HALVED**2 * search.base.cost:  # next to the fault an effect is nothing
        return "recording-fault", faults[0].sentence
    if accepted and explains(accepted, remains, still):
        told = named(search)
        words = " and ".join(f"{display_name(c.winner.law.id)} at {c.winner.port}" for c in told)
        common = next((c.common for c in told if c.common), None)
        words += f", or every sensor has the same ({common[0]}), as from the logger's filters" if common else ""
        sure = [confidence(c, search) for c in told]
        # a real machine has more that is in no simulator: a lead counts of a law that is what its name says
        ahead = accepted[0].margin > CLEAR and not accepted[0].winner.doubtful
        if max(sure) >= HARDLY or ahead or (len(accepted) == 1 and remains < LITTLE):
            said = (
                f"The simulator leaves out {words}."
                if min(sure) > UNSURE
                else f"The simulator most likely leaves out {words}; the name is not certain."
            )
            more = " Something more is missing, of which no name is sure." if len(told) < len(accepted) else ""
            return "missing-physics", said + more + _gone(search, len(accepted))
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
        f"{display_name(near.law.id)} at {near.port}, leaves {remains:.0%} of the excess, and a flexible force "
        f"explains {still:.0%} of what it leaves."
    )


def named(search: Search) -> list[Choice]:
    """The first effect, and others whose names are sure or that leave nothing but noise.

    One filter in every sensor is one effect.
    """
    accepted = search.accepted
    if search.base.cost < AT_FLOOR**2 * search.floor2:
        return accepted
    return [c for c in accepted if c is accepted[0] or _sure_beside(c, accepted[0], search)]


def _sure_beside(choice: Choice, first: Choice, search: Search) -> bool:
    ends = (choice.winner, first.winner)
    one_filter = ends[0].law.id == ends[1].law.id and all(c.port.startswith("sensor:") for c in ends)
    return one_filter or confidence(choice, search) > UNSURE


def _gone(search: Search, effects: int) -> str:
    """What of the simulator's own is nothing beside the effects, in a sentence: they may stand in its place."""
    simulator = search.bench.simulator
    offsets = tuple(e.prefix for e in simulator.elements if e.law.id == "offset")
    names = [k for k in simulator.parameters if not k.startswith(offsets)]
    gone = [k for k in names if np.any(search.without.values[k]) and not np.any(search.base.values[k])]
    beside = "them" if effects > 1 else "it"
    return f" Beside {beside}, {' and '.join(gone)} {'come' if gone[1:] else 'comes'} out as zero." if gone else ""


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
    has replaced). Of readings that are one and the same to the recordings, as of a sensor that creeps and a part that
    relaxes, each is as likely.
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
    # in series with what follows nothing, a law makes the signal by itself; a shift in time does not
    helpless = search.without.cost > HELPLESS**2 and in_series(winner.port) and not winner.law.shifts
    driven = DRIVEN if pressed or winner.doubtful or helpless else 1.0
    return float(np.clip(driven * lead * doubt / (1 + others), 0.0, 0.99)) / choice.readings


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
