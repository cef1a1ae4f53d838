"""Cross-validation: every sample is held out once, and nothing whose input is in what is fitted."""

import numpy as np
import pytest
from command_line import refused, write_csv
from run_files import ALONE, changed

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.data import repeats_itself, same_input
from pilfr_casadi.studies import fold, jobs


def test_folds_hold_out_every_sample_once(folder):
    r = pilfr.read(folder / "train.csv", "u", "y", initial="zero")
    seen = []
    for k in range(4):
        train, held = fold([r], k, 4)
        assert sum(map(len, train)) + sum(map(len, held)) == len(r)
        assert all(np.isin(part.u[0], r.u).all() for part in train) and train[0].initial == (
            "zero" if k else "estimate"
        )
        seen.append(held[0].u)
    assert np.array_equal(np.concatenate(seen), r.u)
    three = [r.with_(name=str(k), u=np.random.default_rng(k).normal(size=len(r))) for k in range(3)]
    assert [[part.name for part in fold(three, k, 2)[1]] for k in range(2)] == [["0", "2"], ["1"]]
    with pytest.raises(InputError, match="too few for 30 folds"):
        fold([r], 0, 30)


def test_other_folds_are_other_jobs(folder, monkeypatch):
    """How recordings are dealt is no entry of the run file; results of another dealing must not be taken for these."""
    path = changed(
        folder, ALONE, ("count = 4", "count = 1"), ("report = false", "folds = 2\nreport = false"), ("[1, 3]", "[0]")
    )
    assert set(pilfr.campaign(path).done) == {
        "operators-0_fold-0_seed-0",
        "operators-0_fold-1_seed-0",
        "operators-0_seed-0",
    }
    assert pilfr.campaign(path).done == ()

    def otherwise(recordings, k, folds):
        return tuple(tuple(r.with_(skip=r.skip + 5) for r in part) for part in fold(recordings, k, folds))

    monkeypatch.setattr(jobs, "fold", otherwise)
    assert set(pilfr.campaign(path).done) == {"operators-0_fold-0_seed-0", "operators-0_fold-1_seed-0"}
    monkeypatch.undo()
    swapped = {k: fold([pilfr.read(folder / "train.csv", "u", "y", initial="zero")], 1 - k, 2) for k in range(2)}
    monkeypatch.setattr(jobs, "fold", lambda recordings, k, folds: swapped[k])
    assert len(pilfr.campaign(path).done) == 2


def test_the_fold_without_a_model_is_named(folder, monkeypatch):
    path = changed(
        folder, ALONE, ("count = 4", "count = 1"), ("report = false", "folds = 2\nreport = false"), ("[1, 3]", "[0]")
    )
    calls, identify = [], jobs.identify

    def fails_once(*given, **options):
        calls.append(given)
        if len(calls) == 2:
            raise InputError("no model today.")
        return identify(*given, **options)

    monkeypatch.setattr(jobs, "identify", fails_once)
    with pytest.raises(InputError, match="can be judged; operators-0_fold-1_seed-0: Failed: no model today"):
        pilfr.campaign(path)


def test_folds_of_steady_periods_are_refused(capsys, folder):
    """Whatever block is held out, the others have its input: it would prove nothing."""
    wave = np.random.default_rng(3).normal(size=100)
    for name in ("train", "test"):
        write_csv(folder / f"{name}.csv", m=300, u=np.tile(wave, 3))
    once = ("report = false", "report = false\nfolds = 3")
    for path in (changed(folder, once), changed(folder, once, ('"zero"', '"periodic"\nperiod = 100'))):
        refused(capsys, "campaign", path, says=("folds = 3 was given", "proves nothing; give other realizations"))
    r = pilfr.read(folder / "train.csv", "u", "y", initial="periodic", period=100)
    other = r.with_(u=np.tile(np.random.default_rng(4).normal(size=100), 3), name="other")
    with pytest.raises(InputError, match="give folds = 2, other realizations"):
        fold([r, other, r], 0, 3)
    dealt = [fold([r, other, r], k, 2) for k in range(2)]  # records of one input are held out together
    assert [[len(part) for part in parts] for parts in dealt] == [[1, 2], [2, 1]]
    assert not repeats_itself(r.slice(0, 140)) and repeats_itself(r.slice(0, 160)) and not same_input(r, other)
    assert same_input(r.slice(0, 100), r.slice(30, 280))
