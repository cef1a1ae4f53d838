"""Faults of time: a channel recorded too early or too late, or by another clock; lost samples.

Shifts and clocks. One channel is read at another time, and the error of the refitted simulator is projected off the
directions that parameters and initial states can follow. The shift (or clock rate) with the smallest remainder is
confirmed by a refit. A late output may be physics (a delay). A shift of many whole samples is typical of a recorder,
and an output before its cause can be nothing else.

Gaps. If samples were lost and the time was renumbered, every state jumps at once. Along the refitted run, a jump δ of
the state at sample k changes the later outputs by `Φ_k δ`. With e the error that parameters and initial states leave,
and base the directions that these can follow, the best jump removes

    s' (S - G G')⁻¹ s,    S = Φ_k'Φ_k,  G = Φ_k' base,  s = Φ_k' e

of e'e. S, G and s follow from those of the next sample by recursion, so that every sample is tried. A shock or a stop
moves no state that is the integral of another, and a step of a force or of a sensor moves none. If one of these
explains about as much, or if no state is such an integral, no gap is reported. A jump is confirmed by a refit to the
two pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from ..data import Recording
from ..laws import Lag
from ..simulators import states_along
from .floor import ABOVE_NOISE, third_differences
from .gates import (
    CLEARLY_BETTER,
    CURED_SHARE,
    EQUAL_RATIO,
    NEAR_NOISE_RATIO,
    POOR_FIT,
    Checked,
    FirstOrder,
    Gate,
    accept,
    correct,
    refit,
    robust_deviation,
    settle,
)
from .linearise import Run
from .workbench import THOROUGH, Fitted, Workbench

SHIFTS = np.union1d(np.arange(-64.0, 65.0), np.linspace(-2.0, 2.0, 17))  # samples
# clock rates tried, as relative errors: 0.01 % to 5 %
RATES = np.concatenate([-np.geomspace(1e-4, 0.05, 28)[::-1], np.geomspace(1e-4, 0.05, 28)])
WHOLE_SHIFT = 0.12  # distance in samples within which a shift counts as whole
LONG_SHIFT = 4.5  # shift in samples above which a whole shift is a fault of the recording
AVERAGED_NOISE = 0.5  # largest share of a channel's noise that interpolation between its samples removes

MOST_GAPS = 3  # gaps that are sought at most
SHORTEST_PIECE = 40  # samples of a piece at least
RIVAL_DISTANCE = 5  # samples around a jump at which rivals are tried, and at which a drift would explain as much
SHOCK_DELAYS = (-0.5, 0.0, 0.5)  # delays of a shock that are tried, in samples
RIDGE = 1e-6  # on the normal equations, against jumps that initial states can follow

_Curve = Callable[[np.ndarray], np.ndarray]  # a signal over time


@dataclass(frozen=True)
class TimeShift(Gate):
    """Channels (columns of "u" or "y") with wrong times: late by seconds, or from a clock that runs faster."""

    kind: str = "y"
    columns: tuple[int, ...] = (0,)
    parameters: ClassVar[int] = 1

    def at(self, value: float, dt: float) -> Self:
        """Return the fault with another shift or clock rate."""
        words = f"The clock of {self.channel} runs {value * 100:+.3g} % off the others'"
        if self.finding == "alignment":
            late = "late" if value > 0 else "early"
            words = f"{self.channel} is recorded {abs(value / dt):.3g} samples ({abs(value):.3g} s) too {late}"
            words += ", or the machine delays it by as much" if self.kind == "y" and value > 0 else ""
        moved = replace(self, value=value, sentence=words)
        return replace(moved, change=moved.read)

    def read(self, r: Recording, cut: bool = True, curves: Sequence[_Curve] = ()) -> Recording:
        """Read the channels at the times of the others, interpolated: outputs by cubic splines, inputs by chords.

        Samples from before the recording are skipped, samples from behind it are cut off. Without `cut`, the end values
        are held. A periodic recording wraps around. `curves` are those of the recording where they are known.
        """
        change = self.value if self.kind == "y" else -self.value
        at = r.t + change if self.finding == "alignment" else r.t * (1 + change)
        wraps = self._wraps(r)
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

    def _wraps(self, r: Recording) -> bool:
        return bool(r.period) and len(r) % (r.period or 1) == 0 and self.finding == "alignment"

    def curves(self, r: Recording) -> list[_Curve]:
        """Interpolate the channels, whatever the value."""
        values = getattr(r, self.kind)
        return [_interpolant(r, values[:, i], self._wraps(r), smooth=self.kind == "y") for i in self.columns]

    def remainder(self, first: FirstOrder, fitted: Fitted) -> Callable[[float], float]:
        """Return the mean square that parameters and initial states leave, as a function of the value."""
        bench = first.bench

        def simulate(r: Recording, state: np.ndarray) -> np.ndarray:
            return np.asarray(fitted.engine.simulate(fitted.model.drive(r), fitted.vector, state)[0])

        @np.errstate(over="ignore", invalid="ignore")  # a diverging run leaves everything
        def left(value: float) -> float:
            moved = self.at(value, bench.dt)
            others = [moved.read(r, False, own) for r, own in zip(bench.recordings, curves, strict=True)]
            runs = as_recorded or list(map(simulate, others, fitted.initial))
            pairs = zip(runs, others, strict=True)
            error = np.concatenate([((y - other.y) / bench.scale)[other.skip :].ravel() for y, other in pairs])
            mean = float(np.mean(first.left(error) ** 2))
            return mean if np.isfinite(mean) else np.inf

        curves = list(map(self.curves, bench.recordings))
        as_recorded = [] if self.kind == "u" else list(map(simulate, bench.recordings, fitted.initial))
        return left

    def relocate(self, now: Checked, after: Checked) -> Self:
        """Return the fault at the value with the smallest remainder nearby."""
        width = now.bench.dt if self.finding == "alignment" else abs(self.value)
        first = FirstOrder.of(replace(now.bench, scale=after.bench.scale), after.fitted)
        value = _minimise(self.remainder(first, after.fitted), self.value - width, self.value + width)[0]
        return self if abs(value - self.value) < 2e-3 * width else self.at(value, now.bench.dt)

    def is_like_delay(self, dt: float, part: float) -> bool:
        """Tell whether it is late as by a delay: by a fraction of `part` samples, or by little."""
        late = self.finding == "alignment" and self.value > -WHOLE_SHIFT * dt
        return late and not (in_steps(self.value, dt, part) and self.value > LONG_SHIFT * dt)


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


def _minimise(left: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Find the minimum of the remainder between two values; return its place and its value."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(left, bounds=(low, high), method="bounded", options={"maxiter": 20})
    return float(found.x), float(found.fun)


def in_steps(value: float, dt: float, part: float = 1.0) -> bool:
    """Tell whether a shift is a multiple of `part` samples."""
    return abs(value / dt - part * round(value / dt / part)) < WHOLE_SHIFT


def find_time_shift(now: Checked, part: float = 1.0, early: bool = True) -> Checked:
    """Find a shifted channel or clock, and correct it if it is a fault of the recording.

    A late channel counts as a fault if it is late by a multiple of `part` samples, nothing else is wrong, and no lag
    follows it as well. Without `early`, an early channel also counts as a fault only if nothing else is wrong.
    """
    bench, noise2 = now.bench, now.noise2
    if now.cost < ABOVE_NOISE**2 * noise2:
        return now
    best: tuple[TimeShift, Checked] | None = None
    for screened in _screen_shifts(bench, now.fitted):
        settled = settle(now, screened)
        if settled is None:
            continue
        fault, after = settled
        if fault.finding == "alignment":
            whole = fault.at(round(fault.value / bench.dt) * bench.dt, bench.dt)
            near = correct(now, whole, [after.fitted.values, {}], after.fitted.begin)
            if near is not None and near.cost < EQUAL_RATIO * after.cost + AVERAGED_NOISE * noise2:
                fault, after = whole, near
        if best is None or after.cost < best[1].cost:
            best = fault, after
    if best is None:
        return now
    fault, after = best
    found = accept(now, after, fault)
    if len(found.gates) == len(now.gates):
        return found
    late = fault.finding == "clock" or fault.value > 0
    more_is_wrong = after.cost > NEAR_NOISE_RATIO**2 * noise2  # then a late channel or a slow clock may be physics
    may_be_physics = fault.is_like_delay(bench.dt, part) or (more_is_wrong and (late or not early))
    return now if may_be_physics or _is_lag(now, after, fault) else found


def _is_lag(now: Checked, after: Checked, fault: TimeShift) -> bool:
    """Tell whether lags follow a late channel better than the shift that was found."""
    if fault.finding == "clock" or (fault.value > 0) != (fault.kind == "y"):  # an early input looks like late outputs
        return False
    simulator = now.bench.simulator
    names, place = (simulator.output_names, "sensor") if fault.kind == "y" else (simulator.inputs, "actuator")
    slow = Lag().at({"T": abs(fault.value)}, {"T": (now.bench.dt / 10, 10 * abs(fault.value))})
    for i in fault.columns:
        simulator = simulator.with_element(f"{place}:{names[i]}", slow)
    lagging = refit(now.bench, [after.fitted.values, {}], simulator, states=now.fitted.begin)
    return lagging is not None and lagging.cost < after.cost


def run_as_given(bench: Workbench, plain: Fitted) -> Fitted:
    """Run the simulator at the user's values, because a refit to shifted channels may be in a wrong minimum."""
    values = {name: p.value for name, p in bench.simulator.parameters.items()}
    unknown = [r.begins == "estimate" for r in bench.recordings]
    initial = [0 * state if u else state for u, state in zip(unknown, plain.initial, strict=True)]
    return bench.result(bench.simulator, values, initial, plain.engine, plain.model)


def _screen_shifts(bench: Workbench, plain: Fitted) -> list[TimeShift]:
    """List the shifts and clock rates that clearly reduce the remainder, best first, three at most."""
    outputs, inputs = bench.simulator.output_names, bench.simulator.inputs
    channels: list[tuple[str, tuple[int, ...], str]] = [("y", (i,), name) for i, name in enumerate(outputs)]
    if len(outputs) > 1:
        channels.append(("y", tuple(range(len(outputs))), ", ".join(outputs)))
    if len(inputs) > 1:
        channels += [("u", (i,), name) for i, name in enumerate(inputs)]
    found = list[tuple[float, TimeShift]]()
    for reference in [plain] if plain.cost < POOR_FIT else [plain, run_as_given(bench, plain)]:
        first = FirstOrder.of(bench, reference)
        for kind, columns, name in channels:
            for finding, values in (("alignment", bench.dt * SHIFTS), ("clock", RATES)):
                fault = TimeShift(name, finding, 0.0, kind=kind, columns=columns)
                left = fault.remainder(first, reference)
                shares = [left(float(v)) for v in values]
                k = int(np.argmin(shares))
                value, share = float(values[k]), shares[k]
                if finding == "clock":  # over a whole record, one step of a rate is many samples
                    value, share = _minimise(left, values[max(k - 1, 0)], values[min(k + 1, len(values) - 1)])
                if share < CLEARLY_BETTER * left(0.0):
                    found.append((share / left(0.0), fault.at(value, bench.dt)))
    best = dict[tuple[str, str], TimeShift]()
    for _, fault in sorted(found, key=lambda pair: pair[0]):
        best.setdefault((fault.channel, fault.finding), fault)
    return list(best.values())[:3]


# lost samples


@dataclass(frozen=True, eq=False)
class Jump(Gate):
    """A jump of the state, as where samples were lost; until it is reported, its value is (recording, sample).

    Attributes
    ----------
    share : float
        Share of the mean square that the jump removes.
    rival : float
        Share that a shock nearby, or a step of one force or sensor there, removes.
    beside : float
        Share that a jump some samples away removes.
    states : list of array
        Initial states of the recordings when this one is cut there.
    places : tuple of (int, int)
        Once reported: each recording that is cut, and the sample at which its later piece begins.
    """

    share: float = 0.0
    rival: float = 0.0
    beside: float = 0.0
    states: Sequence[np.ndarray] = ()
    places: tuple[tuple[int, int], ...] = ()
    remedy: ClassVar[str] = "with the recording cut there"

    def beats(self, other: float, share: float) -> bool:
        """Tell whether this jump leaves at most a share of the error that a rival leaves, which removes `other`."""
        return 1 - self.share < share * (1 - other)

    def apply(self, bench: Workbench) -> Workbench:
        """Cut the recording; the state at the first sample of the later piece is estimated."""
        i, k = self.value
        r = bench.recordings[i]
        pieces = r.slice(0, k), r.slice(k).with_(initial="estimate", period=None)
        return replace(bench, recordings=(*bench.recordings[:i], *pieces, *bench.recordings[i + 1 :]))

    def apply_to_whole(self, whole: list[Recording], places: Sequence[tuple[int, int]]) -> list[Recording]:
        """Cut the recordings where samples are missing in a stretch."""
        out = list(whole)
        for i, k in sorted(((places[i][0], places[i][1] + k) for i, k in self.places), reverse=True):
            r = out[i]
            later = r.slice(k).with_(initial="estimate", period=None, name=f"{r.name} from {k * r.dt:.6g} s".strip())
            out[i : i + 1] = [r.slice(0, k), later]
        return out

    def begin(self, previous: Fitted) -> Sequence[np.ndarray]:
        """Return the states after the jump for the later piece."""
        return self.states

    def relocate(self, now: Checked, after: Checked) -> Jump | None:
        """Find the jump along the run that a fit to the two pieces makes of the whole recording."""
        fitted, bench = after.fitted, now.bench
        initial = [x for i, x in enumerate(fitted.initial) if i != self.value[0] + 1]
        return find_jump(bench, bench.result(bench.simulator, fitted.values, initial, fitted.engine, fitted.model))


def settle_jump(now: Checked) -> tuple[Jump, Checked] | None:
    """Find a jump, and fit the two pieces; the jump is repeated until it stays."""
    jump = find_jump(now.bench, now.fitted)
    return None if jump is None else settle(now, jump, THOROUGH)


def find_gaps(now: Checked) -> Checked:
    """Find lost samples; cut the recordings there if the rule accepts it.

    The state at the first sample of a later piece is estimated. Recordings in periodic steady state are not checked.
    """
    noise2 = min(now.noise2, _quiet_noise2(now) or np.inf)
    origins = [(r, 0) for r in now.bench.recordings]  # recording as given, and the sample at which a piece begins
    last, found = now, now
    while len(origins) - len(now.bench.recordings) < MOST_GAPS and last.cost > ABOVE_NOISE**2 * noise2:
        settled = settle_jump(last)
        if settled is None or not settled[0].beats(settled[0].rival, 1 / EQUAL_RATIO**2):
            break
        jump, last = settled
        i, k = jump.value
        r, begin = origins[i]
        origins.insert(i + 1, (r, begin + k))
        # jumps around a drift also imitate it
        sharp = jump.beats(jump.beside, CLEARLY_BETTER) or last.cost < NEAR_NOISE_RATIO**2 * noise2
        if sharp and jump.beats(jump.rival, CURED_SHARE):
            accepted = accept(now, _name_pieces(last, origins), _describe_gaps(jump, origins))
            found = accepted if len(accepted.gates) > len(now.gates) else found
    return found


def _name_pieces(now: Checked, origins: Sequence[tuple[Recording, int]]) -> Checked:
    """Name each piece by the time at which it begins."""
    named = [
        piece.with_(name=f"{r.name} from {k * r.dt:.6g} s".strip()) if k else piece
        for piece, (r, k) in zip(now.bench.recordings, origins, strict=True)
    ]
    return now.then(replace(now.bench, recordings=tuple(named)), now.fitted)


def _describe_gaps(jump: Jump, origins: Sequence[tuple[Recording, int]]) -> Gate:
    """Describe the gaps before some samples."""
    gaps = sorted([(r.label, k, k * r.dt) for r, k in origins if k])
    several = len({id(r) for r, _ in origins}) > 1
    at = " and ".join(f"t = {t:.6g} s (sample {k}{f' of {label}' if several else ''})" for label, k, t in gaps)
    words = (
        f"Samples are missing just before {at}: the state jumps there as no force and no shock could make it, as where "
        "a logger lost some and counted on"
    )
    given = list(dict.fromkeys(id(r) for r, _ in origins))  # the recordings in their order
    places = tuple((given.index(id(r)), k) for r, k in origins if k)
    return replace(jump, value=[t for _, _, t in gaps], sentence=words, places=places)


def _quiet_noise2(now: Checked) -> float:
    """Estimate the mean square of white noise from third differences, not disturbed by a few jumps."""
    thirds = np.concatenate([third_differences(e) for e in now.fitted.residual])
    return float(np.mean((robust_deviation(thirds) / now.bench.scale) ** 2))


@np.errstate(over="ignore", invalid="ignore")
def find_jump(bench: Workbench, fitted: Fitted) -> Jump | None:
    """Find the jump of the states that removes most error, to first order; None if gaps cannot be detected."""
    simulator = bench.simulator
    if not simulator.kinematic:
        return None
    first = FirstOrder.of(bench, fitted)
    error = first.left(first.error)
    total, at = max(float(error @ error), 1e-300), 0
    moved = [i for i, name in enumerate(simulator.states) if name not in simulator.kinematic]
    best, best_size = Jump(", ".join([*simulator.inputs, *simulator.output_names]), "gap", None), np.zeros(0)
    for i, (r, one) in enumerate(zip(bench.recordings, first.runs, strict=True)):
        rows = slice(at, at + (len(r) - r.skip) * r.n_y)
        at = rows.stop
        if r.begins == "periodic" or len(r) - r.skip < 2 * SHORTEST_PIECE:
            continue
        read = np.column_stack([first.base, error])[rows].reshape(-1, r.n_y, first.base.shape[1] + 1)
        shares, rivals, sizes = _jump_shares(one, bench.scale, read, r.skip, len(simulator.states), moved)
        shares, rivals = shares / total, rivals / total
        shares[: r.skip + SHORTEST_PIECE] = shares[len(r) - SHORTEST_PIECE :] = 0.0
        k = int(np.argmax(shares))
        if shares[k] > best.share:
            around = slice(max(k - RIVAL_DISTANCE, 0), k + RIVAL_DISTANCE + 1)
            rival, beside = float(np.max(rivals[around])), float(max(shares[around.start], shares[k + RIVAL_DISTANCE]))
            best = replace(best, value=(i, k), share=float(shares[k]), rival=rival, beside=beside)
            best_size = sizes[k]
    if best.share < 1 - CLEARLY_BETTER:
        return None
    (i, k), model = best.value, fitted.model
    run = states_along(model, model.drive(bench.recordings[i]), fitted.vector, fitted.initial[i])
    state = run[k * model.substeps, : len(best_size)] - best_size
    return replace(best, states=[*fitted.begin[: i + 1], np.asarray(state), *fitted.begin[i + 1 :]])


def _jump_shares(
    run: Run, scale: np.ndarray, read: np.ndarray, skip: int, n_x: int, moved: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute, at each sample, what the best jump of the state removes, what its best rival removes, and the jump.

    `read` are the base and the error from `skip` on, `moved` the states that a shock moves. Shapes of the results are
    (M,), (M,) and (M, n_x). Forces that stay constant from a sample on are further states.
    """
    m, _, n = run.c.shape
    forces = run.b[:, :, run.n_free :]
    full, n_b = n + forces.shape[2], read.shape[2] - 1
    a = np.tile(np.eye(full), (m, 1, 1))
    a[:, :n, :n], a[:, :n, n:] = run.a, forces
    c = np.concatenate([run.c, run.d[:, :, run.n_free :]], axis=2) / scale[:, None]
    s, g = np.zeros((full, full)), np.zeros((full, n_b + 1))
    size2, left, along = np.zeros((m, full, full)), np.zeros((m, full, full)), np.zeros((m, full))
    for k in range(m - 1, skip - 1, -1):
        s = c[k].T @ c[k] + a[k].T @ s @ a[k]
        g = c[k].T @ read[k - skip] + a[k].T @ g
        size2[k], left[k], along[k] = s, s - g[:, :n_b] @ g[:, :n_b].T, g[:, n_b]
    unit, shock = np.eye(full), np.eye(full)[:, list(moved)]
    removed, size = _solve_jumps(left, size2, along, unit[:, :n_x])
    later = a - np.eye(full)
    later[:, :, n:] = 0.0
    rivals = [shock + part * later @ shock for part in SHOCK_DELAYS] + [unit[:, [j]] for j in range(n, full)]
    return removed, np.max([_solve_jumps(left, size2, along, way)[0] for way in rivals], axis=0), size


def _solve_jumps(left: np.ndarray, s: np.ndarray, e: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute what jumps along some directions, (n, k) or (M, n, k), remove, and their lengths."""
    across = np.swapaxes(ways, -1, -2)
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", across @ s @ ways), 0.0))
    size = np.where(size > 0, size, 1.0)
    matrix = across @ left @ ways / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(ways.shape[-1])
    wanted = (across @ e[:, :, None])[:, :, 0] / size
    lost = ~(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1))  # the run diverges
    matrix[lost], wanted[lost] = np.eye(ways.shape[-1]), 0.0
    found = np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0]
    return np.sum(found * wanted, axis=1), found / size
