"""A receiver is given by its name or its number, wherever one is asked for."""

import doctest
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal

import wrf_mi
from wrf_mi.core import Receiver, receivers
from wrf_mi.core.receivers import receiver_index
from wrf_mi.models import Inputs
from wrf_mi.runs.api import Run
from wrf_mi.runs.prediction_file import write_prediction_file
from wrf_mi.training.predictor import Predictor

NAMES = ("kitchen", "1", "anchor2", "0")
MADE = [Receiver(name, np.zeros(3), np.array([0.0, 0, 0, 1])) for name in NAMES]


@pytest.mark.parametrize(
    ("receiver", "index"), [*((name, k) for k, name in enumerate(NAMES)), *((k, k) for k in range(4)), (np.int64(2), 2)]
)
def test_strings_are_names_and_integers_are_numbers(receiver: int | str, index: int) -> None:
    assert receiver_index(MADE, receiver) == index


@pytest.mark.parametrize(
    "receiver",
    ["sensor10", "", "2", "4", True, "-1", "1.0", "1_0", " 2", "9" * 5000, "Kitchen", 4, -1, 1.0, None, "a\nb"],
)
def test_unknown_receivers_are_refused_in_one_line_with_the_names(receiver: Any) -> None:
    refusal(receiver_index, MADE, receiver, r"no receiver .*; give one of kitchen, 1, anchor2, 0, or its number")


def test_ambiguous_names_are_refused_and_long_lists_are_cut() -> None:
    refusal(receiver_index, [*MADE, MADE[1]], "1", r"'1': name of several; give a number, of 1, 4$")
    refusal(
        receiver_index, MADE[::-1] * 10, "sensor10", r"kitchen, 0, anchor2 and 34 more, or its number from 0 to 39$"
    )


def test_example() -> None:
    assert doctest.testmod(receivers).failed == 0


@pytest.mark.parametrize(("function", "kind"), [(Run.predict, "int | str | None"), (Predictor.__call__, "int | str")])
def test_functions_say_that_they_take_names(function: Callable[..., Any], kind: str) -> None:
    assert inspect.signature(function).parameters["receiver"].annotation == kind


@pytest.mark.parametrize("model", ["mri", "kriging"])
def test_runs_predict_for_a_receiver_by_name(model: str, plain_flat_folder: Path, tmp_path: Path) -> None:
    run = wrf_mi.open_run(wrf_mi.train(plain_flat_folder, model, out=tmp_path / model).folder)
    by_name, by_number, other = (run.predict([[1.0, 2.0, 0.5]], name).mean for name in ("hall $_$", 1, "kitchen"))
    np.testing.assert_array_equal(by_name, by_number)
    assert by_name != other
    for wrong in ("sensor10", 2, -1):
        refusal(run.predict, [[1.0, 2.0, 0.5]], wrong, r"no receiver .*; give one of kitchen, hall")


def test_predicted_table_has_a_column_for_each_of_two_receivers_of_one_name(tmp_path: Path) -> None:
    observations = {"prediction": np.array([[-40.0, -41.0], [-50.0, -51.0]])}
    write_prediction_file(tmp_path / "p.csv", Inputs(np.zeros((2, 3))), ["a", "a"], observations)
    rows = (tmp_path / "p.csv").read_text().splitlines()
    assert rows[:2] == ["x,y,z,a_dbm,a_dbm", "0.0,0.0,0.0,-40.0,-50.0"]
