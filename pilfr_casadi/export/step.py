"""One step over a whole sample, `(x, u) -> (x_next, y)`, of any closed model, with a name for every entry of x and u.

A model steps from sub-step to sub-step and may read the input at the sub-step's end and the time (`Model.reads`). Here
the sub-steps of a sample run one after the other, and y is the output at the first. The arguments stay plain: `u` is
the input held over the sample; where the input is interpolated, the next sample's input follows it; where the equations
read the time, it is the last entry of x and advances by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Model, PrandtlIshlinskii
from ..simulators import ClosedEquations, Instant, Simulator, on_grid

INLINE = 4  # sub-steps written out one after the other; more become a loop, which keeps generated C short
TIME, NEXT = "time", "_next"


@dataclass(frozen=True, eq=False)
class Sampled:
    """A closed model at its parameters' values, with names for every entry of its state.

    Attributes
    ----------
    one : casadi.Function
        A sub-step, `(x, row) -> (x_next, y)`, of scalar expressions; `row` holds the signals that `reads` lists.
    states : tuple of str
        Names of the entries of x; the time comes last where it is a state.
    thresholds : dict
        Name of a memory -> half-width of the play that it belongs to.
    held : tuple of str
        Names of the operators' memory. A delay's shift register is not among them: it moves at every step.
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

    @property
    def interpolated(self) -> bool:
        """Whether the second half of u holds the inputs of the next sample."""
        return "next" in self.reads

    def rows(self, u: Any, t: Any, stack: Any) -> list[Any]:
        """List the signals that each sub-step reads, for inputs u and the time t; `stack` joins columns."""
        n, count = self.substeps, len(self.inputs) // 2 if self.interpolated else len(self.inputs)
        now, after = u[:count], u[count:]
        out = []
        for i in range(n):
            columns = {"t": t + i * self.dt / n, "u": now}
            if self.interpolated:
                columns["u"] = now + (after - now) * (i / n)
                columns["next"] = now + (after - now) * ((i + 1) / n)
            out.append(stack(*(columns[name] for name in self.reads)))
        return out

    def function(self, name: str, one: ca.Function | None = None) -> CheckedStep:
        """Compose the step over a sample of the sub-steps `one` (default: the model's own)."""
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
        return CheckedStep(ca.Function(name, [x, u], [x_next, y], ["x", "u"], ["x_next", "y"]))


class CheckedStep(ca.Function):
    """`(x, u) -> (x_next, y)`, called with numbers or symbols of exactly these sizes, or with several columns of them.

    A plain `casadi.Function` spreads one number over a whole state and takes a missing argument as zero, so a loop that
    lost its state would go on unnoticed.

    Raises
    ------
    InputError
        In a call, if x or u is missing or has another size.
    """

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Return the function's values, after the check."""
        arguments = dict(zip(("x", "u"), given, strict=False)) | named
        if len(given) + len(named) != 2 or set(arguments) != {"x", "u"}:
            raise InputError(f"A step of {self.name()} needs x and u; give both, as in step(x, u).")
        for i, (name, role) in enumerate((("x", "state"), ("u", "input"))):
            size, shape = int(self.size1_in(i)), _shape(arguments[name])
            if not _fits(shape, size):
                count = f"the shape {shape}" if shape else "none" if shape is None else "one number"
                wanted = "1 entry" if size == 1 else f"{size} entries"
                raise InputError(f"The {role} {name} of a step of {self.name()} has {wanted}; {count} was given.")
        return super().__call__(*given, **named)


def _shape(value: Any) -> tuple[int, ...] | None:
    """Shape of an array of numbers or symbols; None for anything else."""
    if isinstance(value, ca.DM | ca.SX | ca.MX):
        return tuple(value.shape)
    try:
        return None if value is None else np.asarray(value, dtype=float).shape
    except (TypeError, ValueError):
        return None


def _fits(shape: tuple[int, ...] | None, size: int) -> bool:
    if shape is None or len(shape) > 2:
        return False
    if shape == () or size == 0:
        return int(np.prod(shape)) == size
    return shape[0] == size or shape == (1, size)


def sampled(model: Model, dt: float, simulator: Simulator | None = None) -> Sampled:
    """Put a closed model's values into its sub-steps and name its states; `simulator` names those of its laws.

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
    if simulator is None:
        states, thresholds, memory = _name_element_states(model)
    else:
        states, thresholds, memory = _name_law_states(model, dt, simulator)
    inputs = model.inputs + (tuple(f"{name}{NEXT}" for name in model.inputs) if "next" in model.reads else ())
    names = _make_unique([*states, *([TIME] if "t" in model.reads else [])])
    renamed = dict(zip(states, names, strict=False))
    return Sampled(
        one=one,
        reads=model.reads,
        substeps=model.substeps,
        dt=dt,
        states=names,
        inputs=_make_unique(inputs),
        outputs=model.outputs,
        thresholds={renamed[name]: value for name, value in thresholds.items()},
        held=tuple(renamed[name] for name in memory),
    )


def right_hand_side(simulator: Simulator, name: str) -> ca.Function | None:
    """Return `(x, u) -> (xdot, y)`, or `(x, u, t)` where the equations read the time.

    x are the simulator's states and those of its laws; inputs are held. A simulator in discrete time, or with a law
    whose memory moves from sample to sample, has no such function: None.
    """
    if simulator.discrete:
        return None
    equations = ClosedEquations(simulator, ca.SX(simulator.parameter_set.start))
    if sum(equations.n_s):
        return None
    n_u = len(simulator.inputs)
    x, u, t = ca.SX.sym("x", len(simulator.states) + sum(equations.n_q)), ca.SX.sym("u", n_u), ca.SX.sym("t")
    found = equations.evaluate(Instant(x, ca.SX(0, 1), u, ca.SX.zeros(n_u), t))[:2]
    xdot, y = (ca.densify(e) for e in found)
    arguments = {"x": x, "u": u} | ({"t": t} if ca.depends_on(ca.vertcat(xdot, y), t) else {})
    return ca.Function(name, list(arguments.values()), [xdot, y], list(arguments), ["xdot", "y"])


def _name_element_states(model: Model) -> tuple[list[str], dict[str, float], list[str]]:
    """Name linear states, then the element's memory; `memory[0,3]` belongs to the threshold r[0,3].

    Returns all names, the thresholds of those memories that have one, and the names of the memory.
    """
    states = [*model.states, *(f"state{k + 1}" for k in range(len(model.states), model.n_x))]
    if not isinstance(model.element, PrandtlIshlinskii):
        unnamed = [f"memory[{k}]" for k in range(model.n_s)]
        return [*states, *unnamed], {}, unnamed
    r = np.asarray(model.parameters["r"].value)
    thresholds = {f"memory[{i},{j}]": float(r[i, j]) for i, j in np.ndindex(r.shape)}
    return [*states, *thresholds], thresholds, list(thresholds)


def _name_law_states(model: Model, dt: float, simulator: Simulator) -> tuple[list[str], dict[str, float], list[str]]:
    """Name a simulator's states, then its laws' own states and memory: `ground.q1`, `ground.memory1`."""
    simulator = on_grid(simulator, dt / model.substeps)
    equations = ClosedEquations(simulator, ca.SX(simulator.parameter_set.start))
    flows, memory, held = list[str](), list[str](), list[str]()
    thresholds: dict[str, float] = {}
    for element, n_q, n_s in zip(simulator.elements, equations.n_q, equations.n_s, strict=True):
        flows += [f"{element.prefix}q{k + 1}" for k in range(n_q)]
        own = [f"{element.prefix}memory{k + 1}" for k in range(n_s)]
        p = simulator.parameters.get(f"{element.prefix}r")
        r = np.ravel(p.value) if p is not None else np.zeros(0)
        thresholds |= dict(zip(own, map(float, r), strict=True)) if len(r) == n_s else {}
        memory += own
        held += [] if getattr(element.law, "shifts", False) else own
    return [*simulator.states, *flows, *memory], thresholds, held


def _make_unique(names: Sequence[str]) -> tuple[str, ...]:
    """Append underscores to names that are taken already."""
    out: list[str] = []
    for name in names:
        while name in out:
            name += "_"
        out.append(name)
    return tuple(out)
