"""Gates of time: a channel that was recorded too early or too late, or by a clock that runs differently.

The residual of the refitted simulator, with one channel read at another time, is projected off what the simulator's own
parameters and initial states can follow; the shift (or clock rate) with the smallest remainder is confirmed by a
refit. A late output may be physics (a delay); a shift of many whole samples is the mark of a recorder, and an output
that comes before its cause is nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .gates import Change, Gate, changed, refit, shifted
from .linearise import linearised
from .remainder import followed
from .workbench import Fitted, Workbench

SHIFTS = np.union1d(np.arange(-64.0, 65.0), np.linspace(-2.0, 2.0, 17))  # samples
RATES = np.concatenate([-np.geomspace(1e-4, 0.05, 28)[::-1], np.geomspace(1e-4, 0.05, 28)])
WHOLE = 0.12  # samples within which a shift counts as whole
LONG = 4.5  # samples beyond which a whole shift is a fault of the recording
FAR = 0.04  # mean square error of a refit that may have gone astray
PROMISING = 0.7  # share of the remainder that a shift or clock rate worth a refit leaves
NOTHING = 0.02  # share of the mean square that a late channel which is all that is wrong leaves at most
ALONE = 5.0  # times the noise that a shift or a clock leaves which is not all that is wrong
AVERAGED = 0.4  # of a channel's noise, which reading it between its samples takes away
DROP = 0.3  # share of the mean square that has to be left at most

Trial = tuple[float, str, str, float, str, tuple[int, ...]]  # share left, channel, what, value, "u" or "y", columns


def nominal_directions(bench: Workbench, fitted: Fitted) -> np.ndarray:
    """Orthonormal basis of what parameters and initial states can change in the stacked outputs."""
    return followed(bench, linearised(bench, fitted)[1], [r.skip for r in bench.recordings])


def _remainder(bench: Workbench, fitted: Fitted, basis: np.ndarray, change: Change, simulate: bool) -> float:
    """Mean square that parameters and initial states leave of the error on changed recordings.

    Without `simulate` the run of the fit stands, as it does where no input is changed.
    """
    parts = []
    with np.errstate(over="ignore", invalid="ignore"):  # what diverges leaves everything
        for r, e, state in zip(bench.recordings, fitted.residual, fitted.initial, strict=True):
            other = change(r)
            y = fitted.engine.simulate(fitted.model.drive(other), fitted.vector, state)[0] if simulate else e + r.y
            parts.append(((y - other.y) / bench.scale)[r.skip :].ravel())
        error = np.concatenate(parts)
        left = error - basis @ (basis.T @ error)
        value = float(left @ left) / len(error)
    return value if np.isfinite(value) else np.inf


def timing(
    bench: Workbench, plain: Fitted, noise2: float, part: float = 1.0, early: bool = True
) -> tuple[Workbench, Fitted, list[Gate]]:
    """Look for a shifted channel or clock; returns the corrected bench where it is a fault of the recording.

    A late channel counts as shifted where it is late by a multiple of `part` samples; and, as an early one without
    `early`, where it is all that is wrong.
    """
    if plain.cost < 4 * noise2:
        return bench, plain, []
    dt = bench.dt
    references = [plain] if plain.cost < FAR else [plain, as_given(bench, plain)]
    trials = [trial for reference in references for trial in _trials(bench, reference)]
    best: tuple[float, str, str, float, Workbench, Fitted, Change] | None = None
    for _, name, what, value, kind, i in _best_of_each(trials):
        make, cut = _maker(kind, i, what), _maker(kind, i, what, cut=True)
        unit = dt if what == "alignment" else abs(value)
        settled = _settled(bench, plain, make, cut, value, unit)
        if settled is None:
            continue
        at, now, current = settled
        if what == "alignment":
            near = _refit_at(bench, cut, round(at / dt) * dt, current)
            if near is not None and near[1].cost < 1.02 * current.cost + AVERAGED * noise2:
                at, (now, current) = round(at / dt) * dt, near
        relative = current.cost * float(np.mean((now.scale / bench.scale) ** 2))
        if best is None or relative < best[0]:
            best = (relative, name, what, at if kind == "y" else -at, now, current, cut(at))
    if best is None or best[0] > DROP * plain.cost:
        return bench, plain, []
    relative, name, what, value, other, found, change = best
    back = refit(bench, found)
    if back is not None and relative > DROP * back.cost:  # it only led the refit out of a local minimum
        return bench, back, []
    late, alone = what == "alignment" and value > 0, 3.0 if what == "alignment" else ALONE
    if (late or what == "clock" or not early) and relative > max(NOTHING * plain.cost, alone**2 * noise2):
        return bench, plain, []  # what comes late or runs slow, next to something else that is wrong, may be physics
    gate = _gate(name, what, value, dt, plain.cost, relative, change, part, noise2)
    return (other, found, [gate]) if gate else (bench, plain, [])


def as_given(bench: Workbench, plain: Fitted) -> Fitted:
    """The simulator at the user's values: a refit to channels out of step may have gone astray."""
    values = {name: p.value for name, p in bench.simulator.parameters.items()}
    unknown = [r.begins == "estimate" for r in bench.recordings]
    initial = [0 * state if u else state for u, state in zip(unknown, plain.initial, strict=True)]
    return bench.result(bench.simulator, values, initial, plain.engine, plain.model)


def _trials(bench: Workbench, fitted: Fitted) -> list[Trial]:
    """The best shift and clock rate of every channel that make the remainder clearly smaller, with its share."""
    names = bench.simulator.output_names
    channels: list[tuple[str, tuple[int, ...], str]] = [("y", (i,), name) for i, name in enumerate(names)]
    if len(names) > 1:
        channels.append(("y", tuple(range(len(names))), ", ".join(names)))
    if len(bench.simulator.inputs) > 1:
        channels += [("u", (i,), name) for i, name in enumerate(bench.simulator.inputs)]
    basis, out = nominal_directions(bench, fitted), list[Trial]()
    straight = _remainder(bench, fitted, basis, lambda r: r, False)
    for kind, i, name in channels:
        for what, values in (("alignment", bench.dt * SHIFTS), ("clock", RATES)):
            make = _maker(kind, i, what)

            def left(value: float, make: Callable[[float], Change] = make, kind: str = kind) -> float:
                return _remainder(bench, fitted, basis, make(value), kind == "u") / straight

            shares = [left(value) for value in values]
            best = int(np.argmin(shares))
            value, share = float(values[best]), shares[best]
            if what == "clock":  # over a whole record a small step of a rate is many samples
                value, share = _narrowed(left, values[max(best - 1, 0)], values[min(best + 1, len(values) - 1)])
            if share < PROMISING:
                out.append((share, name, what, value, kind, i))
    return out


def _narrowed(left: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Where the remainder is smallest between two values, and the remainder there."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(left, bounds=(low, high), method="bounded", options={"maxiter": 20})
    return float(found.x), float(found.fun)


def _refit_at(
    bench: Workbench, cut: Callable[[float], Change], at: float, previous: Fitted
) -> tuple[Workbench, Fitted] | None:
    other = changed(bench, cut(at))
    found = refit(other, previous)
    return None if found is None else (other, found)


def _settled(
    bench: Workbench,
    plain: Fitted,
    make: Callable[[float], Change],
    cut: Callable[[float], Change],
    value: float,
    unit: float,
) -> tuple[float, Workbench, Fitted] | None:
    """Shift and parameters in turn, until the shift stays where it is."""
    best: tuple[float, Workbench, Fitted] | None = None
    at, previous = value, plain
    for _ in range(8):
        found = _refit_at(bench, cut, at, previous)
        if found is None:
            break
        if best is None or found[1].cost < best[2].cost:
            best = (at, *found)
        previous = found[1]
        step = _refined(bench, found[0], previous, make, at, unit)
        if abs(step - at) < 2e-3 * unit:
            break
        at = step
    return best


def _best_of_each(trials: list[Trial]) -> list[Trial]:
    """The best shift and the best clock of each channel, best first, three at most."""
    best: dict[tuple[str, str], Trial] = {}
    for trial in sorted(trials, key=lambda t: t[0]):
        best.setdefault(trial[1:3], trial)
    return list(best.values())[:3]


def _maker(kind: str, i: tuple[int, ...], what: str, cut: bool = False) -> Callable[[float], Change]:
    if what == "alignment":
        return lambda value: shifted(kind, i, value, 0.0, cut)
    return lambda value: shifted(kind, i, 0.0, value, cut)


def _refined(
    bench: Workbench, now: Workbench, fitted: Fitted, make: Callable[[float], Change], at: float, width: float
) -> float:
    """Shift of the original recordings that fits best around `at`."""
    original = replace(bench, scale=now.scale)
    basis = nominal_directions(original, fitted)

    def left(value: float) -> float:
        return _remainder(original, fitted, basis, make(value), True)

    return _narrowed(left, at - width, at + width)[0]


def in_steps(value: float, dt: float, part: float = 1.0) -> bool:
    """Whether a shift is a multiple of `part` samples."""
    return abs(value / dt - part * round(value / dt / part)) < WHOLE


def _gate(
    name: str,
    what: str,
    value: float,
    dt: float,
    before: float,
    after: float,
    change: Change,
    part: float,
    noise2: float,
) -> Gate | None:
    fall = f"the refitted error falls from {before**0.5:.3g} to {after**0.5:.3g} of the outputs' deviation"
    if after > ALONE**2 * noise2:
        fall += (
            f", still {(after / max(noise2, 1e-300)) ** 0.5:.2g} times the noise: more is wrong, with the time "
            "(samples that were lost, say) or otherwise"
        )
    if what == "clock":
        sentence = f"The clock of {name} runs {value * 100:+.3g} % off the others'; with it corrected {fall}."
        return Gate(name, "clock", value, sentence, True, True, change, left=after / before)
    samples = value / dt
    whole = in_steps(value, dt, part) and abs(samples) > LONG
    if samples > -0.3 and not whole:
        return None  # late, and not by whole samples: a delay is physics
    word = "late" if samples > 0 else "early"
    sentence = (
        f"{name} is recorded {abs(samples):.3g} samples ({abs(value):.3g} s) too {word}; with it corrected {fall}."
    )
    return Gate(name, "alignment", value, sentence, True, True, change, left=after / before)
