"""Track a path with a piezo stage: identify it, then plan with the model from an observer's state."""

import numpy as np

import pilfr_casadi as pilfr

DT, RANGE, HORIZON = 1e-3, (0.0, 100.0), 10  # s, V, samples


class Stage:
    """The machine: 200 Maxwell elements driven by the voltage, then a lag of 2 ms; output in µm."""

    def __init__(self):
        self.r, self.q, self.y = np.linspace(0.3, 60, 200), np.zeros(200), 0.0
        self.w = 0.35 * np.exp(-self.r / 20) / np.sum(np.exp(-self.r / 20))

    def advance(self, u):
        """Apply a voltage for one sample."""
        self.q = np.clip(self.q, u - self.r, u + self.r)
        self.y += (0.12 * (u - self.w @ (u - self.q)) - self.y) * (1 - np.exp(-DT / 2e-3))


def close_loop(control, measure, samples):
    """Run the machine with a controller; measurements have noise of 1 nm. Return the true output."""
    stage, noise, y = Stage(), np.random.default_rng(1), np.zeros(samples)
    for k in range(samples):
        y[k], u = stage.y, control(k)
        measure(k, u, stage.y + 0.001 * noise.standard_normal())
        stage.advance(u)
    return y


def tracking_error(fit):
    """Compute the rms error of predictive control with a fitted model, µm."""
    observer = pilfr.kalman_filter(fit, train, disturbance=True)
    plan = pilfr.PredictiveController(observer.function, HORIZON, inputs=RANGE, move=1e-4, u_scale=10)
    x, P, u_before = observer.x0, observer.Q, 0.0

    def control(k):
        return float(plan(x, path[k : k + HORIZON], u_before).u[0])

    def measure(k, u, y):
        nonlocal x, P, u_before
        x, P, _ = observer.step(x, P, u, y)
        u_before = u

    return np.sqrt(np.mean((close_loop(control, measure, 400) - path[:400])[50:] ** 2))


voltage = 50 + 16 * pilfr.multisine(3000, f_max=100.0, fs=1 / DT, rng=np.random.default_rng(0))
voltage = np.clip(voltage * np.minimum(1, np.arange(3000) / 200), *RANGE)
measured = np.zeros(3000)
close_loop(lambda k: voltage[k], lambda k, u, y: measured.__setitem__(k, y), 3000)
train = pilfr.Recording(voltage, measured, DT, initial="zero")
path = np.minimum(1, np.arange(500) / 50) * (5 + 3 * np.sin(2 * np.pi * 25 * DT * np.arange(500)))

linear = tracking_error(pilfr.fit(pilfr.PILFR(2), train))
hysteresis = tracking_error(pilfr.fit(pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 10)), train, starts=2))
print(f"rms tracking error: linear model {linear:.4f} µm, hysteresis model {hysteresis:.4f} µm")
assert hysteresis < 0.2 * linear
