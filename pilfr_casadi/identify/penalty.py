r"""L1 penalty on an element's weights, with all scales fixed that could offset it.

    minimise  1/2 mean(e²) + l1 Σ w_ij

(Tibshirani 1996; simulation error of Krikelis et al. 2024, Eq. 20). The outputs of a PI-LFR do not change
under `w_i -> w_i / μ, (B_w, D_yw)_i -> μ (...)`, nor under a scaling of z with its thresholds and of the states, in
every combination (`generators`). With all blocks free, a rescaling alone would drive the penalty to zero. Fixing an
invariant product such as `C_z B_w` is not enough: it is the first sample of the response from w to z, which is tiny in
a mechanical system and can be restored at almost no cost. Therefore

1. the problem is solved without the penalty;
2. the weights of each channel are scaled to a sum of one, with `B_w` and `D_yw` scaled inversely, unless an entry is
   fixed, bounded or has a prior; `l1` then is the cost of a channel's whole sum of weights;
3. plays or stops of a channel with nearly the same threshold are merged as long as the objective grows by at most the
   share `OBJECTIVE_GROWTH` in all, because the penalty does not distinguish one large weight from two halves of it;
4. the problem is solved with the penalty from there. Weights, thresholds, `y_0` and the initial states are free; the
   linear blocks, other parameters of the operators, and operators of zero weight are fixed.

Only the user's fixed entries are fixed in the result.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from .._base import InputError, is_number
from ..models import LAYER, Model, Parameter, ParameterSet, Play, PrandtlIshlinskii, Stop
from ..optimise import Problem, Solution, Status, check_penalised
from .context import FitContext, Stage
from .result import with_solution

OBJECTIVE_GROWTH = 0.02  # relative growth of the objective that merging operators may cause before the last solve


def check_penalty(l1: dict[str, float], parameters: ParameterSet, linear: bool) -> None:
    """Refuse a penalty on a linear model, an unknown name or a parameter that may be negative, before any long work."""
    if linear:
        raise InputError(
            "l1 was given for a linear model, but the penalty acts on an element's weights; give an element."
        )
    for name, weight in l1.items():
        check_penalised(name, parameters)
        if not is_number(weight) or not 0 <= weight < np.inf:
            raise InputError(f"The L1 weight of {name!r} is {weight!r}; give a number, 0 or more.")


def normalise_weights(model: Model) -> Model:
    """Scale the weights of each channel to a sum of one with the same outputs, unless an entry is fixed or bounded."""
    parameters = model.parameters
    if not isinstance(model.element, PrandtlIshlinskii):
        return model
    values = {name: p.value.copy() for name, p in parameters.items()}
    for i, total in enumerate(values["w"].sum(axis=1)):
        entries = (("w", np.s_[i], 0.0), ("B_w", np.s_[:, i], -np.inf), ("D_yw", np.s_[:, i], -np.inf))
        if total > 0 and all(_may_be_scaled(parameters[name], part, low) for name, part, low in entries):
            values["w"][i] /= total
            values["B_w"][:, i] *= total
            values["D_yw"][:, i] *= total
    return model.with_parameters(parameters.at(parameters.pack(values)))


def _may_be_scaled(p: Parameter, part: Any, low: float) -> bool:
    """Tell whether entries may be scaled: no prior, and free with no bound but `low`, or fixed at zero."""
    fixed = p.fixed[part]
    free = ~fixed & (p.bounds[0][part] == low) & np.isinf(p.bounds[1][part])
    return p.prior is None and bool(np.all(free | (fixed & (p.value[part] == 0))))


def hold_all_but_element(model: Model, names: Iterable[str]) -> Model:
    """Fix all parameters but `y_0` and the penalised ones; weights and thresholds are free if either is penalised."""
    loose = {"y_0", *names} | (set(LAYER) if set(LAYER) & set(names) else set())
    changes = {name: {"fixed": True, "prior": None} for name in model.parameters if name not in loose}
    return model.with_parameters(model.parameters.change(**changes))


def fix_idle_operators(model: Model) -> Model:
    """Fix operators of zero weight, so that merged operators do not split again."""
    p = model.parameters
    if not isinstance(model.element, PrandtlIshlinskii):
        return model
    idle = p["w"].value == 0
    return model.with_parameters(p.change(**{name: {"fixed": p[name].fixed | idle} for name in LAYER}))


def merge_operators(fixed_problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Merge operators of nearly the same threshold, the nearest first; return the variables."""
    element, parameters = fixed_problem.model.element, fixed_problem.model.parameters
    if not (isinstance(element, PrandtlIshlinskii) and isinstance(element.operator, Play | Stop)):
        return theta
    place = np.where(fixed_problem.free, np.cumsum(fixed_problem.free) - 1, -1)
    shape = (element.channels, element.n)
    w_at, r_at = (place[parameters.position(name)].reshape(shape, order="F") for name in LAYER)
    size, n_x = fixed_problem.model.n_state, fixed_problem.model.n_x
    state_starts = range(fixed_problem.n_free, fixed_problem.size, size)
    limit = (1 + OBJECTIVE_GROWTH) * fixed_problem.cost(theta)

    def trial(i: int, a: int, b: int) -> np.ndarray:
        """Replace two operators of channel i by one."""
        out, w, r = theta.copy(), theta[w_at[i]], theta[r_at[i]]
        share = w[b] / (w[a] + w[b])
        out[w_at[i, a]], out[w_at[i, b]] = w[a] + w[b], 0.0
        out[r_at[i, a]] = (1 - share) * r[a] + share * r[b]
        for start in state_starts:
            memory = theta[start + n_x + i * element.n :][: element.n]
            out[start + n_x + i * element.n + a] = (1 - share) * memory[a] + share * memory[b]
        return out

    for i in range(element.channels):
        if np.any(w_at[i] < 0) or np.any(r_at[i] < 0):
            continue
        merging = True
        while merging:
            merging = False
            used = sorted(np.flatnonzero(theta[w_at[i]] > 0), key=lambda j: theta[r_at[i, j]])
            pairs = sorted(pairwise(used), key=lambda ab: theta[r_at[i, ab[1]]] - theta[r_at[i, ab[0]]])
            for a, b in pairs:
                merged = trial(i, int(a), int(b))
                if (
                    np.all((merged >= fixed_problem.lower) & (merged <= fixed_problem.upper))
                    and fixed_problem.cost(merged) <= limit
                ):
                    theta, merging = merged, True
                    break
    return theta


def restore_variables(solution: Solution, fixed_problem: Problem, problem: Problem) -> Solution:
    """Express the solution of a problem with fixed parameters in the variables of the full problem."""
    n_fixed, n = fixed_problem.n_free, problem.n_free
    theta = np.concatenate([fixed_problem.parameters(solution.theta)[problem.free], solution.theta[n_fixed:]])
    multipliers = np.zeros(problem.size + len(problem.g_lower))
    if len(solution.multipliers) == fixed_problem.size + len(fixed_problem.g_lower):
        where = np.flatnonzero(fixed_problem.free[problem.free])
        multipliers[where], multipliers[n:] = solution.multipliers[:n_fixed], solution.multipliers[n_fixed:]
    return replace(solution, theta=theta, multipliers=multipliers)


def penalty_sentence(model: Model, l1: dict[str, float]) -> str:
    """Report how many entries the penalty has set to zero."""
    counts = [f"{np.sum(model.parameters[k].value == 0)} of {model.parameters[k].size} entries of {k}" for k in l1]
    return f"L1 penalty: {', '.join(counts)} are exactly zero; the linear blocks were fixed during this solve"


def solve_with_penalty(model: Model, problem: Problem, solution: Solution, context: FitContext) -> Stage:
    """Solve with the L1 penalty, starting from the solution without it; return model, problem, solution and a note."""
    if solution.status is Status.INTERRUPTED:
        return model, problem, solution, "interrupted before the L1 penalty was applied"
    found = normalise_weights(with_solution(model, problem, solution))
    states = solution.theta[problem.n_free :]
    options: dict[str, Any] = {"engine": problem.engine, "l1": context.l1}
    full_problem = context.problem(found, problem.noise, **options)
    fixed_problem = context.problem(hold_all_but_element(found, context.l1), problem.noise, **options)
    begin = merge_operators(fixed_problem, np.concatenate([fixed_problem.start[: fixed_problem.n_free], states]))
    states = begin[fixed_problem.n_free :]
    last = fix_idle_operators(
        fixed_problem.model.with_parameters(fixed_problem.model.parameters.at(fixed_problem.parameters(begin)))
    )
    if np.any(last.parameters.free):
        fixed_problem = context.problem(last, problem.noise, **options)
    begin = np.concatenate([fixed_problem.start[: fixed_problem.n_free], states])
    result = restore_variables(context.solve(fixed_problem, "L1 penalty", begin), fixed_problem, full_problem)
    return found, full_problem, result, penalty_sentence(with_solution(found, full_problem, result), context.l1)
