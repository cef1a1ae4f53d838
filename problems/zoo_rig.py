"""The grey-box case of the zoo: the rig's own equations, with stops in the open port of its hysteretic spring."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi.models import Model, Parameter, ParameterSet, PrandtlIshlinskii, Stop, close_loop, open_model

from . import masing, masing_data
from .zoo_case import Case


def rig_with_open_spring(stops: int = 10) -> Model:
    """The rig's equations (Krikelis et al. (2024), Eq. 25) in Runge-Kutta steps, stops on a fixed grid for its spring.

    The spring's force is held over a step, so it is read at the middle of it, `z = x1 + h v1 / 2`. That and the few
    stops keep the fit above the noise floor.
    """
    rig, h = masing.MasingRig(), 1.0 / masing_data.FS
    physical = {
        "k1": Parameter(1.2 * rig.k1, "N/m", (200.0, 4000.0)),
        "d1": Parameter(0.8 * rig.d1, "N s/m", (0.0, 100.0)),
        "k2": Parameter(0.8 * rig.k2, "N/m", (2000.0, 40000.0)),
        "d2": Parameter(1.2 * rig.d2, "N s/m", (0.0, 200.0)),
    }

    def rates(x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
        link = p["k2"] * (x[0] - x[2]) + p["d2"] * (x[1] - x[3])
        ground = p["k1"] * x[0] + p["d1"] * x[1] + w
        return ca.vertcat(x[1], -(ground + link) / rig.m1, x[3], (u + link) / rig.m2)

    def step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
        a = rates(x, u, w, p)
        b = rates(x + h / 2 * a, u, w, p)
        c = rates(x + h / 2 * b, u, w, p)
        d = rates(x + h * c, u, w, p)
        return x + h / 6 * (a + 2 * b + 2 * c + d), x[2]

    def port(x: Any, u: Any, p: dict[str, Any]) -> Any:
        return x[0] + h / 2 * x[1]

    names = ("x1", "v1", "x2", "v2")
    model = open_model(step, port, ParameterSet(physical), n_x=4, n_u=1, n_w=1, states=names, outputs=("x2",))
    model = close_loop(model, PrandtlIshlinskii(Stop, stops))
    r = 1e-3 * (np.arange(1, stops + 1) / stops) ** 1.5
    start: dict[str, dict[str, Any]] = {
        "w": {"value": np.full((1, stops), 200.0)},
        "r": {"value": r[None, :], "fixed": True},
    }
    return model.with_parameters(model.parameters.change(**start))


def masing_grey(seed: int = 0) -> Case:
    """The rig of `masing` with its hysteretic spring's port open: physical parameters 20 % off, weights all alike."""
    data = masing_data.benchmark(seed)
    rig = masing.MasingRig()
    truth = {name: getattr(rig, name) for name in ("k1", "d1", "k2", "d2")}
    return Case(
        rig_with_open_spring(),
        (data.records["train"],),
        (data.truth["train"].x2[:, None],),
        truth,
        exact=False,
        remark="few stops, and one step a sample",
    )
