"""Random PI-LFRs, and a simulation of them written anew from Krikelis et al. (2024), for the tests of the core."""

import numpy as np

from pilfr_casadi.data import Recording, multisine
from pilfr_casadi.linear import resolvent
from pilfr_casadi.models import PILFR, GeneralizedPlay, Play, PrandtlIshlinskii, Stop, block_shapes


def random_lfr(seed, nx=3, n_u=1, n_y=1, n_w=1, n=4, operator=Play, radius=0.8, gain=0.1, **options):
    """A stable random PI-LFR: its structure and values by name; z moves over a few units for u of unit size."""
    rng = np.random.default_rng(seed)
    element = PrandtlIshlinskii(operator, n, n_w) if n_w else None
    structure = PILFR(nx, element, **options)
    values = {k: rng.normal(size=shape) for k, shape in block_shapes(nx, n_u, n_y, n_w).items()}
    if nx:
        values["A"] *= radius / np.max(np.abs(np.linalg.eigvals(values["A"])))
    for name in ("B_w", "D_yw"):
        values[name] *= gain
    if n_w:
        values |= {k: np.array(p.value) for k, p in element.parameters().items()}
        values["w"] = rng.uniform(0.1, 1.0, (n_w, n))
        values["r"] = np.sort(rng.uniform(0.05, 2.0, (n_w, n)))
        for name in values:
            if name.startswith("gamma_"):
                values[name] = values[name] + rng.uniform(0.0, 0.3, values[name].shape)
        while nx and _slipping(values) > max(1.01 * radius, 0.9):
            values["B_w"] = values["B_w"] / 2
    return structure, values


def _slipping(values):
    """Spectral radius with all operators slipping, or for stops all sticking."""
    return np.max(np.abs(np.linalg.eigvals(values["A"] + values["B_w"] * values["w"].sum(axis=1) @ values["C_z"])))


def random_input(seed, length=200, n_u=1):
    """A wandering input, (M, n_u), of about unit size."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(length, n_u))
    out = np.empty_like(steps)
    last = np.zeros(n_u)
    for k in range(length):
        last = 0.8 * last + 0.6 * steps[k]
        out[k] = last
    return out


def reference_step(operator, z, q, r, values, channel):
    """Eq. 3, 5 and 7, each as the paper writes it (errata applied): output and next play state."""
    if isinstance(operator, GeneralizedPlay) or operator is GeneralizedPlay:
        low, high = (envelope(values, side, channel, z) for side in ("l", "r"))
        v = max(low - r, min(max(high + r, low - r), q))
        return v, v
    if operator is Play:
        v = max(z - r, min(z + r, q))
        return v, v
    v = min(r, max(-r, z - q))
    return v, z - v


def envelope(values, side, channel, z):
    """γ of Eq. 14 as a network of tanh neurons."""
    c, a0, a, b, d = (values[f"gamma_{side}_{k}"][channel] for k in ("c", "a0", "a", "b", "d"))
    return float(c[0] + a0[0] * z + a @ np.tanh(b * z + d))


def reference(operator, values, u, state):
    """Eq. 15-16 sample by sample with scalars: y (M, n_y), z and w (M, n_w), last state with memory."""
    nx, (n_w, n) = len(values["A"]), values["w"].shape
    x, q = np.array(state[:nx]), np.array(state[nx:]).reshape(n_w, n)
    rows = []
    for u_k in u:
        z = values["C_z"] @ x + values["D_zu"] @ u_k
        w = np.zeros(n_w)
        for i in range(n_w):
            for j in range(n):
                v, q[i, j] = reference_step(operator, z[i], q[i, j], values["r"][i, j], values, i)
                w[i] += values["w"][i, j] * v
        rows.append((values["C_y"] @ x + values["D_yu"] @ u_k + values["D_yw"] @ w + values["y_0"], z, w))
        x = values["A"] @ x + values["B_u"] @ u_k + values["B_w"] @ w
    y, z, w = (np.array(column) for column in zip(*rows, strict=True))
    return y, z, w, np.concatenate([x, q.ravel()])


OPERATORS = (Play, Stop, GeneralizedPlay)


def coupled_plays(seed, samples=800):
    """Two plays that read a mode's position and push it, with noise of a hundredth of the output."""
    rng = np.random.default_rng(seed)
    u = multisine(samples, f_max=8, fs=100, rng=rng)
    A, r, x, q, y = np.array([[0.96, 0.18], [-0.18, 0.96]]) * 0.985, np.array([0.1, 0.5]), np.zeros(2), np.zeros(2), []
    for value in u:
        z = value + 0.5 * x[0]
        q = np.maximum(z - r, np.minimum(z + r, q))
        w = q @ [0.4, 0.3]
        y.append(x[0] + 0.1 * w)
        x = A @ x + np.array([0.05, 0.1]) * value + np.array([0.03, -0.08]) * w
    measured = np.array(y) + 0.01 * np.std(y) * rng.standard_normal(samples)
    return Recording(u, measured, 0.01, initial="zero")


def simulate_lti(system, u, x=None):
    """Output (M, n_y) of a control.StateSpace, sample by sample, from a state or from rest."""
    x, out = np.zeros(system.nstates) if x is None else x, []
    for u_k in u:
        out.append(system.C @ x + system.D @ u_k)
        x = system.A @ x + system.B @ u_k
    return np.array(out)


def frequency_response(system, frequency):
    """Response of a control.StateSpace at frequencies in Hz, (F, n_y, n_u); not finite at a pole."""
    z = np.exp(2j * np.pi * np.asarray(frequency) * system.dt)
    with np.errstate(divide="ignore", invalid="ignore"):
        return resolvent(np.asarray(system.A), np.asarray(system.C), z) @ np.asarray(system.B) + np.asarray(system.D)
