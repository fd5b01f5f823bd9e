"""Interpolation methods: settings, predictions, and lengths and intervals over large areas."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import yaml
from calling import stored
from changed_folders import DATA, needs
from commands import Command
from made_channels import channels
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.settings import describe, settings_from, with_settings
from wrf_mi.core.stored import from_arrays, to_arrays
from wrf_mi.datasets import load, make_splits, write_nerf2_csi, write_spectrum_folder
from wrf_mi.estimators.interpolation.kriging import Kriging
from wrf_mi.estimators.interpolation.path_loss import Trend
from wrf_mi.estimators.interpolation.strength_settings import SHADOWINGS, StrengthSettings
from wrf_mi.estimators.interpolation.strengths import Strengths, fit_strengths
from wrf_mi.estimators.interpolation.trees import GrownTrees, Trees
from wrf_mi.estimators.model import default_settings, inputs_of
from wrf_mi.models import MODELS, Problem, Session, known_model
from wrf_mi.runs.api import train
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import REAL_90

SETTINGS = {
    f"{name} {what}": kind
    for name, model in MODELS.items()
    for what, kind in (model.settings.items() if isinstance(model.settings, dict) else [("", model.settings)])
}
ROUNDING = 1e-4  # powers of tens of dBm are stored in single precision


def test_entries_of_the_registry_are_consistent() -> None:
    assert {"wrf-gs", "wrf-gs+", "factorised", "hybrid", "ray-tracing", "idw", "kriging"} <= set(MODELS)
    for name, model in MODELS.items():
        assert model.name == name
        assert set(model.tasks or ()) <= set(TASKS)
        assert model.source
        for task in model.tasks or TASKS:
            kind = model.serving(task, model.scene != "none").settings
            assert isinstance(kind, type)
            kind()
    with pytest.raises(InputError, match="model 'no-such': no such model; choose from wrf-gs, wrf-gs"):
        known_model("no-such")


def test_settings_are_listed_and_accept_null(flat_folder: Path, command: Command) -> None:
    out = command.done(["train", "--help-settings"])
    for line in ("idw:", "neighbours=null", "kriging, spectra:", "length_m=null", "mri:", "shared=False"):
        assert line in out.splitlines(), line
    defaults = MODELS["kriging"].serving("rssi", False).settings(length_m=2.0)
    changed = with_settings(defaults, ["length_m=null", "noise=1", "trend=constant"])
    assert (changed.length_m, changed.noise, changed.trend) == (None, 1.0, "constant")
    assert isinstance(changed.noise, float)


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_round_trip_through_the_configuration_and_the_list(name: str) -> None:
    """As ``config.yaml`` keeps them and as ``--help-settings`` shows them, lists, choices and null included."""
    settings = SETTINGS[name]()
    reloaded = yaml.safe_load(yaml.safe_dump(json.loads(json.dumps(asdict(settings)))))
    assert settings_from(type(settings), reloaded, "config.yaml") == settings
    assert with_settings(settings, describe(settings).splitlines()) == settings


@dataclass(frozen=True)
class Several:
    """Settings of every type."""

    pair: tuple[float, float] = (1.0, 2.0)
    many: tuple[int, ...] = (1,)
    kind: Literal["a", "b"] = "a"
    maybe: float | None = None


def test_settings_of_every_type() -> None:
    changed = with_settings(Several(), ["pair=[3, 4]", "many=[5, 6, 7]", "kind=b", "maybe=2"])
    assert changed == Several((3.0, 4.0), (5, 6, 7), "b", 2.0)
    for wrong, message in (
        ("pair=[3]", "setting pair: expected a list of 2 values"),
        ("many=5", "setting many: expected a list of values, got 5"),
        ("many=[1.5]", "setting many: expected int, got 1.5"),
        ("kind=c", "setting kind: 'c'; choose from a, b"),
        ("maybe=x", "setting maybe: expected float, got 'x'"),
    ):
        with pytest.raises(InputError, match=message):
            with_settings(Several(), [wrong])


def test_mri_recovers_an_exact_path_loss_law(flat_folder: Path, tmp_path: Path) -> None:
    """T = -45 dBm and gamma = 2 at both anchors, without noise; a receiver missed some rows."""
    record = load(flat_folder)
    distance = np.stack([np.linalg.norm(record.tx_pos_m - r.position_m, axis=1) for r in record.receivers])
    exact = (-45 - 20 * np.log10(distance)).astype(np.float32)
    record.observation[:] = exact
    record.observation[1, 3:9] = np.nan
    for shared in ("false", "true"):
        out = train(record, "mri", out=tmp_path / shared, settings=(f"shared={shared}",)).folder
        with np.load(out / "model.npz") as arrays:
            np.testing.assert_allclose(arrays["models/1/law"], [-45, -2], atol=ROUNDING)
        np.testing.assert_allclose(stored(out)["prediction"], exact[:, 24:], atol=ROUNDING)


def test_kriging_runs_equal_the_library_for_every_task(folder: Path, tmp_path: Path) -> None:
    """Given lengths and noise: the adapter's constant trend and, for channels, complex numbers and all antennas."""
    for data in (folder, write_nerf2_csi(tmp_path / "stations", channels())):
        out = train(data, "kriging", out=tmp_path / f"run-{data.name}", settings=("length_m=0.5", "noise=0.1")).folder
        record, arrays = load(data), stored(out)
        (split,) = make_splits(record, "official")
        model = Kriging(0.5, 0.1).fit(record.tx_pos_m[split.all_train], record.observation[0, split.all_train])
        np.testing.assert_array_equal(arrays["prediction"], model.predict(record.tx_pos_m[split.test]))


def test_runs_with_headings_equal_the_library(flat_folder: Path, tmp_path: Path) -> None:
    """Kriging about each receiver's log-distance law, and trees, as the library alone has them."""
    record = load(flat_folder)
    (split,) = make_splits(record, "official")
    place, turned, training_rows = record.tx_pos_m, record.tx_heading_rad, split.all_train
    kriging, trees = ("length_m=0.5", "noise=0.1", "heading_length=1.5"), ("trees=20", "leaf_rows=2")
    for name, settings in (("kriging", kriging), ("trees", trees)):
        predicted = stored(train(flat_folder, name, out=tmp_path / name, settings=settings).folder)["prediction"]
        for r, receiver in enumerate(record.receivers):
            law = Trend(receiver.position_m)
            model = Kriging(0.5, 0.1, 1.5, trend=law, trend_fit="ols") if name == "kriging" else Trees(20, 2)
            expected = model.fit(place[training_rows], record.observation[r, training_rows], turned[training_rows])
            at_test = expected.predict(place[split.test], turned[split.test])
            np.testing.assert_allclose(predicted[r], at_test, atol=ROUNDING)


def test_grown_trees_predict_as_scikit_learn(flat_folder: Path) -> None:
    record = load(flat_folder)
    rng = np.random.default_rng(2)
    positions, heading = rng.uniform(0, 5, (400, 3)), rng.uniform(-3, 3, 400)
    for turned_by in (None, heading):
        values, columns = np.sin(positions[:, 0]).astype(np.float32), [positions]
        columns += [] if turned_by is None else [np.cos(heading)[:, None], np.sin(heading)[:, None]]
        model = ExtraTreesRegressor(30, min_samples_leaf=2, random_state=0).fit(np.hstack(columns), values)
        stored_trees = from_arrays(GrownTrees, to_arrays(Trees(30, 2).fit(positions, values, turned_by)))
        # At thresholds, where single precision decides the side.
        edge = np.resize(record.tx_pos_m, (300, 3))
        edge[:, 0] = np.resize(
            stored_trees.threshold[(stored_trees.feature == 0) & (stored_trees.left != stored_trees.right)], 300
        )
        asked = edge, None if turned_by is None else np.resize(record.tx_heading_rad, 300)
        columns = [edge] if asked[1] is None else [edge, np.cos(asked[1])[:, None], np.sin(asked[1])[:, None]]
        np.testing.assert_allclose(stored_trees.predict(*asked), model.predict(np.hstack(columns)), atol=1e-6)


@needs("flat-ble")
def test_published_figure_of_mri(tmp_path: Path) -> None:
    """Median 4.17 dB, 90th percentile 10.2 dB, over all anchors and test rows: the data's description."""
    error_db = train("flat-ble", "mri", out=tmp_path / "run").metrics["abs_error_db"]
    assert error_db["median"] == pytest.approx(4.17, abs=0.01)
    assert error_db["p90"] == pytest.approx(10.2, abs=0.05)


def test_idw_of_one_training_row_copies_it_at_every_receiver(two_gateways: Record, tmp_path: Path) -> None:
    data = write_spectrum_folder(tmp_path / "data", two_gateways, bits=16)
    arrays = stored(train(data, "idw", out=tmp_path / "run", n_train=1).folder)
    assert arrays["prediction"].shape == arrays["truth"].shape
    assert (arrays["prediction"] == arrays["prediction"][:, :1]).all()


LIKELY = StrengthSettings(shadowing="likelihood")
FACTOR = 2.5  # of a length by the likelihood of some hundred rows about the true one, either way
COVERED = (0.84, 0.96)
"""Share inside 90 % of some hundred errors, which shadowing correlates: 0.9 within three standard errors of 2 %."""


def area(seed: int, shadow_m: float, extent_m: float = 400.0, receivers: int = 18, rows: int = 300) -> Record:
    """Strengths by the law of exponent 3.2, shadowing of 7 dB, noise of 2 dB, over a square; the last fifth tests."""
    rng = np.random.default_rng(seed)
    tx_pos_m = np.column_stack([rng.uniform(0, extent_m, (rows, 2)), np.full(rows, 1.5)])
    places_m = np.column_stack([rng.uniform(0, extent_m, (receivers, 2)), np.full(receivers, 6.0)])
    apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
    lower = np.linalg.cholesky(np.exp(-apart_m / shadow_m) + 1e-9 * np.eye(rows))
    observed = np.empty((receivers, rows), np.float32)
    for values, place_m in zip(observed, places_m, strict=True):
        law_dbm = -35 + rng.normal(0, 3) - 32 * np.log10(np.linalg.norm(tx_pos_m - place_m, axis=1))
        values[:] = law_dbm + 7 * lower @ rng.normal(size=rows) + rng.normal(0, 2, rows)
    observed[observed < -110] = np.nan
    named = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    official = np.arange(rows * 4 // 5), np.arange(rows * 4 // 5, rows)
    return Record("area", "rssi", tx_pos_m, named, observed, official=official, frequencies_hz=np.array([868e6]))


def errors_db(record: Record, model: str, folder: Path, *settings: str) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors of the test rows, and the same in standard deviations."""
    training_rows, test = record.official
    split = Split(
        "official", 0, training_rows[len(training_rows) // 10 :], training_rows[: len(training_rows) // 10], test
    )
    entry = MODELS[model].serving("rssi", False)
    with threadpool_limits(1, "blas"):  # as in runs
        fitted = entry.fit(Problem(record, default_settings(entry, settings, {})), split, Session(folder, folder))
    predictions = [fitted.predict(inputs_of(record, test), k) for k in range(len(record.receivers))]
    errors = np.abs(np.stack([each.mean for each in predictions]) - record.observation[:, test])
    received = np.isfinite(errors)
    return errors[received], (errors / np.stack([each.stated_std for each in predictions]))[received]


@pytest.mark.parametrize("shadow_m", [15.0, 60.0])
def test_length_is_that_of_the_data(shadow_m: float) -> None:
    record = area(0, shadow_m, receivers=6)
    fitted = fit_strengths(record, np.arange(240), settings=LIKELY).field.hyperparameters
    assert shadow_m / FACTOR < fitted.shadow_m < FACTOR * shadow_m


def test_sectors_of_antennas_are_learned_where_there_are_any() -> None:
    record = area(2, 30.0, receivers=4)
    plain = fit_strengths(record, np.arange(240), settings=LIKELY).field.prior.rx_sd_db
    for values, receiver in zip(record.observation, record.receivers, strict=True):
        away = record.tx_pos_m - receiver.position_m
        values += (8 * np.cos(np.arctan2(away[:, 1], away[:, 0]))).astype(np.float32)
    assert fit_strengths(record, np.arange(240), settings=LIKELY).field.prior.rx_sd_db > 1.5 * plain


def test_intervals_cover(tmp_path: Path) -> None:
    _, relative = errors_db(area(0, 30.0), "kriging", tmp_path)
    assert COVERED[0] < np.mean(relative < REAL_90) < COVERED[1]


@pytest.mark.slow
@needs("duke-cbrs")
def test_hybrid_over_a_real_campus(tmp_path: Path) -> None:
    """Within the error of generic kriging, whose lengths are by likelihood, and intervals that cover."""
    metrics = train(load(DATA / "duke-cbrs"), "hybrid", out=tmp_path / "run").metrics
    assert metrics["abs_error_db"]["median"] <= 6.1
    assert 0.85 < metrics["inside_90"] < 0.95


def test_the_mean_of_a_receiver_has_its_carrier_and_is_stored() -> None:
    """At one place free space differs by 20 log10 of the carriers' ratio, as of Friis' law."""
    place, carriers_hz = np.array([0.0, 0, 2]), np.array([0.9e9, 3.6e9])
    receivers = tuple(Receiver(f"cell:{hz:g}", place, np.array(UPRIGHT)) for hz in carriers_hz)
    positions_m = np.random.default_rng(0).uniform(1, 9, (12, 3))
    level = -20 * np.log10(np.linalg.norm(positions_m - place, axis=1))
    observed = np.stack([level - 40, level - 52]).astype(np.float32)
    plain = Record("cells", "rssi", positions_m, receivers, observed, frequencies_hz=np.array([0.9e9]))
    for record, ratio in ((plain.at_receiver_carriers(carriers_hz), 4), (plain, 1)):
        fitted = fit_strengths(record, np.arange(12))
        again = Strengths.from_arrays(fitted.arrays())
        np.testing.assert_array_equal(again.field.prior.frequency_hz, fitted.field.prior.frequency_hz)
        poses = again.field.stops.poses
        difference_db = np.subtract(*(again.field.prior.columns(poses, receiver)[0] for receiver in (0, 1)))
        np.testing.assert_allclose(difference_db, 20 * np.log10(ratio), rtol=1e-12)


UNCLEAR = 1.05
"""Largest ratio of the mean error to that of the best origin of lengths, chosen by a fifth of some hundred rows."""


@pytest.mark.parametrize(
    ("shadow_m", "extent_m", "receivers"),
    [(2.5, 90.0, 3), (200.0, 1500.0, 6)],
    ids=["large building of short lengths", "outdoors"],
)
def test_held_out_rows_choose_the_lengths(shadow_m: float, extent_m: float, receivers: int, tmp_path: Path) -> None:
    record = area(1, shadow_m, extent_m, receivers)
    chosen = errors_db(record, "kriging", tmp_path / "chosen")[0].mean()
    of_each = [errors_db(record, "kriging", tmp_path / name, f"shadowing={name}")[0].mean() for name in SHADOWINGS]
    assert chosen < UNCLEAR * min(of_each)
    assert max(of_each) > 1.02 * min(of_each)  # else nothing could be chosen wrongly
