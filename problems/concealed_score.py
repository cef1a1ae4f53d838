"""Scores of diagnoses of concealed cases, and their summary beside the targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .concealed_case import Case

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


def kind_of(case: Case) -> str:
    """One of the kinds of `concealed_case.KINDS`."""
    return next(k for k in ("one", "two", "none", "outside", "fault") if k in case.tags)


def score(case: Case, diagnosis: Mapping[str, Any], seconds: float = 0.0, crash: str = "") -> Score:
    """Judge the dict of a `diagnosis.json`; an empty one is a crash and counts as wrong."""
    verdict = str(diagnosis.get("verdict", "crash"))
    effects = list(diagnosis.get("effects", ()))
    pairs = [(str(e["port"]), str(e["law"])) for e in effects]
    kind = kind_of(case)
    matched: set[int] = set()
    hits = []
    for pair in pairs:
        hit = next((i for i, a in enumerate(case.accepted) if i not in matched and pair in a), None)
        hits.append(hit is not None)
        if hit is not None:
            matched.add(hit)
    nameable = bool(case.accepted)
    ports = {p for a in case.accepted for p, _ in a}
    confidence = float(effects[0]["confidence"]) if effects else None
    found = {name for g in diagnosis.get("gates", ()) for name in str(g.get("channel")).split(", ")}
    after = ((diagnosis.get("fit") or {}).get("test") or {}).get("after")
    right = bool(hits) and hits[0]
    return Score(
        case.seed,
        case.name,
        kind,
        case.verdict,
        verdict,
        " + ".join(f"{t['port']} {t['law']}" for t in case.truth),
        " + ".join(f"{p} {law}" for p, law in pairs),
        verdict == case.verdict,
        (bool(pairs) and pairs[0][0] in ports) if nameable else None,
        right if nameable else None,
        (len(matched) == 2) if kind == "two" else None,
        nameable and any(not h for h in hits[1:]),
        (verdict != "complete") if kind == "none" else None,
        (bool(pairs) and (confidence or 0) > SURE) if kind == "outside" else None,
        (verdict == "recording-fault" and bool(found & case.channels)) if kind == "fault" else None,
        confidence,
        right,
        (float(after) / case.floor if after is not None and np.isfinite(after) else np.inf) if nameable else None,
        seconds,
        crash,
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


def _share(values: Sequence[bool | None]) -> tuple[float, int]:
    known = [v for v in values if v is not None]
    return (float(np.mean(known)) if known else float("nan")), len(known)


def summary(scores: Sequence[Score]) -> str:
    """Print the table of targets, calibration, and confusions."""
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
    out = [f"{'':34}{'share':>8}{'cases':>7}  target"]
    for name, (share, n), target, limit, sign in rows:
        verdict = "" if not n or np.isnan(limit) else "  met" if sign * (share - limit) >= 0 else "  MISSED"
        out.append(f"{name:34}{100 * share:7.1f}%{n:7d}  {target}{verdict}")
    sure = [(s.confidence, s.right) for s in scores if s.confidence is not None]
    if sure:
        c, r = np.array(sure, dtype=float).T
        brier = float(np.mean((c - r) ** 2))
        met = "met" if brier <= 0.05 else "MISSED"
        out.append(f"{'Brier score of the confidence':34}{brier:8.3f}{len(c):7d}  <= 0.05  {met}")
    ratios = [s.ratio for s in scores if s.ratio is not None]
    if ratios:
        ratio = float(np.median(ratios))
        met = "met" if ratio <= 1.3 else "MISSED"
        out.append(f"{'median test error after / floor':34}{ratio:8.2f}{len(ratios):7d}  <= 1.3  {met}")
    times = [s.seconds for s in scores]
    out.append(f"{'time a case, median / largest, s':34}{np.median(times):8.1f}{max(times):7.1f}")
    out.append(f"{'crashes':34}{sum(bool(s.crash) for s in scores):8d}")
    if sure:
        out += ["", "confidence     cases   mean   right"]
        for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.9), (0.9, 0.97), (0.97, 1.01)):
            inside = (c >= low) & (c < high)
            if inside.any():
                means = f"{c[inside].mean():6.2f} {r[inside].mean():7.2f}"
                out.append(f"{low:4.2f} - {min(high, 1):4.2f} {inside.sum():8d} {means}")
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
