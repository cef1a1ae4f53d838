"""A tiny machine and hypotheses about it: real objects, with errors as a test states them."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from cart import GROUND, cart

from pilfr_casadi import Recording, multisine
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.search.hypotheses import Findings, Hypotheses
from pilfr_casadi.diagnose.search.trials import Trial
from pilfr_casadi.laws import CubicStiffness, Delay

DT, SAMPLES = 0.05, 200
NOISE2 = 1e-6  # mean square of the noise, over the outputs' variance
STIFF = 1e3  # N/m^3, of a spring that stiffens; other strengths are one


@pytest.fixture(scope="session")
def tiny():
    """A cart with the ports a, b and c, refitted to a recording of one whose spring stiffens: workbench and refit."""
    simulator = cart(ports=[replace(GROUND, name=name) for name in "abc"])
    u = 10 * multisine(SAMPLES, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(0))
    r = Recording(u, u, DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = simulator.with_element("a", CubicStiffness().at({"k_3": STIFF})).simulate(r)
    bench = Workbench.of(simulator, [r.with_(y=y)], "zero", "vm")
    return bench, bench.fit(simulator)


def at_error(bench, fitted, error):
    """A fit that is off by an rms error, now up and now down."""
    residual = [error * bench.scale * np.resize([[1.0], [-1.0]], e.shape) for e in fitted.residual]
    return replace(fitted, cost=error**2, squares=np.array([error**2]), residual=residual)


@pytest.fixture(scope="session")
def hypothesis(tiny):
    """Make a hypothesis of (port, class of law), with a stated rms error and stated values of the last law."""
    bench, refit = tiny

    @functools.cache
    def run(*laws):
        simulator = bench.simulator
        for port, kind in laws:
            own = dict.fromkeys(kind.strength, STIFF if kind is CubicStiffness else 1.0)
            simulator = simulator.with_element(port, kind({"T": DT} if kind is Delay else own))
        return bench.run(simulator, {}, refit.begin)

    def make(*laws, error, **own):
        fitted = at_error(bench, run(*laws), error)
        if own:
            fitted = replace(fitted, values={**fitted.values, **fitted.simulator.elements[-1].named(own)})
        return Trial(fitted.last_elements(len(laws)), fitted, error**2, error**2, True, np.zeros(0))

    return make


@pytest.fixture(scope="session")
def hypotheses(tiny):
    """Put hypotheses beside the simulator alone, whose error is all of the outputs' deviation.

    At every port a flexible force would follow none of their errors.
    """
    bench, refit = tiny

    def put(*trials):
        floor = Floor(NOISE2**0.5 * bench.scale, "repeats")
        found = Hypotheses(bench, refit, floor, (), 1, Stages(lambda *_: None), count=400.0)
        for trial in (Trial((), at_error(bench, refit, 1.0), 1.0, 1.0, True, np.zeros(0)), *trials):
            found.keep(trial)
            found.findings[trial.key] = Findings(flexible={"a": 0.0, "b": 0.0})
        return found

    return put
