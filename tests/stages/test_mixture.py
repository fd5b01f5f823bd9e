"""Mixtures of parts that state deviations and parts that do not, single parts, one hold-out, and stored mixtures."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wrf_mi
from wrf_mi.core import Prediction, Record, Split
from wrf_mi.datasets import make_splits
from wrf_mi.estimators import held_out
from wrf_mi.estimators.few_rows import with_few_rows
from wrf_mi.estimators.model import Arrays, Decomposition, Fitted, Inputs, default_settings
from wrf_mi.models import MODELS, Problem, Session
from wrf_mi.stages.fitted import FittedMixture, deviation_weights
from wrf_mi.stages.mixture import ChosenWeights, MixtureFit, Part
from wrf_mi.training.by_distance import Intervals, Mixture, constant
from wrf_mi.training.selection import RowDistance, hold_out

FACTOR = 1.5  # of the made intervals


class Level(Fitted):
    """A strength everywhere, with or without a standard deviation, traced and learned in halves."""

    def __init__(self, level_dbm: float, std_db: float | None = None) -> None:
        self.level_dbm, self.std_db = level_dbm, std_db

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        mean = np.full(len(inputs), self.level_dbm)
        if self.std_db is None:
            return Prediction(mean)
        return Prediction(mean, np.full(len(inputs), self.std_db), std_mean=np.full(len(inputs), self.std_db / 2))

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        prediction = self.predict(inputs, receiver)
        return Decomposition(prediction, prediction.mean - 3, prediction.mean - 3)

    def arrays(self) -> Arrays:
        return {}


@pytest.fixture(scope="module")
def flat(flat_folder: Path) -> tuple[Problem, Split]:
    record = wrf_mi.load(flat_folder)
    return Problem(record, None), make_splits(record, "official")[0]


def mixture_of(flat, weights, parts, *deviations):
    problem, split = flat
    intervals = Intervals(np.ones(1), np.ones(1), np.zeros(1), np.full(1, FACTOR))
    return FittedMixture("made", problem, split.all_train, parts, weights, None, intervals, deviations, {})


def test_deviations_of_a_mixture_are_those_of_the_parts_that_state_them(flat: tuple[Problem, Split]) -> None:
    """Near the rows of both parts, farther away of that without deviations alone."""
    weights = Mixture(np.array([0.0, 0.1]), np.array([[0.5, 0.5], [0.0, 1.0]]))
    mixture = mixture_of(flat, weights, {"stating": Level(-50, 4.0), "silent": Level(-60)}, "stating")
    record = flat[0].record
    at_m = np.concatenate([record.tx_pos_m[:1], record.tx_pos_m[:1] + np.array([0, 0, 5.0])])
    prediction = mixture.predict(Inputs(at_m), 0)
    np.testing.assert_allclose(prediction.mean, [-55, -60])
    np.testing.assert_allclose(prediction.std, 4 * FACTOR)
    np.testing.assert_allclose(prediction.std_mean, 2 * FACTOR)
    np.testing.assert_allclose(mixture.predict_mean(Inputs(at_m), 0), prediction.mean)


def test_deviation_weights_are_those_of_the_stating_predictions_and_equal_without_any() -> None:
    weights = np.array([[0.2, 0.6, 0.2], [0.0, 1.0, 0.0]])
    states = np.array([True, False, True])
    np.testing.assert_allclose(deviation_weights(weights, states), [[0.5, 0, 0.5], [0.5, 0, 0.5]])
    assert not deviation_weights(weights, ~states & states).any()


def test_single_part_keeps_its_traced_and_learned_components(flat: tuple[Problem, Split]) -> None:
    mixture = mixture_of(flat, constant(np.ones(1)), {"made": Level(-50, 4.0)}, "made")
    parts = mixture.decompose(Inputs(flat[0].record.tx_pos_m[:2]), 0)
    assert parts.traced is not None
    assert parts.learned is not None
    np.testing.assert_array_equal(parts.traced, -53)
    np.testing.assert_allclose(parts.prediction.std, 4 * FACTOR)


def fit_of(names: Sequence[str], flat: tuple[Problem, Split], folder: Path) -> MixtureFit:
    problem, split = flat
    entries = {name: with_few_rows(MODELS[name].serving("rssi", False), "rssi") for name in names}
    parts = {
        name: Part(entry, replace(problem, settings=default_settings(entry, (), {})), Session(folder / name, folder))
        for name, entry in entries.items()
    }
    fit = MixtureFit("made", parts, problem, split, Session(folder, folder))
    for name in names:
        fit.predict_held_out(name)
    return fit


def test_fit_of_parts_with_and_without_deviations_states_those_of_the_former(flat, tmp_path):
    fit = fit_of(["kriging", "idw"], flat, tmp_path)
    assert fit.rows is not None
    count = len(fit.rows.held_out)
    halves = ChosenWeights("mixed", constant(np.full(2, 0.5)), np.full((count, 2), 0.5))
    mixture = fit.mixture(halves, None, {})
    assert mixture.deviations == ("kriging",)
    alone = fit.mixture(ChosenWeights("single", constant(np.eye(2)[1]), np.tile(np.eye(2)[1], (count, 1))), None, {})
    assert list(alone.parts) == ["idw"]
    assert alone.deviations == ()
    inputs = flat[0].record.inputs(flat[1].test)
    means = {name: fit.part(name).predict_mean(inputs, 0) for name in ("kriging", "idw")}
    predicted = mixture.predict(inputs, 0)
    np.testing.assert_allclose(predicted.mean, (means["kriging"] + means["idw"]) / 2)
    assert predicted.std_mean is not None
    assert np.ptp(predicted.stated_std / fit.part("kriging").predict(inputs, 0).stated_std) < 1e-6
    assert np.ptp(alone.predict(inputs, 0).stated_std) < 1e-6


def test_rows_are_held_out_once_in_a_fit(flat, tmp_path, monkeypatch):
    """By the mixture, and for the choices of the kriging in it; the fit without these rows holds out others."""
    splits = list[Split]()

    def counted(record: Record, split: Split) -> Split | None:
        splits.append(split)
        return hold_out(record, split)

    monkeypatch.setattr(held_out, "hold_out", counted)
    fit = fit_of(["kriging"], (replace(flat[0], hold_outs=[]), flat[1]), tmp_path)
    assert fit.part("kriging").options, "chosen by held-out rows"
    assert sum(split is flat[1] for split in splits) == 1


def test_distances_of_a_refit_mixture_are_those_to_its_rows(flat: tuple[Problem, Split], tmp_path: Path) -> None:
    fit = fit_of(["kriging"], flat, tmp_path)
    mixture, record = fit.mixture(fit.weights(), None, {}), flat[0].record
    rows = flat[1].all_train[::2]
    refit = mixture.refit(record, rows)
    assert refit is not None
    at_m = record.tx_pos_m[flat[1].test]
    np.testing.assert_array_equal(refit._distance(at_m, 0), RowDistance.of_rows(record, rows)(at_m, 0))
