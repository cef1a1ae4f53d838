"""The corrected simulator of an unexplained mismatch: a fitted model that predicts well and has no sure name.

A law may follow the recordings far better than the refitted simulator and still not be the physics that is missing.
Its name is then no effect, but the fitted model is worth having. It is handed back where it beats the refit by more
than a tenth on the parts of the training recordings that neither was fitted to, and is no worse on the whole of them.
Test recordings are never looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base import InputError
from ..laws import display_name
from ..simulators import Placed
from .workbench import Fitted

if TYPE_CHECKING:
    from .search import Search

GAIN = 0.9  # largest ratio of the held-out errors with and without the elements: better by more than a tenth
TRIED = 3  # candidates of the first pass that are fitted to everything where the search accepted none


@dataclass(frozen=True, eq=False)
class Description:
    """Elements that follow unseen data better than the refit, without a sure name.

    Attributes
    ----------
    elements : tuple of (port, law, form)
        The laws closed into the simulator; `form` may be empty.
    before, after : float
        Rms error of the refit and of this model on the parts of the training recordings that neither was fitted to,
        in units of the outputs' deviation.
    left, noise : float
        Rms error of this model on whole training recordings, and of the noise, in the same units.
    """

    elements: tuple[tuple[str, str, str], ...]
    before: float
    after: float
    left: float
    noise: float

    @property
    def words(self) -> str:
        """The elements in words, such as "hysteresis (generalized play) at sensor:speed"."""
        names = ((port, display_name(law), display_name(form)) for port, law, form in self.elements)
        return " and ".join(f"{law}{f' ({form})' if form else ''} at {port}" for port, law, form in names)

    @property
    def sentence(self) -> str:
        """Describe the model: its law and port, how much better it predicts, and how much it leaves."""
        return (
            f"The corrected simulator is a description without a sure name: {self.words}. On parts of the training "
            f"recordings that were not fitted it lowers the error from {100 * self.before:.2g} % to "
            f"{100 * self.after:.2g} %. It leaves {100 * self.left:.2g} % on the whole training recordings; the noise "
            f"is about {100 * self.noise:.2g} %."
        )

    def to_dict(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {
            "elements": [{"port": port, "law": law, "form": form} for port, law, form in self.elements],
            "held_out": {"before": self.before, "after": self.after},
            "sentence": self.sentence,
        }


def find_description(search: Search) -> tuple[Description, Fitted] | None:
    """Return the fitted model to hand back for an unexplained mismatch, None where the refit predicts as well.

    The model is the one that the search built up, or the best candidate of the first pass where it accepted none.
    """
    without = np.sqrt(search.errors_on_parts(search.without)[1])
    for fitted, held_out in _models(search):
        if not held_out <= GAIN * without or fitted.cost > search.without.cost:
            continue
        names = tuple((e.port, e.law.id, e.law.form) for e in _added(search, fitted))
        left, noise = fitted.cost**0.5, search.floor2**0.5
        return Description(names, float(without), held_out, left, noise), fitted
    return None


def _models(search: Search) -> Iterator[tuple[Fitted, float]]:
    """Fitted models, the preferred one first, each with its error on the parts that were not fitted."""
    if _added(search, search.base):
        with suppress(InputError):  # it diverges when it is fitted to the first parts alone
            yield search.base, float(np.sqrt(search.errors_on_parts(search.base)[1]))
        return
    tried = sorted(search.passes[0].candidates, key=lambda c: c.tail)[:TRIED] if search.passes else []
    for candidate in tried:
        whole = search.polished(candidate)
        if whole is not None:
            yield whole.fitted, float(np.sqrt(whole.tail))


def _added(search: Search, fitted: Fitted) -> tuple[Placed, ...]:
    """The elements of a fitted simulator that the search put in."""
    return fitted.simulator.elements[len(search.bench.simulator.elements) :]
