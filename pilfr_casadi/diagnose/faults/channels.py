"""Faults of whole channels: a wrong sign, unit or gain, exchanged channels, and a wrong unit of time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from ..._base import InputError, percent, side_by_side
from ...data import Recording, dimension
from ...optimise import GaussNewton
from ...simulators import SENSOR, Simulator, port_name
from ..fits.workbench import THOROUGH, Workbench, refit
from .gates import CLEARLY_BETTER, CURED_SHARE, POOR_FIT, USELESS_FIT, Checked, Gate, accept, correct
from .offsets import describe_constant

# factors by which units are mistaken, and units of the quantities, apart from angles, in which that happens; () for any
UNITS: dict[float, tuple[str, ...]] = {
    **dict.fromkeys((1e3, 1e6, 1e2, 60.0), ()),  # metric prefixes, minutes
    180 / np.pi: ("rad", "rad/s", "rad/s^2"),  # degrees
    30 / np.pi: ("rad/s",),  # revolutions a minute
    9.80665: ("m/s^2", "N", "N m", "kg"),  # standard gravity
    3.6: ("m/s",),  # km/h
    1e5: ("Pa",),  # bar
    4.4482216: ("N",),  # pounds of force
    2.2046226: ("kg",),  # pounds
    25.4: ("m", "m/s", "m/s^2"),  # inches to mm
    1 / 0.0254: ("m", "m/s", "m/s^2"),  # inches to m
    6894.757: ("Pa",),  # pounds per square inch
}
FAHRENHEIT: dict[float, tuple[str, ...]] = {1.8: ("K",)}  # its zero differs as well: this unit comes with an offset
# factors on the time: ms, minutes, µs, hours, and the reverse of the first two
TIME_UNITS = (1e-3, 1 / 60, 1e-6, 1 / 3600, 60.0, 1e3)
IN_RECORDINGS = "In the recordings "
SIZE_RATIO = 6.0  # a factor is tried if it brings the simulated size within this ratio of the measured one
MOST_AT_BOUNDS = 0.3  # share of the parameters at their bounds above which a refit does not confirm a unit of time
# first refit of each trial, only to discard hopeless ones
FIRST_REFIT = GaussNewton(max_iterations=20, tolerance=1e-2, patience=3)


def map_channels(kind: str, matrix: np.ndarray, channel: str, finding: str, value: Any, words: str) -> Gate:
    """Return the fault that inputs ("u") or outputs ("y") times a matrix (n, n) correct."""
    sentence = f"{IN_RECORDINGS}{channel if finding != 'exchange' else ' and '.join(value)} {words}"
    return Gate(channel, finding, value, sentence, change=lambda r: r.with_(**{kind: getattr(r, kind) @ matrix}))


def scale_channels(kind: str, names: Sequence[str], columns: Sequence[int], factor: float, more: str = "") -> Gate:
    """Return the fault that a factor on some channels corrects: a wrong sign or unit."""
    matrix, channel = np.eye(len(names)), ", ".join(names[i] for i in columns)
    matrix[columns, columns] = factor
    if factor < 0:
        return map_channels(kind, matrix, channel, "sign", factor, f"has the wrong sign{more}")
    words = f"{'are' if len(columns) > 1 else 'is'} {_describe_factor(factor, more)}"
    return map_channels(kind, matrix, channel, "unit", factor, words)


def exchange_channels(kind: str, names: Sequence[str], one: int, other: int) -> Gate:
    """Return the fault that two channels are exchanged."""
    matrix, both = np.eye(len(names)), [names[one], names[other]]
    matrix[[one, other]] = matrix[[other, one]]
    return map_channels(kind, matrix, ", ".join(both), "exchange", both, "are exchanged")


def exchange_input(simulator: Simulator, i: int, j: int) -> Gate:
    """Return the fault that input i and output j are exchanged."""
    both = [simulator.inputs[i], simulator.output_names[j]]

    def exchange(r: Recording) -> Recording:
        u, y = r.u.copy(), r.y.copy()
        u[:, i], y[:, j] = r.y[:, j], r.u[:, i]
        return r.with_(u=u, y=y)

    sentence = f"{IN_RECORDINGS}{' and '.join(both)} are exchanged"
    return Gate(", ".join(both), "exchange", both, sentence, change=exchange)


def scale_time(factor: float) -> Gate:
    """Return the fault that a factor on the time corrects."""
    words = f"{IN_RECORDINGS}the time is {_describe_factor(factor)}"
    return Gate("time", "time-unit", factor, words, change=lambda r: r.with_(dt=r.dt * factor, start=r.start * factor))


def _describe_factor(correction: float, more: str = "") -> str:
    size, factor = ("small", correction) if correction > 1 else ("large", 1 / correction)
    return f"too {size} by a factor of {factor:.4g}{more}, as from a wrong unit"


def open_bench(simulator: Any, recordings: Sequence[Recording], hold: str, engine: str) -> tuple[Workbench, list[Gate]]:
    """Make the bench; if the simulator is too fast for the recordings' step, try other units of time.

    Raises
    ------
    InputError
        If no unit of time makes simulator and recordings fit each other.
    """
    try:
        return Workbench.of(simulator, recordings, hold, engine), []
    except InputError as error:
        for factor in TIME_UNITS:
            with suppress(InputError):
                bench = Workbench.of(simulator, [r.with_(dt=r.dt * factor) for r in recordings], hold, engine)
                cost, fault = bench.fit(simulator).cost, scale_time(factor)
                if cost < USELESS_FIT:
                    words = f"as given, the simulator cannot follow; corrected, its error is {percent(cost**0.5)}"
                    words = f"{fault.sentence}; {words} of the outputs' deviation."
                    return bench, [replace(fault, sentence=words, fault=True)]
        raise error


def find_gross_channel_errors(bench: Workbench, workers: int = 1) -> list[Gate]:
    """Find wrong signs and units and exchanges that show at the simulator's values, without a fit; best first.

    The run at these values has to be off by more than its own size, and with the channel corrected by less.
    """
    given = Checked(bench, bench.run_given())
    before = _relative_error(bench, given.fitted.residual)
    if not before > 1:
        return []
    faults = _possible_channel_errors(given, given.fitted.residual, trust_values=True)
    left = np.array(side_by_side(partial(_run_corrected, given), faults, workers))
    near = (left < min(CURED_SHARE * before, 1.0)) & (CURED_SHARE * left <= np.min(left))
    return [replace(faults[i], left=float(left[i])) for i in np.argsort(left, kind="stable") if near[i]]


def correct_gross_channel_errors(bench: Workbench) -> Checked | None:
    """Refit from the user's values, and correct the likeliest gross fault if the rule accepts it; None without one."""
    faults = find_gross_channel_errors(bench)
    if not faults:
        return None
    return accept_best(Checked(bench, refit(bench) or bench.run_given()), faults)


def _run_corrected(given: Checked, fault: Gate) -> float:
    """Return what a run at the given values does not follow once a fault is corrected; see `_relative_error`.

    It is infinite after the bench's deadline.
    """
    if time.perf_counter() > given.bench.deadline:
        return np.inf
    bench, now = fault.apply(given.bench), given.fitted
    pairs = list(zip(given.bench.recordings, bench.recordings, strict=True))
    if now.simulator.observer is not None or any(not np.array_equal(was.u, r.u) for was, r in pairs):
        return _relative_error(bench, bench.run_given(now).residual)
    return _relative_error(bench, [e + was.y - r.y for e, (was, r) in zip(now.residual, pairs, strict=True)])


def _relative_error(bench: Workbench, residual: Sequence[np.ndarray]) -> float:
    """Compute the outputs' mean square error, apart from levels, over the product of simulated and measured deviation.

    So an output that is simulated much too small counts as one that is simulated much too large. An output that stands
    still in the simulation says nothing.
    """
    with np.errstate(all="ignore"):
        errors = np.concatenate([e - np.mean(e, axis=0) for e in bench.scored(residual)])
        measured = np.concatenate([r.y[r.skip :] - np.mean(r.y[r.skip :], axis=0) for r in bench.recordings])
        sizes = np.std(measured, axis=0) * np.std(measured + errors, axis=0)
        moves = sizes != 0  # also if the run diverges
        share = float(np.mean((np.mean(errors**2, axis=0) / sizes)[moves])) if np.any(moves) else np.inf
    return share if np.isfinite(share) else np.inf


def find_channel_errors(now: Checked, workers: int) -> Checked:
    """Find wrong signs and units, exchanged channels and a wrong unit of time, with `workers` trials at a time.

    If the error stays large, try each output with an offset as well; `find_offsets` reports the offset and keeps it.
    """
    bench = now.bench
    given = bench.run_given(now.fitted).residual
    found = accept_best(now, _possible_channel_errors(now, given), workers)
    # with an offset there is a working point, which a run from the stated start would have to reach first
    for i, name in enumerate(bench.simulator.output_names if found.cost > POOR_FIT else ()):
        offset = describe_constant(port_name(SENSOR, name))
        level = correct(now, offset, [{}, now.fitted.values], now.fitted.begin)
        if level is None:
            continue
        near = _make_size_test(level, level.fitted.residual, level.cost <= 1)
        unit = bench.simulator.units.get(name, "")
        factors = [f for f in (-1.0, *_list_factors(unit, UNITS | FAHRENHEIT)) if f < 0 or near("y", [i], f)]
        faults = [scale_channels("y", bench.simulator.output_names, [i], f, " and an offset") for f in factors]
        beside = accept_best(level, faults, workers)
        if beside.adds_to(now) and beside.cost < CURED_SHARE * found.cost:
            found = replace(beside, bench=replace(beside.bench, simulator=bench.simulator))
    return found


def refit_corrected(now: Checked) -> Checked:
    """Refit from the user's values too, with sub-steps chosen for recordings whose channels were corrected."""
    bench = now.bench.renewed(now.bench.recordings)
    fitted = bench.fit(bench.simulator, [now.fitted.values, {}], solver=THOROUGH)
    return replace(now, bench=bench, fitted=fitted)


def _possible_channel_errors(now: Checked, errors: Sequence[np.ndarray], trust_values: bool = False) -> list[Gate]:
    """List the faults of sign, unit, exchange and unit of time that the outputs' sizes in a run allow.

    With `trust_values` the sizes count however large the errors are, and the unit of time counts as right.
    """
    near, faults = _make_size_test(now, errors, trust_values or now.cost <= 1), list[Gate]()
    channels = {"y": now.bench.simulator.output_names, "u": now.bench.simulator.inputs}
    known = now.bench.simulator.units
    for kind, names in channels.items():
        for i in range(len(names)):
            factors = [f for f in _list_factors(known.get(names[i], "")) if near(kind, [i], f)]
            faults += [scale_channels(kind, names, [i], f) for f in (-1.0, *factors)]
    every = range(len(channels["y"]))
    units = [known.get(name, "") for name in channels["y"]]
    shared = [f for f in _list_factors("") if len(every) > 1 and all(f in _list_factors(unit) for unit in units)]
    joint = [f for f in shared if near("y", every, f)]
    faults += [scale_channels("y", channels["y"], every, f) for f in joint]
    for kind, names in channels.items():
        faults += [exchange_channels(kind, names, i, j) for i, j in combinations(range(len(names)), 2)]
    if trust_values:  # with other values, a machine may follow its output backwards as well
        moving = np.flatnonzero(np.max([np.ptp(r.u, axis=0) for r in now.bench.recordings], axis=0))  # as outputs do
        return faults + [exchange_input(now.bench.simulator, i, j) for i in moving.tolist() for j in every]
    return [*faults, *(map(scale_time, TIME_UNITS) if now.cost > POOR_FIT else ())]


def _list_factors(unit: str, units: Mapping[float, Sequence[str]] = UNITS) -> list[float]:
    """List factors by which a quantity is off in a wrong unit, of those that fit its own unit, if that is known."""
    own = dimension(unit)
    fitting = [f for f, of in units.items() if own is None or not of or own in map(dimension, of)]
    return [one for factor in fitting for one in (factor, 1 / factor)]  # mistaken in either direction


def _make_size_test(
    now: Checked, errors: Sequence[np.ndarray], sized: bool
) -> Callable[[str, Sequence[int], float], bool]:
    """Return a test whether a factor on channels lets the outputs of a run have about the measured size.

    Unless `sized`, every factor is allowed: the size of a diverging run says nothing.
    """
    with np.errstate(all="ignore"):
        y = np.concatenate([e + r.y for e, r in zip(errors, now.bench.recordings, strict=True)])
        sizes = now.bench.scale / np.std(y, axis=0)

    def near(kind: str, columns: Sequence[int], factor: float) -> bool:
        ratios = factor * sizes[columns] if kind == "y" else sizes / factor
        unknown = ~np.isfinite(ratios) | (ratios == 0) | (not sized)
        close = unknown | ((ratios > 1 / SIZE_RATIO) & (ratios < SIZE_RATIO))
        return bool(np.all(close) if kind == "y" else np.any(close))

    return near


def accept_best(now: Checked, faults: Sequence[Gate], workers: int = 1) -> Checked:
    """Accept the fault whose correction leaves the smallest error, if the rule accepts it.

    For a linear simulator, a unit of all outputs is equivalent to a unit of its input, or of its only output. Then the
    sentence tells the others.
    """
    tried = zip(faults, side_by_side(partial(_try, now), faults, workers), strict=True)
    found = [(fault, after) for fault, after in tried if after is not None]
    best: tuple[Gate, Checked] | None = None
    for fault, after in found:
        joint = fault.finding == "unit" and "," in fault.channel
        if best is None or after.cost < (CLEARLY_BETTER if joint else 1 - 1e-6) * best[1].cost:
            best = fault, after
    if best is None:
        return now
    fault, after = best
    rest = [one for one in found if one[0] is not fault and one[0].finding == fault.finding == "unit"]
    equal = [f.sentence.removeprefix(IN_RECORDINGS) for f, a in rest if CLEARLY_BETTER * a.cost < after.cost]
    if equal:
        sentence = f"{fault.sentence}; or else {'; or '.join(equal)}: these recordings do not tell which"
        fault = replace(fault, sentence=sentence)
    return accept(now, after, fault)


def _try(now: Checked, fault: Gate) -> Checked | None:
    """Correct a fault and refit from the user's values; None if it is hopeless."""
    glanced = correct(now, fault, solver=FIRST_REFIT)
    if glanced is None or not glanced.cost < now.cost:
        return None
    after = correct(now, fault, [{}, glanced.fitted.values], glanced.fitted.begin)
    bent = fault.finding == "time-unit" and after is not None and after.fitted.share_at_bounds > MOST_AT_BOUNDS
    return None if bent else after
