"""Faults of recordings as edits, the one rule that accepts them, and the faults of whole channels.

A fault is a small frozen object (`Gate`). It corrects the recordings or the simulator, and says so in a sentence. All
faults that a refit can confirm take the same steps.

1. Screen by the size of the outputs, or to first order (`FirstOrder`), which gives the start value: with base the
   orthonormal directions that parameters and initial states can follow, an error e leaves `e - base baseᵀ e`.
2. Correct the fault and refit (`correct`). If the fault has a size or a place, relocate and refit in turn (`settle`).
3. Accept the fault by one rule (`accept`). The gain in log evidence has to exceed the BIC cost of the parameters
   (Schwarz 1978) by the prior odds against a fault, `LEAST_GAIN`, and at most the share `CURED_SHARE` of the mean
   square error may be left: other physics hardly mimics a fault so closely. If the recordings as given are followed
   from the corrected refit's values so well that the rule no longer holds, there is no fault.

The faults of whole channels are sign, unit or gain, exchange, unit of time, and offset.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from .._base import InputError, side_by_side
from ..data import Recording
from ..engine import make_engine
from ..laws import Law
from ..optimise import GaussNewton
from ..simulators import Simulator
from .floor import FEWEST, Floor, effective_size, noise_floor
from .linearise import Probe, Run, linearised
from .screen import followed, lengths, moved, project_off
from .workbench import QUICK, THOROUGH, Fitted, Workbench

Change = Callable[[Recording], Recording]

LEAST_GAIN = 12.0  # least gain of a correction beyond the BIC cost of its parameters, in nats: odds of about 1e5
CERTAIN_ERRORS = (2 * LEAST_GAIN) ** 0.5  # the same in standard errors of one parameter
CURED_SHARE = 0.25  # largest share of the mean square that the correction of a fault leaves: it halves the error
USELESS_FIT = CURED_SHARE  # the same share of the outputs' variance: a worse refit says nothing
POOR_FIT = 0.04  # share of the outputs' variance from which a refit may be in a wrong minimum
CLEARLY_BETTER = 0.8  # share left by an edit that is clearly better than another edit, or than none
EXCEPTION_SHARE = 0.02  # share of a mean square, or of the samples, up to which something is an exception
EQUAL_RATIO = 1.02  # ratio of errors that count as equal
NEAR_NOISE_RATIO = 5.0  # rms error over the noise up to which nothing else is wrong
KEPT_OFFSET = 0.1  # share of its first value that an offset must keep beside effects to be reported
MOST_ROUNDS = 8  # alternations of edit and refit at most

# metric prefixes, degrees, standard gravity, revolutions a minute, km/h, bar, minutes, pounds, inches to mm and m, psi
UNITS = (1e3, 1e6, 1e2, 180 / np.pi, 9.80665, 30 / np.pi, 3.6, 1e5, 60.0, 4.4482216, 25.4, 1 / 0.0254, 6894.757)
FACTORS = tuple(f for unit in UNITS for f in (unit, 1 / unit))  # each unit by mistake in either direction
FAHRENHEIT = (1.8, 1 / 1.8)  # Fahrenheit's zero differs as well: this unit comes with an offset
# factors on the time: ms, minutes, µs, hours, and the reverse of the first two
TIME_UNITS = (1e-3, 1 / 60, 1e-6, 1 / 3600, 60.0, 1e3)
SIZE_RATIO = 6.0  # a factor is tried if it brings the simulated size within this ratio of the measured one
MOST_AT_BOUNDS = 0.3  # share of the parameters at their bounds above which a refit does not confirm a unit of time
# first refit of each trial, only to discard hopeless ones
FIRST_REFIT = GaussNewton(max_iterations=20, tolerance=1e-2, patience=3)


@dataclass(frozen=True)
class Gate:
    """A finding about a channel; if it is a fault that can be corrected, also the edit that corrects it.

    Attributes
    ----------
    value : object
        What is wrong, as reported; the start value until the edit is settled.
    sentence : str
        What is wrong; `accept` adds the effect of the correction.
    corrected : bool
        Whether the diagnosis goes on with the corrected recordings.
    fault : bool
        Whether it is a fault of the recording rather than a note.
    change : callable
        Edit of a recording that corrects it, if there is one.
    parameter : str
        Parameter of the simulator that represents it.
    left : float
        Share of the mean square error that is left after the correction.
    """

    channel: str
    finding: str
    value: Any
    sentence: str = ""
    corrected: bool = True
    fault: bool = False
    change: Change | None = None
    parameter: str = ""
    left: float = 1.0

    # for the rule: parameters that the correction adds, the largest share that it may leave, and how it is described
    parameters: ClassVar[int] = 0
    most_left: ClassVar[float] = CURED_SHARE
    remedy: ClassVar[str] = "with it corrected"

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as in diagnosis.json."""
        keys = ("channel", "finding", "value", "sentence", "corrected")
        return {k: getattr(self, k) for k in keys}

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with changed recordings; errors are in units of the outputs' new deviation."""
        recordings = tuple(self.change(r) if self.change else r for r in bench.recordings)
        if recordings[0].dt != bench.dt:
            return Workbench.of(bench.simulator, recordings, bench.hold, bench.engine)
        scale = np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
        return replace(bench, recordings=recordings, scale=scale)

    def begin(self, previous: Fitted) -> Sequence[np.ndarray]:
        """Return guesses of the initial states of the corrected recordings."""
        return previous.begin

    def relocate(self, now: Checked, after: Checked) -> Self | None:
        """Return the fault at its best value to first order at the corrected refit, or None if there is none."""
        return self


G = TypeVar("G", bound=Gate)


@dataclass(frozen=True, eq=False)
class Checked:
    """The recordings as checked so far, the simulator refitted to them, and the findings."""

    bench: Workbench
    fitted: Fitted
    gates: tuple[Gate, ...] = ()

    @property
    def cost(self) -> float:
        """Mean square error of the refit, outputs in units of their deviation."""
        return self.fitted.cost

    @property
    def floor(self) -> Floor:
        """The noise, measured or estimated from the refit."""
        return noise_floor(self.bench.recordings, self.fitted.residual)

    @property
    def noise2(self) -> float:
        """Mean square of the noise in units of the outputs' variance."""
        return float(np.mean((self.floor.deviation / self.bench.scale) ** 2))

    def then(self, bench: Workbench, fitted: Fitted, *gates: Gate) -> Checked:
        """Return the next state: another bench and refit, with further findings added."""
        return Checked(bench, fitted, (*self.gates, *gates))


# the one rule


def gain(before: float, after: float, residual: Sequence[np.ndarray], parameters: int = 1) -> float:
    """Compute the gain in log evidence, nats, of a fit with more parameters, by BIC on its effective samples."""
    n = max(effective_size(residual), FEWEST)
    return float(0.5 * n * np.log(before / max(after, 1e-300)) - 0.5 * parameters * np.log(n))


def describe_fall(before: float, after: float) -> str:
    """Describe by how much an edit reduces the mean square error."""
    return f"the refitted error falls from {before**0.5:.3g} to {after**0.5:.3g} of the outputs' deviation"


def refit(
    bench: Workbench,
    starts: Sequence[Mapping[str, Any]] = ({},),
    simulator: Simulator | None = None,
    *,
    states: Sequence[np.ndarray] = (),
    solver: GaussNewton = QUICK,
    like: Fitted | None = None,
) -> Fitted | None:
    """Fit a simulator, by default the bench's; None if it diverges. The compiled model of `like` is reused."""
    model, engine = (like.model, like.engine) if like else (None, None)
    simulator = simulator or bench.simulator
    try:
        return bench.fit(simulator, starts, states=states, solver=solver, model=model, engine=engine)
    except InputError:
        return None


def correct(
    now: Checked,
    fault: Gate,
    starts: Sequence[Mapping[str, Any]] = ({},),
    states: Sequence[np.ndarray] = (),
    solver: GaussNewton = QUICK,
) -> Checked | None:
    """Correct a fault and refit; None if the simulator cannot follow then."""
    try:
        bench = fault.apply(now.bench)
    except InputError:
        return None
    same_model = bench.simulator is now.bench.simulator and bench.dt == now.bench.dt
    found = refit(bench, starts, states=states, solver=solver, like=now.fitted if same_model else None)
    return None if found is None else now.then(bench, found)


def settle(now: Checked, fault: G, solver: GaussNewton = QUICK) -> tuple[G, Checked] | None:
    """Refit and relocate a fault in turn until it stays, because a refit without it may be in a wrong minimum."""
    best: tuple[G, Checked] | None = None
    previous = now.fitted
    for _ in range(MOST_ROUNDS):
        after = correct(now, fault, [previous.values, {}], fault.begin(previous), solver)
        if after is None:
            break
        if best is None or after.cost < best[1].cost:
            best = fault, after
        following = fault.relocate(now, after)
        if following is None:
            break
        if following.value == fault.value:
            return following, after
        fault, previous = following, after.fitted
    return best


def accept(now: Checked, after: Checked | None, fault: Gate) -> Checked:
    """Return the corrected state with its finding if the rule accepts the fault, else the state before.

    The simulator is also refitted to the recordings as given, from the corrected refit's values. If that follows as
    well, the correction only led the refit out of a local minimum, and that refit is returned.
    """
    if after is None or not _satisfies_rule(now, after, fault):
        return now
    back = refit(now.bench, [after.fitted.values], states=now.fitted.initial, like=now.fitted)
    if back is not None and not _satisfies_rule(now.then(now.bench, back), after, fault):
        return now.then(now.bench, back)
    sentence = f"{fault.sentence}; {fault.remedy} {describe_fall(now.cost, after.cost)}"
    noises = (after.cost / max(now.noise2, 1e-300)) ** 0.5
    if noises > NEAR_NOISE_RATIO:
        sentence += f", still {noises:.2g} times the noise: more is wrong"
    told = replace(fault, sentence=f"{sentence}.", fault=True, left=after.cost / now.cost)
    return now.then(after.bench, after.fitted, told)


def _satisfies_rule(now: Checked, after: Checked, fault: Gate) -> bool:
    gained = gain(now.cost, after.cost, after.fitted.residual, fault.parameters)
    return gained > LEAST_GAIN and after.cost < min(fault.most_left * now.cost, USELESS_FIT)


@dataclass(frozen=True)
class WrongStart(Gate):
    """Initial states that are not as stated."""

    remedy: ClassVar[str] = "with them estimated"


def find_wrong_start(now: Checked) -> Checked:
    """Estimate the initial states if the stated ones contradict the first samples and no constant explains it as well.

    A first sample depends on no dynamics: missing physics cannot contradict it.
    """
    both = zip(now.bench.recordings, now.fitted.residual, strict=True)
    stated = [(r, e[0]) for r, e in both if r.begins in ("zero", "given")]
    unknown = len(stated) * len(now.bench.simulator.states)
    if not any(np.any(np.abs(first) > CERTAIN_ERRORS * now.floor.deviation) for _, first in stated) or not unknown:
        return now
    words = "The initial states are not as stated"
    fault = WrongStart("initial state", "start", stated[0][0].begins, words, change=_with_unknown_start)
    after = correct(now, fault, [now.fitted.values, {}])
    if after is None or gain(now.cost, after.cost, after.fitted.residual, unknown) < LEAST_GAIN:
        return now
    found = accept(now, after, fault)
    return found if found.cost * EQUAL_RATIO < find_offsets(now).cost else now


def _with_unknown_start(r: Recording) -> Recording:
    return r.with_(initial="estimate") if r.begins in ("zero", "given") else r


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """The refitted simulator linearised along its runs, to screen edits to first order.

    Attributes
    ----------
    base : array, shape (R, n)
        Orthonormal directions of the stacked outputs that parameters and initial states can follow.
    error : array, shape (R,)
        The stacked error in units of the outputs' deviation.
    """

    bench: Workbench
    probe: Probe
    runs: list[Run]
    base: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, bench: Workbench, fitted: Fitted) -> FirstOrder:
        """Linearise a fit."""
        probe, runs = linearised(bench, fitted)
        skips = [r.skip for r in bench.recordings]
        error = [(one.error / bench.scale)[skip:].ravel() for one, skip in zip(runs, skips, strict=True)]
        return cls(bench, probe, runs, followed(bench, runs, skips), np.concatenate(error))

    def left(self, columns: np.ndarray) -> np.ndarray:
        """Subtract what parameters and initial states can follow."""
        return project_off(columns, self.base)

    def response(self, ports: Sequence[str], forces: Sequence[np.ndarray]) -> np.ndarray:
        """Compute the stacked outputs' changes (R, n) by forces at ports, (M, n_k) a recording; see `propagate`."""
        out = []
        for run, r, force in zip(self.runs, self.bench.recordings, forces, strict=True):
            at = [(self.probe.ports.index(name), force) for name in ports]
            out.append(moved(self.bench, run, at, r.skip)[:, -len(ports) * force.shape[1] :])
        return np.concatenate(out)


def robust_deviation(v: np.ndarray) -> np.ndarray:
    """Estimate the deviation of zero-mean columns from the upper quartile of their sizes, which ignores outliers."""
    return np.asarray(np.quantile(np.abs(v), 0.75, axis=0) / 1.1503)


# sign, unit, exchange, unit of time


def map_channels(kind: str, matrix: np.ndarray, channel: str, finding: str, value: Any, words: str) -> Gate:
    """Return the fault that inputs ("u") or outputs ("y") times a matrix (n, n) correct."""
    sentence = f"In the recordings {channel if finding != 'exchange' else ' and '.join(value)} {words}"
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


def scale_time(factor: float) -> Gate:
    """Return the fault that a factor on the time corrects."""
    words = f"In the recordings the time is {_describe_factor(factor)}"
    return Gate("time", "time-unit", factor, words, change=lambda r: r.with_(dt=r.dt * factor))


def _describe_factor(correction: float, more: str = "") -> str:
    return f"off by a factor of {1 / correction:.4g}{more}, as from a wrong unit"


def open_start(r: Recording) -> Recording:
    """Estimate the initial state of a periodic recording, because it is not on its steady cycle."""
    return r.with_(initial="estimate", period=None) if r.begins == "periodic" else r


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
                    words = f"as given, the simulator cannot follow; corrected, its error is {cost**0.5:.3g}"
                    words = f"{fault.sentence}; {words} of the outputs' deviation."
                    return bench, [replace(fault, sentence=words, fault=True)]
        raise error


def find_slips(now: Checked, workers: int) -> Checked:
    """Find wrong signs and units, exchanged channels and a wrong unit of time, with `workers` trials at a time.

    If the error stays large, try each output with an offset as well; `find_offsets` reports the offset and keeps it.
    """
    bench = now.bench
    # with an offset there is a working point, which a run from rest would have to reach first
    found = _accept_best(now, _possible_slips(now, _from_rest(bench)), workers)
    for i, name in enumerate(bench.simulator.output_names if found.cost > POOR_FIT else ()):
        offset = constant_at(f"sensor:{name}")
        level = correct(now, offset, [{}, now.fitted.values], now.fitted.begin)
        if level is None:
            continue
        near = _near(level, level.fitted.residual)
        factors = [f for f in (-1.0, *FACTORS, *FAHRENHEIT) if f < 0 or near("y", [i], f)]
        faults = [scale_channels("y", bench.simulator.output_names, [i], f, " and an offset") for f in factors]
        beside = _accept_best(level, faults, workers)
        if len(beside.gates) > len(now.gates) and beside.cost < CURED_SHARE * found.cost:
            found = replace(beside, bench=replace(beside.bench, simulator=bench.simulator))
    return found


def _possible_slips(now: Checked, errors: Sequence[np.ndarray]) -> list[Gate]:
    """List the faults of sign, unit, exchange and unit of time that the outputs' sizes allow."""
    near, faults = _near(now, errors), list[Gate]()
    channels = {"y": now.bench.simulator.output_names, "u": now.bench.simulator.inputs}
    for kind, names in channels.items():
        for i in range(len(names)):
            factors = [f for f in FACTORS if near(kind, [i], f)]
            faults += [scale_channels(kind, names, [i], f) for f in (-1.0, *factors)]
    every = range(len(channels["y"]))
    joint = [f for f in FACTORS if len(every) > 1 and near("y", every, f)]
    faults += [scale_channels("y", channels["y"], every, f) for f in joint]
    if now.cost > POOR_FIT:
        for kind, names in channels.items():
            faults += [exchange_channels(kind, names, i, j) for i, j in combinations(range(len(names)), 2)]
        faults += map(scale_time, TIME_UNITS)
    return faults


def _near(now: Checked, errors: Sequence[np.ndarray]) -> Callable[[str, Sequence[int], float], bool]:
    """Return a test whether a factor on channels lets the outputs of a run have about the measured size."""
    with np.errstate(all="ignore"):
        y = np.concatenate([e + r.y for e, r in zip(errors, now.bench.recordings, strict=True)])
        sizes = now.bench.scale / np.std(y, axis=0)

    def near(kind: str, columns: Sequence[int], factor: float) -> bool:
        ratios = factor * sizes[columns] if kind == "y" else sizes / factor
        unknown = ~np.isfinite(ratios) | (ratios == 0) | (now.cost > 1)  # the size of a diverging run says nothing
        close = unknown | ((ratios > 1 / SIZE_RATIO) & (ratios < SIZE_RATIO))
        return bool(np.all(close) if kind == "y" else np.any(close))

    return near


def _accept_best(now: Checked, faults: Sequence[Gate], workers: int) -> Checked:
    """Accept the fault whose correction leaves the smallest error, if the rule accepts it."""
    best: tuple[Gate, Checked] | None = None
    for fault, after in zip(faults, side_by_side(partial(_try, now), faults, workers), strict=True):
        # for a linear simulator, a unit of all outputs is equivalent to a unit of its input, or of its only output
        joint = fault.finding == "unit" and "," in fault.channel
        if after is not None and (best is None or after.cost < (CLEARLY_BETTER if joint else 1 - 1e-6) * best[1].cost):
            best = fault, after
    return now if best is None else accept(now, best[1], best[0])


def _try(now: Checked, fault: Gate) -> Checked | None:
    """Correct a fault and refit from the user's values; None if it is hopeless."""
    glanced = correct(now, fault, solver=FIRST_REFIT)
    if glanced is None or not glanced.cost < now.cost:
        return None
    after = correct(now, fault, [{}, glanced.fitted.values], glanced.fitted.begin)
    bent = fault.finding == "time-unit" and after is not None and after.fitted.at_bounds > MOST_AT_BOUNDS
    return None if bent else after


def _from_rest(bench: Workbench) -> list[np.ndarray]:
    """Compute the errors of the simulator at the user's values, run from rest."""
    model = bench.model(bench.simulator)
    engine = make_engine(model, bench.engine)
    start, n = model.parameters.start, model.n_state
    with np.errstate(all="ignore"):
        return [engine.simulate(model.drive(r), start, np.zeros(n))[0] - r.y for r in bench.recordings]


# offset: a constant at an input or an output (a bias of an amplifier, the zero of a sensor, a constant load)


class Offset(Law):
    """A constant added to a signal; it stays a parameter of the simulator and is fitted together with the laws."""

    id = "offset"
    equation = "w = w_0"
    source = "Ljung (1999), System Identification, sec. 14.1"
    sentence = "a constant offset of the signal"
    units: ClassVar[Mapping[str, str]] = {"w_0": "w"}
    strength: ClassVar[tuple[str, ...]] = ("w_0",)
    places: ClassVar[tuple[str, ...]] = ("series",)

    def force(self, p: Any) -> Any:
        """Return the constant."""
        return p.w_0


@dataclass(frozen=True)
class Constant(Gate):
    """A constant at an input or an output; as a parameter of the simulator, it may leave any error to other physics."""

    port: str = ""
    parameters: ClassVar[int] = 1
    most_left: ClassVar[float] = 1.0
    remedy: ClassVar[str] = "with it as a parameter"

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with the constant in its simulator."""
        return replace(bench, simulator=bench.simulator.with_element(self.port, Offset()))


def constant_at(port: str, value: float = 0.0, parameter: str = "") -> Constant:
    """Return the fault that a channel has a constant offset."""
    kind, name = port.split(":", 1)
    where, load = ("input", ", or a constant load acts like one") if kind == "actuator" else ("output", "")
    words = f"The {where} {name} has a constant offset of about {value:.3g}{load}"
    return Constant(name, "offset", value, words, parameter=parameter, port=port)


def find_offsets(now: Checked) -> Checked:
    """Find constants at inputs and outputs, the most useful first, and keep them as parameters of the simulator.

    They count as a fault if they explain most of the mismatch.
    """
    begin, simulator = now, now.bench.simulator
    ports = [f"actuator:{n}" for n in simulator.inputs] + [f"sensor:{n}" for n in simulator.output_names]
    ports = [port for port in ports if port not in {e.port for e in simulator.elements}]
    while ports:
        share = share_of_constants(now.bench, now.fitted, ports)
        port = max(share, key=lambda name: share[name])
        if share[port] < EXCEPTION_SHARE:
            break
        after = correct(now, constant_at(port), [now.fitted.values], now.fitted.initial, THOROUGH)
        if after is None:
            break
        name = f"{after.bench.simulator.elements[-1].prefix}w_0"
        before, now = now, accept(now, after, constant_at(port, float(after.fitted.values[name]), name))
        if now.bench is before.bench:
            break
        ports.remove(port)
    fault = now.cost < CURED_SHARE * begin.cost
    # a constant load acts alike, so that the share that is left does not prove a fault
    found = (replace(g, fault=fault, left=1.0) for g in now.gates[len(begin.gates) :])
    return begin.then(now.bench, now.fitted, *found)


def share_of_constants(bench: Workbench, fitted: Fitted, ports: Sequence[str]) -> dict[str, float]:
    """Compute the share of the mean square that a constant at each port removes, to first order."""
    first = FirstOrder.of(bench, fitted)
    columns = first.response(ports, [np.ones((len(r), 1)) for r in bench.recordings])
    rest = first.left(columns)
    seen = lengths(rest) > 1e-6 * lengths(columns)  # exclude constants that the initial state can follow
    along = np.where(seen, rest.T @ first.error / np.maximum(lengths(rest), 1e-150), 0.0)
    return dict(zip(ports, (along**2 / max(first.error @ first.error, 1e-300)).tolist(), strict=True))


def offset_gates(elements: Sequence[Any], values: Mapping[str, Any]) -> list[Gate]:
    """List the offsets among fitted laws as findings."""
    placed = [(e.port, f"{e.prefix}w_0") for e in elements if isinstance(e.law, Offset)]
    found = [constant_at(port, float(values[name]), name) for port, name in placed]
    return [replace(c, sentence=f"{c.sentence}; it is a parameter of the corrected simulator.") for c in found]


def without_idle_offsets(bench: Workbench, fitted: Fitted) -> Fitted:
    """Fix offsets at zero that gain nothing beside effects: an effect may have looked like an offset."""
    before = len(bench.simulator.elements)
    placed = fitted.simulator.elements
    for offset in offset_gates(placed[:before], fitted.values) if len(placed) > before else ():
        name = offset.parameter
        held = replace(fitted.simulator.parameters[name], value=0.0, fixed=True)
        simulator = fitted.simulator.with_parameters({**fitted.simulator.parameters, name: held})
        start = {k: v for k, v in fitted.values.items() if k != name}
        found = refit(bench, [start], simulator, states=fitted.initial, solver=THOROUGH)
        if found is not None and gain(found.cost, fitted.cost, fitted.residual) <= LEAST_GAIN:
            fitted = found
    return fitted


def without_zero_offsets(simulator: Simulator) -> Simulator:
    """Return a simulator without the offsets that are fixed at zero."""
    for i, e in reversed(list(enumerate(simulator.elements))):
        if isinstance(e.law, Offset) and np.all(simulator.parameters[f"{e.prefix}w_0"].fixed):
            simulator = simulator.without_element(i)
    return simulator


def final_gates(
    gates: Sequence[Gate], after: Fitted, std: Mapping[str, np.ndarray], effects: bool, sure: bool
) -> tuple[Gate, ...]:
    """Return the findings with the offsets that remain, at their fitted values beside the effects, if any."""
    fitted = {g.parameter: g for g in offset_gates(after.simulator.elements, after.values)}
    out = []
    for gate in gates:
        if not gate.parameter:
            out.append(gate)
            continue
        remaining = fitted[gate.parameter]
        certain = abs(remaining.value) > CERTAIN_ERRORS * float(std[gate.parameter])
        if not (certain and abs(remaining.value) > KEPT_OFFSET * abs(gate.value)):
            continue
        sentence = remaining.sentence if effects else gate.sentence  # fitted without the effects, it says little
        if not sure:
            sentence += " As long as the mismatch has no sure name, it may be a part of that."
        out.append(replace(gate, value=remaining.value, sentence=sentence))
    return tuple(out)
