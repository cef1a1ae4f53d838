"""A plan: what a predictive controller answers with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Plan:
    """What a predictive controller found: inputs (N, n_u), outputs (N, n_y), cost, slack, s, whether it converged.

    `limited` says whether limits of the outputs were asked for; without them the slack is zero.
    """

    inputs: Array
    outputs: Array
    cost: float
    slack: float
    seconds: float
    converged: bool
    limited: bool = True

    @property
    def u(self) -> Array:
        """The input to apply now, (n_u,)."""
        return self.inputs[0]

    def __str__(self) -> str:
        how = "converged" if self.converged else "NOT converged"
        applied = ", ".join(f"{v:.5g}" for v in self.u)
        limits = (
            f"; outputs beyond their limits by {self.slack:.3g}" if self.slack > 0 else "; outputs within their limits"
        )
        return (
            f"plan over {len(self.inputs)} samples, {how} in {1e3 * self.seconds:.2f} ms, cost {self.cost:.5g}\n"
            f"input to apply now: {applied}{limits if self.limited else ''}"
        )

    __repr__ = __str__
