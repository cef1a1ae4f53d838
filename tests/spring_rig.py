"""A mass on a spring, measured at position and velocity, and recordings of it with clocks that are wrong."""

import numpy as np

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.engine import make_engine
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator


def spring():
    """A mass on a spring, measured at position and velocity."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos, "vel": x.vel},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(120.0, bounds=(20, 500)), "d": Parameter(1.0, bounds=(0, 20))},
        ports=(Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel),),
    )


def shaken(hold, clock=0.0, m=3000, dt=0.02, law=None, early=0):
    """The spring recorded; `clock`: by how much each of the outputs' samples takes longer, `early`: how many early."""
    rng = np.random.default_rng(3)
    u = np.convolve(rng.standard_normal(m), np.ones(4) / 2, "same")
    true = spring().with_parameters({"k": Parameter(100.0), "d": Parameter(1.4)})
    true = true.with_element("ground", law) if law else true
    blank = Recording(u, rng.standard_normal((m, 2)), dt, ("force",), ("pos", "vel"), initial="zero")
    model = Workbench.of(true, [blank], hold).model(true)
    y = make_engine(model).simulate(model.drive(blank), model.parameters.start, np.zeros(2))[0]
    u, y = u[: m - early], y[early:]
    if clock:
        at = np.arange(m) * (1 + clock)
        u, y = u[at < m - 1], np.stack([np.interp(at[at < m - 1], np.arange(m), c) for c in y.T], axis=1)
    y = y + 1e-4 * y.std(axis=0) * rng.standard_normal(y.shape)
    return Recording(u, y, dt, ("force",), ("pos", "vel"), initial="zero")
