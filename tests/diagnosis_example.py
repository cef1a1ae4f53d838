"""A small rig with one law hidden in a port, its recordings, and its diagnosis filled in by hand."""

import functools
from dataclasses import replace

import numpy as np

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Diagnosis, Effect, Workbench, mismatch
from pilfr_casadi.diagnose.faults.gates import Gate
from pilfr_casadi.diagnose.result_text import Basis
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import BoucWen, CubicStiffness, Saturation
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator

DT, NOISE = 0.01, 1e-3


def rig(k=400.0, d=4.0, name="ground", outputs=("pos",)):
    """A mass on a spring, measured at its position (and velocity)."""
    return Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos - p.d * x.vel),
        lambda x: {n: x["vel" if n == "vel" else "pos"] for n in outputs},
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(k=Parameter(k, unit="N/m", bounds=(50, 2000)), d=Parameter(d, unit="N s/m", bounds=(0, 50))),
        ports=(Port(name, {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    )


def driven_rig(k=400.0, d=4.0):
    """The rig with a port whose term is the force of its drive."""
    plain = rig(k, d)
    drive = Port("force", {"vel": 1.0}, lambda x: x.pos, lambda x: x.vel, "N", "m", term=lambda u: u.force)
    return Simulator(
        plain.dynamics,
        plain.outputs,
        states=plain.states,
        inputs=plain.inputs,
        parameters=plain.parameters,
        ports=(*plain.ports, drive),
    )


LAWS = {
    "ground": CubicStiffness().at({"k_3": 2.0e4}),
    "hysteresis": BoucWen().at({"k_h": 300.0, "q_0": 0.02, "s": 0.5, "n": 1.0}),
    "actuator:force": Saturation().at({"L": 10.0}),
}
PAIRS = [("ground", "ground"), ("ground", "hysteresis"), ("actuator:force", "actuator:force")]


def recorded(true, seed, samples=700, noise=NOISE, **more):
    """A simulated recording with white noise, from rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) * DT
    tones = [np.cos(2 * np.pi * f * t + rng.uniform(0, 6.28)) for f in np.linspace(0.4, 6, 25)]
    u = (8 * np.sum(tones, axis=0) * (0.4 + 0.6 * t / t[-1]))[:, None] / 2
    blank = Recording(u, np.zeros((samples, len(true.output_names))), DT, ("force",), true.output_names, initial="zero")
    model = Workbench.of(true, [blank.with_(y=rng.standard_normal(blank.y.shape))], "zero").model(true)
    y = make_engine(model, "vm").simulate(model.drive(blank), model.parameters.start, np.zeros(model.n_state))[0]
    return blank.with_(y=y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape), **more)


def as_it_stands(bench, simulator):
    """Run a simulator at its own values along a bench's recordings."""
    fixed = {name: replace(p, fixed=True) for name, p in simulator.parameters.items()}
    return bench.fit(simulator.with_parameters(fixed))


@functools.cache  # nothing in it can be changed
def example(verdict="missing-physics", port="ground", law="ground", test=True, outputs=("pos",), **more):
    """A diagnosis as `diagnose` returns it, with the truth filled in by hand."""
    clean = rig(name=port if ":" not in port else "ground", outputs=outputs)
    true = clean.with_element(port, LAWS[law]) if verdict in ("missing-physics", "unexplained") else clean
    train, held_out = [recorded(true, s) for s in (0, 1)], recorded(true, 2, name="slow & steady")
    refit = rig(430.0, 5.0, clean.ports[0].name, outputs)
    element = LAWS[law]
    bench = Workbench.of(refit, train, "zero")
    before = as_it_stands(bench, refit)
    after = as_it_stands(bench, true) if verdict == "missing-physics" else before
    noise = NOISE * bench.scale
    effect = Effect(
        port,
        element.id,
        0.93,
        element.sentence,
        element.equation,
        {k: {"value": float(v), "std": 0.01 * abs(v), "unit": "N/m^3"} for k, v in element.values.items()},
        (("sensor:pos", "creep"),),
        element.form,
    )
    columns = ("port", "law", "form", "nrmse_train", "nrmse_validation", "delta_bic")
    tried = [
        (port, element.id, element.form, 1e-3, 1.1e-3, -900.0),
        ("sensor:pos", "creep", "", 1e-3, 1.2e-3, -880.0),
        ("sensor:pos", "delay", "", 0.2, np.inf, np.nan),
        *((port, f"law_{i}", "", 0.3, 0.3, 2.0) for i in range(15)),
    ]
    rows = [dict(zip(columns, row, strict=True)) for row in tried]
    named = verdict == "missing-physics"
    errors = {"nominal": 0.4, "before": 0.2, "after": NOISE if named else 0.2}
    fault = Gate("pos", "wrong_sign", -1.0, "The sign of pos is the wrong way round.", fault=True)
    gates = (fault, Gate("force", "hold", "linear", "Interpolated between samples fits better."))
    fields = dict(
        verdict=verdict,
        sentence={"missing-physics": f"The simulator leaves out {element.id} at {port}."}.get(
            verdict, f"It is {verdict}."
        ),
        effects=(effect,) if named else (),
        candidates=tuple(rows),
        gates=gates if verdict == "recording-fault" else (),
        mismatch=mismatch(
            train, before.residual, [e + r.y for e, r in zip(before.residual, train, strict=True)], noise, bench.scale
        ),
        parameters={
            n: {"nominal": v, "refit_without": 1.1 * v, "refit_with": np.asarray(v), "std": None, "unit": "N/m"}
            for n, v in {"k": 380.0, "d": 4.4}.items()
        },
        errors={"train": errors, "test": errors if test else None},
        floor={"nrmse": NOISE, "source": "estimated"},
        corrected=true if named else refit,
        refitted=refit,
        hold="zero",
        train=tuple(train),
        test=(held_out,) if test else (),
        seconds=3.0,
        evidence=Basis(without=before, after=after),
    )
    return Diagnosis(**{**fields, **more})
