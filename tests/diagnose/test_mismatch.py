"""Residuals with a known home are found there; numbers do not depend on units."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import mismatch

DT, M = 0.005, 4000
T = np.arange(M) * DT


def motion(seed=0):
    """A narrow-band motion whose amplitude swells and fades several times."""
    rng = np.random.default_rng(seed)
    return np.sin(2 * np.pi * 2.0 * T + rng.uniform(0, 6)) * (1.05 - np.cos(2 * np.pi * 0.15 * T)) / 2


def described(residual, y=None, floor=1e-4, scale=None, factor=1.0, **more):
    y = motion() if y is None else y
    r = Recording(y, factor * (y - np.nan_to_num(residual)), DT, **more)
    scale = np.array([np.std(y)]) if scale is None else scale
    residual, y = (np.reshape(v, (len(v), -1)) * factor for v in (residual, y))
    return mismatch([r], [residual], [y], np.array([floor * factor]), scale * factor)


def noise(size, seed=1):
    return size * np.random.default_rng(seed).standard_normal(M)


@pytest.mark.parametrize("frequency", [1.3, 7.0, 23.0, 61.0])
def test_a_tone_is_found_in_its_band(frequency):
    found = described(0.1 * np.sin(2 * np.pi * frequency * T) + noise(1e-4))
    bands = found["frequency"]
    k = bands["worst"]
    assert bands["low"][k] <= frequency <= bands["high"][k]
    assert sum(bands["share"]) == pytest.approx(1) and max(bands["share"]) > 0.9
    assert sum(bands["power"]) == pytest.approx(found["rms"] ** 2, rel=0.01)
    assert sum(bands["floor"]) == pytest.approx(found["floor"] ** 2, rel=1e-9)
    assert "Almost all of the mismatch lies between" in found["sentence"]
    assert bands["low"][0] == 0 and bands["high"][-1] == pytest.approx(0.5 / DT)
    assert bands["low"][1:] == bands["high"][:-1]


def test_a_slow_drift_lies_below_the_lowest_band():
    found = described(0.2 * T / T[-1])
    assert found["frequency"]["worst"] == 0
    assert "below 0.2 Hz" in found["sentence"] and "grows toward the end" in found["sentence"]
    assert found["thirds"]["rms"] == sorted(found["thirds"]["rms"])
    assert "fades toward the end" in described(0.2 * (1 - T / T[-1]))["sentence"]


@pytest.mark.parametrize(
    ("power", "words"), [(3, "faster than the motion"), (1, "in proportion to"), (0.3, "grows less than the motion")]
)
def test_growth_with_amplitude(power, words):
    y = motion()
    envelope = (1.05 - np.cos(2 * np.pi * 0.15 * T)) / 2
    found = described(0.1 * envelope**power * np.sin(2 * np.pi * 9 * T))
    assert words in found["sentence"]
    middle = np.convolve(found["amplitude"]["edges"], [0.5, 0.5], "valid")
    slope = np.polyfit(np.log(middle), np.log(found["amplitude"]["rms"]), 1)[0]
    assert slope == pytest.approx(power, abs=0.25 * max(power, 1))
    assert sum(found["amplitude"]["samples"]) == pytest.approx(1)
    assert found["amplitude"]["edges"][-1] == pytest.approx(np.max(np.abs(y)) / np.std(y), rel=0.05)


def test_nothing_above_the_floor():
    found = described(noise(0.01), floor=0.01)
    assert "at the noise floor" in found["sentence"]


def test_standstill_and_speed():
    y = np.sin(2 * np.pi * 1.0 * T)
    still = np.abs(np.cos(2 * np.pi * 1.0 * T)) < 0.3
    carrier = 0.1 * np.sin(2 * np.pi * 40 * T)
    assert "larger near standstill" in described(carrier * still, y)["sentence"]
    assert "larger at high speed" in described(carrier * ~still, y)["sentence"]


def test_level_tells_the_sides_apart():
    y = np.sin(2 * np.pi * 0.5 * T)
    level = described(0.1 * (y > 0.7) * np.sin(2 * np.pi * 30 * T), y)["level"]
    assert level["rms"][0] == 0 and level["rms"][-1] > 0.05
    assert level["edges"] == sorted(level["edges"])


def test_the_map_is_the_bands_and_the_amplitudes():
    found = described(0.1 * np.abs(motion()) * np.sin(2 * np.pi * 17 * T) + noise(1e-3), floor=1e-3)
    rms = np.array(found["map"]["rms"], dtype=float)
    samples = np.array(found["amplitude"]["samples"])
    total = np.sum(rms**2 @ samples)
    assert total == pytest.approx(found["rms"] ** 2, rel=0.05)
    k = int(np.argmax(np.max(rms, axis=1)))
    assert found["map"]["low"][k] <= 17 <= found["map"]["high"][k]


def multisine(rng, lines, n):
    k = np.arange(n)
    return sum(np.cos(2 * np.pi * line * k / n + rng.uniform(0, 6.28)) for line in lines) / np.sqrt(len(lines))


@pytest.mark.parametrize(("law", "kind"), [(lambda u: u**2, "mostly even"), (lambda u: u**3, "mostly odd")])
def test_even_and_odd_distortion(law, kind):
    rng = np.random.default_rng(3)
    n = 1024
    odd = np.arange(1, 120, 2)
    lines = np.setdiff1d(odd, rng.choice(odd, 15, replace=False))
    u = np.tile(multisine(rng, lines, n), 3)
    e = 0.05 * law(u) + 1e-4 * rng.standard_normal(len(u))
    r = Recording(u, u - e, DT, period=n, initial="periodic")
    found = mismatch([r], [e[:, None]], [u[:, None]], np.array([1e-4]), np.array([np.std(u)]))
    d = found["distortion"]
    strong, weak = (d["even"], d["odd"]) if kind == "mostly even" else (d["odd"], d["even"])
    assert strong > 20 * weak and weak < 3 * d["noise"]
    assert kind in found["sentence"]


def test_no_word_on_distortion_where_the_input_cannot_tell():
    assert described(noise(0.1))["distortion"] is None
    rng = np.random.default_rng(0)
    u = np.tile(multisine(rng, np.arange(1, 100), 1024), 2)
    r = Recording(u, u, DT, period=1024, initial="periodic")
    e = 0.1 * (u**2)[:, None]
    assert mismatch([r], [e], [u[:, None]], np.array([1e-3]), np.array([1.0]))["distortion"] is None


@settings(max_examples=20, deadline=None)
@given(st.floats(-9, 9), st.integers(0, 5))
def test_units_do_not_matter(exponent, seed):
    residual = 0.1 * motion(seed) ** 3 + noise(1e-3, seed)
    a, b = described(residual), described(residual, factor=10.0**exponent)
    a.pop("scale"), b.pop("scale")
    assert a["sentence"] == b["sentence"]
    assert np.allclose(a["frequency"]["share"], b["frequency"]["share"], rtol=1e-6, atol=1e-9)
    assert np.allclose(a["amplitude"]["rms"], b["amplitude"]["rms"], rtol=1e-6)


def test_many_recordings_and_outputs_and_odd_ones():
    rng = np.random.default_rng(0)
    records, residuals, simulated = [], [], []
    for n, skip in ((700, 0), (1500, 100), (40, 0)):
        y = rng.standard_normal((n, 2)).cumsum(axis=0)
        e = np.column_stack([0.1 * rng.standard_normal(n), np.zeros(n)])
        records.append(Recording(np.zeros(n), y - e, DT, skip=skip, name=f"r{n}"))
        residuals.append(e)
        simulated.append(y)
    found = mismatch(records, residuals, simulated, np.array([0.0, 0.0]), np.array([1.0, 0.0]))
    assert found["outputs"]["y1"] == pytest.approx(1) and "100 % of it is seen in y1" in found["sentence"]
    assert [len(v["t"]) for v in found["time"]] == [24, 24, 24]
    assert found["time"][1]["t"][0] > 100 * DT
    json.dumps(found, allow_nan=False)


def test_a_recording_of_which_one_sample_is_scored():
    rng = np.random.default_rng(0)
    r = [Recording(np.zeros(m), rng.standard_normal(m), 0.01, "u", "y", skip=s) for m, s in ((400, 0), (40, 39))]
    found = mismatch(r, [0.1 * v.y for v in r], [v.y for v in r], 1e-4, np.ones(1))
    json.dumps(found, allow_nan=False)
    assert len(found["time"]) == 2


def test_a_diverging_simulation_still_gives_numbers():
    e = np.full(M, np.nan)
    e[:100] = 0.1
    found = described(e)
    assert found["rms"] > 0
    assert json.dumps(found, allow_nan=False)  # nothing that JSON cannot hold
