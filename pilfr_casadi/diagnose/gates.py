"""Faults of recordings as edits, and the faults of whole channels: sign, unit, exchange, unit of time, offset.

All faults are found in the same way. An edit of the recordings (`Gate.change`), or an element at a sensor, corrects the
fault, and the simulator is refitted with it. The edit is accepted if it leaves a small share of the refit's mean square
error (`CURED`, `EXPLAINED`), and by comparison with the noise (`AT_NOISE`). Parameters that an edit adds must gain more
evidence than they cost (`gain`; Schwarz 1978). Each check takes a `Checked` and returns one.

Edits are screened to first order (`FirstOrder`): with base the orthonormal directions that parameters and initial
states can follow, an error e leaves `e - base baseᵀ e`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from .._base import InputError, side_by_side
from ..data import Recording
from ..engine import make_engine
from ..laws import Law
from ..optimise import GaussNewton
from ..simulators import Simulator
from .floor import Floor, effective_size, noise_floor
from .linearise import Probe, Run, linearised
from .screen import followed, lengths, moved, project_off
from .workbench import QUICK, THOROUGH, Fitted, Workbench

Change = Callable[[Recording], Recording]

# largest share of the mean square error left: by an edit of a whole channel, which other physics hardly mimics; by
# others
CURED, EXPLAINED = 0.12, 0.3
CLEARLY = 0.8  # the same for an edit that is clearly better than another edit, or than none
AT_NOISE = 5.0  # rms error over the noise up to which nothing else is wrong; faults are sought from ABOVE_NOISE on
# mean square error from which a refit may be in a wrong minimum; from which it says nothing
POOR_FIT, USELESS_FIT = 0.04, 0.25
SAME = 1.02  # ratio of errors that count as equal
LEAST_GAIN = 12.0  # least gain of an edit's parameters beyond their BIC cost, in nats: odds of about 1e5
CERTAIN = (2 * LEAST_GAIN) ** 0.5  # the same in standard errors of one parameter

# metric prefixes, degrees, standard gravity, revolutions a minute, km/h, bar, minutes, pounds, inches to mm and m, psi
UNITS = (1e3, 1e6, 1e2, 180 / np.pi, 9.80665, 30 / np.pi, 3.6, 1e5, 60.0, 4.4482216, 25.4, 1 / 0.0254, 6894.757)
FACTORS = tuple(f for unit in UNITS for f in (unit, 1 / unit))  # each unit by mistake in either direction
FAHRENHEIT = (1.8, 1 / 1.8)  # Fahrenheit's zero differs as well: this unit comes with an offset
# factors on the time: ms, minutes, µs, hours, and the reverse of the first two
TIME_UNITS = (1e-3, 1 / 60, 1e-6, 1 / 3600, 60.0, 1e3)
NEAR = 6.0  # a factor is tried if it brings the simulated size within this ratio of the measured one
BENT = 0.3  # share of the parameters at their bounds above which a refit does not confirm a unit of time
# first refit of each trial, only to discard hopeless ones
GLANCE = GaussNewton(max_iterations=20, tolerance=1e-2, patience=3)

LEAST = 0.01  # least share of the mean square that an offset must remove, to first order
STILL = 0.1  # share of its first value that an offset must keep beside effects to be reported


@dataclass(frozen=True)
class Gate:
    """A finding about a channel, and the edit that corrects it.

    Attributes
    ----------
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

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as in diagnosis.json."""
        keys = ("channel", "finding", "value", "sentence", "corrected")
        return {k: getattr(self, k) for k in keys}


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


def describe_fall(before: float, after: float) -> str:
    """Describe by how much an edit reduces the mean square error."""
    return f"the refitted error falls from {before**0.5:.3g} to {after**0.5:.3g} of the outputs' deviation"


def gain(before: float, after: float, residual: Sequence[np.ndarray], parameters: int = 1) -> float:
    """Compute the gain in log evidence, nats, of a fit with more parameters, by BIC on its effective samples."""
    n = max(effective_size(residual), 30.0)
    return float(0.5 * n * np.log(before / max(after, 1e-300)) - 0.5 * parameters * np.log(n))


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


# edits of recordings


def scale_channels(kind: str, index: int | list[int], factor: float) -> Change:
    """Multiply one channel, or several."""

    def change(r: Recording) -> Recording:
        values = np.array(getattr(r, kind))
        values[:, index] *= factor
        return r.with_(**{kind: values})

    return change


def exchange_channels(kind: str, one: int, other: int) -> Change:
    """Exchange two channels."""

    def change(r: Recording) -> Recording:
        values = np.array(getattr(r, kind))
        values[:, [one, other]] = values[:, [other, one]]
        return r.with_(**{kind: values})

    return change


def scale_time(factor: float) -> Change:
    """Multiply the time."""
    return lambda r: r.with_(dt=r.dt * factor)


def open_start(r: Recording) -> Recording:
    """Estimate the initial state of a periodic recording, because it is not on its steady cycle."""
    return r.with_(initial="estimate", period=None) if r.begins == "periodic" else r


def change_recordings(bench: Workbench, change: Change) -> Workbench:
    """Return the bench with changed recordings; the errors are in units of their new deviation."""
    recordings = tuple(change(r) for r in bench.recordings)
    scale = np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
    return replace(bench, recordings=recordings, scale=scale)


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


# sign, unit, exchange, unit of time


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
            try:
                bench = Workbench.of(simulator, [scale_time(factor)(r) for r in recordings], hold, engine)
            except InputError:
                continue
            found = refit(bench)
            if found is not None and found.cost < USELESS_FIT:
                words = (
                    f"The time of the recordings is off by a factor of {1 / factor:.4g}, as from a wrong unit: as "
                    f"given, the simulator cannot follow at all; corrected, its error is {found.cost**0.5:.3g} of the "
                    "outputs' deviation."
                )
                return bench, [Gate("time", "time-unit", factor, words, fault=True, change=scale_time(factor))]
        raise error


def find_slips(now: Checked, workers: int, beside: str = "") -> Checked:
    """Try sign and unit of each channel, of all outputs and of the time, and exchanged channels, `workers` at a time.

    With `beside`, try that channel alone, in addition to the offset that it has already.
    """
    bench, plain = now.bench, now.fitted
    # with an offset there is a working point, which a run from rest would have to reach first
    sizes = _sizes(bench, plain.residual if beside else _from_rest(bench))
    near = (lambda ratio: True) if plain.cost > 1 else _near  # if the run diverged, its size says nothing
    outputs, inputs = bench.simulator.output_names, bench.simulator.inputs
    trials = list[Gate]()
    for kind, names in (("y", outputs), ("u", inputs)):
        for i, name in enumerate(names):
            trials.append(Gate(name, "sign", -1.0, change=scale_channels(kind, i, -1.0)))
            for f in (*FACTORS, *FAHRENHEIT) if beside else FACTORS:
                if near(f * sizes[i]) if kind == "y" else any(near(v / f) for v in sizes):
                    trials.append(Gate(name, "unit", f, change=scale_channels(kind, i, f)))
    if beside:
        return _take_best_slip(now, [g for g in trials if g.channel == beside], workers, " and an offset")
    for f in FACTORS if len(outputs) > 1 else ():
        if all(near(f * size) for size in sizes):
            trials.append(Gate(", ".join(outputs), "unit", f, change=scale_channels("y", list(range(len(outputs))), f)))
    for kind, names in (("y", outputs), ("u", inputs)) if plain.cost > POOR_FIT else ():
        for i, j in combinations(range(len(names)), 2):
            both = [names[i], names[j]]
            trials.append(Gate(", ".join(both), "exchange", both, change=exchange_channels(kind, i, j)))
    for f in TIME_UNITS if plain.cost > POOR_FIT else ():
        trials.append(Gate("time", "time-unit", f, change=scale_time(f)))
    return _take_best_slip(now, trials, workers)


def _take_best_slip(now: Checked, trials: Sequence[Gate], workers: int, more: str = "") -> Checked:
    """Take the trial with the smallest error, if it is far smaller than the error without it."""
    bench, plain = now.bench, now.fitted
    channels = (*bench.simulator.inputs, *bench.simulator.output_names)

    def tried(gate: Gate) -> Checked | None:
        assert gate.change is not None
        other: Workbench = change_recordings(bench, gate.change)
        like: Fitted | None = plain
        if gate.finding == "time-unit":
            try:
                other, like = Workbench.of(bench.simulator, other.recordings, bench.hold, bench.engine), None
            except InputError:
                return None
        glanced = refit(other, solver=GLANCE, like=like)
        if glanced is None or not glanced.cost < plain.cost:
            return None
        found = refit(other, [{}, glanced.values], states=glanced.begin, like=glanced)
        if found is None or (gate.finding == "time-unit" and found.at_bounds > BENT):
            return None
        return now.then(other, found, gate)

    best = now
    for found in side_by_side(tried, trials, workers):
        # for a linear simulator, a unit of all outputs is equivalent to a unit of its input, or of its only output
        joint = found is not None and found.gates[-1].finding == "unit" and found.gates[-1].channel not in channels
        if found is not None and found.cost < (CLEARLY if joint else 1 - 1e-6) * best.cost:
            best = found
    if best is now or best.cost > min(CURED * plain.cost, USELESS_FIT):
        return now
    gate = best.gates[-1]
    factor = 1 / gate.value if isinstance(gate.value, float) else 1.0
    be = "is" if gate.channel in (*channels, "time") else "are"
    what = f"{'the time' if gate.channel == 'time' else gate.channel} {be}"
    words = {
        "sign": f"{gate.channel} has the wrong sign{more}",
        "exchange": f"{gate.channel.replace(', ', ' and ')} are exchanged",
    }.get(gate.finding, f"{what} off by a factor of {factor:.4g}{more}, as from a wrong unit")
    sentence = f"In the recordings {words}: with it corrected {describe_fall(plain.cost, best.cost)}."
    return now.then(best.bench, best.fitted, replace(gate, sentence=sentence, fault=True, left=best.cost / plain.cost))


def _sizes(bench: Workbench, errors: Sequence[np.ndarray]) -> np.ndarray:
    """Compute the ratio of the measured to the simulated size of each output; nan if the simulation diverges."""
    with np.errstate(all="ignore"):
        y = [e + r.y for e, r in zip(errors, bench.recordings, strict=True)]
        return np.asarray(bench.scale / np.std(np.concatenate(y), axis=0))


def _from_rest(bench: Workbench) -> list[np.ndarray]:
    """Compute the errors of the simulator at the user's values, run from rest."""
    model = bench.model(bench.simulator)
    engine = make_engine(model, bench.engine)
    start, n = model.parameters.start, model.n_state
    with np.errstate(all="ignore"):
        return [engine.simulate(model.drive(r), start, np.zeros(n))[0] - r.y for r in bench.recordings]


def _near(ratio: float) -> bool:
    return not np.isfinite(ratio) or ratio == 0 or 1 / NEAR < ratio < NEAR


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


def find_slip_beside_offset(now: Checked, slipped: Checked, workers: int) -> Checked:
    """Return the corrected slips; try each output with a slip and an offset, and return that if it is far better.

    `find_offsets` reports the offset and keeps it.
    """
    bench = now.bench
    for name in bench.simulator.output_names if slipped.cost > POOR_FIT else ():
        placed = replace(bench, simulator=bench.simulator.with_element(f"sensor:{name}", Offset()))
        level = refit(placed, [{}, now.fitted.values], states=now.fitted.begin)
        if level is None:
            continue
        found = find_slips(Checked(placed, level, now.gates), workers, name)
        if len(found.gates) > len(now.gates) and found.cost < CURED * slipped.cost:
            slipped = replace(found, bench=replace(found.bench, simulator=bench.simulator))
    return slipped


def find_offsets(now: Checked) -> Checked:
    """Find constants at inputs and outputs, the most useful first, and keep them as parameters of the simulator.

    They count as a fault if they explain most of the mismatch.
    """
    begin = now
    ports = [f"actuator:{n}" for n in now.bench.simulator.inputs]
    ports += [f"sensor:{n}" for n in now.bench.simulator.output_names]
    taken = {e.port for e in now.bench.simulator.elements}
    ports = [port for port in ports if port not in taken]
    while ports:
        bench, plain = now.bench, now.fitted
        share = share_of_constants(bench, plain, ports)
        port = max(share, key=lambda name: share[name])
        if share[port] < LEAST:
            break
        other = replace(bench, simulator=bench.simulator.with_element(port, Offset()))
        parameter = f"{other.simulator.elements[-1].prefix}w_0"
        found = refit(other, [plain.values], states=plain.initial, solver=THOROUGH)
        if found is None or gain(plain.cost, found.cost, found.residual) < LEAST_GAIN:
            break
        value = float(found.values[parameter])
        sentence = f"{_constant(port, value)}; with it as a parameter {describe_fall(plain.cost, found.cost)}."
        now = now.then(other, found, Gate(port.split(":", 1)[1], "offset", value, sentence, parameter=parameter))
        ports.remove(port)
    fault = now.cost < CURED * begin.cost
    told = (replace(g, fault=fault) for g in now.gates[len(begin.gates) :])
    return begin.then(now.bench, now.fitted, *told)


def share_of_constants(bench: Workbench, fitted: Fitted, ports: Sequence[str]) -> dict[str, float]:
    """Compute the share of the mean square that a constant at each port removes, to first order."""
    first = FirstOrder.of(bench, fitted)
    columns = first.response(ports, [np.ones((len(r), 1)) for r in bench.recordings])
    rest = first.left(columns)
    seen = lengths(rest) > 1e-6 * lengths(columns)  # exclude constants that the initial state can follow
    along = np.where(seen, rest.T @ first.error / np.maximum(lengths(rest), 1e-150), 0.0)
    return dict(zip(ports, (along**2 / max(first.error @ first.error, 1e-300)).tolist(), strict=True))


def _constant(port: str, value: float) -> str:
    kind, name = port.split(":", 1)
    where, load = ("input", ", or a constant load acts like one") if kind == "actuator" else ("output", "")
    return f"The {where} {name} has a constant offset of about {value:.3g}{load}"


def offset_gates(elements: Sequence[Any], values: Mapping[str, Any]) -> list[Gate]:
    """List the offsets among fitted laws as findings."""
    out = []
    for e in elements:
        if isinstance(e.law, Offset):
            parameter = f"{e.prefix}w_0"
            value = float(values[parameter])
            sentence = f"{_constant(e.port, value)}; it is a parameter of the corrected simulator."
            out.append(Gate(e.port.split(":", 1)[1], "offset", value, sentence, parameter=parameter))
    return out


def without_idle_offsets(bench: Workbench, fitted: Fitted) -> Fitted:
    """Fix offsets at zero that gain nothing beside effects: an effect may have looked like an offset."""
    before = len(bench.simulator.elements)
    placed = fitted.simulator.elements
    for element in placed[:before] if len(placed) > before else ():
        if not isinstance(element.law, Offset):
            continue
        name = f"{element.prefix}w_0"
        held = replace(fitted.simulator.parameters[name], value=0.0, fixed=True)
        simulator = fitted.simulator.with_parameters({**fitted.simulator.parameters, name: held})
        start = {k: v for k, v in fitted.values.items() if k != name}
        found = refit(bench, [start], simulator, states=fitted.initial, solver=THOROUGH)
        if found is not None and gain(found.cost, fitted.cost, fitted.residual) <= LEAST_GAIN:
            fitted = found
    return fitted


def final_gates(
    gates: Sequence[Gate], after: Fitted, std: Mapping[str, np.ndarray], effects: bool, sure: bool
) -> tuple[Gate, ...]:
    """Return the findings with the offsets that remain, at their fitted values beside the effects, if any."""
    out = []
    for gate in gates:
        if not gate.parameter:
            out.append(gate)
            continue
        value, error = float(after.values[gate.parameter]), float(std[gate.parameter])
        if not (abs(value) > CERTAIN * error and abs(value) > STILL * abs(gate.value)):
            continue
        sentence = gate.sentence
        if effects:  # an offset fitted without the effects says little
            element = next(e for e in after.simulator.elements if gate.parameter.startswith(e.prefix))
            sentence = offset_gates([element], after.values)[0].sentence
        if not sure:
            sentence += " As long as the mismatch has no sure name, it may be a part of that."
        out.append(replace(gate, value=value, sentence=sentence))
    return tuple(out)
