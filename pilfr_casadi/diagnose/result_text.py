"""The words of a diagnosis: its summary, the reasons for doubt, and the printed answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import listed, multiple, percent
from ..data import DIVERGING, Recording
from ..models import Parameter, ParameterSet, is_at_bound
from ..simulators import Placed, Simulator, name_at, split_port
from .blind_spots import BlindSpot
from .correction import Correction
from .effect import Effect, sign_doubt
from .faults.gates import TEST_FAULT, TEST_OFFSET, Gate, value_with_unit
from .faults.offsets import describe_offsets, find_placed_offsets, recorded_at
from .fits.evidence import BETTER_RATIO, FAR_RATIO, NEAR_RATIO, all_sure
from .fits.floor import ABOVE_NOISE
from .posterior import indistinguishable
from .search.learned import Learned

ERROR_NAMES = {"nominal": "as given", "before": "refitted", "after": "corrected"}  # the errors that are printed
MOST_PRINTED = 8  # parameters and blind spots that are printed at most
GRAVEST_SPOTS = 2  # blind spots that are printed right after the verdict
NEAR_CONSTANT = 0.9  # error above which a refitted simulator is hardly better than a constant
INTERRUPTED = "The search was interrupted: the answer rests on the fits made until then."
OUT_OF_TIME = (
    "The time limit ended the search: the answer rests on the fits made until then. A longer one (time_limit, "
    "--time-limit) may find more."
)


@dataclass(frozen=True, eq=False)
class Basis:
    """The search and the fits on which a diagnosis rests; None where one is unknown."""

    search: Any = None  # the `Search`
    noise: np.ndarray | None = None  # standard deviation of each output's noise, (n_y,)
    without: Any = None  # the refitted simulator, as `Fitted` to the recordings of the search
    after: Any = None  # the corrected one


@dataclass(frozen=True, eq=False)
class NamelessLaw:
    """A law of a correction without a sure name."""

    name: str  # with its port, in words
    equation: str
    doubt: str  # what speaks against it; empty if nothing does
    free: Mapping[str, Parameter]  # the free parameters, at the fitted values
    alike: str  # the laws, with their ports, that explain the recordings about as well; empty if none does


@dataclass(frozen=True, eq=False)
class ResultText:
    """The data of a `Diagnosis`, which are described there, and what they say in words."""

    verdict: str
    sentence: str
    effects: tuple[Effect, ...]
    candidates: tuple[dict[str, Any], ...]
    gates: tuple[Gate, ...]
    mismatch: dict[str, Any]
    parameters: dict[str, dict[str, Any]]
    errors: dict[str, dict[str, float] | None]
    floor: dict[str, Any]
    corrected: Simulator
    refitted: Simulator
    hold: str
    train: tuple[Recording, ...] = ()
    test: tuple[Recording, ...] = ()
    next_experiment: dict[str, Any] | None = None
    seconds: float = 0.0
    times: Mapping[str, float] = field(default_factory=dict)
    interrupted: bool = False
    out_of_time: bool = False
    evidence: Basis = Basis()
    substeps: int = 1
    freed: str = ""
    correction: Correction | None = None
    blind_spots: tuple[BlindSpot, ...] = ()
    calls: Mapping[str, int] = field(default_factory=dict)

    @property
    def sure(self) -> bool:
        """Whether every named effect has a confidence above SURE; False without effects."""
        return all_sure(e.confidence for e in self.effects)

    @property
    def outcome(self) -> str:
        """Effect of the correction on the test error: "better", "same", "worse"; "" if unknown.

        It is unknown without test recordings, if a channel of these is wrong, and if the corrected simulator is the
        refitted one.
        """
        errors = self.errors.get("test")
        if not errors or not self.changed or self.test_fault:
            return ""
        before, after = errors["before"], errors["after"]
        if not after <= BETTER_RATIO * before:
            return "worse"
        return "better" if after < before else "same"

    @property
    def changed(self) -> bool:
        """Whether the corrected simulator differs from the refitted one."""
        return bool(self.effects or self.nameless or self.freed or self.offsets)

    @property
    def added(self) -> tuple[Placed, ...]:
        """The elements of the corrected simulator that the refitted one does not have."""
        own = {e.prefix for e in self.refitted.elements}
        return tuple(e for e in self.corrected.elements if e.prefix not in own)

    @property
    def offsets(self) -> str:
        """Words for the offsets among `added`, such as "the offset of u"; empty if there is none."""
        return describe_offsets(self.added)

    @property
    def only_offsets(self) -> bool:
        """Whether the corrected simulator differs from the refitted one by offsets alone."""
        return self.changed and not (self.effects or self.nameless or self.freed)

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the refit's error above the noise: `named` by laws, `learned` by an element, and `left`."""
        return dict(self.correction.shares) if self.correction else {}

    @property
    def learned(self) -> tuple[Learned, ...]:
        """The learned elements of `corrected`."""
        return self.correction.learned if self.correction else ()

    @property
    def nameless(self) -> Correction | None:
        """The correction, if it has elements and no effect is named."""
        return self.correction if self.correction and self.correction.elements and not self.effects else None

    @property
    def corrected_faults(self) -> list[str]:
        """Faults that were corrected in the recordings; the corrected simulator belongs to corrected recordings."""
        return [g.sentence for g in self.gates if g.fault and g.corrected and not g.parameter]

    @property
    def test_fault(self) -> str:
        """The sentence on a wrong channel of the test recordings; empty if none is known."""
        return next((g.sentence for g in self.gates if g.finding == TEST_FAULT), "")

    @property
    def noise_on_tests(self) -> Mapping[str, float]:
        """The noise relative to the test recordings, `nrmse` and `white`; without these, to the training recordings."""
        return self.floor.get("test") or self.floor

    @property
    def summary(self) -> str:
        """The verdict's sentence, with a warning if the search was cut short or the correction fails the test.

        It also says if no test recording shows what the correction is worth.
        """
        errors, text = self.errors.get("test"), self.sentence
        untold = self.out_of_time and "time limit" not in text
        if untold or (self.effects and (self.interrupted or self.out_of_time)):
            by = "Ctrl-C" if self.interrupted else "the time limit"
            text += f" The search was cut short by {by}, so that a further effect may not have been tried."
        if not errors:
            untested = " This correction is not tested yet: give a recording of another experiment as test."
            return text + untested if self.changed else text
        if self.test_fault:
            return f"{text} {self.test_fault} Until then the test error says nothing of this answer."
        given, before, after = (percent(errors[k]) for k in ("nominal", "before", "after"))
        if self.outcome == "worse" and self.only_offsets:
            text += (
                f" But with {self.offsets} it follows the test recordings worse than without: {before} without, "
                f"{after} with. Something may differ between the recordings."
            )
        elif self.outcome == "same":
            that = f"correcting {self.offsets}" if self.only_offsets else "it"
            text += f" On the test recordings {that} makes no difference: {before} before, {after} after."
            text += " A constant would follow them better." if errors["after"] > 1 else ""
            text += self._better_without()
        elif self.outcome == "worse":
            text += (
                f" But this correction makes the test recordings worse: their error is {before} refitted "
                f"and {after} with it. Do not use it as a correction.{self._better_without()}"
            )
            text += "".join(f" {g.sentence}" for g in self.gates if g.finding == TEST_OFFSET)
        else:
            text += self._idle_on_tests()
        if BETTER_RATIO * errors["nominal"] < min(errors["before"], errors["after"]):
            text += f" As given, the simulator follows the test recordings better than with any fit here: {given}."
        return text

    def worth(self, effect: Effect) -> str:
        """State the test error with and without one of several effects; empty if it is unknown."""
        errors = self.errors.get("test")
        if not errors or self.test_fault or np.isnan(effect.test_without):
            return ""
        with_it, without = percent(errors["after"]), percent(effect.test_without)
        return f"error on the test recordings: {with_it} with it, {without} without it (the rest refitted)"

    def _idle_on_tests(self) -> str:
        """Name the effects without which, one at a time, the test recordings are followed at least as well."""
        after = (self.errors.get("test") or {}).get("after", np.nan)
        idle = [e.name for e in self.effects if e.test_without <= after]
        if not idle:
            return ""
        rest = "their names rest" if idle[1:] else "its name rests"
        return (
            f" The test recordings are followed at least as well without {', or without '.join(idle)}; {rest} on the "
            "training recordings alone."
        )

    def _better_without(self) -> str:
        """Name the effect of a useless correction without which the test error is lowest, if that helps."""
        errors = self.errors.get("test") or {}
        known = [e for e in self.effects if not np.isnan(e.test_without)]
        least = min(known, key=lambda e: e.test_without, default=None)
        if least is None or not BETTER_RATIO * least.test_without < errors["before"]:
            return ""
        return f" Without {least.name} it is {percent(least.test_without)}."

    def warnings(self) -> list[str]:
        """List the reasons for doubt: an interrupt, parameters at their bounds, errors that stay large."""
        out = [INTERRUPTED] * self.interrupted + [OUT_OF_TIME] * self.out_of_time
        ended = self._values_at_bounds()
        if ended:
            one = len(ended) == 1
            out.append(
                f"{', '.join(ended)} came out at {'its bound' if one else 'their bounds'}: more is missing, or "
                f"{'it has' if one else 'they have'} too little room. The ± of the other values do not include that."
            )
        out += self._doubtful_offsets()
        train, test = self.errors["train"], None if self.test_fault else self.errors["test"]
        if train and train["before"] > NEAR_CONSTANT and self.verdict in ("missing-physics", "unexplained"):
            than = "worse than" if train["before"] > 1 / NEAR_CONSTANT else "hardly better than"
            out.append(
                f"Refitted, the simulator alone is {than} a constant (error {percent(train['before'])} of "
                "the outputs' deviation). Either its values, units or bounds are wrong: check them before you "
                "trust a name. Or large physics is missing: then the corrected simulator follows far better."
            )
            if train["before"] > 1:
                out[-1] += " Shares of the mismatch count such an error as the outputs' deviation."
        if train and self.verdict != "unexplained":
            out += self._remaining_error(train["after"])
        far = test and train and test["after"] > FAR_RATIO * max(train["after"], self.noise_on_tests["nrmse"])
        if far and self.outcome != "worse":
            out.append(
                "The test error is far above the training error: the model is only near the truth, or the test "
                "recording visits states that the training recordings do not."
            )
        return out

    def _remaining_error(self, after: float) -> Iterator[str]:
        """Generate a note if the corrected simulator does not follow to the noise, or only to an uncertain one."""
        noise, white = (max(value, 1e-300) for value in (self.floor["nrmse"], _white(self.floor)))
        tried = () if self.effects or after < ABOVE_NOISE * white else self.candidates
        at_noise = [c for c in tried if c["nrmse_train"] < NEAR_RATIO * white]
        best = min(at_noise, key=lambda c: c["nrmse_train"], default=None)
        law = best and f"{name_at(best['port'], best['law'], best['form'])} follows to {best['nrmse_train']:.3g}"
        if after > ABOVE_NOISE * noise:
            rest = f"more may be missing ({law})" if law else "more is missing, or a law is only near"
            yield f"The remaining error is {multiple(after / noise)} times the noise: {rest}."
        elif law or after > FAR_RATIO * white:
            rest = f"missing physics: {law}" if law else "physics that no law here explains"
            yield (
                f"The remaining error is {multiple(after / white)} times the white noise. Its slow part may be noise "
                f"too, or {rest}."
            )

    def _doubtful_offsets(self) -> Iterator[str]:
        """Generate a note on each offset that is larger than its signal ever was."""
        for parameter, e in find_placed_offsets(self.corrected.elements if self.train else ()).items():
            name, value = split_port(e.port)[1], float(self.corrected.parameters[parameter].value)
            reach = float(np.max(np.abs(recorded_at(self.train, e.port))))
            if abs(value) > reach:
                yield (
                    f"The offset of {name} ({value:.3g}) is larger than {name} ever was ({reach:.3g}): it may make up "
                    "for something else, such as a wrong level or gain, or missing physics."
                )

    def _values_at_bounds(self) -> list[str]:
        """List the free entries of parameters at a bound, each with its value.

        Zeros are left out if effects are named: there an effect has replaced the parameter (friction a damper).
        """
        own, out = self.corrected.parameters, []
        for name in self.parameters:
            p = own[name]
            at, fixed = is_at_bound(p.value, *p.bounds), np.broadcast_to(p.fixed, p.value.shape)
            columns = (np.ravel(a, order="F") for a in (p.value, at & ~fixed))
            for label, v, ended in zip(ParameterSet({name: p}).labels, *columns, strict=True):
                if ended and (v or not self.effects):
                    out.append(f"{label} ({v:.4g})")
        return out

    def __str__(self) -> str:
        lines = [self.summary, *self.corrections_made(), *self.gravest_blind_spots()]
        for e in self.effects:
            lines += [str(e), f"  {self.worth(e)}"] if self.worth(e) else [str(e)]
        lines += [*self._nameless_lines(), *self._value_lines(), *self._error_lines(), *self._blind_lines()]
        further = [g.sentence for g in self.gates if g.sentence not in self.corrected_faults]
        lines += [f"note: {text}" for text in (*further, *self.warnings())]
        if self.next_experiment:
            lines.append(f"next experiment: {self.next_experiment['sentence']}")
        calls = "".join(f", {count} calls of {name}" for name, count in self.calls.items() if count)
        lines.append(f"computed in {self.seconds:.{1 if self.seconds < 10 else 0}f} s{calls}")
        return "\n".join(lines)

    __repr__ = __str__

    def _error_lines(self) -> list[str]:
        """Format the errors as a table, with the noise floor below it."""
        lines = [f"{'NRMSE':<12}" + "".join(f"{name:>11}" for name in ERROR_NAMES.values())]
        role = "test" if self.errors.get("test") else "train"
        for kind in ("train", "test", "free_run"):
            errors = self.errors.get(kind)
            if errors:
                shown = (_error_text(errors[k]) for k in ERROR_NAMES)
                label = f"{role} free" if kind == "free_run" else kind  # a free run of the recordings in the row above
                lines.append(f"  {label:<10}" + "".join(f"{text:>11}" for text in shown))
        if self.errors.get("free_run"):
            lines.append(f"  {role} free: a free run of the {role} recordings; the rows above are predictions")
        noise = f"{self.noise_text(self.floor)} ({self.floor['source']})"
        if self.floor.get("test"):
            noise += f", on the test recordings {self.noise_text(self.noise_on_tests)} if they are as noisy"
        return [*lines, f"  noise floor {noise}"]

    def noise_text(self, noise: Mapping[str, float], write: Callable[[float], str] | None = None) -> str:
        """Write a noise floor as far as it is known; `write` formats an error, by default as printed."""
        write = write or _error_text
        most, white = noise["nrmse"], _white(noise)
        if self.verdict == "unexplained" and self.floor["source"] == "estimated":
            return f"at least {write(most)}"
        if most > NEAR_RATIO * white:
            return f"{write(white)} (its white part) to {write(most)} (with the slow part)"
        return write(most)

    def corrections_made(self) -> list[str]:
        """Tell which faults were corrected in the recordings, besides one that is the verdict."""
        return [f"The recordings were corrected: {text}" for text in self.corrected_faults if text != self.sentence]

    def gravest_blind_spots(self) -> list[str]:
        """Describe the gravest facts that the recordings cannot reveal, one a line."""
        return [f"Blind spot of these recordings: {b.sentence}" for b in self.blind_spots[:GRAVEST_SPOTS]]

    def _blind_lines(self) -> list[str]:
        """List the blind spots that are not printed after the verdict."""
        further = [f"  {b.sentence}" for b in self.blind_spots[GRAVEST_SPOTS:MOST_PRINTED]]
        left = len(self.blind_spots) - MOST_PRINTED
        more = [f"  and {left} more, see pilfr check"] if left > 0 else []
        return ["further blind spots of these recordings:", *further, *more] if further else []

    def _nameless_lines(self) -> list[str]:
        """List the laws of the corrected simulator without a sure name, with their values."""
        lines = list[str]()
        for law in self.nameless_laws:
            lines += [f"in the correction, without a sure name: {law.name}"]
            lines += ["  " + "; ".join(filter(None, [law.equation, law.doubt]))]
            lines += [f"  {name} = {value_with_unit(p.value, p.unit, 5)}" for name, p in law.free.items()]
            lines += [f"  cannot be told apart from {law.alike}"] if law.alike else []
        return lines

    @property
    def nameless_laws(self) -> list[NamelessLaw]:
        """The laws of the corrected simulator without a sure name; they may stand beside named effects."""
        out, parameters = list[NamelessLaw](), self.corrected.readable_parameters()
        named = {(effect.port, effect.law) for effect in self.effects}
        for e in self.added:
            if e.law.listed and e.name not in named:
                own = {name: parameters[f"{e.prefix}{name}"] for name in e.law.parameters()}
                free = {name: p for name, p in own.items() if not np.all(p.fixed)}
                doubt = sign_doubt(self.corrected, e, {name: p.value for name, p in self.corrected.parameters.items()})
                alike = listed(self._alike(e), MOST_PRINTED)
                out.append(NamelessLaw(e.words, e.law.equation, doubt, free, alike))
        return out

    def _alike(self, e: Placed) -> list[str]:
        """Name the laws that explain the recordings about as well in place of one of a correction without a name."""
        closest, search = self.correction.closest if self.correction else None, self.evidence.search
        if closest is None or search is None:
            return []
        own = [element for element in closest.laws if element.name == e.name]
        return [name_at(port, law) for element in own for port, law in indistinguishable(search, closest, element)]

    def _value_lines(self) -> list[str]:
        """List the simulator's own estimated values, largest changes first."""
        own = self.corrected.parameters
        free = {k: p for k, p in self.parameters.items() if not own[k].fixed.all() and own[k].value.ndim == 0}
        moved = sorted(free, key=lambda k: -abs(_relative_change(free[k])))
        lines = []
        for name in moved[:MOST_PRINTED]:
            p = free[name]
            std = "" if p["std"] is None else f" ± {float(p['std']):.2g}"
            value, nominal = float(p["refit_with"]), float(p["nominal"])
            bound = ", at its bound" if is_at_bound(value, *own[name].bounds) else ""
            lines.append(f"  {name} = {value:.5g}{std} {p['unit']}".rstrip() + f", given as {nominal:.5g}{bound}")
        more = [f"  and {len(moved) - MOST_PRINTED} more"] if len(moved) > MOST_PRINTED else []
        for name, e in find_placed_offsets(self.corrected.elements).items():
            value, unit = float(own[name].value), self.corrected.port(e.port).unit
            more.append(f"  offset of {split_port(e.port)[1]} = {value_with_unit(value, unit, 4)}")
        return ["the simulator's own values, refitted:", *lines, *more] if lines or more else []


def _error_text(nrmse: float) -> str:
    """Write an error with four decimals, or two digits if it is below them."""
    if not nrmse < DIVERGING:
        return "runs away"
    return f"{nrmse:.4f}" if nrmse >= 1e-3 or nrmse == 0 else f"{nrmse:.2g}"


def _white(noise: Mapping[str, float]) -> float:
    """Return the white part of a noise floor, or all of it where it is not known apart."""
    return noise.get("white", noise["nrmse"])


def _relative_change(row: Mapping[str, Any]) -> float:
    nominal = float(row["nominal"])
    return (float(row["refit_with"]) - nominal) / (abs(nominal) or 1e-300)
