"""Figures show what they say, at any scale, without a screen and without touching anybody's settings."""

import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pilfr_casadi import plots
from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Candidate, Fit
from pilfr_casadi.linear import BLA, robust_bla
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, Stop, hammerstein, wiener
from pilfr_casadi.optimise import Iteration, Solution, Status
from pilfr_casadi.plots import canvas

BLOCKS = {
    "A": [[0.6, 0.3], [-0.3, 0.6]],
    "B_u": [[1.0], [0.5]],
    "B_w": [[0.1], [-0.2]],
    "C_y": [[1e-3, 2e-3]],
    "D_yw": [[5e-4]],
    "C_z": [[1.0, 0.3]],
    "D_zu": [[0.2]],
    "w": [[0.5, 0.3, 0.2]],
    "r": [[0.2, 0.9, 1.7]],
}


def example(operator=Play, scale=1.0, linear=True, **more):
    """A fit of a small PI-LFR, its output in millimetres or so times `scale`."""
    structure = PILFR(2, PrandtlIshlinskii(operator, 3))
    values = {name: scale * np.array(v) if name in ("C_y", "D_yw") else v for name, v in BLOCKS.items()}
    model = structure.model(1, 1, values, inputs=("force",), outputs=("x",))
    history = tuple(Iteration(k, 0.5 * 10.0 ** (-k), 0.1) for k in range(5))
    solution = Solution(np.zeros(0), 1e-4, Status.CONVERGED, 4, 0.1, history=history)
    candidates = (Candidate(0, model, np.zeros(0), 0.01, solution),)
    start = structure.linear().model(1, 1, values, inputs=("force",), outputs=("x",)) if linear else None
    units = {"force": "N", "x": "m"}
    return Fit(
        model,
        structure,
        0.01,
        solution,
        (0.01,),
        {},
        candidates=candidates,
        linear=start,
        units=units,
        engine="vm",
        **more,
    )


def record(fitted, noise=0.0, samples=2000, seed=0, **more):
    rng = np.random.default_rng(seed)
    u = 2 * np.sin(np.arange(samples) / 15.0) + rng.normal(size=samples)
    data = Recording(u, np.zeros(samples), fitted.dt, ("force",), ("x",), initial="zero", name="test 1")
    y = fitted.simulate(data)
    return data.with_(y=y + noise * np.std(y) * rng.normal(size=y.shape), **more)


@pytest.fixture(scope="module")
def fitted():
    return example()


@pytest.fixture(scope="module")
def data(fitted):
    return record(fitted, 0.01)


def pixels(figure):
    """The figure as drawn, (height, width, 4)."""
    canvas_ = FigureCanvasAgg(figure)
    canvas_.draw()
    return np.asarray(canvas_.buffer_rgba())


def legend_of(ax):
    return [] if ax.get_legend() is None else [t.get_text() for t in ax.get_legend().get_texts()]


SINGLE = {
    "time": lambda f, d, ax: plots.time(f, d, ax=ax),
    "traces": lambda f, d, ax: plots.traces(f, d, ax=ax),
    "remains": lambda f, d, ax: plots.remains(f, d, ax=ax),
    "spectrum": lambda f, d, ax: plots.spectrum(f, d, ax=ax),
    "output over input": lambda f, d, ax: plots.output_over_input(f, d, ax=ax),
    "loop": lambda f, d, ax: plots.loop(f, d, ax=ax),
    "bare loop": lambda f, d, ax: plots.loop(f, d, bare=True, ax=ax),
    "loading curve": lambda f, d, ax: plots.loading_curve(f, d, ax=ax),
    "weights": lambda f, d, ax: plots.weights(f, d, ax=ax),
    "convergence": lambda f, d, ax: plots.convergence(f, ax=ax),
    "bla": lambda f, d, ax: plots.best_linear_approximation(some_bla(), f.linear, unit="m/N", ax=ax),
    "loops": lambda f, d, ax: plots.loops({"1 Hz": (d.u[:, 0], d.y[:, 0])}, "force [N]", "x [m]", ax=ax),
    "spread": lambda f, d, ax: plots.spread({"5": [0.1, 0.2, 0.3], "10": [0.1, np.inf]}, floor=0.05, ax=ax),
}


def some_bla():
    f = np.linspace(1, 40, 60)
    G = plots.frequency_response(example().linear, f, 0.01)
    return BLA(f, G, 1e-10 * np.ones(G.shape), 1e-8 * np.ones(G.shape), 0.01, 3, 2)


@pytest.mark.parametrize("name", SINGLE)
def test_every_picture_has_labelled_axes_something_on_them_and_no_text_on_text(name, fitted, data):
    ax = SINGLE[name](fitted, data, None)
    assert ax.get_xlabel() or name == "spread"
    assert ax.get_ylabel()
    figure = ax.figure
    assert isinstance(figure, Figure)
    image = pixels(figure)
    assert len(np.unique(image.reshape(-1, 4), axis=0)) > 20
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert np.all(border == 255), "something is cut off at the edge"
    boxes = [t.get_window_extent() for t in (ax.xaxis.label, ax.yaxis.label, ax.title) if t.get_text()]
    boxes += [ax.get_legend().get_window_extent()] if ax.get_legend() else []
    for i, a in enumerate(boxes):
        assert not any(a.overlaps(b) for b in boxes[i + 1 :])
        assert not a.shrunk(0.9, 0.9).overlaps(ax.get_window_extent())
    given = Figure().add_subplot()
    assert SINGLE[name](fitted, data, given) is given


def test_no_screen_no_pyplot_no_settings_changed(tmp_path):
    code = f"""
import json, sys
sys.path.insert(0, {str(tmp_path)!r})
import matplotlib
before = {{k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != "backend"}}
sys.path[:0] = ["tests/plots"]
from test_plots import example, record
f = example(); figure = f.plot(record(f, 0.01)); figure.savefig({str(tmp_path / "fit.svg")!r})
same = all(matplotlib.rcParams[k] == v for k, v in before.items())
print(json.dumps([same, "matplotlib.pyplot" in sys.modules]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=".")
    assert json.loads(done.stdout) == [True, False]


def test_units_are_on_the_axes_and_small_signals_are_scaled(fitted, data):
    ax = plots.time(fitted, data)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "x [10⁻³ m]")
    assert ax.get_lines()[0].get_ydata().max() == pytest.approx(1e3 * data.y.max(), rel=1e-12)
    assert plots.spectrum(fitted, data).get_ylabel() == "x [dB re m/√Hz]"
    assert plots.output_over_input(fitted, data).get_xlabel() == "force [N]"
    bare = replace(fitted, units={})
    assert plots.time(bare, data).get_ylabel() == "x [10⁻³]"
    assert plots.spectrum(bare, data).get_ylabel() == "x [dB re 1/√Hz]"


@pytest.mark.parametrize(
    ("value", "size", "unit"),
    [
        (0.5, 1, "m"),
        (0.02, 1, "m"),
        (2e-3, 1e-3, "10⁻³ m"),
        (7e-7, 1e-6, "10⁻⁶ m"),
        (2e7, 1e6, "10⁶ m"),
        (0, 1, "m"),
        (np.inf, 1, "m"),
    ],
)
def test_scaling_by_thousands(value, size, unit):
    assert canvas.choose_scale(np.array([value, -value]), "m") == (pytest.approx(size), unit)


def test_legends_are_honest(fitted, data):
    from pilfr_casadi.data import nrmse

    shown = legend_of(plots.time(fitted, data))
    linear = nrmse(data.y, plots.linear_simulation(fitted, data))
    assert shown == [
        "measured output",
        f"residual, linear model {100 * linear:.3g} %",
        f"residual, this model {100 * fitted.nrmse(data):.3g} %",
    ]
    assert legend_of(plots.time(replace(fitted, linear=None), data)) == [shown[0], shown[2]]
    perfect = plots.spectrum(fitted, record(fitted))
    assert legend_of(perfect)[-1] == "residual, this model 0 %: nothing to draw"
    pixels(perfect.figure)
    dollars = record(fitted, 0.01, name="$x^2 {\\frac", inputs=("a$b",), outputs=("_y$",))
    for ax in (plots.time(fitted, dollars), plots.output_over_input(fitted, dollars)):
        pixels(ax.figure)  # a dollar sign in a name is not a formula
        assert ax.get_legend().get_title().get_text() == "\\$x^2 {\\frac"


def test_offsets_do_not_flatten_a_picture(fitted, data):
    away = data.with_(y=data.y + 7.0)
    swing = np.ptp(data.y)
    ax = plots.time(fitted, away)  # a model without the offset of the data
    assert legend_of(ax)[0] == f"measured output less its mean {np.mean(away.y):.6g} m"
    assert legend_of(ax)[2].endswith(", less -7 m")
    assert 1e-3 * np.ptp(ax.get_ylim()) < 2 * swing
    for picture in (plots.traces, plots.output_over_input):
        ax = picture(fitted, away)
        assert legend_of(ax)[-1] == "this model, less -7 m"
        assert np.ptp(ax.get_ylim()) < 2 * swing
        assert legend_of(picture(fitted, data))[-1] == "this model"


def test_loops_show_what_is_scored(fitted, data):
    ax = plots.output_over_input(fitted, data.with_(skip=150))
    assert [len(line.get_xdata()) for line in ax.get_lines()] == [len(data) - 150] * 2
    assert len(plots.loop(fitted, data.with_(skip=150)).get_lines()[0].get_xdata()) == len(data) - 150


def test_signals_of_an_element_have_units_where_they_are_inputs_or_outputs(fitted):
    def labels(structure):
        model = structure.model(1, 1, {**BLOCKS, **structure.fixed}, inputs=("force",), outputs=("x",))
        ax = plots.loading_curve(replace(fitted, model=model, structure=structure))
        return ax.get_xlabel(), ax.get_ylabel()

    element = PrandtlIshlinskii(Play, 3)
    assert labels(hammerstein(2, element)) == ("z [N]", "w (model scale)")
    assert labels(wiener(2, element)) == ("z (model scale)", "w [m]")
    assert labels(PILFR(2, element)) == ("z (model scale)", "w (model scale)")


def test_few_operators_have_no_density(fitted, data):
    assert legend_of(plots.weights(fitted, data)) == ["weights w"]
    values = {**BLOCKS, "w": [[0.5, 0.3, 0.2, 0.1]], "r": [[0.2, 0.9, 1.7, 2.0]]}
    model = PILFR(2, PrandtlIshlinskii(Play, 4)).model(1, 1, values, inputs=("force",), outputs=("x",))
    four = replace(fitted, model=model, structure=None)
    assert legend_of(plots.weights(four, data)) == ["weights w (left)", "smoothed density (right)"]


def test_a_simulation_that_runs_away_is_drawn_as_far_as_it_goes(fitted, data):
    values = fitted.model.parameters.change(A={"value": 1.5 * np.eye(2)})
    wild = replace(fitted, model=fitted.model.with_parameters(values))
    for name in ("time", "traces", "remains", "spectrum", "output over input"):
        ax = SINGLE[name](wild, data, None)
        pixels(ax.figure)
        assert np.all(np.abs(ax.get_ylim()) < 1e5)
    with np.errstate(all="ignore"):
        assert "∞" in str(legend_of(plots.time(wild, data))) or "inf" in str(legend_of(plots.time(wild, data)))


@given(st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=1, max_size=3000), st.integers(10, 300))
def test_thinning_keeps_extremes_ends_and_order(values, most):
    y = np.array(values)
    x = np.arange(len(y)) / 7.0
    x_t, y_t = canvas.thin(x, y, most)
    assert len(y_t) <= max(len(y) if len(y) <= most else most + 4, 1)
    assert np.all(np.diff(x_t) > 0)
    assert (x_t[0], x_t[-1]) == (x[0], x[-1])
    if np.any(np.isfinite(y)):
        assert (np.nanmin(y_t), np.nanmax(y_t)) == (np.nanmin(y), np.nanmax(y))


def test_a_million_samples_make_a_small_file():
    x = np.linspace(0, 1, 1_000_000)
    ax = canvas.axes_or_new(None)
    canvas.line(ax, x, np.sin(3000 * x), "long", canvas.BLUE)
    buffer = io.BytesIO()
    ax.figure.savefig(buffer, format="svg")
    assert buffer.tell() < 200_000


def test_dense_loops_are_pixels_in_a_vector_file(fitted):
    buffer = io.BytesIO()
    plots.loop(fitted, record(fitted, samples=30_000)).figure.savefig(buffer, format="svg")
    assert buffer.tell() < 400_000 and b"image/png" in buffer.getvalue()


def test_decibels_of_nothing_are_gaps():
    assert np.array_equal(
        canvas.decibel(np.array([1, 0, 100, np.inf, np.nan])), [0, np.nan, 20, np.nan, np.nan], equal_nan=True
    )
    ax = canvas.axes_or_new(None)
    canvas.limit_depth(ax, np.array([-900.0, 10.0]), np.array([np.nan]))
    assert ax.get_ylim()[0] == 10 - canvas.DECIBEL_RANGE


def test_densities_are_those_of_the_signals():
    rng = np.random.default_rng(0)
    noise, dt = 3.0 * rng.normal(size=20_000), 0.01
    plain = Recording(noise, noise, dt)
    for data in (plain, plain.with_(period=500)):
        f, power = plots.amplitude_density(noise, data)
        assert np.mean(power) == pytest.approx(2 * dt * 9, rel=0.05)  # white: 2 dt σ²
        assert np.sum(power) * f[0] == pytest.approx(9, rel=0.05)  # and the area is the variance
    tone = np.cos(2 * np.pi * 5 * plain.t)
    f, power = plots.amplitude_density(tone, plain.with_(period=500))
    assert f[np.argmax(power)] == 5.0
    assert np.max(power) * f[0] == pytest.approx(0.5, rel=1e-9)


def test_the_residual_of_the_true_model_lies_on_the_noise_line(fitted):
    rng = np.random.default_rng(1)
    period, periods = 256, 6
    steady = []
    for _ in range(4):
        u = np.tile(rng.normal(size=period), periods + 2)
        data = Recording(
            u, np.zeros(len(u)), fitted.dt, ("force",), ("x",), initial="zero", period=period, skip=2 * period
        )
        y = fitted.simulate(data)
        steady.append(data.with_(y=y + 1e-4 * rng.normal(size=y.shape)))
    ax = plots.spectrum(fitted, steady[0], steady=steady)
    lines = dict(zip(legend_of(ax), ax.get_lines(), strict=True))
    residual = next(v for k, v in lines.items() if k.startswith("residual, this model")).get_ydata()
    for label, truth in (("noise", 2 * fitted.dt * 1e-8), ("noise and distortion", None)):
        level = lines[label].get_ydata()
        assert truth is None or np.median(level) == pytest.approx(10 * np.log10(truth), abs=1.0)
        assert label == "noise" or np.median(level) > np.median(residual) + 3
    assert np.median(residual) == pytest.approx(np.median(lines["noise"].get_ydata()), abs=1.0)
    alone = plots.spectrum(fitted, steady[0])
    assert "noise" in legend_of(alone) and "noise and distortion" not in legend_of(alone)


@pytest.mark.parametrize("operator", [Play, Stop])
def test_the_loading_curve_is_that_of_the_operators(operator):
    z = np.linspace(0, 3, 50)
    r, w = np.array(BLOCKS["r"][0]), np.array(BLOCKS["w"][0])
    per_operator = np.maximum(z[:, None] - r, 0) if operator is Play else np.minimum(z[:, None], r)
    assert plots.virgin_curve(example(operator), z) == pytest.approx(per_operator @ w, abs=1e-12)


def test_the_bare_loop_has_no_slope_left(fitted, data):
    z, w = plots.loop(fitted, data, bare=True).get_lines()[0].get_data()
    assert abs(z @ w) < 1e-9 * np.linalg.norm(z) * np.linalg.norm(w)
    assert np.ptp(w) < np.ptp(plots.loop(fitted, data).get_lines()[0].get_ydata())


def test_frequency_response_against_scipy(fitted):
    import control
    from scipy.signal import dfreqresp

    f = np.array([0.0, 1.0, 17.0, 50.0])
    linear = fitted.linear.with_parameters(fitted.linear.parameters.change(D_yu={"value": np.array([[0.3]])}))
    p = {k: linear.parameters[k].value for k in ("A", "B_u", "C_y", "D_yu")}
    _, expected = dfreqresp((*p.values(), 0.01), 2 * np.pi * f * 0.01)
    ours = plots.frequency_response(linear, f, 0.01)
    assert ours.shape == (4, 1, 1)
    assert ours[:, 0, 0] == pytest.approx(expected, rel=1e-12)
    assert np.array_equal(plots.frequency_response(control.ss(*p.values(), 0.01), f, 0.01), ours)
    assert plots.frequency_response(ours, f, 0.01) is ours
    with pytest.raises(InputError, match="without an element"):
        plots.frequency_response(fitted.model, f, 0.01)
    with pytest.raises(InputError, match=r"expected \(4, n_y, n_u\)"):
        plots.frequency_response(ours[:2], f, 0.01)


def test_the_bla_picture_has_every_line_of_the_paper(fitted):
    ax = plots.best_linear_approximation(some_bla(), fitted.linear, unit="m/N")
    assert legend_of(ax) == [
        "measured (BLA)",
        "linear model",
        "error of the linear model: nothing to draw",
        "deviation by noise and distortion",
        "deviation by noise",
    ]
    assert ax.get_ylabel() == "magnitude [dB re 1 m/N]"
    rng = np.random.default_rng(0)
    u = np.tile(rng.normal(size=100), 3)
    single = robust_bla(Recording(u, u + 0.1 * rng.normal(size=300), 0.01, period=100))
    assert legend_of(plots.best_linear_approximation(single)) == ["measured (BLA)", "deviation by noise"]


def test_plot_fit_is_one_figure_of_everything(fitted, data):
    figure = plots.plot_fit(fitted, [data, data.with_(name="again")])
    drawn = [ax for ax in figure.axes if ax.get_xlabel()]
    assert len(drawn) == 2 * 2 + 3
    pixels(figure)
    linear = replace(fitted, model=fitted.linear, linear=None)
    assert [ax.get_xlabel() for ax in linear.plot(data).axes] == ["time [s]", "frequency [Hz]", "iteration"]


def test_studies(fitted):
    groups = {"5": np.linspace(0.01, 0.1, 21), "20": [0.01, 0.02, np.inf, np.nan]}
    ax = plots.spread(groups, published={"5": 0.03}, floor=0.0032, source="published")
    assert legend_of(ax) == ["median; box: quartiles", "published", "noise floor"]
    assert [t.get_text() for t in ax.texts] == ["2\nfailed"]
    figure = plots.compared_spread(
        {"training": groups, "test": groups}, published={"training": {"5": 0.03}}, floor=0.0032
    )
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["training", "test"]
    assert len(figure.legends) == 1
    pixels(figure)


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (lambda f, d: plots.time(f, d, output=1), "The output 1 was given"),
        (lambda f, d: plots.loop(f, d, channel=1), "The channel 1 was given"),
        (lambda f, d: plots.loop(replace(f, model=f.linear), d), "number of channels is 0"),
        (lambda f, d: plots.linear_simulation(replace(f, linear=None), d), "no linear model"),
    ],
)
def test_requests_that_cannot_be_drawn_are_refused(draw, words, fitted, data):
    with pytest.raises(InputError, match=words):
        draw(fitted, data)


# ------------------------------------------------------------------------------------- linear parts and residual tests


def test_a_bode_diagram_draws_both_linear_parts_over_the_measured_response(fitted, data):
    up, down = fitted.plot(data, "bode").axes
    assert up.get_legend_handles_labels()[1] == ["measured (BLA)", "small motions", "large motions"]
    small = fitted.linear_parts()["small motions"]
    f, drawn = up.lines[1].get_data()
    assert np.allclose(drawn, 20 * np.log10(np.abs(small.response(f)[:, 0, 0])), atol=1e-6)
    assert down.get_xlabel() == "frequency [Hz]" and len(down.lines) == 3


def test_poles_and_zeros_are_drawn_in_the_upper_half_plane(fitted, data):
    (ax,) = fitted.plot(data, "poles").axes
    crosses = [line for line in ax.lines if line.get_marker() == "x"]
    expected = [p[p.imag >= 0].real for p in (part.poles for part in fitted.linear_parts().values())]
    assert [list(line.get_xdata()) for line in crosses] == [list(e) for e in expected]
    assert any("Hz" in text.get_text() for text in ax.texts)


def test_residual_tests_have_a_panel_for_the_residual_each_input_and_its_square(fitted, data):
    axes = fitted.plot(data, "residuals", lags=30).axes
    titles = [ax.get_legend().get_title().get_text() for ax in axes]
    assert titles == [f"residual of x with {other}" for other in ("itself", "force", "force²")]
    x, values = axes[1].lines[-1].get_data()
    assert x[0] == -30 and x[-1] == 30 and np.mean(np.abs(values) < 3) > 0.95  # the noise is independent of the force


def test_a_notebook_shows_a_figure_without_pyplot(fitted, data):
    assert fitted.plot(data, "poles")._repr_png_()[:8] == b"\x89PNG\r\n\x1a\n"


def test_pictures_that_cannot_be_drawn_are_refused(fitted, data):
    for kind, signal in (("bode", "output"), ("poles", "input")):
        with pytest.raises(InputError, match=f"{signal} 1 was given, counted from 0; the number of {signal}s is 1"):
            fitted.plot(data, kind, **{signal: 1})
    with pytest.raises(InputError, match="give fit, bode, poles or residuals"):
        fitted.plot(data, "nyquist")
    with pytest.raises(InputError, match="residual tests need at least 32"):
        plots.residual_tests(data.slice(0, 20), [("model", data.y[:20])])
    exact = plots.residual_tests(data, [("exact", data.y), ("model", 0.9 * data.y)])
    assert [label.partition(":")[0] for label in legend_of(exact.axes[0])] == ["model"]


@pytest.mark.parametrize("kind", ["curve", "loop"])
def test_a_curve_is_drawn_from_left_to_right_and_a_loop_along_the_time(kind):
    x = np.repeat([3.0, 0.0, 5.0, 1.0, 4.0], 3) if kind == "curve" else np.sin(np.arange(60) / 5)
    law = np.maximum(x - 1.5, 0) if kind == "curve" else np.sign(np.cos(np.arange(60) / 5))
    ax = plots.force_cloud(plots.Signal("x", x, "V"), plots.Signal("w", law, "N"), x, law)
    drawn = ax.lines[1].get_xdata()
    assert np.array_equal(drawn, np.sort(x)) is (kind == "curve")


def test_a_simulation_that_dwarfs_the_others_leaves_the_picture():
    t = np.arange(500) * 0.01
    y = np.sin(2 * np.pi * t)[:, None]
    r = Recording(y, y, 0.01, ("u",), ("y",))
    ax = plots.compared_traces(r, [("as given", 40 * y + 3.0), ("corrected", 1.05 * y)], 0)
    assert ax.get_ylim() == pytest.approx((-1.365, 1.365), rel=1e-2)
    assert legend_of(ax) == ["measured", "as given (leaves the picture)", "corrected"]
    ax = plots.compared_traces(r, [("as given", 2 * y), ("corrected", 1.05 * y)], 0)
    assert ax.get_ylim()[1] > 2 and legend_of(ax) == ["measured", "as given", "corrected"]
