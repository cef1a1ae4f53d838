"""Scores of diagnoses of concealed and stress cases, and their summary beside the targets.

The first rows of the summary judge the first name of an answer, as they always did. The others judge every effect
(recall and precision over all of them), the kind of a fault together with its channel, values and loads, the corrected
simulator, and whether an answer as a whole is right. A percentage stands with its 95 % interval (Wilson 1927); that of
recall and precision takes the effects of one case for independent.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .concealed_case import Case, Finding

Array = np.ndarray
KINDS_OF_CASES = ("one", "two", "three", "none", "outside", "fault", "value", "load", "undeclared")
Z = 1.959964  # standard errors of a 95 % interval
MOST_SURE = 0.999  # confidence beyond which the log loss grows no further
SURE = 0.8  # a name given with more confidence than this to an effect outside the catalogue is an error


@dataclass(frozen=True)
class Score:
    """How one diagnosis did; `port`, `law`, `both` are None where the case has nothing to name."""

    seed: int
    name: str
    kind: str
    expected: str
    verdict: str
    truth: str
    named: str
    verdict_right: bool
    port: bool | None
    law: bool | None
    both: bool | None
    spurious: bool
    false_alarm: bool | None
    sure_outside: bool | None
    channel: bool | None
    confidence: float | None
    right: bool
    ratio: float | None
    seconds: float = 0.0
    crash: str = ""
    effects: int = 0  # that are there
    found: int = 0  # of these
    names: int = 0  # that were given
    names_right: int = 0
    certainties: Sequence[Sequence[float]] = ()  # (confidence, 1 where right) of each name
    fault_kind: bool | None = None  # None where there is no fault
    finding: bool | None = None  # kind and channel of everything that has to be told
    wrong_fault: bool = False  # recording-fault where nothing of that kind is at fault
    parameter: bool | None = None
    sure_wrong: bool = False
    answer: bool = False  # the whole answer is right
    over_floor: float | None = None  # test error of the corrected simulator over the least possible
    over_refit: float | None = None  # the same over that of the refit
    tags: Sequence[str] = ()


def kind_of(case: Case) -> str:
    """One of the kinds of cases, `KINDS` and those of the stress sets."""
    return next(k for k in KINDS_OF_CASES if k in case.tags)


@dataclass(frozen=True)
class _Names:
    """The names of an answer against the effects of a case."""

    pairs: list[tuple[str, str]]
    confidences: list[float]
    hits: list[bool]
    matched: int

    @property
    def sure_wrong(self) -> bool:
        return any(c > SURE and not hit for c, hit in zip(self.confidences, self.hits, strict=True))


def _names(case: Case, diagnosis: Mapping[str, Any]) -> _Names:
    """Match each name with the first effect that accepts it; a name of an optional finding is right too."""
    effects = list(diagnosis.get("effects", ()))
    pairs = [(str(e["port"]), str(e["law"])) for e in effects]
    matched: set[int] = set()
    hits = []
    for port, law in pairs:
        hit = next((i for i, a in enumerate(case.accepted) if i not in matched and (port, law) in a), None)
        if hit is not None:
            matched.add(hit)
        hits.append(hit is not None or any(_told(f, port, law) for f in case.findings))
    return _Names(pairs, [float(e["confidence"]) for e in effects], hits, len(matched))


def _told(finding: Finding, channel: str, kind: str) -> bool:
    """Whether this is the finding; channels may be several, and ports stand for their channels."""
    told = {part for name in channel.split(", ") for part in (name, name.split(":", 1)[-1])}
    return kind in finding.kinds and bool(told & finding.channels)


def _findings(case: Case, diagnosis: Mapping[str, Any], names: _Names) -> list[bool]:
    """Whether each finding that has to be told is told, by a gate or by a name."""
    told = [(str(g.get("channel")), str(g.get("finding"))) for g in diagnosis.get("gates", ())] + names.pairs
    return [any(_told(f, *t) for t in told) for f in case.findings if f.needed]


def _parameter_named(case: Case, diagnosis: Mapping[str, Any]) -> bool:
    """Whether one of the case's parameters is said to be wrong: by the answer's sentence, or by that of a gate."""
    gates = [f"{g.get('channel')} {g.get('sentence', '')}" for g in diagnosis.get("gates", ())]
    words = set(re.findall(r"\w+", " ".join([str(diagnosis.get("sentence", "")), *gates])))
    return bool(words & case.parameters)


def _answer_right(
    case: Case, kind: str, verdict: str, names: _Names, findings: Sequence[bool], parameter: bool | None
) -> bool:
    """Whether everything of an answer is right."""
    if kind == "value":  # a spring or damper beside a wrong one is the same as another value
        return (bool(parameter) or any(names.hits)) and not names.sure_wrong
    if verdict != case.verdict and verdict not in case.also:
        return False
    if kind == "undeclared":  # the effect in the equation of a state, or a note that says where it is
        return (names.matched > 0 and all(names.hits)) or (any(findings) and not names.sure_wrong)
    if kind == "outside":
        return not names.sure_wrong
    complete = names.matched == len(case.accepted) and all(names.hits)
    return complete and all(findings) and parameter is not False


def score(case: Case, diagnosis: Mapping[str, Any], seconds: float = 0.0, crash: str = "") -> Score:
    """Judge the dict of a `diagnosis.json`; an empty one is a crash and counts as wrong."""
    verdict = str(diagnosis.get("verdict", "crash"))
    names, kind = _names(case, diagnosis), kind_of(case)
    pairs, hits = names.pairs, names.hits
    nameable = bool(case.truth)
    ports = {p for a in case.accepted for p, _ in a}
    confidence = names.confidences[0] if pairs else None
    found = {name for g in diagnosis.get("gates", ()) for name in str(g.get("channel")).split(", ")}
    errors = (diagnosis.get("fit") or {}).get("test") or {}
    after, before = errors.get("after"), errors.get("before")
    over_floor = float(after) / case.floor if after is not None and np.isfinite(after) else np.inf
    over_refit = float(after) / float(before) if after is not None and before else None
    verdict_right = verdict == case.verdict or verdict in case.also
    findings = _findings(case, diagnosis, names)
    faulty = kind in ("fault", "load")
    kinds = {k for f in case.findings for k in f.kinds}
    fault_kind = any(g.get("finding") in kinds for g in diagnosis.get("gates", ()))
    fault_kind = fault_kind or any(law in kinds for _, law in pairs)
    parameter = _parameter_named(case, diagnosis) if case.parameters else None
    return Score(
        case.seed,
        case.name,
        kind,
        case.verdict,
        verdict,
        " + ".join(f"{t['port']} {t['law']}" for t in case.truth),
        " + ".join(f"{p} {law}" for p, law in pairs),
        verdict_right,
        (bool(pairs) and pairs[0][0] in ports) if nameable else None,
        (bool(hits) and hits[0]) if nameable else None,
        (names.matched == 2) if kind == "two" else None,
        nameable and any(not h for h in hits[1:]),
        (verdict != "complete") if kind == "none" else None,
        (bool(pairs) and not hits[0] and (confidence or 0) > SURE) if kind == "outside" else None,
        (verdict_right and bool(found & case.channels)) if kind == "fault" else None,
        confidence,
        bool(hits) and hits[0],
        over_floor if nameable else None,
        seconds,
        crash,
        len(case.truth),
        names.matched if case.truth else 0,
        len(pairs),
        sum(hits),
        [(c, float(hit)) for c, hit in zip(names.confidences, hits, strict=True)],
        fault_kind if faulty else None,
        all(findings) if findings else None,
        verdict == "recording-fault" and not fault_kind,
        parameter,
        names.sure_wrong,
        _answer_right(case, kind, verdict, names, findings, parameter),
        None if kind == "fault" else over_floor,
        over_refit,
        sorted(case.tags),
    )


def line(s: Score) -> str:
    """One line a case."""
    marks = "".join(
        letter if ok else letter.lower() if ok is not None else "."
        for letter, ok in (("V", s.verdict_right), ("P", s.port), ("L", s.law), ("B", s.both), ("C", s.channel))
    )
    extra = " SPURIOUS" if s.spurious else ""
    extra += " SURE" if s.sure_outside else ""
    sure = f"{s.confidence:.2f}" if s.confidence is not None else "  - "
    ratio = f"{s.ratio:7.2f}" if s.ratio is not None else "      -"
    answer = s.crash or (s.named if s.verdict == "missing-physics" else f"{s.verdict} {s.named}".strip())
    return f"{s.name:44.44} {marks} {sure} {ratio} {s.seconds:5.1f} s  {s.truth or s.expected}  ->  {answer}{extra}"


def wilson(share: float, n: int) -> tuple[float, float]:
    """95 % interval of a share of n independent trials (Wilson 1927)."""
    if not n:
        return float("nan"), float("nan")
    middle = (share + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * float(np.sqrt(share * (1 - share) / n + Z**2 / (4 * n**2)))
    return max(0.0, middle - half), min(1.0, middle + half)


def _share(values: Sequence[bool | None]) -> tuple[float, int]:
    known = [v for v in values if v is not None]
    return (float(np.mean(known)) if known else float("nan")), len(known)


def _row(name: str, share: float, n: int, rest: str = "") -> str:
    low, high = wilson(share, n)
    return f"{name:34}{100 * share:7.1f}%{n:7d} {f'[{100 * low:.1f}, {100 * high:.1f}]':>14}  {rest}".rstrip()


def _first_names(scores: Sequence[Score]) -> list[str]:
    """Rows about verdict and first name, beside their targets."""
    rows = [
        ("verdict right", _share([s.verdict_right for s in scores]), ">= 97 %", 0.97, 1),
        ("port right (nameable)", _share([s.port for s in scores]), ">= 97 %", 0.97, 1),
        ("law right (nameable)", _share([s.law for s in scores]), ">= 93 %", 0.93, 1),
        ("both effects named", _share([s.both for s in scores]), ">= 60 %", 0.60, 1),
        ("spurious second effect", _share([s.spurious for s in scores if s.law is not None]), "0 %", 0.0, -1),
        ("false alarms (nothing missing)", _share([s.false_alarm for s in scores]), "<= 1 %", 0.01, -1),
        ("outside, named surely (> 0.8)", _share([s.sure_outside for s in scores]), "0 %", 0.0, -1),
        ("fault: verdict and channel", _share([s.channel for s in scores]), "", float("nan"), 1),
    ]
    out = []
    for name, (share, n), target, limit, sign in rows:
        verdict = "" if not n or np.isnan(limit) else "  met" if sign * (share - limit) >= 0 else "  MISSED"
        out.append(_row(name, share, n, target + verdict))
    return out


def every_effect(scores: Sequence[Score]) -> list[str]:
    """Rows about every effect, faults, values, and whole answers."""
    there, named = sum(s.effects for s in scores), sum(s.names for s in scores if s.effects)
    found, hits = sum(s.found for s in scores), sum(s.names_right for s in scores if s.effects)
    several = [s.found == s.effects for s in scores if s.effects > 1]
    rows = [
        ("whole answer right", _share([s.answer for s in scores])),
        ("effects named (recall)", (found / there if there else float("nan"), there)),
        ("names right (precision)", (hits / named if named else float("nan"), named)),
        ("all of several effects named", _share(several)),
        ("fault: kind right", _share([s.fault_kind for s in scores])),
        ("kind and channel told", _share([s.finding for s in scores])),
        ("called a fault of a wrong kind", _share([s.wrong_fault for s in scores])),
        ("wrong value named", _share([s.parameter for s in scores])),
        ("a sure name wrong (> 0.8)", _share([s.sure_wrong for s in scores])),
        ("left unexplained", _share([s.verdict == "unexplained" for s in scores if s.kind != "outside"])),
        ("corrected within 1.3 of the floor", _share([_below(s.over_floor, 1.3) for s in scores])),
        ("corrected worse than the refit", _share([_above(s.over_refit, 1.001) for s in scores])),
    ]
    out = [_row(name, share, n) for name, (share, n) in rows if n]
    for name, values in (
        ("median corrected / floor", [s.over_floor for s in scores if s.over_floor is not None]),
        ("median corrected / refit", [s.over_refit for s in scores if s.over_refit is not None]),
    ):
        if values:
            out.append(f"{name:34}{np.median(values):8.2f}{len(values):7d}")
    return out


def _below(value: float | None, limit: float) -> bool | None:
    return None if value is None else value <= limit


def _above(value: float | None, limit: float) -> bool | None:
    return None if value is None else value > limit


def brier(certainty: Array, right: Array) -> float:
    """Mean square of confidence less truth (Brier 1950)."""
    return float(np.mean((certainty - right) ** 2))


def log_loss(certainty: Array, right: Array) -> float:
    """Mean of minus the logarithm of the probability given to the truth; a certainty counts as 0.999."""
    p = np.clip(certainty, 1 - MOST_SURE, MOST_SURE)
    return float(-np.mean(right * np.log(p) + (1 - right) * np.log(1 - p)))


def reliability(certainty: Array, right: Array) -> list[str]:
    """Table of confidence against the share of names that are right."""
    out = ["confidence     cases   mean   right"]
    for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.9), (0.9, 0.97), (0.97, 1.01)):
        inside = (certainty >= low) & (certainty < high)
        if inside.any():
            share, n = float(right[inside].mean()), int(inside.sum())
            between = "[{:.2f}, {:.2f}]".format(*wilson(share, n))
            out.append(
                f"{low:4.2f} - {min(high, 1):4.2f} {n:8d} {certainty[inside].mean():6.2f} {share:7.2f}  {between}"
            )
    return out


def summary(scores: Sequence[Score]) -> str:
    """Print the table of targets, calibration, and confusions."""
    out = [f"{'':34}{'share':>8}{'cases':>7} {'95 %':>14}  target", *_first_names(scores)]
    sure = [(s.confidence, s.right) for s in scores if s.confidence is not None]
    if sure:
        c, r = np.array(sure, dtype=float).T
        met = "met" if brier(c, r) <= 0.05 else "MISSED"
        out.append(f"{'Brier score of the confidence':34}{brier(c, r):8.3f}{len(c):7d}  <= 0.05  {met}")
        out.append(f"{'log loss of the confidence':34}{log_loss(c, r):8.3f}{len(c):7d}")
    ratios = [s.ratio for s in scores if s.ratio is not None]
    if ratios:
        ratio = float(np.median(ratios))
        met = "met" if ratio <= 1.3 else "MISSED"
        out.append(f"{'median test error after / floor':34}{ratio:8.2f}{len(ratios):7d}  <= 1.3  {met}")
    times = [s.seconds for s in scores]
    out.append(f"{'time a case, median / largest, s':34}{np.median(times):8.1f}{max(times):7.1f}")
    out.append(f"{'crashes':34}{sum(bool(s.crash) for s in scores):8d}")
    out += ["", "every effect and the whole answer", *every_effect(scores)]
    every = [pair for s in scores for pair in s.certainties]
    if every:
        c, r = np.array(every, dtype=float).T
        out.append(f"{'Brier score of every name':34}{brier(c, r):8.3f}{len(c):7d}")
        out.append(f"{'log loss of every name':34}{log_loss(c, r):8.3f}{len(c):7d}")
    if sure:
        out += ["", *reliability(*np.array(sure, dtype=float).T)]
    wrong = Counter(
        (s.truth or s.kind, s.named or s.verdict) for s in scores if (s.law is False or not s.verdict_right)
    )
    if wrong:
        out += ["", "confusions (truth -> answer)"]
        out += [f"{n:4d}  {a}  ->  {b}" for (a, b), n in wrong.most_common(40)]
    verdicts = Counter((s.expected, s.verdict) for s in scores)
    out += ["", "verdicts (expected -> given)"]
    out += [f"{n:4d}  {a:16} ->  {b}" for (a, b), n in sorted(verdicts.items())]
    return "\n".join(out)
