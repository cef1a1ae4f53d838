"""The page is one file that says what it should, escapes what users wrote, and works in a real browser."""

import base64
import hashlib
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import PICTURES, SEEN, browser, in_a_browser, needs_chromium
from diagnosis_example import recorded, rig

from pilfr_casadi._base import InputError, multiple
from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Fit, fit, load
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, block_shapes
from pilfr_casadi.optimise import Iteration, Solution, Status
from pilfr_casadi.plots import chart, machine_map, new_figure
from pilfr_casadi.plots.canvas import BLUE, INK, WholeLocator, finish, line
from pilfr_casadi.report import (
    Code,
    Link,
    Page,
    Picture,
    Section,
    Table,
    Text,
    fit_page,
    fit_report,
    mode_tables,
    number_text,
    uncertain_text,
    write_report,
)
from pilfr_casadi.report.page import python_literal

EVIL = "<script>alert(1)</script>\" onload='x' & $\\frac"


def example(nx=2, n_u=1, n_y=1, channels=1, status=Status.CONVERGED, own=False):
    """A fit with random values and a little of everything that a page shows."""
    rng = np.random.default_rng(0)
    structure = PILFR(nx, PrandtlIshlinskii(Play, 3, channels))
    values = {name: rng.normal(size=shape) for name, shape in block_shapes(nx, n_u, n_y, channels).items()}
    values["A"] = 0.9 * values["A"] / np.max(np.abs(np.linalg.eigvals(values["A"])))
    values["B_w"], values["D_yw"] = 0.05 * values["B_w"], 0.3 * values["D_yw"]
    values["w"], values["r"] = rng.uniform(size=(channels, 3)), rng.uniform(0, 2, (channels, 3))
    names = {"inputs": tuple(f"u{i}" for i in range(n_u)), "outputs": tuple(f"y{i}" for i in range(n_y))}
    model = structure.model(n_u, n_y, values, **names)
    errors = {name: np.full(p.value.shape, 0.01) for name, p in model.parameters.items()}
    solution = Solution(np.zeros(0), 1e-4, status, 4, 0.1, history=(Iteration(0, 1.0, 0.1), Iteration(1, 0.1, 0.2)))
    linear = structure.linear().model(n_u, n_y, {k: values[k] for k in ("A", "B_u", "C_y", "D_yu")}, **names)
    kept = None if own else structure
    return Fit(model, kept, 0.01, solution, (0.01,), {}, errors=errors, linear=linear, units={"u0": "V"}, engine="vm")


def record(fitted, name="", samples=600, seed=1):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(samples, fitted.model.n_u))
    model = fitted.model
    data = Recording(u, np.zeros((samples, model.n_y)), fitted.dt, model.inputs, model.outputs, initial="zero")
    y = fitted.simulate(data)
    return data.with_(y=y + 0.02 * np.std(y) * rng.normal(size=y.shape), name=name)


def square():
    """A small PNG file."""
    figure = new_figure(1, 1)
    ax = figure.add_subplot()
    ax.plot([0, 1])
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


class Reader(HTMLParser):
    """Tags and text of a page, and whether every tag is closed."""

    VOID = ("meta", "link", "img", "br", "hr")

    def __init__(self, html):
        super().__init__()
        self.tags, self.open, self.words = [], [], []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] not in (["script"], ["style"]):
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def own_scripts_alone(html):
    """Whether the policy allows exactly the scripts of a page by their hash, and nothing points to a network."""
    rest = re.sub(r"<script>.*?</script>", "", html, flags=re.S)
    scripts = re.findall(r"<script>(.*?)</script>", html, re.S)
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', html)[1]
    allowed = re.findall(r"'sha256-(.*?)'", policy)
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    return allowed == hashes and len(scripts) == 2 and not re.search(r"<script|https?://|@import|url\(", rest)


def test_users_text_is_text():
    blocks = [Text(EVIL), Code(EVIL), Table([EVIL], [[EVIL]], EVIL, EVIL), Table(["a"], [[1]], EVIL, folded=True)]
    blocks += [Picture(square(), EVIL, EVIL)]
    page = Page(EVIL, [Section(EVIL, blocks)] * 3, EVIL, EVIL, facts={EVIL: EVIL})
    html = page.html()
    reader = Reader(html)
    assert "<script" not in html and not any("onload" in attrs for _, attrs in reader.tags)
    assert reader.all("img")[0]["alt"] == EVIL
    assert reader.text.count(EVIL) >= 20


def test_a_page_needs_nothing_from_anywhere():
    html = Page("title", [Section("part", [Picture(square(), "caption", "alt")])]).html()
    reader = Reader(html)
    policy = next(m["content"] for m in reader.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")
    addresses = [v for _, attrs in reader.tags for k, v in attrs.items() if k in ("src", "href")]
    assert addresses and all(a.startswith(("data:", "#")) for a in addresses)
    assert not re.search(r"https?://|@import|url\(", html)


def test_pictures_stand_side_by_side_unless_wide():
    a, b, c = (Picture(square(), k, k, wide=k == "c") for k in "abc")
    section = Section("part", [Text("t"), a, b, c, a, Text("t"), b])
    assert [len(group) for group in section.groups] == [1, 2, 1, 1, 1, 1]
    png = square()
    source, width, height = Picture(png, "", "").embedded
    assert source.startswith("data:image/png;base64,") and (width, height) == (100, 100)
    with pytest.raises(InputError, match="not a PNG file"):
        Page("t", [Section("s", [Picture(b"GIF89a", "", "")])]).html()


def test_tables_write_numbers_for_people():
    table = Table(["a", "b", "c", "d", "e", "f"], [["x", 0.012345678, -1.5e-6, None, 12, np.inf]], digits=3)
    assert [text for text, _ in table.cells[0]] == ["x", "0.0123", "−1.5·10⁻⁶", "–", "12", "∞"]
    assert [number for _, number in table.cells[0]] == [False, True, True, True, True, True]
    assert number_text(np.float64(6.02214e23)) == "6.022·10²³"
    assert number_text(4000, 3) == "4000" and number_text(123456, 3) == "123000"
    assert [multiple(ratio) for ratio in (1.44, 18.4, 231.4)] == ["1.4", "18", "230"]
    assert uncertain_text(1.23456, 0.0123) == "1.235\xa0±\xa00.012"
    assert uncertain_text(-123456.0, 250.0) == "−123456\xa0±\xa0250"
    assert uncertain_text(1.5e-7, 2e-9) == "1.5·10⁻⁷\xa0±\xa02·10⁻⁹"
    assert uncertain_text(0.25, np.nan) == "0.25"
    assert uncertain_text(np.nan, np.nan) == "–"
    assert python_literal({"y of inf": [np.inf, -np.inf, "inf"]}) == "{'y of inf': [np.inf, -np.inf, 'inf']}"
    with pytest.raises(InputError, match="has 1 cells and its table 2 columns"):
        Table(["a", "b"], [["x"]])


def test_a_cell_may_lead_to_another_page():
    cell = Link("a & <b>", 'jobs/a b/report.html?"x"')
    html = Page("links", [Section("s", [Table(["machine", "n"], [[cell, 1], ["plain", 2]])])]).html()
    (link,) = (m for m in re.findall(r'<a href="([^"]*)">([^<]*)</a>', html) if not m[0].startswith("#"))
    assert link == ("jobs/a b/report.html?&#34;x&#34;", "a &amp; &lt;b&gt;") and cell == "a & <b>"


def test_an_unknown_tone():
    with pytest.raises(InputError, match="tone 'jolly' is unknown"):
        Page("title", [], tone="jolly")


def test_writing_is_atomic(tmp_path):
    path = write_report(tmp_path / "r.html", "one", [], status="done", tone="good")
    assert path == tmp_path / "r.html" and 'class="status good"' in path.read_text()
    broken = Section("part", [Picture(b"no picture", "", "")])
    with pytest.raises(InputError):
        write_report(tmp_path / "r.html", "two", [broken])
    assert "<h1>one</h1>" in path.read_text() and len(list(tmp_path.iterdir())) == 1


def test_the_page_of_a_fit(tmp_path):
    fitted = example()
    train, test = record(fitted), record(fitted, "slow", seed=2)
    path = fitted.report(tmp_path / "new" / "folder", train, [test, record(fitted, seed=3)])
    assert path == tmp_path / "new" / "folder" / "report.html"
    again = replace(load(path.with_name("model.json")), engine="vm")
    assert again.nrmse(test) == fitted.nrmse(test)
    html = path.read_text()
    reader = Reader(html)
    assert reader.all("h1") and len(reader.all("h2")) == 6
    assert Status.CONVERGED.value in reader.text and 'class="status good"' in html
    assert f"{fitted.nrmse(test):.3g}" in reader.text and "slow" in reader.text and "test 2" in reader.text
    assert re.search(r"[\d.]+ % error on unseen data; a linear model [\d.]+ %", reader.text)
    assert "Modes in small motions" in reader.text and "Operators, by threshold" in reader.text
    assert "pilfr.load('model.json')" in reader.text
    images = reader.all("img")
    assert len(images) == 2 * 4 + 4 + 1 + 1 + 1 and all(i["alt"] for i in images)
    assert len(reader.all("figcaption")) == len(images)
    assert len(html) < 3_000_000


@pytest.mark.filterwarnings("ignore:.*holds the fitted values, not the simulator's equations")
@pytest.mark.parametrize("hold", ["linear", "next"])
def test_the_lines_of_code_of_a_fit_with_interpolated_inputs_run(hold, tmp_path, monkeypatch):
    simulator = rig()
    r = recorded(rig(), 0, samples=200, hold=hold)
    fitted = fit(simulator, r, engine="vm")
    page = fit_page(fitted, [r], [])
    (code,) = [block.code for section in page.sections for block in section.blocks if isinstance(block, Code)]
    monkeypatch.chdir(tmp_path)
    fitted.save("model.json")
    rows = np.column_stack([r.t, r.u, r.y])
    np.savetxt("new.csv", rows, delimiter=",", header="t,force,pos", comments="", fmt="%.17g")
    space = {"model": simulator}
    exec(code, space)
    assert float(space["y0"]) == pytest.approx(space["y"][0, 0])


def test_the_table_of_errors_is_that_of_the_fit():
    from pilfr_casadi.data import rmse
    from pilfr_casadi.plots import linear_simulation
    from pilfr_casadi.report import fit_page

    fitted = example(n_u=2, n_y=2, channels=2)
    test = record(fitted, "t", seed=5)
    page = fit_page(fitted, record(fitted), test)
    table = next(b for b in page.sections[0].blocks if isinstance(b, Table))
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert [r["output"] for r in rows] == ["y0", "y1", "y0", "y1"]
    assert table.emphasis == [2, 3]
    assert np.mean([r["NRMSE, this model"] for r in rows[2:]]) == pytest.approx(fitted.nrmse(test), rel=1e-12)
    assert np.mean([r["rms error"] for r in rows[2:]]) == pytest.approx(rmse(test.y, fitted.simulate(test)), rel=1e-12)
    linear = np.sqrt(np.mean((test.y - linear_simulation(fitted, test))[:, 1] ** 2)) / np.std(test.y[:, 1])
    assert rows[3]["NRMSE, linear model"] == pytest.approx(linear, rel=1e-12)
    assert rows[2]["rms error, % of range"] == pytest.approx(100 * rows[2]["rms error"] / np.ptp(test.y[:, 0]))


def test_modes_are_eigenvalues():
    fitted = example()
    rate = 2 * np.pi * 5 * complex(-0.1, np.sqrt(1 - 0.01))
    pole = np.exp(rate * fitted.dt)
    a = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    values = fitted.model.parameters.change(A={"value": a}, B_w={"value": np.zeros((2, 1))})
    small, large = mode_tables(replace(fitted, model=fitted.model.with_parameters(values)))
    assert small.rows[0] == pytest.approx(["oscillation", 5.0, 0.1, 1 / (2 * np.pi * 0.5), abs(pole)])
    assert large.rows[0] == pytest.approx(small.rows[0])


def test_modes_that_the_data_cannot_show_are_marked():
    fitted = example()
    values = fitted.model.parameters.change(A={"value": np.diag([0.9, -0.8])}, B_w={"value": np.zeros((2, 1))})
    table, _ = mode_tables(replace(fitted, model=fitted.model.with_parameters(values)))
    assert [row[:3] for row in table.rows] == [["decay", None, None], ["alternates with every sample", None, None]]
    u = np.sin(2 * np.pi * 0.5 * np.arange(4000) * fitted.dt)
    rate = 2 * np.pi * 5 * complex(-0.1, np.sqrt(1 - 0.01))
    pole = np.exp(rate * fitted.dt)
    a = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    values = fitted.model.parameters.change(A={"value": a}, B_w={"value": np.zeros((2, 1))})
    slow = Recording(u, u, fitted.dt)
    table, _ = mode_tables(replace(fitted, model=fitted.model.with_parameters(values)), [slow])
    assert table.rows[0][0] == "oscillation, outside the excited band"


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("status", "tone"),
    [(Status.MAX_ITERATIONS, "warning"), (Status.INTERRUPTED, "warning"), (Status.INFEASIBLE, "bad")],
)
def test_a_fit_that_did_not_converge_says_so(status, tone, tmp_path):
    fitted = example(status=status)
    html = fit_report(fitted, record(fitted), [], tmp_path).read_text()
    assert f'class="status {tone}">' in html and status.value in html
    assert "on its training recordings" in html and ".. " not in Reader(html).text


@pytest.mark.usefixtures("blank_figures")
def test_unusual_fits_have_a_page_too(tmp_path):
    fitted = example()
    values = fitted.model.parameters.change(A={"value": 1.6 * np.eye(2)})
    wild = replace(fitted, model=fitted.model.with_parameters(values))
    html = fit_report(wild, record(fitted), record(fitted), tmp_path).read_text()
    assert "the model diverges" in html
    linear = replace(fitted, model=fitted.linear, structure=PILFR(2), linear=None, errors={})
    own = replace(example(nx=1, own=True), linear=None, candidates=())
    text = Reader(fit_report(linear, record(linear), [], tmp_path).read_text()).text
    assert "Modes of the linear part" in text and "The hysteresis it found" not in text
    assert "model=model)" in fit_report(own, record(own), [], tmp_path).read_text()


@pytest.mark.usefixtures("blank_figures")
def test_the_page_calls_a_simulation_diverging_from_the_error_of_other_tables(tmp_path):
    fitted = example()
    for error, diverges in ((2e3, False), (2e4, True)):
        test = record(fitted).with_(y=record(fitted).y / error)
        html = fit_report(fitted, record(fitted), test, tmp_path).read_text()
        assert ("The model diverges on unseen data" in html) is diverges


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    fitted = example()
    with pytest.raises(InputError, match=r"cannot be made"):
        fit_report(fitted, record(fitted), [], tmp_path / "file" / "folder")


def chart_page(samples=20_000):
    """A page with a line over time with a spike, points beside a loop, and steps on logarithmic axes."""
    t = np.linspace(0, 50, samples)
    axes = [new_figure().add_subplot() for _ in range(3)]
    line(axes[0], t, np.where(np.arange(samples) == 7777, 5.0, np.sin(9 * t)), "measured", BLUE, part=slice(100, 900))
    line(axes[0], t, np.cos(9 * t), "costs $", INK, part=slice(100, 900))
    axes[1].plot(np.cos(t), np.sin(t), label="loop")
    axes[1].plot(np.cos(t[::50]), np.sin(t[::50]) + 0.1, ".", label="points")
    axes[2].stairs([1.0, 300.0, 4.0], [1.0, 10.0, 50.0, 900.0], baseline=None, label="steps")
    axes[2].set(xscale="log", yscale="log")
    for ax, labels in zip(axes, (("time [s]", "y [m]"), ("z [m]", "w [N]"), ("frequency [Hz]", "power")), strict=True):
        finish(ax, *labels, "title")
    drawn = [Picture(ax, "caption", f"Picture {k}.") for k, ax in enumerate(axes)]
    drawn[0] = replace(drawn[0], views={"start": axes[0]})
    return axes, Page("charts", [Section("part", [*drawn, Picture(axes[0], "again", "Again.", replaced=True)])])


def test_the_chart_of_a_map_leaves_out_machines_without_values():
    values = np.array([1.0, np.nan, 3.0])
    columns = [(name, "N", values, 0.1 * values) for name in ("k", "d")]
    ax = machine_map(*columns, ["a", "failed", "c"], np.array([False, True, False])).axes[0]
    content = chart(ax, {}, 500)
    assert [note["text"] for note in content["notes"]] == ["a", "c"]
    json.dumps(content, allow_nan=False)  # a browser reads no NaN


def test_a_picture_becomes_a_chart_of_all_samples():
    (over_time, loop, steps), page = chart_page()
    content = chart(over_time, {"start": over_time}, 500)
    x, y = (unpacked(content["lines"][0][k]) for k in "xy")
    assert 900 < len(x) < 2500 and np.all(np.diff(x) > 0) and (x[0], x[-1]) == (0, 50)
    assert np.max(y) == 5.0 and np.count_nonzero((x > 0.25) & (x < 2.25)) > 350  # spikes stay, and windows are dense
    assert [line["label"] for line in content["lines"]] == ["measured", "costs $"]
    assert content["x"] == {"label": "time [s]", "log": False, "whole": False} and list(content["views"]) == [
        "",
        "start",
    ]
    around, points = chart(loop, {}, 500)["lines"]
    assert len(unpacked(around["x"])) <= 510 and points["mark"] == "dot" and points["width"] == 0
    assert np.max(unpacked(around["x"])) == np.max(unpacked(around["y"])) == pytest.approx(1, abs=1e-6)
    (line,) = chart(steps, {}, 500)["lines"]
    assert unpacked(line["y"]).tolist() == [1, 1, 300, 300, 4, 4]
    figure = new_figure()
    first, _ = figure.subplots(1, 2)
    assert chart(first, {}, 500) is None
    bars = new_figure().add_subplot()
    bars.bar([0.0, 1.0], [2.0, 3.0], label="strong")
    assert [line["label"] for line in chart(bars, {}, 500)["lines"]] == ["strong", "strong"]
    spans = new_figure().add_subplot()
    spans.axhspan(2.0, 3.0)
    spans.axvspan(4.0, 5.0)
    across, up = ({k: unpacked(line[k]) for k in "xy"} for line in chart(spans, {}, 500)["lines"])
    assert set(across["y"]) == {2, 3} and set(up["x"]) == {4, 5}
    assert np.all(np.abs([across["x"], up["y"]]) > 1e38)
    html = page.html()
    assert html.count("data-chart=") == 3 and own_scripts_alone(html)


def unpacked(packed):
    if isinstance(packed, list):
        return packed[0] + packed[1] * np.arange(packed[2])
    return np.frombuffer(base64.b64decode(packed), "<f4").astype(float)


@pytest.fixture
def charts(tmp_path):
    path = tmp_path / "report.html"
    path.write_text(chart_page()[1].html())
    return path


@needs_chromium
def test_charts_in_a_browser(charts):
    for seen in in_a_browser(charts, (390, 1280)):
        assert seen["pictures"] == seen["charts"] == 3
        assert re.fullmatch(r"time [\d.]+ smeasured: \S+ mcosts \$: \S+ m", seen["used"][0]["tip"])


@needs_chromium
def test_numbers_of_charts_are_english_whatever_the_language(charts):
    with browser() as b:
        tips = []
        for language in ("en-US@posix", "de-DE"):
            first = f"Object.defineProperty(Navigator.prototype, 'language', {{ get: () => '{language}' }});"
            tips.append(b.open(charts, first=first).run(SEEN)["used"][0]["tip"])
            assert b.messages == []
        assert tips[0] == tips[1] != ""


TICKS = """(() => {  // the texts that are drawn on canvases
  window.texts = [];
  const draw = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, ...more) {
    texts.push(text);
    draw.call(this, text, ...more);
  };
})()"""


@needs_chromium
@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 5e-4, ["0", "1·10⁻⁴", "5·10⁻⁴"]),
        (-3.0, 3.0, ["−2", "0", "2"]),
        (1e7, 1.1e7, ["1.02·10⁷", "1.10·10⁷"]),
        (20.0, 20.001, ["20.0002", "20.0010"]),
        (0.0, 30_000.0, ["10000", "30000"]),
    ],
)
def test_ticks_tell_neighbours_apart(low, high, expected, tmp_path):
    ax = new_figure().add_subplot()
    ax.plot([0.0, 1.0], [low, high])
    finish(ax, "time [s]", "y [m]")
    (tmp_path / "report.html").write_text(Page("ticks", [Section("part", [Picture(ax, "caption", "alt")])]).html())
    with browser() as b:
        texts = b.open(tmp_path / "report.html", first=TICKS).run("texts")
    assert set(expected) <= set(texts)


@needs_chromium
def test_iterations_are_whole_numbers(tmp_path):
    ax = new_figure().add_subplot()
    ax.plot([0.0, 1.0, 2.0], [1.0, 3.0, 5.0])
    ax.xaxis.set_major_locator(WholeLocator())
    finish(ax, "iteration", "error")
    (tmp_path / "report.html").write_text(Page("whole", [Section("part", [Picture(ax, "caption", "alt")])]).html())
    with browser() as b:
        texts = b.open(tmp_path / "report.html", first=TICKS).run("texts")
    assert {"0", "1", "2"} <= set(texts) and not {"0.5", "1.5"} & set(texts[: texts.index("error")])


LABEL = """(() => {  // whether the label of the vertical axis is inside the canvas
  window.inside = [];
  const draw = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
    const m = this.getTransform(), half = this.measureText(text).width / 2;
    if (Math.abs(m.b) > 0.5) inside.push(m.f - half >= 0 && m.f + half <= this.canvas.height);
    draw.call(this, text, x, y);
  };
})()"""


@needs_chromium
def test_a_long_label_of_the_vertical_axis_is_not_cut(tmp_path):
    ax = new_figure().add_subplot()
    ax.plot([0.0, 1.0], [0.0, 1.0])
    finish(ax, "time [s]", "simulated − measured displacement of the tip [10⁻⁶ m]")
    (tmp_path / "report.html").write_text(Page("label", [Section("part", [Picture(ax, "caption", "alt")])]).html())
    with browser() as b:
        inside = b.open(tmp_path / "report.html", 390, first=LABEL).run("inside")
    assert inside and all(inside)


@needs_chromium
def test_a_chart_that_cannot_be_drawn_leaves_its_picture(charts):
    with browser() as b:
        b.open(charts, first="HTMLCanvasElement.prototype.getContext = () => null;")
        assert b.run(PICTURES) == {"figures": 4, "images": 4, "charts": 0}
        assert any("TypeError" in text for text in b.messages)


@needs_chromium
def test_the_browser_reports_what_the_console_says_at_once(charts):
    with browser() as b, pytest.raises(AssertionError, match=r"not so[\s\S]*broken"):
        b.open(charts, first="console.error('broken')").run("(async () => { throw Error('not so'); })()")


@needs_chromium
@pytest.mark.slow
def test_in_a_browser(tmp_path):
    fitted = example(n_u=2, n_y=2, channels=2)
    long_name = "a_recording_with_a_name_that_goes_on_and_on_without_a_single_blank_in_it"
    fit_report(fitted, record(fitted), [record(fitted, long_name, seed=2)], tmp_path)
    for seen in in_a_browser(tmp_path / "report.html"):
        assert seen["title"] == "Identified model: u0, u1 → y0, y1"
        assert seen["pictures"] > 10
