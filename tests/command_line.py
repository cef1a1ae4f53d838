"""What tests of the command line share: a recording in a file, commands in this process, and how input is refused."""

import numpy as np

from pilfr_casadi.cli import main


def write_csv(path, seed=0, m=600, **columns):
    """A recording of a play behind a first-order lag, with columns replaced or added."""
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.standard_normal(m))
    u -= np.linspace(u[0], u[-1], m)
    q, x, y = 0.0, 0.0, []
    for value in u:
        q = max(value - 1.0, min(value + 1.0, q))
        y.append(x + 0.3 * q)
        x = 0.8 * x + 0.2 * q
    data = {"t": np.arange(m) * 0.01, "u": u, "y": np.array(y) + 1e-3 * rng.standard_normal(m), **columns}
    rows = zip(*data.values(), strict=True)
    path.write_text(",".join(data) + "\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    return path


def run(capsys, *arguments):
    """Exit status, stdout and stderr of a command run in this process."""
    status = main([str(a) for a in arguments])
    out = capsys.readouterr()
    return status, out.out, out.err


def fit_arguments(train, tmp_path, *more):
    names = ("--inputs", "u", "--outputs", "y", "--initial", "zero")
    return ("fit", train, *names, "--nx", 1, "--operators", 3, "--starts", 2, "--out", tmp_path / "out", *more)


def sentence(err):
    """The one sentence on stderr, which lines of progress may come before."""
    *before, last = err.splitlines()
    assert last.startswith("pilfr: ") and err.count("pilfr: ") == 1 and "Traceback" not in err, err
    assert len(before) < 20, err
    return last


def refused(capsys, *arguments, says):
    """Assert the contract on bad input: status 2, one sentence on stderr that says it, no traceback."""
    status, _, err = run(capsys, *arguments)
    assert status == 2, err
    for word in says if isinstance(says, tuple) else (says,):
        assert word in sentence(err), err
