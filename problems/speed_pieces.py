"""The parts of the speed tables that run in a process of their own; `problems.speed` starts them and prints.

    python -m problems.speed_pieces '["growth", "folder", 60000]'

The folder holds the case as `problems.speed.prepare` writes it. A piece prints its figures as one line of JSON.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ORDER, PLAYS = 5, 20
Figures = dict[str, Any]


def peak_memory() -> float:
    """Largest resident memory of this process so far, in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # `getrusage` may count the parent process
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def clock(action: Callable[[], Any], repeats: int = 7, budget: float = 5.0) -> float:
    """Median seconds of an action, after a first one that does not count."""
    action()
    taken: list[float] = []
    while len(taken) < repeats and sum(taken) < budget:
        began = time.perf_counter()
        action()
        taken.append(time.perf_counter() - began)
    return float(np.median(taken))


def load(folder: Path, engine: str = "auto", samples: int | None = None, point: str = "start") -> Any:
    """The problem of the case, at its start or at a point on the way, the record cut or repeated to `samples`."""
    from pilfr_casadi.data import Recording
    from pilfr_casadi.optimise import Problem

    with np.load(folder / f"{point}.npz") as case:
        values = dict(case)
    u, y = values.pop("u"), values.pop("y")
    samples = samples or len(u)
    record = Recording(np.resize(u, (samples, 1)), np.resize(y, (samples, 1)), 1 / 120, initial="zero")
    return Problem(structure().model(1, 1, values), record, engine=engine)


def structure() -> Any:
    """Five states and 20 plays."""
    from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii

    return PILFR(ORDER, PrandtlIshlinskii(Play, PLAYS))


def derivatives(folder: Path, way: str, samples: int) -> Figures:
    """Residual and Jacobian over the record by one way, and the simulation alone where the way is an engine."""
    problem = load(folder, way if way in ("c", "vm") else "vm", samples, "way")
    u, p = problem.recordings[0].u, problem.parameters(problem.start)
    state, before = np.zeros(problem.model.n_x + problem.model.n_s), peak_memory()
    if way in ("c", "vm"):
        seed = np.zeros((len(state), len(p)))
        columns, engine = np.arange(len(p)), problem.engine
        seconds = clock(lambda: engine.sensitivity(u, p, state, seed, columns))
        memory = peak_memory() - before
        return {"seconds": seconds, "memory": memory, "simulation": clock(lambda: engine.simulate(u, p, state), 25)}
    evaluate = _unrolled(problem.model, len(u)) if way == "naive" else _scalar(problem.model, len(u))
    seconds = clock(lambda: evaluate(u.T, p), 3)
    return {"seconds": seconds, "memory": peak_memory() - before}


def _unrolled(model: Any, samples: int) -> Any:
    """`jacobian` of `mapaccum` over the whole record."""
    import casadi as ca

    u, p = ca.MX.sym("u", model.n_u, samples), ca.MX.sym("p", model.parameters.size)
    state = ca.DM.zeros(model.n_x + model.n_s)
    y = model.closed.mapaccum("run", samples)(state, u, ca.repmat(p, 1, samples))[1]
    return ca.Function("naive", [u, p], [y, ca.jacobian(ca.vec(y), p)])


def _scalar(model: Any, samples: int) -> Any:
    """`mapaccum` of a scalar-expression step that carries `S⁺ = f_s S + f_p`, differentiated by CasADi."""
    import casadi as ca

    x, u, p = ca.SX.sym("x", model.n_x + model.n_s), ca.SX.sym("u", model.n_u), ca.SX.sym("p", model.parameters.size)
    x_next, y = model.closed(x, u, p)
    both, slope = ca.vertcat(x_next, y), ca.SX.sym("S", x.shape[0], p.shape[0])
    moved = ca.jtimes(both, x, slope) + ca.jacobian(both, p)
    after = ca.horzcat(x_next, ca.densify(moved[: x.shape[0], :]))
    step = ca.Function("step", [ca.horzcat(x, slope), u, p], [after, y, ca.densify(moved[x.shape[0] :, :])])
    run, first = step.mapaccum("run", samples), np.zeros((x.shape[0], 1 + p.shape[0]))
    return lambda u, p: run(first, u, np.tile(p[:, None], (1, samples)))


def growth(folder: Path, samples: int) -> Figures:
    """Objective, gradient and Gauss-Newton Hessian over a long record."""
    problem = load(folder, "auto", samples, "way")
    before = peak_memory()
    seconds = clock(lambda: problem.normal(problem.start), 3, 3.0)
    return {"seconds": seconds, "memory": peak_memory(), "more": peak_memory() - before, "recording": 16e-6 * samples}


def one_start(folder: Path, engine: str) -> Figures:
    """One start run to the end, as the pipeline would: with its constraints, code generation and building included."""
    from pilfr_casadi.optimise import GaussNewton, Problem, loosen_radii, stability_limits

    model = load(folder, "vm", 200).model
    record = load(folder, "vm").recordings
    began = time.perf_counter()
    problem = Problem(model, record, engine=engine, constraints=loosen_radii(stability_limits(structure(), True)))
    ready = time.perf_counter() - began
    solution = GaussNewton().solve(problem)
    error = float(np.sqrt(np.mean(problem.residual(solution.theta) ** 2)))
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "ready": ready, "iterations": solution.iterations, "error": error}


def pipeline(folder: Path, starts: int) -> Figures:
    """The default identification of the record."""
    from pilfr_casadi.identify import fit

    record = load(folder, "vm").recordings
    began = time.perf_counter()
    result = fit(structure(), record, starts=starts)
    return {"seconds": time.perf_counter() - began, "error": result.train_nrmse[0]}


def least_squares(folder: Path, way: str, limit: int) -> Figures:
    """The same problem from the same start: scipy's trf with bounds, or `GaussNewton` (way "ours")."""
    problem = load(folder, "auto")
    began = time.perf_counter()
    if way == "ours":
        from pilfr_casadi.optimise import GaussNewton

        solution = GaussNewton().solve(problem)
        theta, count, ended = solution.theta, solution.iterations, solution.status.converged
    else:
        from scipy.optimize import least_squares as trf

        slope: Any = problem.jacobian if way == "jacobian" else "2-point"
        bounds = (problem.lower, problem.upper)
        found = trf(problem.residual, problem.start, slope, bounds, "trf", ftol=1e-6, max_nfev=limit)
        theta, count, ended = found.x, int(found.njev or 0), found.status > 0
    seconds = time.perf_counter() - began
    error = float(np.sqrt(np.mean(problem.residual(theta) ** 2)))
    return {"seconds": seconds, "iterations": count, "ended": bool(ended), "error": error}


def imports(folder: Path, what: str) -> Figures:
    """Import time: of casadi alone, and of what comes on top."""
    began = time.perf_counter()
    import casadi  # noqa: F401

    middle = time.perf_counter()
    if what == "package":
        import pilfr_casadi  # noqa: F401
    else:
        pass
    return {"casadi": middle - began, "more": time.perf_counter() - middle}


def building(folder: Path) -> Figures:
    """Time until a compiled engine is ready to run."""
    model = load(folder, "vm", 200).model
    from pilfr_casadi.engine import make_engine

    began = time.perf_counter()
    make_engine(model, "c")
    return {"seconds": time.perf_counter() - began}


MAIN = """#include <stdio.h>
#include <time.h>
#include "rig.h"
int main(void) {
  double x[RIG_NX], y[RIG_NY], u[RIG_NU], sum = 0;
  struct timespec a, b;
  int k;
  rig_x0(x);
  clock_gettime(CLOCK_MONOTONIC, &a);
  for (k = 0; k < 2000000; k++) {
    u[0] = (k / 64 % 2 ? -1.0 : 1.0) * (k % 64 - 32) / 16;
    rig_step(x, u, x, y);
    sum += y[0];
  }
  clock_gettime(CLOCK_MONOTONIC, &b);
  printf("%.6e %.17g\\n", ((b.tv_sec - a.tv_sec) + 1e-9 * (b.tv_nsec - a.tv_nsec)) / 2e6, sum);
  return 0;
}
"""


def exported_step(folder: Path, optimisation: str = "-O2") -> Figures:
    """One step of the exported model in a C program, and of its CasADi function called from Python."""
    import subprocess

    from pilfr_casadi.engine import compiler
    from pilfr_casadi.export import exported

    step = exported(load(folder, "vm", 200, "way").model, dt=1 / 120, name="rig")
    x, u = step.x0(), np.ones(1)
    figures = {"function": clock(lambda: [step.step(x, u) for _ in range(1000)]) / 1000}
    if (cc := compiler()) is not None:
        step.to_c(folder)
        (folder / "main.c").write_text(MAIN)
        command = [cc, "-D_POSIX_C_SOURCE=199309L", "-std=c99", optimisation, "main.c", "rig.c", "-lm", "-o", "rig"]
        subprocess.run(command, cwd=folder, check=True)
        runs = [subprocess.run([folder / "rig"], capture_output=True, text=True, check=True).stdout for _ in range(5)]
        assert all(np.isfinite(float(run.split()[1])) for run in runs)
        figures["seconds"] = float(np.median([float(run.split()[0]) for run in runs]))
    return figures


PIECES = {
    f.__name__: f for f in (derivatives, growth, one_start, pipeline, least_squares, imports, building, exported_step)
}


def main(call: str) -> None:
    """Run one piece on one core and print its figures."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    piece, folder, *arguments = json.loads(call)
    print(json.dumps(PIECES[piece](Path(folder), *arguments)))


if __name__ == "__main__":
    main(sys.argv[1])
