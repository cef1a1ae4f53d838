"""Laws whose strength varies with a signal, as friction that grows with a pressure.

A `Profile` says how: the strength has a value at each of some places in the signal's range, and weights of these values
in between.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError
from ..models import Named, Parameter
from .base import Law, Local, check_signal, continue_along_tangents, rename_class
from .composed import check_force, missing_signal

RATIOS, MOST_RATIO = (0.3, 3.0), 100.0  # tried ratios of an exponential profile, and the largest
PATTERNS = ((0.5, 1.0, 1.5), (1.5, 1.0, 0.5), (0.5, 1.5, 0.5), (1.5, 0.5, 1.5))  # variations, over the mean
LEVEL = 0.1  # smallest variation of a strength, over the largest strength; below it the strength is constant
SPARE = 0.25  # of the variation, the least strength from which a profile starts


@dataclass(frozen=True)
class Profile:
    """How a strength varies over the range of a signal, from `low` to `high`."""

    ends: tuple[str, ...]  # the names of a strength's values are its own name with these ends
    how: str  # the variation in words
    course: str  # the variation in an equation that names the signal
    # weight of each value at a share of the range, from the values of the law's parameters
    weights_at: Callable[[Any, Mapping[str, Any]], list[Any]]

    def weights(self, signal: Any, values: Any) -> list[Any]:
        """Compute the weights of a strength's values, such as `F_c` and `F_c_high`, at a signal."""
        return self.weights_at((signal - values["low"]) / (values["high"] - values["low"]), values)


@functools.cache
def _lagrange(count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the polynomials that are one at one of `count` equidistant nodes and zero at the others, and slopes."""
    nodes = np.linspace(0, 1, count)
    others = (np.poly(np.delete(nodes, i)) for i in range(count))
    basis = [c / np.polyval(c, at) for c, at in zip(others, nodes, strict=True)]
    return basis, [np.polyder(c) for c in basis]


def _interpolation_weights(share: Any, count: int) -> list[Any]:
    """Weigh values at `count` equidistant nodes by the polynomial through them; outside along its tangents."""

    def evaluate(polynomials: list[np.ndarray], at: Any) -> list[Any]:
        return [functools.reduce(lambda total, c: total * at + c, p.tolist()) for p in polynomials]

    basis, slopes = _lagrange(count)
    return continue_along_tangents(share, 0.0, 1.0, lambda at: (evaluate(basis, at), evaluate(slopes, at)))


PROFILES = {
    "linear": Profile(("", "_high"), "", "linear in {by}", lambda share, values: [1 - share, share]),
    "quadratic": Profile(
        ("", "_mid", "_high"),
        " in a parabola",
        "a parabola in {by} through three values",
        lambda share, values: _interpolation_weights(share, 3),
    ),
    "exponential": Profile(
        ("",),
        " exponentially",
        "times ratio^(({by} - low)/(high - low))",
        lambda share, values: [values["ratio"] ** share],
    ),
    # changes that are added to a parameter, which has its own value in the middle of the signal's range
    "tilt": Profile(
        ("",), "", "change = c (2 share - 1),  share = ({by} - low)/(high - low)", lambda share, values: [2 * share - 1]
    ),
    "bend": Profile(
        ("", "_high"),
        "",
        "change = (c (1 - share) - c_high share) (1 - 2 share),  share = ({by} - low)/(high - low)",
        lambda share, values: _interpolation_weights(share, 3)[::2],
    ),
    "curve": Profile(
        ("", "_25", "_75", "_high"),
        "",
        "change = curve of fourth degree in {by} through c, c_25, 0, c_75, c_high, at even steps from low to high",
        lambda share, values: [weight for i, weight in enumerate(_interpolation_weights(share, 5)) if i != 2],
    ),
}
SCHEDULES = ("linear", "quadratic", "exponential")  # profiles of a law's strength


def scheduled(law: type[Law], by: str, profile: str = "linear") -> type[Law]:
    """Make a law whose strength varies with a signal, such as friction that grows with a pressure.

    A strength has one value, such as `F_c`, where the signal is lowest in the recordings (`low`), and another, such as
    `F_c_high`, where it is highest (`high`). A force that opposes motion does so at both.

    Parameters
    ----------
    law : class of Law
        Any law that may act in parallel, as a force.
    by : str
        An input of the simulator, one of the port's own `signals`, "z", the local coordinate, or "t", the time.
    profile : {"linear", "quadratic", "exponential"}
        How the strength varies: in a line, to `F_c_high`; in a parabola over `F_c_mid` in the middle to `F_c_high`,
        along its tangents outside the range; or exponentially, to `ratio` times `F_c`, as viscosity with temperature.

    Raises
    ------
    InputError
        If it is not a law, or acts in series with a signal; if `by` is no name, or there is no such profile.
    """
    check_signal(by)
    return make_scheduled(check_force(law), by, check_profile(profile, SCHEDULES))


def check_profile(profile: str, known: Sequence[str]) -> str:
    """Return the name of a profile if it is known; refuse others."""
    if profile not in known:
        raise InputError(f"profile = {profile!r} was given; give {', '.join(map(repr, known))}.")
    return profile


def constant(law: type[Law]) -> type[Law]:
    """Return the law whose strength is constant, if a signal varies or scales it; see `scheduled` and `scaled`."""
    return law.__base__ if law.scheduled_by or law.scaled_by else law  # type: ignore[return-value]


def likely_profiles(law: type[Law]) -> tuple[str, ...]:
    """Return the profiles in which a strength may vary in a machine, the most general one first.

    The operators of a layer vary together, by one ratio, because separately they could imitate any curve of position.
    """
    layer = any(law().parameters()[name].value.ndim for name in law.strength)
    return ("exponential",) if layer else ("quadratic", "linear", "exponential")


def strengths_over(law: Law, values: Mapping[str, Any], signal: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the strengths (G,), or (G, n) for n operators, of a law that a signal (G,) varies; see `scheduled`."""
    profile = PROFILES[law.profile]
    weights = profile.weights(signal, values)
    return {
        own: sum(np.multiply.outer(w, values[f"{own}{end}"]) for w, end in zip(weights, profile.ends, strict=True))
        for own in constant(type(law)).strength
    }


def _levels(found: Law, own: str, by: str, limits: Mapping[str, float]) -> np.ndarray:
    """Compute a strength at the low end, the middle and the high end of a signal that varies it, (3,) or (3, n).

    If another signal varies the law, its mean strength counts. A strength that a signal scales may be negative, which
    the simulator's own spring or damper compensates; it is shifted, so that all levels here have one sign.
    """
    value = np.asarray(found.values[own], dtype=float)
    if found.scaled_by == by:
        levels = np.array([share * value for share in (limits["low"], sum(limits.values()) / 2, limits["high"])])
        return np.asarray(levels - levels.min(axis=0) + SPARE * np.ptp(levels, axis=0))
    if not found.scheduled_by:
        return np.array([value] * 3)
    signal = np.array([found.values["low"], (found.values["low"] + found.values["high"]) / 2, found.values["high"]])
    levels = strengths_over(found, found.values, signal)[own]
    return levels if found.scheduled_by == by else np.array([levels.mean(axis=0)] * 3)


def _limits(signal: np.ndarray) -> dict[str, float]:
    """Return the range of a signal that varies a law."""
    return {"low": float(signal.min()), "high": float(signal.max())}


def _follow_pattern(profile: str, levels: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the values of a profile from each strength at the low end, the middle and the high end of the signal."""
    values: dict[str, Any] = {}
    for own, (low, middle, high) in levels.items():
        ends = PROFILES[profile].ends
        chosen = {1: (low,), 2: (low, high), 3: (low, middle, high)}[len(ends)]
        values |= {f"{own}{end}": level for end, level in zip(ends, chosen, strict=True)}
        if profile == "exponential":
            ratio = np.abs(np.sum(high)) / max(np.abs(np.sum(low)), 1e-300)
            values["ratio"] = float(np.clip(ratio, 1 / MOST_RATIO, MOST_RATIO))
    return values


def _in_words(base: Any, varies: Profile, by: str, words: str) -> tuple[str, str, str]:
    """Return form, equation and sentence of a law whose strength varies."""
    course = varies.course.format(by=by)
    if base.of_input:
        return f"{by}{varies.how}, with an offset", f"w = a  with a {course}", base.sentence.format(by=words)
    form = f"{base.form}, scheduled{varies.how} by {by}".removeprefix(", ")
    if "parameter" in base.places:
        return form, course, base.sentence.format(by=words)
    equation = f"{base.equation}  with {', '.join(base.strength)} {course}"
    return form, equation, f"{base.sentence}; its strength varies{varies.how} with {words}"


@functools.cache
def make_scheduled(base: Any, by: str, name: str) -> Any:
    """Make the law, without checks, whose strength varies with the signal `by` in the profile of this name."""
    varies = PROFILES[name]
    ends = {own: [f"{own}{end}" for end in varies.ends] for own in base.strength}
    further = {ends[own][k]: base.units[own] for k in range(1, len(varies.ends)) for own in base.strength}
    shape = {"ratio": ""} if name == "exponential" else {}
    with_z = by == "z" and base.places == ("parallel",)
    unit = "z" if with_z else "s" if by == "t" else f"[{by}]"
    words = "the local coordinate" if with_z else "time" if by == "t" else by
    read = [*inspect.signature(base.step if base.memory else base.force).parameters]

    def strengths(p: Any, u: Any, z: Any) -> dict[str, Any]:
        """Parameters of the law at a value of the signal."""
        signal = z if with_z else u[by]
        weights = varies.weights(signal, p)
        own = {name: p[name] for name in base.units}
        return own | {k: sum(w * p[v] for w, v in zip(weights, names, strict=True)) for k, names in ends.items()}

    def arguments(p: Any, u: Any, z: Any, **signals: Any) -> dict[str, Any]:
        """Arguments of the law's force at a value of the signal."""
        have = {"z": z, "p": Named("parameter", strengths(p, u, z)), **signals}
        return {k: have[k] for k in read if k in have}

    class Scheduled(base):
        form, equation, sentence = _in_words(base, varies, by, words)
        sentences = {k: f"{v}; its strength varies{varies.how} with {words}" for k, v in base.sentences.items()}
        units = {**base.units, **further, **shape, "low": unit, "high": unit}
        strength = (*base.strength, *further)
        places = base.places
        scheduled_by, profile, of_input = by, name, False

        @classmethod
        def reads(cls) -> set[str]:
            """Signals of the law, and the one that varies its strength."""
            return base.reads() | {"z" if with_z else "t" if by == "t" else "u"}

        def schedule(self, local: Local) -> np.ndarray:
            return local.z if with_z else super().schedule(local)

        def why_not(self, local: Local) -> str:
            unknown = not (local.readers or (local.from_zero and all(local.from_zero)))
            if with_z and unknown:  # an unknown level of each recording would look like a variation with z
                return "no output reads the coordinate, and its start is unknown"
            return super().why_not(local) or ("" if with_z else missing_signal(by, local))

        def parameters(self) -> dict[str, Parameter]:
            """Parameters: the ends of the signal's range are fixed, and all values of a strength have one shape."""
            found = super().parameters()
            for own, names in ends.items():
                shape_of = found[own].value.shape
                for name in names[1:]:
                    if found[name].value.shape != shape_of:
                        found[name] = replace(found[name], value=np.broadcast_to(found[name].value, shape_of))
            fixed = {k: Parameter(float(self.values.get(k, k == "high")), unit, fixed=True) for k in ("low", "high")}
            return {**found, **fixed}

        def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
            """Bounds of the law, and of the ratio of its strengths."""
            return super().bounds(local) | dict.fromkeys(shape, (1 / MOST_RATIO, MOST_RATIO))

        def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
            """Shapes of the law, with the range of the signal."""
            limits = _limits(self.schedule(local))
            for own in super().shapes(local):
                for ratio in RATIOS if shape else (1.0,):
                    yield own | dict.fromkeys(shape, ratio) | limits

        def doubtful(self, values: Mapping[str, Any]) -> bool:
            """Tell whether the law hardly acts, or its strength hardly varies."""
            middle = (values["low"] + values["high"]) / 2
            found = strengths_over(self, values, np.array([values["low"], middle, values["high"]]))
            varies = any(np.any(np.ptp(v, axis=0) > LEVEL * np.max(np.abs(v), axis=0)) for v in found.values())
            return not varies or super().doubtful(values)

        @classmethod
        def finer_starts(cls, found: Law, local: Local) -> Iterator[dict[str, Any]]:
            """Start as the found law varies, or else with every pattern of variation."""
            limits = _limits(cls().schedule(local))
            kept = {k: v for k, v in found.values.items() if k in base.units} | limits
            levels = {own: _levels(found, own, by, limits) for own in base.strength}
            known = by in (found.scheduled_by, found.scaled_by)
            for pattern in ((1.0, 1.0, 1.0),) if known else PATTERNS[: None if name == "quadratic" else 2]:
                yield kept | _follow_pattern(name, {k: np.multiply(pattern, v.T).T for k, v in levels.items()})

        if base.memory:

            def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0, u: Any = None) -> Any:
                at = p if u is None and not with_z else strengths(p, u, z)
                have = {"z": z, "s": s, "p": at, "dz": dz}
                return super().step(**{k: have[k] for k in read if k in have})

        elif "q" in read:

            def force(self, z: Any, dz: Any, q: Any, u: Any, p: Any) -> Any:
                return super().force(**arguments(p, u, z, dz=dz, q=q))

        else:

            def force(self, z: Any, dz: Any, u: Any, p: Any) -> Any:  # type: ignore[misc]
                return super().force(**arguments(p, u, z, dz=dz))

    return rename_class(
        Scheduled,
        f"{base.__name__}ScheduledBy_{by}{name.capitalize() if varies.how else ''}",
        f"{base.__doc__}\n\n    Its strength varies{varies.how} with {words}.",
    )
