"""One step over a whole sample, `(x, u) -> (x_next, y)`, of any closed model.

A model steps from sub-step to sub-step and may read the input at the sub-step's end and the time (`Model.reads`). Here
the sub-steps of a sample are run one after the other, y being the outputs at the first. What a caller has to give stays
plain: `u` is the input that is held over the sample; where the input is interpolated, the next sample's input follows
it; where the equations know the time, it is the last entry of x and goes on by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Model, ParameterSet, PrandtlIshlinskii
from ..simulators import Equations, Instant, Simulator, on_grid

INLINE = 4  # sub-steps that are written out one after the other; more become a loop
TIME, NEXT = "time", "_next"


@dataclass(frozen=True, eq=False)
class Sampled:
    """A closed model at its parameters' values, with names for every entry of its state.

    Attributes
    ----------
    one : casadi.Function
        A sub-step, `(x, row) -> (x_next, y)`, of scalar expressions; `row` is what `reads` says.
    states : tuple of str
        Names of the entries of x; the time comes last, where it is one.
    thresholds : dict
        Name of a memory -> half-width of the play that it belongs to.
    held : tuple of str
        Names of the operators' memory; a shift register is none, it moves at every step.
    """

    one: ca.Function
    reads: tuple[str, ...]
    substeps: int
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    thresholds: dict[str, float]
    held: tuple[str, ...] = ()

    @property
    def timed(self) -> bool:
        """Whether the last entry of x is the time, s."""
        return "t" in self.reads

    def rows(self, u: Any, t: Any, joined: Any) -> list[Any]:
        """What each sub-step reads, for inputs u and the time t, numbers or symbols; `joined` stacks columns."""
        n, many = self.substeps, len(self.inputs) // 2 if "next" in self.reads else len(self.inputs)
        now, after = u[:many], u[many:]
        out = []
        for i in range(n):
            columns = {"t": t + i * self.dt / n, "u": now}
            if "next" in self.reads:
                columns["u"] = now + (after - now) * (i / n)
                columns["next"] = now + (after - now) * ((i + 1) / n)
            out.append(joined(*(columns[what] for what in self.reads)))
        return out

    def function(self, name: str, one: ca.Function | None = None) -> ca.Function:
        """The step over a sample, of the sub-steps `one` (default: the model's own)."""
        one, own = one or self.one, len(self.states) - self.timed
        kind = ca.SX if self.substeps <= INLINE else ca.MX
        x, u = kind.sym("x", len(self.states)), kind.sym("u", len(self.inputs))
        t = x[own] if self.timed else kind(0)
        rows = self.rows(u, t, ca.vertcat)
        if kind is ca.SX:
            state, y = one(x[:own], rows[0])
            for row in rows[1:]:
                state = one(state, row)[0]
        else:
            first = one(x[:own], rows[0])
            run = one.mapaccum(self.substeps - 1)
            state, y = run(first[0], ca.horzcat(*rows[1:]))[0][:, -1], first[1]
        state = ca.vertcat(state, t + self.dt) if self.timed else state
        x_next, y = ca.densify(state), ca.densify(y)
        return ca.Function(name, [x, u], [x_next, y], ["x", "u"], ["x_next", "y"])


def sampled(model: Model, dt: float, simulator: Simulator | None = None) -> Sampled:
    """A closed model as steps over samples, its parameters' values put in; `simulator` names the laws' states.

    Raises
    ------
    InputError
        If the model's port is open, or it reads measured outputs.
    """
    if model.n_w and model.element is None and not model.n_s:
        raise InputError("The model has an open port; close it with close_loop first.")
    if "y" in model.reads:
        raise InputError("The model is corrected by measured outputs at every step; export the model without that.")
    x, row = ca.SX.sym("x", model.n_state), ca.SX.sym("row", model.n_u)
    stepped = model.closed(x, row, ca.DM(model.parameters.start))
    one = ca.Function("one", [x, row], [ca.densify(e) for e in stepped], ["x", "row"], ["x_next", "y"])
    states, thresholds, held = _of_laws(model, dt, simulator) if simulator else _of_element(model)
    inputs = model.inputs + (tuple(f"{name}{NEXT}" for name in model.inputs) if "next" in model.reads else ())
    names = _unique([*states, *([TIME] if "t" in model.reads else [])])
    renamed = dict(zip(states, names, strict=False))
    kept = {renamed[name]: value for name, value in thresholds.items()}
    still = tuple(renamed[name] for name in held)
    return Sampled(one, model.reads, model.substeps, dt, names, _unique(inputs), model.outputs, kept, still)


def right_hand_side(simulator: Simulator, name: str) -> ca.Function | None:
    """`(x, u) -> (xdot, y)`, or `(x, u, t)` where the time counts; None where there is no such thing.

    That is so for a simulator in discrete time, and for one with a law whose memory moves from sample to sample. x are
    the simulator's states and those of its laws; inputs are held.
    """
    if simulator.discrete:
        return None
    own = ParameterSet(dict(simulator.parameters))
    equations = Equations(simulator, ca.SX(own.start))
    if sum(equations.n_s):
        return None
    n_u = len(simulator.inputs)
    x, u, t = ca.SX.sym("x", len(simulator.states) + sum(equations.n_q)), ca.SX.sym("u", n_u), ca.SX.sym("t")
    found = equations.evaluate(Instant(x, ca.SX(0, 1), u, ca.SX.zeros(n_u), t))[:2]
    xdot, y = (ca.densify(e) for e in found)
    timed = ca.depends_on(ca.vertcat(xdot, y), t)
    return ca.Function(
        name, [x, u, t] if timed else [x, u], [xdot, y], ["x", "u", "t"] if timed else ["x", "u"], ["xdot", "y"]
    )


def _of_element(model: Model) -> tuple[list[str], dict[str, float], list[str]]:
    """Names of linear states, then of the element's memory, `memory[0,3]` being that of the threshold r[0,3]."""
    more = [f"state{k + 1}" for k in range(len(model.states), model.n_x)]
    if not isinstance(model.element, PrandtlIshlinskii):
        unnamed = [f"memory[{k}]" for k in range(model.n_s)]
        return [*model.states, *more, *unnamed], {}, unnamed
    r = np.asarray(model.parameters["r"].value)
    memory = {f"memory[{i},{j}]": float(r[i, j]) for i, j in np.ndindex(r.shape)}
    return [*model.states, *more, *memory], memory, list(memory)


def _of_laws(model: Model, dt: float, simulator: Simulator) -> tuple[list[str], dict[str, float], list[str]]:
    """Names of states, then of the laws' own states and memory behind the port: `ground.q1`, `ground.memory1`."""
    simulator = on_grid(simulator, dt / model.substeps)
    equations = Equations(simulator, ca.SX(ParameterSet(dict(simulator.parameters)).start))
    placed, flows, memory, held = simulator.elements, [], [], []
    thresholds: dict[str, float] = {}
    for element, n_q, n_s in zip(placed, equations.n_q, equations.n_s, strict=True):
        flows += [f"{element.prefix}q{k + 1}" for k in range(n_q)]
        own = [f"{element.prefix}memory{k + 1}" for k in range(n_s)]
        p = simulator.parameters.get(f"{element.prefix}r")
        r = np.ravel(p.value) if p is not None else np.zeros(0)
        thresholds |= dict(zip(own, map(float, r), strict=True)) if len(r) == n_s else {}
        memory += own
        held += [] if getattr(element.law, "shifts", False) else own
    return [*simulator.states, *flows, *memory], thresholds, held


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    """The names, those that are there already with an underscore more."""
    out: list[str] = []
    for name in names:
        while name in out:
            name += "_"
        out.append(name)
    return tuple(out)
