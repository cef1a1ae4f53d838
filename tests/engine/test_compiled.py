"""The compiled engine: ratios of time and memory, with limits for a busy machine; compiler and cache."""

import os
import threading
import time

import numpy as np
import pytest

from pilfr_casadi._base import InputError, c_compiler
from pilfr_casadi.engine import (
    Compiled,
    VirtualMachine,
    cache_directory,
    compiler,
    linearize,
    make_engine,
    source_code,
)
from pilfr_casadi.models import NARX, PILFR, Play, PrandtlIshlinskii, read_measured_output
from problems import speed

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")
AGAIN = 3  # a ratio that another program has spoiled is measured again; a real one fails every time


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("speed")
    speed.prepare(folder)
    return folder


def seconds(case, way, samples):
    return speed.run(case, "derivatives", way, samples)["seconds"] / samples


def largest_ratio(slow, fast, enough):
    """Measure a ratio a few times, until it is large enough; return the largest."""
    found = []
    for _ in range(AGAIN):
        found.append(slow() / fast())
        if found[-1] >= enough:
            break
    return max(found)


@needs_compiler
def test_generated_code_is_faster_than_the_virtual_machine(case):
    assert largest_ratio(lambda: seconds(case, "vm", 2048), lambda: seconds(case, "c", 2048), 3.0) >= 3.0


@pytest.mark.parametrize(("way", "enough"), [pytest.param("naive", 5.0, marks=pytest.mark.slow), ("sx", 3.0)])
def test_recursion_is_faster_than_what_casadi_differentiates(case, way, enough):
    assert largest_ratio(lambda: seconds(case, way, 384), lambda: seconds(case, "vm", 2048), enough) >= enough


def test_long_record_takes_memory_and_time_in_proportion(case):
    rows = []
    for _ in range(AGAIN):
        rows = [speed.run(case, "growth", samples) for samples in (20_000, 200_000)]
        if rows[1]["seconds"] < 15 * rows[0]["seconds"]:
            break
    short, long = rows
    assert long["seconds"] < 15 * short["seconds"]
    # per sample: record, copies and residuals, but not the 88 numbers (704 bytes) of the Jacobian's row
    assert (long["memory"] - short["memory"]) * 2**20 / 180_000 < 300
    assert long["memory"] < 300


@needs_compiler
@pytest.mark.slow
def test_a_step_in_c_takes_less_than_a_microsecond(case):
    """Five states and 20 plays; a busy machine gets another try."""
    assert min(speed.run(case, "exported_step")["seconds"] for _ in range(AGAIN)) <= 1e-6


@pytest.mark.slow
def test_quick_tables(capsys):
    speed.main(["--quick"])
    out = capsys.readouterr().out
    titles = ("residual and Jacobian", "one start to the end", "normal equations", "GaussNewton", "import")
    for title in (*titles, "one step of the exported model"):
        assert title in out


@needs_compiler
def test_second_process_builds_nothing(case, tmp_path):
    env = {"XDG_CACHE_HOME": str(tmp_path)}
    first, second = (speed.run(case, "building", env=env)["seconds"] for _ in range(2))
    assert second < 0.5 * first
    assert len(list((tmp_path / "pilfr_casadi").iterdir())) == 2  # the loops and the model


# --- compiler and cache ----------------------------------------------------------------------------------------------


@pytest.fixture
def model():
    values = {"A": 0.5, "B_u": 1.0, "B_w": 0.3, "C_y": 1.0, "C_z": 1.0}
    return PILFR(1, PrandtlIshlinskii(Play, 2)).model(1, 1, values)


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Use an empty cache, and clear all facts about compilers before and after."""

    def forget():
        for function in (c_compiler.compiler, c_compiler._describe_machine, c_compiler.cache_directory):
            function.cache_clear()

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(c_compiler, "_failures", {})
    forget()
    yield tmp_path
    monkeypatch.undo()
    forget()


def script(path, body):
    path.write_text("#!/bin/sh\n" + body)
    path.chmod(0o755)
    return str(path)


def output(engine, model):
    u = np.sin(np.arange(50.0))[:, None]
    return engine.simulate(u, model.parameters.start, np.zeros(3))[0]


def test_without_compiler(model, fresh, monkeypatch):
    monkeypatch.setenv("PILFR_COMPILER", "none")
    assert isinstance(make_engine(model, "auto"), VirtualMachine)
    with pytest.raises(InputError, match="No C compiler was found; install one"):
        make_engine(model, "c")


@pytest.mark.parametrize("body", ["echo it is broken >&2; exit 1", "exit 0"])
def test_compiler_that_fails(model, fresh, monkeypatch, body):
    calls = fresh / "calls"
    monkeypatch.setenv("CC", script(fresh / "bad", f"echo x >> {calls}\n{body}"))
    with pytest.warns(RuntimeWarning, match="could not build the model .* slower virtual machine is used"):
        assert isinstance(make_engine(model, "auto"), VirtualMachine)
    tried = len(calls.read_text())
    with pytest.raises(InputError, match="repair it, name another in CC, or use engine='vm'"):
        make_engine(model, "c")
    assert len(calls.read_text()) == tried, "what failed once is not tried again"


def test_compiler_that_is_no_program(model, fresh, monkeypatch):
    path = fresh / "bad"
    path.write_bytes(b"\x7fELF, but no")
    path.chmod(0o755)
    monkeypatch.setenv("CC", str(path))
    with pytest.warns(RuntimeWarning, match="could not build"):
        assert isinstance(make_engine(model), VirtualMachine)


@needs_compiler
def test_compiler_that_does_not_know_the_processor(model, fresh, monkeypatch):
    real = compiler()
    refuse = 'for a in "$@"; do [ "$a" = -march=native ] && { echo unknown >&2; exit 1; }; done\n'
    monkeypatch.setenv("CC", script(fresh / "old", f'{refuse}exec {real} "$@"'))
    c_compiler.compiler.cache_clear()
    engine = make_engine(model, "c")
    assert compiler() == str(fresh / "old")
    np.testing.assert_array_equal(output(engine, model), output(VirtualMachine(model), model))


@needs_compiler
@pytest.mark.parametrize("harm", [lambda b: b[:3000], lambda b: b[:5000] + b"x" + b[5001:], lambda b: b""])
def test_damaged_library_is_built_anew(model, fresh, harm):
    source = source_code(linearize(model))
    library = c_compiler.build(source)
    good = library.read_bytes()
    library.write_bytes(harm(good))
    again = c_compiler.build(source)
    assert again.read_bytes() == good
    assert [p.name for p in cache_directory().glob("*/*")] == [again.name]


@needs_compiler
def test_the_cache_does_not_grow_without_end(fresh, monkeypatch):
    monkeypatch.setattr(c_compiler, "KEPT_LIBRARIES", 2)
    monkeypatch.setattr(c_compiler, "_cache_folder", lambda key: cache_directory() / "00")
    sources = [f"int number(void) {{ return {k}; }}" for k in range(4)]
    first = c_compiler.build(sources[0])
    for k, source in enumerate(sources[1:], 1):
        os.utime(c_compiler.build(source), (k, k))
        assert c_compiler.build(sources[0]) == first, "what is in use stays"
    assert len(list((cache_directory() / "00").glob("*.so"))) == 2


def test_cache_others_can_write_to_is_not_used(fresh):
    shared = fresh / "cache" / "pilfr_casadi"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    assert cache_directory() != shared
    assert cache_directory().stat().st_mode & 0o077 == 0


def test_cache_others_can_exchange_is_not_used(fresh):
    (fresh / "cache").mkdir()
    (fresh / "cache").chmod(0o777)
    assert cache_directory().parent != fresh / "cache"


def test_cache_that_cannot_be_made(fresh):
    (fresh / "cache").write_text("a file where the folder should be")
    assert cache_directory().is_dir()


@needs_compiler
def test_processes_may_build_at_the_same_time(case, tmp_path):
    env, done = {"XDG_CACHE_HOME": str(tmp_path)}, []
    threads = [threading.Thread(target=lambda: done.append(speed.run(case, "building", env=env))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == 3
    assert {p.suffix for p in (tmp_path / "pilfr_casadi").rglob("*") if p.is_file()} == {".so"}


@pytest.mark.parametrize("kind", [pytest.param(Compiled, marks=needs_compiler), VirtualMachine])
def test_threads_share_an_engine(model, kind):
    engine, p = kind(model), model.parameters.start
    columns, state = np.arange(len(p)), np.zeros(3)
    inputs = [np.random.default_rng(k).standard_normal((3000, 1)) for k in range(4)]

    def work(u):
        return engine.sensitivity(u, p, state, np.zeros((3, len(p))), columns)

    expected, found = [work(u) for u in inputs], [[] for _ in inputs]

    def repeat(k):
        for _ in range(10):
            found[k].append(work(inputs[k]))

    threads = [threading.Thread(target=repeat, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for right, results in zip(expected, found, strict=True):
        assert len(results) == 10
        for result in results:
            for a, b in zip(right, result, strict=True):
                np.testing.assert_array_equal(a, b)


@needs_compiler
@pytest.mark.slow
def test_many_lags_compile_in_proportion_to_their_code(tmp_path, monkeypatch):
    """Jumps of thousands of outputs, threaded, would take twenty times as long for three times the code."""
    monkeypatch.setattr(c_compiler, "cache_directory", lambda: tmp_path)
    sources = []
    for lags in (10, 20):
        model = read_measured_output(NARX(lags, 10).structure(1, 1).model(1, 1), 1.0)
        sources.append(source_code(linearize(model)))
    more = len(sources[1]) / len(sources[0])

    def ratio():
        taken = []
        for source in sources:
            began = time.perf_counter()
            c_compiler.build(f"{source}\n/* {began} */")
            taken.append(time.perf_counter() - began)
        return taken[1] / taken[0] / more

    assert min(ratio() for _ in range(2)) < 2.5
