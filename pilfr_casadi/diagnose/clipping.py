"""Channels that the recorder clipped: an output's simulation can be clipped alike, an input is lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..data import Recording
from ..laws import AsymmetricSaturation
from .gates import Gate, refit
from .linearise import linearised
from .remainder import folds, followed, held_out, moved
from .stale import stretches
from .workbench import Fitted, Workbench

HALF = 0.5  # of the mismatch, that what lies beyond a limit leaves at most


def unclip(bench: Workbench, plain: Fitted) -> tuple[Workbench, Fitted, list[Gate]]:
    """Outputs that the recorder clipped: the simulator's are clipped alike, and what else they say is kept."""
    gates = []
    for i, low, high, count in clipped(bench.recordings, "y"):
        name = bench.simulator.output_names[i]
        law = AsymmetricSaturation().at({"low": max(low, -1e300), "high": min(high, 1e300)})
        placed = bench.simulator.with_element(f"sensor:{name}", law)
        prefix = placed.elements[-1].prefix
        held = {k: replace(p, fixed=True) if k.startswith(prefix) else p for k, p in placed.parameters.items()}
        other = replace(bench, simulator=placed.with_parameters(held))
        found = refit(other, plain)
        if found is None or found.cost > min(0.97 * plain.cost, 0.3):
            continue
        at = " and ".join(f"{v:.6g}" for v in _said(low, high))
        sentence = (
            f"{name} is clipped at {at} ({count} samples at the limit); with the simulator's output clipped alike the "
            f"refitted error falls from {plain.cost**0.5:.3g} to {found.cost**0.5:.3g} of the outputs' deviation."
        )
        gates.append(Gate(name, "clipping", _said(low, high), sentence, True, fault=True, left=found.cost / plain.cost))
        bench, plain = other, found
    return bench, plain, gates


def clipped_input(bench: Workbench, without: Fitted, remains: float) -> Gate | None:
    """The clipped input beyond whose limits most of the mismatch lies, where no law leaves less (`remains`) of it.

    What went into the machine there is not in the recording; what goes on as smoothly stands for it (`_beyond_limit`).
    """
    for i, low, high, count in clipped(bench.recordings, "u"):
        name = bench.simulator.inputs[i]
        left = 1 - _explained(bench, without, i, low, high)
        if left < min(HALF, remains):
            at = " and ".join(f"{v:.6g}" for v in _said(low, high))
            sentence = (
                f"{name} is clipped at {at} ({count} samples at the limit), and what it may have been beyond explains "
                f"{1 - left:.0%} of the mismatch: what went into the machine there is not in the recording. Record it "
                "with a larger range."
            )
            return Gate(name, "clipping", _said(low, high), sentence, False, fault=True)
    return None


def _explained(bench: Workbench, without: Fitted, i: int, low: float, high: float) -> float:
    """Share of the error that input i beyond its limits explains, on blocks that it was not fitted to."""
    probe, runs = linearised(bench, without)
    port = probe.ports.index(f"actuator:{bench.simulator.inputs[i]}")
    skips = [r.skip for r in bench.recordings]
    limits = [(v, sign) for v, sign in ((low, -1.0), (high, 1.0)) if np.isfinite(v)]
    phi, error = [], []
    for run, r in zip(runs, bench.recordings, strict=True):
        beyond = np.column_stack([sign * _beyond_limit(r.u[:, i], v) for v, sign in limits])
        phi.append(moved(bench, run, [(port, beyond)], r.skip)[:, -len(limits) :])
        error.append((run.error / bench.scale)[r.skip :].ravel())
    base = followed(bench, runs, skips)
    left, columns = np.concatenate(error), np.concatenate(phi)
    left = left - base @ (base.T @ left)
    columns = columns - base @ (base.T @ columns)
    if np.any(np.linalg.lstsq(columns, left, rcond=1e-8)[0] > 0):  # it would have been within the limit
        return 0.0
    return held_out(columns, left, folds(len(left), len(runs)))


def _beyond_limit(u: np.ndarray, limit: float) -> np.ndarray:
    """How far a signal may have been beyond a limit: the cubic that leaves and comes back with its slopes around it."""
    out, rise = np.zeros(len(u)), np.abs(np.diff(u, prepend=u[0], append=u[-1]))
    for begin, end in stretches(u == limit):  # the step to the limit is cut short, the one before it may be
        leaves, back = np.max(rise[max(begin - 1, 0) : begin + 1]), np.max(rise[end : end + 2])
        t = (np.arange(end - begin) + 0.5) / (end - begin)
        out[begin:end] = (end - begin) * t * (1 - t) * (leaves * (1 - t) + back * t)
    return out


def _said(low: float, high: float) -> list[float]:
    """The limits that there are."""
    return [v for v in (low, high) if np.isfinite(v)]


def clipped(recordings: Sequence[Recording], kind: str) -> list[tuple[int, float, float, int]]:
    """Channels whose extremes are repeated exactly over several samples: (column, low, high, samples at the limits).

    `kind` is "u" for the inputs, "y" for the outputs.
    """
    out = []
    for i in range(getattr(recordings[0], kind).shape[1]):
        y = np.concatenate([getattr(r, kind)[:, i] for r in recordings])
        limits, count = [-np.inf, np.inf], 0
        for j, extreme in enumerate((y.min(), y.max())):
            at = y == extreme
            runs = np.diff(stretches(at)).ravel()
            neighbours = np.mean(np.abs(np.diff(y)) == 0)
            if (
                at.sum() >= 6
                and runs.max(initial=0) >= 3
                and np.sum(runs > 1) > 1
                and at.mean() > 3 * _quantised(y)
                and neighbours < 0.5
            ):
                limits[j], count = float(extreme), count + int(at.sum())
        if count:
            out.append((i, limits[0], limits[1], count))
    return out


def _quantised(y: np.ndarray) -> float:
    """Share of samples at a typical level of a quantised signal near its extremes; 0 for a continuous one."""
    values, counts = np.unique(y, return_counts=True)
    if len(values) > 0.5 * len(y):
        return 0.0
    return float(np.median(np.concatenate([counts[1:6], counts[-6:-1]])) / len(y))
