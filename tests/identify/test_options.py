"""Fits made from a fit keep its options: here noise and weights of recordings."""

import json

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.data import fingerprint
from pilfr_casadi.identify import FitOptions, thin_operators
from problems.constrained import three_plays

WEIGHTS = (1.0, 8.0)
PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 5)


class Watching:
    """Gauss-Newton that stores its problems."""

    def __init__(self):
        self.problems = []

    def solve(self, problem, start=None):
        self.problems.append(problem)
        return pilfr.GaussNewton(max_iterations=30, tolerance=1e-4).solve(problem, start)


@pytest.fixture(scope="module")
def records():
    """Two recordings that disagree: the gain of the second is larger."""
    first, second = three_plays(0, 400), three_plays(1, 400)
    return first, second.with_(y=1.1 * second.y, name="second")


@pytest.fixture(scope="module")
def weighted(records):
    plain = pilfr.fit(pilfr.hammerstein(1, PLAYS), records, starts=1)
    return pilfr.fit(plain, records, weights=WEIGHTS, noise=0.2)


def gain(fit, records):
    return float(np.std(fit.simulate(records[1])) / np.std(records[1].y))


def test_a_refit_keeps_the_weights(records, weighted):
    again = pilfr.fit(weighted, records)
    even = pilfr.fit(weighted, records, weights=(1, 1))
    assert gain(again, records) == pytest.approx(gain(weighted, records), abs=2e-3)
    assert gain(even, records) < gain(weighted, records) - 0.02
    assert again.options.weights == weighted.options.weights and set(even.options.weights.values()) == {1.0}


def test_fits_made_from_a_fit_have_its_weights_and_noise(records, weighted):
    watching = Watching()
    judged = three_plays(2, 300)
    pilfr.fit(weighted, records, solver=watching)
    pilfr.prune(weighted, records, solver=watching)
    thin_operators(weighted, records, 2, solver=watching)
    pilfr.regularization_path(weighted, records, judged, strengths=(1e-3,), solver=watching)
    pilfr.regularization_path(weighted, records, judged, strengths=(1.0,), priors={"w": (0, 1)}, solver=watching)
    assert len(watching.problems) > 10
    for problem in watching.problems:
        np.testing.assert_array_equal(problem.weights, WEIGHTS)
        assert problem.noise == 0.2


def test_fits_made_from_a_fit_take_other_weights(records, weighted):
    watching = Watching()
    options = {"weights": (3.0, 1.0), "noise": 0.1, "solver": watching}
    pruned = pilfr.prune(weighted, records, **options)
    pilfr.regularization_path(weighted, records, three_plays(2, 300), strengths=(1e-3,), **options)
    assert {(*p.weights, p.noise) for p in watching.problems} == {(3.0, 1.0, 0.1)}
    assert list(pruned.options.weights.values()) == [3.0, 1.0] and pruned.options.noise == 0.1


def test_weights_belong_to_recordings_in_any_order(records, weighted):
    watching = Watching()
    pilfr.fit(weighted, records[::-1], solver=watching)
    pilfr.fit(weighted, records[1], solver=watching)
    assert [tuple(p.weights) for p in watching.problems] == [(8.0, 1.0), (8.0,)]
    other = three_plays(5, 400).with_(name="other")
    with pytest.raises(InputError, match=r"recording 'other' is not one of them; give weights="):
        pilfr.fit(weighted, [records[0], other])
    with pytest.raises(InputError, match="3 weights"):
        pilfr.prune(weighted, records, weights=(1, 2, 3))


def test_recordings_that_differ_in_their_time_have_weights_of_their_own(records):
    earlier, later = records[0], records[0].with_(start=5.0)
    weights = FitOptions().updated(weights=(1.0, 3.0), train=[earlier, later]).weights
    assert list(weights.values()) == [1.0, 3.0]


def test_noise_can_be_estimated_again(records, weighted):
    prior = {"w": {"prior": (0.3, 0.1)}}
    held = pilfr.fit(weighted.model.with_parameters(weighted.model.parameters.change(**prior)), records, noise=0.2)
    for given, same in ((None, True), ("estimate", False)):
        watching = Watching()
        pilfr.fit(held, records, noise=given, solver=watching)
        assert (watching.problems[-1].noise == 0.2) is same
    for wrong in (0, -1.0, "some", np.nan, True):
        with pytest.raises(InputError, match="give a number above zero"):
            pilfr.fit(weighted, records, noise=wrong)


def test_a_file_keeps_noise_and_weights(records, weighted, tmp_path):
    weighted.save(tmp_path / "m.json")
    loaded = pilfr.load(tmp_path / "m.json")
    assert loaded.options.noise == 0.2
    assert loaded.options.weights == {fingerprint(r): w for r, w in zip(records, WEIGHTS, strict=True)}
    content = json.loads((tmp_path / "m.json").read_text())
    content["training"]["weights"] = {k: -1.0 for k in content["training"]["weights"]}
    content["version"] = 1
    del content["sha256"]
    (tmp_path / "m.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning), pytest.raises(InputError, match="not above zero"):
        pilfr.load(tmp_path / "m.json")
