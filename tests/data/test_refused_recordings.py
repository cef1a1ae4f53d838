"""Recordings and options that `pilfr fit` and `pilfr simulate` refuse: one sentence on stderr, exit status 2."""

import os

import numpy as np
import pytest
from command_line import run
from scipy.io import savemat
from scipy.sparse import csc_array

from pilfr_casadi import PILFR, Recording, fit

M = 400
T = np.arange(M) * 0.01
U = np.random.default_rng(0).normal(size=M)
Y = np.convolve(U, [0.0, 0.5, 0.3, 0.1])[:M]
NAMES = ("--inputs", "u", "--outputs", "y", "--initial", "zero", "--operators", "0", "--nx", "1")


def write_csv(path):
    np.savetxt(path, np.column_stack([T, U, Y]), delimiter=",", header="t,u,y", comments="")
    return path


@pytest.fixture
def train(tmp_path):
    return write_csv(tmp_path / "train.csv")


def refused(capsys, *arguments, says):
    status, _, err = run(capsys, *arguments)
    assert status == 2
    assert err.startswith("pilfr: ") and err.count("\n") == 1 and "Traceback" not in err
    assert says in err


def write_damaged(path):
    np.savez_compressed(path, t=T, u=U, y=Y)
    content = path.read_bytes()
    path.write_bytes(content[:100] + bytes(100) + content[200:])


ODD = {
    "damaged.npz": (write_damaged, "'t' cannot be read"),
    "objects.npz": (lambda p: np.savez(p, t=T, u=U, y=np.array([{}] * M, dtype=object)), "Python objects"),
    "cubes.npz": (lambda p: np.savez(p, t=T, u=U, y=np.ones((M, 2, 2))), "(400, 2, 2)"),
    "sparse.mat": (lambda p: savemat(p, {"t": T, "u": csc_array(U[:, None]), "y": Y}), "sparse matrix"),
    "struct.mat": (lambda p: savemat(p, {"t": T, "u": {"force": U}, "y": Y}), "a struct"),
    "pipe.csv": (os.mkfifo, "a pipe or a device"),
    "loop.csv": (lambda p: p.symlink_to(p), "a link that leads nowhere"),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_files_are_refused(capsys, tmp_path, name):
    write, says = ODD[name]
    write(tmp_path / name)
    refused(capsys, "fit", tmp_path / name, *NAMES, "--out", tmp_path / "out", says=says)
    assert not (tmp_path / "out" / "model.json").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--outputs", "t"), "column 't' holds the time and cannot be an input or an output too"),
        (("--time-tolerance", "nan"), "--time-tolerance nan was given"),
        (("--time-tolerance", "inf"), "--time-tolerance inf was given"),
        (("--time-tolerance", "-1"), "--time-tolerance -1.0 was given"),
    ],
)
def test_options_that_would_switch_a_check_off_are_refused(capsys, tmp_path, train, options, says):
    refused(capsys, "fit", train, *NAMES, "--out", tmp_path / "out", *options, says=says)


def test_a_period_without_an_initial_state_is_refused(capsys, tmp_path, train):
    arguments = [a for a in NAMES if a not in ("--initial", "zero")]
    out = ("--out", tmp_path / "out")
    refused(capsys, "fit", train, *arguments, *out, "--period", 100, says="--period 100 was given without --initial")
    model = tmp_path / "model.json"
    fit(PILFR(1), Recording(U, Y, 0.01, initial="zero")).save(model)
    out = ("--out", tmp_path / "simulated.csv")
    refused(capsys, "simulate", model, train, *out, "--period", 100, says="--initial periodic")
    assert run(capsys, "simulate", model, train, *out, "--period", 100, "--initial", "periodic")[0] == 0
