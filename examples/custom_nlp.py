"""A cost and constraints of one's own: a fit as CasADi expressions over the horizon, solved by any `casadi.nlpsol`."""

import casadi as ca
import numpy as np

import pilfr_casadi as pilfr

# a positioning stage: a play of half-width 0.3 behind a lag, a short record with a lot of noise
rng = np.random.default_rng(0)
u = pilfr.multisine(300, f_max=4.0, fs=100.0, rng=rng)
q, x, truth = 0.0, 0.0, np.zeros_like(u)
for k, value in enumerate(u):
    truth[k] = x
    q = pilfr.play(value, q, 0.3)
    x = 0.85 * x + 0.15 * q
record = pilfr.Recording(u, truth + 0.3 * rng.standard_normal(u.size), dt=0.01, initial="zero")

structure = pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 2), offset=False)
start = {"A": [[0.8]], "B_w": [[0.2]], "C_y": [[1.0]], "r": [[0.1, 0.4]]}
model = structure.model(n_u=1, n_y=1, values=start)
model = model.with_parameters(model.parameters.change(C_y={"fixed": True}, D_yw={"fixed": True}))
problem = pilfr.Problem(model, record)
free = pilfr.GaussNewton().solve(problem).theta

# what is known besides: the stage never left its travel, and its gain is 1 but for some per cent
nlp = problem.to_nlp()
p, y = nlp.parameters, nlp.simulated[0]
travel = np.max(np.abs(truth))
gain = p["B_w"] * ca.sum2(p["w"]) / (1 - p["A"])
cost, constraints = nlp.f + 0.05 * ((gain - 1) / 0.02) ** 2 / problem.residuals, ca.vertcat(nlp.g, y.T)

quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "hessian_approximation": "limited-memory"}}
solver = ca.nlpsol("solver", "ipopt", {"x": nlp.x, "f": cost, "g": constraints}, quiet)
limits = {"lbg": np.append(nlp.lbg, np.full(u.size, -travel)), "ubg": np.append(nlp.ubg, np.full(u.size, travel))}
theta = np.asarray(solver(x0=free, lbx=nlp.lbx, ubx=nlp.ubx, **limits)["x"]).ravel()


def judge(theta):
    """Largest position, and error against the noise-free truth."""
    simulated = problem.simulate(theta)[0][:, 0]
    return np.max(np.abs(simulated)), np.sqrt(np.mean((simulated - truth) ** 2)) / np.std(truth)


for name, values in (("free", free), ("with what is known", theta)):
    print("{:<20} largest position {:.4f}, error {:.4f}".format(name, *judge(values)))
print(f"travel {travel:.4f}, noise {0.3 / np.std(truth):.2f}")
assert solver.stats()["success"] and judge(theta)[0] <= travel + 1e-6 and judge(theta)[1] < judge(free)[1]
