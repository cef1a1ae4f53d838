"""Fit known laws to further recordings: of another machine of the same kind, or of another day.

Nothing is searched. The simulator is fitted as given and with the laws in its ports, and the log evidences say whether
the machine has these laws. With several recordings, each is then fitted alone from the common values, so that values
may drift from one to the next. The remaining errors say whether something else is missing. They are compared with the
noise by the logarithm of their ratio,

    l = log(e / σ),

with e the rms error and σ the noise, both in units of the outputs' deviation. If nothing else is missing, it
scatters because both are estimated from N samples: log e has the variance 1/(2 n), with n the independent samples of
the residual, and log σ the variance 1/(2 N) times the correlation of third differences, 1 + 2 Σ ρ² = 2.31.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import one_blas_thread
from ..data import Recording
from ..laws import Law
from ..simulators import MOST_SUBSTEPS, Placed, Simulator, as_simulator
from .arguments import match_recordings
from .faults.channels import correct_gross_channel_errors
from .faults.gates import Checked
from .fits.evidence import (
    EffectiveSamples,
    formula_tolerance,
    information,
    log_evidence,
    log_prior,
    prior_width,
    standard_errors,
)
from .fits.floor import count_samples, effective_size, measured_floor, third_differences
from .fits.linearise import sample_run
from .fits.workbench import FINER_STEPS, THOROUGH, Fitted, Workbench, refit
from .search.trials import Trials

STEP_ACCURACY = 0.25  # standard errors by which finer steps may change a value: 3 % of it, added in squares
THIRD_DIFFERENCES = 2.31  # 1 + 2 Σ ρ² of third differences of white noise


@dataclass(frozen=True, eq=False)
class Values:
    """Free parameters by label with their standard errors; nan at bounds."""

    values: Mapping[str, float]
    errors: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Replication:
    """A simulator with known laws, fitted to recordings of a machine."""

    without: Fitted  # the simulator as given, refitted
    after: Fitted  # the same with the laws
    estimate: Values  # parameters of `after`, on all recordings
    by_recording: tuple[Values, ...]  # parameters of each recording alone, if there are several
    widths: Mapping[str, float]  # width of each parameter's prior range
    nrmse_before: float  # NRMSE (Eq. 27) without the laws
    nrmse_after: float  # the same with the laws, at the values of each recording
    noise: float  # noise over the outputs' deviation
    remainder: float  # `l` of the module docstring
    remainder_error: float  # its standard error
    gain: float  # log evidence with the laws minus the log evidence without, prior included; 0 without laws
    residuals: tuple[np.ndarray, ...]  # simulated minus measured outputs of each recording, over the outputs' deviation

    @property
    def simulator(self) -> Simulator:
        """The simulator with the laws, at the fitted values."""
        return self.after.corrected()


@one_blas_thread
def refit_error(simulator: Any, recordings: Any, *, hold: str | None = None, engine: str = "auto") -> float:
    """Refit a simulator as given to recordings; return the NRMSE (Eq. 27), averaged over outputs and recordings.

    For arguments and errors see `replicate`.
    """
    bench = _bench(simulator, recordings, hold, engine)
    fitted = bench.fit(bench.simulator, solver=THOROUGH)
    bench.interrupt.raise_pending()
    return bench.nrmse(fitted)


@one_blas_thread
def find_channel_faults(
    simulator: Any, recordings: Any, *, hold: str | None = None, engine: str = "auto"
) -> tuple[str, ...]:
    """Describe wrong signs and units and exchanged channels that show at the simulator's values.

    The simulator is refitted only if one is suspected. For arguments and errors see `replicate`.
    """
    bench = _bench(simulator, recordings, hold, engine)
    now = correct_gross_channel_errors(bench)
    bench.interrupt.raise_pending()
    return tuple(fault.sentence for fault in now.gates) if now else ()


def _bench(simulator: Any, recordings: Any, hold: str | None, engine: str) -> Workbench:
    own, given, stated = match_recordings(as_simulator(simulator), recordings, hold)
    return Workbench.of(own, given, stated or "zero", engine)


@one_blas_thread
def replicate(
    simulator: Any,
    recordings: Recording | Sequence[Recording],
    laws: Sequence[tuple[str, Law]] = (),
    starts: Sequence[Mapping[str, Any]] = (),
    *,
    hold: str | None = None,
    engine: str = "auto",
) -> Replication:
    """Fit a simulator with known laws to recordings of a machine.

    Parameters
    ----------
    laws : sequence of (port, Law)
        The laws with start values and limits.
    starts : sequence of mapping
        Values by name from which to fit besides the user's own.
    hold, engine
        As for `diagnose`; a hold that nobody states is zero-order.

    Raises
    ------
    InputError
        If simulator and recordings do not fit each other, or the simulation diverges.
    KeyboardInterrupt
        On Ctrl-C.
    """
    bench = _bench(simulator, recordings, hold, engine)
    now = Checked(bench, bench.fit(bench.simulator, [{}, *starts], solver=THOROUGH)).weighted()
    bench, plain = replace(now.bench, typical=sample_run(now.bench, now.fitted)), now.fitted
    after = _fit_with_laws(bench, plain, laws, starts) if laws else plain
    after = _refine_steps(bench, after)
    alone, values = _fit_each_recording(bench, after)
    bench.interrupt.raise_pending()
    residuals = tuple(e / bench.scale for e in bench.scored(alone))
    squares2 = _noise2(bench, residuals)
    noise2 = bench.pool(squares2)
    square = bench.pool(np.mean(np.concatenate(residuals) ** 2, axis=0))
    total = sum(e.size for e in residuals)
    # repeats and periods determine the noise at least as well as third differences
    variance = 0.5 / max(effective_size(residuals), 1.0) + 0.5 * THIRD_DIFFERENCES / total
    return Replication(
        without=plain,
        after=after,
        estimate=_values(bench, after),
        by_recording=values,
        widths=_widths(after),
        nrmse_before=bench.nrmse(plain),
        nrmse_after=bench.nrmse(replace(after, residual=alone)),
        noise=float(np.sqrt(noise2)),
        remainder=float(0.5 * np.log(max(square, 1e-300) / max(noise2, 1e-300))),
        remainder_error=float(np.sqrt(variance)),
        gain=_gain(bench, plain, after, after.last_elements(len(laws)), squares2) if laws else 0.0,
        residuals=residuals,
    )


def _fit_with_laws(
    bench: Workbench, plain: Fitted, laws: Sequence[tuple[str, Law]], starts: Sequence[Mapping[str, Any]]
) -> Fitted:
    """Fit the simulator with the laws, to convergence and on steps fine enough for a sharp knee."""
    placed = plain.simulator
    for port, law in laws:
        placed = placed.with_element(port, law)
    trials = Trials(bench, workers=1)
    nominal = {name: p.value for name, p in placed.parameters.items()}
    quick = bench.fit(placed, [nominal, *({**nominal, **start} for start in starts)])
    found = trials.polish(trials.make_trial(quick, len(laws)))
    return found.fitted if np.isfinite(found.mean_square) else quick


def _refine_steps(bench: Workbench, fitted: Fitted) -> Fitted:
    """Refit on finer integration steps until the values no longer depend on them.

    A search needs an integration error below the noise. Values need more: they are means over many samples, so their
    standard errors are far smaller.
    """
    most = min(FINER_STEPS**2 * bench.chosen, MOST_SUBSTEPS)
    while fitted.model.substeps < most and not fitted.simulator.discrete and np.any(fitted.model.parameters.free):
        error = fitted.model.parameters.pack(standard_errors(bench, fitted))
        steps = min(FINER_STEPS * fitted.model.substeps, most)
        finer = replace(bench, substeps=steps, at_least=steps, chosen=max(bench.chosen, -(-steps // FINER_STEPS)))
        found = refit(finer, [fitted.values], fitted.simulator, states=fitted.initial, solver=THOROUGH)
        if found is None:
            break
        change = np.abs(found.vector - fitted.vector) / error
        fitted = found
        if not np.any(change > STEP_ACCURACY):
            break
    return fitted


def _fit_each_recording(bench: Workbench, after: Fitted) -> tuple[list[np.ndarray], tuple[Values, ...]]:
    """Fit each of several recordings alone from the common values; return the residuals and the values."""
    if len(bench.recordings) < 2:
        return after.residual, ()
    residuals, values = [], []
    for i, r in enumerate(bench.recordings):
        own = bench.on([r])
        state = after.initial[i : i + 1]
        fitted = own.fit(after.simulator, [after.values], states=state, solver=THOROUGH, like=after)
        residuals.append(fitted.residual[0])
        values.append(_values(own, fitted))
    return residuals, tuple(values)


def _noise2(bench: Workbench, residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean square noise (n_y,) in units of the outputs' variance: measured, else by third differences."""
    measured = measured_floor(bench.recordings)
    if measured is not None:
        return measured.squares(bench.scale)
    return np.asarray(np.mean(np.concatenate([third_differences(e) for e in residuals]) ** 2, axis=0))


def _gain(bench: Workbench, plain: Fitted, after: Fitted, laws: tuple[Placed, ...], noise2: np.ndarray) -> float:
    """Compute the log evidence with the laws minus the log evidence of the simulator as given."""
    tolerance = formula_tolerance(plain.squares, noise2)
    costs = plain.cost + tolerance, after.cost + tolerance
    count = count_samples(bench.scored(after.residual), bench.scored(plain.residual), bench.scale)
    n = EffectiveSamples(bench.pool(noise2) + tolerance, count).at(min(costs))
    known = information(bench, after, laws)
    return log_evidence(costs[1], known, log_prior(laws, {}), n) - log_evidence(costs[0], np.zeros(0), 0.0, n)


def _values(bench: Workbench, fitted: Fitted) -> Values:
    own = fitted.model.parameters
    values, errors = fitted.vector, own.pack(standard_errors(bench, fitted))
    free = [(k, label) for k, label in enumerate(own.labels) if own.free[k]]
    return Values({label: float(values[k]) for k, label in free}, {label: float(errors[k]) for k, label in free})


def _widths(fitted: Fitted) -> dict[str, float]:
    """Return the width of the prior of each free parameter, as that of a uniform distribution."""
    own, vector = fitted.model.parameters, fitted.vector
    width = np.sqrt(12) * prior_width(np.maximum(np.abs(vector), 1e-300), own.lower, own.upper)
    return {label: float(width[k]) for k, label in enumerate(own.labels) if own.free[k]}
