"""Models as a regressor of scikit-learn: its checks of estimators, cross-validation, missing readings, copies."""

import gc
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_walks import STEPS, walked
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer
from sklearn.utils.estimator_checks import estimator_checks_generator, parametrize_with_checks

import wrf_mi
from wrf_mi import Scene, WrfRegressor
from wrf_mi.core.angles import FloatArray

COLUMNS = "its X has neither two nor three columns"
NO_HEIGHT = "its X has two columns, and no height_m is stated"
NOT_POSITIONS = {
    "check_estimators_overwrite_params": NO_HEIGHT,
    "check_estimators_fit_returns_self": NO_HEIGHT,
    "check_readonly_memmap_input": NO_HEIGHT,
    "check_positive_only_tag_during_fit": COLUMNS,
    "check_n_features_in_after_fitting": COLUMNS,
    "check_estimators_dtypes": COLUMNS,
    "check_dtype_object": COLUMNS,
    "check_regressors_train": COLUMNS,
    "check_regressor_data_not_an_array": COLUMNS,
    "check_regressor_multioutput": COLUMNS,
    "check_regressors_no_decision_function": COLUMNS,
    "check_regressors_int": COLUMNS,
    "check_fit_idempotent": NO_HEIGHT,
    "check_fit_check_is_fitted": NO_HEIGHT,
    "check_n_features_in": NO_HEIGHT,
}
"""Checks that cannot apply to positions, each with its reason; `AnyColumns` passes them."""
SAME_DB = 1e-4  # predictions are float32


class AnyColumns(WrfRegressor):
    """Regressor whose positions are the first three of any number of columns, zero where there are fewer."""

    def _positions_m(self, X: NDArray[np.float64]) -> FloatArray:
        return np.pad(X[:, :3], ((0, 0), (0, max(0, 3 - X.shape[1]))))

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = True  # seven of ten columns do not count
        return tags


@parametrize_with_checks([WrfRegressor("idw")], expected_failed_checks=lambda _: NOT_POSITIONS)
def test_conventions_of_scikit_learn_hold(estimator: WrfRegressor, check: Any) -> None:
    check(estimator)


CHECKS = {check.func.__name__: check for _, check in estimator_checks_generator(AnyColumns("idw"))}


@pytest.mark.parametrize("name", NOT_POSITIONS)
def test_conventions_of_scikit_learn_hold_of_any_columns(name: str) -> None:
    CHECKS[name](AnyColumns("idw"))


@pytest.fixture(scope="module")
def walks() -> wrf_mi.Record:
    """Four walks past eight receivers, without offsets of devices."""
    return walked(dict.fromkeys("abcd", 0.0), seed=3)


def receivers_m(record: wrf_mi.Record) -> FloatArray:
    return np.array([receiver.position_m for receiver in record.receivers])


def test_cross_validation_beside_a_gaussian_process(walks):
    """On walks that it was not trained on, kriging with the law of distance is closer than a Gaussian process."""
    positions_m, power_dbm, runs = walks.tx_pos_m[::2], walks.observation[:3, ::2].T, walks.runs[::2]
    process = GaussianProcessRegressor(ConstantKernel(1.0) * RBF(5.0) + WhiteKernel(0.1), normalize_y=True)
    regressor = WrfRegressor("kriging", receivers=receivers_m(walks)[:3], frequency_hz=2.44e9)
    folds = list(GroupKFold(2).split(positions_m, groups=runs))
    ours, theirs = (cross_val_score(each, positions_m, power_dbm, cv=folds) for each in (regressor, process))
    assert np.isfinite(ours).all()
    assert np.mean(ours) > np.mean(theirs)


@pytest.mark.slow
def test_hybrid_in_a_scene_with_a_receiver_at_an_unknown_place():
    """A law of distance in the laboratory is predicted by the hybrid, though nobody states the receiver's place."""
    place_m = wrf_mi.load("laboratory").receivers[0].position_m
    X = np.random.default_rng(0).uniform([1.0, 1.0], [5.0, 3.0], (40, 2))
    y = -40 - 20 * np.log10(np.linalg.norm(np.column_stack([X, np.full(40, 1.2)]) - place_m, axis=1))
    regressor = WrfRegressor(scene=Scene.open("laboratory"), height_m=1.2, frequency_hz=2.4e9, preset="fast")
    regressor.fit(X[:30], y[:30])
    assert regressor.score(X[30:], y[30:]) > 0.99
    assert regressor.predict(X[30:], return_std=True)[1].min() > 0
    assert regressor.run_.receivers[0].position_std_m is not None


def test_pipeline_with_a_turned_frame_predicts_the_same(walks):
    """Kriging depends on distances: a step before it that turns the positions changes no prediction."""
    turned = FunctionTransformer(lambda positions_m: positions_m[:, [1, 0]] * [1, -1])
    X, y = walks.tx_pos_m[:STEPS, :2], walks.observation[0, :STEPS]
    plain = WrfRegressor("idw", height_m=1.3).fit(X, y)
    predicted = make_pipeline(turned, clone(plain)).fit(X, y).predict(X[:5] + 0.5)
    np.testing.assert_allclose(predicted, plain.predict(X[:5] + 0.5), atol=SAME_DB)


def test_missing_readings_are_no_values(walks):
    """Rows that a receiver did not receive are neither learned nor scored, by a model of each receiver alone."""
    X, y, places_m = walks.tx_pos_m[:STEPS], walks.observation[:2, :STEPS].T.copy(), receivers_m(walks)[:2]
    y[::3, 1] = np.nan
    heard = np.isfinite(y[:, 1])
    both = WrfRegressor("mri", receivers=places_m).fit(X, y)
    first = WrfRegressor("mri", receivers=places_m[:1]).fit(X, y[:, 0])
    second = WrfRegressor("mri", receivers=places_m[1:]).fit(X[heard], y[heard, 1])
    np.testing.assert_allclose(both.predict(X), np.column_stack([first.predict(X), second.predict(X)]), atol=SAME_DB)
    scores = first.score(X, y[:, 0]), second.score(X[heard], y[heard, 1])
    assert both.score(X, y) == pytest.approx(np.mean(scores), abs=1e-5)


def test_copy_outlives_the_run(walks):
    """A pickle contains the files of the run, whose temporary folder is removed with it."""
    X, y = walks.tx_pos_m[:STEPS], walks.observation[:2, :STEPS].T
    regressor = WrfRegressor("idw").fit(X, y)
    before, folder, stored = regressor.predict(X), regressor.run_.folder, pickle.dumps(regressor)
    del regressor
    gc.collect()
    assert not folder.exists()
    copied = pickle.loads(stored)
    np.testing.assert_array_equal(copied.predict(X), before)
    assert copied.run_.metrics["n_train"] == STEPS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height_m": 1.3}, r"X: n_features = 3; give x, y, or omit height_m"),
        ({"receivers": [[0.0, 0, 2]]}, r"receivers: 1 for 2 columns of y; give a position"),
        ({"receivers": [[0.0, 0], [1, 1]]}, r"give a position x, y, z in metres of each column"),
        ({"scene": "laboratory"}, r"takes no scene; omit --scene"),
    ],
)
def test_arguments_that_do_not_fit_the_data_are_refused(walks, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(wrf_mi.InputError, match=message):
        WrfRegressor("idw", **arguments).fit(walks.tx_pos_m[:9], walks.observation[:2, :9].T)


def test_deviations_of_a_model_without_any_need_intervals(walks, tmp_path: Path) -> None:
    X, y = walks.tx_pos_m[:STEPS], walks.observation[0, :STEPS]
    with pytest.raises(wrf_mi.InputError, match=r"idw: states no standard deviations .* intervals=True"):
        WrfRegressor("idw").fit(X, y).predict(X, return_std=True)
    regressor = WrfRegressor("idw", intervals=True, out=tmp_path / "run").fit(X, y)
    mean_dbm, std_db = regressor.predict(X, return_std=True)
    assert mean_dbm.shape == std_db.shape == (STEPS,)
    assert std_db.min() > 0
    assert wrf_mi.open_run(tmp_path / "run", regressor.run_.record).metrics["n_test"] == 0
    with pytest.raises(wrf_mi.InputError, match="no test rows, so no scores"):
        wrf_mi.compare([tmp_path / "run"], tmp_path / "page")
    with pytest.raises(wrf_mi.InputError, match="run"):
        regressor.fit(X, y)
