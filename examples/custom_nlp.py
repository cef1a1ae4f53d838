"""Use your own cost and constraints: a fit as CasADi expressions over the horizon, solved by any `casadi.nlpsol`."""

import casadi as ca
import numpy as np

import pilfr_casadi as pilfr

# a positioning stage: a play of half-width 0.3 behind a lag of gain 1, a short record with a lot of noise
rng = np.random.default_rng(0)
u = pilfr.multisine(300, f_max=4.0, fs=100.0, rng=rng)
q, x, truth = 0.0, 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    truth[k] = x
    q = pilfr.play(value, q, 0.3)
    x = 0.85 * x + 0.15 * q
record = pilfr.Recording(u, truth + 0.3 * rng.standard_normal(u.size), dt=0.01, initial="zero")

element = pilfr.PrandtlIshlinskii(pilfr.Play, 2)
structure = pilfr.hammerstein(1, element, offset=False)
model = structure.model(n_u=1, n_y=1, values={"A": [[0.8]], "B_w": [[0.2]], "C_y": [[1.0]], "r": [[0.1, 0.4]]})
model = model.with_parameters(model.parameters.change(C_y={"fixed": True}, D_yw={"fixed": True}, B_w={"fixed": True}))
problem = pilfr.Problem(model, record)
free = pilfr.GaussNewton().solve(problem).theta

# further knowledge: the gain within 2 %, and the stage never left its travel
nlp = problem.to_nlp()
p, y = nlp.parameters, nlp.simulated[0]
travel = np.max(np.abs(truth))
gain = p["B_w"] * ca.sum2(p["w"]) / (1 - p["A"])
noise = 0.3 / problem.scale[0]
e = ca.vertcat(nlp.residual, noise * (gain - 1) / 0.02)
slope = ca.jacobian(e, nlp.x)
weight, multipliers = ca.MX.sym("weight"), ca.MX.sym("multipliers", y.numel())
hessian = weight * (slope.T @ slope + 0.1 * ca.diag(ca.sum1(slope**2)))  # Gauss-Newton, damped
hess_lag = ca.Function("hess_lag", [nlp.x, ca.MX(0, 1), weight, multipliers], [ca.triu(hessian)])

# plays have kinks, at which a gradient need not vanish: stop when the cost no longer changes
ipopt = {"acceptable_tol": 10.0, "acceptable_obj_change_tol": 1e-8, "acceptable_constr_viol_tol": 1e-8}
ipopt |= {"print_level": 0, "sb": "yes", "mu_init": 1e-3}
options = {"hess_lag": hess_lag, "print_time": False, "ipopt": ipopt}
solver = ca.nlpsol("solver", "ipopt", {"x": nlp.x, "f": 0.5 * ca.sumsqr(e), "g": y.T}, options)
found = solver(x0=free, lbx=nlp.lbx, ubx=nlp.ubx, lbg=-travel, ubg=travel)


def judge(theta):
    """Compute the largest position, and the error against the noise-free output."""
    simulated = problem.simulate(theta)[0][:, 0]
    return np.max(np.abs(simulated)), np.sqrt(np.mean((simulated - truth) ** 2)) / np.std(truth)


theta = np.asarray(found["x"]).ravel()
for name, values in (("free", free), ("with what is known", theta)):
    print("{:<20} largest position {:.4f}, error {:.4f}".format(name, *judge(values)))
print(f"travel {travel:.4f}, noise {0.3 / np.std(truth):.2f}")
assert solver.stats()["success"] and judge(theta)[0] <= travel + 1e-6 and judge(theta)[1] < judge(free)[1]
