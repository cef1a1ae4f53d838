"""A robot joint whose gear is elastic, simulated as rigid with friction and a delay that may hide the elasticity.

The truth is motor and link, a spring and a damper between them, and friction at the motor. Torque and motor angle are
recorded. The simulator is one inertia with free viscous and Coulomb friction and a free delay of the torque: refitted,
its damping and its delay take over what the elasticity does. Values are drawn anew for every seed.

    python -m problems.elastic_joint                     20 elastic joints, 5 rigid ones
    python -m problems.elastic_joint --cases 4           4 elastic joints, 1 rigid one
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator, diagnose
from pilfr_casadi.laws import CoulombFriction, Delay

DT, SAMPLES, FINE = 0.002, 3000, 10  # s, samples, steps of the truth in a sample
NOISE = 2e-5  # rad, an encoder of 16 bits
KNEE = 0.02  # rad/s


def simulator(inertia: float, damping: float, friction: float) -> Simulator:
    """Make the rigid joint with friction, and a delay of the torque."""

    def into(p: Any) -> dict[str, Any]:
        return {"speed": -1 / p.J}

    rigid = Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - p.d * x.speed) / p.J},
        lambda x: {"motor": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={
            "J": Parameter(inertia, unit="kg m^2", bounds=(inertia / 5, inertia * 5)),
            "d": Parameter(damping, unit="N m s/rad", bounds=(0.0, 50 * damping)),
        },
        ports=(Port("joint", into, lambda x: x.angle, lambda x: x.speed, unit="N m", across_unit="rad"),),
        hold="zero",
        units={"torque": "N m", "motor": "rad"},
    )
    friction_law = CoulombFriction().at({"F_c": friction, "v_0": KNEE})
    rubbing = rigid.with_element("joint", friction_law)
    return rubbing.with_element("actuator:torque", Delay().at({"T": DT}))


def recorded(seed: int, elastic: bool) -> tuple[Simulator, Recording, Recording]:
    """Draw a joint; return its simulator, with values off by up to a fifth, a training and a test recording."""
    rng = np.random.default_rng(seed)
    motor, link = rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0)
    damping, friction = rng.uniform(0.5, 3.0), rng.uniform(0.2, 1.0)
    resonance, ratio = 2 * np.pi * rng.uniform(8.0, 30.0), rng.uniform(0.02, 0.1)
    reduced = motor * link / (motor + link)
    stiffness, loss = reduced * resonance**2, 2 * ratio * reduced * resonance
    train, test = (_run(motor, link, damping, friction, stiffness, loss, elastic, rng) for _ in range(2))
    off = rng.uniform(0.8, 1.25, 3)
    return simulator((motor + link) * off[0], damping * off[1], friction * off[2]), train, test


def _run(
    motor: float,
    link: float,
    damping: float,
    friction: float,
    stiffness: float,
    loss: float,
    elastic: bool,
    rng: np.random.Generator,
) -> Recording:
    """Drive the joint with a multisine up to 40 Hz, from rest."""
    t, lines = DT * np.arange(SAMPLES), np.arange(1, int(40 * DT * SAMPLES))
    lines = rng.choice(lines, 40, replace=False)
    waves = np.cos(2 * np.pi * np.outer(t / t[-1], lines) + rng.uniform(0, 6.3, 40))
    u = 12 * (waves @ (1 / np.sqrt(40) * np.ones(40)))[:, None]
    x, w, torque = ca.SX.sym("x", 4), ca.SX.sym("w"), ca.SX.sym("u")
    twist = stiffness * (x[0] - x[2]) + loss * (x[1] - x[3]) if elastic else 0.0
    rubbing: Any = damping * x[1] + friction * ca.tanh(x[1] / KNEE)
    own = motor if elastic else motor + link
    slope = ca.vertcat(x[1], (torque - rubbing - twist) / own, x[3] if elastic else 0, twist / link if elastic else 0)
    f = ca.Function("f", [x, torque], [slope])
    h = DT / FINE
    now = x
    for _ in range(FINE):
        k1 = f(now, w)
        k2 = f(now + h / 2 * k1, w)
        k3 = f(now + h / 2 * k2, w)
        now = now + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(now + h * k3, w))
    step = ca.Function("step", [x, w], [now])
    states = np.asarray(step.mapaccum(SAMPLES)(np.zeros(4), u.T)).T
    y = np.vstack([[0.0], states[:-1, :1]]) + NOISE * rng.standard_normal((SAMPLES, 1))
    return Recording(u, y, DT, ("torque",), ("motor",), initial="zero", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20, help="elastic joints; a quarter as many rigid ones")
    parser.add_argument("--first", type=int, default=0, help="first case to run")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    kinds = [True] * options.cases + [False] * (options.cases // 4)
    right = delays = 0
    for seed, elastic in list(enumerate(kinds))[options.first :]:
        rig, train, test = recorded(seed, elastic)
        began = time.perf_counter()
        found = diagnose(rig, train, test=test, workers=options.workers)
        named = [(e.port, e.law) for e in found.effects]
        right += named == [("joint", "extra_mode")] if elastic else found.verdict == "complete"
        delays += any(law == "delay" for _, law in named)
        errors = found.errors["test"]
        assert errors is not None
        told = ", ".join(f"{e.law} ({e.form}) at {e.port} {e.confidence:.2f}" for e in found.effects) or found.verdict
        print(
            f"{seed:3} {'elastic' if elastic else 'rigid':8} {told:50} test {errors['before']:.4f} -> "
            f"{errors['after']:.4f}, noise {found.floor['nrmse']:.4f}, {time.perf_counter() - began:.0f} s",
            flush=True,
        )
    print(f"{right} of {len(kinds) - options.first} right; a delay was named {delays} times")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
