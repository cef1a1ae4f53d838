"""Fits, simulators and files that the tests of exports, model files and figures share."""

import copy
from dataclasses import replace

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator, laws
from pilfr_casadi._base import ordered_digest
from pilfr_casadi.identify import Fit
from pilfr_casadi.laws import Local
from pilfr_casadi.models import (
    PILFR,
    GeneralizedPlay,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    Stop,
    close_loop,
    hammerstein,
    open_model,
)
from pilfr_casadi.optimise import Iteration, Solution, Status

M = 150  # samples of a wave
EVERY_LAW = (
    *(law for law in laws.CATALOGUE if not law.in_line),  # these need a term of the equations
    *(finer for kinds in laws.FINER.values() for finer in kinds),
)
CASES = {
    "play": (PILFR(3, PrandtlIshlinskii(Play, 4)), 1, 1),
    "stops, two channels": (
        PILFR(
            2,
            PrandtlIshlinskii(Stop, 3, 2),
            bounds={"w": (0, 2), "A": (-3.0, np.inf)},
            priors={"C_z": (0.0, 1.0)},
            offset=False,
        ),
        2,
        3,
    ),
    "generalized play": (PILFR(1, PrandtlIshlinskii(GeneralizedPlay(2), 3)), 1, 2),
    "rounded": (PILFR(2, PrandtlIshlinskii(Play, 3, rounded=True)), 1, 1),
    "linear": (PILFR(3), 2, 1),
    "hammerstein": (hammerstein(2, PrandtlIshlinskii(Play, 2)), 1, 1),
    "no states": (PILFR(0, PrandtlIshlinskii(Play, 3), fixed={"D_yu": 0.5}), 1, 1),
}


def some_fit(case="play", seed=0, engine="vm", **more):
    """A fit with random values, as if it had been estimated."""
    structure, n_u, n_y = CASES[case]
    rng = np.random.default_rng(seed)
    start = structure.model(n_u, n_y, inputs=tuple("ab"[:n_u]), outputs=tuple("xyz"[:n_y]))
    values = {name: np.clip(rng.normal(size=p.value.shape) / 3, *p.bounds) for name, p in start.parameters.items()}
    values |= {
        name: np.abs(rng.normal(size=p.value.shape)) for name, p in start.parameters.items() if name in ("w", "r")
    }
    values |= {name: p.value for name, p in start.parameters.items() if name in structure.fixed or name == "y_0"}
    model = structure.model(n_u, n_y, values, inputs=start.inputs, outputs=start.outputs)
    size = model.n_x + model.n_s
    labels = (
        *np.array(model.parameters.labels, dtype=object)[model.parameters.free],
        *(f"initial[0].{k}" for k in range(size)),
    )
    state = rng.normal(size=size)
    theta = np.concatenate([model.parameters.start[model.parameters.free], state])
    solution = Solution(
        theta,
        1e-5,
        Status.MAX_ITERATIONS,
        7,
        0.5,
        multipliers=rng.normal(size=theta.size),
        history=(Iteration(0, 1.0, 0.1), Iteration(1, np.inf, 0.2, 0.3, 1e-3)),
        message="told",
    )
    errors = {name: rng.uniform(size=p.value.shape) for name, p in model.parameters.items()}
    errors["C_y"] = np.full(errors["C_y"].shape, np.nan)
    errors["D_yu"] = np.full(errors["D_yu"].shape, np.inf)
    if "multipliers" in more:
        solution = replace(solution, multipliers=more.pop("multipliers"))
    fields = dict(
        train_nrmse=(0.01, np.inf),
        initial={"0123456789abcdef": state},
        labels=labels,
        errors=errors,
        active=("w[0] = 0",),
        units={"a": "V", "x": "µm"},
    )
    return Fit(model, structure, 1 / 120, solution, engine=engine, seconds=1.25, **(fields | more))


def recording_for(fitted, samples=200, initial="zero", seed=1):
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.normal(size=(samples, fitted.model.n_u)), axis=0)
    y = rng.normal(size=(samples, fitted.model.n_y))
    return Recording(u, y, fitted.dt, fitted.model.inputs, fitted.model.outputs, initial=initial)


def one_sentence(error):
    text = str(error.value)
    assert "\n" not in text and text.endswith(".") and not text.endswith(".."), text
    return text


def changed(content, path, value):
    """The content with the entry at a path replaced, or taken out where the value is `...`."""
    content = copy.deepcopy(content)
    parent = content
    for key in path[:-1]:
        parent = parent[key]
    if value is ...:
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    return content


def signed(content):
    """The content with the digest of what it now is."""
    content = {key: value for key, value in content.items() if key != "sha256"}
    return {**content, "sha256": ordered_digest(content)}


def leaves(content, path=()):
    yield path
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield from leaves(value, (*path, key))


def own_model(n=3):
    """A model of the user's own equations, with units."""
    p = ParameterSet({"k": Parameter(2.0, unit="N/m", bounds=(0, 5)), "d": Parameter([0.1, 0.2])})
    model = open_model(
        lambda x, u, w, p: (0.9 * x + p["k"] * u + w, x + p["d"][0] * u), lambda x, u, p: x, p, n_x=1, n_u=1, n_w=1
    )
    return close_loop(model, PrandtlIshlinskii(Play, n))


def linear(n_u, n_y, nx, seed=0):
    """Blocks of a stable linear part with everything in it."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(nx, nx))
    a *= 0.9 / max(1e-9, np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
    return {"A": a, "B_u": rng.normal(size=(nx, n_u)), "C_y": rng.normal(size=(n_y, nx)), "y_0": rng.normal(size=n_y)}


def as_fit(model, structure=None, dt=0.01):
    """A model as if it had been estimated."""
    return replace(some_fit(), model=model, structure=structure, initial={}, units={}, dt=dt)


def lfr(operator, nx, n, channels=1, n_u=1, n_y=1, seed=0, fixed=None):
    """A fit of a PI-LFR with such a linear part and an element that counts."""
    structure = PILFR(nx, PrandtlIshlinskii(operator, n, channels), fixed or {})
    rng, base = np.random.default_rng(seed + 1), structure.model(n_u, n_y)
    values = linear(n_u, n_y, nx, seed) | {
        "B_w": 0.1 * rng.normal(size=(nx, channels)),
        "D_yw": rng.normal(size=(n_y, channels)),
        "C_z": rng.normal(size=(channels, nx)),
        "D_zu": rng.normal(size=(channels, n_u)),
        "w": rng.uniform(0.1, 1.0, size=(channels, n)),
        "r": np.sort(rng.uniform(0.05, 2.0, size=(channels, n)), axis=1),
    }
    for name, known in structure.fixed.items():
        values[name] = np.where(np.isnan(known), values[name], known)
    return as_fit(structure.model(n_u, n_y, values, inputs=base.inputs, outputs=base.outputs), structure)


def mass_on_spring():
    """A mass on a spring and a damper, with a port between mass and ground."""

    def dynamics(x, u, p):
        return {"pos": x.vel, "vel": (u.force - 60 * x.pos - p.d * x.vel) / 1.2}

    port = Port("ground", {"vel": -1 / 1.2}, lambda x: x.pos, lambda x: x.vel, "N", "m")
    return Simulator(dynamics, lambda x: {"y": x.pos}, ("pos", "vel"), ("force",), {"d": Parameter(1.0)}, ports=(port,))


def dose(kind):
    """A law with a shape from its own grid, and strengths that matter."""
    t = np.arange(400) * 0.01
    z = 0.8 * np.sin(2 * np.pi * 1.3 * t) + 0.5 * np.sin(2 * np.pi * 3.1 * t + 1) + 0.05
    local = Local(z, np.gradient(z, 0.01), 0.01, (400,), np.inf, revolution=2 * np.pi)
    law = kind()
    law = law.at(next(iter(law.shapes(local))))
    law = law.at({k: 1.03 * v for k, v in law.values.items()}).at({}, law.bounds(local))  # off the kinks of its grid
    values = {name: np.asarray(law.parameters()[name].value) for name in law.strength}
    return law.at({name: 0.3 * np.ones(v.shape) if v.ndim else 0.3 for name, v in values.items()})


def with_law(kind):
    return mass_on_spring().with_element("ground" if "parallel" in kind.places else "sensor:y", dose(kind))


def wave(simulator, dt, amplitude=1.0):
    """Held steps of seeded inputs, at rest first."""
    rng = np.random.default_rng(3)
    n_u, n_y = len(simulator.inputs), len(simulator.output_names)
    steps = np.cumsum(rng.standard_normal((M // 6, n_u)), axis=0) * amplitude
    u = np.repeat(steps, 6, axis=0)[:M]
    return Recording(u, np.zeros((M, n_y)), dt, simulator.inputs, simulator.output_names, initial="zero")
