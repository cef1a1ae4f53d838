"""Ctrl-C under a progress bar, at any stage: the diagnosis answers from what it has fitted."""

from __future__ import annotations

import signal

import pytest
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi._base import progress_bar
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, Law


def friction() -> pilfr.Recording:
    """A recording of the rig with dry friction."""
    return recorded(rig().with_element("ground", CoulombFriction().at({"F_c": 2.0, "v_0": 0.01})), 0)


@pytest.mark.parametrize(
    "stage",
    ["checks and refit", "fits", "conclusion", *(pytest.param(s, marks=pytest.mark.slow) for s in ("screen", "proof"))],
)
def test_ctrl_c_once_gives_an_answer(stage: str) -> None:
    """The bar raises an interrupt again if CasADi may have swallowed it, but not one that was handled."""
    laws: tuple[type[Law], ...] = (CoulombFriction,)
    pressed = list[str]()
    with progress_bar() as show:

        def press(name: str, done: int, total: int, best: float) -> None:
            if name == stage and not pressed and (done > 1 or stage != "checks and refit"):
                pressed.append(name)
                signal.raise_signal(signal.SIGINT)
            show(name, done, total, best)

        found = pilfr.diagnose(rig(430.0, 5.0), friction(), laws=laws, hold="zero", workers=1, progress=press)
    assert pressed and found.interrupted
    assert "interrupted" in str(found)
    named = [e.law for e in found.effects]
    assert named == (["coulomb_friction"] if stage in ("fits", "conclusion", "proof") else [])


def test_what_follows_far_better_corrects_although_it_has_no_name() -> None:
    laws: tuple[type[Law], ...] = (CubicStiffness,)
    both = rig().with_element("ground", CoulombFriction().at({"F_c": 2.0, "v_0": 0.01}))
    both = both.with_element("ground", CubicStiffness().at({"k_3": 2e4}))
    pressed = list[str]()

    def press(name: str, *_: object) -> None:
        if name == "fits" and not pressed:
            pressed.append(name)
            signal.raise_signal(signal.SIGINT)

    found = pilfr.diagnose(rig(430.0, 5.0), recorded(both, 0), laws=laws, hold="zero", workers=1, progress=press)
    assert found.interrupted and not found.effects
    assert "The corrected simulator has cubic stiffness at ground" in found.sentence
    assert found.errors["train"]["after"] < 0.5 * found.errors["train"]["before"]
