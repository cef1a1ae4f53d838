"""Table 2 of the paper in a tiny configuration: every row can be fitted, and what is printed is what was found."""

import numpy as np
import pytest

from pilfr_casadi.models import PILFR
from problems import table2
from problems.masing_figures import draw, loop_width


@pytest.mark.slow
def test_the_command(capsys, tmp_path):
    wanted = ["--rows", "LTI", "N=5, paper", "nx=5, n=5", "--starts", "2", "--network-starts", "1", "--workers", "1"]
    table2.main([*wanted, "--seed", "101", "--figures", str(tmp_path)])
    said = capsys.readouterr().out
    for words in (
        "LTI, 5th order",
        "(0.3026)",
        "(0.0441)",
        "(0.3982)",
        'cells with "paper\'s start"',
        "failed",
        "baselines over",
    ):
        assert words in said
    assert "default fit" not in said
    assert {p.name for p in tmp_path.iterdir()} == {
        "fig03_operators.png",
        "fig07_loops.png",
        "fig08_linear.png",
        "fig11_starts.png",
    }
    assert "approximately 3 Hz" in said and "3.25 Hz" in said


def test_every_published_row_is_there():
    rows = table2.rows(3, 2)
    published = {row.published for row in rows if row.published}
    assert published == {*table2.PUBLISHED, *table2.BASELINES}
    assert len({row.name for row in rows}) == len(rows)
    assert {row.starts for row in rows} == {1, 2, 3, 8}


def test_percentiles_and_failures():
    errors = np.array([[0.1, 0.2, np.inf], [0.2, 0.3, 0.4], [0.3, 0.3, 0.3], [0.1, 0.1, np.inf]])
    result = table2.Result(table2.Row("row", PILFR(5), 4, published="LTI"), errors, None, 0.0)
    np.testing.assert_allclose(result.percentile(25), [0.1, 0.175, 0.375])
    assert np.isinf(result.percentile(75)[2])
    assert result.failed(linear=0.3) == 0.75  # two diverge, one is no better than the linear model
    assert "unstable" in table2.line(result, 0.3) and "(0.3026)" in table2.line(result, 0.3)


def test_no_such_row():
    with pytest.raises(SystemExit):
        table2.main(["--rows", "nonsense"])


def test_the_width_of_an_ellipse():
    t = np.linspace(0, 4 * np.pi, 400)
    assert loop_width(3 * np.sin(t), np.cos(t)) == pytest.approx(6, rel=1e-3)
    assert loop_width(np.sin(t), np.sin(t)) == pytest.approx(0, abs=1e-9)


def test_claims_without_rows(tmp_path):
    said = draw(101, {}, tmp_path)
    assert "Fig. 8" in said and "Fig. 9" not in said
