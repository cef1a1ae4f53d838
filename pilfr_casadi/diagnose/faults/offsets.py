"""Constant errors of recordings: offsets of channels, and wrong initial states.

An offset that all recordings share becomes a parameter of the simulator, because a constant load has the same effect.
Offsets that differ between the recordings are subtracted. If an output's constant is larger than its deviation, one of
an input that looks the same is reported instead. A constant load that looks the same is reported as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ..._base import in_words
from ...data import Recording, moves_freely
from ...laws import Gain, Law
from ...simulators import ACTUATOR, EQUATION, SENSOR, Placed, Simulator, in_series, kind_of, port_name, split_port
from ..fits.evidence import FORMULA_ERROR
from ..fits.floor import ABOVE_NOISE, effective_size, noise_floor, samples_of_mean
from ..fits.screen import block_diagonal, lengths
from ..fits.workbench import FEW, THOROUGH, Fitted, Workbench, refit
from .gates import (
    CERTAIN_ERRORS,
    CURED_SHARE,
    EQUAL_RATIO,
    EXCEPTION_SHARE,
    LEAST_GAIN,
    NEAR_NOISE_RATIO,
    Checked,
    FirstOrder,
    Gate,
    accept,
    correct,
    evidence_gain,
    follows_better,
    settle,
    value_with_unit,
)

KEPT_OFFSET = 0.1  # share of its first value that an offset must keep beside effects to be reported
VISIBLE_SHARE = 1e-6  # share of a constant's response above which initial states cannot follow it


@dataclass(frozen=True)
class WrongStart(Gate):
    """Initial states that are not as stated; other physics may remain beside it.

    Attributes
    ----------
    otherwise : WrongStart
        Finding to report instead if a search with estimated initial states follows better.
    """

    otherwise: WrongStart | None = None

    most_left: ClassVar[float] = 1.0
    remedy: ClassVar[str] = "with them estimated"


def find_wrong_start(now: Checked) -> Checked:
    """Estimate the initial states if the stated ones contradict the first samples more than a sensor's zero could.

    Missing dynamics cannot contradict a first sample. If the sensor's zero is wrong instead, it is wrong by that miss.
    So both explanations begin at the first sample, and the refit decides which one is reported.
    """
    bench, misses = now.bench, _missed_starts(now)
    stated = [r for r in bench.recordings if r.begins in ("zero", "given")]
    # the states of other recordings come out as stated
    unknown = sum(map(np.any, misses)) * len(bench.simulator.states)
    if not unknown:
        return now
    missed = _describe_miss(now, misses)
    words = f"The initial states are not as stated: {missed}"
    fault = WrongStart("initial state", "start", stated[0].begins, words, change=_with_unknown_start)
    after = correct(now, fault, [now.fitted.values, {}])
    if after is None or evidence_gain(now.cost, after.cost, after.residuals, unknown) < LEAST_GAIN:
        return now
    zeroed = [r.with_(y=r.y + miss) for r, miss in zip(bench.recordings, misses, strict=True)]
    rival = refit(bench.on(zeroed), [now.fitted.values, {}], states=now.fitted.begin)
    left = np.inf if rival is None else _error_at_own_zero(bench, rival, misses)
    if left > EQUAL_RATIO * after.cost:
        return accept(now, after, fault)
    if EQUAL_RATIO * left > after.cost:
        words = f"{words}; a wrong zero of the sensor explains that as well"
        return accept(now, after, replace(fault, sentence=words))
    searched = f"{words}; a search with them estimated follows better than one with a wrong zero of the sensor."
    otherwise = replace(fault, sentence=searched, fault=True)
    words = "a wrong zero of the sensor explains that better than another start. If the machine did begin elsewhere"
    words = f"As stated, {missed}; {words}, give each state's value, or leave the start unknown."
    zero = replace(fault, sentence=words, corrected=False, change=None, otherwise=otherwise)
    return now.then(bench, now.fitted, zero)


def _error_at_own_zero(bench: Workbench, zeroed: Fitted, misses: Sequence[np.ndarray]) -> float:
    """Compute the mean square error without the constants that are left where one noisy sample has set the zero."""
    residuals = bench.scored(zeroed.residual)
    most = CERTAIN_ERRORS * noise_floor(bench.recordings, residuals).deviation
    left = [np.clip(np.mean(e, axis=0), -most, most) * (miss != 0) for e, miss in zip(residuals, misses, strict=True)]
    errors = np.concatenate([e - constant for e, constant in zip(residuals, left, strict=True)])
    return bench.pool(np.mean(errors**2, axis=0) / bench.scale**2)


def _missed_starts(now: Checked) -> list[np.ndarray]:
    """Compute by how much a run from its stated start misses each recording's first sample, (n_y,); noise is zero."""
    least, both = CERTAIN_ERRORS * now.floor.deviation, zip(now.bench.recordings, now.fitted.residual, strict=True)
    first = (e[0] if r.begins in ("zero", "given") else np.zeros(r.n_y) for r, e in both)
    return [np.where(np.abs(e) > least, e, 0.0) for e in first]


def _describe_miss(now: Checked, misses: Sequence[np.ndarray]) -> str:
    """Describe the first sample that is missed most."""
    i, k = divmod(int(np.argmax(np.abs(np.array(misses)) / now.bench.scale)), len(now.bench.scale))
    r, name = now.bench.recordings[i], now.bench.simulator.output_names[k]
    stated, first = r.y[0, k] + misses[i][k], r.y[0, k]
    of = f" of {r.name or f'recording {i + 1}'}" if len(misses) > 1 else ""
    scaled = f", unless the scale of {name} is wrong" if abs(stated) > FORMULA_ERROR * abs(first) else ""
    return f"{name} would begin at {stated:.3g}, but its first sample{of} is {first:.3g}{scaled}"


def _with_unknown_start(r: Recording) -> Recording:
    return r.with_(initial="estimate") if r.begins in ("zero", "given") else r


class Offset(Law):
    """A constant added to a signal; it stays a parameter of the simulator and is fitted together with the laws."""

    id = "offset"
    equation = "w = w_0"
    source = "Ljung (1999), System Identification, sec. 14.1"
    sentence = "a constant offset of the signal"
    units: ClassVar[Mapping[str, str]] = {"w_0": "w"}
    strength: ClassVar[tuple[str, ...]] = ("w_0",)
    places: ClassVar[tuple[str, ...]] = ("series",)
    listed: ClassVar[bool] = False

    def force(self, p: Any) -> Any:
        """Return the constant."""
        return p.w_0


class Load(Offset):
    """A constant force or flow at an inner port, which may act like an offset; only to compare both."""

    places: ClassVar[tuple[str, ...]] = ("parallel",)


def find_placed_offsets(elements: Iterable[Placed]) -> dict[str, Placed]:
    """Return the offsets among elements, by the full name of their parameter."""
    return {f"{e.prefix}w_0": e for e in elements if isinstance(e.law, Offset)}


def describe_offsets(elements: Iterable[Placed]) -> str:
    """Name the channels of the offsets among elements, such as "the offsets of u and y"; "" if there is none."""
    channels = [split_port(e.port)[1] for e in find_placed_offsets(elements).values()]
    return f"the offset{'s' * (len(channels) > 1)} of {in_words(channels)}" if channels else ""


def _law_of_constant(port: str) -> Offset:
    return Offset() if in_series(port) else Load()


@dataclass(frozen=True)
class SharedOffset(Gate):
    """A constant at a port that all recordings share, a parameter of the simulator; other physics may remain beside it.

    `alike` says in the sentence what else the recordings may show.
    """

    port: str = ""
    alike: str = ""
    parameters: ClassVar[int] = 1
    most_left: ClassVar[float] = 1.0
    remedy: ClassVar[str] = "with it as a parameter"

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with the constant in its simulator."""
        return replace(bench, simulator=bench.simulator.with_element(self.port, _law_of_constant(self.port)))

    def count_samples(self, residuals: Sequence[np.ndarray]) -> float:
        """Count the samples that determine a mean: slow physics that is missing hides a constant."""
        return samples_of_mean(residuals)


def describe_constant(
    port: str, value: float = 0.0, parameter: str = "", unit: str = "", alike: str = ""
) -> SharedOffset:
    """Return the fault that a channel has a constant offset; `alike` says what else it may be."""
    kind, name = split_port(port)
    own = ", or a constant load acts like one, as do dry friction and a dead zone while the input keeps its sign"
    where, load = ("input", own) if kind == ACTUATOR else ("output", "")
    words = f"The {where} {name} has a constant offset of about {value_with_unit(value, unit)}{load}{alike}"
    return SharedOffset(name, "offset", value, words, parameter=parameter, port=port, alike=alike)


def find_offsets(now: Checked, otherwise: Mapping[str, str] | None = None) -> Checked:
    """Find constants at inputs and outputs, the most useful first, and keep them as parameters of the simulator.

    They count as a fault if they explain most of the mismatch. Offsets of each recording's own take their place where
    more than noise is left and they gain enough. `otherwise` says by port which other fault follows as well.
    """
    begin, ports = now, _channels(now.bench.simulator)
    inner = [port.name for port in now.bench.simulator.all_ports() if not port.series]
    while ports:
        share = share_of_constants(now.bench, now.fitted, [*ports, *inner])
        largest = max(share[name] for name in ports)
        if largest < EXCEPTION_SHARE:
            break
        alike = [name for name in share if np.isclose(share[name], largest)]  # as at an input and an output behind it
        start = [now.fitted.values], now.fitted.initial
        tried = {name: correct(now, describe_constant(name), *start, THOROUGH) for name in alike}
        settled = {name: found for name, found in tried.items() if found is not None}
        port = _choose_constant(settled)
        if not port:
            break
        after, words = settled[port], _describe_alike(settled, port, (otherwise or {}).get(port, ""))
        name, unit = _name_of_constant(after), now.bench.simulator.port(port).unit
        if _stands_for_load(now.bench, port, _constant(after)):
            break
        words += _doubt_size(now.bench, port, _constant(after))
        constant = describe_constant(port, _constant(after), name, unit, words)
        before, now = now, accept(now, after, constant)
        if now.bench is before.bench:
            break
        ports.remove(port)
    fault = now.cost < CURED_SHARE * begin.cost
    # a constant load acts alike, so that the share that is left does not prove a fault
    added = (replace(g, fault=fault, left=1.0) for g in now.gates[len(begin.gates) :])
    shared = begin.then(now.bench, now.fitted, *added)
    if shared.cost < NEAR_NOISE_RATIO**2 * shared.noise2:
        return shared
    each = find_varying_offset(begin)
    more = len(begin.bench.recordings) - len(shared.gates) + len(begin.gates)
    return each if evidence_gain(shared.cost, each.cost, each.residuals, more) > LEAST_GAIN else shared


def recorded_at(recordings: Sequence[Recording], port: str) -> np.ndarray:
    """Return the channel (M,) of an actuator or a sensor, of all recordings one after the other."""
    kind, name = split_port(port)
    sides = [(r.u, r.inputs) if kind == ACTUATOR else (r.y, r.outputs) for r in recordings]
    return np.concatenate([values[:, names.index(name)] for values, names in sides])


def _stands_for_load(bench: Workbench, port: str, value: float) -> bool:
    """Tell whether an offset of an output is larger than the output ever was, in recordings without a changing input.

    Such an offset acts like a constant load, as dry friction in a coast-down is until the machine stands.
    """
    if kind_of(port) != SENSOR or not moves_freely(bench.recordings):
        return False
    return bool(abs(value) > np.max(np.abs(recorded_at(bench.recordings, port))))


def _doubt_size(bench: Workbench, port: str, value: float) -> str:
    """Say that an offset of an input that moves is more than the input ever was; "" if it is not."""
    if kind_of(port) != ACTUATOR:
        return ""
    u = recorded_at(bench.recordings, port)
    larger = abs(value) > np.max(np.abs(u)) and np.ptp(u) > 0
    return f"; that is more than {split_port(port)[1]} ever was, which speaks for a constant load" if larger else ""


def _name_of_constant(after: Checked) -> str:
    """Return the parameter of the constant that was fitted last."""
    return list(find_placed_offsets(after.bench.simulator.elements))[-1]


def _constant(after: Checked) -> float:
    """Return the value of the constant that was fitted last."""
    return float(after.fitted.values[_name_of_constant(after)])


def _is_large(port: str, after: Checked) -> bool:
    """Tell whether a constant is at an output and above its deviation, which a sensor's zero hardly ever is."""
    if kind_of(port) != SENSOR:
        return False
    i = after.bench.simulator.output_names.index(split_port(port)[1])
    return abs(_constant(after)) > after.bench.scale[i]


def _choose_constant(settled: Mapping[str, Checked]) -> str:
    """Choose the channel whose constant follows best; "" if there is none.

    An input's constant that acts alike takes the place of a large one of an output.
    """
    channels = [port for port in settled if in_series(port)]
    best = min(channels, key=lambda port: settled[port].cost, default="")
    if not best or not _is_large(best, settled[best]):
        return best
    inputs = [port for port in _alike(settled, best) if kind_of(port) == ACTUATOR]
    return min(inputs, key=lambda port: settled[port].cost, default=best)


def _alike(settled: Mapping[str, Checked], port: str) -> list[str]:
    """List the other ports whose constant follows about as well."""
    one = settled[port]
    others = ((name, found.cost) for name, found in settled.items() if name != port)
    return [name for name, cost in others if not follows_better(one.cost, cost, one.residuals)]


def _describe_alike(settled: Mapping[str, Checked], port: str, other: str) -> str:
    """Describe what acts like a constant: one of another channel, a constant load, or the fault `other`."""
    alike, own, words = _alike(settled, port), settled[port].bench.simulator, ""
    loads = [name for name in alike if not in_series(name)]
    if loads and kind_of(port) == SENSOR:
        places = [f"in the {p.replace(':', ' of ')}" if kind_of(p) == EQUATION else f"at {p}" for p in loads]
        words += f", or a constant load {' or '.join(places)} acts like one"
    for name in (n for n in alike if in_series(n) and not _is_large(n, settled[n])):
        where = "input" if kind_of(name) == ACTUATOR else "output"
        size = value_with_unit(_constant(settled[name]), own.port(name).unit)
        words += f", or the {where} {split_port(name)[1]} has one of about {size}"
    return f"{words}; or else {other}: these recordings do not tell which" if other else words


def find_rivals(now: Checked, after: Checked, cost: float) -> list[tuple[str, Law]]:
    """List the constants at ports, and the gains of channels, that follow about as well as a fault.

    `after` is the refit with the fault corrected, to as many samples, and `cost` the mean square that it leaves.
    """
    simulator, found = now.bench.simulator, list[tuple[str, Law]]()
    for port in simulator.all_ports():
        for law in (_law_of_constant(port.name), Gain()) if port.series else (Load(),):
            placed = simulator.with_element(port.name, law)
            fitted = refit(now.bench, [now.fitted.values, after.fitted.values], placed, states=now.fitted.initial)
            if fitted is not None and not follows_better(cost, fitted.cost, after.residuals):
                found.append((port.name, law))
    return found


@dataclass(frozen=True)
class VaryingOffset(Gate):
    """Constants of a channel that differ between the recordings, as of a sensor that is zeroed before each.

    `value` has one constant for each recording; `port` is the channel's port.
    """

    port: str = ""

    @property
    def parameters(self) -> int:  # type: ignore[override]
        """Number of the constants."""
        return len(self.value)

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with the constants subtracted from its recordings."""
        return replace(bench, recordings=tuple(map(self.subtract, bench.recordings, self.value)))

    def apply_to_whole(self, whole: list[Recording], places: Sequence[tuple[int, int]]) -> list[Recording]:
        """Subtract from each recording the mean of the constants of its stretches; none if gaps have cut stretches."""
        if len(self.value) != len(places):
            return whole
        each = [[v for v, (k, _) in zip(self.value, places, strict=True) if k == i] for i in range(len(whole))]
        return [self.subtract(r, float(np.mean(v))) if v else r for r, v in zip(whole, each, strict=True)]

    def subtract(self, r: Recording, value: float) -> Recording:
        """Subtract a constant from the channel of a recording."""
        kind, name = split_port(self.port)
        side, names = ("u", r.inputs) if kind == ACTUATOR else ("y", r.outputs)
        at = np.array([one == name for one in names], dtype=float)
        return r.with_(**{side: getattr(r, side) - value * at})

    def relocate(self, now: Checked, after: Checked) -> VaryingOffset:
        """Return the constants that follow best to first order at the corrected refit."""
        first = FirstOrder.of(after.bench, after.fitted)
        return self.at(np.add(self.value, _constants_of_each(first, self.port)[1]))

    def at(self, values: np.ndarray) -> VaryingOffset:
        """Return it with other constants."""
        value = [float(f"{v:.6g}") for v in values]
        listed_values = ", ".join(f"{v:.3g}" for v in value)
        words = (
            f"{self.channel} has an offset that differs between the recordings, {listed_values}, and may be another in "
            "further ones"
        )
        return replace(self, value=value, sentence=words)


def _constants_of_each(first: FirstOrder, port: str) -> tuple[float, np.ndarray]:
    """Compute the share of the mean square that a constant of each recording's own removes, and the constants."""
    recordings = first.bench.recordings
    ends = np.cumsum([r.y[r.skip :].size for r in recordings])
    response = first.response([port], [np.ones((len(r), 1)) for r in recordings])
    rest, seen = _visible(first, block_diagonal(np.split(response, ends[:-1]), 0))
    found = np.zeros(len(recordings))
    found[seen] = np.linalg.lstsq(rest[:, seen], first.error, rcond=1e-8)[0]
    left = first.project_off(first.error)
    share = 1 - np.sum((left - rest @ found) ** 2) / max(left @ left, 1e-300)
    return float(share), found if kind_of(port) == ACTUATOR else -found


def _visible(first: FirstOrder, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of responses that parameters and initial states cannot follow, and mark the visible ones."""
    rest = first.project_off(columns)
    return rest, lengths(rest) > VISIBLE_SHARE * lengths(columns)


def find_varying_offset(now: Checked) -> Checked:
    """Subtract constants that differ between the recordings if the rule accepts them and only noise is left.

    The mean effect of missing physics may differ between the recordings as well.
    """
    if len(now.bench.recordings) < 2:
        return now
    first = FirstOrder.of(now.bench, now.fitted)
    found = {port: _constants_of_each(first, port) for port in _channels(now.bench.simulator)}
    likely = sorted(found, key=lambda port: -found[port][0])[:FEW]
    faults = (VaryingOffset(split_port(p)[1], "offset", (), port=p).at(found[p][1]) for p in likely)
    settled = [pair for fault in faults if (pair := settle(now, fault)) is not None]
    if not settled:
        return now
    fault, after = min(settled, key=lambda pair: pair[1].cost)
    return accept(now, after, fault) if after.cost < ABOVE_NOISE**2 * after.noise2 else now


def _channels(simulator: Simulator) -> list[str]:
    """List the ports of the inputs and outputs that have no element yet."""
    ports = [port_name(ACTUATOR, n) for n in simulator.inputs]
    ports += [port_name(SENSOR, n) for n in simulator.output_names]
    return [port for port in ports if port not in {e.port for e in simulator.elements}]


def share_of_constants(bench: Workbench, fitted: Fitted, ports: Sequence[str]) -> dict[str, float]:
    """Compute the share of the mean square that a constant at each port removes, to first order."""
    first = FirstOrder.of(bench, fitted)
    rest, seen = _visible(first, first.response(ports, [np.ones((len(r), 1)) for r in bench.recordings]))
    along = np.where(seen, rest.T @ first.error / np.maximum(lengths(rest), 1e-150), 0.0)
    return dict(zip(ports, (along**2 / max(first.error @ first.error, 1e-300)).tolist(), strict=True))


def list_offsets(
    elements: Iterable[Placed],
    values: Mapping[str, Any],
    simulator: Simulator | None = None,
    alike: Mapping[str, str] | None = None,
) -> list[Gate]:
    """List the offsets among fitted laws as findings, with the units that the simulator knows.

    `alike` says by parameter what else a constant may be.
    """
    out, words = list[Gate](), alike or {}
    for name, e in find_placed_offsets(elements).items():
        unit = simulator.port(e.port).unit if simulator else ""
        constant = describe_constant(e.port, float(values[name]), name, unit, words.get(name, ""))
        out.append(replace(constant, sentence=f"{constant.sentence}; it is a parameter of the corrected simulator."))
    return out


def fix_idle_offsets(bench: Workbench, fitted: Fitted) -> Fitted:
    """Fix offsets at zero that gain nothing beside effects, because an effect may have looked like an offset."""
    before = len(bench.simulator.elements)
    placed = fitted.simulator.elements
    for name in find_placed_offsets(placed[:before]) if len(placed) > before else ():
        zero = replace(fitted.simulator.parameters[name], value=0.0, fixed=True)
        simulator = fitted.simulator.with_parameters({**fitted.simulator.parameters, name: zero})
        start = {k: v for k, v in fitted.values.items() if k != name}
        found = refit(bench, [start], simulator, states=fitted.initial, solver=THOROUGH)
        rest = bench.scored(fitted.residual)
        if found and evidence_gain(found.cost, fitted.cost, rest, samples=samples_of_mean(rest)) <= LEAST_GAIN:
            fitted = found
    return fitted


def refit_without_offsets(bench: Workbench, fitted: Fitted, own: int) -> Fitted:
    """Refit a simulator with its first `own` elements only; as fitted if the rest has no offset, or if it diverges."""
    simulator = remove_offsets(fitted.simulator, own)
    if simulator is fitted.simulator:
        return fitted
    values = {name: fitted.values[name] for name in simulator.parameters}
    return refit(bench, [values, {}], simulator, states=fitted.initial, solver=THOROUGH) or fitted


def remove_offsets(simulator: Simulator, own: int, idle: bool = False) -> Simulator:
    """Return a simulator without its offsets after the first `own` elements.

    With `idle` only those are removed that `fix_idle_offsets` has fixed.
    """
    for name, e in find_placed_offsets(simulator.elements[own:]).items():
        if not idle or np.all(simulator.parameters[name].fixed):
            simulator = simulator.without_element(simulator.elements.index(e))
    return simulator


def update_offsets(
    gates: Sequence[Gate], after: Fitted, std: Mapping[str, np.ndarray], effects: bool, sure: bool
) -> tuple[Gate, ...]:
    """Return the findings with the offsets at their fitted values; drop offsets that the effects have replaced.

    Without effects they stay, because the corrected simulator has them.
    """
    alike = {g.parameter: g.alike for g in gates if isinstance(g, SharedOffset)}
    fitted = {g.parameter: g for g in list_offsets(after.simulator.elements, after.values, after.simulator, alike)}
    units = {
        name: after.simulator.port(e.port).unit for name, e in find_placed_offsets(after.simulator.elements).items()
    }
    # standard errors count the samples that are independent for any parameter
    ratio = (effective_size(after.residual) / samples_of_mean(after.residual)) ** 0.5
    out = []
    for gate in gates:
        if not gate.parameter:
            out.append(gate)
            continue
        remaining, error = fitted[gate.parameter], ratio * float(std[gate.parameter])
        uncertain = abs(remaining.value) <= CERTAIN_ERRORS * error  # an unknown error says nothing
        replaced = uncertain or not abs(remaining.value) > KEPT_OFFSET * abs(gate.value)
        if replaced and effects:
            continue
        sentence = remaining.sentence if effects else gate.sentence  # the value before the effects says little
        if not sure:
            sentence += " As long as the mismatch has no sure name, it may be a part of that."
        before, now = (value_with_unit(g.value, units.get(gate.parameter, "")) for g in (gate, remaining))
        if not effects and (replaced or now != before):
            sentence += f" Beside the correction it is {now}{', and may be zero' if replaced else ''}."
        out.append(replace(gate, value=remaining.value, sentence=sentence))
    return tuple(out)
