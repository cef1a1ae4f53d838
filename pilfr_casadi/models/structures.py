"""Build a model structure from names and numbers, as the command line and run files give them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .baselines import NARX, NOE, Lagged, network_lfr, ssnn
from .elements import PrandtlIshlinskii
from .operators import GeneralizedPlay, Play, Stop
from .pilfr import PILFR, hammerstein, wiener

OPERATORS: dict[str, Any] = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}
HYSTERETIC = ("nx", "operators", "operator", "channels", "neurons", "offset", "fix", "bounds", "priors")
LAGGED = {"narx": NARX, "noe": NOE}
# options of each structure
TAKES: dict[str, tuple[str, ...]] = {
    "lfr": HYSTERETIC,
    "hammerstein": HYSTERETIC,
    "wiener": HYSTERETIC,
    "ssnn": ("nx", "hidden", "offset", "fix", "bounds", "priors"),
    "network_lfr": ("nx", "hidden", "channels", "offset", "fix", "bounds", "priors"),
    "narx": ("lags", "hidden", "input_lags"),
    "noe": ("lags", "hidden", "input_lags"),
}
STRUCTURES = tuple(TAKES)
ANY = frozenset(name for takes in TAKES.values() for name in takes)


def named_structure(structure: str = "lfr", **given: Any) -> PILFR | Lagged:
    """Build the named structure with options of `TAKES`; omitted options have the structure's defaults.

    Parameters
    ----------
    structure : str
        One of `STRUCTURES`.
    given
        `nx` or `lags` at least. `operators` is 20 by default and 0 for a linear model; `neurons` belong to a
        generalized play.

    Raises
    ------
    InputError
        As for `PILFR`, `PrandtlIshlinskii`, `StaticNetwork` and `NARX`.
    """
    if structure in LAGGED:
        return LAGGED[structure](**given)
    element: dict[str, Any] = {k: given[k] for k in ("hidden", "channels") if k in given}
    form = {k: given[k] for k in ("bounds", "priors", "offset") if k in given}
    base = _network(structure, given["nx"], element) if "hidden" in TAKES[structure] else _hysteretic(structure, given)
    return PILFR(given["nx"], base.element, {**base.fixed, **given.get("fix", {})}, **form)


def _network(structure: str, nx: int, options: Mapping[str, Any]) -> PILFR:
    """Build an SS-NN, or a network in the port of a linear model."""
    return ssnn(nx, **options) if structure == "ssnn" else network_lfr(nx, **options)


def _hysteretic(structure: str, given: Mapping[str, Any]) -> PILFR:
    """Build a PI-LFR, PI-Hammerstein or PI-Wiener model, linear without operators."""
    neurons, n = given.get("neurons"), given.get("operators", 20)
    kind = OPERATORS[given.get("operator", "play")] if neurons is None else GeneralizedPlay(neurons)
    element = PrandtlIshlinskii(kind, n, given.get("channels", 1)) if n else None
    if structure == "lfr" or element is None:
        return PILFR(given["nx"], element)
    return {"hammerstein": hammerstein, "wiener": wiener}[structure](given["nx"], element)
