"""Map of the refitted simulator's residual over frequency, amplitude, rate, level and time.

Residuals are in units of each output's deviation. Power above the noise floor is the *excess*, and shares are shares of
the excess. Frequency bands are half octaves; the amplitude is the envelope of the simulated output. If the input is a
multisine with omitted lines, the residual at these lines is distortion: at even lines from asymmetric laws, at odd
lines from symmetric laws (Pintelon & Schoukens, System Identification, 2nd ed., 2012, ch. 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from .._base import in_words
from ..data import Recording

BINS = 6  # bins of amplitude, rate and level
MOST_BANDS = 24  # frequency bands at most, so that the map stays readable
TIME_PIECES = 24  # pieces of a recording in the picture over time
OMITTED_SHARE = 1e-3  # share of the largest line below which an input line counts as omitted
CLEAR_RATIO = 1.5  # ratio that the sentence mentions


def mismatch(
    recordings: Sequence[Recording],
    residuals: Sequence[np.ndarray],
    simulated: Sequence[np.ndarray],
    floor_deviation: np.ndarray,
    scale: np.ndarray,
) -> dict[str, Any]:
    """Map residuals over frequency, amplitude, rate, level and time.

    Parameters
    ----------
    recordings : sequence of Recording
    residuals : sequence of array, (M, n_y)
        Simulated minus measured outputs of each recording, unscored samples included.
    simulated : sequence of array, (M, n_y)
        Simulated outputs, which have no noise; they define amplitude, rate and level.
    floor_deviation, scale : array, (n_y,)
        Deviation of the noise, and of each output.

    Returns
    -------
    dict
        Numbers and lists only. `sentence`; `rms` and `floor` in units of the outputs' deviation; `scale`, that
        deviation, and `outputs`, the share of the mismatch, both by output; `frequency` (`low`, `high` in Hz, mean
        squares `power` and `floor`, and `share` of each band; `worst` its index); `amplitude`, `input`, `rate` (per s)
        and `level` (`edges` of bins, `rms` of the residual, share of `samples`); `map` (`low`, `high`, `edges`,
        `rms` by [band][amplitude]); `time` (`name`, `t`, `rms`, `output` of each recording), `thirds`; `distortion`
        (`even`, `odd`, `excited`, `noise`: rms a line) or None.
    """
    scale = np.where(np.asarray(scale) > 0, scale, 1.0)
    e, y = (_scored(v, recordings, scale) for v in (residuals, simulated))
    outputs, dt = recordings[0].outputs, recordings[0].dt
    noise = np.asarray(floor_deviation) / scale
    floor2 = float(np.mean(noise**2))
    power = np.concatenate([np.mean(v**2, axis=1) for v in e])
    low, high = _bands(max(map(len, e)), dt)
    envelope = [_envelope(v) for v in y]
    slopes = _scored([np.gradient(v, dt, axis=0) for v in simulated], recordings, scale)  # of which one may be scored
    rates = [np.sqrt(np.mean(v**2, axis=1)) for v in slopes]
    u = [r.u[r.skip :] for r in recordings]
    spread = np.std(np.concatenate(u), axis=0)
    inputs = [_envelope(v / np.where(spread > 0, spread, 1.0)) for v in u]
    by_output = np.maximum(np.mean(np.concatenate(e) ** 2, axis=0) - noise**2, 0.0)
    worst = int(np.argmax(by_output))
    level = _rms_by_bin(np.concatenate([v[:, worst] for v in y]), np.concatenate([v[:, worst] ** 2 for v in e]))
    amplitude, by_input, rate = (
        _rms_by_bin(np.concatenate(v), power, from_zero=True) for v in (envelope, inputs, rates)
    )
    total = max(float(np.sum(by_output)), 1e-300)
    found: dict[str, Any] = {
        "rms": float(np.sqrt(np.mean(power))),
        "floor": float(np.sqrt(floor2)),
        "scale": {n: float(v) for n, v in zip(outputs, scale, strict=True)},
        "outputs": {n: float(v / total) for n, v in zip(outputs, by_output, strict=True)},
        "frequency": _by_frequency(e, low, high, floor2, dt),
        "amplitude": amplitude,
        "input": by_input,
        "rate": rate,
        "level": {"output": outputs[worst], **level},
        "map": _map(e, envelope, low, high, np.asarray(amplitude["edges"]), dt),
        "time": [_over_time(r, a, b) for r, a, b in zip(recordings, e, y, strict=True)],
        "thirds": _thirds(e, y),
        "distortion": _distortion(recordings, e),
    }
    found["sentence"] = _describe(found)
    return found


def _scored(signals: Sequence[np.ndarray], recordings: Sequence[Recording], scale: np.ndarray) -> list[np.ndarray]:
    """Return the scored samples of each signal over the outputs' deviation; zero where a signal is not finite."""
    parts = [np.asarray(v)[r.skip :] / scale for v, r in zip(signals, recordings, strict=True)]
    return [np.where(np.isfinite(v), v, 0.0) for v in parts]


def _bands(samples: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of the bands in Hz: half octaves from four periods a recording up; the first holds all below."""
    top, first = 0.5 / dt, min(4 / (samples * dt), 0.25 / dt)
    count = int(np.clip(np.ceil(2 * np.log2(top / first)), 1, MOST_BANDS - 1))
    edges = np.concatenate([[0.0], first * (top / first) ** (np.arange(count + 1) / count)])
    return edges[:-1], edges[1:]


def _by_frequency(
    e: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray, floor2: float, dt: float
) -> dict[str, Any]:
    power, weight = np.zeros(len(low)), 0
    for v in e:
        n = len(v)
        window = np.hanning(n + 2)[1:-1, None]
        lines = np.mean(np.abs(np.fft.rfft(v * window, axis=0)) ** 2, axis=1)
        lines[1 : len(lines) - (n % 2 == 0)] *= 2
        lines /= n * float(np.sum(window**2))  # the sum over lines is the mean square
        band = np.searchsorted(high, np.fft.rfftfreq(n, dt), side="left").clip(0, len(low) - 1)
        power += n * np.bincount(band, lines, minlength=len(low))
        weight += n
    power /= weight
    floor = floor2 * (high - low) * 2 * dt
    excess = np.maximum(power - floor, 0.0)
    share = excess / max(float(np.sum(excess)), 1e-300)
    lists = {"low": low, "high": high, "power": power, "floor": floor, "share": share}
    return {k: v.tolist() for k, v in lists.items()} | {"worst": int(np.argmax(share))}


def _envelope(v: np.ndarray) -> np.ndarray:
    """Compute the amplitude (M,): modulus of the analytic signal about the mean, over all columns."""
    from scipy.signal import hilbert

    power = np.sum(np.abs(hilbert(v - np.mean(v, axis=0), axis=0)) ** 2, axis=1)
    return np.asarray(np.sqrt(power / max(v.shape[1], 1)))  # without a column, zero


def _bin_indices(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the bin of each value; values outside join the outer bins."""
    return np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)


def _rms_by_bin(x: np.ndarray, power: np.ndarray, from_zero: bool = False) -> dict[str, Any]:
    """Compute the rms of the residual in bins of x; the outermost half percents join the outer bins."""
    a, b = (0.0 if from_zero else float(np.quantile(x, 0.005))), float(np.quantile(x, 0.995))
    edges = np.linspace(a, b if b > a else a + 1.0, BINS + 1)
    index = _bin_indices(x, edges)
    count = np.bincount(index, minlength=BINS)
    mean = np.bincount(index, power, minlength=BINS) / np.maximum(count, 1)
    rms = [float(np.sqrt(m)) if c else None for m, c in zip(mean, count, strict=True)]
    return {"edges": edges.tolist(), "rms": rms, "samples": (count / len(x)).tolist()}


def _map(
    e: Sequence[np.ndarray],
    envelope: Sequence[np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    edges: np.ndarray,
    dt: float,
) -> dict[str, Any]:
    """Compute the residual's rms by frequency band and amplitude bin; None for bins with few samples."""
    index = _bin_indices(np.concatenate(envelope), edges)
    count = np.bincount(index, minlength=BINS)
    spectra = [(np.fft.rfft(v, axis=0), np.fft.rfftfreq(len(v), dt), len(v)) for v in e]
    rows: list[list[float | None]] = []
    for k, (a, b) in enumerate(zip(low, high, strict=True)):
        parts = []
        for s, f, n in spectra:
            inside = (f >= a if k == 0 else f > a) & (f <= b)
            parts.append(np.mean(np.fft.irfft(s * inside[:, None], n, axis=0) ** 2, axis=1))
        total = np.bincount(index, np.concatenate(parts), minlength=BINS)
        rows.append([float(np.sqrt(t / c)) if c > 20 else None for t, c in zip(total, count, strict=True)])
    return {"low": low.tolist(), "high": high.tolist(), "edges": edges.tolist(), "rms": rows}


def _over_time(r: Recording, e: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    edges = np.linspace(0, len(e), min(TIME_PIECES, len(e)) + 1).astype(int)
    pieces = [slice(a, b) for a, b in pairwise(edges)]
    centred = y - np.mean(y, axis=0)
    return {
        "name": r.name,
        "t": [float(r.start + (r.skip + (p.start + p.stop - 1) / 2) * r.dt) for p in pieces],
        "rms": [float(np.sqrt(np.mean(e[p] ** 2))) for p in pieces],
        "output": [float(np.sqrt(np.mean(centred[p] ** 2))) for p in pieces],
    }


def _thirds(e: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> dict[str, list[float]]:
    """Compute the rms of residual and output in the first, middle and last third, over all recordings."""
    out: dict[str, list[float]] = {"rms": [], "output": []}
    for k in range(3):
        for name, signals in (("rms", e), ("output", [v - np.mean(v, axis=0) for v in y])):
            cut = [v[k * len(v) // 3 : (k + 1) * len(v) // 3] for v in signals]
            out[name].append(float(np.sqrt(np.mean(np.concatenate(cut) ** 2))))
    return out


def _distortion(recordings: Sequence[Recording], e: Sequence[np.ndarray]) -> dict[str, float | None] | None:
    """Compute the residual's rms per line at omitted even and odd lines, up to the last excited one."""
    even, odd, driven, noise = [], [], [], []
    for r, v in zip(recordings, e, strict=True):
        n = r.period
        if not n or len(v) < n:
            continue
        count = len(v) // n
        u = np.mean(np.abs(np.fft.rfft(r.u[r.skip : r.skip + count * n].reshape(count, n, -1), axis=1)), axis=0)
        excited = np.any(u > OMITTED_SHARE * np.max(u[1:], axis=0), axis=1)
        excited[0] = False
        lines = np.fft.rfft(v[: count * n].reshape(count, n, -1), axis=1) / n
        mean = np.mean(np.abs(np.mean(lines, axis=0)) ** 2, axis=1)
        k = np.arange(len(mean))
        inside = (k > 0) & (k <= int(np.max(np.flatnonzero(excited), initial=0)))
        even.append(mean[inside & ~excited & (k % 2 == 0)])
        odd.append(mean[inside & ~excited & (k % 2 == 1)])
        driven.append(mean[inside & excited])
        if count > 1:
            noise.append(np.mean(np.var(lines, axis=0, ddof=1) / count, axis=1)[inside])
    if sum(map(len, even)) < 5 or sum(map(len, odd)) < 5:
        return None

    def rms(parts: list[np.ndarray]) -> float | None:
        return float(np.sqrt(np.mean(np.concatenate(parts)))) if sum(map(len, parts)) else None

    return {"even": rms(even), "odd": rms(odd), "excited": rms(driven), "noise": rms(noise)}


def _describe(found: dict[str, Any]) -> str:
    """Describe the clearest features of the map in a sentence or two."""
    rms, floor = found["rms"], found["floor"]
    if rms < 1.1 * floor:
        return "The residual is at the noise floor; no band, amplitude or stretch of time stands out."
    parts = [_where_in_frequency(found["frequency"])]
    growth = _growth(found["amplitude"], floor)
    if growth is not None and growth > 1.4:
        parts.append("grows faster than the motion and is worst at large amplitude")
    elif growth is not None and growth < 0.6:
        parts.append("grows less than the motion does, as an effect of constant size does")
    elif growth is not None:
        parts.append("grows in proportion to the motion, as a wrong value does")
    speed = _ratio(found["rate"])
    if speed is not None and not CLEAR_RATIO > speed > 1 / CLEAR_RATIO:
        parts.append("is larger at high speed" if speed > 1 else "is larger near standstill")
    thirds = found["thirds"]
    absolute = thirds["rms"][2] / max(thirds["rms"][0], 1e-300)
    relative = absolute * thirds["output"][0] / max(thirds["output"][2], 1e-300)
    if min(absolute, relative) > CLEAR_RATIO:
        parts.append("grows toward the end of the recording")
    elif max(absolute, relative) < 1 / CLEAR_RATIO:
        parts.append("fades toward the end of the recording")
    text = parts[0]
    if len(parts) > 1:
        text += f"; it {in_words(parts[1:])}"
    outputs = found["outputs"]
    if len(outputs) > 1:
        name = max(outputs, key=outputs.__getitem__)
        text += f". {100 * outputs[name]:.0f} % of it is seen in {name}"
    distortion = found["distortion"]
    if distortion and distortion["even"] and distortion["odd"]:
        ratio = distortion["even"] / distortion["odd"]
        clear = "mostly even" if ratio > 1 else "mostly odd"
        kind = "both even and odd" if 1 / CLEAR_RATIO < ratio < CLEAR_RATIO else clear
        why = {"mostly even": " (a law that differs with the direction)", "mostly odd": " (a symmetric law)"}
        text += f". The distortion at lines that the input leaves out is {kind}{why.get(kind, '')}"
    return text + "."


def _where_in_frequency(found: dict[str, Any]) -> str:
    """Find the narrowest range of bands with three quarters of the excess."""
    share = np.asarray(found["share"])
    total = np.concatenate([[0.0], np.cumsum(share)])
    best: tuple[int, float, int, int] | None = None
    for i in range(len(share)):
        j = int(np.searchsorted(total, total[i] + 0.75 - 1e-12))
        if j <= len(share):
            inside = float(total[j] - total[i])
            if best is None or (j - i, -inside) < best[:2]:
                best = (j - i, -inside, i, j)
    _, negative, i, j = best or (0, -1.0, 0, len(share))
    amount = "Almost all" if -negative > 0.95 else f"{-100 * negative:.0f} %"
    low, high = found["low"][i], found["high"][j - 1]
    where = f"below {high:.3g} Hz" if low == 0 else f"between {low:.3g} and {high:.3g} Hz"
    return f"{amount} of the mismatch lies {where}"


def _growth(amplitude: dict[str, Any], floor: float) -> float | None:
    """Fit the exponent of the residual's rms over the amplitude, in bins above the floor; None for too few bins."""
    edges = np.asarray(amplitude["edges"])
    middle = (edges[1:] + edges[:-1]) / 2
    use = [i for i, (v, n) in enumerate(zip(amplitude["rms"], amplitude["samples"], strict=True)) if v and n > 0.01]
    use = [i for i in use if amplitude["rms"][i] > 1.3 * floor]
    if len(use) < 3:
        return None
    own = np.sqrt(np.asarray([amplitude["rms"][i] for i in use]) ** 2 - floor**2)
    return float(np.polyfit(np.log(middle[use]), np.log(own), 1)[0])


def _ratio(binned: dict[str, Any]) -> float | None:
    """Divide the rms in the upper half of the bins by that in the lower half."""
    half, means = BINS // 2, []
    for part in (slice(0, half), slice(half, BINS)):
        weights = np.asarray(binned["samples"][part])
        if weights.sum() < 0.02:
            return None
        power = np.asarray([(v or 0.0) ** 2 for v in binned["rms"][part]])
        means.append(float(np.sqrt(np.sum(weights * power) / weights.sum())))
    return means[1] / max(means[0], 1e-300)
