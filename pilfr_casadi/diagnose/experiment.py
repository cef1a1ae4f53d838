"""The next experiment: the input that separates two explanations which the recordings do not tell apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import multiple
from .faults.gates import value_with_unit
from .fits.evidence import BETTER_RATIO
from .fits.workbench import Fitted, Workbench

AMPLITUDES = (0.1, 0.3, 1.0)  # amplitudes tried, as shares of the largest
SINES, TRIANGLES = 12, 5  # frequencies that are tried
LONGEST_EXPERIMENT = 3000  # longest simulated experiment, in samples
VISIBLE_LEVEL = 0.1  # mean of an input over its amplitude, above which a sentence states it
VISIBLE_DIFFERENCE = 0.01  # difference of two answers over the noise, above which a recording shows it


@dataclass(frozen=True, eq=False)
class _Rivals:
    """Two fitted explanations, and the deviation of the outputs' noise (n_y,)."""

    bench: Workbench
    fits: tuple[Fitted, Fitted]
    noise: np.ndarray

    def simulate(self, u: np.ndarray) -> list[np.ndarray]:
        """Simulate both from zero along inputs (M, n_u)."""
        y = np.zeros((len(u), len(self.noise)))
        recording = self.bench.recordings[0].with_(u=u, y=y, initial="zero", period=None, skip=0)
        with np.errstate(all="ignore"):
            return [f.simulate(recording, np.zeros(f.model.n_state)) for f in self.fits]

    def separation(self, y: Sequence[np.ndarray]) -> float:
        """Compute the rms difference of the outputs of both over the noise; zero if one diverges."""
        with np.errstate(all="ignore"):
            value = float(np.sqrt(np.mean(((y[0] - y[1]) / np.maximum(self.noise, 1e-300)) ** 2)))
        return value if np.isfinite(value) else 0.0


def next_experiment(
    bench: Workbench,
    fits: tuple[Fitted, Fitted],
    noise: np.ndarray,
    limits: Mapping[str, float] | None = None,
    rivals: str = "the two",
) -> dict[str, Any] | None:
    """Find the input that separates two fitted explanations, the `rivals`, best.

    `noise` (n_y,) is the deviation of the outputs' noise; `limits` are the largest amplitudes of inputs, by default
    such that they stay within their recorded range. Returns `input`, `waveform`, `level` (its mean), `amplitude`,
    `frequency` (Hz), `separation` (rms difference over the noise), `recorded` (the separation in the recordings) and
    `sentence`; None if nothing within the limits separates them better than the recordings do.
    """
    two, m = _Rivals(bench, fits, noise), min(max(map(len, bench.recordings)), LONGEST_EXPERIMENT)
    best: dict[str, Any] = {}
    swings = np.zeros(len(noise))
    for tried, drive in _experiments(bench, m, limits or {}):
        y = two.simulate(drive)
        value = two.separation(y)
        if not best or value > BETTER_RATIO * best["separation"]:
            best = {**tried, "separation": value}
            swings = np.max([np.ptp(one, axis=0) for one in y], axis=0)
    if not best or best["separation"] < 1.0:
        return None
    recorded = max(two.separation(two.simulate(r.u[:m])) for r in bench.recordings)
    if best["separation"] < BETTER_RATIO * recorded:
        return None
    sentence = _describe_experiment(bench, best, recorded, rivals) + _describe_travel(bench, swings)
    return {**best, "recorded": recorded, "sentence": sentence}


def _experiments(
    bench: Workbench, m: int, limits: Mapping[str, float]
) -> Iterator[tuple[dict[str, str | float], np.ndarray]]:
    """Generate the experiments of m samples that are tried, one input at a time, and their inputs (m, n_u)."""
    u = bench.stacked_inputs
    rest = np.median(u, axis=0)
    for i, name in enumerate(bench.simulator.inputs):
        low, high = float(np.min(u[:, i])), float(np.max(u[:, i]))
        most = limits.get(name, (high - low) / 2)
        for waveform, f, wave in _waves(m, bench.dt):
            for amplitude in (share * most for share in AMPLITUDES):
                # near its usual value, but within what was recorded: many inputs, such as a heater's, have one sign
                least, largest = sorted((low + amplitude, high - amplitude))
                level = float(np.clip(rest[i], least, largest))
                drive = np.tile(rest, (m, 1))
                drive[:, i] = level + amplitude * wave
                shape: dict[str, str | float] = {"input": name, "waveform": waveform, "level": level}
                yield {**shape, "amplitude": amplitude, "frequency": f}, drive


def _waves(m: int, dt: float) -> Iterator[tuple[str, float, np.ndarray]]:
    """Generate the waveforms to try: name, frequency in Hz, and `m` samples of unit amplitude."""
    t = np.arange(m) * dt
    for f in np.geomspace(4 / (m * dt), 0.2 / dt, SINES).tolist():
        yield "sine", f, np.sin(2 * np.pi * f * t)
    for f in np.geomspace(2 / (m * dt), 0.02 / dt, TRIANGLES).tolist():
        yield "triangle", f, 2 / np.pi * np.arcsin(np.sin(2 * np.pi * f * t))


def _describe_experiment(bench: Workbench, best: Mapping[str, Any], recorded: float, rivals: str) -> str:
    """Describe an experiment; `recorded` is the separation in the recordings."""
    unit = bench.unit_of(best["input"])
    so_far = f"by {multiple(recorded)} times" if recorded > VISIBLE_DIFFERENCE else "not at all"
    about = abs(best["level"]) > VISIBLE_LEVEL * best["amplitude"]
    swing = value_with_unit(best["amplitude"], unit)
    level = f" about {value_with_unit(best['level'], unit)}" if about else ""
    return (
        f"A {best['waveform']} of {best['frequency']:.3g} Hz with amplitude {swing}{level} at "
        f"{best['input']} separates {rivals} best: their outputs then differ by {best['separation']:.3g} times the "
        f"noise (in these recordings {so_far})."
    )


def _describe_travel(bench: Workbench, swings: np.ndarray) -> str:
    """Warn of the output that would leave most the range over which it was recorded, if one would."""
    known = np.max([np.ptp(r.y, axis=0) for r in bench.recordings], axis=0)
    i = int(np.argmax(swings / np.maximum(known, 1e-300)))
    if not swings[i] > known[i]:
        return ""
    name = bench.simulator.output_names[i]
    unit = bench.unit_of(name)
    return (
        f" By the simulation {name} would vary over {value_with_unit(swings[i], unit)}; in these recordings it varies "
        f"over {value_with_unit(known[i], unit)}."
    )
