"""What problems with drawn machines share: the truth's integration, its excitation, and the command that diagnoses."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pilfr_casadi import Diagnosis, Recording, Simulator, diagnose

Flow = Callable[[np.ndarray, Any], np.ndarray]  # from states and inputs to the states' derivatives
Drawn = tuple[Simulator, Recording, Recording]  # the simulator, a training and a test recording


def advance(flow: Flow, x: np.ndarray, u: Any, dt: float, steps: int) -> np.ndarray:
    """Move the states x on by dt, s, with held inputs u: Runge-Kutta of fourth order in `steps` steps."""
    h = dt / steps
    for _ in range(steps):
        k1 = flow(x, u)
        k2 = flow(x + h / 2 * k1, u)
        k3 = flow(x + h / 2 * k2, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + flow(x + h * k3, u))
    return x


def trajectory(flow: Flow, x: np.ndarray, u: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """States (M, n_x) at the samples, from x at the first one, with the inputs u (M,) or (M, n_u) held between them."""
    out = np.empty((len(u), len(x)))
    for k, held in enumerate(u):
        out[k] = x
        x = advance(flow, x, held, dt, steps)
    return out


def random_sines(
    rng: np.random.Generator, t: np.ndarray, band: tuple[float, float], lines: int, peak: float, roll_off: float = 0.0
) -> np.ndarray:
    """Sum of sines at random frequencies in a band, Hz, with amplitudes ~ f^-roll_off, scaled to a peak; shape (M,)."""
    low, high = np.log(band)
    f, phases = np.exp(rng.uniform(low, high, lines)), rng.uniform(0, 2 * np.pi, lines)
    out = np.sum(np.sin(2 * np.pi * np.outer(t, f) + phases) / f**roll_off, axis=1)
    return np.asarray(out * (peak / np.max(np.abs(out))))


def case_parser(description: str | None, cases: int, of: str = "") -> argparse.ArgumentParser:
    """Make the parser of a problem whose cases are drawn anew for every seed."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=cases, help=of or None)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--workers", type=int, default=2)
    return parser


@dataclass(frozen=True, eq=False)
class Answer:
    """A diagnosis of a drawn machine, and the seconds it took."""

    found: Diagnosis
    seconds: float

    @property
    def named(self) -> list[tuple[str, str]]:
        """The ports and laws that were named."""
        return [(e.port, e.law) for e in self.found.effects]

    @property
    def errors(self) -> tuple[float, float, float]:
        """The test errors before and after the correction, and the noise, as NRMSE."""
        test = self.found.errors["test"]
        assert test is not None
        return test["before"], test["after"], self.found.floor["nrmse"]

    def is_right(self, port: str, law: str) -> bool:
        """Say whether the law alone was named at the port; without a law, whether the simulator was found complete."""
        return self.named == [(port, law)] if law else self.found.verdict == "complete"

    def show(self, case: str) -> None:
        """Print a line: the case, what was named, and the errors."""
        effects = (f"{e.law} ({e.form or 'plain'}) at {e.port} {e.confidence:.2f}" for e in self.found.effects)
        before, after, noise = self.errors
        print(
            f"{case} {', '.join(effects) or self.found.verdict:55} "
            f"test {before:.4f} -> {after:.4f}, noise {noise:.4f}, {self.seconds:.0f} s",
            flush=True,
        )


def diagnose_case(drawn: Drawn, workers: int) -> Answer:
    """Diagnose a drawn machine."""
    simulator, train, test = drawn
    began = time.perf_counter()
    found = diagnose(simulator, train, test=test, workers=workers)
    return Answer(found, time.perf_counter() - began)


def numbered(options: argparse.Namespace) -> Sequence[int]:
    """The numbers of the cases that the options of `case_parser` ask for."""
    return range(options.first, options.first + options.cases)
