"""The result of a diagnosis: it simulates, plots, exports and refines, and is written as diagnosis.json."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, later, to_json, write_atomically
from ..data import SAME_STEP, Recording, as_recordings, nrmse
from ..engine import make_engine
from ..identify import run_free
from ..simulators import Simulator, check_hold, discretise
from .faults.gates import edited
from .fits.workbench import Fitted, output_deviation
from .proof import Started
from .refinement import Refinement, refine
from .result_text import ResultText

VERDICTS = ("missing-physics", "complete", "unexplained", "recording-fault")


@dataclass(frozen=True, eq=False)
class BeforeAfter:
    """A recording beside the simulator as given, refitted, and corrected.

    Attributes
    ----------
    recording : Recording
        The recording with the corrections of the diagnosis (sign, unit, shift).
    given, before, after : array, shape (M, n_y), or None
        Outputs of the simulator as given, refitted, and corrected. None if the simulation diverges; `after` is also
        None if nothing was added to the simulator.
    """

    recording: Recording
    given: np.ndarray | None
    before: np.ndarray | None
    after: np.ndarray | None


class Diagnosis(ResultText):
    """Result of a diagnosis: the verdict, the missing physics, its confidence, the corrected simulator, and the proof.

    Attributes
    ----------
    verdict : str
        One of `VERDICTS`.
    sentence : str
        The verdict in words; `summary` adds the gravest warnings.
    effects : tuple of Effect
        The missing physics that has a name: port, law, confidence, equation, values with standard errors.
    candidates : tuple of dict
        All laws that were fitted, in the order of the search.
    gates : tuple of Gate
        Findings about recordings and simulator, and their corrections.
    mismatch : dict
        Where the refitted simulator misses: by output, band, amplitude, rate and time.
    parameters : dict
        The simulator's own parameters: given, refitted without and with the effects.
    corrected : Simulator
        The simulator with the effects added, at the fitted values (without effects: refitted).
    errors : dict
        `train`, `test` -> `nominal`, `before`, `after`: NRMSE averaged over outputs. With an observer these are errors
        of predictions; `free_run` then has the errors without it, on the test recordings if there are any.
    floor : dict
        `nrmse` and `source` of the noise, and its `white` part; the rest of an estimate may be physics as well. `test`
        has the same noise relative to the test recordings, `nrmse` and `white`.
    out_of_time : bool
        Whether the time limit ended the search.
    substeps : int
        Integration steps per sample with which the corrected simulator was fitted.
    freed : str
        Parameters that were fixed or at a bound and are free in the corrected simulator, joined by "and"; see
        `other_explanations`.
    correction : Correction or None
        The elements of `corrected` beside the refit: laws, a learned element, and their shares. Elements that are not
        among `effects` predict unseen data better than the refit but have no sure name.
    blind_spots : tuple of BlindSpot
        Facts that the recordings cannot reveal, the gravest first; see `check`.
    calls : dict
        How often the diagnosis called functions that have no equations, by name; see `Numeric`.
    """

    def to_dict(self) -> dict[str, Any]:
        """Return the content of diagnosis.json; numbers that are not finite are None."""
        raw: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "sentence": self.summary,
            "effects": [e.to_dict() for e in self.effects],
            "candidates": list(self.candidates),
            "gates": [g.to_dict() for g in self.gates],
            "mismatch": self.mismatch,
            "parameters": self.parameters,
            "fit": {**self.errors, "noise_floor": self.floor},
            "next_experiment": self.next_experiment,
            "description": self.correction.to_dict() if self.correction else None,
            "notes": self.warnings(),
            "interrupted": self.interrupted,
            "out_of_time": self.out_of_time,
        }
        if self.correction:
            raw |= {"shares": self.shares, "learned": [e.to_dict() for e in self.learned]}
        raw["blind_spots"] = [asdict(b) for b in self.blind_spots]
        clean: dict[str, Any] = to_json(raw)
        return clean

    def simulate(self, recording: Recording) -> np.ndarray:
        """Simulate the corrected simulator along the inputs of a recording.

        With an observer (`focus="prediction"`), the outputs are predictions one sample ahead.
        Recordings are corrected as the training recordings were (sign, unit, shift; see `gates`). An unknown initial
        state is estimated from the first samples, and expected to be like those of the training runs.

        Parameters
        ----------
        recording : Recording
            Must have the simulator's inputs and outputs by name, in any order.

        Returns
        -------
        array, shape (M, n_y)
            Outputs in the simulator's order and units, at the samples of the recording as the diagnosis has corrected
            it (a shift cuts samples off); not finite where the simulation diverges. `matched(recording)` has the
            measured outputs in the same units at the same samples; `plot` draws both.

        Raises
        ------
        InputError
            If the recording lacks a channel or has another step than the training recordings.
        """
        return self.run(recording)[1]

    def nrmse(self, recordings: Recording | Sequence[Recording]) -> float:
        """Compute the NRMSE (Eq. 27) of the corrected simulator, averaged over outputs and recordings.

        Samples from which an initial state was estimated are not scored; otherwise see `simulate`. The error is
        infinite if the simulation diverges. Where an output rests, its deviation over the training recordings counts.
        """
        runs = [self.run(recording) for recording in as_recordings(recordings)]
        scale = output_deviation(self.train)
        errors = [nrmse(r.y, y, k, scale) if np.all(np.isfinite(y)) else np.inf for r, y, k in runs]
        return float(np.mean(errors))

    def plot(self, recording: Recording) -> Any:
        """Draw a recording beside the refitted and the corrected simulator.

        Parameters
        ----------
        recording : Recording
            See `simulate`.

        Returns
        -------
        matplotlib.figure.Figure
            A row for each output: the signals around the largest swing, and the errors over the whole recording.
        """
        from ..plots import Simulated, plot_comparison

        found = self.before_and_after(recording)
        r = found.recording
        simulated: Simulated = [("refitted", found.before)]
        simulated += [("corrected", found.after)] if self.changed else []
        return plot_comparison(r, simulated, self.floor["nrmse"] * np.std(r.y[r.skip :], axis=0))

    def before_and_after(self, recording: Recording) -> BeforeAfter:
        """Simulate the simulator as given, refitted, and corrected along a recording; see `simulate`."""
        own = self.refitted.parameter_set
        values = own.change(**{name: {"value": p["nominal"]} for name, p in self.parameters.items()})
        given = self.run(recording, self.refitted.with_parameters(values))[1]
        r, before, _ = self.run(recording, self.refitted)
        after = self.run(recording)[1] if self.changed else None
        finite = (y if y is not None and np.all(np.isfinite(y)) else None for y in (given, before, after))
        return BeforeAfter(r, *finite)

    compare = before_and_after  # the earlier name

    def run(self, recording: Recording, simulator: Simulator | None = None) -> tuple[Recording, np.ndarray, int]:
        """Simulate the corrected simulator, or another one, along a recording.

        Returns
        -------
        recording : Recording
            As corrected, with its channels in the simulator's order.
        array, shape (M, n_y)
            Outputs; not finite where the simulation diverges.
        int
            First scored sample; an initial state is estimated from the samples before it.
        """
        simulator = simulator or self.corrected
        r, dt = self.matched(recording), self.train[0].dt
        check_hold(simulator, r, self.hold)
        if abs(r.dt / dt - 1) > SAME_STEP:
            raise InputError(f"The recording's step is {r.dt:g} s, the training's {dt:g} s; resample it.")
        fitted = self.evidence.after if simulator is self.corrected else self.evidence.without
        substeps = fitted.model.substeps if fitted is not None else self.substeps
        model = discretise(simulator, dt, self.hold, substeps)
        one = Started(model)
        if fitted is not None:
            follows = r.begins == "estimate" and simulator in (self.corrected, self.refitted)
            search = self.evidence.search if follows else None
            one = Started.of(model, fitted, search.bench if search is not None else None)
        y, skip = run_free(model, make_engine(model), r, one.starts, known=one.known)
        return r, y, skip

    def matched(self, recording: Recording) -> Recording:
        """Return a recording with the simulator's channels, order and units, corrected as the training was (`gates`).

        Training recordings of the diagnosis are corrected already. Give any other as it was read: a corrected one would
        be corrected twice.
        """
        matched = self.corrected.matched(recording)
        return matched if any(recording is known for known in self.train) else edited([matched], self.gates)[0]

    def export(self, **options: Any) -> Any:
        """Export the corrected simulator as a step over one sample, with the hold and sub-steps of the fit.

        An observer (`focus="prediction"`) is left out.

        For `options` see `pilfr.exported`; the result has `step`, `c_code` and the other exports.
        """
        from ..export import exported

        free = replace(self.corrected, observer=None)
        if isinstance(options.get("start"), Recording):
            options["start"] = self.matched(options["start"])
        return exported(free, dt=self.train[0].dt, hold=self.hold, substeps=self.substeps, **options)

    def to_casadi(self, name: str = "model", smooth: float = 0.0) -> Any:
        """Export the corrected simulator as a `casadi.Function (x, u) -> (x_next, y)`; see `pilfr.to_casadi`."""
        return self.export(name=name, smooth=smooth).step

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the content of diagnosis.json to a file, atomically.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_atomically(path, json.dumps(self.to_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n")

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.html, diagnosis.json and figures into a folder; return the page's path."""
        return Path(later("report.diagnosis_report")(self, folder))

    def refine(self, operators: int = 12, kind: str | None = None, *, port: str | None = None) -> Refinement:
        """Identify a Prandtl-Ishlinskii layer in the port where hysteresis was found; see `refinement`.

        It takes the place of the found law (hysteresis, backlash, or friction with presliding) and is fitted together
        with the simulator's parameters to the training recordings. If it does not predict held-out parts of these
        better than the found law, the result says so and keeps that law.

        Parameters
        ----------
        operators : int
            Operators of the layer.
        kind : {"stop", "play", "generalized_play"}, optional
            The operators; by default all that may stand at the port are tried, and the error on held-out data decides.
            Generalized plays are for actuators and sensors.
        port : str, optional
            The port; by default that of the surest effect with hysteresis.

        Returns
        -------
        Refinement
            With `simulator`, `loading_curve`, `weights` over `thresholds`, `nrmse`, `plot` and `export`.

        Raises
        ------
        InputError
            If the diagnosis has found no hysteresis (at the port), or an argument is wrong.
        """
        return refine(self, operators, kind, port)

    def with_fit(self, fitted: Fitted) -> Diagnosis:
        """Copy with another fitted simulator as the corrected one."""
        evidence = replace(self.evidence, after=fitted)
        corrected = replace(fitted.corrected(), substeps=fitted.model.substeps)
        return replace(self, corrected=corrected, evidence=evidence, substeps=fitted.model.substeps)

    def _repr_html_(self) -> str:
        return str(later("report.diagnosis_card")(self))
