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

import numpy as np

from ..data import Recording
from ..simulators import states_along
from .floor import ABOVE_NOISE
from .gates import (
    AT_NOISE,
    CLEARLY,
    EXPLAINED,
    POOR_FIT,
    SAME,
    Change,
    Checked,
    FirstOrder,
    Gate,
    change_recordings,
    describe_fall,
    refit,
)
from .linearise import Run
from .workbench import THOROUGH, Fitted, Workbench

TURNS = 8  # alternations of edit and refit at most, until the edit is constant

SHIFTS = np.union1d(np.arange(-64.0, 65.0), np.linspace(-2.0, 2.0, 17))  # samples
# clock rates tried, as relative errors: 0.01 % to 5 %
RATES = np.concatenate([-np.geomspace(1e-4, 0.05, 28)[::-1], np.geomspace(1e-4, 0.05, 28)])
WHOLE = 0.12  # distance in samples within which a shift counts as whole
LONG = 4.5  # shift in samples above which a whole shift is a fault of the recording
AVERAGED = 0.5  # largest share of a channel's noise that interpolation between its samples removes

MOST_GAPS = 3  # gaps that are sought at most
WORSE = 2.0  # least ratio of the error left by a shock or a step to that left by a jump
SHARP = 1.1  # least ratio of the error left by a jump some samples away to that left by the jump
SHORTEST = 40  # samples of a piece at least
BESIDE = 5  # samples around a jump at which rivals are tried, and at which a drift would explain as much
BETWEEN = (-0.5, 0.0, 0.5)  # delays of a shock that are tried, in samples
RIDGE = 1e-6  # on the normal equations, against jumps that initial states can follow


@dataclass(frozen=True)
class TimeShift:
    """Channels (columns of "u" or "y") with wrong times: late by seconds, or from a clock that runs faster."""

    channel: str
    finding: str
    kind: str
    columns: tuple[int, ...]

    def change(self, value: float, cut: bool = True) -> Change:
        """Read the channels at another time; see `shift_channels`."""
        seconds, rate = (value, 0.0) if self.finding == "alignment" else (0.0, value)
        return shift_channels(self.kind, self.columns, seconds, rate, cut)

    def at(self, now: Checked, value: float, previous: Fitted) -> Checked | None:
        """Refit to the channels read at another time."""
        bench = change_recordings(now.bench, self.change(value))
        found = refit(bench, [{}, previous.values], states=previous.begin)
        return None if found is None else now.then(bench, found)


def shift_channels(kind: str, index: Sequence[int], seconds: float, rate: float = 0.0, cut: bool = True) -> Change:
    """Read some channels at `t + seconds + rate t`, interpolated.

    Samples from before the recording are skipped, samples from behind it are cut off. Without `cut`, the end values are
    held. A periodic recording wraps around.
    """

    def change(r: Recording) -> Recording:
        values, at = np.array(getattr(r, kind)), r.t * (1 + rate) + seconds
        end = len(r) * r.dt if r.period and len(r) % r.period == 0 and not rate else None
        for i in index:
            values[:, i] = _read(r.t, values[:, i], at, end, smooth=kind == "y")
        other = r.with_(**{kind: values})
        if kind == "y" and r.begins == "zero":  # the recording was at rest at its stated start
            other = other.with_(initial="estimate")
        if end is not None or not cut:
            return other
        early, late = int(np.sum(at < 0)), int(np.sum(at > r.t[-1] + 1e-9 * r.dt))
        if early:
            other = other.with_(skip=min(max(r.skip, early), len(r) - 2))
        return other.slice(0, max(len(r) - late, other.skip + 2)) if late else other

    return change


def _read(t: np.ndarray, v: np.ndarray, at: np.ndarray, end: float | None, smooth: bool) -> np.ndarray:
    """Interpolate a signal: an output along a cubic spline, an input along its chords; ends are held."""
    if not smooth:
        return np.interp(at, t, v, period=end)
    from scipy.interpolate import CubicSpline

    if end is None:
        return np.asarray(CubicSpline(t, v)(np.clip(at, t[0], t[-1])))
    return np.asarray(CubicSpline(np.append(t, end), np.append(v, v[0]), bc_type="periodic")(at))


def find_time_shift(now: Checked, part: float = 1.0, early: bool = True) -> Checked:
    """Find a shifted channel or clock, and correct it if it is a fault of the recording.

    A late channel counts as a fault if it is late by a multiple of `part` samples and nothing else is wrong. Without
    `early`, an early channel also counts as a fault only if nothing else is wrong.
    """
    bench, plain, noise2 = now.bench, now.fitted, now.noise2
    if plain.cost < ABOVE_NOISE**2 * noise2:
        return now
    best: tuple[float, TimeShift, float, Checked] | None = None
    for step, value in _screen_shifts(bench, plain):
        settled = _settle_shift(now, step, value)
        if settled is None:
            continue
        at, found = settled
        if step.finding == "alignment":
            whole = round(at / bench.dt) * bench.dt
            near = step.at(now, whole, found.fitted)
            if near is not None and near.cost < SAME * found.cost + AVERAGED * noise2:
                at, found = whole, near
        relative = found.cost * float(np.mean((found.bench.scale / bench.scale) ** 2))
        if best is None or relative < best[0]:
            best = relative, step, at, found
    if best is None or best[0] > EXPLAINED * plain.cost:
        return now
    left, step, at, found = best
    back = refit(bench, [{}, found.fitted.values], states=found.fitted.begin)
    if back is not None and left > EXPLAINED * back.cost:  # the shift only led the refit out of a local minimum
        return now.then(bench, back)
    value = at if step.kind == "y" else -at
    late = step.finding == "clock" or value > 0
    if (late or not early) and left > AT_NOISE**2 * noise2:
        return now  # a late channel or a slow clock may be physics if something else is wrong
    samples = value / bench.dt
    if step.finding == "alignment" and samples > -WHOLE and not (in_steps(value, bench.dt, part) and samples > LONG):
        return now  # late by a fraction of a sample or by little: a delay is physics
    sentence = f"{_shift_in_words(step, value, bench.dt)}; with it corrected {describe_fall(plain.cost, left)}"
    if left > AT_NOISE**2 * noise2:
        sentence += (
            f", still {(left / max(noise2, 1e-300)) ** 0.5:.2g} times the noise: more is wrong, with the time "
            "(samples that were lost, say) or otherwise"
        )
    gate = Gate(step.channel, step.finding, value, f"{sentence}.", fault=True, change=step.change(at))
    return found.then(found.bench, found.fitted, replace(gate, left=left / plain.cost))


def _shift_in_words(step: TimeShift, value: float, dt: float) -> str:
    if step.finding == "clock":
        return f"The clock of {step.channel} runs {value * 100:+.3g} % off the others'"
    word = "late" if value > 0 else "early"
    return f"{step.channel} is recorded {abs(value / dt):.3g} samples ({abs(value):.3g} s) too {word}"


def run_as_given(bench: Workbench, plain: Fitted) -> Fitted:
    """Run the simulator at the user's values, because a refit to shifted channels may be in a wrong minimum."""
    values = {name: p.value for name, p in bench.simulator.parameters.items()}
    unknown = [r.begins == "estimate" for r in bench.recordings]
    initial = [0 * state if u else state for u, state in zip(unknown, plain.initial, strict=True)]
    return bench.result(bench.simulator, values, initial, plain.engine, plain.model)


def in_steps(value: float, dt: float, part: float = 1.0) -> bool:
    """Tell whether a shift is a multiple of `part` samples."""
    return abs(value / dt - part * round(value / dt / part)) < WHOLE


def _screen_shifts(bench: Workbench, plain: Fitted) -> list[tuple[TimeShift, float]]:
    """List the shifts and clock rates that clearly reduce the remainder, best first, three at most."""
    outputs, inputs = bench.simulator.output_names, bench.simulator.inputs
    channels: list[tuple[str, tuple[int, ...], str]] = [("y", (i,), name) for i, name in enumerate(outputs)]
    if len(outputs) > 1:
        channels.append(("y", tuple(range(len(outputs))), ", ".join(outputs)))
    if len(inputs) > 1:
        channels += [("u", (i,), name) for i, name in enumerate(inputs)]
    steps = [TimeShift(name, finding, kind, i) for kind, i, name in channels for finding in ("alignment", "clock")]
    found = list[tuple[float, TimeShift, float]]()
    for reference in [plain] if plain.cost < POOR_FIT else [plain, run_as_given(bench, plain)]:
        first = FirstOrder.of(bench, reference)
        for step in steps:
            left = _remainder_of(first, reference, step)
            values = bench.dt * SHIFTS if step.finding == "alignment" else RATES
            shares = [left(float(v)) for v in values]
            k = int(np.argmin(shares))
            value, share = float(values[k]), shares[k]
            if step.finding == "clock":  # over a whole record, one step of a rate is many samples
                value, share = _minimise(left, values[max(k - 1, 0)], values[min(k + 1, len(values) - 1)])
            if share < CLEARLY * left(0.0):
                found.append((share / left(0.0), step, value))
    best = dict[TimeShift, float]()
    for _, step, value in sorted(found, key=lambda t: t[0]):
        best.setdefault(step, value)
    return list(best.items())[:3]


def _remainder_of(first: FirstOrder, fitted: Fitted, step: TimeShift) -> Callable[[float], float]:
    """Return the mean square that parameters and initial states leave, as a function of shift or clock rate."""
    recordings = first.bench.recordings

    def simulated(r: Recording, state: np.ndarray) -> np.ndarray:
        return np.asarray(fitted.engine.simulate(fitted.model.drive(r), fitted.vector, state)[0])

    @np.errstate(over="ignore", invalid="ignore")  # a diverging run leaves everything
    def left(value: float) -> float:
        others = list(map(step.change(value, cut=False), recordings))
        y = as_recorded or map(simulated, others, fitted.initial)
        parts = [((v - other.y) / first.bench.scale)[other.skip :].ravel() for v, other in zip(y, others, strict=True)]
        mean = float(np.mean(first.left(np.concatenate(parts)) ** 2))
        return mean if np.isfinite(mean) else np.inf

    as_recorded = [] if step.kind == "u" else list(map(simulated, recordings, fitted.initial))
    return left


def _minimise(left: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Find the minimum of the remainder between two values; return its place and its value."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(left, bounds=(low, high), method="bounded", options={"maxiter": 20})
    return float(found.x), float(found.fun)


def _settle_shift(now: Checked, step: TimeShift, at: float) -> tuple[float, Checked] | None:
    """Refit parameters and shift in turn, until the shift is constant."""
    best: tuple[float, Checked] | None = None
    previous, width = now.fitted, now.bench.dt if step.finding == "alignment" else abs(at)
    for _ in range(TURNS):
        found = step.at(now, at, previous)
        if found is None:
            break
        if best is None or found.cost < best[1].cost:
            best = at, found
        previous = found.fitted
        first = FirstOrder.of(replace(now.bench, scale=found.bench.scale), previous)
        moved = _minimise(_remainder_of(first, previous, step), at - width, at + width)[0]
        if abs(moved - at) < 2e-3 * width:
            break
        at = moved
    return best


# lost samples


Origin = tuple[str, int]  # label of the recording as given, and the sample at which a piece begins


@dataclass(frozen=True)
class Jump:
    """A jump of the state at a sample of a recording; the shares are those of the mean square that it removes.

    Attributes
    ----------
    rival : float
        Share that a shock nearby, or a step of one force or sensor there, removes.
    beside : float
        Share that a jump some samples away removes.
    size : array, shape (n_x,)
        The jump.
    """

    recording: int
    sample: int
    share: float
    rival: float
    beside: float
    size: np.ndarray

    def beats(self, other: float, times: float) -> bool:
        """Tell whether a rival that removes the share `other` leaves more than `times` this jump's error."""
        return 1 - other > times * max(1 - self.share, 0.0)


def find_gaps(now: Checked) -> Checked:
    """Find lost samples; cut the recordings there if that removes most of the mismatch.

    The state at the first sample of a later piece is estimated. Recordings in periodic steady state are not checked.
    """
    noise2 = min(now.noise2, _quiet_noise2(now) or np.inf)
    origins: list[Origin] = [(r.label, 0) for r in now.bench.recordings]
    last, kept = now, list[tuple[Checked, list[Origin]]]()
    while len(origins) - len(now.bench.recordings) < MOST_GAPS and last.cost > ABOVE_NOISE**2 * noise2:
        settled = _settle_jump(last)
        if settled is None or not settled[0].beats(settled[0].rival, SAME**2):
            break
        (jump, last), at = settled, settled[0].recording + 1
        origins = [*origins[:at], (origins[at - 1][0], origins[at - 1][1] + jump.sample), *origins[at:]]
        # jumps around a drift also imitate it
        sharp = jump.beats(jump.beside, SHARP) or last.cost < AT_NOISE**2 * noise2
        if sharp and jump.beats(jump.rival, WORSE) and last.cost < EXPLAINED * now.cost:
            kept.append((last, origins))
    if not kept:
        return now
    found, origins = kept[-1]
    pieces = [_name_piece(r, begin) for r, (_, begin) in zip(found.bench.recordings, origins, strict=True)]
    gate = _describe_gaps(now, [o for o in origins if o[1]], found.cost)
    return now.then(replace(found.bench, recordings=tuple(pieces)), found.fitted, gate)


def _name_piece(r: Recording, begin: int) -> Recording:
    """Name a piece by the time at which it begins."""
    return r.with_(name=f"{r.name} from {begin * r.dt:.6g} s".strip()) if begin else r


def _run_at(bench: Workbench, fitted: Fitted, initial: list[np.ndarray]) -> Fitted:
    """Run another bench's fit on this bench's recordings, at its values."""
    return bench.result(bench.simulator, fitted.values, initial, fitted.engine, fitted.model)


def _settle_jump(now: Checked) -> tuple[Jump, Checked] | None:
    """Repeat jump and fit to the pieces until the jump is constant: a fit across a gap may be in a wrong minimum."""
    bench, along = now.bench, now.fitted
    best: tuple[Jump, Checked] | None = None
    for _ in range(TURNS):
        jump = find_jump(bench, along)
        if jump is None or jump.share < 1 - CLEARLY:
            break
        i, r = jump.recording, bench.recordings[jump.recording]
        if best is not None and (i, jump.sample) == (best[0].recording, best[0].sample):
            return jump, best[1]
        pieces = r.slice(0, jump.sample), r.slice(jump.sample).with_(initial="estimate", period=None)
        other = replace(bench, recordings=(*bench.recordings[:i], *pieces, *bench.recordings[i + 1 :]))
        states = [*along.begin[: i + 1], _state_after(along, r, jump), *along.begin[i + 1 :]]
        found = refit(other, [along.values, {}], states=states, solver=THOROUGH, like=now.fitted)
        if found is None:
            break
        best = jump, now.then(other, found)
        along = _run_at(bench, found, [*found.initial[: i + 1], *found.initial[i + 2 :]])
    return best


def _quiet_noise2(now: Checked) -> float:
    """Estimate the mean square of white noise from the median of third differences, which is robust to a few jumps."""
    thirds = np.abs(np.concatenate([np.diff(e, 3, axis=0) for e in now.fitted.residual]))
    return float(np.mean((1.4826 * np.median(thirds, axis=0) / now.bench.scale) ** 2) / 20)


@np.errstate(over="ignore", invalid="ignore")
def find_jump(bench: Workbench, fitted: Fitted) -> Jump | None:
    """Find the jump of the states that removes most error, to first order; None if gaps cannot be detected."""
    simulator = bench.simulator
    if not simulator.kinematic:
        return None
    first = FirstOrder.of(bench, fitted)
    runs, base, error = first.runs, first.base, first.left(first.error)
    n_x = len(simulator.states)
    moved = [i for i, name in enumerate(simulator.states) if name not in simulator.kinematic]
    best: Jump | None = None
    at = 0
    for i, (r, one) in enumerate(zip(bench.recordings, runs, strict=True)):
        rows = slice(at, at + (len(r) - r.skip) * r.n_y)
        at = rows.stop
        if r.begins == "periodic" or len(r) - r.skip < 2 * SHORTEST:
            continue
        shares, rivals, sizes = _jump_shares(one, bench.scale, base[rows], error[rows], r.skip, n_x, moved)
        shares[: r.skip + SHORTEST] = shares[len(r) - SHORTEST :] = 0.0
        k = int(np.argmax(shares))
        if best is None or shares[k] > best.share:
            rival = float(np.max(rivals[max(k - BESIDE, 0) : k + BESIDE + 1]))
            beside = float(max(shares[k - BESIDE], shares[k + BESIDE]))
            best = Jump(i, k, float(shares[k]), rival, beside, sizes[k])
    total = max(float(error @ error), 1e-300)
    if best is None:
        return None
    return replace(best, share=best.share / total, rival=best.rival / total, beside=best.beside / total)


def _jump_shares(
    run: Run, scale: np.ndarray, base: np.ndarray, error: np.ndarray, skip: int, n_x: int, moved: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute, at each sample, the share that the best jump of the state removes, its best rival's share, and the jump.

    Shapes (M,), (M,) and (M, n_x); `moved` are the states that a shock moves. Forces that stay constant from a sample
    on are further states.
    """
    m, n_y, n = run.c.shape
    forces = run.b[:, :, run.n_free :]
    full, n_b = n + forces.shape[2], base.shape[1]
    a = np.tile(np.eye(full), (m, 1, 1))
    a[:, :n, :n], a[:, :n, n:] = run.a, forces
    c = np.concatenate([run.c, run.d[:, :, run.n_free :]], axis=2) / scale[:, None]
    read = np.zeros((m, n_y, n_b + 1))
    read[skip:] = np.column_stack([base, error]).reshape(m - skip, n_y, n_b + 1)
    s, g = np.zeros((full, full)), np.zeros((full, n_b + 1))
    size2, left, along = np.zeros((m, full, full)), np.zeros((m, full, full)), np.zeros((m, full))
    for k in range(m - 1, skip - 1, -1):
        s = c[k].T @ c[k] + a[k].T @ s @ a[k]
        g = c[k].T @ read[k] + a[k].T @ g
        size2[k], left[k], along[k] = s, s - g[:, :n_b] @ g[:, :n_b].T, g[:, n_b]
    unit, shock = np.eye(full), np.eye(full)[:, list(moved)]
    taken, size = _solve_jumps(left, size2, along, unit[:, :n_x])
    later = a - np.eye(full)
    later[:, :, n:] = 0.0
    rivals = [shock + part * later @ shock for part in BETWEEN] + [unit[:, [j]] for j in range(n, full)]
    return taken, np.max([_solve_jumps(left, size2, along, way)[0] for way in rivals], axis=0), size


def _solve_jumps(left: np.ndarray, s: np.ndarray, e: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the shares that jumps along some directions, (n, k) or (M, n, k), remove, and their lengths."""
    across = np.swapaxes(ways, -1, -2)
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", across @ s @ ways), 0.0))
    size = np.where(size > 0, size, 1.0)
    matrix = across @ left @ ways / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(ways.shape[-1])
    wanted = (across @ e[:, :, None])[:, :, 0] / size
    lost = ~(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1))  # the run diverges
    matrix[lost], wanted[lost] = np.eye(ways.shape[-1]), 0.0
    found = np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0]
    return np.sum(found * wanted, axis=1), found / size


def _state_after(fitted: Fitted, r: Recording, jump: Jump) -> np.ndarray:
    """Compute the simulator's own states after a jump, to first order."""
    model = fitted.model
    states = states_along(model, model.drive(r), fitted.vector, fitted.initial[jump.recording])
    return np.asarray(states[jump.sample * model.substeps, : len(jump.size)] - jump.size)


def _describe_gaps(now: Checked, places: Sequence[Origin], after: float) -> Gate:
    """Describe the gaps before some samples in a gate."""
    ordered = sorted(places)
    bench, before = now.bench, now.cost
    dt, several = bench.dt, len({label for label, _ in ordered}) > 1 or len(bench.recordings) > 1
    at = " and ".join(f"t = {k * dt:.6g} s (sample {k}{f' of {label}' if several else ''})" for label, k in ordered)
    names = ", ".join([*bench.simulator.inputs, *bench.simulator.output_names])
    sentence = (
        f"Samples are missing just before {at}: the state jumps there as no force and no shock could make it, as where "
        f"a logger lost some and counted on. With the recording cut there {describe_fall(before, after)}."
    )
    return Gate(names, "gap", [k * dt for _, k in ordered], sentence, fault=True, left=after / before)
