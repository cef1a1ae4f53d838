"""The verdict in words, from the posterior, the checks of the recordings, and the remainder of the refit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..laws import display_name
from .floor import swells_with, white_part
from .gates import Gate
from .posterior import Posterior
from .proof import mean_nrmse
from .recording_faults import ringing
from .search import Search
from .trials import Trial

AT_FLOOR = 1.15  # ratio to the noise that counts as at the noise
# largest ratio of noise to a measured floor; to an estimated floor; to that if no force explains the noise
QUANTISED, SOMEWHAT, COLOURED = 2.0, 4.0, 9.0
LOUD, SILENT = 0.05, 0.01  # largest coloured noise over the deviation, and the share of it that a force may explain
QUIET, CHANCE = 0.01, 0.05  # the same for noise too small to matter: a force explains that much by chance
HINT = 0.1  # least share of a residual that a flexible force has to explain to count
CURES = 1e-3  # share of the mean square left by a fault's correction below which the fault was the mismatch
HALVED = 3.0  # least ratio of errors by which an effect improves on a corrected fault, to be named instead
AS_NEAR = 1.5  # ratio to a surrogate's own error within which nothing can be said
SURE = 0.5  # confidence above which a name is stated without reservation


@dataclass(frozen=True)
class Verdict:
    """One of the four verdicts, and its sentence."""

    kind: str
    sentence: str


def judge(search: Search, found: Posterior, gates: Sequence[Gate], closest: Trial | None = None) -> Verdict:
    """Choose the verdict: a fault if it was the mismatch, else the likeliest answer of the posterior.

    `closest` is the hypothesis that an unexplained mismatch is compared with, by default the likeliest one.
    """
    off = mean_nrmse(search.bench, search.root.fitted)
    if search.stand_in_error and off < AS_NEAR * search.stand_in_error:
        return Verdict(
            "complete",
            "Nothing is seen that the simulation lacks: refitted, what stands for it follows the recordings to "
            f"{off:.3g} of the outputs' deviation, and the simulation itself to {search.stand_in_error:.3g}.",
        )
    faults = [g for g in gates if g.fault]
    cured = min((g.left for g in faults), default=1.0) < CURES
    if cured and search.root.whole < HALVED**2 * found.best.whole:  # beside the fault, an effect is negligible
        return Verdict("recording-fault", faults[0].sentence)
    if found.effects and found.named > 0.5:
        return Verdict("missing-physics", _describe_effects(search, found))
    opened = search.flexible(search.root)
    still = max(opened.values(), default=0.0)
    hum = [g for g in gates if g.finding == "tone" and not found.effects]
    own = ringing(search.bench, search.root.fitted)
    noise = not found.effects and _is_noise(search, hum, still, own)
    if faults and (noise or cured or (still < HINT and not found.effects)):
        return Verdict("recording-fault", faults[0].sentence)
    if noise and still < HINT:
        beside = f" but a steady tone in {' and '.join(g.channel for g in hum)}" if hum else ""
        return Verdict(
            "complete",
            f"Nothing is missing{beside}: refitted, the simulator follows the recordings to {off:.3g} of the "
            "outputs' deviation, and no force at any port explains any of the rest.",
        )
    return Verdict(
        "unexplained", _describe_unexplained(search, closest if closest and closest.laws else found.best, opened, own)
    )


def _is_noise(search: Search, hum: Sequence[Gate], still: float, own: float | None) -> bool:
    """Tell whether the refit's residual can be noise: no force explains it, no mode rings, and its power is steady."""
    root = search.root
    quiet = root.error * max(1 - sum(1 - g.left for g in hum), 0.0) ** 0.5
    white = white_part(root.fitted.residual) if search.floor.source == "estimated" else search.floor.deviation
    times = quiet / float(np.sqrt(np.mean((white / search.bench.scale) ** 2)))
    if times < AT_FLOOR:
        return True
    unexplained = still < (CHANCE if root.whole < QUIET**2 else SILENT)
    if search.floor.source != "estimated":
        like = times < QUANTISED and unexplained
    else:
        like = times < SOMEWHAT or (times < COLOURED and unexplained and root.whole < LOUD**2)
    return like and own is None and not _swells(search)


def _swells(search: Search) -> bool:
    """Tell whether the residual's power follows the inputs, the outputs or their rates."""
    records = search.bench.recordings
    signals = [np.column_stack([r.u, r.y, np.gradient(r.y, axis=0)])[r.skip :] for r in records]
    rest = [e[r.skip :] for e, r in zip(search.root.fitted.residual, records, strict=True)]
    return swells_with(rest, signals)


def _describe_effects(search: Search, found: Posterior) -> str:
    words = " and ".join(f"{display_name(e.name[1])} at {e.name[0]}" for e in found.effects)
    if found.sure > SURE:
        said = f"The simulator leaves out {words}."
    else:
        said = f"The simulator most likely leaves out {words}; the name is not certain."
    return said + _describe_vanished(search, found)


def _describe_vanished(search: Search, found: Posterior) -> str:
    """Describe the simulator's own parameters that vanish beside the effects, which may replace them."""
    simulator = search.bench.simulator
    offsets = tuple(e.prefix for e in simulator.elements if e.law.id == "offset")
    names = [k for k in simulator.parameters if not k.startswith(offsets)]
    before, after = search.root.fitted.values, found.best.fitted.values
    gone = [k for k in names if np.any(before[k]) and not np.any(after[k])]
    beside = "them" if len(found.effects) > 1 else "it"
    return f" Beside {beside}, {' and '.join(gone)} {'come' if gone[1:] else 'comes'} out as zero." if gone else ""


def _describe_unexplained(search: Search, closest: Trial, opened: dict[str, float], own: float | None) -> str:
    root, still = search.root, max(opened.values(), default=0.0)
    where = max(opened, key=lambda k: opened[k], default="")
    laws = [e for e in closest.laws if e.law.id != "offset"]
    if not laws:
        rings = (
            f" The rest swings at the simulator's own {own:.3g} Hz, as from a force that was not recorded or a value "
            "that varies in time."
            if own
            else ""
        )
        at = f" A force at {where} could explain {still:.0%} of the rest." if still > HINT else ""
        noise = search.floor.nrmse(search.bench.scale)
        return (
            "Physics is missing, and no law of the catalogue explains it. The refitted simulator is off by "
            f"{100 * mean_nrmse(search.bench, root.fitted):.3g} % of the outputs' deviation; the noise is about "
            f"{100 * noise:.3g} %.{at}{rings}"
        )
    port = where if opened.get(laws[0].port, 0.0) < 0.5 * still else laws[0].port
    left = (closest.whole - search.floor2) / max(root.whole - search.floor2, 1e-300)
    rest = max(search.flexible(closest).values(), default=0.0)
    words = " and ".join(f"{display_name(e.law.id, e.law.form)} at {e.port}" for e in laws)
    named = f"laws, {words}, remove" if laws[1:] else f"law, {words}, removes"
    return (
        f"Physics is missing, most likely at {port}, and no law of the catalogue explains all of it. The closest "
        f"{named} {1 - left:.0%} of the mismatch on the training recordings. The rest is not noise: a force at a port "
        f"explains {rest:.0%} of it."
    )
