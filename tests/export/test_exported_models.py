"""The exported function, generated C, python-control and the simulation agree on every model."""

import ctypes
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from exported_fits import EVERY_LAW, M, as_fit, dose, lfr, mass_on_spring, wave, with_law

from pilfr_casadi import (
    NARX,
    PILFR,
    Combined,
    Envelope,
    GeneralizedPlay,
    Parameter,
    Part,
    Play,
    PrandtlIshlinskii,
    Products,
    Recording,
    Stop,
    close_loop,
    exported,
    network_lfr,
    ssnn,
)
from pilfr_casadi.engine import VirtualMachine, compiler
from pilfr_casadi.laws import CubicStiffness, StopHysteresis, carried, heated
from pilfr_casadi.linear import modal
from pilfr_casadi.models import ParameterSet
from pilfr_casadi.simulators import discretise, fastest_rates, load_simulator
from problems import emps, masing_diagnosis, piezo_diagnosis, silverbox, tanks
from problems.concealed_rigs_more import RIGS
from problems.zoo import CASES

LIBRARY_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-ffp-contract=off", "-fPIC", "-shared")
NETWORKS = {
    "ssnn": (ssnn(2, 2), 1),
    "network_lfr": (network_lfr(2, 3), 1),
    "NARX": (NARX(2, 3).structure(1, 1), 1),
    "wide NARX": (NARX(2, 3, input_lags=3).structure(2, 2), 2),
}


def combined():
    """A PI-LFR with an envelope in the feedback, products, and plays at the inputs."""
    parts = (
        Part("envelope", Envelope(2), (0, 1)),
        Part("products", Products(2, (2,)), (0, 1)),
        Part("input", PrandtlIshlinskii(Play, 2, 2), (2, 3), (0, 1)),
    )
    return PILFR(4, Combined(parts), {"envelope_reach": 50.0, "products_reach": 10.0}, {"envelope_rate": (1e-3, 0.5)})


def random_fit(structure, n_io, seed=7):
    """A fit of a structure at random values inside its bounds, with a stable A."""
    rng, model = np.random.default_rng(seed), structure.model(n_io, n_io)
    values = {}
    for name, p in model.parameters.items():
        drawn = np.clip(0.2 * rng.normal(size=p.value.shape), *p.bounds)
        values[name] = np.where(p.fixed, p.value, 0.3 * drawn if name == "A" else drawn)
    return as_fit(
        model.with_parameters(model.parameters.change(**{k: {"value": v} for k, v in values.items()})), structure
    )


def other_structures():
    """Name -> fit of further structures: modal coordinates, combined elements, networks."""
    networks = {f"network {name}": random_fit(*given) for name, given in NETWORKS.items()}
    return {
        "modal coordinates": lfr(Play, 5, 4, fixed={"A": modal(5)}),
        "combined": random_fit(combined(), 2),
        **networks,  # a NOE is a NARX with other values
    }


def from_zoo(make):
    """A case of the zoo as a fit at its start, from rest."""
    case = make()
    p = case.model.parameters
    if "B_w" in p:  # shut at the start
        rng = np.random.default_rng(0)
        p = p.change(**{k: {"value": 0.05 * rng.normal(size=p[k].shape)} for k in ("B_w",) if not np.all(p[k].fixed)})
    model = case.model.with_parameters(p)
    r = case.recordings[0]
    return as_fit(model, dt=r.dt), r.slice(0, min(len(r), 2 * M)).with_(initial="zero", skip=0)


def from_rig(rig):
    """A base rig of the concealed cases in the middle of its parameters' ranges."""
    texts = {n: f"Parameter({float(np.sqrt(low * high))!r})" for n, (low, high, _, _) in rig.parameters.items()}
    return rig.module(rig.source(texts))["simulator"]


def pace(simulator):
    """A step that suits a simulator's fastest mode."""
    p = ParameterSet(dict(simulator.parameters)).start
    rate = fastest_rates(simulator, np.full((1, len(simulator.states)), 0.1), np.zeros((1, len(simulator.inputs))), p)[
        0
    ]
    return 0.3 / rate if np.isfinite(rate) and rate > 0 else 0.01


def simulators(every):
    """Name -> simulator, step, hold, sub-steps (None: chosen)."""
    laws = EVERY_LAW if every else EVERY_LAW[::5]
    out = {f"law {kind.__name__}": (with_law(kind), 0.02, "zero", 2) for kind in laws}
    named = {"masing": masing_diagnosis.simulator()}
    if every:
        named |= {
            "silverbox": silverbox.simulator(),
            "emps": emps.simulator(),
            "tanks": tanks.simulator(False),
            "root tanks": tanks.simulator(True),
            "piezo": piezo_diagnosis.simulator(),
            "demo": load_simulator("pilfr_casadi/cli/demo_data/rig.py"),
            **{f"rig {name}": from_rig(rig) for name, rig in RIGS.items()},
        }
    out |= {name: (s, pace(s), "zero", None) for name, s in named.items()}
    spring = named["masing"].with_element("ground-m1", dose(StopHysteresis))
    out["masing, corrected"] = spring.with_element("ground-m2", dose(CubicStiffness)), 1 / 120, "zero", None
    out["interpolated"] = mass_on_spring().with_element("ground", dose(StopHysteresis)), 0.02, "linear", 3
    out["many sub-steps"] = mass_on_spring().with_element("ground", dose(StopHysteresis)), 0.05, "linear", 9
    heat = {"c": -0.5, "T": 0.5, "s_2": 4.0}
    out["a warm damper"] = mass_on_spring().with_element("parameter:d", heated("vel")().at(heat)), 0.02, "zero", 2
    oily = mass_on_spring().with_parameters({"d": Parameter(1.0, bounds=(0, 10))})  # its viscosity falls exponentially
    out["warm oil"] = oily.with_element("parameter:d", heated("force")().at(heat)), 0.02, "zero", 2
    pipe = carried("force")().at({"V": 2.0})
    out["a signal in a pipe"] = mass_on_spring().with_element("sensor:y", pipe), 0.02, "zero", None
    element = PrandtlIshlinskii(Stop, 3)
    out["stops in a port"] = close_loop(mass_on_spring(), element, "ground"), 0.02, "zero", None
    return out


def exports(every):
    """Name -> (exported, recording, simulated outputs); without `every` one or a few of each kind."""
    out = {}
    fits = {
        "5 states, 20 plays": lfr(Play, 5, 20),
        "static stack": lfr(Play, 0, 20),
        "stops, two channels": lfr(Stop, 2, 4, 2, 2, 3),
        "generalized plays": lfr(GeneralizedPlay(2), 2, 3, 2, 1, 2),
        **other_structures(),
    }
    for name, fitted in fits.items():
        rng = np.random.default_rng(2)
        u = np.cumsum(rng.normal(size=(M, fitted.model.n_u)), axis=0) / 3
        x0 = rng.normal(size=fitted.model.n_x + fitted.model.n_s)
        x0[fitted.model.n_x :] = np.abs(x0[fitted.model.n_x :])  # the mean squares of an envelope are not negative
        data = Recording(
            u, np.zeros((M, fitted.model.n_y)), 0.01, fitted.model.inputs, fitted.model.outputs, initial=x0
        )
        out[name] = fitted, {"start": data}, data, replace(fitted, engine="vm").simulate(data)
    for name, make in CASES.items() if every else ():
        fitted, data = from_zoo(make)
        out[f"zoo {name}"] = fitted, {}, data, replace(fitted, engine="vm").simulate(data)
    grey = mass_on_spring().with_element("ground", dose(StopHysteresis))  # a fit of a simulator's model
    fitted = as_fit(discretise(grey, 0.02, "linear", 3), dt=0.02)
    data = wave(grey, 0.02, 3.0)
    out["fit with sub-steps"] = fitted, {}, data, replace(fitted, engine="vm").simulate(data)
    for name, (simulator, dt, hold, substeps) in simulators(every).items():
        data = wave(simulator, dt, 3.0 if name.startswith("law") else 1.0)
        given = {"dt": dt, "hold": hold, "substeps": substeps}
        used = exported(simulator, **given).substeps
        model = discretise(simulator, dt, hold, used)
        run = VirtualMachine(model).simulate(model.drive(data), model.parameters.start, np.zeros(model.n_state))
        out[name] = simulator, given, data, run[0]
    named = {key: f"case{i}" for i, key in enumerate(out)}
    return {k: (exported(m, name=named[k], **given), r, y) for k, (m, given, r, y) in out.items()}


@pytest.fixture(scope="module", params=["some", pytest.param("every", marks=pytest.mark.slow)])
def models(request):
    return exports(every=request.param == "every")


@pytest.fixture(scope="module")
def library(models, tmp_path_factory):
    """The C of all models in one library, compiled with every warning an error."""
    if compiler() is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("c")
    sources = [str(e.to_c(folder)[0]) for e, _, _ in models.values()]
    path = folder / "all.so"
    subprocess.run([compiler(), *LIBRARY_FLAGS, "-o", path, *sources, "-lm"], check=True, capture_output=True)
    return ctypes.CDLL(str(path))


def agree(found, expected):
    assert np.all(np.isfinite(expected)) and np.ptp(expected) > 0
    size, apart = np.max(np.abs(expected), axis=0), np.max(np.abs(found - expected), axis=0)
    np.testing.assert_array_less(apart, 1e-10 * size + 1e-300)
    return float(np.max(apart / np.maximum(size, 1e-300)))


def tell(what, apart):
    print(f"\n{what} beside the simulation: {len(apart)} models, at most {max(apart):.1e} of the output's size apart")


def test_states_and_signals_have_names(models):
    for name, (model, _, _) in models.items():
        assert list(model.states.values()) == list(range(model.step.size1_in("x"))), name
        assert model.step.size1_in("u") == len(model.inputs) and model.step.size1_out("y") == len(model.outputs)


def test_the_function_agrees_with_the_simulation(models):
    apart = []
    for model, data, expected in models.values():
        x, rows = model.x0(), []
        for u in model.drive(data):
            x, y = model.step(x, u)
            rows.append(np.asarray(y).ravel())
        apart.append(agree(np.array(rows), expected))
    tell("CasADi function", apart)


def test_c_agrees_with_the_simulation(models, library):
    vector, apart = np.ctypeslib.ndpointer(dtype=np.float64, flags="C"), []
    for model, data, expected in models.values():
        step, begin = (getattr(library, f"{model.name}_{what}") for what in ("step", "x0"))
        step.argtypes, begin.argtypes = [vector] * 4, [vector]
        step.restype = begin.restype = None
        x, y, rows = np.full(max(1, len(model.states)), np.nan), np.zeros(len(model.outputs)), []
        begin(x)
        assert np.array_equal(x[: len(model.states)], model.x0())
        for u in model.drive(data):
            step(x, np.ascontiguousarray(u), x, y)
            rows.append(y.copy())
        apart.append(agree(np.array(rows), expected))
    tell("C", apart)


def test_control_agrees_with_the_simulation(models):
    import control

    apart = []
    for model, data, expected in models.values():
        system, u = model.to_control(), model.drive(data)
        assert (system.dt, system.ninputs, system.noutputs) == (model.dt, len(model.inputs), len(model.outputs))
        assert system.nstates == len(model.states)
        found = control.input_output_response(system, np.arange(len(u)) * model.dt, u.T, X0=model.x0())
        apart.append(agree(found.outputs.reshape(len(model.outputs), -1).T, expected))
    tell("control system", apart)
