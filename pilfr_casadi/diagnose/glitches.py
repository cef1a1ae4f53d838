"""Gate of glitches: single samples of an output far off their neighbours, as from a lost bit or a loose contact.

A sample is told by its distance from the cubic through its four neighbours, against the distances nearby. With it
replaced by that cubic nothing around it stands out any more; around a step or a shock it does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Recording
from .gates import Gate

CUBIC = np.array([-1, 4, 0, 4, -1]) / 6  # through the neighbours at -2, -1, 1, 2
WIDTH = 12  # samples on either side that a distance is compared with
MOST, FAR, LARGE = 0.75, 12.0, 0.1  # of the distances nearby; times that quantile, and times the output's deviation
CLEAN = 0.12  # of a glitch, that distances around it reach at most once it is replaced
SHARE = 0.02  # of the samples that may be glitches
MAINLY = 0.5  # share of all squared distances beyond which they are a fault


def without_glitches(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Recordings with glitches replaced by what lies between their neighbours, and what is to be told."""
    gates = []
    for i, name in enumerate(recordings[0].outputs):
        places = [glitches(r.y[:, i])[0] for r in recordings]
        count = sum(map(len, places))
        if not count:
            continue
        off = [distances(r.y[:, i]) ** 2 for r in recordings]
        weight = sum(float(np.sum(d[k])) for d, k in zip(off, places, strict=True)) / float(np.sum(np.concatenate(off)))
        first = next(r.dt * k[0] for r, k in zip(recordings, places, strict=True) if len(k))
        sentence = (
            f"Single samples of {name} are far off their neighbours, as from glitches: {count}, the first at "
            f"t = {first:.6g} s. What lies between their neighbours is taken instead."
        )
        gates.append(Gate(name, "glitch", count, sentence, True, weight > MAINLY, mended))
    return (tuple(map(mended, recordings)) if gates else tuple(recordings)), gates


def mended(r: Recording) -> Recording:
    """The recording with each glitch of its outputs replaced by the cubic through its neighbours."""
    return r.with_(y=np.column_stack([glitches(column)[1] for column in r.y.T]))


def glitches(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of single samples far off their neighbours, shape (k,), and the output without them; few or none."""
    clean, found, deviation = np.array(y), np.zeros(0, dtype=int), float(np.std(y))
    while len(y) > 4 * WIDTH and len(found) < SHARE * len(y):
        d = distances(clean)
        more = [k for k in np.flatnonzero(np.abs(d) > LARGE * deviation) if _alone(clean, np.abs(d), int(k))]
        if not more:
            return np.sort(found), clean
        clean[more] -= d[more]
        found = np.append(found, more)
    return np.zeros(0, dtype=int), np.array(y)


def distances(y: np.ndarray) -> np.ndarray:
    """Distance of each sample from the cubic through its four neighbours; none at the ends."""
    d = np.zeros(len(y))
    d[2:-2] = y[2:-2] - np.convolve(y, CUBIC, mode="valid")
    return d


def _alone(y: np.ndarray, d: np.ndarray, k: int) -> bool:
    """Whether a sample stands out, and nothing around it does once it is replaced."""
    around = np.arange(max(k - WIDTH, 2), min(k + WIDTH + 1, len(y) - 2))
    near = np.abs(around - k) <= 2
    usual = float(np.quantile(d[around[~near]], MOST))
    if d[k] <= FAR * usual:
        return False
    whole = slice(max(k - 4, 0), min(k + 5, len(y)))
    other = np.array(y[whole])
    other[k - whole.start] -= distances(y)[k]
    return bool(np.max(np.abs(distances(other))) < CLEAN * d[k])
