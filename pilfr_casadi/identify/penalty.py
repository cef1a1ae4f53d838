r"""The L1 penalty on an element's weights, with the scales held that it could hide in.

    minimise  1/2 mean(e²) + l1 Σ w_ij

(Tibshirani 1996; the simulation error is that of Krikelis et al. 2024, Eq. 20). The outputs of a PI-LFR do not change
under `w_i -> w_i / μ, (B_w, D_yw)_i -> μ (...)`, nor under a scaling of z with its thresholds and of the states, in
every combination (`generators`). With all blocks free, units alone would drive the penalty to zero. Nor is it enough to
hold a product such as `C_z B_w`, which no change of the states moves: it is the first sample of the response from w to
z, next to nothing in a mechanical system, and costs next to nothing to restore. So

1. the problem is solved without the penalty;
2. the weights of each channel are scaled to a sum of one, which `B_w` and `D_yw` take up, unless an entry is fixed,
   bounded or has a prior: `l1` then is in units of the cost, for all of a channel's weights;
3. plays or stops of a channel with nearly the same threshold are merged into one, as long as the objective grows by
   no more than `SLACK` in all: to the penalty one large weight and two halves of it are the same;
4. the problem is solved with the penalty from there. Every linear block, every parameter of the operators and every
   entry that is zero is held at its value; weights, thresholds, `y_0` and the initial states are free.

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
from ..optimise import Problem, Solution, Status
from .context import FitContext, Stage
from .result import with_solution

SLACK = 0.02  # share of the objective that merging operators may cost before the last solve


def check_penalty(l1: dict[str, float], parameters: ParameterSet, linear: bool) -> None:
    """Refuse a penalty on a linear model, an unknown name or a parameter that may be negative, before any long work."""
    if linear:
        raise InputError("An L1 penalty was asked for on a linear model; it acts on an element's weights, give one.")
    for name, weight in l1.items():
        lower = parameters.lower[parameters.position(name)]
        if not is_number(weight) or not 0 <= weight < np.inf:
            raise InputError(f"The L1 weight of {name!r} is {weight!r}; give a number, 0 or more.")
        if np.any(lower < 0):
            raise InputError(f"An L1 penalty on {name!r} needs a lower bound of zero or more; bound it or use a prior.")


def normalise_weights(model: Model) -> Model:
    """Scale the weights of each channel to a sum of one with the same outputs, unless an entry is fixed or bounded."""
    parameters = model.parameters
    if not isinstance(model.element, PrandtlIshlinskii):
        return model
    values = {name: p.value.copy() for name, p in parameters.items()}
    for i, total in enumerate(values["w"].sum(axis=1)):
        entries = (("w", np.s_[i], 0.0), ("B_w", np.s_[:, i], -np.inf), ("D_yw", np.s_[:, i], -np.inf))
        if total > 0 and all(_scales(parameters[name], part, low) for name, part, low in entries):
            values["w"][i] /= total
            values["B_w"][:, i] *= total
            values["D_yw"][:, i] *= total
    return model.with_parameters(parameters.at(parameters.pack(values)))


def _scales(p: Parameter, part: Any, low: float) -> bool:
    """Tell whether entries may be scaled: free without a bound other than `low`, or fixed at zero; no prior."""
    fixed = p.fixed[part]
    free = ~fixed & (p.bounds[0][part] == low) & np.isinf(p.bounds[1][part])
    return p.prior is None and bool(np.all(free | (fixed & (p.value[part] == 0))))


def hold_all_but_element(model: Model, names: Iterable[str]) -> Model:
    """Fix all parameters but `y_0`, the penalised names and, if weights or thresholds are among them, both of these."""
    loose = {"y_0", *names} | (set(LAYER) if set(LAYER) & set(names) else set())
    held = {name: {"fixed": True, "prior": None} for name in model.parameters if name not in loose}
    return model.with_parameters(model.parameters.change(**held))


def fix_idle_operators(model: Model) -> Model:
    """Hold operators of no weight, so that they do not split from another one again."""
    p = model.parameters
    if not isinstance(model.element, PrandtlIshlinskii):
        return model
    idle = p["w"].value == 0
    return model.with_parameters(p.change(**{name: {"fixed": p[name].fixed | idle} for name in LAYER}))


def merge_operators(held: Problem, theta: np.ndarray) -> np.ndarray:
    """Merge operators of nearly the same threshold, the nearest first; return the variables."""
    element, parameters = held.model.element, held.model.parameters
    if not (isinstance(element, PrandtlIshlinskii) and isinstance(element.operator, Play | Stop)):
        return theta
    at = np.where(held.free, np.cumsum(held.free) - 1, -1)
    shape = (element.channels, element.n)
    w_at, r_at = (at[parameters.position(name)].reshape(shape, order="F") for name in LAYER)
    size, n_x = held.model.n_x + held.model.n_s, held.model.n_x
    first = range(int(held.free.sum()), held.size, size)
    limit = (1 + SLACK) * held.cost(theta)

    def trial(i: int, a: int, b: int) -> np.ndarray:
        """Replace two operators of channel i by one."""
        out, w, r = theta.copy(), theta[w_at[i]], theta[r_at[i]]
        share = w[b] / (w[a] + w[b])
        out[w_at[i, a]], out[w_at[i, b]] = w[a] + w[b], 0.0
        out[r_at[i, a]] = (1 - share) * r[a] + share * r[b]
        for start in first:
            memory = theta[start + n_x + i * element.n :][: element.n]
            out[start + n_x + i * element.n + a] = (1 - share) * memory[a] + share * memory[b]
        return out

    for i in range(element.channels):
        if np.any(w_at[i] < 0) or np.any(r_at[i] < 0):
            continue
        better = True
        while better:
            better = False
            used = sorted(np.flatnonzero(theta[w_at[i]] > 0), key=lambda j: theta[r_at[i, j]])
            pairs = sorted(pairwise(used), key=lambda ab: theta[r_at[i, ab[1]]] - theta[r_at[i, ab[0]]])
            for a, b in pairs:
                there = trial(i, int(a), int(b))
                if np.all((there >= held.lower) & (there <= held.upper)) and held.cost(there) <= limit:
                    theta, better = there, True
                    break
    return theta


def restore_variables(solution: Solution, held: Problem, problem: Problem) -> Solution:
    """Express the solution of a problem with held parameters in the variables of the problem without."""
    n_held, n = int(held.free.sum()), int(problem.free.sum())
    theta = np.concatenate([held.parameters(solution.theta)[problem.free], solution.theta[n_held:]])
    multipliers = np.zeros(problem.size + len(problem.g_lower))
    if len(solution.multipliers) == held.size + len(held.g_lower):
        where = np.flatnonzero(held.free[problem.free])
        multipliers[where], multipliers[n:] = solution.multipliers[:n_held], solution.multipliers[n_held:]
    return replace(solution, theta=theta, multipliers=multipliers)


def penalty_sentence(model: Model, l1: dict[str, float]) -> str:
    """Say how many entries the penalty has brought to zero."""
    counts = [f"{np.sum(model.parameters[k].value == 0)} of {model.parameters[k].size} entries of {k}" for k in l1]
    return f"L1 penalty: {', '.join(counts)} are exactly zero; the linear blocks were held while it acted"


def solve_with_penalty(model: Model, problem: Problem, solution: Solution, context: FitContext) -> Stage:
    """Solve with the L1 penalty from the solution without; return model, problem, solution and a note."""
    if solution.status is Status.INTERRUPTED:
        return model, problem, solution, "interrupted before the L1 penalty was applied"
    found = normalise_weights(with_solution(model, problem, solution))
    states = solution.theta[int(problem.free.sum()) :]
    options: dict[str, Any] = {"engine": problem.engine, "l1": context.l1}
    whole, held = (
        context.problem(m, problem.noise, **options) for m in (found, hold_all_but_element(found, context.l1))
    )
    begin = merge_operators(held, np.concatenate([held.start[: int(held.free.sum())], states]))
    states = begin[int(held.free.sum()) :]
    last = fix_idle_operators(held.model.with_parameters(held.model.parameters.at(held.parameters(begin))))
    if np.any(last.parameters.free):
        held = context.problem(last, problem.noise, **options)
    begin = np.concatenate([held.start[: int(held.free.sum())], states])
    result = restore_variables(context.solve(held, "L1 penalty", begin), held, whole)
    return found, whole, result, penalty_sentence(with_solution(found, whole, result), context.l1)
