"""A fit that its limit of iterations has stopped is continued; what has not converged is said."""

from __future__ import annotations

import importlib
from dataclasses import replace

import pytest
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.workbench import converge
from pilfr_casadi.optimise import GaussNewton, Status


def test_a_fit_that_ended_early_is_continued_to_its_minimum() -> None:
    """Unless there is no time."""
    simulator = rig(430.0, 5.0)
    bench = Workbench.of(simulator, [recorded(rig(), 0)], "zero")
    early = bench.fit(simulator, solver=GaussNewton(max_iterations=1))
    assert early.status is Status.MAX_ITERATIONS
    assert converge(bench, early, 0.0) is early
    found = converge(bench, early, 60.0)
    assert found.status.converged and found.cost < early.cost
    assert converge(bench, found, 60.0) is found


def test_a_fit_that_does_not_converge_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the findings, and so in what is printed."""
    options = {"hold": "zero", "effects": 0, "laws": (), "workers": 1}
    found = pilfr.diagnose(rig(), recorded(rig(), 0, samples=300), **options)
    assert "convergence" not in [g.finding for g in found.gates]
    pipeline = importlib.import_module("pilfr_casadi.diagnose.pipeline")  # `pilfr_casadi.diagnose` is the function
    monkeypatch.setattr(pipeline, "converge", lambda bench, fitted, _: replace(fitted, status=Status.MAX_ITERATIONS))
    found = pilfr.diagnose(rig(), recorded(rig(), 0, samples=300), **options)
    (note,) = (g for g in found.gates if g.finding == "convergence")
    assert "Not converged: the iteration limit was reached" in note.sentence
    assert note.sentence in str(found)
