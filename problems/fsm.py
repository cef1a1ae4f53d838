"""A real fine steering mirror, 3 x 3, at three levels with one model (`python -m problems.fsm`).

CubeSpec fine steering mirror: three piezo actuators in V, three displacements in m; Floren et al. (2024), ISMA-USD, pp.
2042-2052, CC BY 4.0, data not included here. At each level (100, 200, 300 mV) six realizations of orthogonal
random-phase multisines, two periods of 8192 samples in steady state; the sampling rate is not in the files, time is
counted in samples.

One model for all levels that is told nothing but the input. The last realization of each level is held back; what is
reported is its relative error, RMSE / std(y), averaged over outputs and periods. The means of the recordings are zero,
where the mirror rests and creeps is not in them: the models have no offset (`y_0 = 0`), and what mean their own
hysteresis makes counts as an error.

What the combined model is made of was chosen on realization 4, fitted to 1 and 5.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.control import response_bound
from pilfr_casadi.data import Recording, mean_period, noise_weights, period_noise
from pilfr_casadi.identify import Fit, fit
from pilfr_casadi.models import PILFR
from pilfr_casadi.optimise import GaussNewton, Problem, stable

from .fsm_linear import LINES, Y_UNIT, Spectra, first_modes, fitted_levels, simulated
from .fsm_model import combined, envelope_alone, pure
from .measured_data import measured

LEVELS = (100, 200, 300)  # mV
PERIOD, TRAINING, HELD = 8192, (0, 1, 2, 3, 4), 5
LARGEST, SETTLING = 2.0, 20  # V; periods
RADIUS = 0.998  # the largest spectral radius of the linear part: a guarantee for amplitudes that were not seen
NOISY = 0.02  # relative noise of one period above which a realization is said to be noisy
ITERATIONS = (8, 32, 16)  # PI-LFR and envelope; the combined model on some realizations, then on all
PURE, COMBINED = "PI-LFR: stops in the feedback and at inputs", "combined: envelopes, products, input plays"
MODELS = {PURE: "pi_lfr", "envelope alone": "envelope", COMBINED: "combined"}  # with the names of their files
PUBLISHED = (
    ("published: linear, one a level", (8.38, 7.95, 5.63)),
    ("published: linear, one for all", (18.6, 6.6, 16.3)),
    ("published: NL-LFR, one for all", (6.37, 4.84, 4.19)),
)


def recordings(folder: Path) -> list[list[Recording]]:
    """Realizations of each level, two periods each: u1-u3 in V, y1-y3 in m."""
    options: dict[str, Any] = {"period": PERIOD, "initial": "periodic"}
    options["units"] = {f"u{i}": "V" for i in (1, 2, 3)} | {f"y{i}": "m" for i in (1, 2, 3)}
    out = []
    for level in LEVELS:
        u, y = (np.load(folder / f"{x}_{level}mV_train.npy") for x in "uy")
        flat = [[x[:, :, r].transpose(2, 0, 1).reshape(-1, 3) for x in (u, y)] for r in range(u.shape[2])]
        out.append([Recording(a, b, 1.0, name=f"{level} mV, {r + 1}", **options) for r, (a, b) in enumerate(flat)])
    return out


def relative_error(simulation: np.ndarray, recording: Recording) -> float:
    """RMSE / std(y) in %, averaged over outputs and periods; `simulation` is one period."""
    y = recording.y.reshape(-1, PERIOD, 3)
    return 100 * float(np.mean(np.sqrt(np.mean((simulation - y) ** 2, axis=1)) / np.std(y, axis=1)))


def noise_table(data: Sequence[Sequence[Recording]]) -> list[str]:
    """Relative noise of one period of each realization, and which are noisy."""
    lines = ["noise of one period [% of std(y)], from the differences between periods", f"{'realization':>16}"]
    lines[1] += "".join(f"{r + 1:>8}" for r in range(len(data[0])))
    noisy = []
    for level, group in zip(LEVELS, data, strict=True):
        shares = [float(np.mean(period_noise(r) / np.std(r.y, axis=0))) for r in group]
        noisy += [f"{r.name} ({100 * s:.1f} %)" for r, s in zip(group, shares, strict=True) if s > NOISY]
        lines.append(f"{level:>13} mV" + "".join(f"{100 * s:8.2f}" for s in shares))
    return [*lines, f"noisy: {'; '.join(noisy) or 'none'}; they stay in the fit and count less"]


def improved(
    structure: PILFR,
    values: dict[str, Any],
    train: Sequence[Recording],
    options: dict[str, Any],
    iterations: int,
    threads: int,
) -> dict[str, Any]:
    """Values after some iterations over some of the recordings, without what a `Fit` brings."""
    first = train[0]
    model = structure.model(3, 3, values, inputs=first.inputs, outputs=first.outputs)
    problem = Problem(model, train, constraints=[stable(RADIUS)], **options)
    problem.threads = threads
    solution = GaussNewton(max_iterations=iterations, tolerance=1e-3, damping=1e-3).solve(problem)
    return {k: p.value for k, p in model.parameters.at(problem.parameters(solution.theta)).items()}


class Mirror:
    """Recordings, their spectra and weights, and the models that are fitted to them."""

    def __init__(self, folder: Path, threads: int) -> None:
        self.data, self.threads = recordings(folder), threads
        train = [[level[r] for r in TRAINING] for level in self.data]
        weights = noise_weights([r for level in train for r in level]).reshape(len(LEVELS), -1)
        self.train, self.weights = [[mean_period(r) for r in level] for level in train], weights
        relative = weights / np.max(weights, axis=1, keepdims=True)
        self.spectra = [
            Spectra.of(np.stack([r.u for r in level], axis=2), np.stack([r.y for r in level], axis=2), share)
            for level, share in zip(self.train, relative, strict=True)
        ]
        held = [mean_period(level[HELD]) for level in self.data]
        self.held = [Spectra.of(r.u[:, :, None], r.y[:, :, None], np.ones(1)) for r in held]

    def chosen(self, realizations: Sequence[int]) -> tuple[list[Recording], dict[str, Any]]:
        """Training recordings of these realizations, and options with their weights."""
        chosen = [self.train[level][r] for level in range(len(LEVELS)) for r in realizations]
        weights = [self.weights[level][r] for level in range(len(LEVELS)) for r in realizations]
        return chosen, {"weights": weights}

    def linear_errors(self, family: Any, theta: np.ndarray, levels: Sequence[int]) -> list[float]:
        """Errors of the linear family on the held-back realizations."""
        out = []
        for level in levels:
            y, _ = simulated(family, theta, self.held[level], level, PERIOD)
            out.append(relative_error(y[:, :, 0], self.data[level][HELD]))
        return out

    def errors(self, result: Fit) -> list[float]:
        """Errors of a fit on the held-back realizations."""
        return [relative_error(self.held_simulation(result, level), self.data[level][HELD]) for level in range(3)]

    def held_simulation(self, result: Fit, level: int) -> np.ndarray:
        """One simulated period of the held-back realization."""
        return result.simulate(mean_period(self.data[level][HELD]))


def run(
    mirror: Mirror, iterations: tuple[int, int, int], report: Any = print, models: Sequence[str] = tuple(MODELS)
) -> dict[str, Fit]:
    """Fit every model, report each row, and return the hysteretic ones."""
    began = time.perf_counter()

    def row(name: str, errors: Sequence[float], parameters: int | str = "") -> None:
        figures = "".join(f"{e:8.2f}" for e in errors)
        report(f"{name:<44}{figures}{parameters!s:>12}{time.perf_counter() - began:10.0f} s")

    start = first_modes(mirror.spectra[1], PERIOD)
    alone = {}
    for level in (1, 0, 2):
        family, theta = fitted_levels(start, mirror.spectra, [level], 0, PERIOD)
        alone[level] = mirror.linear_errors(family, theta, [level])[0]
        if level == 1:
            start = {"mask": start["mask"], **{k: family.unpack(theta)[k] for k in "ABCD"}}
    row("linear, one a level (told the level)", [alone[level] for level in range(3)], len(theta))
    family, theta = fitted_levels(start, mirror.spectra, [0, 1, 2], 0, PERIOD)
    row("linear, one for all levels", mirror.linear_errors(family, theta, [0, 1, 2]), len(theta))
    family, theta = fitted_levels(start, mirror.spectra, [0, 1, 2], 3, PERIOD)
    row("linear, stiffness of 3 signals by level (told)", mirror.linear_errors(family, theta, [0, 1, 2]), len(theta))
    signals = [simulated(family, theta, mirror.spectra[k], k, PERIOD)[1][:, :, 0] for k in range(3)]
    everything = combined(family, theta, signals, mirror.spectra[1].deviation)
    fits = {}
    for name, (structure, values), steps in (
        (PURE, pure(family, theta, signals), (iterations[0], 3)),
        ("envelope alone", envelope_alone(*everything), (iterations[0], 3)),
        (COMBINED, everything, iterations[1:]),
    ):
        if name in models:
            fits[name] = hysteretic(mirror, structure, values, steps)
            row(name, mirror.errors(fits[name]), int(fits[name].model.parameters.free.sum()))
    return fits


def hysteretic(mirror: Mirror, structure: PILFR, values: dict[str, Any], steps: tuple[int, int]) -> Fit:
    """A model fitted to some of the realizations first, then to all."""
    values = improved(structure, values, *mirror.chosen((0, 4)), steps[0], mirror.threads)
    train, options = mirror.chosen(range(len(TRAINING)))
    solver = GaussNewton(max_iterations=steps[1], tolerance=1e-3, damping=1e-3)
    fixed = {"weights": options["weights"], "workers": mirror.threads}
    return fit(structure, train, start=values, solver=solver, stable=False, constraints=[stable(RADIUS)], **fixed)


def picture(mirror: Mirror, result: Fit, path: Path) -> None:
    """Spectra of the held-back outputs, of what the model leaves and of the noise, per level: lines and their median.

    Amplitudes are root mean squares over the outputs, the noise is that of a mean period; shaded lines are not excited.
    """
    from scipy.ndimage import median_filter

    from pilfr_casadi.plots import canvas

    figure = canvas.new_figure(10.5, 9.0)
    panels: Any = figure.subplots(len(LEVELS), 1, sharex=True, sharey=True)
    for level, panel in enumerate(panels):
        record = mean_period(mirror.data[level][HELD])
        both = mirror.data[level][HELD].y.reshape(2, PERIOD, 3)
        for x, label, colour in (
            (record.y, "output", canvas.GREY),
            (record.y - mirror.held_simulation(result, level), "what the model leaves", canvas.VERMILLION),
            ((both[0] - both[1]) / 2, "noise", canvas.BLUE),
        ):
            size = np.sqrt(np.mean(np.abs(np.fft.rfft(x, axis=0) / PERIOD) ** 2, axis=1))[1:] / Y_UNIT
            lines = np.arange(1, len(size) + 1)
            panel.semilogy(lines, size, ".", markersize=1.5, color=colour, alpha=0.3)
            for part in (lines <= LINES[-1], lines > LINES[-1]):
                smooth = median_filter(size[part], 25, mode="nearest")
                panel.semilogy(lines[part], smooth, color=colour, label=label if part[0] else None)
        panel.axvspan(LINES[-1] + 0.5, PERIOD / 2, color="0.93", zorder=0)
        panel.set(xlim=(0, PERIOD / 2), ylim=(1e-5, 1.0))
        last = level == len(LEVELS) - 1
        canvas.finish(
            panel,
            f"line (cycles a period of {PERIOD} samples)" if last else "",
            "amplitude [µm]",
            f"{LEVELS[level]} mV, held-back realization",
            3,
            legend=level == 0,
        )
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, save the models, draw the spectra."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/fsm"), help="folder for models and picture")
    parser.add_argument("--threads", type=int, default=2, help="recordings that are run at a time")
    parser.add_argument(
        "--iterations", type=int, nargs=3, default=ITERATIONS, help="PI-LFR; combined on some, then on all"
    )
    names = tuple(MODELS.values())
    parser.add_argument("--models", nargs="+", choices=names, default=names, help="which to fit (default: all)")
    options = parser.parse_args(arguments)
    folder = measured("fsm")
    if folder is None:
        print(
            "The mirror's recordings are not here; put them into a folder DATA/fsm and run with PILFR_DATA=DATA, or "
            "put them into shared/data/fsm beside the repository."
        )
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter(), time.process_time()
    mirror = Mirror(folder, options.threads)
    print("\n".join(noise_table(mirror.data)), flush=True)
    print(f"\nrelative error on the held-back realization {HELD + 1} [%]")
    print(f"{'':<44}" + "".join(f"{level:>5} mV" for level in LEVELS) + f"{'parameters':>12}{'time':>12}")
    for name, errors in PUBLISHED:
        print(f"{name:<44}" + "".join(f"{e:8.2f}" for e in errors))
    chosen = [name for name, file in MODELS.items() if file in options.models]
    fits = run(mirror, tuple(options.iterations), lambda line: print(line, flush=True), chosen)
    for name, result in fits.items():
        path = options.out / f"{MODELS[name]}.json"
        result.save(path)
        print(f"model: {path}; {response_bound(result, LARGEST)}")
        left = forgotten(mirror, result)
        print(f"  outputs {SETTLING} periods after a far-off initial state differ by {left:.1e} of their deviation")
    picture(mirror, list(fits.values())[-1], options.out / "spectra.png")
    print(f"picture: {options.out / 'spectra.png'}")
    wall, work = time.perf_counter() - began[0], time.process_time() - began[1]
    print(f"{wall:.0f} s, {work:.0f} s of processor time")
    return 0


def forgotten(mirror: Mirror, result: Fit) -> float:
    """What is left of a wrong initial state, ten times the steady one and of random signs, next to the outputs."""
    record = mean_period(mirror.data[-1][HELD])
    state = result.initial_state(record)
    far = 10 * state * np.random.default_rng(0).choice([-1.0, 1.0], size=len(state))
    far[result.model.n_x :] = np.abs(far[result.model.n_x :])  # mean squares are not negative
    long = record.with_(u=np.tile(record.u, (SETTLING, 1)), y=np.tile(record.y, (SETTLING, 1)), initial=far)
    last = result.simulate(long)[-PERIOD:]
    return float(np.max(np.std(last - result.simulate(record), axis=0) / np.std(record.y, axis=0)))


if __name__ == "__main__":
    raise SystemExit(main())
