"""What constraints and sparsity cost on the Masing rig (`python -m problems.constrained`).

Three tables:

1. stability: bounds on the spectral radius of `A` and of `A + B_w diag(Σw) C_z`, which hold exactly at the result's
   numbers, and what they cost in training NRMSE next to an identification without any. The rig itself (Krikelis et al.
   2024, Table 1) has poles of modulus up to `slowest_pole`: bounds below it deny some of the physics;
2. sparse weights: an L1 penalty with a second fit after pruning, its strength chosen on validation records (two
   multisines and two slower sweeps), against the full fit on the test multisine and the test sweep, which nothing has
   seen; on the Masing rig, whose density of operators is continuous, and on a machine with three plays;
3. constraints that cannot be met, and the sentence that says so.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording, multisine, sine_sweep
from pilfr_casadi.identify import Fit, fit, regularization_path
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, hammerstein, play
from pilfr_casadi.optimise import Constraint, dc_gain, ordered

from .masing import MasingRig, simulate
from .masing_data import F_MAX, FS, benchmark

FIRST_RECORD = 100
VALIDATION = 1000  # added to a record's seed
RADII = (1.0, 0.995, 0.99, 0.9895, 0.989)
STRENGTHS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # of L1 on the rig, in units of the full fit's objective
RATES = (0.6, 0.8)  # of the sweeps for validation; that of the test is 1.17
MARGIN = 0.1  # of the validation error that a sparser fit may cost


@dataclass(frozen=True)
class Bounded:
    """A fit under a bound on the spectral radius."""

    bound: float
    radius: float
    train: float
    cost: float
    multisine: float
    sweep: float
    active: int


@dataclass(frozen=True)
class Sparse:
    """A full fit and the sparse one that validation chooses."""

    name: str
    operators: tuple[int, int]
    full: tuple[float, ...]
    sparse: tuple[float, ...]

    @property
    def share(self) -> float:
        """Change of the held-out error, the mean over the test recordings."""
        return sum(self.sparse) / sum(self.full) - 1


def slowest_pole() -> float:
    """Largest modulus of the sampled rig's poles, with its spring gone or at its initial stiffness."""
    moduli = []
    for virgin in (True, False):
        poles = np.linalg.eigvals(MasingRig().matrices(virgin_spring=virgin)[0])
        moduli.append(float(np.max(np.exp(poles.real / FS))))
    return max(moduli)


def radius(result: Fit) -> float:
    """The larger spectral radius of the two linear extremes of a PI-LFR of plays."""
    p = result.parameters
    full = p["A"] + p["B_w"] @ np.diag(p["w"].sum(axis=1)) @ p["C_z"]
    return float(max(np.max(np.abs(np.linalg.eigvals(a))) for a in (p["A"], full)))


def stability_table(record: int, n: int, starts: int, radii: Sequence[float] = RADII) -> tuple[Fit, list[Bounded]]:
    """The identification without a bound, and those with exact ones, all from the same starts."""
    records = benchmark(record).records
    structure = PILFR(5, PrandtlIshlinskii(Play, n))
    reference = fit(structure, records["train"], starts=starts, stable=False)
    rows = []
    for bound in radii:
        found = fit(structure, records["train"], starts=starts, stable=bound)
        tests = found.nrmse(records["multisine"]), found.nrmse(records["sweep"])
        active = sum(limit.active for limit in found.limits if limit.kind == "constraint")
        cost = found.train_nrmse[0] / reference.train_nrmse[0] - 1
        rows.append(Bounded(bound, radius(found), found.train_nrmse[0], cost, *tests, active))
    return reference, rows


def other_sweep(record: int, rate: float) -> Recording:
    """A slower sweep with noise of its own, for validation: multisines alone do not reach its amplitudes."""
    u = sine_sweep(0.1, F_MAX, FS, rate=rate)
    x = simulate(u, FS).x2
    noise = np.random.default_rng(record + VALIDATION).standard_normal(len(x))
    return Recording(
        u, x + 10 ** (-50 / 20) * np.std(x) * noise, 1 / FS, initial="zero", hold="zero", name="other sweep"
    )


def sparse_masing(record: int, n: int, starts: int, strengths: Sequence[float] | None = STRENGTHS) -> Sparse:
    """The Masing rig, judged on multisine and sweep."""
    records = benchmark(record).records
    held = [benchmark(record + k * VALIDATION).records["multisine"] for k in (1, 2)]
    held += [other_sweep(record + k, rate) for k, rate in enumerate(RATES)]
    full = fit(PILFR(5, PrandtlIshlinskii(Play, n)), records["train"], starts=starts)
    given = None if strengths is None else [full.solution.cost * s for s in strengths]
    path = regularization_path(full, records["train"], held, strengths=given, margin=MARGIN)
    tests = [records["multisine"], records["sweep"]]
    used = path.operators[path.recommended]
    errors = (tuple(f.nrmse(r) for r in tests) for f in (full, path.fit))
    return Sparse(f"Masing rig, record {record}", (n, used), *errors)


def three_plays(seed: int, samples: int = 2000) -> Recording:
    """A drive of three plays in parallel behind a lag, with noise of about 0.7 % of the output."""
    rng = np.random.default_rng(seed)
    u = multisine(samples, f_max=5.0, fs=100.0, rng=rng)
    memory, x, y = np.zeros(3), 0.0, np.zeros_like(u)
    for k, value in enumerate(u):
        y[k] = x
        memory = play(value, memory, np.array([0.1, 0.5, 1.0]))
        x = 0.8 * x + 0.2 * np.array([0.5, 0.3, 0.2]) @ memory
    return Recording(u, y + 0.005 * rng.standard_normal(u.size), 0.01, initial="zero")


def sparse_plays(seed: int, n: int = 10, starts: int = 3) -> Sparse:
    """The machine with three plays, fitted with many."""
    train, held, test = (three_plays(1000 * k + seed) for k in range(3))
    full = fit(hammerstein(1, PrandtlIshlinskii(Play, n)), train, starts=starts)
    path = regularization_path(full, train, held, margin=MARGIN)
    used = path.operators[path.recommended]
    return Sparse(f"three plays, seed {seed}", (n, used), (full.nrmse(test),), (path.fit.nrmse(test),))


def infeasible_sentences() -> list[str]:
    """What is said of constraints that cannot be met: before the work where that can be known, else by the result."""
    record, element, out = three_plays(0), PrandtlIshlinskii(Play, 3), []
    held = PILFR(1, element, fixed={"A": 0.95})
    beyond = Constraint(lambda p: p["r"], lower=1.0, upper=-1.0, name="thresholds")
    for structure, options in (
        (held, {"stable": 0.9}),
        (hammerstein(1, element), {"constraints": [beyond]}),
        (PILFR(1, element, bounds={"w": (2.0, 1.0)}), {}),
        (hammerstein(1, element), {"constraints": [dc_gain(1.0), dc_gain(2.0)]}),
        (PILFR(1, element, bounds={"r": (0.0, 1.0)}), {"constraints": [ordered("r", gap=2.0)]}),
    ):
        try:
            found = fit(structure, record, starts=1, **options)
            missed = [str(limit) for limit in found.limits if not limit.met]
            out.append(f"{found.status.value} ({'; '.join(missed)})")
        except InputError as error:
            out.append(str(error))
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=3, help=f"fresh records, from {FIRST_RECORD} on")
    parser.add_argument("--operators", type=int, nargs="+", default=[20, 60], metavar="N", help="of the sparse fits")
    parser.add_argument("--starts", type=int, default=8)
    options = parser.parse_args(arguments)
    seeds = range(FIRST_RECORD, FIRST_RECORD + options.records)
    print(f"slowest pole of the rig {slowest_pole():.4f}; PI-LFR with 20 plays, train / multisine / sweep")
    for seed in seeds:
        reference, rows = stability_table(seed, 20, options.starts)
        print(f"record {seed}: no bound, radius {radius(reference):.6f}, train {reference.train_nrmse[0]:.4f}")
        for r in rows:
            print(
                f"  radius <= {r.bound:<5g} {r.radius:.9f} {'holds' if r.radius <= r.bound else 'FAILS'}, "
                f"{r.train:.4f} / {r.multisine:.4f} / {r.sweep:.4f}, cost {100 * r.cost:+.1f} %, {r.active} active",
                flush=True,
            )
    print("sparse weights: operators and held-out NRMSE (multisine / sweep), full -> chosen by validation")
    cases = [sparse_masing(seed, n, options.starts) for n in options.operators for seed in seeds]
    for case in [*cases, *(sparse_plays(seed) for seed in range(options.records))]:
        full, sparse = (" / ".join(f"{e:.4f}" for e in errors) for errors in (case.full, case.sparse))
        print(
            f"  {case.name}: {case.operators[0]} -> {case.operators[1]} operators, {full} -> {sparse} "
            f"({100 * case.share:+.1f} %)",
            flush=True,
        )
    print("constraints that cannot be met")
    for sentence in infeasible_sentences():
        print(f"  {sentence}")


if __name__ == "__main__":
    main()
