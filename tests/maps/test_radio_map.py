"""Radio maps: closed forms, files that other readers open, chunks, sides and paths, coverage, what is refused."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
import xarray as xr
from calling import SMALL
from commands import Command, arrays_in
from PIL import Image
from scipy.constants import speed_of_light
from scipy.stats import norm
from traced_rooms import SHOEBOX, write_xml

import wrf_mi
from wrf_mi.apps.maps import api
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.coverage import coverage_probability, reliability, reliability_figure, run_reliability
from wrf_mi.apps.maps.dataset import write_map
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import write_ble_folder
from wrf_mi.models import Inputs
from wrf_mi.runs.api import train
from wrf_mi.runs.run import Run
from wrf_mi.stages.fitted import FittedMixture
from wrf_mi.training.by_distance import Mixture
from wrf_mi.training.selection import RowDistance

HZ = 2.44e9
FIT_DB = 1e-3
"""Of a law that is fitted to float32 values of its own form."""
FLOAT32 = 1e-5
TRANSMIT_DBM = 12.0
REFLECTED_DB = 3.0
"""Of the power of one-bounce reflections beside a line of sight in the room."""


@pytest.fixture(scope="module")
def strengths() -> Record:
    """Strengths in free space of a transmitter of 12 dBm, with isotropic antennas."""
    rng = np.random.default_rng(0)
    positions = rng.uniform([1, 1, 1.3], [5, 4, 1.3], (60, 3))
    receivers = tuple(
        wrf_mi.Receiver(name, np.array(at), np.array([0.0, 0, 0, 1]))
        for name, at in (("hall $_$", (0.0, 0.5, 2.0)), ("kitchen", (5.5, 4.5, 2.2)))
    )
    observed = np.stack([free_space_db(positions, receiver) + TRANSMIT_DBM for receiver in receivers])
    rows = np.arange(60)
    record_fields: dict[str, Any] = {"frequencies_hz": np.array([HZ]), "official": (rows[:45], rows[45:])}
    return Record("open", "rssi", positions, receivers, observed.astype(np.float32), **record_fields)


def free_space_db(positions_m: np.ndarray, receiver: wrf_mi.Receiver) -> np.ndarray:
    """Friis' path gain of isotropic antennas."""
    distance = np.linalg.norm(positions_m - receiver.position_m, axis=-1)
    return 20 * np.log10(speed_of_light / HZ / (4 * np.pi * distance))


@pytest.fixture(scope="module")
def law(strengths: Record, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return wrf_mi.train(strengths, "mri", out=tmp_path_factory.mktemp("runs") / "law", intervals=True)


@pytest.fixture(scope="module")
def mapped(law: Run) -> xr.Dataset:
    return radio_map(law, step_m=0.5, transmit_dbm=TRANSMIT_DBM, threshold_dbm=-32.0)


def grid_positions(mapped: xr.Dataset) -> np.ndarray:
    y, x = np.meshgrid(mapped["y"], mapped["x"], indexing="ij")
    return np.stack([x, y, np.full(x.shape, float(mapped["height"]))], axis=-1)


def test_path_gain_of_a_path_loss_law_in_free_space_is_that_of_friis(mapped: xr.Dataset, strengths: Record) -> None:
    positions = grid_positions(mapped)
    for gain, receiver in zip(mapped["path_gain_db"], strengths.receivers, strict=True):
        np.testing.assert_allclose(gain, free_space_db(positions, receiver), atol=FIT_DB)
    np.testing.assert_allclose(mapped["power_dbm"], mapped["path_gain_db"] + TRANSMIT_DBM, atol=FIT_DB)


def test_best_receiver_is_the_nearest_in_free_space(mapped: xr.Dataset, strengths: Record) -> None:
    at = np.stack([receiver.position_m for receiver in strengths.receivers])
    distance = np.linalg.norm(grid_positions(mapped)[..., None, :] - at, axis=-1)
    np.testing.assert_array_equal(mapped["best_receiver"], distance.argmin(axis=-1))


def test_variables_have_units_and_dimensions(mapped: xr.Dataset) -> None:
    assert (mapped["power_dbm"].dims, mapped["best_receiver"].dims) == (("receiver", "y", "x"), ("y", "x"))
    assert all("long_name" in mapped[name].attrs for name in (*mapped.data_vars, *mapped.coords))
    assert (mapped["power_std_db"].attrs["units"], mapped["x"].attrs["units"]) == ("dB", "m")
    assert mapped.attrs["Conventions"].startswith("CF-")
    assert mapped.attrs["threshold_dbm"] == -32.0


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_files_open_with_xarray_as_they_were_written(mapped: xr.Dataset, suffix: str, tmp_path: Path) -> None:
    for _ in range(2):  # once more over the first
        file = write_map(mapped, tmp_path / f"map{suffix}")
    with xr.open_dataset(file) as opened:
        xr.testing.assert_equal(opened.load(), mapped)
        assert opened["power_dbm"].attrs == mapped["power_dbm"].attrs
        assert set(opened.attrs) == set(mapped.attrs)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_table_has_a_row_for_each_receiver_and_position(mapped: xr.Dataset, tmp_path: Path) -> None:
    table = pd.read_csv(write_map(mapped, tmp_path / "map.csv"))
    assert len(table) == mapped["power_dbm"].size
    row = table.iloc[57]
    parts = mapped["power_dbm"].sel(receiver=row["receiver"], x=row["x"], y=row["y"], method=None)
    assert float(parts) == pytest.approx(row["power_dbm"], rel=FLOAT32)
    assert set(table["best_receiver"]) == {"hall $_$", "kitchen"}


def test_chunks_and_choices_of_receivers_do_not_change_values(law, mapped, monkeypatch):
    options: dict[str, Any] = {"step_m": 0.5, "transmit_dbm": TRANSMIT_DBM, "threshold_dbm": -32.0}
    kitchen = radio_map(law, receivers=["kitchen"], **options)
    np.testing.assert_array_equal(kitchen["power_dbm"][0], mapped["power_dbm"][1])
    monkeypatch.setattr(api, "CHUNK_SIZE", 7)
    xr.testing.assert_allclose(radio_map(law, **options), mapped, rtol=FLOAT32)


def box(size_m: tuple[float, ...], at_m: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(size_m, transform=trimesh.transformations.translation_matrix(at_m))


def test_surface_has_the_values_of_its_points(law: Run, tmp_path: Path) -> None:
    box((2.0, 1.0, 0.5), (3, 2, 1)).export(tmp_path / "box.ply")
    parts = radio_map(law, surface=tmp_path / "box.ply", step_m=0.4)
    assert parts["power_dbm"].dims == ("receiver", "point")
    points = np.stack([parts[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(points, parts["triangle"].mean("corner"), atol=FLOAT32)
    np.testing.assert_allclose(parts["power_dbm"][1], law.predict(points, 1).mean, rtol=FLOAT32)


def test_heights_count_from_a_sloping_surface(law: Run, tmp_path: Path) -> None:
    """Ground that rises by 1 m in 4 m: z is that of the ground and 1.5 m."""
    corners = np.array([[1, 1, 0], [5, 1, 1], [5, 4, 1], [1, 4, 0]], float)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "slope.ply")
    parts = radio_map(law, surface=tmp_path / "slope.ply", step_m=0.5, height_m=1.5)
    np.testing.assert_allclose(parts["z"], (parts["x"] - 1) / 4 + 1.5, atol=1e-5)
    points = np.stack([parts[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(parts["power_dbm"][0], law.predict(points, 0).mean, rtol=FLOAT32)


@pytest.mark.parametrize("name", ["law", "traced"])
def test_cells_have_the_strength_that_is_predicted_at_their_centres(name: str, request: pytest.FixtureRequest) -> None:
    run = request.getfixturevalue(name)
    parts = radio_map(run, step_m=0.7, height_m=1.3)
    power = parts["power_dbm"][-1].values
    predicted = run.predict(grid_positions(parts).reshape(-1, 3), len(run.receivers) - 1).mean.reshape(power.shape)
    finite = ~np.isnan(power)
    assert finite.sum() > 20
    np.testing.assert_allclose(power[finite], predicted[finite], rtol=FLOAT32)


def test_headings_are_averaged_by_the_law_of_total_variance(flat_folder: Path, tmp_path: Path) -> None:
    run = wrf_mi.train(flat_folder, "kriging", out=tmp_path / "run", intervals=True)
    parts = radio_map(run, step_m=1.5)
    positions = grid_positions(parts).reshape(-1, 3)
    each = [run.predict(positions, 0, np.full(len(positions), turn)) for turn in np.arange(8) * np.pi / 4]
    means, stds = (
        np.array([prediction.mean for prediction in each]),
        np.array([prediction.stated_std for prediction in each]),
    )
    std = np.sqrt((stds**2).mean(axis=0) + means.var(axis=0))
    np.testing.assert_allclose(parts["power_dbm"][0].values.ravel(), means.mean(axis=0), rtol=FLOAT32)
    np.testing.assert_allclose(parts["power_std_db"][0].values.ravel(), std, rtol=FLOAT32)
    turned = radio_map(run, step_m=1.5, heading_deg=45.0)
    np.testing.assert_allclose(turned["power_dbm"][0].values.ravel(), means[1], rtol=FLOAT32)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record]:
    """A room with a solid cabinet in it, and strengths measured there."""
    folder = tmp_path_factory.mktemp("room")
    parts = SHOEBOX | {"cabinet": ("itu_concrete", box((0.4, 0.4, 2.0), (3, 2, 1)))}
    rng = np.random.default_rng(3)
    positions = rng.uniform([0.5, 0.5, 1.3], [2.5, 4.5, 1.3], (30, 3))
    receiver = wrf_mi.Receiver("rx", np.array([5.0, 4.0, 2.0]), np.array([0.0, 0, 0, 1]))
    observed = (free_space_db(positions, receiver) + 3)[None].astype(np.float32)
    record_fields: dict[str, Any] = {"frequencies_hz": np.array([HZ]), "official": (np.arange(22), np.arange(22, 30))}
    return write_xml(folder, parts), Record("room", "rssi", positions, (receiver,), observed, **record_fields)


@pytest.fixture(scope="module")
def traced(room: tuple[Path, Record], tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Lines of sight in the room."""
    out = tmp_path_factory.mktemp("runs") / "traced"
    return wrf_mi.train(room[1], "ray-tracing", out=out, scene=room[0], settings=["depth=0"])


def test_traced_paths_have_statistics_and_solids_are_left_out(traced: Run) -> None:
    parts = radio_map(traced, step_m=0.4, height_m=1.3)
    reached = ~np.isnan(parts["k_factor_db"][0].values)
    # The line of sight alone: no spread, an infinite K-factor.
    assert reached.sum() > 20
    assert (parts["k_factor_db"][0].values[reached] == np.inf).all()
    assert (parts["delay_spread_s"][0].values[reached] == 0).all()
    inside = parts["power_dbm"][0].sel(x=3.0, y=2.0, method="nearest")
    assert np.isnan(inside)
    assert parts["best_receiver"].sel(x=3.0, y=2.0, method="nearest") == -1
    assert "power_std_db" not in parts


def test_map_outside_of_a_closed_room_is_refused_and_outside_of_the_data_told(traced, law, tmp_path, caplog):
    bounds = traced.problem.opened_scene.mi_scene.bbox()
    low, high = float(bounds.min.z), float(bounds.max.z)
    for height in (high + 2, low - 0.5, high + 0.01):
        with pytest.raises(InputError, match=rf"height {height:g} m: outside of the scene, which spans z = 0.00 to"):
            radio_map(traced, step_m=1.0, height_m=height)
    inside = radio_map(traced, step_m=0.7, height_m=high - 0.1)
    for axis in "xy":
        assert float(getattr(bounds.min, axis)) < inside[axis].min()
        assert inside[axis].max() < float(getattr(bounds.max, axis))
    box((1.0, 1.0, 1.0), (1, 1, high)).export(tmp_path / "box.ply")
    caplog.clear()
    radio_map(traced, surface=tmp_path / "box.ply")
    assert "of the surface lie outside of the scene" in caplog.text
    caplog.clear()
    radio_map(law, step_m=1.0, height_m=1.5)
    assert caplog.text == ""
    radio_map(law, step_m=1.0, height_m=5.0)
    assert "height 5 m: the data's transmitters were at 1.30 to 1.30 m, so values are extrapolated" in caplog.text


def test_map_above_a_scene_without_a_ceiling_is_told(room, tmp_path, caplog):
    _, record = room
    parts = {name: part for name, part in SHOEBOX.items() if name != "ceiling"}
    options: dict[str, Any] = {"scene": write_xml(tmp_path / "open", parts), "settings": ["depth=0"]}
    run = wrf_mi.train(record, "ray-tracing", out=tmp_path / "run", **options)
    radio_map(run, step_m=2.0, height_m=20.0)
    assert "height 20 m: outside of the scene" in caplog.text


def test_sides_of_a_hybrid_add_up_by_their_weights(room: tuple[Path, Record], tmp_path: Path) -> None:
    scene, record = room
    traced = wrf_mi.train(record, "ray-tracing", out=tmp_path / "traced", scene=scene, settings=["rays=1024"])
    law = wrf_mi.train(record, "mri", out=tmp_path / "law")
    mixture = Mixture(np.array([0.0, 1.0]), np.array([[1.0, 0.0], [0.2, 0.8]]))
    fitted = {"paths": traced.fitted, "kriging": law.fitted}
    hybrid = FittedMixture("hybrid", traced.problem, np.arange(22), fitted, mixture, None, None, (), {})
    positions = np.concatenate([record.tx_pos_m[:2], record.tx_pos_m[:2] + np.array([0.0, 0.0, 0.7])])
    parts = hybrid.decompose(Inputs(positions), 0)
    np.testing.assert_array_equal(parts.prediction.mean, hybrid.predict(Inputs(positions), 0).mean)
    assert parts.traced is not None
    assert parts.learned is not None
    # Training rows are traced alone.
    np.testing.assert_array_equal(np.isnan(parts.learned), [True, True, False, False])
    np.testing.assert_array_equal(parts.traced[:2], parts.prediction.mean[:2])
    share = hybrid.mixture(RowDistance.of_rows(record, np.arange(22))(positions, 0))[2:]
    expected = share[:, 0] * parts.traced[2:] + share[:, 1] * parts.learned[2:]
    np.testing.assert_allclose(expected, parts.prediction.mean[2:])
    assert parts.paths is not None


def test_sides_of_a_joint_model_add_up_as_amplitudes(room: tuple[Path, Record], tmp_path: Path) -> None:
    scene, record = room
    settings = [*SMALL, "traced.depth=1", "traced.reflections=1", "traced.rays=1024", "patience=0"]
    run = wrf_mi.train(record, "wrf-gs+", out=tmp_path / "run", scene=scene, settings=settings)
    run.field.predictor.reach = None  # Gaussians everywhere, whatever these few steps gained
    positions = record.tx_pos_m[:5]
    parts = run.fitted.decompose(Inputs(positions), 0)
    np.testing.assert_allclose(parts.prediction.mean, run.predict(positions).mean, atol=FIT_DB)
    assert parts.traced is not None
    assert parts.learned is not None
    total, traced, learned = (10 ** (x / 20) for x in (parts.prediction.mean, parts.traced, parts.learned))
    assert (total <= (traced + learned) * (1 + FIT_DB)).all()
    assert (total >= np.abs(traced - learned) * (1 - FIT_DB)).all()
    assert parts.paths is not None
    line_of_sight = free_space_db(positions, record.receivers[0])
    # The cabinet hides one of the positions.
    assert np.median(np.abs(parts.paths.path_gain_db - line_of_sight)) < REFLECTED_DB


def test_command_writes_map_and_picture(strengths: Record, tmp_path: Path, command: Command) -> None:
    run, out = tmp_path / "run", tmp_path / "map.nc"
    wrf_mi.train(write_ble_folder(tmp_path / "data", strengths), "mri", out=run, intervals=True)
    status, printed, err = command(["map", run, "--step", "0.5", "--out", out])
    assert (status, err) == (0, "mapping\n")
    assert "map.nc" in printed
    assert "map.png" in printed
    with Image.open(tmp_path / "map.png") as picture:
        assert picture.size[0] > 300
    command.done(["evaluate", run, "--reliability", tmp_path / "r.png"])
    assert (tmp_path / "r.png").stat().st_size > 1000


def test_bad_input_is_one_line(law: Run, tmp_path: Path, command: Command) -> None:
    out = tmp_path / "map.nc"
    for words, message in (
        ([law.folder, "--out", tmp_path / "map.txt"], "maps are written as NetCDF"),
        ([law.folder, "--out", tmp_path], "maps are written as|is a folder"),
        ([law.folder, "--out", out, "--step", "one"], "invalid float"),
        ([tmp_path / "none", "--out", out], "none"),
    ):
        command.refused(["map", *words], message)
    for arguments, message in (
        ({"step_m": 0.0}, "positive number"),
        ({"height_m": float("nan")}, "height nan"),
        ({"receivers": ["attic"]}, "no receiver 'attic'"),
        ({"heading_deg": 30.0}, "do not depend on the heading"),
        ({"frequency_hz": 1e9}, "one carrier"),
        ({"surface": "none.ply"}, "no such file"),
        ({"surface": "none.ply", "height_m": float("inf")}, "height inf"),
    ):
        with pytest.raises(InputError, match=message):
            radio_map(law, **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("suffix", "package"),
    [(".nc", "xarray"), (".nc", "h5netcdf"), (".nc", "h5py"), (".zarr", "zarr"), (".csv", "pandas")],
)
def test_missing_package_is_named(suffix, package, mapped, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"need {package}: pip install '\.\[maps\]'"):
        write_map(mapped, tmp_path / f"map{suffix}")


EXACT = 1e-12
CHANCE = 0.01
"""Of an observed share in 20,000 draws: three standard errors."""


def test_coverage_is_the_normal_distribution_beyond_the_threshold() -> None:
    mean, std = np.linspace(-100, -80, 7), np.linspace(1, 8, 7)
    np.testing.assert_allclose(coverage_probability(mean, std, -90), norm.sf(-90, mean, std), rtol=EXACT)
    assert coverage_probability(-89.0, 0.0, -90.0) == 1
    assert np.isnan(coverage_probability(np.nan, 1.0, -90.0))


def test_levels_drawn_as_predicted_are_reliable_and_narrower_statements_are_not() -> None:
    rng = np.random.default_rng(1)
    mean, std = rng.uniform(-95, -60, 20_000), rng.uniform(2, 9, 20_000)
    measured = rng.normal(mean, std)
    measured[::7] = np.nan
    result = reliability(mean, std, measured)
    assert result.error < CHANCE
    np.testing.assert_allclose(result.observed, result.predicted, atol=3 * CHANCE)
    assert result.count.sum() == 9 * np.isfinite(measured).sum()
    narrow = reliability(mean, std / 4, measured)
    assert narrow.error > 5 * CHANCE
    assert narrow.brier > result.brier
    assert len(reliability_figure({"drawn": result}).axes[0].lines) == 2


def test_reliability_of_a_run_is_that_of_its_test_rows(plain_flat_folder: Path, tmp_path: Path) -> None:
    run = train(plain_flat_folder, "kriging", out=tmp_path / "run", intervals=True)
    result = run_reliability(run.folder, np.array([-55.0]))
    stored = arrays_in(run.folder / "predictions.npz")
    p, above = norm.sf(-55, stored["prediction"], stored["std"]), stored["truth"] > -55
    assert result.brier == pytest.approx(np.square(p - above).mean(), rel=1e-5)
    assert result.count.sum() == above.size
    without = train(plain_flat_folder, "mri", out=tmp_path / "without")
    with pytest.raises(InputError, match="states no standard deviation; train with --intervals"):
        run_reliability(without.folder)
