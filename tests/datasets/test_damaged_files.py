"""Damaged and hostile files of every reader: refused in one line, or read as finite numbers, in 3 GiB."""

import io
import re
import resource
import shutil
from collections.abc import Callable, Iterable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import psutil
import pytest
import trimesh
from changed_folders import error_line, refusal, text
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from made_rooms import write_las
from made_scenarios import write_scenario
from PIL import Image
from small_fits import settings as field_settings
from small_fits import stop_after
from test_argos import argos
from test_faults import LAYOUTS
from wrf_mi_scenes.mitsuba_xml import scene_xml

from wrf_mi.apps.exports import export
from wrf_mi.apps.exports.fields import import_field
from wrf_mi.apps.exports.format import ExportOptions
from wrf_mi.apps.exports.paths_table import read_paths
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.dataset import write_map
from wrf_mi.apps.maps.locate_file import read_observations
from wrf_mi.apps.viewer.map_layer import read_map
from wrf_mi.core import InputError, Receiver
from wrf_mi.core.files import inside, one_line
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.datasets import load, load_split
from wrf_mi.estimators.checks import check_parts
from wrf_mi.runs.api import Interrupted, open_run, train
from wrf_mi.runs.prediction_file import read_inputs
from wrf_mi.runs.results import read_run
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.scene.mesh.files import mesh_parts, read_mesh
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.scan.points import read_points
from wrf_mi.scene.xml_file import read_scene_xml
from wrf_mi.tracing import open_scene
from wrf_mi.training.checkpoint import cut_log, read_checkpoint

EXAMPLES, OF_CHILDREN = 20, 3  # of a reader, and of one that starts a process for each file
DEADLINE = timedelta(seconds=60)
MEMORY_BYTES = 3 << 30
CARRIER_HZ = 2.4e9
WORD = re.compile(rb"[\w.+-]+")
NUMBERS = (0, 2**15, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1)
PIECES = (
    *(b"", b"-1", b"1e308", b"nan", b"inf", b"9999999999", b"1" * 5000, b",", b"..", b"/etc/passwd", b"null", b"[]"),
    *(b"{a: 1}", b"*a", b"\xff\xfe", b"\0", b"\n\n", b'"', b"<!ENTITY>", b"!!python/object:os.system", b"2024-99-99"),
    *(number.to_bytes(8, order) for number in NUMBERS for order in ("little", "big")),
)


@st.composite
def damaged(draw: Any, content: bytes) -> bytes:
    """A content with one to three parts cut off, repeated, or replaced by a piece or random bytes."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        stop = start + draw(st.sampled_from((0, 1, 4, 8, 64, len(data))))
        if (words := list(WORD.finditer(data, start, start + 4096))) and draw(st.booleans()):
            start, stop = draw(st.sampled_from(words)).span()
        repeated = st.just(bytes(data[start : start + 64]) * 50)
        data[start:stop] = draw(st.sampled_from(PIECES) | st.binary(max_size=8) | repeated)
    return bytes(data)


def loaded(file: Path, folder: int = 0) -> Iterable[Any]:
    record = load(file.parents[folder])
    check_parts(record)
    return [receiver.position_m for receiver in record.receivers]


def predicted(file: Path) -> Iterable[Any]:
    run = open_run(file.parent)
    return [run.predict([[2.0, 1.0, 1.0]]).mean, run.predict([[2.0, 1.0, 1.0]]).mean]  # the second by the operator


def opened(file: Path) -> Iterable[Any]:
    box = open_scene(next(p for p in file.parents if (p / "scene.xml").exists()), CARRIER_HZ).mi_scene.bbox()
    return [box.min, box.max]


def imported(file: Path) -> Iterable[Any]:
    shutil.rmtree(out := file.parent / "imported", ignore_errors=True)
    return [import_field(file, out).predict([[2.0, 1.0, 1.0]]).mean]


def heard(file: Path) -> Iterable[Any]:
    upright = np.array([0.0, 0, 0, 1])
    places = read_observations(file, [Receiver(name, np.zeros(3), upright) for name in ("one", "other")])[1]
    return () if places is None else (places,)


def of_folder(read: Callable[[Path], Any]) -> Callable[[Path], Iterable[Any]]:
    """A reader of the file's folder, whose result has numbers in several places."""

    def numbers(file: Path) -> Iterable[Any]:
        read(file.parent)
        return ()

    return numbers


READERS: Mapping[str, Callable[[Path], Iterable[Any]]] = {
    **dict.fromkeys(("spectra/gateway_info.yml", "spectra/tx_pos.csv", "spectra/train_index.txt"), loaded),
    **dict.fromkeys(("ble/anchors.csv", "ble/calibration_df.csv", "nerf2-ble/gateway_position.yml"), loaded),
    **dict.fromkeys(("nerf2-ble/gateway_rssi.csv", "nerf2-csi/base-station.yml", "nerf2-csi/csidata.npy"), loaded),
    **dict.fromkeys(("newrf/hall.npz", "deepmimo/params.json", "deepmimo/power_t000_tx000_r001.mat"), loaded),
    "spectra/spectrum/00001.png": lambda file: loaded(file, 1),
    "argos/capture.hdf5": of_folder(load),
    **dict.fromkeys(
        ("cloud.ply", "cloud.las", "cloud.laz", "cloud.xyz", "cloud.npz"), lambda file: [read_points(file)]
    ),
    **dict.fromkeys(
        ("box.ply", "box.stl", "box.obj", "box.glb"), lambda file: [part.vertices_m for part in read_mesh(file)]
    ),
    **dict.fromkeys(
        ("plan.npz", "plan.png", "plan.yaml", "plan.csv"),
        lambda file: [getattr(plan := read_plan(file, 0.1 if file.suffix == ".png" else None), "origin_m", plan)],
    ),
    **dict.fromkeys(("room/scene.xml", "room/meshes/floor.ply"), opened),
    **dict.fromkeys(("room/scene.yml", "room/materials.yml"), of_folder(read_scene_folder)),
    **dict.fromkeys(("kriging/config.yaml", "kriging/split.npz", "kriging/model.npz"), predicted),
    **dict.fromkeys(("field/model.npz", "field/operator0.npz"), predicted),
    **dict.fromkeys(("kriging/predictions.npz", "kriging/metrics.json"), of_folder(read_run)),
    "stopped/checkpoint.npz": of_folder(read_checkpoint),
    "stopped/log.jsonl": of_folder(lambda folder: cut_log(folder, 2)),
    "split.npz": lambda file: [load_split(file).train],
    "paths.csv": lambda file: [read_paths(file).gain, read_paths(file).length_m],
    "field.npz": imported,
    "map.nc": lambda file: [read_map(file)[0].x_m],
    "heard.csv": heard,
    "inputs.csv": lambda file: [read_inputs(file, None).tx_pos_m],
    "inputs.npz": lambda file: [read_inputs(None, file).tx_pos_m],
}
"""Readers of files, which return the numbers that have to be finite."""
CHILDREN = (".laz", ".mat", ".nc")


@pytest.fixture(scope="module")
def samples(folder: Path, flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("samples")
    for name, (write, _) in LAYOUTS.items():
        (place / name).mkdir()
        write(place / name)
    write_scenario(place / "deepmimo", suffix=".mat")
    (place / "argos").mkdir()
    argos(place / "argos" / "capture.hdf5")
    cloud, positions = np.random.default_rng(0).uniform(0, 4, (2, 60, 3))
    trimesh.PointCloud(cloud).export(place / "cloud.ply")
    np.savetxt(place / "cloud.xyz", cloud)
    np.savez(place / "cloud.npz", points=cloud)
    for suffix in ("las", "laz"):
        write_las(place / f"cloud.{suffix}", cloud)
    for suffix in ("ply", "stl", "obj", "glb"):
        trimesh.creation.box((4, 5, 3)).export(place / f"box.{suffix}")
    grid = np.pad(np.full((28, 38), -2.0), 1, constant_values=2)
    np.savez(place / "plan.npz", log_odds=grid, row_0="top", resolution_m=0.1)
    Image.fromarray(np.where(grid > 0, 0, 255).astype(np.uint8)).save(place / "plan.png")
    (place / "plan.yaml").write_text("image: plan.png\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n")
    shutil.copy(flat_folder / "layout.csv", place / "plan.csv")
    shutil.copytree(room, place / "room")
    strengths = train(flat_folder, "kriging", out=place / "kriging", settings=("heading=false", "generic=true"))
    shutil.copy(place / "kriging" / "split.npz", place)
    write_map(radio_map(strengths, height_m=1.0, step_m=0.5), place / "map.nc")
    short = field_settings("steps=4", "network.static_geometry=true", "checkpoint_every=2", "log_every=1")
    run = train(folder, "wrf-gs+", out=place / "field", settings=short)
    run.predict([[2.0, 1.0, 1.0]])
    export(run.folder, "field", place / "field.npz")
    with pytest.raises(Interrupted):
        train(folder, "wrf-gs+", out=place / "stopped", settings=short, stop=stop_after(3))
    ends: dict[str, Any] = {"tx_pos_m": np.array([[1.0, 2, 1]]), "rx_pos_m": np.array([[3.0, 1, 2]])}
    export(room, "paths", place / "paths.csv", ExportOptions(frequency_hz=CARRIER_HZ, **ends))
    (place / "heard.csv").write_text("x,y,rssi_one,other_dbm\n1,2,-60.5,-71\n2,2,,-70\n")
    np.savetxt(place / "inputs.csv", positions, delimiter=",", header="x,y,z", comments="")
    np.savez(place / "inputs.npz", tx_pos=positions)
    return place


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_in_one_line_or_give_finite_numbers(name: str, samples: Path) -> None:
    file, read = samples / name, READERS[name]
    undamaged_bytes = file.read_bytes()

    def assert_finite() -> None:
        for numbers in read(file):
            assert np.isfinite(np.asarray(numbers)).all()

    @settings(
        max_examples=OF_CHILDREN if name.endswith(CHILDREN) else EXAMPLES,
        deadline=DEADLINE,
        suppress_health_check=list(HealthCheck),
    )
    @given(damaged(undamaged_bytes))
    @example(b"")
    @example(undamaged_bytes.replace(b"1.0", b"\x80", 1))
    @example(undamaged_bytes.decode("latin-1").encode("utf-16"))
    def refused_or_finite(content: bytes) -> None:
        file.write_bytes(content)
        message = ""
        try:
            assert_finite()
        except InputError as error:
            message = str(error)
        assert "\n" not in message
        assert len(message) < 2000

    assert_finite()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MEMORY_BYTES, limits[1]))
    try:
        refused_or_finite()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        file.write_bytes(undamaged_bytes)


def picture(size: int) -> bytes:
    stream = io.BytesIO()
    Image.new("1", (size, size)).save(stream, "png")
    return stream.getvalue()


def cloud(at: int) -> bytes:
    """A scan that states records without end at a place of its header."""
    scan, stream = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4")), io.BytesIO()
    scan.xyz = np.zeros((5, 3))
    scan.write(stream)
    content = stream.getvalue()
    return content[:at] + b"\xff" * 4 + content[at + 4 :]


BOMB = ["a0: &a0 [x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10))]
REFUSED: list[tuple[Callable[..., Any], str, str | bytes, str]] = [  # reader, name and content of a file, and message
    (read_yaml, "bomb.yml", "\n".join(BOMB), "more than 1000000 values with its aliases written out"),
    (read_yaml, "own.yml", "a: &a [*a]", "an alias of what holds it"),
    (read_plan, "plan.png", picture(9_000), "9000 x 9000 pixels; at most 16,000,000 are read"),
    (mesh_parts, "bad.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read as a mesh"),
    (mesh_parts, "flat.obj", "v 0 0\nv 1 0\nv 1 1\nf 1 2 3\n", r"line 1: a vertex of 2 numbers; expected 3"),
    (read_points, "cloud.las", cloud(100), "states 4294967295 records, and has"),
    (read_points, "cloud.las", cloud(243), "states 4294967295 extended records, and has"),
    *(
        (read_scene_xml, "scene.xml", content, message)
        for content, message in (
            ('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><scene>&b;</scene>', "document type or entities"),
            ('<scene><include filename="x.xml"/></scene>', "element <include> does not belong into a scene"),
            ('<scene><shape type="../evil"/></scene>', "plugin '../evil' of <shape>"),
            (
                '<scene><shape type="ply"><string name="filename" value="../x.ply"/></shape></scene>',
                "outside its folder",
            ),
            ("<scene/>", 'not with a scene and its version; write <scene version="3.0.0">'),
            ("<scene>" + "<transform>" * 80 + "</transform>" * 80 + "</scene>", "more than 64 levels"),
        )
    ),
]


@pytest.mark.parametrize(("read", "name", "content", "message"), REFUSED)
def test_files_that_mean_harm_are_refused(read: Any, name: str, content: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    error_line(read, tmp_path / name, *([0.1] if read is read_plan else []), message)


def test_aliases_and_scenes_of_known_plugins_are_read(tmp_path: Path) -> None:
    (tmp_path / "fine.yml").write_text("a: &a [1, 2]\nb: *a")
    assert read_yaml(tmp_path / "fine.yml") == {"a": [1, 2], "b": [1, 2]}
    (tmp_path / "scene.xml").write_text(scene_xml({"floor": "itu_concrete", "wall": "perfect"}))
    assert read_scene_xml(tmp_path / "scene.xml").tag == "scene"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("^dataset_name", r"array: {rows: 100000, columns: 100000, spacing_m: 1}\ndataset_name", "give 16384 at most"),
        (r"^\w+:$", "..:", "cannot name a folder"),
    ],
)
def test_receivers_that_ask_for_too_much_are_refused(old: str, new: str, message: str, folder: Path, tmp_path: Path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    text("gateway_info.yml", old, new)(copy)
    refusal(load, copy, message)


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    assert inside(tmp_path, "meshes/a.ply", tmp_path) == tmp_path / "meshes/a.ply"
    for name in ("../a", "/etc/passwd", "a/../../b", "", 5, None, "a" * 5000):
        refusal(inside, tmp_path, name, tmp_path / "scene.yml", r"outside its folder|no name of a file")


def test_messages_of_other_libraries_are_short() -> None:
    assert len(one_line(ValueError("1" * 5000))) < 500
