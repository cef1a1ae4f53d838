"""Parameters: validation, and the layout shared by numbers and symbols."""

import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from pilfr_casadi._base import InputError
from pilfr_casadi.models import Parameter, ParameterSet, is_at_bound

shapes = st.one_of(st.just(()), st.tuples(st.integers(1, 4)), st.tuples(st.integers(0, 3), st.integers(1, 3)))
values = shapes.flatmap(lambda s: hnp.arrays(float, s, elements=st.floats(-5, 5)))
sets = st.lists(values, min_size=1, max_size=4).map(
    lambda arrays: ParameterSet({f"p{i}": Parameter(a) for i, a in enumerate(arrays)})
)


def test_values_a_little_inside_their_bounds_count_as_at_them_and_small_values_do_not_as_zero():
    values, high = [0.0005 + 3e-15, 19.9986, 19.9, 1e-9, 0.0, 5.0], [0.05, 20, 20, 10, 10, np.inf]
    found = is_at_bound(values, [0.0005, 0, 0, 0, 0, -np.inf], high)
    assert found.tolist() == [True, True, False, False, True, False]
    assert not is_at_bound(1.0005, 0.999, 1.002) and is_at_bound(2.0, 2.0, 2.0)


@given(sets)
def test_vector_and_names_are_one_layout(parameters):
    start = parameters.start
    assert start.shape == (parameters.size,)
    back = parameters.unpack(start)
    for name, p in parameters.items():
        np.testing.assert_array_equal(back[name], p.value)
        assert back[name].shape == p.value.shape
    np.testing.assert_array_equal(parameters.pack(back), start)
    assert len(parameters.labels) == len(set(parameters.labels)) == parameters.size


@given(sets)
def test_symbols_have_the_layout_of_numbers(parameters):
    vector = ca.SX.sym("p", parameters.size)
    named = parameters.symbols(vector)
    f = ca.Function("f", [vector], [ca.densify(named[name]) for name in parameters])
    found = f.call([ca.DM(parameters.start)])
    for (_, p), value in zip(parameters.items(), found, strict=True):
        assert value.shape == p.shape
        np.testing.assert_array_equal(np.asarray(value), p.value.reshape(p.shape, order="F"))


def test_labels_say_where_an_entry_is():
    parameters = ParameterSet(
        {"m": Parameter(1.0), "r": Parameter([1.0, 2.0]), "A": Parameter([[1.0, 2.0], [3.0, 4.0]])}
    )
    assert parameters.labels == ("m", "r[0]", "r[1]", "A[0,0]", "A[1,0]", "A[0,1]", "A[1,1]")
    assert parameters.start.tolist() == [1, 1, 2, 1, 3, 2, 4]  # column by column
    assert parameters.position("A") == slice(3, 7)


def test_bounds_and_flags_fill_the_shape():
    p = Parameter([[1.0, 2.0]], bounds=(0.0, [[5.0, 6.0]]), fixed=[[True, False]])
    parameters = ParameterSet({"a": p, "b": Parameter(3.0)})
    assert parameters.lower.tolist() == [0, 0, -np.inf]
    assert parameters.upper.tolist() == [5, 6, np.inf]
    assert parameters.free.tolist() == [False, True, True]
    assert parameters.free.dtype == bool


def test_parameters_do_not_change():
    value = np.ones(2)
    p = Parameter(value)
    value[0] = 7.0
    assert p.value.tolist() == [1.0, 1.0]
    for array in (p.value, *p.bounds, p.fixed):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    parameters = ParameterSet({"a": p})
    changed = parameters.change(a={"fixed": True, "unit": "N"})
    assert changed["a"].fixed.all()
    assert changed["a"].unit == "N"
    assert not parameters["a"].fixed.any()


def test_at_moves_rounding_back_onto_the_bounds():
    parameters = ParameterSet({"a": Parameter(0.5, bounds=(0.0, 1.0)), "b": Parameter(0.0)})
    moved = parameters.at(np.array([-1e-17, 3.0]))
    assert moved.start.tolist() == [0.0, 3.0]


def test_joining_sets_keeps_the_order():
    a, b = ParameterSet({"x": Parameter(1.0)}), ParameterSet({"y": Parameter(2.0)})
    assert tuple(a | b) == ("x", "y")
    with pytest.raises(InputError, match="'x' is used twice"):
        a | a


def test_other_names_keep_their_start():
    parameters = ParameterSet({"a": Parameter(1.0), "b": Parameter([2.0, 3.0])})
    assert parameters.pack({"b": [5.0, 6.0]}).tolist() == [1.0, 5.0, 6.0]
    assert parameters.pack({"b": [[5.0], [6.0]]}).tolist() == [1.0, 5.0, 6.0]


def test_sets_travel_between_processes():
    parameters = ParameterSet({"a": Parameter([1.0, 2.0], unit="m", bounds=(0, 3), prior=(1.0, 0.5))})
    copy = pickle.loads(pickle.dumps(parameters))
    assert copy.start.tolist() == [1.0, 2.0]
    assert copy["a"].prior == (1.0, 0.5)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Parameter("heavy"), "value is 'heavy'"),
        (lambda: Parameter([1.0, [2.0]]), "value is"),
        (lambda: Parameter(np.nan), "not finite"),
        (lambda: Parameter(np.ones((2, 2, 2))), "3 dimensions"),
        (lambda: Parameter(1.0, bounds=(2.0, 0.0)), "infeasible"),
        (lambda: Parameter(1.0, bounds=(0.0, np.nan)), "infeasible"),
        (lambda: Parameter(1.0, bounds=(2.0, 3.0)), "lies outside its bounds"),
        (
            lambda: Parameter([1.0, 2.0], bounds=(np.zeros(3), 5.0)),
            r"A bound .* has the shape \(3,\); give a number or an array of shape \(2,\)",
        ),
        (lambda: Parameter(1.0, bounds=0.0), "give a pair"),
        (lambda: Parameter(1.0, bounds=("low", "high")), "A bound of a parameter is low; give a number"),
        (lambda: Parameter(1.0, fixed=[True, False]), "A fixed flag of a parameter has the shape"),
        (lambda: Parameter(1.0, prior=(0.0, 0.0)), "positive standard deviation"),
        (lambda: Parameter(1.0, prior=(np.inf, 1.0)), "finite mean"),
        (lambda: Parameter(1.0, prior=3.0), "give a pair"),
        (lambda: Parameter(1.0, unit=3), "unit is 3; give plain text"),
        (lambda: Parameter({"k": 1.0}), "value is {'k': 1.0}; give a number"),
        (lambda: Parameter([1.0, 2.0], prior=(np.zeros(3), 1.0)), "The prior of a parameter has the shape"),
    ],
)
def test_invalid_parameters_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_invalid_values_of_a_set_are_refused():
    parameters = ParameterSet({"A": Parameter(np.zeros((2, 3)))})
    for call, words in (
        (lambda: parameters.pack({"B": 1.0}), "no parameter 'B'; there are A"),
        (lambda: parameters.pack({"A": np.zeros((3, 2))}), r"'A' was given with shape \(3, 2\); expected \(2, 3\)"),
        (lambda: parameters.pack({"A": np.zeros(6)}), "'A' was given with shape"),
        (lambda: parameters.unpack(np.zeros(5)), "length 5 was given; expected 6"),
        (lambda: parameters.position("B"), "no parameter 'B'"),
        (lambda: parameters.change(B={"fixed": True}), "no parameter 'B'"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_a_set_at_a_vector_changes_only_the_values(monkeypatch):
    own = ParameterSet(
        {"k": Parameter(2.0, "N/m", (1.0, 3.0), prior=(2.0, 1.0)), "A": Parameter(np.eye(2), fixed=True)}
    )
    monkeypatch.setattr(Parameter, "__post_init__", lambda self: pytest.fail("a valid parameter was validated again"))
    moved = own.at(np.array([9.0, 1.0, 2.0, 3.0, 4.0]))
    assert moved["k"].value == 3.0 and moved["A"].value.tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert (moved["k"].unit, moved["k"].bounds, moved["k"].prior) == ("N/m", (1.0, 3.0), (2.0, 1.0))
    assert moved["A"].fixed.all() and not moved["A"].value.flags.writeable
    assert own["k"].value == 2.0
    with pytest.raises(InputError, match="not finite"):
        own.at(np.full(5, np.nan))
