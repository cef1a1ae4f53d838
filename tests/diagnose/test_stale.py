"""Samples that repeat the one before, among those that never do."""

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.stale import stale_samples


def lost(r, share, seed=0):
    """The recording with some samples that repeat the one before."""
    y = np.array(r.y)
    for k in np.flatnonzero(np.random.default_rng(seed).random(len(y)) < share):
        y[k] = y[max(k - 1, 0)]
    return r.with_(y=y)


@pytest.mark.slow
def test_stale_samples_are_told_and_where():
    (r,) = recordings(count=1)
    (gate,) = stale_samples([lost(r, 0.1)])
    assert (gate.channel, gate.finding, gate.corrected, gate.fault) == ("x2", "stale", False, False)
    assert gate.value == pytest.approx(0.1, abs=0.02)
    found = pilfr.diagnose(rig(OFF), lost(r, 0.1))
    assert found.verdict == "complete" and "stale" in [g.finding for g in found.gates]


@pytest.mark.parametrize("kind", ["clean", "coarse", "resting", "clipped", "encoder"])
def test_a_converter_and_a_rest_are_not_stale(kind):
    (r,) = recordings(count=1)
    y = np.array(r.y)
    if kind == "coarse":
        y = np.round(y / np.std(y), 1) * np.std(y)
    if kind == "resting":
        y[:400] = y[400]
    if kind == "clipped":
        y = np.clip(y, *np.quantile(y, [0.05, 0.95]))
    if kind == "encoder":  # more levels than half of the samples, and slow ways between them
        y = np.round(np.linspace(0, 1, len(y))[:, None] ** 4 + 0.01 * y / np.std(y), 3)
    assert not stale_samples([r.with_(y=y)])
