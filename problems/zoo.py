"""A zoo of small, seeded identification problems that carry their answers; every solver faces every one of them.

The cases stand in `zoo_blocks` and `zoo_rig`. Truth is simulated in plain NumPy (the rig by the exact simulator of
`masing`), apart from the package's engines. Noise is white, and the fit starts from what a user would have: a perturbed
or identified linear model with the element's way into the loop shut (`B_w = D_yw = 0`, Krikelis et al. (2024), Eq. 24),
or physical parameters 20 % off.

Simulation-error problems with hysteresis have many local minima. With the seeds given here both solvers find the truth;
with others one of them, or both, may end elsewhere: `python -m problems.zoo --seeds 20` counts how often.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np

from pilfr_casadi.optimise import GaussNewton, Ipopt

from .zoo_blocks import asymmetric, backlash_loop, lti, mimo_lfr, pi_hammerstein, pi_wiener
from .zoo_case import Case
from .zoo_rig import masing_grey

CASES: dict[str, Callable[..., Case]] = {
    "lti": lti,
    "backlash_loop": backlash_loop,
    "pi_hammerstein": pi_hammerstein,
    "pi_wiener": pi_wiener,
    "mimo_lfr": mimo_lfr,
    "asymmetric": asymmetric,
    "masing_grey": masing_grey,
}


def table(seed: int | None = None) -> str:
    """Both solvers on every case, one line a case; with the seed each case has for itself where none is given."""
    head = f"{'case':15}{'n':>4}{'start':>11}{'floor':>11}"
    head += f"{'Gauss-Newton':>15}{'it':>5}{'s':>6}{'IPOPT':>12}{'it':>5}{'s':>6}{'differ':>9}  active bounds"
    lines = [head]
    for name, make in CASES.items():
        case = make() if seed is None else make(seed)
        problem = case.problem()
        one, two = GaussNewton().solve(problem), Ipopt().solve(problem)
        at = np.flatnonzero((two.theta == problem.lower) | (two.theta == problem.upper))
        line = f"{name:15}{problem.size:4d}{problem.cost(problem.start):11.3e}{case.floor:11.3e}"
        line += f"{one.cost:15.4e}{one.iterations:5d}{one.seconds:6.2f}"
        line += f"{two.cost:12.4e}{two.iterations:5d}{two.seconds:6.2f}"
        line += f"{two.cost / one.cost - 1:9.2%}  {', '.join(problem.labels[i] for i in at) or '-'}"
        lines.append(f"{line}  ({one.cost / case.floor:.1f} x the floor: {case.remark})" if case.remark else line)
    return "\n".join(lines)


def counts(seeds: int) -> str:
    """How often, over many seeds, each solver ends within 5 % of the noise floor, and both within 2 % of each other."""
    lines = [f"{'case':15}{'Gauss-Newton':>14}{'IPOPT':>8}{'agree':>8}   of {seeds}"]
    for name, make in CASES.items():
        cases = [make(seed) for seed in range(seeds)]
        found = np.array([[s.solve(c.problem()).cost / c.floor for s in (GaussNewton(), Ipopt())] for c in cases])
        good, agree = np.sum(found < 1.05, axis=0), np.sum(np.abs(found[:, 1] / found[:, 0] - 1) <= 0.02)
        at_floor = [f"{g:d}" if cases[0].exact else "-" for g in good]
        lines.append(f"{name:15}{at_floor[0]:>14}{at_floor[1]:>8}{agree:8d}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and with ``--seeds`` the counts."""
    parser = argparse.ArgumentParser(prog="python -m problems.zoo", description="Both solvers on every problem.")
    parser.add_argument("--seeds", type=int, default=0, help="count, over this many seeds, who finds the truth")
    seeds = parser.parse_args(arguments).seeds
    print(counts(seeds) if seeds else table())


if __name__ == "__main__":
    main()
