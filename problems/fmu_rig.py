"""A two-mass rig with dry friction in its guide, diagnosed from equations and from functional mock-up units.

The units lack the friction, as the equations do. One is written by hand in C (`fmu_rig.c`, FMI 2.0), one exported by
CasADi (FMI 3.0), and one is for co-simulation, built by PythonFMU (`fmu_rig_slave.py`).
`python -m problems.fmu_rig --cases 20` prints the verdict, port and law of each, and the time beside that of the
equations, loading included.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator, diagnose, from_fmu
from pilfr_casadi.engine import compiler
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.simulators import CoSimulation

HERE = Path(__file__).parent
PARAMETERS = {"k1": (380.0, 100, 2000), "k2": (1000.0, 200, 5000), "d1": (2.3, 0, 50), "d2": (1.3, 0, 50)}
UNITS = {"k1": "N/m", "k2": "N/m", "d1": "N.s/m", "d2": "N.s/m"}
MASSES = {"m1": 1.2, "m2": 0.8}
GUIDE = {"guide": {"into": "guide_force", "across": "pos1", "rate": "vel1"}}
FOLDER = {"linux": "linux64", "darwin": "darwin64", "win32": "win64"}.get(sys.platform, "linux64")
SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
FRICTION = {"F_c": 3.0, "v_0": 0.002}


def rig() -> Simulator:
    """The same rig as equations."""

    def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
        inner = p.k2 * (x.x1 - x.x2) + p.d2 * (x.v1 - x.v2)
        outer = p.k1 * x.x1 + p.d1 * x.v1
        return dict(x1=x.v1, v1=(u.force - outer - inner) / MASSES["m1"], x2=x.v2, v2=inner / MASSES["m2"])

    return Simulator(
        dynamics,
        lambda x: dict(pos1=x.x1, pos2=x.x2),
        ("x1", "v1", "x2", "v2"),
        ("force",),
        {name: Parameter(value, UNITS[name], (low, high)) for name, (value, low, high) in PARAMETERS.items()},
        (Port("guide", dict(v1=-1 / MASSES["m1"]), lambda x: x.x1, lambda x: x.v1, "N", "m"),),
    )


def recording(
    seed: Any, law: CoulombFriction | None = None, samples: int = 1500, dt: float = 2e-3, noise: float = 1e-3
) -> Recording:
    """A recording of the rig with a law in its guide, from rest."""
    rng, true = np.random.default_rng(seed), rig()
    true = true.with_element("guide", law) if law is not None else true
    t = np.arange(samples) * dt
    tones = zip(rng.uniform(2, 6, 12), rng.uniform(0.3, 12, 12), rng.uniform(0, 2 * np.pi, 12), strict=True)
    u = sum(a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in tones)[:, None]
    blank = Recording(u, np.zeros((samples, 2)), dt, ("force",), ("pos1", "pos2"), initial="zero", hold="zero")
    y = true.simulate(blank)
    return blank.with_(y=y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape))


def _variable(
    name: str,
    reference: int,
    causality: str,
    variability: str = "continuous",
    unit: str = "",
    more: str = "",
    numbers: str = "",
) -> str:
    unit = f' unit="{unit}"' if unit else ""
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability}"{more}><Real{unit}{numbers}/></ScalarVariable>'
    )


def description(kind: str = "ModelExchange", version: str = "2.0") -> str:
    """modelDescription.xml of the rig in C."""
    variables = [
        _variable(n, i, "parameter", "tunable", UNITS[n], ' initial="exact"', f' start="{v}" min="{low}" max="{high}"')
        for i, (n, (v, low, high)) in enumerate(PARAMETERS.items())
    ]
    variables += [
        _variable(n, 4 + i, "parameter", "fixed", "kg", ' initial="exact"', f' start="{v}"')
        for i, (n, v) in enumerate(MASSES.items())
    ]
    states = ("x1", "v1", "x2", "v2")
    variables += [
        _variable(n, 6 + i, "local", more=' initial="exact"', numbers=' start="0"') for i, n in enumerate(states)
    ]
    variables += [
        _variable(f"der({n})", 10 + i, "local", numbers=f' derivative="{7 + i}"') for i, n in enumerate(states)
    ]
    variables += [_variable("force", 14, "input", unit="N", numbers=' start="0"')]
    variables += [_variable("guide_force", 15, "input", unit="N", numbers=' start="0"')]
    outputs = (("pos1", "m"), ("pos2", "m"), ("vel1", "m/s"), ("power", ""))
    variables += [_variable(n, 16 + i, "output", unit=unit) for i, (n, unit) in enumerate(outputs)]
    units = "".join(f'<Unit name="{u}"/>' for u in ("N/m", "N.s/m", "kg", "N", "m", "m/s"))
    places = {"y": range(17, 21), "x": range(11, 15)}
    listed = {k: "".join(f'<Unknown index="{i}"/>' for i in at) for k, at in places.items()}
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{version}" modelName="rig" guid="rig" numberOfEventIndicators="0">
<{kind} modelIdentifier="rig"/>
<UnitDefinitions>{units}</UnitDefinitions>
<ModelVariables>{"".join(variables)}</ModelVariables>
<ModelStructure><Outputs>{listed["y"]}</Outputs><Derivatives>{listed["x"]}</Derivatives>
<InitialUnknowns>{listed["x"]}{listed["y"]}</InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""


def c_rig(path: Path, *defined: str, folder: str = FOLDER, **described: str) -> Path:
    """Write the rig of `fmu_rig.c`; `defined` are macros of its compilation."""
    library = Path(path).with_suffix(".lib")
    command = [compiler() or "cc", "-O2", "-fPIC", "-shared", *(f"-D{name}" for name in defined)]
    subprocess.run([*command, str(HERE / "fmu_rig.c"), "-o", str(library)], check=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(**described))
        archive.write(
            library, f"binaries/{folder}/rig{ {'darwin': '.dylib', 'win32': '.dll'}.get(sys.platform, '.so') }"
        )
    library.unlink()
    return Path(path)


def casadi_rig(path: Path) -> Path:
    """Write the rig as CasADi exports it, with FMPy's copy of the standard's headers; in the working folder."""
    import fmpy

    model = ca.DaeBuilder("rig")
    x1, v1, x2, v2 = (model.add(name, "local") for name in ("x1", "v1", "x2", "v2"))
    force, guide = (model.add(name, "input") for name in ("force", "guide_force"))
    p = {
        n: model.add(n, "parameter", "tunable", {"start": v, "min": low, "max": high, "unit": UNITS[n]})
        for n, (v, low, high) in PARAMETERS.items()
    }
    inner = p["k2"] * (x1 - x2) + p["d2"] * (v1 - v2)
    model.eq(model.der(x1), v1)
    model.eq(model.der(v1), (force + guide - p["k1"] * x1 - p["d1"] * v1 - inner) / MASSES["m1"])
    model.eq(model.der(x2), v2)
    model.eq(model.der(v2), inner / MASSES["m2"])
    for name, value in (("pos1", x1), ("pos2", x2), ("vel1", v1), ("power", force**2)):
        model.eq(model.add(name, "output"), value)
    files = model.export_fmu()
    headers = Path(fmpy.__file__).parent / "c-code"
    files = model.compile_fmu(files, {"include_dirs": [str(headers)], "compiler_options": {"flags": ["-O2"]}})
    model.pack_fmu(files, {"path": str(path)})
    return Path(path)


def python_rig(path: Path) -> Path:
    """Write the rig for co-simulation by PythonFMU."""
    from pythonfmu.builder import FmuBuilder

    built = Path(FmuBuilder.build_FMU(HERE / "fmu_rig_slave.py", dest=path.parent))
    return built.replace(path)


def load(kind: str, path: Path) -> Simulator:
    """Make the simulator of a unit; one of PythonFMU states neither bounds nor step size."""
    more: dict[str, Any] = {}
    if kind == "pythonfmu":
        bounds = {n: (low, high) for n, (_, low, high) in PARAMETERS.items()}
        more = {"bounds": bounds, "cosimulation": CoSimulation(dt=2e-3)}
    return from_fmu(path, ports=GUIDE, outputs=("pos1", "pos2"), **more)


def answer(simulator: Simulator, seed: int) -> tuple[tuple[Any, ...], float]:
    """Diagnose the rig on a recording of a seed; return verdict and effects, and the seconds that it took."""
    train, test = (recording([seed, k], CoulombFriction(FRICTION)) for k in range(2))
    begin = time.perf_counter()
    found = diagnose(simulator, [train], test=[test], hold="zero")
    effects = tuple((effect.port, effect.law) for effect in found.effects)
    return (found.verdict, *effects), time.perf_counter() - begin


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 0 where the units are answered as the equations in all cases but one of twenty."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=3, help="number of seeds (default: 3)")
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument(
        "--kinds", nargs="+", default=["c"], choices=["c", "casadi", "pythonfmu"], help="units (default: c)"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        makers = {"c": c_rig, "casadi": casadi_rig, "pythonfmu": python_rig}
        files = {kind: makers[kind](Path(folder) / f"{kind}.fmu") for kind in options.kinds}
        same, ratios = dict.fromkeys(files, 0), {kind: list[float]() for kind in files}
        for seed in range(options.first, options.first + options.cases):
            wanted, seconds = answer(rig(), seed)
            print(f"{seed:3} equations {seconds:6.1f} s  {wanted}", flush=True)
            for kind, path in files.items():
                begin = time.perf_counter()
                unit = load(kind, path)
                loading = time.perf_counter() - begin
                found, longer = answer(unit, seed)
                longer += loading
                same[kind] += found == wanted
                ratios[kind].append(longer / seconds)
                print(f"    {kind:9} {longer:6.1f} s  {found}; loaded in {loading:.1f} s", flush=True)
        for kind in files:
            ratio = np.median(ratios[kind])
            print(f"{kind}: {same[kind]} of {options.cases} as the equations; {ratio:.1f} times the time")
        os.chdir(HERE)
    return int(min(same.values()) < options.cases * 19 / 20)


if __name__ == "__main__":
    sys.exit(main())
