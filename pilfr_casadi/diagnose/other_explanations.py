"""Explanations other than a law at a declared port: a pinned parameter, an undeclared port, a machine that changed.

- A missing law may be equivalent to other values of parameters, as a spring beside a spring. A search finds it only if
  these values are fixed, or if their bounds exclude the new ones; then the pinned values are reported. If the bounds
  are in another unit, no law helps; values powers of ten away are tried.
- A mismatch that no declared port explains may have a sure name in the equation of a state.
- Laws of a single physical domain are not tried at a port whose domain is unknown; a note says so.
- One set of values for all recordings is compared with one set for each recording, or with one for the first halves and
  one for the second. If separate sets follow far better, the differing values are reported; the engineer has to find
  the cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from .._base import InputError, in_words, listed, percent
from ..data import Recording
from ..laws import display_name
from ..simulators import EQUATION, UNKNOWN, Placed, in_series, name_at, split_port
from .faults.gates import (
    CERTAIN_ERRORS,
    CURED_SHARE,
    EQUAL_RATIO,
    LEAST_GAIN,
    USELESS_FIT,
    Gate,
    describe_fall,
    evidence_gain,
    open_start,
    value_with_unit,
)
from .fits.evidence import AT_NOISE_RATIO, BETTER_RATIO, CONTENDING_NATS, FAR_RATIO, NEAR_RATIO, SURE, standard_errors
from .fits.linearise import simulate_states
from .fits.workbench import FEW, THOROUGH, Fitted, Workbench, refit
from .posterior import Posterior, posterior
from .search.moves import Search
from .search.trials import Trial

# factors on a parameter's start value that are tried if the refit says nothing
DECADES = (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3)


@dataclass(frozen=True, eq=False)
class PinnedParameters:
    """Pinned parameters, the simulator fitted with them freed, and the sentence for the report."""

    names: tuple[str, ...]
    fitted: Fitted
    sentence: str


def find_pinned_parameters(search: Search, answer: Posterior) -> PinnedParameters | None:
    """Find the fewest pinned parameters that explain as much, once freed, as the named laws; None if there are none.

    If one value does not suffice, further ones are freed beside the best, up to the number of the laws' own parameters.
    """
    named = [e.element for e in answer.effects]
    bench, without = search.bench, search.root.fitted
    if not named and without.cost < USELESS_FIT:
        return None
    as_well = EQUAL_RATIO**2 * answer.best.mean_square if named else np.inf
    # a larger error means that something else is missing
    enough = min(as_well, (FAR_RATIO if named else AT_NOISE_RATIO) ** 2 * search.floor2)
    pinned = [
        name
        for name, p in bench.simulator.parameters.items()
        if not p.value.ndim  # a matrix or a zero represents no physics
        and float(p.value) != 0
        and bool(np.all(p.fixed) or np.all(without.is_at_bound(name)))
    ]
    most = max(1, answer.best.size)
    freed: tuple[str, ...] = ()
    best = without
    while len(freed) < min(len(pinned), most):
        if len(freed) == 1:
            together = _refit_freed(search, pinned, best, enough)  # if all of them do not suffice, no subset does
            if together is None or together.cost > NEAR_RATIO**2 * enough:
                return None
        found = {name: _refit_freed(search, [*freed, name], best, enough) for name in pinned if name not in freed}
        gained = {name: f for name, f in found.items() if f is not None and _left_bounds(search, (*freed, name), f)}
        if search.interrupted or not gained:
            return None
        name = min(gained, key=lambda n: gained[n].cost)
        freed, best = (*freed, name), gained[name]
        # any value equals a law that hardly explains anything
        if (
            best.cost <= enough
            and evidence_gain(without.cost, best.cost, search.bench.scored(best.residual), len(freed)) > LEAST_GAIN
        ):
            return PinnedParameters(freed, best, _describe_pinned(search, freed, best, named))
    return None


def _refit_freed(search: Search, names: Sequence[str], start: Fitted, enough: float) -> Fitted | None:
    """Refit with some pinned parameters freed; None if the fit fails or there is no time."""
    if search.past_deadline:
        return None
    bench, without = search.bench, search.root.fitted
    own = bench.simulator.parameters
    freed = {}
    for name in names:
        positive = float(own[name].value) > 0
        freed[name] = replace(own[name], fixed=False, bounds=(0.0 if positive else -np.inf, np.inf))
    simulator = bench.simulator.with_parameters({**own, **freed})
    far = DECADES if without.cost >= USELESS_FIT and len(names) == 1 else ()
    starts = [start.values, *({**start.values, n: own[n].value * by} for n in names for by in far)]
    found = None
    with search.until_interrupted():
        found = refit(bench, starts, simulator, states=start.initial)
        if found is not None and found.cost < NEAR_RATIO**2 * enough:
            found = refit(bench, [found.values], simulator, states=found.initial, solver=THOROUGH, like=found)
    return None if search.interrupted else found


def _left_bounds(search: Search, names: Sequence[str], found: Fitted) -> bool:
    """Tell whether each freed value is one that the pinned parameter could not have."""
    own = search.bench.simulator.parameters
    ends = [(own[n], float(found.values[n])) for n in names]
    return all(bool(np.all(p.fixed)) or not np.all((p.bounds[0] <= v) & (v <= p.bounds[1])) for p, v in ends)


def _describe_pinned(search: Search, names: Sequence[str], found: Fitted, named: Sequence[Placed]) -> str:
    """Describe the pinned parameters with the values that they have once they are freed."""
    without, errors = search.root.fitted, map(search.bench.nrmse, (search.root.fitted, found))
    parts = []
    for name in names:
        p, value = search.bench.simulator.parameters[name], float(found.values[name])
        kept = "held at" if np.all(p.fixed) else "kept by its bounds at"
        was = value_with_unit(float(without.values[name]), p.unit, 4)
        parts.append(f"{name} = {value_with_unit(value, p.unit, 5)}, which is {kept} {was}")
    words = in_words([f"the {name_at(*placed.name)}" for placed in named])
    like = f", no further off than with {words}" if named else ""
    what, it, its, given = (
        ("a value", "it", "its", "value is") if len(names) == 1 else ("values", "them", "their", "values are")
    )
    return (
        f"Nothing is missing but {what}: with {', and '.join(parts)}, {describe_fall(*errors)}{like}; "
        f"free {it}, or widen {its} bounds. If the given {given} right, physics that acts like another is missing."
    )


def may_act_elsewhere(search: Search, trial: Trial) -> bool:
    """Tell whether the laws of a hypothesis may imitate laws in an equation where no port is declared.

    Such laws drive a parameter to a bound, or they are at an actuator or sensor and leave more than white noise.
    """
    simulator = search.bench.simulator
    if not simulator.unreached:
        return False
    at_ends = any(in_series(e.port) for e in trial.effects)
    above_noise = trial.mean_square > AT_NOISE_RATIO**2 * search.least_noise2
    return trial.fitted.strained(simulator.parameters) > 0 or (at_ends and above_noise)


def find_undeclared_port(search: Search, named: Trial | None = None) -> tuple[tuple[Gate, ...], float]:
    """Note a mismatch that has a sure name in the equation of a state, and return its odds against `named`.

    `named` is the hypothesis that has a name at declared ports, if there is one.
    """
    nothing = tuple[Gate, ...](), 0.0
    other = _search_undeclared_ports(search)
    if other is None:
        return nothing
    found = posterior(other)
    if found.sure <= SURE:
        return nothing
    port, law = found.effects[0].name
    kind, state = split_port(port)
    if kind != EQUATION or (named is not None and not found.best.error < BETTER_RATIO * named.error):
        return nothing
    sentence = (
        f"No declared port {'may ' * bool(named)}reach{'' if named else 'es'} it: in the equation of {state}, "
        f"{display_name(law)} explains it{' as well' * bool(named)} (refitted with it, the error is "
        f"{percent(other.bench.nrmse(found.best.fitted))} of the outputs' deviation). "
        "Declare the port that it acts through."
    )
    gate = Gate(state, "undeclared", law.replace("_", " "), sentence, corrected=False)
    ahead = other.log_prior(found.best) - search.log_prior(found.best)  # as many samples count in both
    ahead += search.optimistic_evidence(found.best) - search.optimistic_evidence(named or search.root)
    return (gate,), float(np.exp(np.clip(ahead, -CONTENDING_NATS, CONTENDING_NATS)))


def _search_undeclared_ports(search: Search) -> Search | None:
    """Search a law in the equations that no declared port reaches; None without one, after an interrupt or divergence.

    The hypotheses at actuators and sensors are taken over.
    """
    ports = search.bench.simulator.undeclared
    if not ports or search.interrupted:
        return None
    open_ = search.bench.simulator.with_ports(ports)
    bench = replace(search.bench, simulator=open_)
    other: Search | None = None
    with search.until_interrupted(), suppress(InputError):
        there = Search(
            bench,
            without=bench.fit(open_, [search.root.fitted.values], states=search.root.fitted.begin),
            floor=search.floor,
            laws=[law for law in search.laws if "parallel" in law.places],
            workers=search.workers,
            say=search.say,
            aligned=True,
            surrogate_nrmse=search.surrogate_nrmse,
            until=search.until,
        )
        there.alternatives |= {port: laws for port, laws in search.alternatives.items() if in_series(port)}
        for trial in search.memo.values():
            if trial.laws and all(in_series(e.port) for e in trial.laws):
                known = replace(trial.fitted, simulator=trial.fitted.simulator.with_ports(ports))
                there.memo[trial.key] = replace(trial, fitted=known)
        other = there.run(1)
    if other is None:
        return None
    search.cut_short_with(other)
    return None if other.interrupted else other


def find_untried_laws(search: Search) -> tuple[Gate, ...]:
    """Note the ports of unknown domain, where laws of a single domain were not tried."""
    special = [law for law in search.laws if law.special]
    ports = [p.name for p in search.bench.simulator.all_ports() if p.domain == UNKNOWN and not p.series]
    if not (special and ports):
        return ()
    domains = sorted({domain for law in special for domain in law.domains})
    sentence = (
        f"The physical domain of {listed(ports)} is unknown, so laws that are {' or '.join(domains)} alone "
        "were not tried there; state the units of the port's force and coordinate, or its domain."
    )
    return (Gate(", ".join(ports), "domain", UNKNOWN, sentence, corrected=False),)


Group = tuple[str, Sequence[Recording], Sequence[np.ndarray]]  # name, recordings, and initial states


def find_varying_values(search: Search) -> tuple[Gate, ...]:
    """Note values that differ between the recordings, or else between the halves of each recording."""
    bench, whole = search.bench, search.root.fitted
    if search.interrupted or not np.any(whole.model.parameters.free):
        return ()
    with search.until_interrupted():
        for groups, where in ((_by_recording(bench, whole), "the recordings"), (_by_half(bench, whole), "the halves")):
            found = _compare_groups(search, groups, where) if len(groups) > 1 else None
            if found is not None:
                return (found,)
    return ()


def _by_recording(bench: Workbench, whole: Fitted) -> list[Group]:
    names = [r.name or f"recording {i + 1}" for i, r in enumerate(bench.recordings)]
    return [(n, (r,), (x,)) for n, r, x in zip(names, bench.recordings, whole.initial, strict=True)]


def _by_half(bench: Workbench, whole: Fitted) -> list[Group]:
    first, second, middle = list[Recording](), list[Recording](), list[np.ndarray]()
    for r, x in zip(bench.recordings, whole.initial, strict=True):
        cut = (r.skip + len(r)) // 2
        first.append(open_start(r.slice(0, cut)))
        second.append(open_start(r.slice(cut)))
        middle.append(simulate_states(whole, r, x)[cut])
    return [("first", first, whole.initial), ("second", second, middle)]


def _compare_groups(search: Search, groups: Sequence[Group], where: str) -> Gate | None:
    """Fit each group alone; note the values that differ if this follows far better than one set of values."""
    bench, whole = search.bench, search.root.fitted
    fits, benches = list[Fitted](), list[Workbench]()
    for _, recordings, states in groups:
        part = bench.on(recordings)
        fitted = refit(part, [whole.values], whole.simulator, states=states, like=whole)
        if fitted is None:
            return None
        fits.append(fitted)
        benches.append(part)
    sizes = [sum(len(r) - r.skip for r in part.recordings) for part in benches]
    squares = np.average([f.squares for f in fits], weights=sizes, axis=0)
    cost = bench.pool(squares)
    more_starts = sum(len(part.recordings) for part in benches) - len(bench.recordings)
    more = whole.model.parameters.free.sum() * (len(fits) - 1) + whole.model.initial_basis.shape[1] * more_starts
    residual = [e for part, f in zip(benches, fits, strict=True) for e in part.scored(f.residual)]
    if cost > CURED_SHARE * whole.cost:
        return None
    if evidence_gain(whole.cost, max(cost, search.floor2), residual, more) < LEAST_GAIN:
        return None
    values = _clearest_differences(whole, fits, benches)
    if not values:
        return None
    listed = "; ".join(f"{name}: {' / '.join(f'{v:.4g}' for v in found)}" for name, found in values)
    names = " / ".join(name for name, *_ in groups)
    errors = np.sqrt(np.mean(whole.squares)), np.sqrt(np.mean(squares))
    sentence = (
        f"With values of their own, {where} ({names}) are followed to {percent(errors[1])} of the outputs' deviation "
        f"instead of {percent(errors[0])} ({listed}): something differs between them, such as a setting, a "
        "temperature or a level that the simulator does not know."
    )
    return Gate(", ".join(name for name, _ in values), "varying", [v for _, v in values], sentence, corrected=False)


def _clearest_differences(
    whole: Fitted, fits: Sequence[Fitted], benches: Sequence[Workbench]
) -> list[tuple[str, list[float]]]:
    """List the parameters with the most significant differences, the most significant first."""
    std = [standard_errors(part, f) for part, f in zip(benches, fits, strict=True)]
    out = list[tuple[float, str, list[float]]]()
    for name, p in whole.simulator.parameters.items():
        if np.size(p.value) != 1 or np.all(p.fixed):
            continue
        values = [float(np.ravel(f.values[name])[0]) for f in fits]
        errors = [float(np.ravel(s[name])[0]) for s in std]
        error = np.sqrt(np.nanmean(np.square(errors))) if np.any(np.isfinite(errors)) else np.inf
        clear = np.ptp(values) / max(error, 1e-300)
        if clear > CERTAIN_ERRORS:
            out.append((clear, name, values))
    return [(name, values) for _, name, values in sorted(out, reverse=True)[:FEW]]
