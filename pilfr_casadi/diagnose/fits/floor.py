"""The noise floor: from repeated periods, from repeated recordings, or estimated from a residual.

Repeats are rounded alike, so that a measured floor is at least the error of rounding to the sensor's steps. A
machine that wears, warms up or is set otherwise does not repeat: then the input drives the differences between the
repeats, which are no noise.

The estimate takes third differences of the residual (normalised by √20): they remove slow model error and keep white
noise. They underestimate coloured noise. If a fit's residual cannot be told from noise (no local signal explains any of
it on held-out data), the residual itself is the floor.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from ...data import Recording

CORRELATED, P_VALUE = 0.5, 1e-4  # rank correlation with a signal that drives a residual, its p-value: many are tried
REFUTED = 0.01  # probability under measured noise below which an error is not that noise
ABOVE_NOISE = 2.0  # ratio of the error to the noise from which results say that more is missing
FEWEST = 30.0  # effective samples that a residual has at least
OUTSTANDING = 5.0  # standard errors by which third differences exceed white noise, above which they hold oscillations
LONGEST = 400  # longest correlation of a residual, in samples
DISTINCT_SHARE = 0.5  # share of the samples with distinct values above which a signal is not quantised
FEWEST_LEVELS = 10  # of a quantised signal; one with fewer is a switch
DRIVEN = 0.5  # share of the differences between repeats that the input explains, above which they are no noise
RESPONSE, SPANS, COMPARED = 150, 30, 6000  # lags of the input that are tried one by one, longer spans, and samples
NARROW_BAND, LEAST_RANK = 1e-3, 4  # least share of a direction of the input, and the directions of a sine or a ramp
SENSOR_RESOLUTION = 1e-6  # least noise assumed, as a share of the output's deviation: a 20-bit sensor
ROUNDING2 = float(np.finfo(float).eps) ** 2  # least mean square over a variance: simulated data may be met exactly
DIVERGED = 1e20  # mean square error, over an output's variance, of a run that diverges
MODEL_ERRORS = 200  # sizes of the model error that are tried where outputs with unequal noise are pooled
SAME_LEVEL = 1e-9  # distance of two values, over the range, below which they are one level


@dataclass(frozen=True, eq=False)
class Floor:
    """Standard deviation of each output's noise (n_y,), and its source."""

    deviation: np.ndarray
    source: str
    # number of periods, or of recordings with the same input, on which the noise is measured; 1 if it is not
    repeats: int = 1
    # (n_y,), independent samples of each output's noise in a repeat
    independent: np.ndarray = field(default_factory=lambda: np.ones(1))

    def may_be(self, rms: np.ndarray) -> bool:
        """Tell whether a residual with the rms errors (n_y,) can be a measured noise, in every output.

        Of n repeats, noise s leaves the power s² (n - 1)/n within them, and s²/n in their mean, where all that the
        simulator lacks is as well. Of noise alone, the second over the first has an F distribution, each over its
        independent samples. False for an estimated noise, and for an error that is clearly larger.
        """
        from scipy.stats import f

        if self.repeats < 2:
            return False
        chance = REFUTED / len(self.deviation)  # that noise exceeds the limit in any output
        most = f.isf(chance, self.independent, (self.repeats - 1) * self.independent)
        limit = np.minimum(1 + (most - 1) / self.repeats, ABOVE_NOISE**2)
        return bool(np.all(np.square(rms) < limit * np.square(self.deviation)))

    def beside(self, deviation: np.ndarray) -> Floor:
        """Return the floor with another independent error added, such as a surrogate's."""
        return replace(self, deviation=np.hypot(self.deviation, deviation))

    def squares(self, scale: np.ndarray) -> np.ndarray:
        """Compute each output's mean square noise in units of its variance, (n_y,)."""
        return np.maximum((self.deviation / scale) ** 2, ROUNDING2)

    def nrmse(self, scale: np.ndarray) -> float:
        """Compute the noise over the outputs' deviation, averaged over outputs."""
        return float(np.mean(self.deviation / scale))


def pool(squares: np.ndarray, noise2: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Pool mean square errors of the outputs (n_y,): return one mean square, and what variances it rests on.

    A wrong model is about as wrong in all outputs, in units of their deviation; noise is not. So the errors e have
    variances in proportion to noise2 + m, with a model error m common to the outputs; the variances, b, are scaled to
    the geometric mean 1. The pooled mean square is the mean of e² / b at the likeliest m: with -n/2 times its logarithm
    as log likelihood, it is the determinant criterion (Bard 1974, Nonlinear Parameter Estimation, sec. 4-9) for
    variances of this form. For one output, equal noise, or unknown noise, it is the mean.
    """
    mean = float(np.mean(squares))
    if noise2 is None or np.ptp(noise2) <= 0 or not 0 < mean < DIVERGED:
        return mean, np.ones(len(squares))
    return _pool_unequal(tuple(squares.tolist()), tuple(noise2.tolist()))


@functools.lru_cache(maxsize=1 << 14)  # each ranking of hypotheses pools the errors of all
def _pool_unequal(squares: tuple[float, ...], noises2: tuple[float, ...]) -> tuple[float, np.ndarray]:
    """Pool mean square errors of outputs with unequal noise."""
    noise2 = np.maximum(noises2, SENSOR_RESOLUTION**2)
    common = np.append(0.0, np.geomspace(1e-3 * np.min(noise2), 1e3 * max(*noise2, *squares), MODEL_ERRORS))
    variances = noise2 + common[:, None]
    balances = variances / np.exp(np.mean(np.log(variances), axis=1, keepdims=True))
    pooled = np.mean(squares / balances, axis=1)
    k, mean = int(np.argmin(pooled)), float(np.mean(squares))
    balance = balances[k].copy() if pooled[k] < mean else np.ones(len(squares))
    balance.flags.writeable = False  # all callers share it
    return min(float(pooled[k]), mean), balance


def noise_floor(recordings: Sequence[Recording], residuals: Sequence[np.ndarray]) -> Floor:
    """Measure the floor on repeated data, or estimate it from residuals if nothing repeats."""
    return measured_floor(recordings) or Floor(white_part(residuals), "estimated")


def measured_floor(recordings: Sequence[Recording]) -> Floor | None:
    """Measure the floor on periods, else on recordings with the same input; None if there are neither."""
    groups: dict[bytes, list[Recording]] = {}
    for r in recordings:
        groups.setdefault(r.u.tobytes(), []).append(r)
    periods = [y for r in recordings if (y := _fold(r)) is not None]
    alike = [y for g in groups.values() if (y := _stack(g)) is not None]
    repeated = periods or alike
    if not repeated:
        return None
    square = np.mean(np.concatenate([np.var(y, axis=0, ddof=1) for y in repeated]), axis=0)
    steps = [sensor_step(column) for column in np.concatenate([r.y for r in recordings]).T]
    deviation = np.maximum(np.sqrt(square), np.array(steps) / np.sqrt(12))
    noise = [y[0] - np.mean(y, axis=0) for y in repeated]
    independent = np.array([effective_size([e[:, [i]] for e in noise]) for i in range(len(deviation))])
    source = "periods" if periods else "repeats"
    return Floor(deviation, source, min(map(len, repeated)), np.maximum(independent, 1.0))


def sensor_step(values: np.ndarray) -> float:
    """Find the smallest step of a quantised signal (M,); zero if most samples have a value of their own."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    quantised = FEWEST_LEVELS <= len(levels) < DISTINCT_SHARE * len(values)
    return float(np.min(gaps[gaps > SAME_LEVEL * np.ptp(values)])) if quantised else 0.0


def _is_driven(differences: np.ndarray, u: np.ndarray, before: np.ndarray) -> bool:
    """Tell whether the input u (N, n_u) drives the differences (P, N, n_y) of repeats from their mean.

    The response of each output to the input, and to the inputs `before`, is fitted to the first half of each repeat. It
    has to explain most of the second half. Noise has no such response; but an input like a sine cannot be told from
    noise of that frequency, and shows nothing.
    """
    if not u.shape[1]:
        return False
    every = max(len(u) // COMPARED, 1)
    columns = _responses(np.vstack([before, u]))[len(before) :: every]
    columns = columns - np.mean(columns, axis=0)
    half, left, total = len(columns) // 2, 0.0, 0.0
    settled = columns[half // 2 : half]  # all lags are within the recording there
    if not settled.size or np.linalg.matrix_rank(settled, NARROW_BAND * np.linalg.norm(settled)) <= LEAST_RANK:
        return False
    for e in differences[:, ::every] - np.mean(differences[:, ::every], axis=1, keepdims=True):
        response = np.linalg.lstsq(columns[:half], e[:half], rcond=1e-6)[0]
        left = left + np.sum((e[half:] - columns[half:] @ response) ** 2, axis=0)
        total = total + np.sum(e[half:] ** 2, axis=0)
    return bool(np.any(left < (1 - DRIVEN) * np.asarray(total)))


def _responses(u: np.ndarray) -> np.ndarray:
    """Compute sums of the input (N, n_u), (N, n): over each of the last samples, and over ever longer spans before."""
    n, n_u = u.shape
    single = min(RESPONSE, n // (16 * n_u))
    spans = np.geomspace(max(single, 1), max(n / 4, 2.0), min(SPANS, n // (32 * n_u)) + 1)
    edges = np.unique(np.append(np.arange(single + 1), spans.astype(int)))
    total = np.vstack([np.zeros((1, n_u)), np.cumsum(u, axis=0)])
    until = [total[np.maximum(np.arange(1, n + 1) - edge, 0)] for edge in edges]
    return np.hstack([a - b for a, b in pairwise(until)]) if len(edges) > 1 else np.zeros((n, 0))


def _stack(group: Sequence[Recording]) -> np.ndarray | None:
    """Stack the outputs of recordings of one input, (P, N, n_y); None if they do not repeat an experiment.

    They do not if the input drives their differences. Unknown initial states may differ, so that only the second half
    is compared; and where the input rests there, as in free decays from different heights, they decide what follows.
    """
    if len(group) < 2:
        return None
    first, u = max(r.skip for r in group), group[0].u
    if not all(r.begins in ("zero", "periodic") for r in group):
        first = max(first, len(u) // 2)
        if not np.any(np.ptp(u[first:], axis=0) > 0):
            return None
    y = np.stack([r.y[first:] for r in group])
    return None if _is_driven(y - np.mean(y, axis=0), u[first:], u[:first]) else y


def _fold(r: Recording) -> np.ndarray | None:
    """Stack the outputs' periods, (P, N, n_y); None if there are not two, or the input drives their differences."""
    n = r.period
    if not n or r.begins != "periodic":
        return None
    y, u = r.y[r.skip :], r.u[r.skip :][:n]
    count = len(y) // n
    if count < 2:
        return None
    folded = y[: count * n].reshape(count, n, -1)
    return None if _is_driven(folded - np.mean(folded, axis=0), u, u) else folded


def third_differences(residual: np.ndarray) -> np.ndarray:
    """Return third differences (M - 3, n_y), normalised so that white noise keeps its deviation."""
    return np.asarray(np.diff(residual, 3, axis=0) / np.sqrt(20))


def white_part(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Estimate the white noise inside residuals, (n_y,): third differences, the smallest over recordings.

    Recordings with too few samples for such a difference say nothing, unless there are no others.
    """
    long = [_without_lines(third_differences(e)) for e in residuals if len(e) > 3]
    return np.asarray(np.min(long or [np.sqrt(np.mean(e**2, axis=0)) for e in residuals], axis=0))


def _without_lines(differences: np.ndarray) -> np.ndarray:
    """Compute the rms of third differences (M, n_y), without fast oscillations, which stand out of the upper spectrum.

    Over its expected course the spectrum of white noise is exponentially distributed, so that its median is ln 2 of its
    mean, with a standard error of 1 / ln 2 over the root of the number of lines. The median does not see a few of them.
    """
    mean2, n = np.mean(differences**2, axis=0), len(differences)
    f = np.arange(n // 4, (n + 1) // 2) / n
    if len(f) < FEWEST:
        return np.asarray(np.sqrt(mean2))
    course = (2 * np.sin(np.pi * f)) ** 6 / 20
    lines = np.abs(np.fft.fft(differences, axis=0)[n // 4 : (n + 1) // 2]) ** 2 / n
    median2 = np.median(lines / course[:, None], axis=0) / np.log(2)
    most = (1 + OUTSTANDING / (np.log(2) * np.sqrt(len(f)))) * median2
    return np.asarray(np.sqrt(np.where(mean2 > most, median2, mean2)))


def times_white(residual: np.ndarray) -> float:
    """Compute the ratio of a residual's rms to that of the white noise in it, the largest of all outputs."""
    rms, white = np.sqrt(np.mean(residual**2, axis=0)), white_part([residual])
    return float(np.max(rms / np.maximum(white, 1e-9 * np.max(rms, initial=1e-300))))


def effective_size(residuals: Sequence[np.ndarray]) -> float:
    """Count the independent samples: all samples over the residuals' correlation time `1 + 2 Σ ρ²`."""
    total = 0.0
    for e in residuals:
        for column in (e - e.mean(axis=0)).T:
            n = len(column)
            spectrum = np.abs(np.fft.rfft(column, 2 * n)) ** 2
            rho = np.fft.irfft(spectrum)[: min(LONGEST, max(n // 4, 1))]
            rho = rho / rho[0] if rho[0] > 0 else np.zeros(1)
            total += n / (1 + 2 * float(np.sum(rho[1:] ** 2)))
    return total


def samples_of_mean(residuals: Sequence[np.ndarray]) -> float:
    """Count the independent samples that determine the residuals' means: the samples times variance over density.

    The density is that of the slowest part of the spectrum, √M / 2 lines of M samples (Welch 1967 averages as many). A
    slow residual hides a constant; a fast oscillation does not, however long it lasts.
    """
    total = 0.0
    for e in residuals:
        centred = e - e.mean(axis=0)
        lines = np.abs(np.fft.rfft(centred, axis=0)) ** 2 / max(len(e), 1)
        slow = np.mean(lines[1 : 2 + int(np.sqrt(len(e)) / 2)], axis=0) if len(e) > 2 else np.zeros(e.shape[1])
        total += len(e) * float(np.sum(np.minimum(np.var(centred, axis=0) / np.maximum(slow, 1e-300), 1.0)))
    return max(total, 1.0)


def acting_samples(residuals: Sequence[np.ndarray], scale: np.ndarray) -> float:
    """Count the samples in which residuals act: all of Gaussian noise, few of bursts.

    With q the sum of a sample's squares over n_y outputs, each in units of its `scale`, it is (n_y + 2) (Σ q)² / Σ q².
    Samples in which a machine stands, and every model lets it stand, say nothing for or against a law.
    """
    errors = np.concatenate(residuals) / scale
    q = np.sum((errors / max(np.max(np.abs(errors)), 1e-300)) ** 2, axis=1)
    acting = (errors.shape[1] + 2) * np.sum(q) ** 2 / max(np.sum(q**2), 1e-300)
    return float(min(acting, errors.size))


def count_samples(residuals: Sequence[np.ndarray], mismatch: Sequence[np.ndarray], scale: np.ndarray) -> float:
    """Count the independent samples of a fit's residuals, at most those in which the mismatch it explains acts."""
    return max(min(effective_size(residuals), acting_samples(mismatch, scale)), FEWEST)


def swells_with(residuals: Sequence[np.ndarray], signals: Sequence[np.ndarray]) -> bool:
    """Tell whether a residual's power follows any column of signals of the same length; that of noise does not.

    Test the rank correlation (Spearman 1904) of their powers over blocks longer than the residual's correlation time,
    and from sample to sample, as of a gain that varies.
    """
    from scipy.stats import spearmanr

    for k in range(residuals[0].shape[1]):
        own = [e[:, [k]] for e in residuals]
        memory = sum(map(len, own)) / max(effective_size(own), 1.0)
        blocks = [int(np.clip(4 * memory, 10, max(len(e) // 12, 10))) for e in own]
        loud = [_powers(e[:, 0], b) for e, b in zip(own, blocks, strict=True)]
        if sum(map(len, loud)) < 8 or not np.ptp(np.concatenate(loud)) > 0:
            continue
        at_once = [e[:, 0] ** 2 for e in own]
        for j in range(signals[0].shape[1]):
            deviations = [v[:, j] - v[:, j].mean() for v in signals]
            other = [_powers(v, b) for v, b in zip(deviations, blocks, strict=True)]
            if not np.ptp(np.concatenate(other)) > 0:
                continue
            rank, chance = spearmanr(np.concatenate(loud), np.concatenate(other))
            if (rank > CORRELATED and chance < P_VALUE) or _rank_together(at_once, [v**2 for v in deviations]):
                return True
    return False


def _powers(values: np.ndarray, width: int) -> np.ndarray:
    """Compute the mean squares of blocks of a width in samples."""
    count = len(values) // width
    return np.asarray(np.mean(values[: count * width].reshape(count, width) ** 2, axis=1))


def _rank_together(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> bool:
    """Tell whether the ranks of two series, in parts of equal lengths, are correlated although both are slow.

    The variance of the covariance of two independent series is the sum of the products of their autocovariances
    (Bartlett 1946).
    """
    from scipy.stats import norm, rankdata

    ranks = [rankdata(np.concatenate(v)) for v in (first, second)]
    cuts = np.cumsum([len(v) for v in first])[:-1]
    parts = list(zip(*(np.split(v - v.mean(), cuts) for v in ranks), strict=True))
    covariance = sum(float(a @ b) for a, b in parts)
    variance = 0.0
    for a, b in parts:
        spectra = [np.abs(np.fft.fft(v, 2 * len(v))) ** 2 for v in (a, b)]
        variance += float(np.mean(spectra[0] * spectra[1])) / len(a)
    size = np.prod([np.linalg.norm(np.concatenate(v)) for v in zip(*parts, strict=True)])
    return bool(covariance > CORRELATED * size and norm.sf(covariance / np.sqrt(variance)) < P_VALUE)
