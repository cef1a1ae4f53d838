"""The verdict of a search, and its sentence.

The verdict is the likeliest answer of the posterior: complete, missing physics or unexplained. It also takes into
account what the checks of the recordings have found, and whether the refit's residual can be noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._base import capitalise, in_words, percent
from ..laws import CATALOGUE, display_name
from .faults.gates import Gate
from .faults.offsets import find_placed_offsets
from .faults.tones import find_ringing_mode
from .fits.evidence import (
    AT_NOISE_RATIO,
    EXPLAINED_NOISE,
    EXPLAINED_QUIET_NOISE,
    FAR_RATIO,
    FORMULA_ERROR,
    LEAST_EXPLAINED,
    NEAR_RATIO,
    NEGLIGIBLE_ERROR,
    OTHER_PORT_SHARE,
    SURE,
    WHITE_NOISE_RATIO,
)
from .fits.floor import ABOVE_NOISE
from .posterior import Posterior, may_be_coloured_noise, share_left, times_of_noise
from .search.hypotheses import Hypotheses
from .search.trials import Trial


@dataclass(frozen=True)
class Verdict:
    """One of the four verdicts, and its sentence."""

    kind: str
    sentence: str


def judge(search: Hypotheses, found: Posterior, gates: Sequence[Gate], closest: Trial | None = None) -> Verdict:
    """Choose the verdict: a fault if it was the mismatch, else the likeliest answer of the posterior.

    `closest` is the hypothesis that an unexplained mismatch is compared with, by default the most promising with a law.
    """
    off = search.bench.nrmse(search.root.fitted)
    surrogate = search.surrogate_nrmse
    if surrogate and off < NEAR_RATIO * surrogate:
        return Verdict(
            "complete",
            "Nothing is seen that the simulation lacks: refitted, what stands for it follows the recordings to "
            f"{percent(off)} of the outputs' deviation, and the simulation itself to {percent(surrogate)}.",
        )
    fault = min((g for g in gates if g.fault), key=lambda g: g.left, default=None)
    cured = fault is not None and fault.left < FORMULA_ERROR
    # beside the fault, an effect is negligible
    if fault and cured and search.root.mean_square < FAR_RATIO**2 * found.best.mean_square:
        return Verdict("recording-fault", fault.sentence)
    if found.effects and found.named > SURE:
        return Verdict("missing-physics", _describe_effects(search, found))
    shares = search.flexible(search.root)
    share = max(shares.values(), default=0.0)
    slow = share > EXPLAINED_NOISE and may_be_coloured_noise(search) and not search.is_driven
    if slow:  # a force always seems to explain some of slow noise
        share = search.innovation_share(search.root)
    matters = not slow and np.mean(search.root.fitted.squares) > NEGLIGIBLE_ERROR**2
    explained = share > (EXPLAINED_NOISE if matters else EXPLAINED_QUIET_NOISE)
    unnamed = not found.effects
    steady = [g for g in gates if g.finding == "tone" and unnamed]
    mode = find_ringing_mode(search.bench, search.root.fitted)
    quiet = max(1 - sum(1 - g.left for g in steady), 0.0) ** 0.5  # share of the error that is left without the tones
    measured = unnamed and search.floor.may_be(quiet * search.rms(search.root))
    noise = unnamed and (measured or _is_noise(search, quiet, explained, mode))
    noise = noise and (measured or share < LEAST_EXPLAINED)
    if fault and (noise or cured):
        return Verdict("recording-fault", fault.sentence)
    if noise:
        beside = _describe_beside(search, steady) + _describe_allowed_laws(search)
        rest = "no force at any port explains any of the rest"
        if measured:
            rest = "the rest is as large as the noise"
        elif slow:
            rest = "the rest is slow noise: hardly any force explains its changes from sample to sample"
        return Verdict(
            "complete",
            f"Nothing is missing{beside}: {_describe_refit(search)}, the simulator follows the recordings to "
            f"{percent(off)} of the outputs' deviation, and {rest}.",
        )
    closest = closest_hypothesis(search, closest) or found.best
    return Verdict("unexplained", _describe_unexplained(search, closest, shares, mode))


def _describe_beside(search: Hypotheses, tones: Sequence[Gate]) -> str:
    """Describe the steady tones and the fitted offsets, beside which nothing is missing."""
    steady = f"a steady tone in {in_words([g.channel for g in tones])}" if tones else ""
    found = list(filter(None, (steady, search.offsets)))
    return f" but {in_words(found)}" if found else ""


def _describe_refit(search: Hypotheses) -> str:
    """Say that the simulator was refitted, and with which offsets."""
    return f"refitted with {search.offsets}" if search.offsets else "refitted"


def closest_hypothesis(search: Hypotheses, chosen: Trial | None = None) -> Trial | None:
    """Return the hypothesis with effects that an unexplained mismatch is compared with, None if there is none.

    It is the one chosen as the correction, or else the most promising: the likeliest one may explain nothing, because
    few samples count where all hypotheses are wrong, and the smallest claim is then refuted least.
    """
    if chosen is not None and chosen.effects:
        return chosen
    return max((t for t in search.memo.values() if t.effects), key=search.optimistic_evidence, default=None)


def _is_noise(search: Hypotheses, quiet: float, explained: bool, mode: float | None) -> bool:
    """Tell whether the refit's residual can be noise: not explained, no mode rings, and its power is steady.

    `quiet` is the share of its rms that is left without steady tones.
    """
    times = quiet * times_of_noise(search)
    if times < AT_NOISE_RATIO:
        return True
    if mode is not None or search.is_driven:
        return False
    if search.floor.source != "estimated":
        return times < ABOVE_NOISE and not explained
    near = quiet**2 * search.root.mean_square < ABOVE_NOISE**2 * search.floor2
    return (near and times < WHITE_NOISE_RATIO) or (not explained and may_be_coloured_noise(search, quiet))


def _describe_effects(search: Hypotheses, found: Posterior) -> str:
    """Name the effects, those with a sure name first."""
    sure, unsure = (
        in_words([e.words for e in found.effects if (e.confidence > SURE) is known]) for known in (True, False)
    )
    names_are = "names are" if " and " in unsure else "name is"
    placed = all(e.confidence > SURE or e.at_port > SURE for e in found.effects)
    there = in_words(list(dict.fromkeys(e.element.port for e in found.effects if not e.confidence > SURE)))
    certain = f"not certain, only that something acts at {there}" if placed else "not certain"
    if not unsure:
        sentence = f"The simulator leaves out {sure}."
    elif not sure:
        the = "these" if " and " in unsure else "the"
        sentence = f"The simulator most likely leaves out {unsure}; {the} {names_are} {certain}."
    else:
        these = "these" if " and " in unsure else "this"
        more = f"More acts beside that; the best guess is {unsure}, but {these} {names_are} {certain}."
        sentence = f"The simulator leaves out {sure}. {more}"
    return sentence + _describe_vanished(search, found)


def _describe_vanished(search: Hypotheses, found: Posterior) -> str:
    """Describe the simulator's own parameters that vanish beside the effects, which may replace them."""
    simulator = search.bench.simulator
    offsets = find_placed_offsets(simulator.elements)
    before, after = search.root.fitted.values, found.best.fitted.values
    gone = [k for k in simulator.parameters if k not in offsets and np.any(before[k]) and not np.any(after[k])]
    come = "come out as zero: they are replaced" if gone[1:] else "comes out as zero: it is replaced"
    return f" The simulator's own {' and '.join(gone)} {come}." if gone else ""


def _name_tried_laws(search: Hypotheses) -> str:
    """Name the laws that do not explain the mismatch; after the time limit, only those that were fitted."""
    if not search.out_of_time or search.tried >= search.selected:
        allowed = _list_allowed_laws(search)
        if allowed is None:
            return "no law of the catalogue"
        return f"none of the laws tried ({allowed})" if allowed else "no law (none was allowed)"
    pairs = f"{search.tried} of {search.selected} pairs of port and law"
    return f"none of the laws that were fitted before the time limit ({pairs})"


def _describe_failure(search: Hypotheses) -> str:
    """Say that no law explains the mismatch, or that none was fitted."""
    if len(search.memo) == 1 and not search.out_of_time and _list_allowed_laws(search) != "":
        why = "because all that is left may be noise" if search.most_effects else "as asked for"
        return f"no law was fitted, {why}"
    return f"{_name_tried_laws(search)} explains it"


def _list_allowed_laws(search: Hypotheses) -> str | None:
    """List the laws that were allowed; None if all of the catalogue were."""
    if {law.__name__ for law in search.laws} >= {law.__name__ for law in CATALOGUE}:
        return None
    return in_words(list(dict.fromkeys(display_name(law.id) for law in search.laws if law.id != "offset")))


def _describe_allowed_laws(search: Hypotheses) -> str:
    """Say which laws were tried, unless the whole catalogue was."""
    allowed = _list_allowed_laws(search)
    if allowed is None:
        return ""
    return f", as far as the laws tried can show ({allowed})" if allowed else ", though no law was allowed"


def _describe_partial_failure(search: Hypotheses, laws: int) -> str:
    """Say what failed to explain all of the mismatch; after the time limit, further effects may not have been tried."""
    if search.out_of_time and search.tried >= search.selected:
        effects = "one effect, which does" if laws == 1 else f"{laws} effects, which do"
        return f"the time limit ended the search after {effects} not explain all of it"
    return f"{_name_tried_laws(search)} explains all of it"


def _describe_far(search: Hypotheses, share: float, where: str, mode: float | None) -> str:
    """Describe a mismatch that no law comes near; a force at a port, `where`, explains the `share` of it."""
    estimated, rings, at = search.floor.source == "estimated", "", ""
    if mode:
        rings = (
            f" The rest swings at the simulator's own {mode:.3g} Hz, as from a force that was not recorded or a value "
            "that varies in time."
        )
    if share > LEAST_EXPLAINED:
        explained = f"{100 * share:.0f} % of the rest"
        at = f" A force at {where} could explain {explained}; it may also be one that was not recorded."
    large = estimated and share < LEAST_EXPLAINED and times_of_noise(search) < WHITE_NOISE_RATIO
    or_noise = ", or the noise is large and slow" if large and not mode else ""
    return (
        f"Physics is missing{or_noise}, and {_describe_failure(search)}. {capitalise(_describe_refit(search))}, the "
        f"simulator is off by {percent(search.bench.nrmse(search.root.fitted))} of the outputs' deviation; the noise "
        f"is {'at least' if estimated else 'about'} {percent(search.least_floor.nrmse(search.bench.scale))}.{at}{rings}"
    )


def _describe_unexplained(search: Hypotheses, closest: Trial, shares: dict[str, float], mode: float | None) -> str:
    """Describe the likeliest port of an unexplained mismatch, and how much of it the closest laws remove."""
    share, where = max(shares.values(), default=0.0), max(shares, key=lambda k: shares[k], default="")
    laws, left = closest.effects, share_left(search, closest.fitted, floor=search.least_floor)
    if not laws or 1 - left < LEAST_EXPLAINED:
        return _describe_far(search, share, where, mode)
    # a force at the laws' port explains what they remove, however little of it shows beside the linearised simulator
    there = max(shares.get(laws[0].port, 0.0), 1 - left)
    port = laws[0].port if there >= OTHER_PORT_SHARE * share else where
    # after the time limit, this may not be worth another minute
    looked = search.findings[closest.key].flexible is not None or not search.out_of_time
    rest = max(search.flexible(closest).values(), default=0.0) if looked else 0.0
    words = in_words([e.words for e in laws])
    named = f"laws, {words}, remove" if laws[1:] else f"law, {words}, removes"
    if left < FORMULA_ERROR:
        them, sure = ("they are", "names are") if laws[1:] else ("it is", "name is")
        return (
            f"Physics is missing, most likely at {port}. The closest {named} all of the mismatch on the training "
            f"recordings, down to the noise; but it is not sure that {them} the physics, so the {sure} not stated."
        )
    removed = f"{100 * (1 - left):.0f} %" if round(left, 2) else f"all but {100 * left:.1g} %"
    explained = ": nothing tried explains it" if looked else ""
    if rest > LEAST_EXPLAINED:
        explained = f": a force at a port explains {100 * rest:.0f} % of it"
    return (
        f"Physics is missing, most likely at {port}, and {_describe_partial_failure(search, len(laws))}. The closest "
        f"{named} {removed} of the mismatch on the training recordings. The rest is not noise{explained}."
    )
