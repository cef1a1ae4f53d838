"""Compute which parameters recordings can identify.

Everything follows from the simulator linearised along its refitted run, in units of the noise. Let J be the outputs'
changes by the parameters, with initial states projected off, and D the range that the bounds allow each parameter. The
singular values s of J D tell how well each direction is determined. If s < 1, the standard error exceeds the range: the
recordings add nothing to the bounds. Parameters that share such a direction are traded off. If the direction has
integer exponents in the logarithms of the parameters, only a ratio or a product is identifiable (Bellman & Åström 1970;
Brun, Reichert & Künsch 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from .._base import in_words
from ..models import is_at_bound
from ..simulators import Simulator, stack
from .fits.evidence import prior_width
from .fits.linearise import Run, sample_run
from .fits.screen import lengths, orthonormal, own_changes, project_off
from .fits.workbench import Fitted, Workbench

LARGEST_EXPONENT = 3  # in numerators and denominators; physical laws have small exponents
TRIAL_FACTOR = 1.1  # factor of a trial step that distinguishes a product from a sum; they differ by a twentieth of it
ZERO_SHARE = 0.01  # share of a change that counts as zero: steps along any other curve leave more


@dataclass(frozen=True)
class ParameterRow:
    """A free parameter as refitted, and whether it is identifiable."""

    name: str
    value: float
    unit: str
    std: float | None  # standard error due to the noise alone; None where the parameter is not identifiable
    # "identifiable", "dead" (no output reacts), "flat" (the standard error is as large as the range of the bounds),
    # "tied" (traded off with others), "start" (traded off with the unknown initial state), or "port" (only the ports
    # read it, so that it acts only through a law)
    status: str
    at_bound: bool = False  # whether the refit ended at one of its bounds


@dataclass(frozen=True)
class Tie:
    """Parameters that trade off, and their only identifiable combinations, such as ("k/m",)."""

    names: tuple[str, ...]
    only_as: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The tie in words."""
        names = in_words(self.names)
        if len(self.names) == 1:
            return f"{names} cannot be identified from these recordings."
        if not self.only_as:
            return f"{names} can be identified only together, not separately."
        if len(self.only_as) == 1 and len(self.names) == 2:
            text = self.only_as[0]
            word = "sum" if " + " in text else "product" if "*" in text and " - " not in text else ""
            if word and "^" not in text:
                return f"{names} can be identified only as their {word} ({text})."
        return f"{names} can be identified only as {in_words(self.only_as)}."


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivity of the outputs, along whole recordings, to free parameters and unknown initial states."""

    bench: Workbench  # its scale is the noise
    fitted: Fitted  # the refitted simulator
    span: np.ndarray  # (n,), prior standard deviation of each value, from its bounds alone
    raw: np.ndarray  # (R, n), changes of all outputs, in units of the noise, by a unit change of each parameter
    start: np.ndarray  # (R, k), the same by each unknown initial state

    @classmethod
    def of(cls, bench: Workbench, fitted: Fitted, runs: Sequence[Run]) -> Sensitivity:
        """Compute the sensitivity along the fitted runs of a bench whose scale is the noise."""
        own = bench.simulator.parameter_set
        given, lower, upper = (v[own.free] for v in (own.start, own.lower, own.upper))
        raw, start = _changes(bench, runs)
        signal = np.concatenate([r.y[r.skip :] for r in bench.recordings]) / bench.scale
        # without bounds the range is the given value, or for zero the change that moves the outputs by their deviation
        unit = np.linalg.norm(signal - signal.mean(axis=0)) / np.where(lengths(raw) > 0, lengths(raw), 1.0)
        span = prior_width(np.where(given != 0, np.abs(given), unit), lower, upper)
        return cls(bench, fitted, span, raw, start)

    @cached_property
    def places(self) -> np.ndarray:
        """Places of the free entries in the parameter vector, shape (n,)."""
        return np.flatnonzero(self.bench.simulator.parameter_set.free)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the free entries."""
        return tuple(self.bench.simulator.parameter_set.labels[i] for i in self.places)

    @property
    def values(self) -> np.ndarray:
        """Refitted values of the free entries, shape (n,)."""
        return self.fitted.vector[self.places]

    @cached_property
    def base(self) -> np.ndarray:
        """Orthonormal basis of the changes by unknown initial states, shape (R, k)."""
        return orthonormal(self.start)

    @cached_property
    def scaled(self) -> np.ndarray:
        """Triangular factor (n, n) of J D, with the same singular values."""
        return np.asarray(np.linalg.qr(project_off(self.raw * self.span, self.base), mode="r"))

    @property
    def reach(self) -> np.ndarray:
        """Change of the outputs over each parameter's range, in standard deviations of the noise, shape (n,)."""
        return lengths(self.raw * self.span)


def _changes(bench: Workbench, runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray]:
    known = [r.from_zero or q.begins == "given" for r, q in zip(runs, bench.recordings, strict=True)]
    return own_changes(bench, runs, [r.skip for r in bench.recordings], known)


def _undetermined(scaled: np.ndarray) -> np.ndarray:
    """Find the orthonormal directions (k, n) along which the standard error exceeds the range."""
    _, s, v = np.linalg.svd(scaled)
    return np.asarray(v[np.append(s, np.zeros(len(v) - len(s))) < 1])


def assess_parameters(response: Sensitivity) -> tuple[tuple[ParameterRow, ...], tuple[Tie, ...]]:
    """Assess each free parameter, and find the groups that are traded off."""
    own, scaled = response.bench.simulator.parameter_set, response.scaled
    status = np.full(len(response.names), "identifiable", dtype=object)
    status[lengths(scaled) < 1] = "start"
    status[response.reach < 1] = "flat"
    status[response.reach == 0] = "dead"
    status[_read_by_ports_alone(response.bench.simulator)] = "port"
    rest = np.flatnonzero(status == "identifiable")
    groups = [rest[members] for members in _find_ties(scaled[:, rest])]
    for group in groups:
        status[group] = "tied"
    _, s, v = np.linalg.svd(scaled[:, rest])
    errors = lengths((v[: len(s)] / np.maximum(s, 1.0)[:, None])[s >= 1])  # standard errors in units of the range
    std: list[float | None] = [None] * len(status)
    for i, error in zip(rest, (response.span[rest] * errors).tolist(), strict=True):
        std[i] = error if status[i] == "identifiable" else None
    units = np.repeat([p.unit for p in own.values()], [p.size for p in own.values()])[own.free]
    at_bound = is_at_bound(response.values, own.lower[own.free], own.upper[own.free]).tolist()
    columns = (response.names, response.values.tolist(), units.tolist(), std, status, at_bound)
    rows = tuple(ParameterRow(*row) for row in zip(*columns, strict=True))
    return rows, tuple(
        Tie(tuple(response.names[i] for i in group), _find_combinations(response, group)) for group in groups
    )


def _read_by_ports_alone(simulator: Simulator) -> np.ndarray:
    """Mark the free entries of parameters that ports read and no equation does, shape (n,), bool."""
    symbols = simulator.symbols()
    parameters = stack(symbols[2])
    equations = ca.vertcat(simulator.derivatives(*symbols), *simulator.measured(*symbols).values())
    factors = ca.vertcat(ca.SX(0, 1), *(f for port in simulator.ports for f in simulator.into(port, *symbols).values()))
    own, ports = (np.array(ca.which_depends(e, parameters), dtype=bool) for e in (equations, factors))
    return np.asarray((ports & ~own)[simulator.parameter_set.free])


def _find_ties(scaled: np.ndarray) -> list[list[int]]:
    """Find the groups of columns that trade off.

    Columns that the undetermined directions do not need are dropped, smallest components first.
    The remaining columns are one group if a direction links them.
    """
    from scipy.sparse.csgraph import connected_components

    free = _undetermined(scaled)
    members = list(range(scaled.shape[1])) if len(free) else []
    for i in np.argsort(lengths(free)):
        others = [j for j in members if j != i]
        if len(_undetermined(scaled[:, others])) == len(free):
            members = others
    free = _undetermined(scaled[:, members])
    count, group = connected_components(np.abs(free.T @ free) > ZERO_SHARE, directed=False)
    return [[j for j, own in zip(members, group, strict=True) if own == k] for k in range(count)]


def _find_combinations(response: Sensitivity, group: np.ndarray) -> tuple[str, ...]:
    """Write the identifiable combinations of a group: monomials or sums with small integers, if there are any."""
    names, values = [response.names[i] for i in group], response.values[group]
    found = []
    for unit, write in ((values, _monomial), (np.ones(len(group)), _sum)):
        if (
            np.all(unit != 0)
            and (rows := _integer_rows(response.scaled[:, group], response.span[group] / unit)) is not None
        ):
            change = _finite_change(response, group, rows, write is _monomial)
            found.append((change, tuple(write(names, row) for row in rows)))
    change, best = min(found, default=(np.inf, ()))
    return best if change < ZERO_SHARE else ()


def _integer_rows(columns: np.ndarray, span: np.ndarray) -> np.ndarray | None:
    """Find rows of small integers that are constant along a group's undetermined directions, or None.

    `columns` are columns of J D; `span` is D in the wanted coordinates, with sign.
    """
    free = _undetermined(columns) * span
    if not len(free):  # undetermined only together with parameters outside the group
        return None
    rows = _reduce_rows(_complement(free))
    for factor in range(1, LARGEST_EXPONENT + 1):
        whole = np.round(rows * factor)
        if np.any(np.abs(whole) > LARGEST_EXPONENT) or not np.all(np.any(whole, axis=1)):
            continue
        test = _complement(whole) / span  # directions that leave these rows constant
        test /= lengths(test.T)[:, None]
        if len(test) == len(free) and np.all(lengths(columns @ test.T) < 1):
            return np.asarray(whole)
    return None


def _complement(rows: np.ndarray) -> np.ndarray:
    """Find the orthonormal directions that are orthogonal to independent rows."""
    return np.asarray(np.linalg.svd(rows)[2][len(rows) :])


def _reduce_rows(rows: np.ndarray) -> np.ndarray:
    """Combine orthonormal rows so that the last independent columns hold the identity."""
    pivots: list[int] = []
    for j in reversed(range(rows.shape[1])):
        if np.linalg.matrix_rank(rows[:, [j, *pivots]], tol=1e-6) > len(pivots):
            pivots = [j, *pivots]
    return np.asarray(np.linalg.lstsq(rows[:, pivots], rows)[0])


def _monomial(names: Sequence[str], exponents: np.ndarray) -> str:
    """Write a product of powers, "k/m" or "gain*k_sensor"; its sign is chosen to put more factors in the numerator."""
    total = np.sum(exponents) or exponents[np.flatnonzero(exponents)[-1]]
    e = exponents if total > 0 else -exponents

    def power(name: str, k: float) -> str:
        return name if abs(k) == 1 else f"{name}^{abs(int(k))}"

    above = [power(n, k) for n, k in zip(names, e, strict=True) if k > 0]
    below = [power(n, k) for n, k in zip(names, e, strict=True) if k < 0]
    under = below[0] if len(below) == 1 else f"({'*'.join(below)})"
    return "*".join(above) + (f"/{under}" if below else "")


def _sum(names: Sequence[str], factors: np.ndarray) -> str:
    """Write a sum, "k1 + k2" or "a - 2*b"."""
    factors = factors if factors[np.flatnonzero(factors)[0]] > 0 else -factors
    text = ""
    for name, k in zip(names, factors, strict=True):
        if k:
            term = name if abs(k) == 1 else f"{abs(int(k))}*{name}"
            text += f" {'+' if k > 0 else '-'} {term}" if text else term
    return text


def _finite_change(response: Sensitivity, group: np.ndarray, rows: np.ndarray, logarithmic: bool) -> float:
    """Compute the change of the outputs by a step of a tenth along which the rows are constant.

    The result is relative to the change by the first parameter alone, and zero if it is below the noise. Both changes
    exclude the part that unknown initial states can follow.
    """
    bench, fitted, value = response.bench, response.fitted, response.values[group]
    direction, alone = _complement(rows)[0], np.eye(len(group))[0]
    step = (TRIAL_FACTOR - 1) * np.min(np.abs(value))
    sizes = []
    for along in (direction / np.max(np.abs(direction)), alone):
        vector = fitted.vector.copy()
        vector[response.places[group]] = value * TRIAL_FACTOR**along if logarithmic else value + step * along
        values = fitted.model.parameters.unpack(vector)
        there = bench.rerun(fitted, values)
        if not np.isfinite(there.cost):
            return np.inf
        pairs = zip(there.residual, fitted.residual, bench.recordings, strict=True)
        change = np.concatenate([((new - old) / bench.scale)[r.skip :].ravel() for new, old, r in pairs])
        sizes.append(float(np.linalg.norm(project_off(change, response.base))))
    return sizes[0] / sizes[1] if sizes[0] > 1 else 0.0


def helpful_sensors(response: Sensitivity, runs: Sequence[Run]) -> tuple[str, ...]:
    """Find the states with which a further sensor, as quiet as the present ones, determines more; best first."""
    bench = response.bench
    signal = np.std(np.concatenate([r.y for r in bench.recordings]), axis=0)
    noise = np.mean(bench.scale / signal) * np.std(sample_run(bench, response.fitted)[0], axis=0)
    count, found = len(_undetermined(response.scaled)), list[tuple[int, str]]()
    for j in np.flatnonzero(noise > 0):
        row = np.eye(runs[0].a.shape[1])[j]
        sensed = [replace(r, c=np.zeros_like(r.c[:, :1]) + row, d=np.zeros_like(r.d[:, :1])) for r in runs]
        raw, start = _changes(replace(bench, scale=noise[[j]]), sensed)
        more = replace(response, raw=np.vstack([response.raw, raw]), start=np.vstack([response.start, start]))
        left = len(_undetermined(more.scaled))
        found += [(left, bench.simulator.states[j])] if left < count else []
    return tuple(name for _, name in sorted(found))
