"""The stress sets: cases of the kinds that the concealed ones leave out.

    slow-noise      AR(1) noise with a pole of 0.90 to 0.995; nothing missing, or one effect
    weak            one effect whose refit leaves 1 to 3 times the noise
    three           three effects, each visible with the two others in place
    wrong-fixed     nothing missing, but a parameter is held 10 to 40 % off
    outside-bounds  nothing missing, but a parameter's true value lies outside the user's bounds
    undeclared      one effect at a port that the user does not declare, though others are
    faults          every kind of fault, at inputs and at outputs
    one-sided       friction in one direction, constant loads, and these beside a law
    in-place        a law in place of a spring, and two laws one behind the other
    noisy-sensor    one output of several with noise of 1 to 5 % of its signal; nothing missing, one effect, or two

A case is drawn by the generator of the concealed cases (`concealed_case.planned`) with a plan, from the seed
`100000 n + index` of the n-th set, and its expected answer is put right here. Where several answers say the same, each
is accepted: a shift of half a sample for the wrong hold, a linear spring or damper beside a wrong one, an offset for a
constant load.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

from .concealed_case import Case, Finding, planned
from .concealed_draw import USUAL, Plan
from .concealed_rigs_more import RIGS
from .stress_effects import (
    IN_PLACE,
    LOAD,
    TERMS,
    constant_load,
    in_place,
    in_series,
    inside,
    law_and_load,
    loaded,
    one_sided_friction,
    one_way,
    three,
)

POLES = (0.90, 0.95, 0.97, 0.99, 0.995)
WEAK = (1.05, 2.9)  # refit's error over the noise, inside the 1 to 3 that the set is for
OFFSETS = frozenset({"offset", "zero", LOAD})
BOTH_SIDES = ("sign", "unit", "zero", "offset", "alignment", "clipped", "stale")
SETTLING = frozenset({"zero", "offset", "stale", "hold"})  # put right, or told, without being the verdict
SET_SIZE = 100_000  # seeds from one set to the next

MOVING = tuple(r.name for r in RIGS.values() if r.states)
INSIDE = tuple(r.name for r in RIGS.values() if any(laws and ":" not in p for p, laws in r.laws.items()))
RESTING = tuple(n for n in INSIDE if not RIGS[n].integrator)
SPRINGS = tuple(n for n, ports in TERMS.items() if n in RESTING and any(k for k, _ in ports.values()))
GUIDED = tuple(n for n in RESTING if any("coulomb_friction" in laws for laws in RIGS[n].laws.values()))
SEVERAL_PORTS = tuple(n for n in INSIDE if len(RIGS[n].ports) > 1)
SEVERAL_OUTPUTS = tuple(n for n in MOVING if len(RIGS[n].outputs) > 1)
SEVERAL_INPUTS = tuple(n for n in MOVING if len(RIGS[n].inputs) > 1)


@dataclass(frozen=True)
class Entry:
    """One case of a set: its kind in the generator, its plan, and what puts the expected answer right."""

    kind: str
    plan: Plan = USUAL
    finish: Callable[[Case], Case] = lambda case: case


def _slow_noise() -> list[Entry]:
    kinds = ("none", "none", "none", "one", "one")
    return [Entry(kind, Plan(pole=pole)) for pole in POLES for kind in kinds]


def _values(value: str) -> list[Entry]:
    return [Entry("value", Plan(rigs=MOVING, value=value), wrong_value) for _ in range(24)]


def _faults() -> list[Entry]:
    wanted = [(kind, side, MOVING) for kind in BOTH_SIDES for side in ("input", "output", "input", "output")]
    wanted += [("exchange", "input", SEVERAL_INPUTS)] * 2 + [("exchange", "output", SEVERAL_OUTPUTS)] * 3
    wanted += [(kind, "", MOVING) for kind in ("clock", "gap") for _ in range(3)]
    wanted += [("hold", "", tuple(n for n in MOVING if RIGS[n].hold is None))] * 3
    starts = ("estimate", "zero")
    return [
        Entry("fault", Plan(rigs=rigs, fault=kind, side=side, start=starts[i % 2]), fault_told)
        for i, (kind, side, rigs) in enumerate(wanted)
    ]


def _one_sided() -> list[Entry]:
    friction = Plan(rigs=GUIDED, pairs=one_way, drafts={"coulomb_friction": one_sided_friction})
    load = Plan(rigs=RESTING, pairs=loaded, drafts={LOAD: constant_load})
    beside = replace(load, pairs=law_and_load)
    return [
        *[Entry("one", friction, load_allowed) for _ in range(10)],
        *[Entry("one", load, load_expected) for _ in range(7)],
        *[Entry("two", beside, load_expected) for _ in range(7)],
    ]


def _in_place() -> list[Entry]:
    place = Plan(rigs=SPRINGS, pairs=in_place, drafts=IN_PLACE)
    series = Plan(rigs=RESTING, pairs=in_series)
    return [*[Entry("one", place)] * 14, *[Entry("two", series)] * 10]


def _noisy_sensor() -> list[Entry]:
    plan = Plan(rigs=SEVERAL_OUTPUTS, noisy=(0.01, 0.05))
    return [Entry(kind, plan) for kind in ("one", "one", "two", "none") for _ in range(6)]


def wrong_value(case: Case) -> Case:
    """A linear law at the port of a wrong spring or damper is the same as another value of it."""
    rig = next(r for r in RIGS if r in case.tags)
    ports = {p for p, terms in TERMS.get(rig, {}).items() if case.parameters & set(terms)}
    linear = Finding(frozenset({"linear_stiffness", "viscous_damping"}), frozenset(ports), needed=False)
    return replace(case, findings=(linear,), also=frozenset({"unexplained", "parameters"}))


def fault_told(case: Case) -> Case:
    """Some faults leave the rest of the answer standing."""
    return replace(case, also=frozenset({"complete"}) if case.details["fault"].kind in SETTLING else frozenset())


def _load(case: Case, needed: bool) -> Finding:
    """A constant force: at its port, or as an offset of an input or an output."""
    ports = {e.port for e in case.details["hidden"]}
    return Finding(OFFSETS, frozenset({*ports, *case.simulator.inputs, *case.simulator.output_names}), needed)


def load_allowed(case: Case) -> Case:
    """One-sided friction may be told as symmetric friction and a load."""
    return replace(case, findings=(_load(case, False),))


def load_expected(case: Case) -> Case:
    """A load is a finding, and no effect to be named."""
    laws = [i for i, t in enumerate(case.truth) if t["law"] != LOAD]
    truth, accepted = tuple(case.truth[i] for i in laws), tuple(case.accepted[i] for i in laws)
    case = replace(case, truth=truth, accepted=accepted, findings=(_load(case, True),))
    if truth:
        return replace(case, tags=case.tags - {"two"} | {"one", "load"}, also=frozenset({"recording-fault"}))
    also = frozenset({"complete", "missing-physics"})  # the latter where the load is an effect's name
    return replace(case, tags=case.tags - {"one"} | {"load"}, verdict="recording-fault", also=also)


def not_declared(case: Case) -> Case:
    """The effect may be named in the equation of a state that its force enters, or a note may say that it is there."""
    (effect,), states = case.details["hidden"], case.details["into"]
    pairs = {(f"equation:{state}", law) for state in states[effect.port] for _, law in case.accepted[0]}
    pairs |= {pair for pair in case.accepted[0] if pair[0] != effect.port}
    note = Finding(frozenset({"undeclared"}), frozenset(states[effect.port]))
    return replace(
        case,
        truth=(),
        accepted=(frozenset(pairs),),
        findings=(note,),
        verdict="unexplained",
        also=frozenset({"missing-physics"}),
        tags=case.tags - {"one"} | {"undeclared"},
    )


@cache
def sets() -> dict[str, list[Entry]]:
    """Every set by its name."""
    weak = Plan(visible=WEAK, target=(0.002, 0.03), loudest=10 ** (-30 / 20))
    several = Plan(rigs=tuple(n for n in INSIDE if n != "piezo"), pairs=three, target=(0.03, 0.1))
    hidden = Plan(rigs=SEVERAL_PORTS, pairs=inside, undeclared=True)
    return {
        "slow-noise": _slow_noise(),
        "weak": [Entry("one", weak)] * 24,
        "three": [Entry("three", several)] * 24,
        "wrong-fixed": _values("fixed"),
        "outside-bounds": _values("bounds"),
        "undeclared": [Entry("one", hidden, not_declared)] * 24,
        "faults": _faults(),
        "one-sided": _one_sided(),
        "in-place": _in_place(),
        "noisy-sensor": _noisy_sensor(),
    }


def seeds(names: Sequence[str] = ()) -> list[int]:
    """Seeds of the sets named, or of all."""
    found = enumerate(sets().items(), 1)
    return [SET_SIZE * n + i for n, (name, of) in found if not names or name in names for i in range(len(of))]


def set_of(seed: int) -> str:
    """Name of the set that a seed belongs to."""
    return list(sets())[seed // SET_SIZE - 1]


def case(seed: int) -> Case:
    """Draw a case of a stress set; the same seed gives the same case.

    Raises
    ------
    RuntimeError
        If no draw of this seed can be used.
    """
    name, index = set_of(seed), seed % SET_SIZE
    entry = sets()[name][index]
    drawn = entry.finish(planned(seed, entry.kind, entry.plan, attempts=200))
    rest = drawn.name.split("-", 1)[1]
    return replace(drawn, name=f"{name}-{index:02d}-{rest}", tags=drawn.tags | {name})
