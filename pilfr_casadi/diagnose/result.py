"""What a diagnosis found: immutable, printable, and as the contract's diagnosis.json."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..data import Recording
from ..simulators import Simulator
from .gates import Gate

VERDICTS = ("missing-physics", "complete", "unexplained", "recording-fault")

MOST = 8  # values of the simulator that are printed
LEFT = 2.0  # times the noise that is left, to be told
WORSE = 1.05  # times the test error without the effects that one with them is worth a warning
CONSTANT = 0.9  # error of a refitted simulator that follows next to nothing
INTERRUPTED = "The search was interrupted: this is what was found until then, and the rest was not tried."
FAR = 3.0  # times the training error that a test error is worth a warning


@dataclass(frozen=True, eq=False)
class Effect:
    """A piece of physics that was left out."""

    port: str
    law: str
    confidence: float
    sentence: str
    equation: str
    parameters: dict[str, dict[str, Any]]
    indistinguishable: tuple[tuple[str, str], ...] = ()
    form: str = ""
    placebo: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        out: dict[str, Any] = {
            "port": self.port,
            "law": self.law,
            "confidence": self.confidence,
            "sentence": self.sentence,
            "equation": self.equation,
            "parameters": self.parameters,
            "indistinguishable": [{"port": p, "law": law} for p, law in self.indistinguishable],
        }
        if self.form:
            out["form"] = self.form
        if self.placebo:
            out["placebo"] = dict(self.placebo)
        return out


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Where the simulator is wrong, what it lacks, how sure that is, and the proof.

    Attributes
    ----------
    verdict : str
        One of `VERDICTS`.
    corrected : Simulator
        The simulator with the effects closed in, at the fitted values (without effects: refitted).
    errors : dict
        `train`, `test` -> `nominal`, `before`, `after`: NRMSE averaged over outputs.
    floor : dict
        `nrmse` and `source`.
    substeps : int
        Integration steps a sample with which the corrected simulator was fitted.
    let_go : str
        Parameter that was fixed or at a bound and is let go in the corrected simulator; see `held`.
    """

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
    evidence: Mapping[str, Any] = field(default_factory=dict)
    substeps: int = 1
    let_go: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The content of diagnosis.json; numbers that are not finite are None."""
        raw = {
            "schema": 1,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "effects": [e.to_dict() for e in self.effects],
            "candidates": list(self.candidates),
            "gates": [g.to_dict() for g in self.gates],
            "mismatch": self.mismatch,
            "parameters": self.parameters,
            "fit": {**self.errors, "noise_floor": self.floor},
            "next_experiment": self.next_experiment,
            "notes": self.warnings(),
            "interrupted": self.interrupted,
        }
        clean: dict[str, Any] = plain(raw)
        return clean

    def export(self, **options: Any) -> Any:
        """The corrected simulator as a step over a sample, in steps and sub-steps as fitted; see `export.exported`."""
        from ..export import exported

        return exported(self.corrected, dt=self.train[0].dt, hold=self.hold, substeps=self.substeps, **options)

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """The corrected simulator as `casadi.Function (x, u) -> (x_next, y)`; see `export.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def report(self, folder: str | os.PathLike[str]) -> None:
        """Write report.html, diagnosis.json and figures into a folder."""
        from ..report import diagnosis_report

        diagnosis_report(self, folder)

    def warnings(self) -> list[str]:
        """What makes the answer less certain than it looks: an interrupt, parameters at bounds, errors that stay large.

        At zero is what a named effect has replaced, such as a damper that was there for friction.
        """
        out, own = [INTERRUPTED] if self.interrupted else [], self.corrected.parameters
        ends = {k: (np.asarray(own[k].value), *own[k].bounds) for k in self.parameters if not own[k].fixed}
        held = {k: np.ravel(v)[0] for k, (v, low, high) in ends.items() if np.any((v <= low) | (v >= high))}
        held = {k: v for k, v in held.items() if v or not self.effects}
        if held:
            names = ", ".join(f"{k} ({v:.4g})" for k, v in held.items())
            one = len(held) == 1
            out.append(
                f"{names} came out at {'its bound' if one else 'their bounds'}: more is missing, or "
                f"{'it has' if one else 'they have'} too little room."
            )
        test, train = self.errors["test"], self.errors["train"]
        if train and train["before"] > CONSTANT and self.verdict in ("missing-physics", "unexplained"):
            out.append(
                f"Refitted, the simulator alone is hardly better than a constant (error {train['before']:.2g} of the "
                "outputs' deviation): look at its values, their units and their bounds before anything that is named."
            )
        times = train["after"] / max(self.floor["nrmse"], 1e-300) if train and self.effects else 1.0
        if times > LEFT:
            out.append(f"What is left is {times:.2g} times the noise: more is missing, or a law is only near.")
        if test and self.effects and test["after"] > WORSE * test["before"]:
            out.append(
                f"On the test recording the simulator is worse with what is named ({test['after']:.3g} of the outputs' "
                f"deviation) than refitted without ({test['before']:.3g}): do not rely on it there."
            )
        elif test and train and test["after"] > FAR * max(train["after"], self.floor["nrmse"]):
            out.append(
                "The test error is far above the training error: what was found is only near what happens, or the test "
                "recording visits what the training recordings do not."
            )
        return out

    def __str__(self) -> str:
        lines = [self.sentence]
        for e in self.effects:
            lines.append(f"{e.port}: {e.law}{f' ({e.form})' if e.form else ''}, confidence {e.confidence:.2f}")
            lines.append(f"  {e.sentence}: {e.equation}")
            for name, p in e.parameters.items():
                std = "" if p["std"] is None else f" ± {p['std']:.2g}"
                lines.append(f"  {name} = {p['value']:.5g}{std} {p['unit']}".rstrip())
            if e.indistinguishable:
                others = ", ".join(f"{port}: {law}" for port, law in e.indistinguishable)
                lines.append(f"  cannot be told apart from {others}")
        lines += self._own()
        for kind in ("train", "test"):
            errors = self.errors[kind]
            if errors:
                shown = " -> ".join("diverges" if not np.isfinite(v) else f"{v:.4f}" for v in errors.values())
                lines.append(f"NRMSE {kind} (nominal -> refitted without -> with): {shown}")
        lines.append(f"noise floor {self.floor['nrmse']:.4f} ({self.floor['source']})")
        lines += [f"note: {text}" for text in (*(g.sentence for g in self.gates), *self.warnings())]
        if self.next_experiment:
            lines.append(f"next experiment: {self.next_experiment['sentence']}")
        stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in self.times.items())
        lines.append(f"{self.seconds:.1f} s{f': {stages}' if stages else ''}")
        return "\n".join(lines)

    __repr__ = __str__

    def _own(self) -> list[str]:
        """The simulator's own estimated values, those that moved most first."""
        own = self.corrected.parameters
        free = {k: p for k, p in self.parameters.items() if not own[k].fixed.all() and own[k].value.ndim == 0}
        moved = sorted(free, key=lambda k: -abs(_change(free[k])))
        lines = []
        for name in moved[:MOST]:
            p = free[name]
            std = "" if p["std"] is None else f" ± {float(p['std']):.2g}"
            value, nominal = float(p["refit_with"]), float(p["nominal"])
            lines.append(f"  {name} = {value:.5g}{std} {p['unit']}".rstrip() + f", given as {nominal:.5g}")
        more = [f"  and {len(moved) - MOST} more"] if len(moved) > MOST else []
        return ["the simulator's own values, refitted:", *lines, *more] if lines else []


def _change(row: Mapping[str, Any]) -> float:
    """Share by which a parameter has moved."""
    nominal = float(row["nominal"])
    return (float(row["refit_with"]) - nominal) / (abs(nominal) or 1e-300)


def plain(value: Any) -> Any:
    """Plain JSON types; None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
