"""When the other hold is tried, and when its search is taken."""

from types import SimpleNamespace

import pytest

from pilfr_casadi.diagnose import other_hold
from pilfr_casadi.diagnose.candidate import Candidate
from pilfr_casadi.diagnose.search_start import Asked
from pilfr_casadi.diagnose.stages import Stages
from pilfr_casadi.laws import Delay, Mode, Relaxation
from pilfr_casadi.simulators import Placed

DT = 2e-3


def asked():
    """A diagnosis of two effects, of nothing in particular."""
    return Asked(None, (), (), None, "auto", 1, 2, 0.0, Stages(lambda *_: None))


def named(port, law, **values):
    """A fitted candidate, as far as `within` reads it."""
    element = Placed(port, law, "l.")
    own = element.named({k: p.value for k, p in law.parameters().items()} | values)
    fitted = SimpleNamespace(values=own, simulator=SimpleNamespace(elements=[element]))
    return Candidate(port, law, fitted, 1.0, 1.0, 1)


@pytest.mark.parametrize(
    ("found", "within"),
    [
        (named("sensor:y", Delay(), T=0.4 * DT), True),
        (named("sensor:y", Delay(), T=3 * DT), False),
        (named("actuator:u", Mode(), c_1=0.1, W=1.5 / DT, D=0.2), True),
        (named("actuator:u", Mode(), c_1=0.1, W=0.2 / DT, D=0.2), False),
        (named("spring", Relaxation(), k_v=3.0, T=0.4 * DT), False),
    ],
)
def test_what_acts_within_a_sample_may_be_the_other_hold(found, within):
    assert found.within(DT) is within
    named, bench = [SimpleNamespace(winner=found)], SimpleNamespace(dt=DT)
    search = SimpleNamespace(interrupted=False, misheld=1.0, accepted=named, much=lambda: False, bench=bench)
    assert other_hold.doubted(search) is within
    search.interrupted = True
    assert not other_hold.doubted(search)


@pytest.mark.parametrize("stops", [KeyboardInterrupt, other_hold.InputError])
def test_what_ends_the_other_search_leaves_the_one_there_is(stops, monkeypatch):
    def ended(*_):
        raise stops("ended")

    monkeypatch.setattr(other_hold, "prepared_search", ended)
    bench = SimpleNamespace(otherwise_held=lambda: SimpleNamespace(hold="linear"))
    search, ready = SimpleNamespace(bench=bench, misheld=1.0, interrupted=False), object()
    assert other_hold.otherwise_held(asked(), ready, search) == (ready, search)
    assert search.interrupted is (stops is KeyboardInterrupt)


@pytest.mark.parametrize(("unsure", "taken"), [(False, True), (True, False)])
def test_where_nothing_is_missing_with_the_other_hold_that_is_taken(unsure, taken, monkeypatch):
    other = SimpleNamespace(bench=None, without=None, floor=None, gates=())
    again = SimpleNamespace(
        base=SimpleNamespace(cost=1.0),
        interrupted=False,
        accepted=[],
        much=lambda: False,
        unsure=lambda: unsure,
        certainty=lambda: 0.0,
    )
    monkeypatch.setattr(other_hold, "prepared_search", lambda *_: (other, again))
    monkeypatch.setattr(other_hold, "hold_note", lambda *_: "held")
    monkeypatch.setattr(other_hold, "replace", lambda of, **_: of)
    bench = SimpleNamespace(otherwise_held=lambda: SimpleNamespace(hold="linear"))
    base = SimpleNamespace(cost=1.0)
    search = SimpleNamespace(bench=bench, misheld=1.0, interrupted=False, base=base, certainty=lambda: 0.6)
    found = other_hold.otherwise_held(asked(), "ready", search)
    assert found == ((other, again) if taken else ("ready", search))
