"""Small valid files of every format that is read, and their readers, for `wrf_mi_bench.hostile_files`."""

import base64
import json
import shutil
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from PIL import Image

from wrf_mi.apps.exports import export
from wrf_mi.apps.exports.fields import import_field
from wrf_mi.apps.exports.format import ExportOptions
from wrf_mi.apps.exports.paths_table import read_paths
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.dataset import write_map
from wrf_mi.apps.maps.locate_file import read_observations
from wrf_mi.apps.viewer.map_layer import read_map
from wrf_mi.core import Paths, Receiver, Record
from wrf_mi.core.array_files import write_arrays
from wrf_mi.core.files import write_atomically
from wrf_mi.core.paths import load_paths, save_paths
from wrf_mi.core.types import Split
from wrf_mi.datasets import load, load_split, save_split, write_ble_folder, write_spectrum_folder
from wrf_mi.datasets.argos import read_argos
from wrf_mi.datasets.deepmimo import read_deepmimo
from wrf_mi.datasets.nerf2_csi import write_nerf2_csi
from wrf_mi.datasets.newrf import read_newrf, read_pickled_table
from wrf_mi.estimators.checks import check_parts
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.prediction_file import read_inputs
from wrf_mi.runs.results import read_run
from wrf_mi.scene.folder import read_scene_folder, write_scene
from wrf_mi.scene.materials import read_materials
from wrf_mi.scene.mesh.files import read_mesh
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.scan.points import read_points
from wrf_mi.tracing import open_scene
from wrf_mi.training.checkpoint import cut_log, read_checkpoint

UP = np.array([0.0, 0, 0, 1])
CARRIER_HZ = 2.4e9
HEARD_BY = [Receiver(name, np.zeros(3), UP) for name in ("one", "other")]
# A table of pandas 3.1 with columns of numbers and of arrays, by Python's pickle, protocol 5.
PICKLE = (
    "c-oy)O>fgc5RLOi+7zfjgd(AGLZp{eTo4DKX%m6c2vfDaR;#tMj;+{hYrR$zi3&J0w9?)f`a9vq4Q4lqk|1(n59_f#@9mq}H=j%2Ul(&`sd7SjkE"
    "Wp3+EmiFf<_F!!Oj=BfVwJ@s4qZmPjVV=ELbDpk_k@3v=LEG`%EBq;~<RP!TZTO!c}dGAYtI7a|o!rB;!fo4njs8jnT>Xc@`z31~K#)GZDC;s>Bm"
    "<<Yb;_DC;+yxyAKkZyGc~l?(wsdvcU$`6}<dgzKxXa18ZsL0PZBw(Y~;xXjkgNpQMWH$MhtwLoH;syJB?%7CNBQW^%Xrs?J|$<i#{yx#q)sx4}bG"
    "DJ`zD4xAR1ao7aN|Ct|vHqsIg)J~YHPa=uEC(iv@ML|qe^2E<Eb09Cm(D%Zd3^?T|4#j8Yeo5!N2Lk=10*gW?IT^#e?nF^8O0Xd=P%}J{o22Jdby"
    "IT(wuRE|7M=Z5aw@d8H=4B16HlJmVMV_LzXrinle!9gtK$f(cg5lbE-6pjc<GCWi-~33(Z~N^*$yf84c$?wA=go&jED@tf$R$dkUKYswYweyuUxa"
    "%flz-pGDjFAvgQio*A#4jHDlPc=zeoq};L2d+I;a4)Awo_g}!5U465vcslH~(Q~K6qZrRBv`#vvCu49_k?U!+GsAI&r>!4T-e(Jy`k{?>l~hQym@"
    "1|+POyVIU>H~i$@GS!j1qCmb!R*?<!X&YOj6UTGgLsO#96+;8i*Itz6l@FFpSSr(#sN@2`U*0sl#xPuhPtE`~mA>hgJ"
)
SMALL = ("initial.gaussians=8", "network.width=8", "steps=4", "density.every=0", "checkpoint_every=2", "log_every=1")


@dataclass(frozen=True)
class Reader:
    """A reader: folder of its files, the file that is changed, and a function of the folder that reads it."""

    group: str
    file: str
    read: Callable[[Path], Any]


def _whole(kind: str, *files: str) -> dict[str, Reader]:
    """Files of a data set, which is read as a whole."""
    readers = (Reader(kind, file, lambda folder: check_parts(load(folder))) for file in files)
    return {f"{kind}: {Path(reader.file).name}": reader for reader in readers}


def _each(kind: str, reader: Callable[..., Any], *files: str, group: str = "files") -> dict[str, Reader]:
    """Files that a reader reads one by one."""

    def read(file: str, folder: Path) -> Any:
        return reader(folder / file)

    return {f"{kind}: {file}": Reader(group, file, partial(read, file)) for file in files}


def _predicted(name: str) -> Callable[[Path], Any]:
    return lambda folder: open_run(folder / name).predict([[2.0, 1.0, 1.0]])


def _predicted_by_operator(folder: Path) -> None:
    run = open_run(folder / "field")
    run.predict([[2.0, 1.0, 1.0]])
    assert np.isfinite(run.predict([[2.0, 1.0, 1.0]]).mean).all()


def _imported(folder: Path) -> None:
    out = folder / "imported"
    shutil.rmtree(out, ignore_errors=True)
    import_field(folder / "field.npz", out).predict([[2.0, 1.0, 1.0]])


READERS: Mapping[str, Reader] = {
    **_whole("spectra", "gateway_info.yml", "tx_pos.csv", "train_index.txt", "spectrum/00001.png"),
    **_whole("ble", "receivers.csv", "train.csv"),
    **_whole("nerf2-ble", "gateway_position.yml", "gateway_rssi.csv"),
    **_whole("nerf2-csi", "base-station.yml", "csidata.npy"),
    **_each("newrf", read_newrf, "room.npz"),
    **_each("newrf", read_pickled_table, "table.pkl"),
    **_each("argos", read_argos, "capture.hdf5"),
    "deepmimo: params.json": Reader("deepmimo", "params.json", read_deepmimo),
    "deepmimo: power.mat": Reader("deepmimo", "power_t000_tx000_r001.mat", read_deepmimo),
    **_each("points", read_points, "cloud.ply", "cloud.las", "cloud.laz", "cloud.xyz", "cloud.npz"),
    **_each("mesh", read_mesh, "box.ply", "box.stl", "box.obj", "box.glb"),
    **_each("plan", read_plan, "plan.npz", "plan.yaml", "plan.png", "plan.csv"),
    "scene: scene.xml": Reader("scene", "scene.xml", lambda folder: open_scene(folder / "scene.xml", CARRIER_HZ)),
    "scene: floor.ply": Reader("scene", "meshes/floor.ply", lambda folder: open_scene(folder, CARRIER_HZ)),
    "scene: scene.yml": Reader("scene", "scene.yml", read_scene_folder),
    "scene: materials.yml": Reader("scene", "materials.yml", read_materials),
    "run: config.yaml": Reader("runs", "kriging/config.yaml", _predicted("kriging")),
    "run: split.npz": Reader("runs", "kriging/split.npz", _predicted("kriging")),
    "run: model.npz of kriging": Reader("runs", "kriging/model.npz", _predicted("kriging")),
    "run: model.npz of wrf-gs+": Reader("runs", "field/model.npz", _predicted("field")),
    "run: operator0.npz": Reader("runs", "field/operator0.npz", _predicted_by_operator),
    "run: checkpoint.npz": Reader("runs", "stopped/checkpoint.npz", lambda folder: read_checkpoint(folder / "stopped")),
    "run: log.jsonl": Reader("runs", "stopped/log.jsonl", lambda folder: cut_log(folder / "stopped", 2)),
    "run: predictions.npz": Reader("runs", "kriging/predictions.npz", lambda folder: read_run(folder / "kriging")),
    "run: metrics.json": Reader("runs", "kriging/metrics.json", lambda folder: read_run(folder / "kriging")),
    **_each("run", load_paths, "paths.npz"),
    **_each("split", load_split, "split.npz"),
    **_each("paths", read_paths, "paths.csv"),
    **_each("map", read_map, "map.nc", "surface.nc", group="runs"),
    "map: chunk of map.zarr": Reader("runs", "map.zarr/power_dbm/0.0.0", lambda folder: read_map(folder / "map.zarr")),
    "map: .zmetadata": Reader("runs", "map.zarr/.zmetadata", lambda folder: read_map(folder / "map.zarr")),
    "import: field.npz": Reader("runs", "field.npz", _imported),
    **_each("locate", partial(read_observations, receivers=HEARD_BY), "heard.csv"),
    "predict: inputs.csv": Reader("files", "inputs.csv", lambda folder: read_inputs(folder / "inputs.csv", None)),
    "predict: inputs.npz": Reader("files", "inputs.npz", lambda folder: read_inputs(None, folder / "inputs.npz")),
}
"""All readers by name."""


def warm() -> None:
    """Import what readers import late, before memory is limited."""
    from wrf_mi.backend import init

    init("llvm", threads=1)
    for name in ("h5py", "laspy", "lazrs", "scipy.io", "sionna.rt", "xarray", "zarr", "h5netcdf"):
        __import__(name)


def prepare_spectra(folder: Path) -> Record:
    """Write a folder of twelve small spectra."""
    rng = np.random.default_rng(0)
    receiver = Receiver("gateway1", np.array([0.0, 0, 1]), UP, array_m=np.array([[0.1, 0, 0], [-0.1, 0, 0]]))
    record = Record(
        "spectra",
        "spectrum",
        rng.uniform(1, 4, (12, 3)),
        (receiver,),
        rng.uniform(0, 1, (1, 12, 9, 36)).astype(np.float32),
        official=(np.arange(8), np.arange(8, 12)),
        frequencies_hz=np.array([CARRIER_HZ]),
    )
    write_spectrum_folder(folder, record)
    return record


def prepare_strengths(folder: Path, rows: int = 12) -> Record:
    """Write a folder of a few signal strengths at two anchors; the last third are test rows."""
    rng = np.random.default_rng(0)
    record = Record(
        "ble",
        "rssi",
        rng.uniform(1, 4, (rows, 3)),
        tuple(Receiver(f"anchor{k}", np.array([float(k), 0, 1]), UP) for k in (1, 2)),
        rng.uniform(-80, -40, (2, rows)).astype(np.float32),
        official=(np.arange(2 * rows // 3), np.arange(2 * rows // 3, rows)),
        frequencies_hz=np.array([CARRIER_HZ]),
    )
    write_ble_folder(folder, record)
    return record


def prepare(folder: Path) -> None:
    """Write all samples, if they are not there."""
    if (folder / "done").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    rng = np.random.default_rng(0)
    spectra = prepare_spectra(folder / "spectra")
    positions = spectra.tx_pos_m
    common: dict[str, Any] = {"tx_pos_m": positions, "receivers": spectra.receivers, "official": spectra.official}
    common["frequencies_hz"] = spectra.frequencies_hz
    prepare_strengths(folder / "ble")
    channels = (rng.normal(size=(1, 12, 2, 4)) + 1j * rng.normal(size=(1, 12, 2, 4))).astype(np.complex64)
    hz = CARRIER_HZ + 1e6 * np.arange(4)
    station = {**common, "frequencies_hz": hz, "uplink": channels[0], "uplink_hz": hz - 1e8}
    write_nerf2_csi(folder / "nerf2-csi", Record("csi", "csi", observation=channels, **station))
    poses, powers = {"gateway1": [0.0, 0, 1], "gateway2": [3.0, 0, 1]}, rng.uniform(-90, -40, (len(positions), 2))
    write_atomically(folder / "nerf2-ble" / "gateway_position.yml", yaml.safe_dump(poses))
    for name, header, table in (("tx_pos", "x,y,z", positions), ("gateway_rssi", ",".join(poses), powers)):
        np.savetxt(folder / "nerf2-ble" / f"{name}.csv", table, delimiter=",", header=header, comments="")
    _write_deepmimo(folder / "deepmimo", rng)
    corners, faces = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    above = Surface("ceiling", "ceiling", corners + np.array([0.0, 0, 3]), faces)
    surfaces = [Surface("floor", "floor", corners, faces), above]
    write_scene(folder / "scene", surfaces, frame="z upwards", source="made here")
    _write_files(folder / "files", positions, rng)
    _write_runs(folder)
    (folder / "done").touch()


def _write_deepmimo(folder: Path, rng: np.random.Generator) -> None:
    from scipy.io import savemat

    folder.mkdir(parents=True)
    sets = {f"txrx_set_{k}": {"id": k, "is_tx": not k, "is_rx": bool(k), "num_points": 1 + 5 * k} for k in (0, 1)}
    stated = {"version": "4.0.5", "rt_params": {"frequency": CARRIER_HZ}, "txrx_sets": sets, "scene": {"num_scenes": 1}}
    (folder / "params.json").write_text(json.dumps(stated))
    matrices = {name: rng.uniform(1, 90, (6, 3)) for name in ("phase", "aod_az", "aod_el", "aoa_az", "aoa_el")}
    matrices |= {"power": rng.uniform(-100, -60, (6, 3)), "delay": rng.uniform(1e-8, 1e-6, (6, 3))}
    matrices |= {"rx_pos": rng.uniform(-9, 9, (6, 3)), "tx_pos": np.array([[0.0, 0, 9]])}
    for name, values in matrices.items():
        savemat(folder / f"{name}_t000_tx000_r001.mat", {name: values.astype(np.float32)})


def _write_files(folder: Path, positions: Any, rng: np.random.Generator) -> None:
    import h5py
    import laspy

    folder.mkdir(parents=True)
    cloud = rng.uniform(0, 4, (60, 3))
    trimesh.PointCloud(cloud).export(folder / "cloud.ply")
    np.savetxt(folder / "cloud.xyz", cloud)
    write_arrays(folder / "cloud.npz", {"points": cloud}, compressed=True)
    for suffix in ("las", "laz"):
        las = laspy.create(point_format=0)
        las.header.scales = [0.001] * 3
        las.x, las.y, las.z = cloud.T
        las.write(folder / f"cloud.{suffix}")
    for suffix in ("ply", "stl", "obj", "glb"):
        trimesh.creation.box((4, 5, 3)).export(folder / f"box.{suffix}")
    grid = np.full((30, 40), -2.0)
    grid[[0, -1]], grid[:, [0, -1]] = 2.0, 2.0
    write_arrays(folder / "plan.npz", {"log_odds": grid, "row_0": np.asarray("top"), "resolution_m": np.asarray(0.1)})
    Image.fromarray(np.where(grid > 0, 0, 255).astype(np.uint8)).save(folder / "plan.png")
    facts = {"image": "plan.png", "resolution": 0.1, "origin": [0.0, 0.0, 0.0], "negate": 0}
    (folder / "plan.yaml").write_text(yaml.safe_dump(facts))
    (folder / "plan.csv").write_text("x,y\n0,0\n4,0\n4,3\n0,3\n0,0\n")
    channels = rng.normal(size=12) + 1j * rng.normal(size=12)
    room = {"tx_pos": np.zeros(3), "rx_pos": positions, "frequency_hz": np.asarray(CARRIER_HZ), "csi": channels}
    write_arrays(folder / "room.npz", room, compressed=True)
    (folder / "table.pkl").write_bytes(zlib.decompress(base64.b85decode(PICKLE)))
    with h5py.File(folder / "capture.hdf5", "w") as stored:
        samples = rng.integers(-99, 99, (4, 2, 448, 2), dtype=np.int16)
        stored.create_dataset("Pilot_Samples", data=samples, compression="gzip")
        stored.attrs.update({"num_mob_ant": 2, "samples_per_user": 224, "measured_noise": 0})
    rows, ones = np.arange(2), np.ones((2, 3)) / np.sqrt(3)
    bounces = np.zeros((2, 0), np.uint8), np.zeros((2, 0, 3)), np.zeros((2, 0), np.int32)
    arrays: Any = (rows, rows * 0, rows + 1j, rows + 1.0, ones, ones, *bounces, (), 2, 1)
    save_paths(folder / "paths.npz", Paths(*arrays))
    (folder / "heard.csv").write_text("x,y,rssi_one,other_dbm\n1,2,-60.5,-71\n2,2,,-70\n")
    save_split(folder / "split.npz", Split("own", 0, np.arange(6), np.arange(6, 8), np.arange(8, 12)))
    np.savetxt(folder / "inputs.csv", positions, delimiter=",", header="x,y,z", comments="")
    write_arrays(folder / "inputs.npz", {"tx_pos": positions})


def _write_runs(folder: Path) -> None:
    from wrf_mi.backend import init
    from wrf_mi.training.session import Interrupted

    init("llvm", threads=1)
    strengths = train(folder / "ble", "kriging", out=folder / "runs" / "kriging")
    where = ExportOptions(frequency_hz=CARRIER_HZ, tx_pos_m=np.array([[1.0, 2, 1]]), rx_pos_m=np.array([[3.0, 1, 2]]))
    export(folder / "scene", "paths", folder / "files" / "paths.csv", where)
    radio = radio_map(strengths, height_m=1.0, step_m=0.5)
    write_map(radio, folder / "runs" / "map.nc")
    write_map(radio, folder / "runs" / "map.zarr")
    write_map(radio_map(strengths, surface=folder / "files" / "box.ply"), folder / "runs" / "surface.nc")
    settings = (*SMALL, "network.static_geometry=true")
    run = train(folder / "spectra", "wrf-gs+", out=folder / "runs" / "field", settings=settings).folder
    export(run, "field", folder / "runs" / "field.npz")
    open_run(run).predict([[2.0, 1.0, 1.0]])  # builds the operator
    asked, stopped = iter(range(1, 5)), folder / "runs" / "stopped"
    with suppress(Interrupted):
        train(folder / "spectra", "wrf-gs+", out=stopped, settings=settings, stop=lambda: next(asked) >= 3)
