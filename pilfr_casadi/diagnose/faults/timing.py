"""Faults of time: a channel recorded too early or too late, or by another clock.

One channel is read at shifted times, and the error of the refitted simulator is projected off the directions that
parameters and initial states can follow. A refit confirms the shift (or clock rate) with the smallest remainder. A late
output or an early input may be physics (a delay). A shift of many whole samples is typical of a recorder, and only a
recorder puts an output before its cause.

On a ramp, a decay or a sine other causes act like a shift or a clock rate. So it has to follow clearly better than a
smaller shift, such as one by a period less, and than a constant or a gain (`find_rivals`), which are more common; else
a note tells both. Its value has to lie within the range that is screened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from ...data import COURSES, Recording, moves_freely
from ...laws import Gain, Lag, Law
from ...simulators import in_series
from ..fits.floor import ABOVE_NOISE
from ..fits.workbench import RUNAWAY, THOROUGH, Fitted, Workbench, refit
from .gates import (
    CLEARLY_BETTER,
    EQUAL_RATIO,
    NEAR_NOISE_RATIO,
    Checked,
    FirstOrder,
    Gate,
    accept,
    correct,
    follows_better,
    satisfies_rule,
    settle,
)
from .offsets import Offset, find_offsets, find_rivals

LARGEST_SHIFT = 64  # largest shift that is tried, and largest number of lost samples of an output
SHIFTS = np.union1d(np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1.0), np.linspace(-2.0, 2.0, 17))  # samples
# clock rates tried, as relative errors: 0.01 % to 5 %
RATES = np.concatenate([-np.geomspace(1e-4, 0.05, 28)[::-1], np.geomspace(1e-4, 0.05, 28)])
WHOLE_SHIFT = 0.12  # distance in samples within which a shift counts as whole
LONG_SHIFT = 4.5  # shift in samples above which a whole shift is a fault of the recording
MOST_SCREENED, MOST_SHIFTS = 4, 2  # faults that refits confirm, and shifts of one channel among them
BEYOND = 1.05  # how far a value may move beyond the range tried, which shows that the best one is not in it
LEAST_RECORDED = 0.5  # least share of the samples that a shift may read inside the recordings
AVERAGED_NOISE = 0.5  # share of a noise that the mean of two samples removes, the most that interpolation can

_Curve = Callable[[np.ndarray], np.ndarray]  # a signal over time


@dataclass(frozen=True)
class TimeShift(Gate):
    """Channels (columns of "u" or "y") with wrong times: late by seconds, or from a clock that runs faster."""

    kind: str = "y"
    columns: tuple[int, ...] = (0,)
    hold: str = "zero"  # of the inputs
    parameters: ClassVar[int] = 1

    def at(self, value: float, dt: float) -> Self:
        """Return the fault with another shift or clock rate."""
        words = f"The clock of {self.channel} runs {value * 100:+.3g} % off the others'"
        if self.finding == "alignment":
            late = "late" if value > 0 else "early"
            are, it = ("are", "them") if "," in self.channel else ("is", "it")
            words = f"{self.channel} {are} recorded {_samples(abs(value / dt))} ({abs(value):.3g} s) too {late}"
        moved = replace(self, value=value, sentence=words)
        if moved.delay > 0:
            moved = replace(moved, sentence=f"{words}, or the machine delays {it} by as much")
        elif self.finding == "alignment" and abs(value / dt) < 1 + WHOLE_SHIFT and not COURSES[self.hold].begin:
            moved = replace(moved, sentence=f"{words}, or inputs are means up to their samples (hold 'next')")
        return replace(moved, change=moved.read)

    def read(self, r: Recording, cut: bool = True, curves: Sequence[_Curve] = ()) -> Recording:
        """Read the channels at the times of the others, interpolated: outputs by cubic splines, inputs by chords.

        Samples from before the recording are skipped, samples from behind it are cut off. Without `cut`, the end values
        are held. A periodic recording wraps around. `curves` are its interpolants, if they are known.
        """
        at, wraps = self._times(r), self._wraps(r)
        values = np.array(getattr(r, self.kind))
        for i, curve in zip(self.columns, curves or self.curves(r), strict=True):
            values[:, i] = curve(at)
        other = r.with_(**{self.kind: values})
        if self.kind == "y" and r.begins == "zero":  # the recording was at rest at its stated start
            other = other.with_(initial="estimate")
        if wraps or not cut:
            return other
        early, late = int(np.sum(at < 0)), int(np.sum(at > r.t[-1] + 1e-9 * r.dt))
        if early:
            other = other.with_(skip=min(max(r.skip, early), len(r) - 2))
        return other.slice(0, max(len(r) - late, other.skip + 2)) if late else other

    def _times(self, r: Recording) -> np.ndarray:
        """Return the times (M,) at which the channel is read."""
        return r.t + self.value if self.finding == "alignment" else r.t * (1 + self.value)

    def _recorded(self, r: Recording) -> np.ndarray:
        """Mark the samples (M,) that are read inside the recording; elsewhere the end values are held."""
        at = self._times(r)
        return np.full(len(r), True) if self._wraps(r) else (at >= 0) & (at <= r.t[-1] + 1e-9 * r.dt)

    def _wraps(self, r: Recording) -> bool:
        return r.wraps and self.finding == "alignment"

    def curves(self, r: Recording) -> list[_Curve]:
        """Interpolate the channels, whatever the value."""
        values = getattr(r, self.kind)
        return [_interpolant(r, values[:, i], self._wraps(r), smooth=self.kind == "y") for i in self.columns]

    def kept(self, r: Recording) -> slice:
        """Return which samples of a recording are still scored after the correction."""
        moved = self.read(r)
        return slice(moved.skip, len(moved) if len(moved) < len(r) else None)

    def keep(self, r: Recording) -> Recording:
        """Return the recording as it is, with the samples that the correction scores."""
        moved = self.read(r)
        return moved.with_(u=r.u[: len(moved)], y=r.y[: len(moved)])

    def remainder(self, first: FirstOrder, fitted: Fitted) -> Callable[[float], float]:
        """Return the mean square that parameters and initial states leave, as a function of the value.

        It is relative to what they leave of the same samples as recorded, because a shift leaves out samples at an end.
        """
        bench = first.bench

        @np.errstate(over="ignore", invalid="ignore")  # a diverging run leaves everything
        def left(value: float) -> float:
            moved = self.at(value, bench.dt)
            others = [moved.read(r, False, own) for r, own in zip(bench.recordings, curves, strict=True)]
            runs = as_recorded or list(map(fitted.simulate, others, fitted.initial))
            pairs = zip(runs, others, strict=True)
            error = np.concatenate([((y - other.y) / bench.scale)[other.skip :].ravel() for y, other in pairs])
            inside = zip(map(moved._recorded, bench.recordings), others, strict=True)
            known = np.concatenate([np.repeat(k[other.skip :], len(bench.scale)) for k, other in inside])
            if np.mean(known) < LEAST_RECORDED:
                return np.inf
            after, before = np.mean(first.project_off(np.column_stack([error, first.error]), known) ** 2, axis=0)
            return float(after / before) if np.isfinite(after) and before > 0 else np.inf

        curves = list(map(self.curves, bench.recordings))
        as_recorded = [] if self.kind == "u" else list(map(fitted.simulate, bench.recordings, fitted.initial))
        return left

    def relocate(self, now: Checked, after: Checked) -> Self:
        """Return the fault at the value with the smallest remainder nearby, hardly beyond the range tried."""
        width = now.bench.dt if self.finding == "alignment" else abs(self.value)
        most = BEYOND * self.largest(now.bench.dt)
        first = FirstOrder.of(replace(now.bench, scale=after.bench.scale), after.fitted)
        low, high = max(self.value - width, -most), min(self.value + width, most)
        value = minimise(self.remainder(first, after.fitted), low, high)[0]
        return self if abs(value - self.value) < 2e-3 * width else self.at(value, now.bench.dt)

    def largest(self, dt: float) -> float:
        """Return the largest value that is tried."""
        return float(RATES[-1] if self.finding == "clock" else LARGEST_SHIFT * dt)

    @property
    def delay(self) -> float:
        """Delay in seconds by which the machine would look the same: of a late output or of an early input."""
        return 0.0 if self.finding == "clock" else self.value if self.kind == "y" else -self.value

    @property
    def leads(self) -> bool:
        """Whether outputs come before their causes: an early output or a late input, which no physics explains."""
        return self.delay < 0

    def is_whole(self, dt: float) -> bool:
        """Tell whether it is a shift by whole samples, which needs no interpolation."""
        return self.finding == "alignment" and in_steps(self.value, dt)

    def is_like_delay(self, dt: float, step: float) -> bool:
        """Tell whether it may be a delay: by a fraction of `step` samples, or by few samples."""
        may_be = self.finding == "alignment" and self.delay > -WHOLE_SHIFT * dt
        return may_be and not (in_steps(self.delay, dt, step) and self.delay > LONG_SHIFT * dt)


def _samples(count: float) -> str:
    return "1 sample" if f"{count:.3g}" == "1" else f"{count:.3g} samples"


def _interpolant(r: Recording, v: np.ndarray, wraps: bool, smooth: bool) -> _Curve:
    """Interpolate a signal along a cubic spline or along its chords, as a function of time; ends are held."""
    end = len(r) * r.dt
    if not smooth:
        return lambda at: np.interp(at, r.t, v, period=end if wraps else None)
    from scipy.interpolate import CubicSpline

    if wraps:
        return CubicSpline(np.append(r.t, end), np.append(v, v[0]), bc_type="periodic")
    spline = CubicSpline(r.t, v)
    return lambda at: np.asarray(spline(np.clip(at, r.t[0], r.t[-1])))


@np.errstate(invalid="ignore")  # an infinite remainder has no parabola through it
def minimise(left: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Find the minimum of the remainder between two values; return its place and its value."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(left, bounds=(low, high), method="bounded", options={"maxiter": 20})
    return float(found.x), float(found.fun)


def in_steps(value: float, dt: float, step: float = 1.0) -> bool:
    """Tell whether a shift is a multiple of `step` samples."""
    return abs(value / dt - step * round(value / dt / step)) < WHOLE_SHIFT


def find_time_shift(now: Checked, shift_step: float = 1.0, correct_early: bool = True, given: bool = True) -> Checked:
    """Find a shifted channel or clock, and correct it if it is a fault of the recording.

    With `given`, the run at the user's values is screened as well as the refit. A shift that looks like a delay counts
    as a fault if it is a multiple of `shift_step` samples, nothing else is wrong, and no lag follows it as well.
    Without `correct_early`, one that puts outputs before their causes also counts as a fault only if nothing else is
    wrong.
    """
    dt, noise2 = now.bench.dt, now.noise2
    likeliest = _find_likeliest(now, given)
    if likeliest is None:
        return now
    fault, after, kept = likeliest
    found = accept(now, after, fault)
    if not found.adds_to(now):
        return found
    more_is_wrong = after.cost > NEAR_NOISE_RATIO**2 * noise2  # then a delay or a slow clock may be physics
    may_be_physics = fault.is_like_delay(dt, shift_step) or (more_is_wrong and not (fault.leads and correct_early))
    if may_be_physics or not satisfies_rule(kept.cost, after, fault) or _is_lag(now, after, fault):
        return now
    # interpolation has removed a part of the noise
    averaged = 0.0 if fault.kind == "u" or fault.is_whole(dt) else AVERAGED_NOISE * noise2
    rivals = find_rivals(kept, after, after.cost + averaged)
    words = fault.sentence[0].lower() + fault.sentence[1:] if fault.finding == "clock" else fault.sentence
    offsets = {port: words for port, law in rivals if law.id == Offset.id and in_series(port)}
    if offsets:
        return find_offsets(now, offsets)
    return now.then(now.bench, now.fitted, _describe_rivals(fault, rivals)) if rivals else found


def _describe_rivals(fault: TimeShift, rivals: Sequence[tuple[str, Law]]) -> Gate:
    """Note a shift or a clock rate that is not corrected, because gains or constant loads follow as well."""
    others = " or ".join(f"a {'gain' if law.id == Gain.id else 'constant load'} at {port}" for port, law in rivals)
    words = f"{fault.sentence}, or else {others} acts like that: these recordings do not tell which"
    return Gate(fault.channel, fault.finding, fault.value, f"{words}, and no time is changed.", corrected=False)


def _find_likeliest(now: Checked, given: bool) -> tuple[TimeShift, Checked, Checked] | None:
    """Return the shift or clock rate that follows best, the refit with it, and one without it to the same samples.

    None if only noise is left, no channel looks shifted, or the best value is beyond the range that is tried.
    """
    if now.cost < ABOVE_NOISE**2 * now.noise2:
        return None
    screened = _screen_shifts(now.bench, now.fitted, given)
    settled = [pair for s in screened if (pair := _settle_shift(now, s)) is not None]
    if not settled:
        return None
    fault, after = min(settled, key=lambda pair: pair[1].cost)
    kept = _on_kept_samples(now, fault, after)
    smaller = _find_smaller(kept, fault, after)
    if smaller is not None and (again := _settle_shift(now, smaller)) is not None:
        fault, after = again
        kept = _on_kept_samples(now, fault, after)
    return (fault, after, kept) if abs(fault.value) <= fault.largest(now.bench.dt) else None


def _on_kept_samples(now: Checked, fault: TimeShift, after: Checked) -> Checked:
    """Refit to the samples that a fault keeps, as they were recorded: fewer are followed more easily."""
    recordings = tuple(map(fault.keep, now.bench.recordings))
    bench, values = replace(now.bench, recordings=recordings, scale=after.bench.scale), now.fitted.values
    fitted = refit(bench, [values, after.fitted.values], states=now.fitted.begin, solver=THOROUGH)
    return now.then(bench, fitted or bench.rerun(now.fitted))


def _settle_shift(now: Checked, screened: TimeShift) -> tuple[TimeShift, Checked] | None:
    """Settle a shift or a clock rate; a shift of whole samples is preferred."""
    settled, dt = settle(now, screened), now.bench.dt
    if settled is None or settled[0].finding != "alignment":
        return settled
    fault, after = settled
    whole = fault.at(round(fault.value / dt) * dt, dt)
    near = correct(now, whole, [after.fitted.values, {}], after.fitted.begin)
    as_good = near is not None and near.cost < EQUAL_RATIO * after.cost + AVERAGED_NOISE * now.noise2
    return (whole, near) if near is not None and as_good else settled


def _find_smaller(kept: Checked, fault: TimeShift, after: Checked) -> TimeShift | None:
    """Find a smaller shift that follows the samples of this one as well, such as by a period less; None without one."""
    dt = kept.bench.dt
    count = int(abs(fault.value) / dt)
    if fault.finding != "alignment" or count < 2:
        return None
    left = fault.remainder(FirstOrder.of(kept.bench, kept.fitted), kept.fitted)
    values = dt * np.arange(1.0 - count, count)
    shares = np.array([left(float(v)) for v in values])
    inner = shares[1:-1]
    lowest = 1 + np.flatnonzero((inner <= shares[:-2]) & (inner <= shares[2:]) & (inner < CLEARLY_BETTER))
    for k in sorted(lowest, key=lambda k: abs(values[k]))[:MOST_SCREENED]:
        settled = _settle_shift(kept, fault.at(float(values[k]), dt))
        if settled is None or not abs(settled[0].value) < abs(fault.value) - dt:
            continue
        if not follows_better(after.cost, settled[1].cost, after.residuals):
            return settled[0]
    return None


def _is_lag(now: Checked, after: Checked, fault: TimeShift) -> bool:
    """Tell whether lags follow what looks like a delay better than the shift that was found."""
    if not fault.delay > 0:
        return False
    simulator = now.bench.simulator
    names, place = (simulator.output_names, "sensor") if fault.kind == "y" else (simulator.inputs, "actuator")
    slow = Lag().at({"T": fault.delay}, {"T": (now.bench.dt / 10, 10 * fault.delay)})
    for i in fault.columns:
        simulator = simulator.with_element(f"{place}:{names[i]}", slow)
    lagging = refit(now.bench, [after.fitted.values, {}], simulator, states=now.fitted.begin)
    return lagging is not None and lagging.cost < after.cost


def _screen_shifts(bench: Workbench, plain: Fitted, also_given: bool = True) -> list[TimeShift]:
    """List the shifts and clock rates that clearly reduce the remainder, best first, a few at most.

    A shift can lead the refit into a wrong minimum. Therefore the run at the user's values is screened too by default,
    unless it runs away.
    """
    outputs, inputs = bench.simulator.output_names, bench.simulator.inputs
    driven = not moves_freely(bench.recordings)  # else the times of outputs count only against each other
    channels: list[tuple[str, tuple[int, ...], str]] = []
    if driven or len(outputs) > 1:
        channels += [("y", (i,), name) for i, name in enumerate(outputs)]
    if driven and len(outputs) > 1:
        channels.append(("y", tuple(range(len(outputs))), ", ".join(outputs)))
    if driven and len(inputs) > 1:
        channels += [("u", (i,), name) for i, name in enumerate(inputs)]
    if not channels:
        return []
    found = list[tuple[float, TimeShift]]()
    given = [bench.run_given(plain)] if also_given else []
    for reference in (plain, *(one for one in given if one.cost < RUNAWAY**2)):
        first = FirstOrder.of(bench, reference)
        for kind, columns, name in channels:
            for finding, values in (("alignment", bench.dt * SHIFTS), ("clock", RATES)):
                fault = TimeShift(name, finding, 0.0, kind=kind, columns=columns, hold=bench.hold)
                left = fault.remainder(first, reference)
                shares = [left(float(v)) for v in values]
                k = int(np.argmin(shares))
                value, share = float(values[k]), shares[k]
                if finding == "clock":  # over a whole record, one step of a rate is many samples
                    value, share = minimise(left, values[max(k - 1, 0)], values[min(k + 1, len(values) - 1)])
                if share < CLEARLY_BETTER:
                    found.append((share, fault.at(value, bench.dt)))
    best = list[TimeShift]()
    for _, fault in sorted(found, key=lambda pair: pair[0]):
        known = [b.value for b in best if (b.channel, b.finding) == (fault.channel, fault.finding)]
        apart = bench.dt if fault.finding == "alignment" else np.inf
        if all(abs(fault.value - value) > apart for value in known) and len(known) < MOST_SHIFTS:
            best.append(fault)
    return best[:MOST_SCREENED]
