"""Pictures of maps by the command: spectra, channels, several carriers, surfaces."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import xarray as xr
from commands import Command
from made_channels import channels
from made_waves import wave_record
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

import wrf_mi
from wrf_mi.apps.maps import picture
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.dataset import write_map
from wrf_mi.apps.maps.picture import map_figure
from wrf_mi.core import Record
from wrf_mi.datasets import make_splits, write_ble_folder, write_nerf2_csi, write_spectrum_folder
from wrf_mi.scene.make import make_scene

BANDS_HZ = (9e8, 2.4e9)


def mapped(data: Any, folder: Path, command: Command, *more: Any) -> tuple[xr.Dataset, Figure, wrf_mi.Run]:
    """Map by the command of a run of kriging with intervals, and its picture drawn anew."""
    run = wrf_mi.train(data, "kriging", out=folder / "run", intervals=True)
    out = folder / "map.nc"
    status, _, err = command(["map", run.folder, "--step", "0.5", "--out", out, *more])
    assert (status, err) == (0, "mapping\n")
    assert out.with_suffix(".png").stat().st_size > 1000
    with xr.open_dataset(out) as dataset:
        return dataset.load(), map_figure(dataset, run), run


def dots(figure: Figure, panel: int) -> dict[str, np.ndarray]:
    """Levels of the measured rows of a panel: those of training rows and all others."""
    drawn = [collection for collection in figure.axes[panel].collections if isinstance(collection, PathCollection)]
    squares, circles = (np.asarray(collection.get_array()) for collection in drawn)
    return {"trained": circles, "other": squares}


def make_scene_of(folder: Path) -> Path:
    """A room of 5 m x 4 m with floor and ceiling."""
    (folder / "layout.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n")
    return make_scene(folder / "layout.csv", folder / "scene", height_m=2.5).folder


def strengths_in_a_room() -> Record:
    rng = np.random.default_rng(2)
    positions = np.column_stack([rng.uniform(0.5, 3.5, (40, 2)), np.full(40, 1.3)])
    receiver = wrf_mi.Receiver("wall", np.array([0.5, 0.5, 2]), np.array([0.0, 0, 0, 1]))
    observed = -40 - 20 * np.log10(np.linalg.norm(positions - receiver.position_m, axis=1)) + rng.normal(0, 1, 40)
    split = (np.arange(30), np.arange(30, 40))
    values = observed[None].astype(np.float32)
    return Record("room", "rssi", positions, (receiver,), values, frequencies_hz=np.array([2.4e9]), official=split)


def marks(figure: Figure) -> set[str]:
    """Entries of the legend."""
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}


def heading(figure: Figure) -> str:
    return " ".join(figure.get_suptitle().split())


def test_picture_of_spectra_states_a_relative_level_and_thins_training_rows(tmp_path, command, monkeypatch):
    data = write_spectrum_folder(tmp_path / "data", wave_record(receivers=1))
    dataset, figure, run = mapped(data, tmp_path, command, "--threshold", "-10")
    assert dataset["power_dbm"].attrs["units"] == "dB"
    assert dataset.attrs["threshold_db"] == -10
    assert not {"threshold_dbm", "transmit_power_dbm"} & set(dataset.attrs)
    assert "no signal strengths" in heading(figure)
    titles = [axes.get_title().split(": ")[-1] for axes in figure.axes[:3]]
    assert titles == ["expected power", "standard deviation of a reading", "probability of more than -10 dB"]
    assert [axes.get_ylabel().split()[0] for axes in figure.axes[3:]] == ["dB", "dB", "probability"]
    assert marks(figure) == {"training rows", "other measured rows", "receiver"}
    place = {"position_m": [0.0, 0.0, 0.0], "std_m": [0.5, 0.25, 0.0]}
    (run.folder / "receiver_places.json").write_text(json.dumps({run.receivers[0].name: place}))
    amid = {f"receiver_{axis}": ("receiver", [float(dataset[axis].mean())]) for axis in "xy"}
    dataset = dataset.assign_coords(amid)
    estimated = map_figure(dataset, run)
    (ellipse,) = estimated.axes[0].patches
    assert isinstance(ellipse, Ellipse)
    assert (ellipse.get_width(), ellipse.get_height()) == (1.0, 0.5)
    assert marks(estimated) == {"training rows", "other measured rows", picture.AT_ESTIMATED}
    assert "not drawn" not in heading(estimated)
    split = make_splits(run.problem.record, "official")[0]
    assert len(split.test) <= 12 < len(split.all_train)
    for most, trained in ((picture.MOST_POINTS, len(split.all_train)), (12, -(-len(split.all_train) // 3))):
        monkeypatch.setattr(picture, "MOST_POINTS", most)
        shown = {name: len(values) for name, values in dots(map_figure(dataset, run), 0).items()}
        assert shown == {"trained": trained, "other": len(split.test)}


def test_picture_leaves_estimated_receivers_far_outside_out(two_bands, tmp_path, command):
    """Their cross or ellipse would shrink the map to a dot."""
    data = write_ble_folder(tmp_path / "data", two_bands)
    dataset, near, run = mapped(data, tmp_path, command, "--frequency", BANDS_HZ[1])
    name = run.receivers[0].name
    for place_m, std_m in (([-400.0, 20, 2], 1.0), ([2.0, 2, 2], 400.0)):
        place = {"position_m": place_m, "std_m": [std_m] * 3}
        (run.folder / "receiver_places.json").write_text(json.dumps({name: place}))
        moved = dataset.assign_coords(
            {f"receiver_{axis}": ("receiver", [x]) for axis, x in zip("xyz", place_m, strict=True)}
        )
        figure = map_figure(moved, run)
        assert np.ptp(figure.axes[0].get_xlim()) < 2 * np.ptp(near.axes[0].get_xlim())
        outside = "1 receivers estimated outside of the map, not drawn" in heading(figure)
        assert (outside, len(figure.axes[0].patches)) == ((True, 0) if place_m[0] < 0 else (False, 1))


def test_picture_of_a_scene_draws_the_walls_at_its_height(tmp_path: Path) -> None:
    """A floor and a ceiling are not cut by any height between them."""
    scene = make_scene_of(tmp_path)
    record = strengths_in_a_room()
    run = wrf_mi.train(record, "ray-tracing", scene=scene, out=tmp_path / "run", settings={"depth": 1, "rays": 1000})
    figure = map_figure(radio_map(run, step_m=1.0), run)
    (walls,) = (collection for collection in figure.axes[0].collections if isinstance(collection, LineCollection))
    lines = np.array(walls.get_segments())
    low, high = lines.min(axis=(0, 1)), lines.max(axis=(0, 1))
    along = [(lines[:, :, axis] == end[axis]).all(axis=1) for axis in (0, 1) for end in (low, high)]
    assert np.sum(along, axis=0).tolist() == [1] * len(lines)  # each line is part of one of the room's sides
    assert all(side.any() for side in along)


def test_picture_of_channels_has_levels_at_the_transmit_power(tmp_path: Path, command: Command) -> None:
    record = channels()
    dataset, figure, _ = mapped(write_nerf2_csi(tmp_path / "data", record), tmp_path, command, "--transmit-power", "20")
    level = 20 + 10 * np.log10(np.mean(np.abs(record.observation[0]) ** 2, axis=(1, 2)))
    shown = np.sort(np.concatenate(list(dots(figure, 0).values())))
    np.testing.assert_allclose(shown, np.sort(level), rtol=1e-5)
    assert dataset["power_dbm"].attrs["units"] == "dBm"
    np.testing.assert_allclose(dataset["power_dbm"] - dataset["path_gain_db"], 20, rtol=1e-5)


@pytest.fixture
def two_bands() -> Record:
    """Strengths of -40 dBm at one carrier and -60 dBm at the other."""
    rng = np.random.default_rng(0)
    rows = np.arange(40)
    carriers = np.array(BANDS_HZ)[rows % 2]
    receiver = wrf_mi.Receiver("wall", np.array([0.0, 0, 2]), np.array([0.0, 0, 0, 1]))
    observed = np.where(rows % 2, -60.0, -40.0) + rng.normal(0, 0.5, 40)
    record_fields: dict[str, Any] = {"carriers_hz": carriers, "official": (rows[:30], rows[30:])}
    positions = np.column_stack([rng.uniform(1, 4, (40, 2)), np.full(40, 1.3)])
    return Record("bands", "rssi", positions, (receiver,), observed[None].astype(np.float32), **record_fields)


def test_picture_of_a_carrier_has_the_rows_of_that_carrier(two_bands: Record, tmp_path: Path, command: Command) -> None:
    data = write_ble_folder(tmp_path / "data", two_bands)
    dataset, figure, run = mapped(data, tmp_path, command, "--frequency", BANDS_HZ[1])
    assert dataset.attrs["frequency_hz"] == BANDS_HZ[1]
    assert "2400 MHz" in heading(figure)
    drawn_dots = dots(figure, 0)
    assert (len(drawn_dots["trained"]), len(drawn_dots["other"])) == (15, 5)
    assert np.concatenate(list(drawn_dots.values())).max() < -50
    command.refused(["map", run.folder, "--out", tmp_path / "none.nc"], "900000000, 2400000000 Hz")
    assert "other measured rows" in marks(figure)
    sure = map_figure(radio_map(run, step_m=1.0, frequency_hz=BANDS_HZ[1], threshold_dbm=-200), run)
    assert " ".join(sure.axes[2].get_title().split()).endswith("more than -200 dBm: 1.00 to 1.00 here")
    between = map_figure(radio_map(run, step_m=1.0, frequency_hz=1.5e9), run)
    assert "no measured row at this carrier" in heading(between)


def test_picture_of_a_surface_shows_the_mesh(flat_folder, tmp_path, command, monkeypatch):
    trimesh.creation.box((2.0, 1.0, 0.5)).export(tmp_path / "table.ply")
    more = ("--surface", tmp_path / "table.ply", "--receiver", "anchor1")
    dataset, figure, run = mapped(flat_folder, tmp_path, command, *more)
    faces = figure.axes[0].collections[0]
    drawn = np.asarray(faces.get_facecolor())
    colours = np.unique(drawn[:, :3], axis=0)
    assert len(drawn) == dataset.sizes["point"]
    assert len(colours) > 1
    assert "transmitter at z" not in heading(figure)
    assert write_map(dataset, tmp_path / "map.csv").read_text().startswith("receiver,x,y,z,")
    for most, deviations in ((2, 3), (1, 1)):  # the strongest receiver's, and those of few receivers
        monkeypatch.setattr(picture, "MOST_DEVIATIONS", most)
        figure = map_figure(radio_map(run, step_m=1.0), run)
        assert sum("standard deviation" in axes.get_title() for axes in figure.axes) == deviations
