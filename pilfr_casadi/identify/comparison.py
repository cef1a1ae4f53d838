"""Models of any kind beside one recording, all treated alike: `compare`.

An error depends on where a simulation begins: one rig has 0.63 from zero and 0.0055 from a fitted state. So `compare`
starts every model in the same way, and does not use a state that a fit estimated from the whole recording. States of a
black box have no scale of their own and get the weak prior around rest of `Fit.nrmse`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, later
from ..data import DIVERGING, Recording, as_recordings, rmse_per_output
from ..engine import Engine, make_engine
from ..models import Model
from ..optimise import StatePrior, estimate_initial_state, samples_to_start
from ..simulators import Simulator, as_simulator, discretise_for
from .result import Fit


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Models beside a recording; print it, plot it, or read `nrmse`.

    Attributes
    ----------
    recording : Recording
        Its `skip` is the first sample that is scored, for all models.
    simulated : dict
        Model's name -> outputs (M, n_y); not finite where the model diverges.
    errors : dict
        Model's name -> NRMSE (Krikelis et al. 2024, Eq. 27) of each output, (n_y,); infinite where it diverges.
    """

    recording: Recording
    simulated: Mapping[str, np.ndarray]
    errors: Mapping[str, np.ndarray]

    @property
    def nrmse(self) -> dict[str, float]:
        """Model's name -> NRMSE averaged over outputs."""
        return {name: float(np.mean(error)) for name, error in self.errors.items()}

    @property
    def rows(self) -> list[list[str]]:
        """A row of text for each model: its name, its error of each output, and their mean if there are several."""
        many = self.recording.n_y > 1
        return [
            [name, *(_format_error(e) for e in error), *([_format_error(float(np.mean(error)))] if many else [])]
            for name, error in self.errors.items()
        ]

    @property
    def columns(self) -> list[str]:
        """The heads of `rows`."""
        return ["NRMSE", *self.recording.outputs, *(["mean"] if self.recording.n_y > 1 else [])]

    @property
    def note(self) -> str:
        """A sentence about the start of the simulations and the samples that are scored."""
        r = self.recording
        start = {
            "estimate": "Every model's initial state is fitted to the first samples",
            "zero": "Every model begins at zero",
            "periodic": "Every model runs in periodic steady state",
            "given": "Every model begins at the recording's initial state",
        }[r.begins]
        return f"{start}; scored from {r.skip * r.dt:.4g} s on." if r.skip else f"{start}; all samples are scored."

    def plot(self, kind: str = "signals", **options: Any) -> Any:
        """Draw the models beside the recording, a row for each output.

        Parameters
        ----------
        kind : {"signals", "residuals"}
            The signals around the largest swing and the errors over the whole recording, or correlations of the errors
            with themselves and with the inputs (`plots.residual_tests`, which takes the `options`).

        Returns
        -------
        matplotlib.figure.Figure
        """
        from ..plots import plot_comparison, residual_tests

        if kind == "residuals":
            return residual_tests(self.recording, list(self.simulated.items()), **options)
        if kind != "signals":
            raise InputError(f"kind={kind!r} was given to plot; give signals or residuals.")
        error = self.nrmse
        return plot_comparison(
            self.recording, [(f"{k} ({_format_error(error[k])})", y) for k, y in self.simulated.items()]
        )

    def __repr__(self) -> str:
        cells = [self.columns, *self.rows]
        widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
            for row in cells
        ]
        return "\n".join([*lines, self.note])

    def _repr_html_(self) -> str:
        return str(later("report.comparison_card")(self))


def _format_error(error: float) -> str:
    return f"{error:.4f}" if error < DIVERGING else "diverges"


def compare(recording: Recording, models: Mapping[str, Any] | Any) -> Comparison:
    """Simulate several models along one recording and tabulate their errors.

    All begin at the recording's `initial`. For `"estimate"` this is a state fitted to the first samples at each model's
    own parameters; these samples, as many as the largest model needs, are not scored. Nothing else is fitted.

    Parameters
    ----------
    recording : Recording
        Recording with the inputs and outputs of the models; a model with names takes its own by name.
    models : mapping of str to model, or one model
        Each a `Simulator`, a `Fit`, a `Diagnosis` (its corrected simulator), a closed `Model`, or a
        `control.StateSpace`, by its name in the table and the figure.

    Returns
    -------
    Comparison
        Printable, with `plot`, `nrmse`, `errors` and `simulated`.

    Raises
    ------
    InputError
        If `recording` is not a Recording, has no outputs, or does not fit a model.
    """
    if not isinstance(recording, Recording):
        raise InputError(f"A {type(recording).__name__} was given to compare; give a Recording first, then the models.")
    if not recording.n_y:
        raise InputError(f"{recording.label} has no outputs to compare with; name the measured columns.")
    named = dict(models) if isinstance(models, Mapping) else {"simulated": models}
    if not named:
        raise InputError("No model was given to compare; give a mapping from names to models.")
    residuals: dict[str, np.ndarray] = {}
    first = recording.skip
    for name, model in named.items():
        try:
            residuals[str(name)], own = _residual(model, recording)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        first = max(first, own)
    recording = recording.with_(skip=min(first, len(recording) - 2))
    simulated = {name: recording.y + e for name, e in residuals.items()}
    sigma = np.std(recording.y[recording.skip :], axis=0)
    for i, name in enumerate(recording.outputs):
        if not sigma[i] > 1e-14 * np.max(np.abs(recording.y[:, i])):
            raise InputError(f"the output {name!r} never changes where it is scored, so its NRMSE does not exist.")
    errors = {name: rmse_per_output(recording.y, y, recording.skip) / sigma for name, y in simulated.items()}
    return Comparison(recording, simulated, errors)


def simulator_nrmse(simulator: Simulator, recordings: Recording | Sequence[Recording]) -> float:
    """Compute `Simulator.nrmse`: the mean over recordings of the error in `compare`, over the simulator's outputs."""
    given = [simulator.matched(r) for r in as_recordings(recordings)]
    return float(np.mean([compare(r, simulator).nrmse["simulated"] for r in given]))


def _residual(model: Any, recording: Recording) -> tuple[np.ndarray, int]:
    """Return simulated minus measured outputs (M, n_y), in the recording's order, and the first sample to score.

    A diagnosis is compared with the recording that it has corrected (sign, unit, shift). Its residual is scaled back,
    so that the residual's share of the output's deviation stays the same.
    """
    if isinstance(model, Fit) and model.simulator is not None:
        seen = model.matched(recording)
        y, first = run_free(model.model, make_engine(model.model, model.engine), seen)
    elif hasattr(model, "run"):
        if isinstance(model, Fit):
            model = replace(model, initial={})  # no model uses a state from the whole recording
        seen, y, first = model.run(recording)
    elif isinstance(model, Model):
        seen = model.in_order(recording)
        y, first = run_free(model, make_engine(model), seen)
    else:
        seen, y, first = run_simulator(as_simulator(model, [recording]), recording)
    missing = [name for name in recording.outputs if name not in seen.outputs]
    if missing:
        raise InputError(f"it has no output {missing[0]!r}; leave that out of the recording.")
    order = [seen.outputs.index(name) for name in recording.outputs]
    scale = np.std(recording.y, axis=0) / np.maximum(np.std(seen.y[:, order], axis=0), 1e-300)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray((y - seen.y)[:, order] * scale), first


def run_simulator(simulator: Simulator, recording: Recording) -> tuple[Recording, np.ndarray, int]:
    """Simulate along a recording, from an estimated state where `Simulator.simulate` begins at zero (`run_free`).

    Returns the recording with the simulator's channels, the outputs (M, n_y), and the first scored sample.
    """
    matched = simulator.matched(recording)
    model = discretise_for(simulator, [matched])
    return matched, *run_free(model, make_engine(model), matched)


def run_free(
    model: Model,
    engine: Engine,
    recording: Recording,
    starts: Sequence[np.ndarray] = (),
    *,
    whole: bool = False,
    known: StatePrior | None = None,
) -> tuple[np.ndarray, int]:
    """Simulate a model at its start values along a recording.

    An unknown initial state is fitted to the first part of the recording, starting from rest and from `starts`, with
    the prior `known` if there is one; with `whole` to all of it, without a prior, as in a fit.

    Returns
    -------
    array, shape (M, n_y)
        Simulated outputs; not finite where the simulation diverges.
    int
        First scored sample, after the part to which the state is fitted unless that is the whole recording.
    """
    estimated = recording.begins == "estimate" and model.n_state > 0
    used = samples_to_start(model, engine, recording) if estimated else 0
    with np.errstate(all="ignore"):
        try:
            state = estimate_initial_state(model, engine, recording, used or None, starts=starts, known=known)
            if whole and estimated:
                used, state = 0, estimate_initial_state(model, engine, recording, len(recording), starts=(state,))
            y = engine.simulate(model.drive(recording), model.parameters.start, state)[0]
        except (RuntimeError, FloatingPointError):  # a quadratic program of huge numbers
            y = np.full(recording.y.shape, np.nan)
    return np.asarray(y), max(recording.skip, used)
