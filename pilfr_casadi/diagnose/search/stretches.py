"""Long records: the search runs on the most informative stretches, the final fits on everything.

A search fits hundreds of hypotheses. If the training recordings have more samples than it can use in minutes, it runs
on a few stretches of them. Neighbouring stretches of a long record are much alike, and rare ones add most. Therefore
each candidate stretch gets features, and stretches far apart in them are chosen (farthest-point selection, Gonzalez
1985):

- For each port, the size of the residual that forces of a family explain there beyond the simulator's own parameters,
  along a run of the simulator as given. The families are smooth forces of position and rate, hysteresis, and a slow
  relaxation; the catalogue's laws are near their span.
- Amplitude, rate and operating point of each channel.

The initial state of a stretch from within a recording is estimated, with the memory of laws. All its samples are
scored, because a state before unscored samples is hardly determined and could be far outside the recorded range.

The likeliest hypotheses are then fitted to everything, by normal equations that are summed over the recordings piece by
piece (`optimise.Problem.normal`), so that memory does not grow with their length. A hypothesis that all recordings
together refute is dropped; errors, values and standard errors come from all recordings.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..._base import InputError, side_by_side
from ...data import Recording
from ...engine import Engine
from ...laws import Creep, StopHysteresis
from ...models import Model
from ...optimise import GaussNewton, estimate_initial_state, samples_for_state
from ...simulators import Simulator
from ..faults.gates import Gate
from ..fits.flexible_forces import Surface
from ..fits.linearise import Probe, loudest_stretch, run
from ..fits.screen import Dose, Remainder, orthonormal
from ..fits.workbench import DIVERGED, FEW, CompiledSimulator, Fitted, Workbench, output_deviation, refit
from .hypotheses import Findings, likeliest
from .moves import Search
from .trials import Trial

SEARCHED_SAMPLES = 60_000  # samples of the training recordings up to which everything is searched: effort
STRETCH_SHARE, LONG_STRETCHES = 2 / 3, 10  # share of these samples in all stretches together, and number of long ones
MOST_STRETCHES = 100  # stretches that are searched at most: each has an initial state of its own to estimate
SHORTEST_STRETCH = 500  # least length of a stretch in samples: a law with memory needs some history
MOST_LINEARISED = 300  # stretches that are linearised at most
LINEARISED_SAMPLES = 1000  # samples of each that are linearised
FAMILIES = (Surface, StopHysteresis, Creep)  # the catalogue's laws are near the span of these forces
# few steps suffice from the values on the stretches
FINAL = GaussNewton(max_iterations=40, tolerance=1e-5, patience=3)


@dataclass(frozen=True)
class Stretch:
    """Samples `begin` up to `end` of a training recording, counted from zero."""

    recording: int
    begin: int
    end: int

    def __len__(self) -> int:
        return self.end - self.begin

    def cut(self, recordings: Sequence[Recording]) -> Recording:
        """Cut the stretch out of its recording; a whole recording is returned as it is."""
        r = recordings[self.recording]
        if len(self) == len(r):
            return r
        name = f"{r.name or f'recording {self.recording + 1}'} from {self.begin * r.dt:.6g} s"
        return r.slice(self.begin, self.end).with_(name=name)


@dataclass(frozen=True, eq=False)
class Stretches:
    """All training recordings, and the stretches of them that a search uses."""

    recordings: tuple[Recording, ...]
    chosen: tuple[Stretch, ...]

    def cut(self) -> tuple[Recording, ...]:
        """Cut the chosen stretches out of the recordings."""
        return tuple(s.cut(self.recordings) for s in self.chosen)

    def note(self, fitted_to_all: bool = True) -> Gate:
        """Say how much was searched, and whether the final fits use everything."""
        lengths = sorted({len(s) for s in self.chosen})
        size = f"{lengths[0]}" if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]}"
        total, count = sum(map(len, self.recordings)), len(self.chosen)
        of = f"{total} samples" if len(self.recordings) == 1 else f"{len(self.recordings)} recordings, {total} samples"
        sentence = (
            f"The search ran on {count} stretch{'es' if count > 1 else ''} of {size} samples, chosen from {of} by what "
            "they tell of missing forces; "
        )
        sentence += (
            "the final fits use everything."
            if fitted_to_all
            else "from the whole recordings the refitted simulation runs away, so that values and errors are those of "
            "the stretches."
        )
        return Gate("recordings", "stretches", sum(map(len, self.chosen)), sentence, corrected=False)

    def everything(self, bench: Workbench, gates: Sequence[Gate]) -> Workbench:
        """Return a bench of the stretches with all recordings in their place, corrected by the gates."""
        recordings, places = list(self.recordings), [(s.recording, s.begin) for s in self.chosen]
        for gate in gates:
            recordings = gate.apply_to_whole(recordings, places)
        scale = output_deviation(recordings)
        noise2 = None if bench.noise2 is None else bench.noise2 * (bench.scale / scale) ** 2
        return replace(bench.on(recordings), scale=scale, noise2=noise2)


def choose_stretches(
    simulator: Simulator,
    recordings: Sequence[Recording],
    hold: str,
    engine: str = "auto",
    most: int = SEARCHED_SAMPLES,
    workers: int = 1,
) -> tuple[Stretch, ...]:
    """Choose the stretches of recordings that say most about missing forces; see the module docstring.

    They have two thirds of `most` samples together, up to which everything would be searched.
    """
    length = max(int(STRETCH_SHARE * most) // LONG_STRETCHES, SHORTEST_STRETCH)
    stretches = [s for i, r in enumerate(recordings) for s in divide(i, len(r), r.skip, length)]
    usual = float(np.mean([s.end - s.begin for s in stretches]))  # shorter than asked for where the recordings are
    count = int(np.clip(STRETCH_SHARE * most / usual, 1, MOST_STRETCHES))
    signals = signal_features(recordings, stretches)
    if len(stretches) > MOST_LINEARISED:
        kept = spread_out(signals, MOST_LINEARISED, int(np.argmax(np.sum(signals**2, axis=1))))
        kept = sorted(kept)
        stretches, signals = [stretches[k] for k in kept], signals[kept]
    explained = force_features(simulator, recordings, stretches, hold, engine, workers)
    strength = signals if explained is None else explained
    features = signals if explained is None else np.hstack([explained, signals])
    chosen = spread_out(features, count, int(np.argmax(np.sum(strength**2, axis=1))))
    return tuple(sorted((stretches[k] for k in chosen), key=lambda s: (s.recording, s.begin)))


def divide(recording: int, samples: int, skip: int, length: int) -> list[Stretch]:
    """Divide a recording into stretches of about equal length; the first begins with its skipped samples."""
    edges = np.linspace(skip, samples, max(round((samples - skip) / length), 1) + 1).astype(int)
    edges[0] = 0
    return [Stretch(recording, int(a), int(b)) for a, b in pairwise(edges)]


def spread_out(features: np.ndarray, count: int, first: int) -> list[int]:
    """Select `count` rows of features (n, k), from `first` on each as far as possible from the rows before it."""
    chosen = [first]
    distance = np.sum((features - features[first]) ** 2, axis=1)
    while len(chosen) < min(count, len(features)):
        distance[chosen] = -1.0
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((features - features[chosen[-1]]) ** 2, axis=1))
    return chosen


def signal_features(recordings: Sequence[Recording], stretches: Sequence[Stretch]) -> np.ndarray:
    """Compute mean, deviation and rate of each channel in each stretch, (n, 3 n_channels).

    Each is divided by its largest value in any stretch and by the root of their number.
    """
    rows = []
    for s in stretches:
        r = recordings[s.recording]
        v = np.column_stack([r.u[s.begin : s.end], r.y[s.begin : s.end]])
        rows.append(np.concatenate([v.mean(axis=0), v.std(axis=0), np.sqrt(np.mean(np.diff(v, axis=0) ** 2, axis=0))]))
    found = np.array(rows)
    means = found.shape[1] // 3
    found[:, :means] -= found[:, :means].mean(axis=0)
    largest = np.max(np.abs(found), axis=0)
    # a channel's mean is an operating point only relative to its amplitude
    largest[:means] = np.maximum(largest[:means], largest[means : 2 * means])
    return np.asarray(found / np.where(largest > 0, largest, 1.0) / np.sqrt(found.shape[1]))


def force_features(
    simulator: Simulator,
    recordings: Sequence[Recording],
    stretches: Sequence[Stretch],
    hold: str,
    engine: str,
    workers: int,
) -> np.ndarray | None:
    """Compute the size of the residual that each family of forces explains at each port in each stretch, (n, k).

    Each stretch counts where its residual is largest. All sizes are divided by the largest, and by the root of their
    number. None if the simulator as given cannot be run.
    """
    try:
        bench = Workbench.of(simulator, recordings, hold, engine)
        given = bench.compile(simulator)
    except InputError:
        return None
    pieces = [piece for i in range(len(recordings)) for piece in _loudest(bench, given, i, stretches)]
    if not all(np.all(np.isfinite(state)) for _, state in pieces):
        return None
    values = {name: p.value for name, p in given.model.parameters.items()}
    alike = np.ones(len(bench.scale))
    fitted = Fitted(simulator, given.model, given.engine, values, [], [], np.nan, np.nan * alike, alike)
    probe = Probe.of(bench, fitted)

    def explained(piece: tuple[Recording, np.ndarray]) -> dict[tuple[str, str], float]:
        r, state = piece
        part = replace(bench, recordings=(r,))
        rest = Remainder.of(part, probe, [run(part, probe, replace(fitted, initial=[state]), 0)], FAMILIES)
        return {(t.port.name, law.id): _explained_size(rest, d) for t in rest.tasks for law, d in rest.doses(t)}

    rows = side_by_side(explained, pieces, workers)
    keys = sorted(set().union(*rows))
    found = np.array([[row.get(key, 0.0) for key in keys] for row in rows])
    largest = np.max(found, initial=0.0)
    if not (np.isfinite(largest) and largest > 0):
        return None
    return np.asarray(found / largest / np.sqrt(len(keys)))


def _loudest(
    bench: Workbench, given: CompiledSimulator, i: int, stretches: Sequence[Stretch]
) -> Iterator[tuple[Recording, np.ndarray]]:
    """Generate the part of each stretch of recording i with the largest residual as given, and the state before it."""
    r, model = bench.recordings[i], given.model
    p, rows = model.parameters.start, model.substeps
    here = [s for s in stretches if s.recording == i]
    if not here:
        return
    drive, at, state = model.drive(r), 0, _first_state(model, given.engine, r)

    def simulate(begin: int, end: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if end == begin:
            return r.y[:0], state
        with np.errstate(all="ignore"):
            y, after = given.engine.simulate(drive[begin * rows : end * rows], p, state)
        return y, after

    for s in here:  # in the order of their samples
        state = simulate(at, s.begin, state)[1]
        y, after = simulate(s.begin, s.end, state)
        with np.errstate(all="ignore"):
            power = np.nan_to_num(np.sum(((y - r.y[s.begin : s.end]) / bench.scale) ** 2, axis=1), nan=0.0, posinf=0.0)
        part = loudest_stretch(power, LINEARISED_SAMPLES, 0)
        yield (
            r.slice(s.begin + part.start, s.begin + part.stop),
            simulate(s.begin, s.begin + part.start, state)[1],
        )
        at, state = s.end, after


def _explained_size(rest: Remainder, doses: Sequence[Dose]) -> float:
    """Compute the size of the remainder along the forces of a family at a port."""
    base = orthonormal(np.hstack([d.phi for d in doses])) if doses else np.zeros((len(rest.left), 0))
    return float(np.linalg.norm(base.T @ rest.left))


def _first_state(model: Model, engine: Engine, r: Recording) -> np.ndarray:
    """Find the state at a recording's first sample at the model's start values; zero if that diverges."""
    try:
        return np.asarray(estimate_initial_state(model, engine, r, min(samples_for_state(model), len(r) // 3) or None))
    except (InputError, RuntimeError, FloatingPointError, np.linalg.LinAlgError):
        return np.zeros(model.n_state)


# final fits


def fit_to_all(bench: Workbench, fitted: Fitted, time_limit: float) -> Fitted:
    """Fit a simulator to all recordings of a bench from its values on stretches of them.

    Without time, or if the run diverges, the values stay as they are.
    """
    at, start, found = fitted.fitted_model, [fitted.values], None
    states = [_first_state(at, fitted.engine, r) for r in bench.recordings]
    if time_limit > 0:
        solver = replace(FINAL, time_limit=time_limit)
        found = refit(bench, start, fitted.simulator, states=states, solver=solver, like=fitted)
    return found or bench.rerun(fitted, initial=states)


@dataclass(frozen=True, eq=False)
class Everything:
    """The fits to everything: the bench with all recordings, and the fit to it for each fit to the stretches."""

    bench: Workbench
    fits: dict[Fitted, Fitted]

    @classmethod
    def of(cls, search: Search, stretches: Stretches, gates: Sequence[Gate]) -> Everything | None:
        """Fit the likeliest hypotheses of a search to everything, and drop the refuted ones from its memo.

        After an interrupt, or past the deadline, their values stay as they are. None if the refitted simulator runs
        away from the whole recordings.
        """
        whole = stretches.everything(search.bench, gates)
        contenders = [t for t in likeliest(search.memo.values(), search.evidence) if t.laws][:FEW]
        trials = [search.root, *contenders]
        limit = _seconds_left(search) / 2  # the rest is for the simulators that the conclusion adds
        fits = list[Fitted]()
        with search.until_interrupted():
            fits = side_by_side(lambda t: fit_to_all(whole, t.fitted, limit), trials, search.workers, whole.interrupt)
        fits = fits or [fit_to_all(whole, t.fitted, 0.0) for t in trials]
        if not fits[0].cost < DIVERGED:
            return None
        there = replace(search, bench=whole, memo={}, moves=[], findings=defaultdict(Findings))
        for trial, fitted in zip(trials, fits, strict=True):
            there.keep(Trial.of(fitted, len(trial.laws), thorough=True))
        best = max(there.memo.values(), key=there.evidence)
        there.count = there.count_samples(best.fitted)
        kept = {t.key for t in likeliest(there.memo.values(), there.evidence)} | {search.root.key}
        for trial in trials:
            if trial.key not in kept:
                del search.memo[trial.key]
        return cls(whole, {trial.fitted: fitted for trial, fitted in zip(trials, fits, strict=True)})

    def fit(self, search: Search, fitted: Fitted) -> Fitted:
        """Return the fit to everything of a simulator fitted to the stretches."""
        if fitted not in self.fits:
            with search.until_interrupted():
                self.fits[fitted] = fit_to_all(self.bench, fitted, _seconds_left(search))
        if fitted not in self.fits:
            self.fits[fitted] = fit_to_all(self.bench, fitted, 0.0)
        return self.fits[fitted]


def _seconds_left(search: Search) -> float:
    """Return the seconds until the deadline of a search; none after an interrupt."""
    return 0.0 if search.interrupted else search.bench.deadline - time.perf_counter()


def back_on_stretches(bench: Workbench, fitted: Fitted, states: Sequence[np.ndarray]) -> Fitted:
    """Run a fit to everything along the stretches of a bench; only their initial states are fitted, from `states`."""
    parameters = fitted.fitted_model.parameters
    held = fitted.model.with_parameters(parameters.change(**{k: {"fixed": True} for k in parameters}))
    found = bench.fit(fitted.simulator, [fitted.values], states=states, like=replace(fitted, model=held))
    return bench.rerun(fitted, initial=found.initial)
