"""Recordings of simulated machines."""

import numpy as np

from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import discretise


def outputs_of(machine, recording, hold="zero", substeps=1):
    """Outputs (M, n_y) of a machine at its values along a recording's inputs, from rest."""
    model = discretise(machine, recording.dt, hold, substeps)
    return make_engine(model).simulate(model.drive(recording), model.parameters.start, np.zeros(model.n_state))[0]
