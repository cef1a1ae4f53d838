"""The benchmark's simulator against independent solutions of the same equations, and the properties of its spring."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pilfr_casadi._base import InputError
from pilfr_casadi.data import nrmse
from problems.masing import MasingRig, simulate
from problems.masing_data import FS, benchmark, records
from problems.masing_spring import MasingSpring

RIG = MasingRig()
K, R_U = RIG.K, RIG.r_u
SPRING = RIG.spring
elongations = st.lists(st.floats(-2e-3, 2e-3), min_size=1, max_size=12)


@pytest.fixture(scope="module")
def data():
    return benchmark(0)


def along(path, spring=SPRING):
    for x in path:
        spring = spring.move(x)
    return spring


# ---- the spring ----


@given(st.floats(-5e-3, 5e-3))
def test_virgin_curve(x):
    expected = math.copysign(R_U * (1.0 - math.exp(-K * abs(x) / R_U)), x)
    assert SPRING.move(x).force == pytest.approx(expected, rel=1e-9, abs=1e-12)


@given(elongations, st.sampled_from([-1, 1]))
def test_slope_is_the_published_rate_law(path, direction):
    """Eq. 26, n = 1: slope K (1 - |f - r*| / 2 r_u) on a branch from r*, K (1 - |f| / r_u) on first loading."""
    spring, step = along(path), 1e-8
    ahead = spring.move(spring.x + direction * step)
    middle = spring.move(spring.x + 0.5 * direction * step)
    if middle.turns != ahead.turns:  # a loop closes right here
        return
    start = ahead.turns[-1][1] if ahead.turns else None
    law = K * (1 - abs(middle.force) / R_U) if start is None else K * (1 - abs(middle.force - start) / (2 * R_U))
    begin = spring.force
    assert (ahead.force - begin) / (direction * step) == pytest.approx(law, rel=1e-4, abs=1e-4)


@given(elongations, elongations)
def test_a_closed_minor_loop_is_forgotten(path, loop):
    """Madelung: inside the last half-swing, an excursion that returns leaves force and memory unchanged."""
    spring = along([*path, -3e-3, 3e-3])
    lower = spring.move(-1e-3)
    inner = [min(max(x, -1e-3), 2.9e-3) for x in loop]
    returned = along([*inner, -1e-3], lower)
    onwards = -1.5e-3
    assert returned.move(onwards).force == pytest.approx(lower.move(onwards).force, abs=1e-12)
    assert returned.move(onwards).turns == lower.move(onwards).turns


@given(elongations)
def test_large_swings_wipe_out_the_past(path):
    assert along([*path, 4e-3]).turns == ()
    assert along([*path, 4e-3]).force == pytest.approx(SPRING.move(4e-3).force, abs=1e-15)


@given(elongations)
def test_force_is_odd_in_the_path(path):
    assert along([-x for x in path]).force == -along(path).force


@given(elongations, st.integers(2, 9))
def test_force_depends_on_turning_points_only(path, n):
    fine = [x for a, b in pairwise([0.0, *path]) for x in [*np.linspace(a, b, n)[1:-1].tolist(), b]]
    assert along(fine).force == pytest.approx(along(path).force, abs=1e-12)


@given(elongations, elongations, st.floats(1e-5, 1e-3))
def test_minor_loops_between_equal_limits_are_congruent(path, other, width):
    def loop(history):
        spring = along([*history, 3e-3, -width])
        spring = spring.move(0.0)
        lower, upper = spring.move(-width), spring.move(-width).move(0.0)
        return [s.force - spring.force for s in (spring.move(-0.4 * width), lower, lower.move(-0.4 * width), upper)]

    assert loop([*path, -3e-3]) == pytest.approx(loop([*other, -4e-3]), abs=1e-12)
    assert loop([*path, -3e-3])[-1] == pytest.approx(0.0, abs=1e-12)


def stop_density(r):
    """Density w(r) of the stops that make up the spring, N/m^2, at thresholds r, m."""
    return K**2 / R_U * np.exp(-K / R_U * np.asarray(r))


def stop_elements(n, x_max):
    """Thresholds and weights of n stops whose virgin curve is the chord polygon of the spring's on [0, x_max].

    It errs by at most `(K^2 / r_u) (x_max / n)^2 / 8`, and any branch by at most twice that.
    """
    r = np.linspace(0.0, x_max, n + 1)
    slopes = np.diff(-R_U * np.expm1(-K / R_U * r)) / np.diff(r)
    return r[1:], slopes - np.append(slopes[1:], 0.0)


@given(elongations)
def test_spring_is_the_sum_of_its_stops(path):
    """The same force from many stops of Eq. 3, within the discretisation's bound."""
    n, x_max = 400, 4e-3
    r, w = stop_elements(n, x_max)
    bound = 2 * (K**2 / R_U) * (x_max / n) ** 2 / 8
    s, x_old, spring = np.zeros(n), 0.0, SPRING
    for x in path:
        s, x_old, spring = np.clip(s + x - x_old, -r, r), x, spring.move(x)
        assert abs(w @ s - spring.force) <= bound


def test_stop_density_integrates_to_the_virgin_curve():
    from scipy.integrate import quad

    for x in (1e-5, 2e-4, 1e-3):
        below = quad(lambda r: r * stop_density(r), 0.0, x)[0]
        above = x * quad(lambda r: stop_density(r), x, 0.02)[0]
        assert below + above == pytest.approx(SPRING.move(x).force, rel=1e-9)


def test_stop_weights_sample_the_density():
    r, w = stop_elements(200, 2e-3)
    np.testing.assert_allclose(w[:-1], stop_density(r[:-1]) * (r[1] - r[0]), rtol=2e-4)
    assert (w > 0).all()


# ---- the rig ----


def event_located(u, fs, hold):
    """Eq. 25 and 26 as printed, the spring force a state of the ODE, switching at events located by scipy."""
    from scipy.integrate import solve_ivp

    g = RIG
    y, rows, turns, sign = np.zeros(5), [np.zeros(5)], [], 0
    for k, (u0, u1) in enumerate(pairwise(u)):
        t, t0, t_end = k / fs, k / fs, (k + 1) / fs
        while t < t_end:
            r_star, strength = (turns[-1][1], 2 * g.r_u) if turns else (0.0, g.r_u)
            limit = (turns[-2][0] if len(turns) > 1 else -turns[0][0]) if turns else sign * 1e9

            def rhs(t, y, r_star=r_star, strength=strength, u0=u0, u1=u1, t0=t0):
                x1, v1, x2, v2, f = y
                force = u0 + (u1 - u0) * (t - t0) * fs if hold == "linear" else u0
                a1 = -(g.d2 * (v1 - v2) + g.k2 * (x1 - x2) + g.d1 * v1 + g.k1 * x1 + f) / g.m1
                a2 = (force - g.d2 * (v2 - v1) - g.k2 * (x2 - x1)) / g.m2
                return [v1, a1, v2, a2, g.K * (1 - abs((f - r_star) / strength)) * v1]

            def reversal(t, y):
                return y[1]

            def closing(t, y, limit=limit):
                return y[0] - limit

            reversal.terminal = closing.terminal = True
            reversal.direction, closing.direction = -sign, sign
            events = [reversal, closing] if sign else None
            found = solve_ivp(rhs, (t, t_end), y, "DOP853", rtol=1e-13, atol=1e-16, max_step=2e-3, events=events)
            t, y = found.t[-1], found.y[:, -1].copy()
            if not sign:
                sign = int(np.sign(y[1]))
            elif found.status == 1 and len(found.t_events[0]):
                turns, sign, y[1] = [*turns, (y[0], y[4])], -sign, 0.0
            elif found.status == 1:
                turns, y[0] = turns[:-2], limit
        rows.append(y)
    return np.array(rows).T


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize(
    ("name", "part"), [pytest.param("train", slice(0, 700), marks=pytest.mark.slow), ("sweep", slice(0, 700))]
)
def test_agrees_with_event_located_solution(data, name, part, hold):
    u = data.records[name].u[part, 0]
    reference = event_located(u, FS, hold)
    motion = simulate(u, FS, hold=hold, substeps=128)
    for name, expected in zip(("x1", "v1", "x2", "v2", "k_H"), reference, strict=True):
        np.testing.assert_allclose(getattr(motion, name), expected, rtol=0, atol=1e-8 * expected.std(), err_msg=name)


@pytest.mark.parametrize("name", [*(pytest.param(n, marks=pytest.mark.slow) for n in ("train", "multisine")), "sweep"])
def test_step_halving(data, name):
    """Fourth order through all reversals and closing loops; the default is good to 1e-5."""
    u = data.records[name].u
    exact = simulate(u, FS, substeps=64).x2
    error = {n: np.abs(simulate(u, FS, substeps=n).x2 - exact).max() / exact.std() for n in (4, 8, 16)}
    assert error[8] < 1e-5
    assert 12 < error[4] / error[8] < 20
    assert 12 < error[8] / error[16] < 20
    np.testing.assert_array_equal(simulate(u, FS).x2, simulate(u, FS, substeps=8).x2)


def test_held_input_may_be_sampled_faster(data):
    u = data.records["train"].u[:1500, 0]
    coarse, fine = simulate(u, FS, substeps=8), simulate(np.repeat(u, 4), 4 * FS, substeps=2)
    np.testing.assert_allclose(fine.x1[::4], coarse.x1, rtol=0, atol=1e-10 * coarse.x1.std())
    np.testing.assert_allclose(fine.k_H[::4], coarse.k_H, rtol=0, atol=1e-10 * coarse.k_H.std())


def test_force_follows_from_the_displacement_alone(data):
    """The spring fed with the finely sampled x1 returns k_H, but for the turning points between samples."""
    motion = simulate(np.repeat(data.records["train"].u[:1500, 0], 32), 32 * FS, substeps=1)
    spring, force = SPRING, []
    for x in motion.x1.tolist():
        spring = spring.move(x)
        force.append(spring.force)
    np.testing.assert_allclose(force, motion.k_H, rtol=0, atol=1e-4 * motion.k_H.std())


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize(
    ("rig", "virgin"), [(MasingRig(r_u=1e9), True), (MasingRig(K=0.0), False)], ids=["elastic", "no spring"]
)
def test_linear_limits(rig, virgin, hold):
    from scipy.signal import cont2discrete, dlsim

    u = np.random.default_rng(3).standard_normal(600)
    u[0] = 0.0  # the first-order hold's transformed state starts at rest with it
    method = {"zero": "zoh", "linear": "foh"}[hold]
    discrete = cont2discrete(rig.matrices(virgin_spring=virgin), 1 / FS, method=method)
    motion = simulate(u, FS, rig=rig, hold=hold, substeps=64)
    expected = dlsim(discrete, u)[1][:, 0]
    np.testing.assert_allclose(motion.x2, expected, rtol=0, atol=1e-7 * expected.std())


def test_matrices_make_a_control_model():
    import control

    for virgin, stiffness in ((True, RIG.k1 + RIG.K), (False, RIG.k1)):
        model = control.ss(*RIG.matrices(virgin_spring=virgin))
        assert float(control.dcgain(model)) == pytest.approx(1 / stiffness + 1 / RIG.k2)


def test_small_amplitudes_feel_the_initial_stiffness(data):
    u = 1e-6 * data.records["train"].u[:1000, 0]
    motion = simulate(u, FS)
    elastic = simulate(u, FS, rig=MasingRig(r_u=1e9))
    assert nrmse(elastic.x2, motion.x2) < 1e-4


@pytest.mark.parametrize(
    ("u", "options", "words"),
    [
        ([[1.0, 2.0]], {}, "one column"),
        ([], {}, "one column"),
        ([0.0, math.nan], {}, "not finite"),
        ([0.0, 1.0], {"hold": "cubic"}, "'zero' or 'linear'"),
        ([0.0, 1.0], {"substeps": 0}, "positive"),
        ([0.0] + 2000 * [1e3], {"substeps": 1, "fs": 5.0}, "more substeps"),
    ],
)
def test_bad_input_is_named(u, options, words):
    with pytest.raises(InputError, match=words):
        simulate(u, **{"fs": FS, **options})


# ---- the data ----


def test_records_follow_the_paper(data):
    assert {name: len(r) for name, r in data.records.items()} == {"train": 6144, "multisine": 6144, "sweep": 3067}
    for name, record in data.records.items():
        assert record.dt == 1 / 120
        assert (record.initial, record.hold) == ("zero", "zero")
        assert nrmse(record.y, data.truth[name].x2[:, None]) == pytest.approx(10**-2.5, rel=0.05)
    assert np.abs(data.records["sweep"].u).max() == pytest.approx(1.0, abs=1e-3)
    for period in data.steady:
        assert (len(period), period.period) == (1024, 1024)
        assert period.u.std() == pytest.approx(1.0)
        lines = np.abs(np.fft.rfft(period.u[:, 0]))
        assert lines[257:].max() < 1e-9 * lines[1:257].min()


def test_seeds_reproduce_and_differ(data):
    again, other = records(0), records(1)
    for name, record in data.records.items():
        np.testing.assert_array_equal(again[name].u, record.u)
        np.testing.assert_array_equal(again[name].y, record.y)
        assert not np.array_equal(other[name].y, record.y)
    assert abs(np.corrcoef(again["train"].u[:, 0], again["multisine"].u[:, 0])[0, 1]) < 0.1


def test_noise_is_white_and_independent_of_the_record(data):
    noise = {name: data.records[name].y[:, 0] - data.truth[name].x2 for name in data.truth}
    for e in noise.values():
        assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4 / math.sqrt(len(e))
    assert abs(np.corrcoef(noise["train"], noise["multisine"])[0, 1]) < 4 / math.sqrt(6144)
    clean = benchmark(0, snr_db=math.inf)
    np.testing.assert_array_equal(clean.records["train"].y[:, 0], data.truth["train"].x2)


def test_flat_periods_are_not_quite_steady(data):
    """Repeated on, the flat periods settle; as recorded they differ from that by some per cent."""
    u = data.records["train"].u
    for flat in range(512, 6144, 2048):
        period = u[flat : flat + 1024]
        periods = simulate(np.concatenate([u[:flat], *[period] * 6]), FS).x2[flat:].reshape(6, 1024)
        assert nrmse(periods[4], periods[5]) < 1e-5
        assert 1e-3 < nrmse(periods[0], periods[5]) < 0.06


def test_loops_are_widest_at_the_first_resonance(data):
    """Sec. 6.1 and Fig. 7: greatest near 3 Hz, almost nothing at high frequencies."""
    x1, force = data.truth["sweep"].x1, data.truth["sweep"].k_H
    frequency = 0.1 + 1.17 * np.arange(x1.size) / FS
    work = 0.5 * (force[1:] + force[:-1]) * np.diff(x1)

    def loss(lo, hi):
        return work[(frequency[1:] >= lo) & (frequency[1:] < hi)].sum() / ((hi**2 - lo**2) / (2 * 1.17))

    bands = [(f - 0.5, f + 0.5) for f in np.arange(1.0, 29.5, 0.5)]
    losses = [loss(*band) for band in bands]
    assert bands[int(np.argmax(losses))] == (2.5, 3.5)
    assert loss(20.0, 30.0) < 1e-3 * max(losses)


def test_spring_is_immutable_and_simple_to_read():
    spring = MasingSpring(K, R_U)
    moved = spring.move(1e-3).move(-5e-4)
    assert spring == SPRING
    assert moved.turns == ((1e-3, SPRING.move(1e-3).force),)
    assert moved.direction == -1
    assert moved.move(moved.x) is moved
