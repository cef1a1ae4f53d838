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
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from ..._base import InputError, multiple, percent
from ...data import Recording
from ...optimise import GaussNewton
from ..fits.evidence import formula_tolerance
from ..fits.floor import FEWEST, Floor, effective_size, noise_floor, pool
from ..fits.linearise import Probe, Run, linearise_runs
from ..fits.screen import block_diagonal, in_deviations, moved, orthonormal, project_off
from ..fits.workbench import QUICK, THOROUGH, Fitted, Workbench, near_balance, output_deviation, refit

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
MOST_ROUNDS = 8  # alternations of edit and refit at most
TEST_FAULT = "test fault"  # the finding that a channel of the test recordings is wrong
TEST_OFFSET = "test offset"  # the finding that test recordings lack an offset of the training recordings


@dataclass(frozen=True)
class Gate:
    """A finding about a channel; if it is a fault that can be corrected, also the edit that corrects it.

    Attributes
    ----------
    value : object
        Size or kind of the fault, as reported; the start value until the edit is settled.
    sentence : str
        The finding in words; `accept` adds the effect of the correction.
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

    def edit(self, r: Recording) -> Recording:
        """Return a recording corrected, or as it is if the correction does not change recordings."""
        return self.change(r) if self.change is not None else r

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with changed recordings; errors are in units of the outputs' new deviation."""
        recordings = edited(bench.recordings, [self])
        if recordings[0].dt != bench.dt:
            return bench.renewed(recordings)
        return replace(bench, recordings=recordings, scale=output_deviation(recordings))

    def apply_to_whole(self, whole: list[Recording], places: Sequence[tuple[int, int]]) -> list[Recording]:
        """Correct whole recordings whose stretches were checked; `places` are their (recording, first sample)."""
        return list(map(self.edit, whole)) if self.corrected else whole

    def kept(self, r: Recording) -> slice:
        """Return which samples of a recording are still scored after the correction."""
        return slice(r.skip, None)

    def count_samples(self, residuals: Sequence[np.ndarray]) -> float:
        """Count the samples that speak for the correction, from the residuals (M, n_y) that it leaves."""
        return max(effective_size(residuals), FEWEST)

    def begin(self, previous: Fitted) -> Sequence[np.ndarray]:
        """Return guesses of the initial states of the corrected recordings."""
        return previous.begin

    def relocate(self, now: Checked, after: Checked) -> Self | None:
        """Return the fault at its best value to first order at the corrected refit, or None if there is none."""
        return self


def edited(recordings: Sequence[Recording], gates: Iterable[Gate]) -> tuple[Recording, ...]:
    """Return recordings with the corrections of gates, one after the other."""
    for gate in gates:
        recordings = [gate.edit(r) for r in recordings]
    return tuple(recordings)


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
    def residuals(self) -> list[np.ndarray]:
        """The scored residual of each recording, (M, n_y)."""
        return self.bench.scored(self.fitted.residual)

    @property
    def floor(self) -> Floor:
        """The noise, measured or estimated from the refit."""
        return noise_floor(self.bench.recordings, self.residuals)

    @property
    def noise2(self) -> float:
        """Mean square of the noise in units of the outputs' variance."""
        return self.bench.pool(self.floor.squares(self.bench.scale))

    def weighted(self, floor: Floor | None = None) -> Checked:
        """Weigh the outputs by their noise, by default the present one, and refit if that changes their weights.

        The share of the mismatch that formulas may leave counts as noise.
        """
        bench, squares = self.bench, self.fitted.squares
        noise2 = (floor or self.floor).squares(bench.scale)
        bench = replace(bench, noise2=noise2 + formula_tolerance(squares, noise2))
        cost, balance = pool(squares, bench.noise2)
        fitted = replace(self.fitted, cost=cost, balance=balance)
        if not near_balance(balance, self.fitted.balance):
            again = refit(bench, [fitted.values], states=fitted.initial, solver=THOROUGH, like=fitted)
            fitted = again or fitted
        return replace(self, bench=bench, fitted=fitted)

    def then(self, bench: Workbench, fitted: Fitted, *gates: Gate) -> Checked:
        """Return the next state: another bench and refit, with further findings added."""
        return Checked(bench, fitted, (*self.gates, *gates))

    def with_deadline(self, deadline: float) -> Checked:
        """Return the same state with another time at which its fits end."""
        return replace(self, bench=replace(self.bench, deadline=deadline))

    def adds_to(self, before: Checked) -> bool:
        """Tell whether it has more findings than a state before."""
        return len(self.gates) > len(before.gates)


# the one rule


def evidence_gain(
    before: float, after: float, residuals: Sequence[np.ndarray], parameters: int = 1, samples: float | None = None
) -> float:
    """Compute the gain in log evidence, nats, of a fit with more parameters, by BIC on its effective samples.

    `residuals` (M, n_y) are its scored samples in each recording; `samples` is their effective number, if it is known.
    """
    n = max(effective_size(residuals), FEWEST) if samples is None else samples
    return float(0.5 * n * np.log(before / max(after, 1e-300)) - 0.5 * parameters * np.log(n))


def error_ratio(one: float, other: float) -> float:
    """Compute the ratio of the larger to the smaller of two rms errors from their mean squares."""
    return float(np.sqrt(max(one, other) / max(min(one, other), 1e-300)))


def follows_better(one: float, other: float, residuals: Sequence[np.ndarray]) -> bool:
    """Tell whether an edit that leaves the mean square `one` is clearly better than another of as many parameters."""
    return one < CLEARLY_BETTER * other and evidence_gain(other, one, residuals, 0) > LEAST_GAIN


def value_with_unit(value: float | Sequence[float] | np.ndarray, unit: str, digits: int = 3) -> str:
    """Write a value, or several, with their unit, if that is known."""
    return f"{', '.join(f'{v:.{digits}g}' for v in np.ravel(value))} {unit}".rstrip()


def describe_fall(before: float, after: float) -> str:
    """Describe by how much an edit reduces the NRMSE."""
    if not np.isfinite(before):
        return f"the refitted error is {percent(after)} of the outputs' deviation, where the simulation diverged before"
    return f"the refitted error falls from {percent(before)} to {percent(after)} of the outputs' deviation"


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

    If the recordings as given are followed as well from the corrected refit's values, the correction only took the
    refit out of a local minimum: that refit is returned, without a finding.
    """
    if after is None or not satisfies_rule(_cost_where_kept(now, after, fault), after, fault):
        return now
    back = refit(now.bench, [after.fitted.values], states=now.fitted.initial, like=now.fitted)
    if back is not None:
        moved = now.then(now.bench, back)
        if not satisfies_rule(_cost_where_kept(moved, after, fault), after, fault):
            return moved
    errors = now.bench.nrmse(now.fitted), after.bench.nrmse(after.fitted)
    sentence = f"{fault.sentence}; {fault.remedy} {describe_fall(*errors)}"
    noises = (after.cost / max(now.noise2, 1e-300)) ** 0.5
    if noises > NEAR_NOISE_RATIO:
        sentence += f", still {multiple(noises)} times the noise: more is wrong"
    told = replace(fault, sentence=f"{sentence}.", fault=True, left=after.cost / _cost_where_kept(now, after, fault))
    return now.then(after.bench, after.fitted, told)


def satisfies_rule(before: float, after: Checked, fault: Gate) -> bool:
    """Tell whether the rule accepts a fault whose correction reduces the mean square error `before`."""
    samples = fault.count_samples(after.residuals)
    gained = evidence_gain(before, after.cost, after.residuals, fault.parameters, samples)
    return gained > LEAST_GAIN and after.cost < min(fault.most_left * before, USELESS_FIT)


def _cost_where_kept(now: Checked, after: Checked, fault: Gate) -> float:
    """Compute the mean square error before a correction on the samples that it keeps."""
    kept = list(map(fault.kept, now.bench.recordings))
    if all(where == slice(r.skip, None) for where, r in zip(kept, now.bench.recordings, strict=True)):
        return now.cost
    errors = [e[where] / after.bench.scale for e, where in zip(now.fitted.residual, kept, strict=True)]
    return now.bench.pool(np.mean(np.concatenate(errors) ** 2, axis=0))


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """A fitted simulator linearised along its runs, to screen edits to first order; made by `of`."""

    bench: Workbench
    fitted: Fitted

    @classmethod
    def of(cls, bench: Workbench, fitted: Fitted) -> FirstOrder:
        """Linearise a fit, with the outputs in balance."""
        return cls(bench.balanced(fitted), fitted)

    @cached_property
    def error(self) -> np.ndarray:
        """The stacked error in units of the outputs' deviation, (R,)."""
        bench = self.bench
        residual = bench.rerun(self.fitted).residual
        return np.asarray((np.concatenate(bench.scored(residual)) / bench.scale).ravel())

    @cached_property
    def base(self) -> np.ndarray:
        """Orthonormal directions of the stacked outputs that parameters and initial states can follow, (R, n)."""
        f, basis = self.fitted, self.fitted.model.initial_basis
        free = f.model.parameters.free
        n_free = int(free.sum())
        seed = np.hstack([np.zeros((len(basis), n_free)), basis])
        columns, blocks = np.where(free, np.cumsum(free) - 1, -1), list[np.ndarray]()
        for r, state in zip(self.bench.recordings, f.initial, strict=True):
            with np.errstate(over="ignore", invalid="ignore"):
                changes = f.engine.sensitivity(f.model.drive(r), f.vector, state, seed, columns)[1]
            blocks.append(in_deviations(self.bench, changes[r.skip :]))
        return orthonormal(block_diagonal(blocks, n_free))

    @cached_property
    def linearised(self) -> tuple[Probe, list[Run]]:
        """The open ports and the linearised runs, which responses to forces need."""
        return linearise_runs(self.bench, self.fitted)

    @property
    def runs(self) -> list[Run]:
        """The linearised runs."""
        return self.linearised[1]

    def project_off(self, columns: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
        """Project off what parameters and initial states can follow, in all rows or in the known ones (R,) alone."""
        if known is None or np.all(known):
            return project_off(columns, self.base)
        columns, base, unknown = columns[known], self.base[known], self.base[~known]
        products = np.eye(base.shape[1]) - unknown.T @ unknown  # of the base with itself; mostly few rows are unknown
        inverse = np.linalg.pinv(products, rcond=1e-10, hermitian=True)
        return np.asarray(columns - base @ (inverse @ (base.T @ columns)))

    def response(self, ports: Sequence[str], forces: Sequence[np.ndarray]) -> np.ndarray:
        """Compute the stacked outputs' changes (R, n) by forces at ports, (M, n_k) a recording; see `propagate`."""
        out = []
        for run, r, force in zip(self.runs, self.bench.recordings, forces, strict=True):
            at = [(self.linearised[0].ports.index(name), force) for name in ports]
            out.append(moved(self.bench, run, at, r.skip)[:, -len(ports) * force.shape[1] :])
        return np.concatenate(out)


def robust_deviation(v: np.ndarray) -> np.ndarray:
    """Estimate the deviation of zero-mean columns from the upper quartile of their sizes, which ignores outliers."""
    return np.asarray(np.quantile(np.abs(v), 0.75, axis=0) / 1.1503)


def open_start(r: Recording) -> Recording:
    """Estimate the initial state of a periodic recording, because it is not on its steady cycle."""
    return r.with_(initial="estimate", period=None) if r.begins == "periodic" else r
