"""Steady tones in a residual, and modes of the simulator that ring there.

A tone, for example from mains hum, a fan or an unbalanced motor, is a line of the residual's spectrum far above its
neighbours (Fisher 1929). Its amplitude and phase are constant over the record, and it is neither in an input nor a
harmonic or a mixture of an input's few lines. A residual at one of the simulator's own frequencies is not noise either:
an unrecorded force causes it, and no law at any port explains it.
"""

from __future__ import annotations

import itertools

import numpy as np

from ...data import Recording
from ..fits.linearise import linearise_runs
from ..fits.workbench import Fitted, Workbench
from .gates import EXCEPTION_SHARE, LEAST_GAIN, Gate, value_with_unit

LEVEL_WIDTHS = 6  # widths on either side of a spectral line that tell the level of the spectrum there
TONE_LINES = 5  # spectral lines on either side that may belong to a tone
AMPLITUDE_CHANGE = 0.5  # largest change of the amplitude in a quarter of the record, over the amplitude
# for mixtures of an input's lines: most lines; highest order of mixtures, and of harmonics
LINES, ORDER, HARMONICS = 3, 7, 60
LIGHT_DAMPING = 0.15  # damping ratio below which a mode rings


def find_tones(bench: Workbench, fitted: Fitted) -> list[Gate]:
    """Note each output whose residual holds the same tone in every recording."""
    found = []
    for i, name in enumerate(bench.simulator.output_names):
        pairs = zip(fitted.residual, bench.recordings, strict=True)
        each = [find_tone(e[r.skip :, i], r) for e, r in pairs if len(r) - r.skip >= 8 * LEVEL_WIDTHS * TONE_LINES]
        steady = [t for t in each if t is not None]
        longest = max((len(r) for r in bench.recordings), default=0) * bench.dt
        if not steady or len(steady) < len(each) or np.ptp([f for f, _ in steady]) > 2 / longest:
            continue
        f, amplitude = (float(v) for v in np.mean(steady, axis=0))
        size = value_with_unit(amplitude, bench.unit_of(name))
        sentence = (
            f"{name} holds a steady tone of {f:.4g} Hz, amplitude {size}, that is in no input, as from mains hum, a "
            "fan, or a mode with little damping that the simulator lacks: shield or filter it, record what causes it, "
            "or add the mode."
        )
        scale = bench.balanced(fitted).scale
        share = amplitude**2 / 2 / scale[i] ** 2 / len(scale) / fitted.cost
        found.append(Gate(name, "tone", f, sentence, corrected=False, left=1 - min(share, 1.0)))
    return found


def find_tone(e: np.ndarray, r: Recording) -> tuple[float, float] | None:
    """Find frequency, Hz, and amplitude of the tone in the residual of one output; None if there is none."""
    n, e = len(e), e - np.mean(e)
    power = _spectrum(e)
    k = 2 * TONE_LINES + int(np.argmax(power[2 * TONE_LINES : -TONE_LINES]))
    if not _stands_out(power, k, TONE_LINES, len(power)):
        return None
    f = _refine_frequency(e, k)
    whole = _fit_wave(e, f, slice(None))
    quarters = [_fit_wave(e, f, slice(q * n // 4, (q + 1) * n // 4)) for q in range(4)]
    unsteady = max(abs(q - whole) for q in quarters) > AMPLITUDE_CHANGE * abs(whole)
    if unsteady or abs(whole) ** 2 / 2 < EXCEPTION_SHARE * float(np.mean(e**2)):
        return None
    return None if any(_comes_from_input(u, f, r) for u in r.u[r.skip :].T) else (f / r.dt, abs(whole))


def _spectrum(v: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.fft.rfft((v - np.mean(v)) * np.hanning(len(v)))) ** 2)


def _stands_out(power: np.ndarray, k: int, width: int, tried: int = 1) -> bool:
    """Tell whether a spectrum at line k, the largest of `tried` lines, is above its level on both sides.

    The power of noise is exponentially distributed about its level, so that the ratio is the gain in nats.
    """
    below = power[max(k - LEVEL_WIDTHS * width, 1) : max(k - width, 1)]
    above = power[k + width + 1 : k + LEVEL_WIDTHS * width + 1]
    level = max(float(np.median(v)) for v in (below, above) if len(v)) / np.log(2)
    return bool(power[k] > (LEAST_GAIN + np.log(tried)) * level)


def _fit_wave(e: np.ndarray, f: float, part: slice) -> complex:
    """Fit amplitude and phase of the frequency f, a share of the sampling rate, in a part of e."""
    angle = 2 * np.pi * f * np.arange(len(e))[part]
    a, b, _ = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))]), e[part])[0]
    return complex(a, -b)


def _refine_frequency(e: np.ndarray, k: int) -> float:
    """Find the frequency of the strongest wave near line k, as a share of the sampling rate."""
    from scipy.optimize import minimize_scalar

    ends = (k - 1) / len(e), (k + 1) / len(e)
    found = minimize_scalar(lambda f: -abs(_fit_wave(e, f, slice(None))), bounds=ends, options={"xatol": 1e-3 / len(e)})
    return float(found.x)


def _comes_from_input(u: np.ndarray, f: float, r: Recording) -> bool:
    """Tell whether an input holds the frequency, or can make it by harmonics or mixtures of its few lines."""
    from scipy.signal import find_peaks

    n, power = len(u), _spectrum(u)
    k = round(f * n)
    if _stands_out(power, max(k - 1, 0) + int(np.argmax(power[max(k - 1, 0) : k + 2])), TONE_LINES):
        return True
    if r.period and abs(f * r.period - round(f * r.period)) * n < r.period:
        return True
    strong = find_peaks(power, EXCEPTION_SHARE * np.max(power), distance=2 * TONE_LINES)[0]
    lines = [_refine_frequency(u, j) for j in strong[: LINES + 1]]
    order = ORDER
    if lines and all(abs(v / lines[0] - round(v / lines[0])) < 0.05 for v in lines):
        lines, order = lines[:1], HARMONICS if lines[0] * n > LEVEL_WIDTHS * TONE_LINES else ORDER
    if not 0 < len(lines) <= LINES:
        return False
    orders = itertools.product(range(-order, order + 1), repeat=len(lines))
    made = np.array([np.dot(c, lines) for c in orders if sum(map(abs, c)) <= order])
    # orders above half the sampling rate fold back
    return bool(np.any(np.abs(np.abs(made - np.round(made)) - f) * n < 2))


def find_ringing_mode(bench: Workbench, fitted: Fitted) -> float | None:
    """Find the frequency, Hz, of a lightly damped mode that is visible in the residual of a fit, or None."""
    a = linearise_runs(bench, fitted)[1][0].mean[0]
    with np.errstate(divide="ignore"):
        poles = np.log(np.linalg.eigvals(a).astype(complex)) * fitted.model.substeps / bench.dt
    modes = [abs(s) / (2 * np.pi) for s in poles if s.imag > 0 and -s.real < LIGHT_DAMPING * abs(s)]
    rest = [column for e in bench.scored(fitted.residual) for column in e.T]
    return next((f for f in sorted(modes) if any(_rings(e, f * bench.dt) for e in rest)), None)


def _rings(e: np.ndarray, f: float) -> bool:
    """Tell whether a mode at the frequency f, a share of the sampling rate, stands out of the spectrum of e."""
    k = round(f * len(e))
    width = int(LIGHT_DAMPING * k)  # lines of a mode on either side
    if k < 2 * TONE_LINES or k + 2 * width >= len(e) // 2:
        return False
    power = np.convolve(_spectrum(e), np.ones(width) / width, mode="same")
    highest = k - width + int(np.argmax(power[k - width : k + width + 1]))
    return _stands_out(power, highest, width, 2 * width + 1)
