"""Positions of imports in pixels of plans, in JSON of survey programs, and in trajectories of cameras."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from changed_folders import error_line
from PIL import Image
from scipy.spatial.transform import Rotation
from survey_tables import imported, strengths, written

from wrf_mi import import_measurements
from wrf_mi.apps.importing.observed import read_observed
from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.sources import read_plan

pandas = pytest.importorskip("pandas")
pytest.importorskip("pyproj")

ROWS, COLUMNS, RESOLUTION_M = 100, 200, 0.05
"""Of the picture of a plan of 10 x 5 m."""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    """A plan whose only wall is black at columns 40 to 44 and rows 20 to 60."""
    pixels = np.full((ROWS, COLUMNS), 255, np.uint8)
    pixels[20:61, 40:45] = 0
    Image.fromarray(pixels).save(tmp_path / "plan.png")
    return tmp_path / "plan.png"


def test_pixels_of_a_plan_lie_where_its_walls_are(plan: Path, tmp_path: Path) -> None:
    file = written(tmp_path, "clicks.csv", "x,y,bssid,rssi\n42.5,40.5,a,-50\n180,90,a,-70\n42.5,40.5,b,-61\n")
    anchors = written(tmp_path, "aps.csv", "id,x,y\na,0,100\nb,200,0\n")
    options = {"units": "px", "plan": plan, "resolution_m": RESOLUTION_M, "anchors": anchors}
    report = imported(tmp_path, file, **options)
    grid = read_plan(plan, RESOLUTION_M)
    assert isinstance(grid, PlanGrid)
    middle = grid.centres_m(grid.occupied).mean(axis=0)
    np.testing.assert_allclose(report.record.tx_pos_m[0, :2], middle, atol=RESOLUTION_M / 2)
    np.testing.assert_allclose(report.record.tx_pos_m[1, :2], [9.0, 0.5])
    places = np.array([receiver.position_m[:2] for receiver in report.record.receivers])
    np.testing.assert_allclose(places, [[0, 0], [10, 5]], atol=1e-9)
    shifted = imported(tmp_path, file, **options, origin_m=(1.0, 2.0, 0.0))
    np.testing.assert_allclose(shifted.record.tx_pos_m[1, :2], [8.0, -1.5])
    command = "wrf-mi mesh plan.png --resolution 0.05 --origin 1,2,0 --wall-height M"
    assert any(note.endswith(command) for note in shifted.notes)


def test_pixels_outside_their_plan_are_refused(plan: Path, tmp_path: Path) -> None:
    file = written(tmp_path, "clicks.csv", "Pixel X,Pixel Y,bssid,rssi\n40,20,a,-50\n201,20,a,-60\n")
    message = "plan.png: 1 of 2 positions are outside its 200 x 100 pixels; give the picture that was clicked, or --reg"
    error_line(import_measurements, file, tmp_path / "data", message, plan=plan, resolution_m=RESOLUTION_M)


def test_pixels_of_a_turned_map_lie_where_its_walls_are(plan: Path, tmp_path: Path) -> None:
    """A robot's map with a yaw, against the scene that is made of it."""
    text = f"image: plan.png\nresolution: {RESOLUTION_M}\norigin: [2.0, 3.0, 0.5]\nnegate: 0\n"
    sheet = written(tmp_path, "map.yaml", text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    file = written(tmp_path, "clicks.csv", "x_px,y_px,bssid,rssi\n0,100,a,-50\n42.5,40.5,a,-60\n")
    places = imported(tmp_path, file, plan=sheet).record.tx_pos_m[:, :2]
    grid = read_plan(sheet)
    assert isinstance(grid, PlanGrid)
    turn = Rotation.from_euler("z", grid.yaw_rad).as_matrix()[:2, :2]
    np.testing.assert_allclose(places[0], [2, 3])
    np.testing.assert_allclose(places[1], turn @ grid.centres_m(grid.occupied).mean(axis=0), atol=RESOLUTION_M / 2)


def test_pixels_are_registered_by_pairs(tmp_path: Path) -> None:
    """A plan that is turned by 30 degrees, 40 pixels a metre: closed form."""
    rotation = np.array([[np.cos(np.pi / 6), -np.sin(np.pi / 6)], [np.sin(np.pi / 6), np.cos(np.pi / 6)]])
    pixels = np.array([[0, 0], [400, 0], [400, 200], [120, 60]], float)
    metres = (pixels * [1, -1] / 40) @ rotation.T + [3, 7]
    pairs = np.column_stack([pixels, metres])[:3]
    pandas.DataFrame(pairs, columns=["x", "y", "to_x", "to_y"]).to_csv(tmp_path / "pairs.csv", index=False)
    file = written(tmp_path, "clicks.csv", "x_px,y_px,bssid,rssi,heading\n120,60,a,-50,0\n400,0,a,-60,0\n")
    record = imported(tmp_path, file, register_pairs=tmp_path / "pairs.csv").record
    np.testing.assert_allclose(record.tx_pos_m[:, :2], metres[[3, 1]], atol=1e-6)
    np.testing.assert_allclose(record.tx_heading_rad, np.pi / 6)


REFUSED_PIXELS: dict[str, tuple[dict[str, Any], str]] = {
    "no plan": ({"units": "px"}, r"--units px: pixels of which picture\? Give --plan plan\.png, or --register-pairs"),
    "no scale": ({"units": "px", "plan": True}, r"a picture has no resolution; give .*\(--resolution\)"),
    "no pixels": ({"plan": True}, "--plan: it belongs to --units px; omit it"),
    "no picture": ({"resolution_m": 0.1}, "--resolution: it belongs to --plan; omit it"),
    "pairs": ({"units": "px", "register_pairs": True}, "1 pairs at one place tell no scale; give two pairs"),
    "pitch": ({"units": "px", "plan": True, "pitch_m": 0.6}, "--pitch: positions are pixels, or registered by pairs"),
    "up": ({"up": "z"}, "--up: it belongs to a trajectory of --positions; omit it"),
    "axis": ({"up": "x"}, "--up 'x' is unknown; give --up=z, --up=y or --up=-y"),
}


@pytest.mark.parametrize("case", REFUSED_PIXELS)
def test_what_places_pixels_is_asked_for(case: str, plan: Path, tmp_path: Path) -> None:
    options, message = REFUSED_PIXELS[case]
    pairs = written(tmp_path, "pairs.csv", "x,y,to_x,to_y\n1,2,3,4\n")
    files = {"plan": plan, "register_pairs": pairs}
    options = {name: files[name] if value is True else value for name, value in options.items()}
    file = written(tmp_path, "t.csv", "x,y,bssid,rssi\n40,20,a,-50\n180,90,a,-70\n")
    error_line(import_measurements, file, tmp_path / "data", message, **options)
    assert not (tmp_path / "data").exists()


def point(x: float, y: float, dbm: float, **others: Any) -> dict[str, Any]:
    return {"x": x, "y": y, "wifiData": {"bssid": "a", "rssi": dbm, "signalStrength": 80} | others, "isEnabled": True}


SURVEYS: dict[str, Any] = {
    "points with a picture": {
        "floorplanImagePath": "/media/plan.png",
        "surveyPoints": [point(40, 20, -50), point(180, 90, -70)],
        "dimensions": {"width": 200, "height": 100},
    },
    "points with scans": [
        {"x": 40, "y": 20, "plan": "plan.png", "result": {"rss": -50, "scan": [{"bssid": "a", "level": -50}]}},
        {"x": 180, "y": 90, "plan": "plan.png", "result": {"rss": -51, "scan": [{"bssid": "a", "level": -70}]}},
    ],
    "positions in lists": [
        {"position": [40, 20], "image": "plan.png", "aps": {"02:00:00:00:00:01": {"rssi": -50, "bssid": "a"}}},
        {"position": [180, 90], "image": "plan.png", "aps": {"02:00:00:00:00:01": {"rssi": -70, "bssid": "a"}}},
    ],
}


@pytest.mark.parametrize("case", SURVEYS)
def test_json_of_surveys_with_a_picture_and_points(case: str, plan: Path, tmp_path: Path) -> None:
    file = written(tmp_path, "survey.json", json.dumps(SURVEYS[case]))
    message = r"points of plan\.png; give --units px --plan plan\.png --resolution M"
    error_line(import_measurements, file, tmp_path / "data", message)
    record = imported(tmp_path, file, units="px", plan=plan, resolution_m=RESOLUTION_M).record
    assert strengths(record) == {"a": {(2.0, 4.0): -50, (9.0, 0.5): -70}}
    assert strengths(imported(tmp_path, file, units="m").record) == {"a": {(40.0, 20.0): -50, (180.0, 90.0): -70}}


TIMES = np.arange(5.0)
WALKED = np.column_stack([TIMES, 0.5 * TIMES, np.full(5, 1.2)])
"""Positions x, y, z, z up, of a camera that looks along its way, at every second."""
AHEAD = np.arctan2(0.5, 1)
TO_CAMERA = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From z up to the frame of a camera: x to the right, y down, z ahead."""


def trajectory(form: str) -> str:
    """The walk in the frame of a camera whose first pose is not turned against the building, or in the building's."""
    if form == "TUM":
        quaternion = Rotation.from_euler("z", AHEAD).as_quat()
        rows = [np.concatenate([[time], place, quaternion]) for time, place in zip(TIMES, WALKED, strict=True)]
    else:
        # The camera's z axis is the way ahead, its y axis is down.
        x, y, z = [np.sin(AHEAD), -np.cos(AHEAD), 0], [0, 0, -1], [np.cos(AHEAD), np.sin(AHEAD), 0]
        rotation = TO_CAMERA @ np.column_stack([x, y, z])
        places = (WALKED - WALKED[0]) @ TO_CAMERA.T
        if form == "camera":
            quaternion = Rotation.from_matrix(rotation).as_quat()
            rows = [np.concatenate([[time], place, quaternion]) for time, place in zip(TIMES, places, strict=True)]
        else:
            rows = [np.column_stack([rotation, place]).ravel() for place in places]
    head = "# timestamp tx ty tz qx qy qz qw\n" if form == "TUM" else ""
    return head + "\n".join(" ".join(f"{value:.6f}" for value in row) for row in rows) + "\n"


@pytest.mark.parametrize("form", ["TUM", "camera", "KITTI"])
def test_trajectories_state_positions_with_headings(form: str, tmp_path: Path) -> None:
    readings = "time,bssid,rssi\n" + "".join(f"{time},a,{-50 - time:.0f}\n" for time in (0.5, 1.5, 2.5))
    file = written(tmp_path, "scan.csv", readings)
    poses = written(tmp_path, "poses.txt", trajectory(form))
    if form == "KITTI":
        written(tmp_path, "times.txt", "\n".join(f"{time:.6e}" for time in TIMES) + "\n")
    if form == "camera":
        message = "so y seems to be vertical; give --up=-y"
        error_line(import_measurements, file, tmp_path / "data", message, positions=[poses])
    options = {"up": "-y"} if form == "camera" else {}
    record = imported(tmp_path, file, positions=[poses], **options).record
    expected = (WALKED[1:4] + WALKED[:3]) / 2
    np.testing.assert_allclose(record.tx_pos_m[:, :2], expected[:, :2], atol=1e-5)
    np.testing.assert_allclose(record.tx_pos_m[:, 2], 1.2 if form == "TUM" else 1.3, atol=1e-5)
    np.testing.assert_allclose(record.tx_heading_rad, AHEAD, atol=1e-5)


def test_a_trajectory_is_registered_to_the_building(tmp_path: Path) -> None:
    file = written(tmp_path, "scan.csv", "time,bssid,rssi\n1,a,-50\n3,a,-60\n")
    poses = written(tmp_path, "poses.txt", trajectory("KITTI"))
    written(tmp_path, "times.txt", "".join(f"{time}\n" for time in TIMES))
    pairs = written(tmp_path, "pairs.csv", "x,y,to_x,to_y\n0,0,5,5\n4,0,5,9\n4,2,3,9\n")  # a quarter turn
    anchors = written(tmp_path, "aps.csv", "id,x,y\na,7,8\n")
    record = imported(tmp_path, file, positions=[poses], register_pairs=pairs, anchors=anchors).record
    np.testing.assert_allclose(record.tx_pos_m[:, :2], [[4.5, 6], [3.5, 8]], atol=1e-5)
    np.testing.assert_allclose(record.tx_heading_rad, AHEAD + np.pi / 2, atol=1e-5)
    np.testing.assert_allclose(record.receivers[0].position_m[:2], [7, 8])


def test_pixels_of_a_plan_are_located_in_its_frame(plan: Path, tmp_path: Path) -> None:
    file = written(tmp_path, "clicks.csv", "x,y,bssid,rssi\n40,40,a,-50\n180,90,a,-70\n")
    report = imported(tmp_path, file, units="px", plan=plan, resolution_m=RESOLUTION_M)
    facts = yaml.safe_load((tmp_path / "data" / "import.yml").read_text())
    np.testing.assert_allclose(read_observed(file, facts).xy_m, report.record.tx_pos_m[:, :2])
