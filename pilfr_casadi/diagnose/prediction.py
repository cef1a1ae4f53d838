"""Prediction focus: an observer corrects the simulator's states, and the errors are those of one-step predictions.

An unstable simulator cannot be run by its inputs alone, and a simulator with a drift or an unrecorded disturbance
leaves the recordings however good it is. An observer corrects its states by the outputs (Ljung 1999, System
Identification, sec. 4.3),

    x̂ₖ₊₁ = f(x̂ₖ, uₖ) + L (yₖ - ŷₖ),

so that it forgets its past within a memory τ. The gain L belongs to a predictor without process noise for e^(dt/τ) A
in place of A: every eigenvalue of A - L C is then within e^(-dt/τ) (prescribed degree of stability: Anderson & Moore
1971, Linear Optimal Control, sec. 3.5), and eigenvalues within this radius stay.

A long memory shows missing physics best, because its effect adds up over τ. It is also nearest to the predictor of a
machine without disturbances, so that noise that a controller feeds back biases the fit least. Therefore the longest
memory is used with which the refitted simulator follows the recordings; if it follows with none, the memory with the
smallest error.

Disturbances that nobody recorded need a shorter memory. With one that is too long, laws that only make the observer
forget sooner look like missing physics. So the refitted simulator and the best laws are fitted with shorter memories
too, and the search begins again with the memory with which the likeliest of them predicts best (`forget_sooner`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.linalg

from .._base import InputError
from ..data import Recording
from ..linear import steady_state_gain
from ..simulators import Simulator, discretise, growth_rate
from .faults.gates import LEAST_GAIN, USELESS_FIT, Gate, evidence_gain
from .fits.linearise import differentiate_step, linearise_runs
from .fits.workbench import FEW, Fitted, Workbench, growth, refit
from .search.hypotheses import Hypotheses, likeliest_forms
from .search.trials import Trial

ROUNDING = 1e-9  # share of the largest entry that counts as zero
# memories that are tried in turn, in half decades: times the time of e-fold growth (a longer one leaves the unstable
# eigenvalue of the observer as it is); for a stable simulator times the longest recording's duration
OF_GROWTH, OF_DURATION = (3.0, 1.0, 0.3, 0.1), (0.1, 0.03, 0.01, 0.003)
SOONER = 10**-0.25  # ratio of the memories that are tried where disturbances need a shorter one: quarter decades


def observer_keeps_up(simulator: Simulator, recordings: Sequence[Recording]) -> bool:
    """Tell whether an observer keeps up: the error of the simulator grows by less than a factor e within a sample."""
    return growth_rate(simulator, recordings[0]) * recordings[0].dt < 1


def drifts(bench: Workbench, fitted: Fitted) -> bool:
    """Tell whether small forces at ports add up in a free run, because its memory is longer than the recordings.

    That is so if a port's force excites a mode that slow, and an output shows the mode.
    """
    probe, runs = linearise_runs(bench, fitted)
    a, b, c = max(runs, key=lambda r: len(r.z)).mean
    inner = [i for i, name in enumerate(probe.ports) if not bench.simulator.port(name).series]
    if not len(a) or not inner:
        return False
    forces = b[:, runs[0].n_free :][:, inner]
    values, left, right = scipy.linalg.eig(a, left=True, right=True)
    felt, seen = (np.max(np.abs(m), axis=1) for m in (left.conj().T @ forces, (c @ right).T))
    felt, seen = (v > ROUNDING * np.max(np.abs(m), initial=0.0) for v, m in ((felt, forces), (seen, c)))
    slow = np.abs(values) ** (max(map(len, bench.recordings)) * fitted.model.substeps) > np.exp(-1)
    return bool(np.any(slow & felt & seen))


def predictor(simulator: Simulator, recordings: Sequence[Recording], hold: str, engine: str) -> tuple[Simulator, float]:
    """Add the observer with the longest memory that follows the recordings; return the simulator and the memory, s.

    Raises
    ------
    InputError
        If it diverges with every observer.
    """
    rate, duration = growth(simulator, recordings), max(len(r) * r.dt for r in recordings)
    memories = [times / rate for times in OF_GROWTH] if rate else [times * duration for times in OF_DURATION]
    memories = [max(memory, recordings[0].dt) for memory in memories]  # corrections come once a sample
    best: tuple[float, Simulator, float] | None = None
    for memory in memories:
        observed = replace(simulator, observer=observer(simulator, recordings, hold, memory))
        bench = Workbench.of(observed, recordings, hold, engine)
        found = refit(bench)
        if found is None:
            continue
        if found.cost < USELESS_FIT:
            return observed, memory
        if best is None or found.cost < best[0]:
            best = found.cost, observed, memory
    if best is None:
        raise InputError(
            "Led by the recordings, the simulator still cannot follow them; check the signs and units of its equations "
            "and of the recordings."
        )
    return best[1:]


def forget_sooner(search: Hypotheses, simulator: Simulator, memory: float) -> tuple[Simulator, float] | None:
    """Return the simulator with the memory, s, with which the likeliest hypothesis predicts best, if it is shorter.

    The refitted simulator and the best laws have each their own best memory, from `memory` down to a sample. Laws count
    only if they then predict clearly better: with a memory that is too long, many can imitate one that forgets sooner.
    """
    bench = search.bench
    plain = likeliest = _best_memory(search, search.root, simulator, memory)
    named = (t for t in search.memo.values() if t.names)
    for trial in likeliest_forms(named, search.optimistic_evidence)[:FEW]:
        own = _best_memory(search, trial, simulator, memory)
        count = 0 if trial.information is None else len(trial.information)
        gained = evidence_gain(plain.left, own.left, bench.scored(own.fitted.residual), count)
        if gained > LEAST_GAIN and own.left < likeliest.left:
            likeliest = own
    if likeliest.memory >= memory:
        return None
    gain = observer(simulator, bench.recordings, bench.hold, likeliest.memory)
    return replace(simulator, observer=gain), likeliest.memory


@dataclass(frozen=True, eq=False)
class _ObservedFit:
    """The fit of a hypothesis with an observer: its memory, s, and the mean square error that it leaves."""

    fitted: Fitted
    left: float
    memory: float


def _best_memory(search: Hypotheses, trial: Trial, simulator: Simulator, memory: float) -> _ObservedFit:
    """Fit a hypothesis with shorter memories, and return it with the best."""
    bench, best = search.bench, _ObservedFit(trial.fitted, trial.mean_square, memory)
    last = trial.fitted
    while (memory := memory * SOONER) >= bench.dt and search.may_go_on():
        gain = observer(simulator, bench.recordings, bench.hold, memory)
        found = refit(bench, [last.values], replace(last.simulator, observer=gain), states=last.begin)
        if found is not None:
            last, left = found, bench.pool(found.squares)
            best = _ObservedFit(found, left, memory) if left < best.left else best
    return best


def disturbance_note(simulator: Simulator, memory: float, before: float) -> Gate:
    """Note that disturbances explain more than the laws that were found with a longer memory."""
    sentence = (
        "Disturbances that nobody recorded move the machine, or physics that no law here follows: with an observer "
        f"that forgets within {memory:.3g} s, the simulator follows better than with one that forgets within "
        f"{before:.3g} s. Physics whose effect is smaller than that is not found."
    )
    return Gate(", ".join(simulator.output_names), "disturbance", memory, sentence, corrected=False)


def agreement_note(simulator: Simulator, shorter: float, memory: float) -> Gate:
    """Note that a shorter memory shows the same laws, though not well enough to be sure."""
    sentence = (
        f"With an observer that forgets within {shorter:.3g} s in place of {memory:.3g} s the simulator follows "
        "better: disturbances that nobody recorded move the machine, or physics that no law here follows. The effects "
        "named here are the likeliest there, too, but it shows them too little to be sure."
    )
    return Gate(", ".join(simulator.output_names), "disturbance", memory, sentence, corrected=False)


def prediction_note(simulator: Simulator, recordings: Sequence[Recording], memory: float) -> Gate:
    """Note that the errors are errors of predictions, and if so that the simulator is unstable."""
    rate = growth(simulator, recordings)
    why = f"The simulator is unstable by itself (it grows e-fold in {1 / rate:.2g} s). " if rate else ""
    sentence = (
        f"{why}The recordings lead the simulator: an observer lets it forget its past within {memory:.3g} s, and the "
        "errors are those of predictions one sample ahead, not of a free run."
    )
    return Gate(", ".join(simulator.output_names), "prediction", memory, sentence, corrected=False)


def drift_note(simulator: Simulator, memory: float, what: str) -> Gate:
    """Note that a law was found in predictions because the simulator drifts in a free run."""
    sentence = (
        "In a free run small forces add up over the whole recording, so that its errors hardly tell laws apart: "
        f"{what} was found in predictions one sample ahead, for which an observer lets the simulator forget its past "
        f"within {memory:.3g} s. The values and errors here are those of a fit in free run."
    )
    return Gate(", ".join(simulator.output_names), "prediction", memory, sentence, corrected=False)


def unfinished_note(simulator: Simulator, begun: bool) -> Gate:
    """Note that the simulator drifts in a free run, and that there was no time for predictions, or to end them."""
    why = "time ran out before they gave an answer" if begun else "there was no time for them"
    sentence = (
        "In a free run small forces and disturbances add up over the whole recording, so that its errors hardly tell "
        f"laws apart. Predictions one sample ahead often do, but {why}: diagnose with the focus 'prediction' "
        "(--focus prediction), or give more time."
    )
    return Gate(", ".join(simulator.output_names), "prediction", None, sentence, corrected=False)


def observer(simulator: Simulator, recordings: Sequence[Recording], hold: str, memory: float) -> np.ndarray:
    """Compute the gain (n_x, n_y) of an observer that forgets within `memory` seconds.

    The simulator is linearised where the first recording begins. Its outputs count by their deviations, and laws' own
    states get no correction.
    """
    bench = Workbench.of(simulator, recordings, hold)
    model = discretise(simulator, bench.dt, hold, bench.substeps)
    symbols, (_, by_state, _, seen, _) = differentiate_step(model)
    slopes = ca.Function("slopes", symbols, [by_state, seen])
    r, begun = bench.recordings[0], np.zeros(model.n_state)
    if not isinstance(r.initial, str):
        begun[: len(r.initial)] = r.initial
    a, c = (np.asarray(v) for v in slopes(begun, model.drive(r)[0], model.parameters.start))
    a, faster = np.linalg.matrix_power(a, model.substeps), np.exp(bench.dt / memory)
    gain = steady_state_gain(faster * a, c, np.zeros_like(a), np.diag(bench.scale**2)) / faster
    return np.asarray(gain[: len(simulator.states)])
