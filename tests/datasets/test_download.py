"""Known data sets: where they are looked for, and downloads from a server on this machine."""

import functools
import hashlib
import shutil
import socket
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, needs

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.datasets import datasets, fetch, load, read_newrf, read_spectrum_folder, registry, write_spectrum_folder
from wrf_mi.datasets.download import download
from wrf_mi.datasets.newrf import arrays_sha256, convert_newrf
from wrf_mi.datasets.registry import DATA_VARIABLE, DataSet, RemoteFile, known, remote_files

ROWS = 6
NAMES = ("rfid-lab", "flat-ble", "newrf-conference", "newrf-office", "laboratory", "traced-room")
NAMES += ("traced-room-bands", "traced-csi-flat", "traced-csi-office")
NAMES += ("traced-floor-receivers", "traced-floor-receivers-csi")
PICKLES = Path(__file__).parent / "data"
DATASET = DataSet("small", "spectrum", "MIT", "made up", base_url="http://unused")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(autouse=True)
def _without_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retries wait."""
    monkeypatch.setattr(sys.modules[download.__module__], "RETRIES", 0)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Path]]:
    """A server of files on this machine: its URL and the folder it serves."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    root = tmp_path / "served"
    root.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=root)) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{http.server_port}", root
        http.shutdown()
        thread.join()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without data: an empty cache and no WRF_MI_DATA."""
    monkeypatch.delenv("WRF_MI_DATA", raising=False)
    monkeypatch.setattr(registry, "user_cache", lambda: tmp_path / "cache")
    return tmp_path


def small_folder(path: Path) -> Path:
    rng = np.random.default_rng(1)
    record = Record(
        "small",
        "spectrum",
        rng.normal(size=(ROWS, 3)),
        (Receiver("gateway1", np.zeros(3), np.array([0.0, 0, 0, 1])),),
        rng.random((1, ROWS, 4, 8)).astype(np.float32),
        official=(np.arange(2, ROWS), np.arange(2)),
    )
    return write_spectrum_folder(path, record)


def manifest(folder: Path) -> list[RemoteFile]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return [
        RemoteFile(path.relative_to(folder).as_posix(), hashlib.sha256(path.read_bytes()).hexdigest(), remote)
        for path in paths
        for remote in [f"abc123/{path.relative_to(folder).as_posix()}"]
    ]


def test_download_is_complete_and_checked_again(server: tuple[str, Path], tmp_path: Path):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    target = download(DATASET, entries, tmp_path / "home" / "small", url)
    np.testing.assert_array_equal(
        read_spectrum_folder(target).observation, read_spectrum_folder(root / "abc123").observation
    )
    assert [path.name for path in target.parent.iterdir()] == ["small"]
    assert (target / "SOURCE.txt").read_text() == "small: made up\nLicence: MIT\n"
    shutil.rmtree(root / "abc123")
    assert download(DATASET, entries, target, url) == target, "what is there needs no server"
    (target / "tx_pos.csv").write_text("x,y,z\n")
    with pytest.raises(InputError, match=r"tx_pos.csv: missing or is not the published file \(1 of \d+ are not\)"):
        download(DATASET, entries, target, url)


@pytest.mark.parametrize("progress", [False, True])
def test_a_corrupted_file_is_refused_and_nothing_is_left(server: tuple[str, Path], tmp_path: Path, progress: bool):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    image = root / "abc123" / "spectrum" / "00004.png"
    image.write_bytes(image.read_bytes()[:-1] + b"\0")
    with pytest.raises(InputError, match=r"00004\.png has not the published SHA-256") as error:
        download(DATASET, entries, tmp_path / "home" / "small", url, progress=progress)
    assert "\n" not in str(error.value)
    assert list((tmp_path / "home").iterdir()) == []


def test_a_file_without_end_is_refused_and_nothing_is_left(
    server: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    monkeypatch.setattr(sys.modules[download.__module__], "MOST_BYTES", 100)
    with pytest.raises(InputError, match="is larger than any published file, nothing was kept"):
        download(DATASET, entries, tmp_path / "home" / "small", url)
    assert list((tmp_path / "home").iterdir()) == []


def test_missing_remote_file_is_reported_in_one_line(server: tuple[str, Path], tmp_path: Path):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    (root / "abc123" / "spectrum" / "00002.png").unlink()
    with pytest.raises(InputError, match=r"404 .*00002\.png"):
        download(DATASET, entries, tmp_path / "home" / "small", url)
    assert list((tmp_path / "home").iterdir()) == []


def test_missing_network_is_reported_in_one_line(home: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound and not listening: connections are refused
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(InputError, match=r"127\.0\.0\.1:\d+ cannot be reached; .*WRF_MI_DATA") as error:
            fetch("rfid-lab", base_url=url, progress=False)
    assert "\n" not in str(error.value)
    assert list((home / "cache").iterdir()) == []


def test_unwritable_folder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "file"))
    with pytest.raises(InputError, match="cannot be written"):
        fetch("rfid-lab", base_url="http://127.0.0.1:9", progress=False)


def test_names_that_cannot_be_fetched(home: Path):
    with pytest.raises(InputError, match="neither a folder nor known; known are rfid-lab"):
        fetch("nerf")
    with pytest.raises(InputError, match="not downloaded but traced"):
        fetch("laboratory")


def test_data_sets_are_located_in_order(home: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="run `wrf-mi data fetch rfid-lab`"):
        load("rfid-lab")
    with pytest.raises(InputError, match="traces it"):
        load("laboratory")
    with pytest.raises(InputError, match="no such folder"):
        load(home / "nothing")
    with pytest.raises(InputError, match="no such folder"):
        load("some/where")
    with pytest.raises(InputError, match="neither a folder nor known"):
        load("nothing")
    assert {status.dataset.name: status.location for status in datasets()} == dict.fromkeys(NAMES)

    cached = small_folder(home / "cache" / "laboratory")
    assert load("laboratory").source == str(cached)
    chosen = small_folder(home / "data" / "laboratory")
    monkeypatch.setenv("WRF_MI_DATA", str(home / "data"))
    assert load("laboratory").source == str(chosen), "WRF_MI_DATA goes before the cache"
    monkeypatch.setenv("WRF_MI_DATA", str(home / "elsewhere"))
    assert load("laboratory").source == str(cached)
    here = {status.dataset.name: status.location for status in datasets()}
    assert here == dict.fromkeys(NAMES) | {"laboratory": cached}
    monkeypatch.chdir(home / "data")
    assert load("laboratory").source == "laboratory", "a folder goes before a name"
    assert load(chosen).name == "laboratory"


def test_the_manifest_is_complete():
    entries = remote_files(known("rfid-lab"))
    paths = [entry.path for entry in entries]
    texts = {"LICENSE", "gateway_info.yml", "tx_pos.csv", "train_index.txt", "test_index.txt"}
    assert set(paths) == texts | {f"spectrum/{row:05d}.png" for row in range(1, 201)}
    assert len(set(paths)) == len(paths)
    for entry in entries:
        commit, _, rest = entry.remote.partition("/")
        assert len(entry.sha256) == 64
        assert len(commit) == 40
        assert rest in (entry.path, f"data_test200/{entry.path}")


@needs("rfid-lab")
def test_fetch_rfid_lab_from_a_copy(server: tuple[str, Path], home: Path):
    url, root = server
    for entry in remote_files(known("rfid-lab")):
        (root / entry.remote).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(DATA, "rfid-lab", entry.path), root / entry.remote)
    target = fetch("rfid-lab", base_url=url, progress=False)
    assert target == home / "cache" / "rfid-lab"
    ours, theirs = load("rfid-lab"), read_spectrum_folder(Path(DATA, "rfid-lab"))
    np.testing.assert_array_equal(ours.observation, theirs.observation)
    np.testing.assert_array_equal(ours.folds, theirs.folds)
    (target / "blocked_folds.txt").unlink()
    np.testing.assert_array_equal(load("rfid-lab").folds, theirs.folds)


def test_manifests_of_the_other_data_sets():
    expected = {
        "flat-ble": {"anchors.csv", "calibration_df.csv", "test_robot_df.csv", "layout.csv"},
        "newrf-conference": {"LICENSE", "conference.stl", "conference.npz"},
        "newrf-office": {"LICENSE", "office.stl", "office.npz"},
    }
    for name, paths in expected.items():
        entries = remote_files(known(name))
        assert {entry.path for entry in entries} == paths
        for entry in entries:
            commit, _, rest = entry.remote.partition("/")
            assert len(bytes.fromhex(entry.sha256)) == 32
            assert len(bytes.fromhex(commit)) == 20
            assert entry.converted == rest.endswith(".pkl")


@pytest.mark.parametrize("folder", ["newrf", "newrf-office"])
def test_a_room_is_found_in_a_folder_of_its_own_or_beside_others(
    home: Path, monkeypatch: pytest.MonkeyPatch, folder: str
):
    monkeypatch.setenv("WRF_MI_DATA", str(home / "data"))
    place = home / "data" / folder
    place.mkdir(parents=True)
    with pytest.raises(InputError, match="run `wrf-mi data fetch newrf-office`"):
        load("newrf-office")
    np.savez(place / "office.npz", **convert_newrf(PICKLES / "newrf_protocol5.pkl"))
    assert load("newrf-office").source == str(place / "office.npz")
    with pytest.raises(InputError, match="newrf-conference: not on this machine"):
        load("newrf-conference")
    assert {s.dataset.name for s in datasets() if s.location} == {"newrf-office"}


def room(root: Path) -> list[RemoteFile]:
    """A served room: its mesh and its pickle."""
    (root / "abc123").mkdir()
    (root / "abc123" / "hall.stl").write_bytes(b"mesh")
    shutil.copyfile(PICKLES / "newrf_protocol5.pkl", root / "abc123" / "data.pkl")
    return [
        RemoteFile("hall.stl", hashlib.sha256(b"mesh").hexdigest(), "abc123/hall.stl"),
        RemoteFile("hall.npz", arrays_sha256(convert_newrf(root / "abc123" / "data.pkl")), "abc123/data.pkl", True),
    ]


def test_a_room_is_converted_and_its_arrays_are_checked_again(server: tuple[str, Path], tmp_path: Path):
    url, root = server
    entries = room(root)
    target = download(DATASET, entries, tmp_path / "home" / "hall", url)
    assert sorted(path.name for path in target.iterdir()) == ["SOURCE.txt", "hall.npz", "hall.stl"]
    assert read_newrf(target).observation.shape == (1, 5, 1)
    # Written by another program the file has other bytes and the same arrays.
    with np.load(target / "hall.npz") as stored:
        arrays = dict(stored)
    np.savez(target / "hall.npz", **arrays)
    assert download(DATASET, entries, target, url) == target
    np.savez(target / "hall.npz", **arrays | {"csi": -arrays["csi"]})
    with pytest.raises(InputError, match=r"hall\.npz: missing or is not the published file \(1 of 2 are not\)"):
        download(DATASET, entries, target, url)
    (target / "hall.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"hall\.npz: missing or is not the published file"):
        download(DATASET, entries, target, url)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a pickle", r"data\.pkl cannot be converted \(not the pickle of a table .*; nothing was kept"),
        (None, r"data\.pkl does not hold the published arrays, nothing was kept; set WRF_MI_DATA"),
    ],
)
def test_a_pickle_with_other_content_is_refused_and_nothing_is_left(
    server: tuple[str, Path], tmp_path: Path, content: bytes | None, message: str
):
    url, root = server
    entries = room(root)
    served = root / "abc123" / "data.pkl"
    served.write_bytes(
        served.read_bytes().replace(b"\x33\x33\x33\x33", b"\x34\x33\x33\x33") if content is None else content
    )
    with pytest.raises(InputError, match=message) as error:
        download(DATASET, entries, tmp_path / "home" / "hall", url)
    assert "\n" not in str(error.value)
    assert str(tmp_path) not in str(error.value), "names a file that is gone"
    assert list((tmp_path / "home").iterdir()) == []


@needs("rfid-lab")
def test_fetch_flat_ble_from_a_copy(server: tuple[str, Path], home: Path, capsys: pytest.CaptureFixture[str]):
    url, root = server
    for entry in remote_files(known("flat-ble")):
        (root / entry.remote).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(DATA, "flat-ble", entry.path), root / entry.remote)
    target = fetch("flat-ble", base_url=url)
    assert "lidar/points.npz and lidar/gridmap.npz" in capsys.readouterr().err
    assert "CC BY 4.0" in (target / "SOURCE.txt").read_text()
    ours, theirs = load("flat-ble"), load(Path(DATA, "flat-ble"))
    np.testing.assert_array_equal(ours.observation, theirs.observation)
    assert ours.frequencies_hz == [2.44e9]
    assert all(one.array_m is None for one in ours.receivers)


@needs("rfid-lab")
@pytest.mark.parametrize("name", ["rfid-lab", "flat-ble", "newrf-conference", "newrf-office"])
def test_existing_copy_is_checked_without_network(name: str):
    folder = fetch(name, base_url="http://127.0.0.1:9", progress=False)
    assert folder.parent == DATA


@needs("rfid-lab")
def test_rfid_lab_has_its_carrier_and_array():
    record = load("rfid-lab")
    assert record.frequencies_hz == [920e6]
    np.testing.assert_allclose(
        record.receivers[0].array_m[[0, 1, 4]], [[-0.24, -0.24, 0], [-0.08, -0.24, 0], [-0.24, -0.08, 0]]
    )
