"""Lines in the spectrum of a residual: steady tones that no input holds, and the simulator's own modes.

A tone, as from mains hum, a fan or an unbalanced motor, is a line of the residual's spectrum far above those around it.
Its amplitude and phase stay over the record, and it is neither in an input nor a harmonic or a mixture of an input's
few lines.

A residual that swings at one of the simulator's own frequencies is no noise. A force that is not recorded, or one that
depends on more than a port's coordinate and the time, leaves such a residual: no law at any port explains it, and yet
something is missing.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ..data import Recording
from .gates import Gate
from .linearise import linearised
from .workbench import Fitted, Workbench

FEWEST, SLOWEST = 256, 10  # samples, and periods in the record, that a tone is told from
FAR, IN_INPUT = 50.0, 10.0  # times the lines around, in the residual and in an input
AROUND, OWN = 30, 3  # lines on either side that are compared with, and that belong to the tone
SHARE = 0.05  # of the residual's power
STEADY = 0.5  # of the amplitude by which a quarter's may differ
LINES, STRONG, ORDER = 3, 0.01, 7  # an input that has no more, of that power over its strongest, mixes them
SPARSE, HARMONICS = 16, 60  # lines of the record that lie between an input's harmonics at least, and their number

LIGHT = 0.15  # damping ratio below which a mode rings
LOUD = 10.0  # times the spectrum around it
FINE = 10  # lines of the spectrum up to a mode
AVERAGED = 4  # half-overlapping segments that its spectrum is averaged over at least
BESIDE = 1.2, 1.8  # times a mode's frequency, above and below, where the spectrum is compared with


def tones(bench: Workbench, fitted: Fitted) -> list[Gate]:
    """Note each output in whose residual, in every recording, the same tone stands."""
    found = []
    for i, name in enumerate(bench.simulator.output_names):
        pairs = zip(fitted.residual, bench.recordings, strict=True)
        each = [tone(e[r.skip :, i], r) for e, r in pairs if len(r) - r.skip >= FEWEST]
        told = [t for t in each if t is not None]
        longest = max((len(r) for r in bench.recordings), default=0) * bench.dt
        if not told or len(told) < len(each) or np.ptp([f for f, _ in told]) > 2 / longest:
            continue
        f, amplitude = float(np.mean([f for f, _ in told])), float(np.mean([a for _, a in told]))
        unit = bench.recordings[0].units.get(name, "")
        sentence = (
            f"{name} holds a steady tone of {f:.4g} Hz, amplitude {amplitude:.3g}{f' {unit}' if unit else ''}, that is "
            "in no input, as from mains hum or a fan: shield or filter it, or record what causes it."
        )
        share = amplitude**2 / 2 / bench.scale[i] ** 2 / len(bench.scale) / fitted.cost
        found.append(Gate(name, "tone", f, sentence, False, left=1 - min(share, 1.0)))
    return found


def tone(e: np.ndarray, r: Recording) -> tuple[float, float] | None:
    """Find frequency, Hz, and amplitude of the tone in the residual of one output; None where there is none."""
    n, e = len(e), e - np.mean(e)
    power = _power(e)
    k = SLOWEST + int(np.argmax(power[SLOWEST:-OWN]))
    if power[k] < FAR * _around(power, k):
        return None
    f = _refined(e, k)
    whole = _wave(e, f, slice(None))
    quarters = [_wave(e, f, slice(q * n // 4, (q + 1) * n // 4)) for q in range(4)]
    unsteady = max(abs(q - whole) for q in quarters) > STEADY * abs(whole)
    if unsteady or abs(whole) ** 2 / 2 < SHARE * float(np.mean(e**2)):
        return None
    return None if any(_from(u, f, r) for u in r.u[r.skip :].T) else (f / r.dt, abs(whole))


def _power(v: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.fft.rfft((v - np.mean(v)) * np.hanning(len(v)))) ** 2)


def _around(power: np.ndarray, k: int) -> float:
    """Return the median of the lines around line k."""
    near = np.arange(max(k - AROUND, 1), min(k + AROUND + 1, len(power)))
    return float(np.median(power[near[np.abs(near - k) > OWN]]))


def _wave(e: np.ndarray, f: float, part: slice) -> complex:
    """Fit amplitude and phase of the frequency f, a share of the sampling rate, in a part of e, by least squares."""
    angle = 2 * np.pi * f * np.arange(len(e))[part]
    a, b, _ = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))]), e[part])[0]
    return complex(a, -b)


def _refined(e: np.ndarray, k: int) -> float:
    """Find the frequency of the strongest wave near line k, as a share of the sampling rate."""
    from scipy.optimize import minimize_scalar

    ends = (k - 1) / len(e), (k + 1) / len(e)
    found = minimize_scalar(lambda f: -abs(_wave(e, f, slice(None))), bounds=ends, options={"xatol": 1e-3 / len(e)})
    return float(found.x)


def _from(u: np.ndarray, f: float, r: Recording) -> bool:
    """Tell whether an input holds the frequency, or its few lines or its period make it in something nonlinear."""
    n, power = len(u), _power(u)
    k = round(f * n)
    if np.max(power[max(k - 1, 0) : k + 2]) > IN_INPUT * _around(power, k):
        return True
    if r.period and abs(f * r.period - round(f * r.period)) * n < r.period:
        return True
    peaks = [j for j in range(2, len(power) - 2) if power[j] == max(power[max(j - OWN, 0) : j + OWN + 1])]
    strong = [j for j in peaks if power[j] > STRONG * np.max(power)]
    lines = [_refined(u, j) for j in strong[: LINES + 1]]
    made = _mixed(lines) if 0 < len(lines) <= LINES else list[float]()
    if lines and lines[0] * n > SPARSE and all(abs(v / lines[0] - round(v / lines[0])) < 0.05 for v in lines):
        made += [m * lines[0] for m in range(1, HARMONICS)]
    return any(abs(_folded(v) - f) * n < 2 for v in made)


def _mixed(lines: Sequence[float]) -> list[float]:
    """Combine a few lines up to the order `ORDER`."""
    orders = [c for c in itertools.product(range(-ORDER, ORDER + 1), repeat=len(lines)) if sum(map(abs, c)) <= ORDER]
    return [abs(sum(a * f for a, f in zip(c, lines, strict=True))) for c in orders]


def _folded(f: float) -> float:
    """Return the frequency at which one above half the sampling rate appears."""
    return abs(f - round(f))


def ringing(bench: Workbench, fitted: Fitted) -> float | None:
    """Find the frequency, Hz, of a lightly damped mode that stands out of a fit's residual, or None."""
    a = linearised(bench, fitted)[1][0].mean[0]
    with np.errstate(divide="ignore"):
        poles = np.log(np.linalg.eigvals(a).astype(complex)) * fitted.model.substeps / bench.dt
    modes = [abs(s) / (2 * np.pi) for s in poles if s.imag > 0 and -s.real < LIGHT * abs(s)]
    rest = [e[r.skip :, i] for e, r in zip(fitted.residual, bench.recordings, strict=True) for i in range(r.n_y)]
    return next((f for f in sorted(modes) if any(_stands_out(e, f * bench.dt) for e in rest)), None)


def _stands_out(e: np.ndarray, f: float) -> bool:
    """Tell whether the spectrum of e at frequency f, a share of the sampling rate, is far above that around it."""
    from scipy.signal import welch

    length = int(np.ceil(FINE / f))
    if BESIDE[1] * f > 0.5 or 2 * len(e) // length - 1 < AVERAGED:
        return False
    lines, power = welch(e, nperseg=length)
    far = np.maximum(lines / f, f / np.maximum(lines, 1e-12))
    around = power[(far > BESIDE[0]) & (far < BESIDE[1])]
    return bool(np.max(power[far < 1 + 1.5 / FINE]) > LOUD * np.median(around))
