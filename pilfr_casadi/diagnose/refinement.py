"""Identify a Prandtl-Ishlinskii element in the port where a diagnosis has found hysteresis.

The catalogue describes hysteresis by few numbers, to distinguish it from other physics. Once its port is known, a layer
of many operators takes the place of the found law (Krikelis et al. 2024, Eq. 16),

    w(k) = Σ_i w_i H_{r_i}[z](k),   w_i ≥ 0, r_i ≥ 0,

with H a stop, a play or a generalized play; `laws.hysteresis_layer` adds a linear term where it belongs. Thresholds
start on grids over the range of z along the diagnosed run, weights at the non-negative least-squares fit of the
diagnosed law's force there. Then all of them are fitted together with the simulator's own parameters and the other
laws, on the recordings, the steps and the hold of the diagnosis; the solver keeps the bounds. As in `fit`, the
thresholds of the best fit are then spread along the density of their weights, because some have clustered or are idle,
and the layer is fitted again, as long as that helps.

The layer replaces the law if it predicts held-out parts of the training recordings better (`evidence`): by the error on
blocks or second halves that a fit has not seen, plus the spread of predictions for other inputs, which grows with every
parameter that the recordings hardly determine. Test recordings are never used. Otherwise the diagnosed law stays.

The initial loading curve is the response to z growing from zero with empty memory (virgin curve); for plays
`Σ w_i max(z - r_i, 0)`, for stops `Σ w_i min(z, r_i)` (Kuhnen 2003, Eur. J. Control 9(4)), plus the linear term.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Interrupt, one_blas_thread, percent, whole
from ..data import Recording
from ..engine import make_engine
from ..identify import regrid
from ..laws import OPERATORS, Law, Local, display_name, hysteresis_layer, unit_forces
from ..models import check_size, play
from ..simulators import Simulator, discretise, in_series, on_grid
from .fits.evidence import EffectiveSamples, ExpectedError, HeldOut, held_out_errors, spread
from .fits.force_recovery import signals_along
from .fits.workbench import THOROUGH, CompiledSimulator, Fitted, Workbench
from .search.moves import Search

FINE_THRESHOLDS = 40  # thresholds of each of the two fine grids that estimate the density of weights
BENDS = (-0.2, 0.0, 0.2)  # tried bends of generalized plays, a_2 times the largest |z|, as in the catalogue
SPLIT = 0.2  # distance of the parts into which a threshold of the diagnosed law is split, over the threshold
LEAST_START_WEIGHT = 0.01  # least weight of an operator at a start, over the mean weight
IDLE_SHARE = 1e-9  # deviation of an operator's output, over the largest, below which it is idle
EXTENT = 1.2  # range in which thresholds are spread, over the threshold below which 99 % of the weight lies
ROUNDS, GAIN = 3, 0.99  # rounds of spreading the thresholds; ratio of costs above which no further round follows
PRINTED_WEIGHT = 1e-3  # weight of an operator, over the largest, below which it is not printed
CURVE_POINTS = 201  # points of a loading curve
PER_OPERATOR = 10  # least samples for each operator: its weight, its threshold and their standard errors
DIAGNOSED = "diagnosed"  # key of the law that the diagnosis has found
HYSTERETIC = ("hysteresis", "backlash")  # ids of laws with rate-independent memory; friction with presliding has it too


@dataclass(frozen=True, eq=False)
class Refinement:
    """A Prandtl-Ishlinskii layer in place of the hysteresis that a diagnosis has found.

    Attributes
    ----------
    port, kind : str
        The port, and the operators of the layer: "stop", "play" or "generalized_play".
    improves : bool
        Whether the layer predicts held-out training data better than the diagnosed law. If not, `simulator` has the
        diagnosed law.
    thresholds, weights : array, shape (n,)
        Threshold r_i (unit of z) and weight w_i (unit of w over z) of each operator, by increasing threshold: the
        weight density over r.
    linear : float
        Coefficient k_0 of the linear term beside the operators; 0 if there is none.
    loading_curve : tuple of array, shape (G,)
        z from 0 to half its range in the training recordings, and w there from empty memory; at an actuator or a sensor
        the whole signal z + w.
    expected : mapping
        Errors on held-out training data and the spread for other inputs, in units of the outputs' deviation, of the
        "diagnosed" law and of each kind of layer that was tried.
    errors : mapping
        "train", "test" -> "diagnosed", "refined": NRMSE, averaged over outputs and recordings; "test" is None without
        test recordings.
    layer : Simulator
        The simulator with the layer, whether it improves or not.
    """

    port: str
    kind: str
    improves: bool
    thresholds: np.ndarray
    weights: np.ndarray
    linear: float
    loading_curve: tuple[np.ndarray, np.ndarray]
    expected: Mapping[str, ExpectedError]
    errors: Mapping[str, Mapping[str, float] | None]
    layer: Simulator
    _chosen: Any  # the Diagnosis with `simulator`; its file imports this one
    _law: str
    _loops: tuple[np.ndarray, ...]

    @property
    def simulator(self) -> Simulator:
        """The simulator with the layer, or with the diagnosed law if the layer does not predict better."""
        corrected: Simulator = self._chosen.corrected
        return corrected

    @property
    def held_out(self) -> dict[str, HeldOut]:
        """The errors on held-out training data alone, without the spread: an old spelling of `expected`."""
        return {name: one.held_out for name, one in self.expected.items()}

    @property
    def sentence(self) -> str:
        """Say whether the layer replaces the diagnosed law, and why."""
        what = f"A layer of {len(self.weights)} {self.kind.replace('_', ' ')}s at {self.port}"
        before, after = (percent(self.expected[k].rms) for k in (DIAGNOSED, self.kind))
        errors = f"the expected error is {after} of the outputs' deviation with the layer and {before} with the law"
        if self.improves:
            return f"{what} takes the place of {self._law}: by held-out training data {errors}."
        return f"{what} does not predict better than {self._law}, which stays: by held-out training data {errors}."

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulate the chosen simulator along the inputs of a recording, shape (M, n_y); see `Diagnosis.simulate`."""
        return np.asarray(self._chosen.simulate(recording))

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """Compute the NRMSE of the chosen simulator; see `Diagnosis.nrmse`."""
        return float(self._chosen.nrmse(recordings))

    def export(self, **options: Any) -> Any:
        """Export the chosen simulator as a step over one sample; see `Diagnosis.export`."""
        return self._chosen.export(**options)

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """Export the chosen simulator as a `casadi.Function (x, u) -> (x_next, y)`; see `pilfr.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def plot(self) -> Any:
        """Draw the loops along the training recordings, the loading curve, and the weights over thresholds.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from ..plots import Signal, refined_hysteresis

        port, (z, w, z_before, w_before) = self.layer.port(self.port), self._loops
        across, up = ("z", "z + w") if in_series(self.port) else ("z", "w")
        return refined_hysteresis(
            Signal(across, z, port.across_unit),
            Signal(up, w, port.unit),
            (z_before, w_before),
            self.loading_curve,
            (self.thresholds, self.weights),
            names=(f"{len(self.weights)} {self.kind.replace('_', ' ')}s", self._law),
        )

    def __str__(self) -> str:
        lines = [self.sentence, f"{'NRMSE':<12}{DIAGNOSED:>11}{'refined':>11}"]
        for kind, errors in self.errors.items():
            if errors is not None:
                lines.append(f"  {kind:<10}" + "".join(f"{errors[k]:>11.4g}" for k in (DIAGNOSED, "refined")))
        lines.append(f"{'held-out training data':<24}{'error':>9}{'expected':>11}  (with the spread for other inputs)")
        for name, found in self.expected.items():
            lines.append(f"  {name.replace('_', ' '):<22}{found.held_out.rms:>9.4g}{found.rms:>11.4g}")
        port = self.layer.port(self.port)
        unit = f" [{port.across_unit}]" if port.across_unit else ""
        used = self.weights > PRINTED_WEIGHT * np.max(self.weights)
        lines.append(f"{np.sum(used)} of {len(used)} operators are in use; threshold{unit} and weight:")
        lines += [f"  {r:11.5g}{w:13.5g}" for r, w in zip(self.thresholds[used], self.weights[used], strict=True)]
        return "\n".join(lines)

    __repr__ = __str__


@one_blas_thread
def refine(diagnosis: Any, operators: int, kind: str | None, port: str | None) -> Refinement:
    """Carry out `Diagnosis.refine` for a Diagnosis; see there."""
    n = whole(operators, "operators", 1)
    check_size("A layer", 2 * n)
    if kind is not None and kind not in OPERATORS:
        raise InputError(f"kind = {kind!r} was given; give {', '.join(map(repr, OPERATORS))}, or None to try them.")
    search, after = diagnosis.evidence.search, diagnosis.evidence.after
    if search is None or after is None:
        raise InputError("This diagnosis does not hold its search; refine one that `diagnose` has just returned.")
    search.bench = replace(search.bench, interrupt=Interrupt())  # an interrupt of an earlier one is over
    samples = sum(len(r) - r.skip for r in search.bench.recordings)
    if PER_OPERATOR * n > samples:
        raise InputError(
            f"operators = {n} was given for {samples} training samples; give at most {max(samples // PER_OPERATOR, 1)}."
        )
    number = _find_hysteresis(diagnosis, after, len(search.bench.simulator.elements), port)
    element = after.simulator.elements[number]
    series = in_series(element.port)
    kinds: tuple[str, ...] = ("play", "stop", "generalized_play") if series else ("stop", "play")
    if kind is not None:
        kinds = (kind,)
    laws = {name: hysteresis_layer(name, n, series) for name in kinds}  # refuses kinds that the port does not allow
    expected = {DIAGNOSED: _predict(search, after)}
    layers: dict[str, Fitted] = {}
    for name, law in laws.items():
        fitted = _fit_layer(search.bench, after, number, law)
        if fitted is not None:
            layers[name], expected[name] = fitted, _predict(search, fitted)
        search.bench.interrupt.raise_pending()
    if not layers:
        raise InputError(
            f"With a layer of {n} operators at {element.port} the simulation diverges; give fewer operators, or keep "
            "the diagnosed law."
        )
    best, *others = layers
    for name in others:  # plays and stops differ only by a line; another kind has to be better in both errors
        one, other = expected[best], expected[name]
        better = other.held_out.mean_square < one.held_out.mean_square and other.mean_square < one.mean_square
        best = name if better else best
    return _build_refinement(diagnosis, search.bench, best, layers[best], number, expected)


def _predict(search: Search, fitted: Fitted) -> ExpectedError:
    """Compute the error that is expected of a fitted simulator on other recordings.

    The spread uses the held-out error as mean square error, without the error that a search allows the formula of a
    named law.
    """
    bench = search.bench
    found = held_out_errors(bench, fitted, search.workers)
    v = found.mean_square
    n = EffectiveSamples(search.floor2, search.count_samples(fitted)).at(v)
    return ExpectedError(found, spread(bench, fitted, search.added_laws(fitted), v, n) if np.isfinite(v) else np.inf)


def _find_hysteresis(diagnosis: Any, after: Fitted, given: int, port: str | None) -> int:
    """Return the index of the surest law with rate-independent memory (at the port, if one is given)."""
    elements = after.simulator.elements
    found = [i for i in range(given, len(elements)) if _is_hysteretic(elements[i].law)]
    if not found:
        words = diagnosis.correction.words if diagnosis.correction else ""
        raise InputError(
            f"The diagnosis found {words or 'nothing to add'}, and no hysteresis, backlash or friction with presliding "
            "that a layer of operators could refine."
        )
    ports = list(dict.fromkeys(elements[i].port for i in found))
    if port is not None and port not in ports:
        raise InputError(f"port = {port!r} was given; the diagnosis found hysteresis at {', '.join(ports)}.")
    rank = {(e.port, e.law): k for k, e in enumerate(diagnosis.effects)}
    there = [i for i in found if port in (None, elements[i].port)]
    return min(there, key=lambda i: rank.get((elements[i].port, elements[i].law.id), len(rank)))


def _is_hysteretic(law: Law) -> bool:
    """Tell whether a law has a rate-independent memory that operators can take over."""
    return law.id in HYSTERETIC or law.form.startswith("presliding")


def _fit_layer(bench: Workbench, after: Fitted, number: int, kind: type[Law]) -> Fitted | None:
    """Fit a layer in place of an element, together with all other parameters; None if the simulation diverges."""
    old = after.simulator.elements[number]
    z, dz, force = signals_along(bench, after, number)
    local = bench.local(z, dz)
    starts = _start_values(kind(), local, force, old.own(after.values))
    layer = kind().at(starts[0], kind().bounds(local))
    placed = after.simulator.without_element(number).with_element(old.port, layer, number)
    element = placed.elements[number]
    model = discretise(placed, bench.dt, bench.hold, after.model.substeps)
    layered = CompiledSimulator(placed, model, make_engine(model, bench.engine))
    first, h = np.cumsum([0, *local.lengths])[:-1], bench.dt / after.model.substeps
    states = [_initial_state(after, s, number, element.law, z[k], h) for s, k in zip(after.initial, first, strict=True)]
    own = [{**after.values, **element.named(start)} for start in starts]
    try:
        best = bench.fit(placed, own, states=states, like=layered)
        for _ in range(ROUNDS):
            values = element.own(best.values)
            moved = {**values, **_spread_thresholds(values["r"], values["w"], local.half, len(values["r"]))}
            own = [{**best.values, **element.named(moved)}, best.values]
            found = bench.fit(placed, own, states=best.initial, solver=THOROUGH, like=layered)
            gained, best = found.cost < GAIN * best.cost, min(found, best, key=lambda f: f.cost)
            if not gained:
                break
    except InputError:
        return None
    return best


def _start_values(law: Any, local: Local, force: np.ndarray, found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Compute start values that differ in their thresholds.

    The thresholds are spread along the density of the weights; on an even grid over the range of z; and, if the
    diagnosed law has thresholds, about these. The weights fit the diagnosed law's force (M,); the density comes from
    such a fit on a fine grid.
    """
    n = law.parameters()["r"].size
    fine = local.half * np.union1d(np.linspace(0.0, 0.95, FINE_THRESHOLDS), np.geomspace(0.003, 0.95, FINE_THRESHOLDS))
    bends: list[dict[str, Any]] = [{}]
    if "a_2" in law.units:
        bends = [{"a_2": bend / local.reach, "a_3": 0.0} for bend in BENDS]
        bends += [{name: found[name] for name in ("a_2", "a_3")}] if "a_2" in found else []
    solved = [_fit_weights(law, local, force, {"r": fine, **bend}) for bend in bends]
    (_, dense), bend = min(zip(solved, bends, strict=True), key=lambda pair: pair[0][0])
    grids = [local.half * (np.arange(n) + 0.5) / n]
    own = np.ravel(found.get("r", ()))
    if 0 < len(own) <= n:
        copies = -(-n // len(own))
        about = np.outer(1 + SPLIT * (np.arange(copies) - (copies - 1) / 2), own)
        grids.append(np.clip(np.ravel(about)[:n], 0.0, 0.95 * local.half))
    along_density = {**dense, **_spread_thresholds(fine, dense["w"], local.half, n)}
    return [along_density, *(_fit_weights(law, local, force, {"r": grid, **bend})[1] for grid in grids)]


def _fit_weights(law: Any, local: Local, force: np.ndarray, shape: dict[str, Any]) -> tuple[float, dict[str, Any]]:
    """Fit weights at given thresholds (and bend) to a force (M,); return the squared error and all values.

    A constant is free, since memory may begin anywhere. Weights stay above zero, where their thresholds have no slope.
    """
    from scipy.optimize import lsq_linear

    r, z = np.asarray(shape["r"]), local.z
    bent = z + float(shape.get("a_2", 0.0)) * z**2 + float(shape.get("a_3", 0.0)) * z**3
    memory, columns = np.zeros(len(r)), np.empty((len(z), len(r)))
    begins = set(np.cumsum([0, *local.lengths]).tolist())
    for k, value in enumerate(bent):
        memory = play(value, np.full(len(r), value) if k in begins else memory, r)
        columns[k] = memory
    columns = law.sign * (bent[:, None] - columns if law.operator == "stop" else columns)
    linear = {name: z**power for name, power in (("k_0", 1), ("b_2", 2)) if name in law.units}
    a = np.column_stack([columns, *linear.values()])
    a = a - a.mean(axis=0)
    size = np.linalg.norm(a, axis=0)
    size = np.where(size > IDLE_SHARE * np.max(size), size, np.inf)  # an idle operator gets no weight
    low = np.append(np.zeros(len(r)), np.full(len(linear), -np.inf))
    found = lsq_linear(a / size, force - force.mean(), (low, np.inf))
    w = found.x[: len(r)] / size[: len(r)]
    values = dict(zip(linear, (found.x / size)[len(r) :], strict=True))
    return float(found.cost), {**shape, **values, "w": np.maximum(w, LEAST_START_WEIGHT * np.mean(w))}


def _spread_thresholds(r: np.ndarray, w: np.ndarray, half: float, n: int) -> dict[str, np.ndarray]:
    """Spread n thresholds along the smoothed density of weights over thresholds; see `identify.regrid`."""
    order = np.argsort(r)
    mass = np.cumsum(w[order])
    reach = min(EXTENT * float(r[order][np.searchsorted(mass, 0.99 * mass[-1])]), 0.95 * half)
    r, w = regrid(r, w, reach, extent=1.0, count=n)
    return {"r": r, "w": np.maximum(w, LEAST_START_WEIGHT * np.mean(w))}


def _initial_state(after: Fitted, state: np.ndarray, number: int, law: Law, z: float, h: float) -> np.ndarray:
    """Return an initial state in which the layer's memory is z, so that no operator is saturated."""
    own = len(after.simulator.states)
    elements = on_grid(after.simulator, h).elements  # the memory of a delay depends on the step
    memories = [int(e.law.memory) if hasattr(e.law, "step") else 0 for e in elements]
    sizes = [*(int(getattr(e.law, "order", 0)) for e in elements), *memories]
    parts = np.split(np.asarray(state, dtype=float)[own:], np.cumsum(sizes)[:-1])
    parts[number] = np.zeros(0)
    parts[len(elements) + number] = np.full(law.memory, z)
    return np.concatenate([state[:own], *parts])


def _build_refinement(
    diagnosis: Any, bench: Workbench, kind: str, fitted: Fitted, number: int, expected: Mapping[str, ExpectedError]
) -> Refinement:
    """Compare a fitted layer with the diagnosed law, and keep the one that is expected to predict better."""
    element, after = fitted.simulator.elements[number], diagnosis.evidence.after
    values, port = element.own(fitted.values), element.port
    refined = diagnosis.with_fit(fitted)
    errors: dict[str, dict[str, float] | None] = {
        "train": {DIAGNOSED: bench.nrmse(after), "refined": bench.nrmse(fitted)},
        "test": None,
    }
    if diagnosis.test:
        errors["test"] = {DIAGNOSED: diagnosis.nrmse(diagnosis.test), "refined": refined.nrmse(diagnosis.test)}
    loops = [signals_along(bench, one, number) for one in (fitted, after)]
    signal = in_series(port)
    z = np.linspace(0.0, float(np.ptp(loops[0][0])) / 2, CURVE_POINTS)
    order = np.argsort(values["r"])
    improves = expected[kind].mean_square < expected[DIAGNOSED].mean_square
    old = after.simulator.elements[number].law
    return Refinement(
        port=port,
        kind=kind,
        improves=improves,
        thresholds=np.asarray(values["r"])[order],
        weights=np.asarray(values["w"])[order],
        linear=float(values.get("k_0", 0.0)),
        loading_curve=(z, _loading_curve(element.law, values, z) + signal * z),
        expected=dict(expected),
        errors=errors,
        layer=refined.corrected,
        _chosen=refined if improves else diagnosis,
        _law=display_name(old.id, old.form),
        _loops=tuple(part for z_i, _, w in loops for part in (z_i, w + signal * z_i)),
    )


def _loading_curve(law: Law, values: Mapping[str, Any], z: np.ndarray) -> np.ndarray:
    """Compute the law's response (G,) to z (G,) that grows from zero with empty memory."""
    local = Local(z, np.gradient(z), 1.0, (len(z),), from_zero=(True,))
    shape = {name: values[name] for name in law.units if name not in law.strength}
    strengths = np.concatenate([np.ravel(values[name]) for name in law.strength])
    return np.asarray(unit_forces(type(law)(), local, [shape])[:, 0] @ strengths)
