"""Whether an input is repeated: what is held out proves nothing where what is kept has the same input.

In steady state the response to a repeated input repeats, so a model that has learnt one period by heart knows the next.
Two stretches of input are the same where their difference, root mean square, is at most `ALIKE` of their deviation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .recording import Recording

Array = np.ndarray

ALIKE = 0.02  # rms difference over deviation; a measured input is never quite the same
UNLIKE = 0.5  # the same beyond which an input has another period than is said, or none: noise alone gives 1.4
MOST = 2 / 3  # of a recording: the largest lag at which it is compared with itself


def repeats_itself(recording: Recording) -> bool:
    """Whether a recording's input repeats within it, as in steady periods or a sine."""
    m = len(recording) - recording.skip
    if recording.begins == "periodic" and recording.period and recording.period <= MOST * m:
        return True
    u = _scaled(recording.u[recording.skip :])
    if u is None:
        return False
    n = np.arange(m, 0, -1)
    power = np.concatenate([[0.0], np.cumsum(np.sum(u**2, axis=1))])
    apart = (power[-1] - power[:m] + power[m - np.arange(m)] - 2 * _products(u, u)[:m]) / n  # (1/n) Σ |u(t+p) - u(t)|²
    size = u.shape[1] * 1.0
    away = np.argmax(apart > size)  # a slow input is like itself a moment later: first it has to be unlike
    last = int(MOST * m)
    return bool(away and away < last and np.min(apart[away : last + 1]) <= ALIKE**2 * size)


def keeps_its_period(recording: Recording) -> bool:
    """Whether the input repeats after the period of a recording that is said to be in periodic steady state."""
    u, n = recording.u[recording.skip :], recording.period or 0
    if recording.begins != "periodic" or not 0 < n < len(u):
        return True
    apart = np.sqrt(np.mean((u[n:] - u[:-n]) ** 2, axis=0))
    return bool(np.all(apart <= UNLIKE * np.std(u, axis=0)))


def same_input(one: Recording, other: Recording) -> bool:
    """Whether the shorter of two inputs is found in the other, half by half and in any phase."""
    short, long = sorted((one, other), key=lambda r: len(r) - r.skip)
    wanted, u = short.u[short.skip :], long.u[long.skip :]
    if long.begins == "periodic":
        u = np.concatenate([u, u[: long.period]])
    half = len(wanted) // 2
    return half > 0 and _found(wanted[:half], u) and _found(wanted[half : 2 * half], u)


def by_input(recordings: Sequence[Recording]) -> list[list[int]]:
    """Numbers of the recordings in groups of one input each, in their order."""
    groups: list[list[int]] = []
    for k, r in enumerate(recordings):
        mine = next((g for g in groups if any(same_input(r, recordings[i]) for i in g)), None)
        if mine is None:
            groups.append([k])
        else:
            mine.append(k)
    return groups


def _found(wanted: Array, u: Array) -> bool:
    """Whether a stretch (L, n_u) that is not at rest is in an input (M, n_u)."""
    middle, size = wanted.mean(axis=0), wanted.std(axis=0)
    moving = size > 1e-9 * np.max(np.abs(u), initial=1e-300)
    if len(u) < len(wanted) or not np.any(moving):
        return False
    a, b = ((x - middle)[:, moving] / size[moving] for x in (wanted, u))
    power = np.concatenate([[0.0], np.cumsum(np.sum(b**2, axis=1))])
    lags = len(u) - len(a) + 1
    apart = np.sum(a**2) + power[len(a) :] - power[:lags] - 2 * _products(b, a)[:lags]
    return bool(np.min(apart) <= ALIKE**2 * a.size)


def _scaled(u: Array) -> Array | None:
    """Channels that move, (M, n), with mean 0 and deviation 1; None where none does."""
    size = u.std(axis=0)
    moving = size > 1e-9 * np.max(np.abs(u), axis=0, initial=1e-300)
    return (u - u.mean(axis=0))[:, moving] / size[moving] if np.any(moving) else None


def _products(u: Array, v: Array) -> Array:
    """Σ over t and channels of u(t + p) v(t), for the lags p from 0 to M - 1, (M,)."""
    n = len(u) + len(v)
    spectrum = np.fft.rfft(u, n, axis=0) * np.conj(np.fft.rfft(v, n, axis=0))
    return np.asarray(np.fft.irfft(np.sum(spectrum, axis=1), n))[: len(u)]
