"""Which parameters of a simulator are identifiable from recordings, and which are dead, flat or traded off.

With J the outputs' changes by the parameters in units of the noise, initial states projected off, and D the room that
the bounds leave each parameter, the singular values s of J D say how well each direction is determined. Where s < 1
the standard error is larger than the room: the recordings add nothing to the bounds. Parameters that hold such a
direction among themselves are traded off. A direction with whole exponents, in logarithms of the parameters, leaves
only a ratio or a product identifiable (Bellman & Åström 1970; Brun, Reichert & Künsch 2001).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from .._base import in_words
from ..models import ParameterSet
from ..simulators import Named, Simulator
from .linearise import Probe, Run, propagate
from .remainder import block_diagonal, lengths, moved, orthonormal
from .workbench import Fitted, Workbench

LARGEST_GROUP = 4  # parameters of a group that is looked for; above it all combinations are too many
EXPONENTS = (1, 2, 3)  # denominators of exponents; physical laws have small ones
STEP = 1.1  # factor of a trial step that tells a product from a sum; they differ by a twentieth of it
SAME = 0.01  # share of a parameter's own change that a step along a ratio or product leaves; of another curve, more


@dataclass(frozen=True)
class ParameterRow:
    """A free parameter as refitted, and whether it is identifiable.

    Attributes
    ----------
    std : float or None
        Standard error due to the noise alone; None where the parameter is not identifiable.
    status : str
        "identifiable", "dead" (no output reacts), "flat" (the standard error is as large as the room of the bounds),
        "tied" (traded off with others), "start" (traded off with the unknown initial state), or "port" (only the
        ports read it, so it acts with a law alone).
    at_bound : bool
        Whether the refit ended at one of its bounds.
    """

    name: str
    value: float
    unit: str
    std: float | None
    status: str
    at_bound: bool = False


@dataclass(frozen=True)
class Tie:
    """Parameters that are traded off, and the only combinations that are identifiable, such as ("k/m",)."""

    names: tuple[str, ...]
    only_as: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The tie in words."""
        names = in_words(self.names)
        if not self.only_as:
            return f"{names} can be identified only together, not separately."
        if len(self.only_as) == 1 and len(self.names) == 2:
            word = "product" if "*" in self.only_as[0] else "sum" if "+" in self.only_as[0] else ""
            if word and "^" not in self.only_as[0]:
                return f"{names} can be identified only as their {word} ({self.only_as[0]})."
        return f"{names} can be identified only as {in_words(self.only_as)}."


@dataclass(frozen=True, eq=False)
class Symbols:
    """Symbols that a simulator's equations are evaluated with: vectors, and by name."""

    states: ca.SX
    inputs: ca.SX
    vector: ca.SX
    x: Named
    u: Named
    p: Named
    t: ca.SX

    @classmethod
    def of(cls, simulator: Simulator) -> Symbols:
        """Make new symbols."""
        own = simulator.parameter_set
        xs, us, vector = (
            ca.SX.sym(n, size)
            for n, size in (("x", len(simulator.states)), ("u", len(simulator.inputs)), ("p", own.size))
        )
        x = Named("state", {name: xs[i] for i, name in enumerate(simulator.states)})
        u = Named("input", {name: us[i] for i, name in enumerate(simulator.inputs)})
        return cls(xs, us, vector, x, u, Named("parameter", own.symbols(vector)), ca.SX.sym("t"))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How parameters and unknown initial states move the outputs along whole recordings, in units of the noise.

    Attributes
    ----------
    names, units : tuple of str
        Free entries of the simulator's parameters.
    values, room : array, shape (n,)
        Fitted values, and the standard deviation of a value of which only the bounds are known.
    at_bound : array, shape (n,), bool
        Whether the fitted values are at a bound.
    raw : array, shape (R, n)
        Changes of all outputs by a unit change of each parameter.
    start : array, shape (R, k)
        Orthonormal changes by unknown initial states.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    room: np.ndarray
    at_bound: np.ndarray
    raw: np.ndarray
    start: np.ndarray

    @classmethod
    def of(
        cls, bench: Workbench, probe: Probe, runs: Sequence[Run], more: Callable[[Run], Run] | None = None
    ) -> Sensitivity:
        """Along the runs of a bench whose scale is the noise; `more` gives each run other outputs."""
        own, skips = ParameterSet(dict(bench.simulator.parameters)), [r.skip for r in bench.recordings]
        places = np.flatnonzero(own.free)
        if more is None:
            blocks = [moved(bench, r, skip=skip) for r, skip in zip(runs, skips, strict=True)]
        else:
            found = [propagate(more(r))[skip:] for r, skip in zip(runs, skips, strict=True)]
            blocks = [v.reshape(-1, v.shape[2]) for v in found]
        whole = block_diagonal(blocks, runs[0].n_free)
        states = whole[:, len(places) :]
        kept = np.repeat([not r.from_zero and q.begins != "given" for r, q in zip(runs, bench.recordings, strict=True)],
                         states.shape[1] // len(runs))  # fmt: skip
        raw = whole[:, : len(places)]
        signal = np.concatenate([r.y[skip:] / bench.scale for r, skip in zip(bench.recordings, skips, strict=True)])
        felt = np.linalg.norm(signal - signal.mean(axis=0)) / np.where(lengths(raw) > 0, lengths(raw), 1.0)
        values, given, lower, upper = (v[places] for v in (probe.values, own.start, own.lower, own.upper))
        units = [p.unit for p in own.values() for _ in range(p.size)]
        return cls(
            tuple(own.labels[i] for i in places),
            tuple(units[i] for i in places),
            values,
            room(np.where(given != 0, np.abs(given), felt), lower, upper),
            (values <= lower) | (values >= upper),
            raw,
            orthonormal(states[:, kept]),
        )

    @property
    def scaled(self) -> np.ndarray:
        """Changes by as much as the bounds leave room for, initial states projected off."""
        columns = self.raw * self.room
        return np.asarray(columns - self.start @ (self.start.T @ columns))


def room(size: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Standard deviation of values of which the bounds alone are known: uniform, in logarithms if of one sign.

    Without bounds it is `size`: the given value, whose sign would be unknown then; of a value given as zero the change
    that moves the outputs as much as they have moved.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(np.log(upper / lower)) / np.sqrt(12) * size
    linear = (upper - lower) / np.sqrt(12)
    bounded = np.isfinite(linear) & (linear > 0)
    return np.where(bounded & (lower * upper > 0), ratio, np.where(bounded, linear, size))


def count_undetermined(scaled: np.ndarray) -> int:
    """Number of directions along which the standard error is larger than the room."""
    return scaled.shape[1] - int(np.sum(np.linalg.svd(scaled, compute_uv=False) >= 1)) if scaled.shape[1] else 0


def assess_parameters(
    response: Sensitivity, bench: Workbench, fitted: Fitted
) -> tuple[tuple[ParameterRow, ...], tuple[Tie, ...]]:
    """Each free parameter, and the groups that are traded off."""
    names, n = response.names, len(response.names)
    if not n:
        return (), ()
    small = np.asarray(np.linalg.qr(response.scaled, mode="r"))  # the same singular values
    alone, before = lengths(small), lengths(response.raw * response.room)
    status = np.full(n, "identifiable", dtype=object)
    status[alone < 1] = "start"
    status[before < 1] = "flat"
    status[before == 0] = "dead"
    status[_port_parameters(bench.simulator)] = "port"
    rest = [i for i in range(n) if status[i] == "identifiable"]
    groups = _groups(small, rest)
    for i in {i for g in groups for i in g}:
        status[i] = "tied"
    _, s, v = np.linalg.svd(small[:, rest])
    weight = np.where(s >= 1, 1 / np.maximum(s, 1.0), 0.0)
    std = response.room[rest] * np.sqrt(np.sum((weight[:, None] * v[: len(s)]) ** 2, axis=0)) if rest else np.zeros(0)
    by_place = dict(zip(rest, std.tolist(), strict=True))
    rows = []
    for i, name in enumerate(names):
        own = by_place.get(i) if status[i] == "identifiable" else None
        value, at_bound = float(response.values[i]), bool(response.at_bound[i])
        rows.append(ParameterRow(name, value, response.units[i], own, str(status[i]), at_bound))
    ties = tuple(Tie(tuple(names[i] for i in g), _only_as(response, small, g, bench, fitted)) for g in groups)
    return tuple(rows), ties


def _port_parameters(simulator: Simulator) -> np.ndarray:
    """Which free entries of the parameters only the ports read, shape (n,), bool."""
    s = Symbols.of(simulator)
    equations = [simulator.derivatives(s.x, s.u, s.p, s.t), *simulator.measured(s.x, s.u, s.p, s.t).values()]
    ports = [e for port in simulator.ports for e in simulator.into(port, s.x, s.u, s.p, s.t).values()]
    read = [
        np.array(ca.which_depends(ca.vertcat(*map(ca.SX, found)), s.vector), dtype=bool) if found else np.zeros(0, bool)
        for found in (equations, ports)
    ]
    only = ~read[0] & read[1] if ports else np.zeros(s.vector.numel(), bool)
    return np.asarray(only[simulator.parameter_set.free])


def _groups(small: np.ndarray, rest: list[int]) -> list[list[int]]:
    """Smallest sets of columns that hold an undetermined direction; those that share a parameter are one group."""
    found: list[set[int]] = []
    total = count_undetermined(small[:, rest])
    share = _share(small, rest)
    involved = [i for i, part in zip(rest, share, strict=True) if part > SAME]

    def left() -> int:  # undetermined directions that no group holds
        return total - sum(count_undetermined(small[:, sorted(g)]) for g in found)

    for size in range(2, min(LARGEST_GROUP, len(involved)) + 1):
        if left() <= 0:
            break
        for chosen in combinations(involved, size):
            new = set(chosen)
            if any(new <= g for g in found) or count_undetermined(small[:, list(chosen)]) == 0:
                continue
            if any(count_undetermined(small[:, list(part)]) for part in combinations(chosen, size - 1)):
                continue  # a smaller set holds it
            for g in [g for g in found if g & new]:
                found.remove(g)
                new |= g
            found.append(new)
            if left() <= 0:
                break
    if left() > 0:  # spread over many
        wide = [i for i in involved if not any(i in g for g in found)]
        for i in sorted(wide, key=lambda i: share[rest.index(i)]):  # the least involved first
            others = [j for j in wide if j != i]
            wide = others if count_undetermined(small[:, others]) == count_undetermined(small[:, wide]) else wide
        found += [set(wide)] if len(wide) > 1 else []
    return [sorted(g) for g in found]


def _share(small: np.ndarray, rest: list[int]) -> np.ndarray:
    """How much each parameter takes part in the undetermined directions, between 0 and 1."""
    _, s, v = np.linalg.svd(small[:, rest])
    s = np.append(s, np.zeros(len(v) - len(s)))
    return np.asarray(lengths(v[s < 1]))


def _only_as(
    response: Sensitivity, small: np.ndarray, group: list[int], bench: Workbench, fitted: Fitted
) -> tuple[str, ...]:
    """What is identifiable of a group: monomials or sums of small whole numbers, or nothing where it is neither."""
    names, values = [response.names[i] for i in group], response.values[group]
    found = []
    for unit, write in ((values, _monomial), (np.ones(len(group)), _sum)):
        if np.all(unit != 0) and (rows := _whole(small[:, group], response.room[group] / unit)) is not None:
            change = _finite_change(rows, write is _monomial, group, response, bench, fitted)
            found.append((change, tuple(write(names, row) for row in rows)))
    change, best = min(found, default=(np.inf, ()))
    return best if change < SAME else ()


def _whole(columns: np.ndarray, room: np.ndarray) -> np.ndarray | None:
    """Find rows of small whole numbers that are constant along a group's undetermined directions, or None.

    `columns` are those of J D, and `room` is D in the coordinates wanted, with their sign.
    """
    _, s, v = np.linalg.svd(columns)
    s = np.append(s, np.zeros(len(v) - len(s)))
    free = (v[s < 1] * room)[:, ::-1]  # the first named parameter comes last, as what is divided by
    count = columns.shape[1]
    rows = _reduced(np.linalg.svd(free)[2][len(free) :])
    for factor in EXPONENTS:
        whole = np.round(rows * factor)
        if np.any(np.abs(whole) > max(EXPONENTS)) or not np.all(np.any(whole, axis=1)):
            continue
        kept = np.linalg.svd(whole)[2][len(whole) :][:, ::-1]  # directions that leave these rows as they are
        test = kept / room
        test /= lengths(test.T)[:, None]
        if len(kept) == count - len(rows) and np.all(lengths((test @ columns.T).T) < 1):
            return np.asarray(whole[::-1, ::-1])
    return None


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Reduced row echelon form."""
    rows = rows.copy()
    at = 0
    for j in range(rows.shape[1]):
        if at == len(rows):
            break
        i = at + int(np.argmax(np.abs(rows[at:, j])))
        if abs(rows[i, j]) < 1e-6:  # of rows of length one
            continue
        rows[[at, i]] = rows[[i, at]]
        rows[at] /= rows[at, j]
        others = np.arange(len(rows)) != at
        rows[others] -= rows[others, j][:, None] * rows[at]
        at += 1
    return rows


def _monomial(names: Sequence[str], exponents: np.ndarray) -> str:
    """Write a product of powers, "k/m" or "gain*k_sensor"; its sign is chosen so that more is above the line."""
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


def _finite_change(
    rows: np.ndarray, logarithmic: bool, group: list[int], response: Sensitivity, bench: Workbench, fitted: Fitted
) -> float:
    """Change of the first recording's outputs by a step of a tenth along which the rows are constant.

    It is a share of the change by the first parameter alone, and zero where it is below the noise; unknown initial
    states follow both.
    """
    along = np.linalg.svd(rows)[2][len(rows)]
    along /= np.max(np.abs(along))
    places = np.flatnonzero(ParameterSet(dict(bench.simulator.parameters)).free)[group]
    value, alone = response.values[group], np.eye(len(group))[0]
    far = (STEP - 1) * np.min(np.abs(value))
    r, model = bench.recordings[0], fitted.model
    drive = model.drive(r)

    def outputs(way: np.ndarray) -> np.ndarray:
        vector = fitted.vector.copy()
        vector[places] = value * STEP**way if logarithmic else value + far * way
        y = fitted.engine.simulate(drive, vector, fitted.initial[0])[0]
        return np.asarray((y / bench.scale)[r.skip :].ravel())

    with np.errstate(all="ignore"):
        now = outputs(0 * along)
        changes = np.column_stack([outputs(along) - now, outputs(alone) - now])
    if not np.all(np.isfinite(changes)):
        return np.inf
    start = response.start[: len(changes)]
    if start.shape[1]:
        changes = changes - start @ np.linalg.lstsq(start, changes, rcond=None)[0]
    size = lengths(changes)
    return float(size[0] / size[1]) if size[0] > 1 else 0.0
