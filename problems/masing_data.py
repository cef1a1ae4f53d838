r"""Recordings of the rig of `masing`, with the truth behind them.

Source: Krikelis et al. (2024), Sec. 6.2: Tukey-windowed multisines to train and to test, a sine sweep to test, each
output ``y = x2 + e`` with white noise of the variance ``var(x2) 10^(-SNR / 10)``, SNR = 50 dB.

    python -m problems.masing_data         writes the recordings that `pilfr demo` uses
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pilfr_casadi.data import Recording, sine_sweep, steady_periods, tukey_realizations

from .masing import MasingRig, Motion, simulate

FS = 120.0  # Hz
F_MAX = 30.0  # Hz
N_PERIOD = 1024
N_REALIZATIONS = 3
DEMO_SEED = 2024


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The records of one seed and the truth behind them.

    Attributes
    ----------
    records : dict of str to Recording
        ``train``, ``multisine`` and ``sweep``: what an identification may see.
    steady : tuple of Recording
        The flat period of each training realization, for the best linear approximation (Sec. 6.3). Half a period of
        ramp does not settle the rig: the flat period differs from the steady state by some per cent of the output's
        standard deviation, so ``initial`` is "estimate".
    truth : dict of str to Motion
        Noise-free motion under each of the three inputs.
    rig : MasingRig
        The parameters.
    """

    records: dict[str, Recording]
    steady: tuple[Recording, ...]
    truth: dict[str, Motion]
    rig: MasingRig


def benchmark(
    seed: int,
    *,
    snr_db: float = 50.0,
    normalize: Literal["record", "steady"] = "steady",
    rig: MasingRig | None = None,
) -> Benchmark:
    """Data sets of Krikelis et al. (2024), Sec. 6.2, for one seed, and the truth.

    The training record is 3 realizations of a multisine of 1024 samples at 120 Hz, excited up to 30 Hz: half a period
    ramped up, one flat period, half a period ramped down. The multisine test is another such record, ramps included,
    with phases of its own. The sweep runs from 0.1 to 30 Hz at 1.17 Hz/s with unit amplitude. Each output is x2 plus
    white Gaussian noise, the rig starts at rest, and the force is held between samples.

    The paper leaves open whether the multisine or the shaped record has unit standard deviation. Only the former brings
    a linear fit to the published 0.48 on the sweep (`python -m problems.table2 --rows LTI`).

    Parameters
    ----------
    seed : int
        Not negative; equal seeds give equal data.
    snr_db : float
        Variance of x2 over variance of the noise, dB, in each record; ``inf`` for no noise.
    normalize : {"record", "steady"}
        What has unit standard deviation, see :func:`pilfr_casadi.signals.tukey_realizations`.
    rig : MasingRig, optional
        Parameters; those of Table 1 by default.

    Returns
    -------
    Benchmark
    """
    rig = rig or MasingRig()
    phases, fresh_phases, *noises = np.random.default_rng(seed).spawn(5)
    inputs = {
        "train": tukey_realizations(N_REALIZATIONS, N_PERIOD, F_MAX, FS, phases, normalize=normalize),
        "multisine": tukey_realizations(N_REALIZATIONS, N_PERIOD, F_MAX, FS, fresh_phases, normalize=normalize),
        "sweep": sine_sweep(0.1, F_MAX, FS, rate=1.17),
    }
    truth, data = {}, {}
    for (name, u), noise in zip(inputs.items(), noises, strict=True):
        truth[name] = motion = simulate(u, FS, rig=rig)
        y = motion.x2 + 10.0 ** (-snr_db / 20.0) * motion.x2.std() * noise.standard_normal(u.size)
        units = {"u": "N", "x2": "m"}
        data[name] = Recording(u, y, 1.0 / FS, ("u",), ("x2",), units, initial="zero", hold="zero", name=name)
    steady = tuple(
        data["train"].slice(part.start, part.stop).with_(period=N_PERIOD, initial="estimate", name=f"steady {i}")
        for i, part in enumerate(steady_periods(N_REALIZATIONS, N_PERIOD), 1)
    )
    return Benchmark(data, steady, truth, rig)


def records(seed: int) -> dict[str, Recording]:
    """Training, multisine test and sweep test record of one seed; see :func:`benchmark`."""
    return benchmark(seed).records


def write_demo(folder: Path) -> None:
    """Write the demonstration's recordings as CSV, with seven digits."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, r in records(DEMO_SEED).items():
        rows = (f"{t:.9g},{u:.7g},{y:.7g}" for t, u, y in zip(r.t, r.u[:, 0], r.y[:, 0], strict=True))
        (folder / f"{name}.csv").write_text("t,u,x2\n" + "\n".join(rows) + "\n")


if __name__ == "__main__":
    write_demo(Path(__file__).parents[1] / "pilfr_casadi" / "cli" / "demo_data")
