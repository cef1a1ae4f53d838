"""The cards of a notebook: one piece of well-formed HTML without scripts, that says what the object's print says."""

from html.parser import HTMLParser

import numpy as np
import pytest
from diagnosis_example import example

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator

VOID = {"img", "br", "meta", "link", "hr", "input"}


class Reader(HTMLParser):
    """Text outside of style, and whether every tag is closed in its order."""

    def __init__(self, html):
        super().__init__()
        self.text, self.open, self.seen = "", [], set()
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.seen.add(tag)
        assert not any(name.startswith("on") or name in ("src", "href") for name, _ in attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.seen.add(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text += data + " "


@pytest.fixture(scope="module")
def diagnosis():
    return example()


def card(thing, most=9000):
    html = thing._repr_html_()
    assert len(html) < most
    read = Reader(html)
    assert "script" not in read.seen
    return " ".join(read.text.split())


def test_a_recording_shows_channels_with_units_and_escapes_their_names():
    u = np.sin(np.arange(5000) / 50)
    r = Recording(u, np.column_stack([u, u**2]), 1e-3, ("<force>",), ("x", "v"), units={"x": "mm"}, name="run 3")
    text = card(r)
    for said in (
        "Recording run 3",
        "5000 samples, step 0.001 s, 5 s",
        "<force> input",
        "x output mm",
        "hold not stated",
    ):
        assert said in text
    assert "<force>" not in r._repr_html_() and r._repr_html_().count("<polyline") == 3
    assert "and 8 more" in card(Recording(np.tile(u[:, None], 20), u, 1e-3), 30_000)


def test_a_simulator_shows_ports_and_parameters_with_bounds():
    simulator = Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos),
        lambda x: dict(position=x.pos),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(k=Parameter(100.0, unit="N/m", bounds=(50, 200)), m=Parameter(2.0, fixed=True)),
        ports=Port("mount", into=dict(vel=-1.0), across=lambda x: x.pos),
    )
    text = card(simulator)
    for said in ("pos, vel", "mount", "k 100 N/m 50 … 200", "m 2 fixed"):
        assert said in text


def test_a_fit_shows_how_it_ended_and_its_errors(diagnosis):
    fitted = pilfr.fit(diagnosis.refitted, diagnosis.train)
    text = card(fitted)
    assert fitted.status.value in text and f"{fitted.train_nrmse[0]:.4f}" in text and "free parameters" in text


def test_a_diagnosis_shows_the_verdict_and_each_effect(diagnosis):
    text = card(diagnosis)
    assert diagnosis.sentence.rstrip(".") in text
    for effect in diagnosis.effects:
        assert f"{effect.port} {effect.confidence:.2f}" in text


def test_a_comparison_shows_its_table(diagnosis):
    found = pilfr.compare(diagnosis.train[0], {"refitted": diagnosis.refitted, "corrected": diagnosis})
    text = card(found)
    assert all(" ".join(row) in text for row in found.rows) and found.note in text
