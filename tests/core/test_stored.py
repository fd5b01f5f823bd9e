"""Dataclasses in files of arrays."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from numpy.typing import NDArray

from wrf_mi.core.array_files import stored_arrays, write_arrays
from wrf_mi.core.stored import NOT_STORED, from_arrays, to_arrays

TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=6)
NUMBERS = st.floats(allow_nan=False)
ARRAYS = st.sampled_from([float, np.float32, np.int64, bool, complex]).flatmap(
    lambda kind: arrays_of.arrays(kind, arrays_of.array_shapes(min_dims=0, min_side=0, max_dims=3, max_side=3))
)


@dataclass(frozen=True)
class Plain:
    number: float
    choice: Literal["a", "b"] | None
    pair: tuple[int, float]


@dataclass
class Base:
    values: NDArray[Any]


@dataclass
class Derived(Base):
    label: str | None = None


PLAIN = st.builds(Plain, NUMBERS, st.sampled_from(["a", "b", None]), st.tuples(st.integers(-9, 9), NUMBERS))
NESTED = st.builds(Base, ARRAYS) | st.builds(Derived, ARRAYS, TEXTS | st.none())
INTEGERS = st.integers(-(2**63), 2**63 - 1)
FIELDS: list[tuple[Any, st.SearchStrategy[Any]]] = [
    (float, NUMBERS),
    (float | None, NUMBERS | st.none()),
    (int, INTEGERS),
    (int | str, INTEGERS | TEXTS),
    (bool, st.booleans()),
    (complex, st.complex_numbers(allow_nan=False)),
    (str, TEXTS),
    (NDArray[Any], ARRAYS),
    (NDArray[np.float64] | None, ARRAYS | st.none()),
    (tuple[float, ...], st.lists(NUMBERS, max_size=3).map(tuple)),
    (list[str], st.lists(TEXTS, max_size=3)),
    (dict[str, Any], st.dictionaries(TEXTS, st.none() | st.booleans() | NUMBERS | TEXTS, max_size=3)),
    (Plain, PLAIN),
    (tuple[Plain, ...], st.lists(PLAIN, max_size=2).map(tuple)),
    (Base, NESTED),
    (Derived | None, st.builds(Derived, ARRAYS) | st.none()),
    (list[Base | None], st.lists(NESTED | st.none(), max_size=3)),
    (tuple[Derived, NDArray[Any]], st.tuples(st.builds(Derived, ARRAYS), ARRAYS)),
    (dict[str, NDArray[Any]], st.dictionaries(TEXTS, ARRAYS, max_size=3)),
    (Mapping[int, Base], st.dictionaries(INTEGERS, NESTED, max_size=3)),
    (dict[str, Base], st.dictionaries(TEXTS, NESTED, max_size=3)),
]


@st.composite
def dataclasses_of_all_kinds(draw: st.DrawFn) -> Any:
    """A dataclass with some fields of every kind."""
    kinds = draw(st.lists(st.sampled_from(FIELDS), min_size=1, max_size=6))
    kind = make_dataclass("Drawn", [(f"x{number}", hint) for number, (hint, _) in enumerate(kinds)])
    return kind(*(draw(values) for _, values in kinds))


def assert_same(first: Any, second: Any) -> None:
    """Values of equal type and content, to the last bit."""
    assert type(first) is type(second)
    if isinstance(first, np.ndarray):
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)
    elif dataclasses.is_dataclass(first):
        assert_same(vars(first), vars(second))
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for key, value in first.items():
            assert_same(value, second[key])
    elif isinstance(first, list | tuple):
        assert len(first) == len(second)
        for pair in zip(first, second, strict=True):
            assert_same(*pair)
    else:
        assert first == second


@given(dataclasses_of_all_kinds())
def test_dataclass_is_equal_after_storing(value: Any) -> None:
    assert_same(from_arrays(type(value), to_arrays(value, "lead/"), "lead/"), value)


@given(value=dataclasses_of_all_kinds())
def test_dataclass_is_equal_after_a_file(value: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    file: Path = tmp_path_factory.getbasetemp() / "stored.npz"
    write_arrays(file, to_arrays(value), checksum=True)
    assert_same(from_arrays(type(value), stored_arrays(file)), value)


@dataclass
class Fit:
    data: str = field(metadata=NOT_STORED)
    rate: float
    plain: Plain
    parts: list[Base]
    part: Base | None = None


FIT = Fit("rows", 0.5, Plain(1.0, "a", (1, 2.0)), [Base(np.ones(2)), Derived(np.zeros(1))])


def test_field_that_is_not_stored_is_an_argument() -> None:
    arrays = to_arrays(FIT)
    assert "data" not in arrays
    assert_same(from_arrays(Fit, arrays, data="rows"), FIT)


@pytest.mark.parametrize("name", to_arrays(FIT))
def test_missing_array_is_refused_by_name(name: str) -> None:
    arrays = to_arrays(FIT)
    del arrays[name]
    with pytest.raises(ValueError, match=f"^array {name} is missing$"):
        from_arrays(Fit, arrays, data="rows")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rate", np.zeros(2), r"array rate has shape \(2,\), and one without axes is due"),
        ("rate", np.array("fast"), "array rate, setting value: expected float, got 'fast'"),
        ("plain", np.array('{"number": 1.0, "choice": "c", "pair": [1, 2.0]}'), "array plain.*'c'; choose from a, b"),
        ("plain", np.array("3"), "array plain.*: expected a mapping, got 3"),
        ("parts/0", np.array("Plain"), "array parts/0 is 'Plain', and Base or Derived is due"),
    ],
)
def test_array_of_another_form_is_refused(name: str, value: NDArray[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_arrays(Fit, to_arrays(FIT) | {name: value}, data="rows")


def test_class_without_a_form_is_no_value_of_a_field() -> None:
    with pytest.raises(TypeError, match="field part: complex cannot be stored"):
        to_arrays(dataclasses.replace(FIT, part=1j))  # type: ignore[arg-type]
