"""Laws that the screen did not let through and that what came out best asks for.

A resonance whose frequency is found at the wrong port is found at the right one from there: a small mass that is
carried along is felt in a narrow band, between whose neighbours on the grid the screen may miss it. A damped resonance,
too, slips between the lightly damped ones of the grid; the delay or the lag that comes near in its place says at which
frequency it would be as late. What takes time, such as a delay, looks alike before and behind a simulator that is
nearly linear: it is put up at the other end. And a law with one more term than one that came near is no worse: where it
came out so, it was started elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..laws import Attached, Delay, Lag, Resonance
from ..simulators import in_series
from .candidate import Candidate
from .kinship import CONTAINS
from .screen import Scored

AHEAD = 1.5  # times the best error beyond which a carried mass, or a special case, is worth another start
BEHIND = 3.0  # times the best error of a delay or a lag that may stand for a resonance
NEARLY = 1.25  # times the best error of a law that one with one more term may go on from
DAMPED = (0.25, 0.6)  # damping ratios of the resonances tried in its place


def passed_over(candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """Pairs of port and law to be fitted as well; candidates and what was scored are best first."""
    if not candidates:
        return []
    best, tried = candidates[0], {(c.port, type(c.law)) for c in candidates}
    near = {(c.port, type(c.law)) for c in candidates if c.error < AHEAD * best.error}
    other = [s for s in scored if s.port == best.port and (s.port, type(s.law)) not in near]
    # a special case of what came out best may have been left where a few steps led
    chosen = [type(s.law) for s in other if s.law.id in CONTAINS.get(best.law.id, ())]
    other = [s for s in other if (s.port, type(s.law)) not in tried or type(s.law) in chosen]
    other_ways = (_carried, _late, _other_end, _refined)
    more = [entry for way in other_ways for entry in way(candidates, scored)]
    return [*(s for s in other if type(s.law) in chosen), *more]


def _carried(candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """Carried masses at every port where none came near, from the frequency and damping of the best resonance."""
    best = candidates[0]
    if not {"W", "D"} <= set(best.law.units) or isinstance(best.law, Attached):
        return []
    found = {k: float(np.ravel(best.own[k])[0]) for k in ("W", "D")}
    near = {c.port for c in candidates if isinstance(c.law, Attached) and c.error < AHEAD * best.error}
    out: dict[str, Scored] = {}
    for s in scored:
        if isinstance(s.law, Attached) and s.port not in near and s.port not in out:
            out[s.port] = replace(s, starts=(*({**start, **found} for start in s.starts), *s.starts))
    return list(out.values())


def _late(candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """Damped resonances where a delay or a lag of T came near: at low frequencies they are 2 D / W late."""
    late: dict[str, float] = {}
    for c in candidates:
        if isinstance(c.law, Delay | Lag) and c.error < BEHIND * candidates[0].error and c.port not in late:
            late[c.port] = float(np.ravel(c.own["T"])[0])
    out: dict[tuple[str, type], Scored] = {}
    for s in scored:
        key = s.port, type(s.law)
        if isinstance(s.law, Resonance) and s.port in late and key not in out:
            found = [{"W": 2 * damping / late[s.port], "D": damping} for damping in DAMPED]
            out[key] = replace(s, starts=(*({**start, **w} for start in s.starts[:1] for w in found), *s.starts[:1]))
    return list(out.values())


def _other_end(candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """The best law of a signal that takes time, at every actuator and sensor where it did not come near."""
    best = candidates[0]
    if not in_series(best.port) or not (best.law.order or best.law.shifts):
        return []
    times = [k for k, unit in best.law.units.items() if unit in ("s", "rad/s", "")]
    found = {k: float(np.ravel(best.own[k])[0]) for k in times}
    near = {c.port for c in candidates if type(c.law) is type(best.law) and c.error < AHEAD * best.error}
    out: dict[str, Scored] = {}
    for s in scored:
        if type(s.law) is type(best.law) and in_series(s.port) and s.port not in near and s.port not in out:
            out[s.port] = replace(s, starts=(*({**start, **found} for start in s.starts), *s.starts))
    return list(out.values())


def _refined(candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """Laws that came near with one more term, where that came out worse: from their values."""
    best = candidates[0]
    least = {(c.port, type(c.law)): c.error for c in reversed(candidates)}
    out: dict[tuple[str, type], Scored] = {}
    for c in candidates:
        wider = [s for s in scored if s.port == c.port and type(s.law) is not type(c.law)]
        for s in wider if c.error < NEARLY * best.error else ():
            key = s.port, type(s.law)
            if isinstance(s.law, type(c.law)) and least.get(key, 0.0) > c.error and key not in out:
                start = s.law.starts_as(c.law, c.own)
                out |= {key: replace(s, starts=(start,))} if start else {}
    return list(out.values())
