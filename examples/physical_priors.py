"""Use priors on physical parameters: a short noisy push and a roughly known stiffness; validation selects the prior."""

import casadi as ca
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, ParameterSet


def step(x, u, w, p):
    """Advance a mass on a spring and a damper, pushed by u; w is the hysteretic force of the spring."""
    velocity = x[1] + 0.01 * (u[0] - p["k"] * x[0] - p["d"] * x[1] - w[0]) / p["m"]
    return ca.vertcat(x[0] + 0.01 * velocity, velocity), x[0]


def rig(k=400.0, d=15.0, prior=None):
    """Make the model with two stops; the mass is known, the stiffness may have a prior."""
    physics = {"m": Parameter(2.0, "kg", fixed=True), "d": Parameter(d, "N s/m", bounds=(0.0, 100.0))}
    physics["k"] = Parameter(k, "N/m", bounds=(0.0, 2000.0), prior=prior)
    opened = pilfr.open_model(step, lambda x, u, p: x[0], ParameterSet(physics), n_x=2, n_u=1, n_w=1)
    model = pilfr.close_loop(opened, pilfr.PrandtlIshlinskii(pilfr.Stop, 2))
    return model.with_parameters(model.parameters.change(w={"value": [[80.0, 40.0]]}, r={"value": [[0.01, 0.03]]}))


def record(seed, samples):
    """Simulate the rig with k = 300 and d = 10 and strong measurement noise."""
    rng, run = np.random.default_rng(seed), rig(300.0, 10.0)
    u, state, y = 10 * pilfr.multisine(samples, f_max=2.0, fs=100.0, rng=rng), np.zeros(4), np.zeros(samples)
    for k, value in enumerate(u):
        state, output = run.closed(state, value, run.parameters.start)
        y[k] = float(output)
    return pilfr.Recording(u, y + 0.3 * np.std(y) * rng.standard_normal(samples), dt=0.01, initial="zero")


train, validation = record(0, 100), record(1, 1000)
errors, fits = {}, {}
for std in (np.inf, 100.0, 30.0, 10.0, 3.0):  # N/m around 305: from no prior to a strong one
    prior = None if std == np.inf else (305.0, std)
    fits[std] = pilfr.fit(rig(prior=prior), train)
    errors[std] = fits[std].nrmse(validation)
    print(f"prior 305 ± {std:g}: k = {fits[std].parameters['k']:.0f} N/m, validation NRMSE {errors[std]:.4f}")
best = fits[min(errors, key=errors.get)]
print(best)
assert abs(best.parameters["k"] - 300) < abs(fits[np.inf].parameters["k"] - 300)
