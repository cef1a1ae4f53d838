"""The stand-in for the piezo platform, and the rows of Table 3 on a small one."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pilfr_casadi.linear import is_modal
from pilfr_casadi.models import NOE, PILFR
from problems.measured_data import measured
from problems.piezo_platform import PERIODS, Platform, measure
from problems.piezo_stack import recordings
from problems.table3 import (
    Row,
    by_training,
    identify,
    lti,
    main,
    pi_hammerstein,
    pi_lfr,
    rows,
    ss_nn,
    stack_rows,
    table,
)
from problems.table3_figures import quietened

SMALL = Platform(
    modes=((404.0, 0.02, 0.2, 0.3), (1618.0, 0.02, 0.8, 0.7)),
    creep=((0.05, 0.01),),
    elements=40,
    coupling=0.7,
    noise=0.05,
)


def small(realizations=3, **options):
    return measure(800.0, realizations=realizations, n_period=1024, **{"platform": SMALL, **options})


@pytest.mark.slow
def test_the_platform_is_in_steady_state_and_hysteretic():
    u = np.array([10 * np.sin(2 * np.pi * np.arange(256) / 256)])
    one, two = (SMALL.steady(u, settle=n) for n in (6, 8))
    assert np.max(np.abs(one - two)) < 1e-6 * np.ptp(two)
    quarter = 256 // 4
    up, down = two[0, 0], two[0, 2 * quarter]  # at zero voltage on the way up and down
    assert down - up > 0.05 * np.ptp(two)
    half = SMALL.steady(u / 2, settle=6)
    assert np.ptp(half) < 0.99 * np.ptp(two) / 2  # softer for larger swings
    finer = SMALL.steady(u, substeps=32, settle=6)
    assert np.max(np.abs(one - finer)) < 2e-3 * np.ptp(two)


def test_the_noise_floor_is_what_averaging_leaves():
    data = small()
    expected = SMALL.noise / np.sqrt(PERIODS) / np.sqrt(np.mean([np.var(r.y) for r in data.averaged()]))
    assert data.floor() == pytest.approx(expected, rel=0.05)
    loud = np.std(data.recordings[0].y.reshape(PERIODS, -1), axis=0, ddof=1).mean()
    quiet = np.std(quietened(data.recordings[:1])[0].y.reshape(PERIODS, -1), axis=0, ddof=1).mean()
    assert quiet == pytest.approx(loud / np.sqrt(PERIODS))


@pytest.mark.slow
def test_rows_of_a_small_platform_come_in_the_paper_s_order(capsys):
    data = small()
    averaged, floor = data.averaged(), data.floor()
    wanted = {"LTI": Row(lti(6)), "PI-Hamm": Row(pi_hammerstein(6, 8)), "PI-LFR": Row(pi_lfr(6, 8), (0.1, 0.1))}
    with ThreadPoolExecutor(1) as pool:
        fits = table(wanted, averaged[:-1], averaged[-1], floor, pool, explored=1)
    error = {name: one.nrmse(averaged[-1]) for name, one in fits.items()}
    assert error["PI-LFR"] < 1.1 * floor
    assert error["PI-LFR"] < error["PI-Hamm"] < error["LTI"]
    assert error["LTI"] > 2 * floor
    out = capsys.readouterr().out
    assert "(0.1000 0.1000)" in out and f"{error['PI-LFR']:.4f}" in out


def test_the_table_has_every_row_of_the_paper():
    found = rows()
    sizes = [(nx, n) for nx in (8, 15) for n in (10, 20)]
    published = ["LTI nx=8", *(f"NOE lags={nx} n={n}" for nx, n in sizes), *(f"SS-NN nx={nx} n={n}" for nx, n in sizes)]
    published += [f"{kind} nx={nx} N={n}" for kind in ("PI-Hamm", "PI-LFR") for nx, n in sizes]
    assert [name for name, row in found.items() if row.published] == published
    assert all(is_modal(r.model.fixed, r.model.nx) for r in found.values() if isinstance(r.model, PILFR))


def test_the_better_row_is_the_one_of_the_smaller_training_error():
    class Told:  # the data are the errors: larger in training, smaller on the test
        def __init__(self, train, test):
            self.errors = {"train": train, "test": test}

        def nrmse(self, which):
            return self.errors[which]

    fits = {"LTI nx=8": Told(3, 3), "NOE lags=8 n=10": Told(2, 1), "NOE lags=8 n=20": Told(1, 2)}
    said = by_training(fits, "train", "test", 0.5)
    assert said.endswith("LTI nx=8 6.000, NOE lags=8 n=20 4.000")
    assert len(by_training(dict.fromkeys(rows(), Told(1, 1)), "train", "test", 1.0).split(",")) == 2 + 4 * 2 + 1


@pytest.mark.slow
def test_networks_of_a_small_platform():
    data = small()
    averaged, wanted = data.averaged(), {"LTI": Row(lti(6)), "SS-NN": Row(ss_nn(6, 3), None, (20, 5))}
    wanted["NOE"] = Row(NOE(6, 3), None, (20, 5))
    error = {name: identify(row, averaged[:-1]).nrmse(averaged[-1]) for name, row in wanted.items()}
    assert error["SS-NN"] < 0.8 * error["LTI"]
    assert np.isfinite(error["NOE"])


PIEZO = measured("piezo_dbo")


@pytest.mark.skipif(PIEZO is None, reason="the piezo recordings are not beside the repository")
def test_plays_beat_a_linear_model_on_the_real_stack():
    data, wanted = recordings(PIEZO), stack_rows()
    second = data["varying"].with_(skip=len(data["first half"]))
    error = {
        name: identify(wanted[name], [data["first half"]], starts=2).nrmse(second)
        for name in ("LTI nx=1", "PI-LFR nx=1 N=10")
    }
    assert error["PI-LFR nx=1 N=10"] < 0.75 * error["LTI nx=1"]


@pytest.mark.slow
def test_some_rows_of_another_platform(capsys):
    with pytest.raises(SystemExit):
        main(["--rows", "nonsense"])
    main(["--rows", "LTI nx=8", "--coupling", "0.02", "--workers", "1"])
    out = capsys.readouterr().out
    assert out.count("LTI nx=8") == 2 and "LTI nx=15" not in out and "real piezo stack" not in out


@pytest.mark.slow
def test_the_whole_table(capsys, tmp_path):
    main(["--out", str(tmp_path)])
    out = capsys.readouterr().out
    best = next(line for line in out.splitlines() if line.startswith("PI-LFR nx=15 N=20"))
    assert float(best.split()[5]) <= 1.1
    assert {p.name for p in tmp_path.iterdir()} == {"fig13_linear.png", "fig14_test.png", "fig15_hysteresis.png"}
