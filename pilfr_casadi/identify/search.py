"""What the starts of one identification share, what one of them leads to, and how they are run."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import InputError, Progress
from ..data import Recording
from ..engine import Engine
from ..models import PILFR, Model
from ..optimise import Constraint, GaussNewton, Problem, Solution, Status, loosened
from .start import Blocks
from .told import solve_inside


@dataclass(frozen=True, eq=False)
class Search:
    """All that the tasks of one identification share."""

    structure: PILFR
    recordings: tuple[Recording, ...]
    linear: Blocks
    solver: Any = field(default_factory=GaussNewton)
    constraints: tuple[Constraint, ...] = ()
    engine: str = "auto"
    start: str = "grid"
    l1: dict[str, float] = field(default_factory=dict)
    noise: float | None = None
    weights: np.ndarray | None = None
    level: float = 1.0
    coordinates: bool = True  # whether the states' coordinates are free to choose
    progress: Progress | None = None  # gets the steps of every solve; of starts in other processes they are not heard

    def problem(self, model: Model, engine: Engine | None = None, noise: float | None = None) -> Problem:
        """The simulation-error problem of a model of this structure.

        Priors are weighed against the noise that was asked for, else what has been reached, `noise`; else what a linear
        model reaches, `level`.
        """
        return Problem(
            model,
            self.recordings,
            engine=engine or self.engine,
            constraints=loosened(self.constraints, least=1.0),
            l1=self.l1,
            noise=self.noise or noise or self.level,
            weights=self.weights,
        )

    def solve(self, problem: Problem, start: np.ndarray | None, solver: Any, held: bool = False) -> Solution:
        """A solver's solution inside exact bounds on spectral radii; `held` says that they hold it."""
        return solve_inside(problem, start, solver, "steps", self.progress, held=held)

    def model(self, values: dict[str, Any]) -> Model:
        """The closed model starting at `values`."""
        first = self.recordings[0]
        return self.structure.model(first.n_u, first.n_y, values, inputs=first.inputs, outputs=first.outputs)


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one start led to; `drawn` tells whether its start depends on the seed."""

    seed: int
    model: Model
    theta: np.ndarray
    error: float
    solution: Solution
    note: str = ""
    drawn: bool = True


def run_tasks(
    function: Callable[..., Candidate],
    tasks: Iterable[tuple[Any, ...]],
    executor: Executor | None,
    report: Callable[[list[Candidate], int], None],
) -> tuple[list[Candidate], bool]:
    """Results in the order of the tasks, from an executor or one after the other; whether the run was interrupted.

    `report` gets the results so far and their number in the end, first when there are none.
    """
    tasks, results = list(tasks), list[Candidate]()
    if executor is not None:
        try:
            pickle.dumps(tasks[:1])
        except Exception as error:
            raise InputError(
                f"The model or a constraint cannot be sent to other processes ({error}); "
                "define functions at the top of a module, or use workers=1."
            ) from None
    futures = [executor.submit(function, *task) for task in tasks] if executor is not None else None
    try:
        report(results, len(tasks))
        for i, task in enumerate(tasks):
            candidate = futures[i].result() if futures else function(*task)
            results.append(candidate)
            report(results, len(tasks))
            if candidate.solution.status is Status.INTERRUPTED:
                return results, True
    except KeyboardInterrupt:
        for future in futures or ():
            future.cancel()
        return results, True
    return results, False
