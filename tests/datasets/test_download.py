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
from typing import Any

import numpy as np
import pytest
from changed_folders import DATA, error_line, needs, refusal
from spectrum_records import assert_same, make_record

from wrf_mi.core.array_files import write_arrays
from wrf_mi.datasets import datasets, fetch, load, read_newrf, read_spectrum_folder, registry, write_spectrum_folder
from wrf_mi.datasets.download import download
from wrf_mi.datasets.newrf import arrays_sha256, convert_newrf
from wrf_mi.datasets.registry import DATA_VARIABLE, DataSet, RemoteFile, known, remote_files

NAMES = (
    *("rfid-lab", "flat-ble", "newrf-conference", "newrf-office", "laboratory", "traced-room", "traced-room-bands"),
    *("traced-csi-flat", "traced-csi-office", "traced-floor-receivers", "traced-floor-receivers-csi"),
)
Server = tuple[str, Path]
"""The URL and the folder that it serves."""
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
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
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
    return write_spectrum_folder(path, make_record(6))


def remote(path: Path, name: str) -> RemoteFile:
    return RemoteFile(name, hashlib.sha256(path.read_bytes()).hexdigest(), f"abc123/{name}")


def manifest(folder: Path) -> list[RemoteFile]:
    return [remote(path, path.relative_to(folder).as_posix()) for path in sorted(folder.rglob("*")) if path.is_file()]


def test_download_is_complete_and_checked_again(server: Server, tmp_path: Path):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    target = download(DATASET, entries, tmp_path / "home" / "small", url)
    assert_same(read_spectrum_folder(target), read_spectrum_folder(root / "abc123"), "name")
    assert [path.name for path in target.parent.iterdir()] == ["small"]
    assert (target / "SOURCE.txt").read_text() == "small: made up\nLicence: MIT\n"
    shutil.rmtree(root / "abc123")
    assert download(DATASET, entries, target, url) == target, "what is there needs no server"
    (target / "tx_pos.csv").write_text("x,y,z\n")
    message = r"tx_pos.csv: missing or is not the published file \(1 of \d+ are not\)"
    refusal(download, DATASET, entries, target, url, message)


def refused(entries: list[RemoteFile], home: Path, url: str, message: str, progress: bool = False) -> None:
    """The download is refused in one line, which names no file that is gone, and nothing is left."""
    line = error_line(download, DATASET, entries, home / "small", url, message, progress=progress)
    assert str(home) not in line
    assert list(home.iterdir()) == []


@pytest.mark.parametrize("progress", [False, True])
def test_missing_and_corrupted_files(server: Server, tmp_path: Path, progress: bool):
    url, root = server
    entries = manifest(small_folder(root / "abc123"))
    image = root / "abc123" / "spectrum" / "00004.png"
    image.write_bytes(image.read_bytes()[:-1] + b"\0")
    refused(entries, tmp_path / "home", url, r"00004\.png has not the published SHA-256", progress)
    image.unlink()
    refused(entries, tmp_path / "home", url, r"404 .*00004\.png", progress)


def test_missing_network_and_unwritable_folders_are_reported(home: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound and not listening: connections are refused
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        refusal(fetch, "rfid-lab", r"127\.0\.0\.1:\d+ cannot be reached; .*WRF_MI_DATA", base_url=url, progress=False)
    assert list((home / "cache").iterdir()) == []
    (home / "file").write_text("in the way")
    monkeypatch.setenv(DATA_VARIABLE, str(home / "file"))
    refusal(fetch, "rfid-lab", "cannot be written", base_url="http://127.0.0.1:9", progress=False)


def locations() -> dict[str, Path | None]:
    return {status.dataset.name: status.location for status in datasets()}


def test_data_sets_are_located_in_order(home: Path, monkeypatch: pytest.MonkeyPatch):
    refusal(fetch, "nerf", "neither a folder nor known; known are rfid-lab")
    error_line(fetch, "laboratory", "not downloaded but traced")
    refusal(load, "rfid-lab", "run `wrf-mi data fetch rfid-lab`")
    refusal(load, "laboratory", "traces it")
    refusal(load, home / "nothing", "no such folder")
    refusal(load, "some/where", "no such folder")
    refusal(load, "nothing", "neither a folder nor known")
    assert locations() == dict.fromkeys(NAMES)
    cached = small_folder(home / "cache" / "laboratory")
    assert load("laboratory").source == str(cached)
    chosen = small_folder(home / "data" / "laboratory")
    monkeypatch.setenv("WRF_MI_DATA", str(home / "data"))
    assert load("laboratory").source == str(chosen), "WRF_MI_DATA goes before the cache"
    monkeypatch.setenv("WRF_MI_DATA", str(home / "elsewhere"))
    assert load("laboratory").source == str(cached)
    assert locations() == dict.fromkeys(NAMES) | {"laboratory": cached}
    monkeypatch.chdir(home / "data")
    assert load("laboratory").source == "laboratory", "a folder goes before a name"
    assert load(chosen).name == "laboratory"


MANIFESTS = {
    "rfid-lab": {"LICENSE", "gateway_info.yml", "tx_pos.csv", "train_index.txt", "test_index.txt"}
    | {f"spectrum/{row:05d}.png" for row in range(1, 201)},
    "flat-ble": {"anchors.csv", "calibration_df.csv", "test_robot_df.csv", "layout.csv"},
    "newrf-conference": {"LICENSE", "conference.stl", "conference.npz"},
    "newrf-office": {"LICENSE", "office.stl", "office.npz"},
}


@pytest.mark.parametrize("name", MANIFESTS)
def test_manifests_are_complete(name: str):
    entries = remote_files(known(name))
    assert sorted(entry.path for entry in entries) == sorted(MANIFESTS[name])
    for entry in entries:
        commit, _, path = entry.remote.partition("/")
        assert (len(bytes.fromhex(entry.sha256)), len(bytes.fromhex(commit))) == (32, 20)
        assert entry.converted == path.endswith(".pkl")
        assert name != "rfid-lab" or path in (entry.path, f"data_test200/{entry.path}")


def fetched_from_copy(name: str, server: Server, **options: bool) -> Path:
    """The data set as it is fetched from a server of this machine's copy."""
    url, root = server
    for entry in remote_files(known(name)):
        (root / entry.remote).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(DATA / name / entry.path, root / entry.remote)
    return fetch(name, base_url=url, **options)


@needs("rfid-lab")
def test_fetch_rfid_lab_from_a_copy(server: Server, home: Path):
    target = fetched_from_copy("rfid-lab", server, progress=False)
    assert target == home / "cache" / "rfid-lab"
    fetched, copy = load("rfid-lab"), read_spectrum_folder(DATA / "rfid-lab")
    np.testing.assert_array_equal(fetched.observation, copy.observation)
    np.testing.assert_array_equal(fetched.folds, copy.folds)
    assert fetched.frequencies_hz == [920e6]
    corners_m = [[-0.24, -0.24, 0], [-0.08, -0.24, 0], [-0.24, -0.08, 0]]
    np.testing.assert_allclose(fetched.receivers[0].array_m[[0, 1, 4]], corners_m)
    (target / "blocked_folds.txt").unlink()
    np.testing.assert_array_equal(load("rfid-lab").folds, copy.folds)


@needs("rfid-lab")
def test_fetch_flat_ble_from_a_copy(server: Server, home: Path, capsys: pytest.CaptureFixture[str]):
    target = fetched_from_copy("flat-ble", server)
    assert "lidar/points.npz and lidar/gridmap.npz" in capsys.readouterr().err
    assert "CC BY 4.0" in (target / "SOURCE.txt").read_text()
    fetched = load("flat-ble")
    np.testing.assert_array_equal(fetched.observation, load(DATA / "flat-ble").observation)
    assert fetched.frequencies_hz == [2.44e9]
    assert all(receiver.array_m is None for receiver in fetched.receivers)


@pytest.mark.parametrize("folder", ["newrf", "newrf-office"])
def test_a_room_is_found_in_its_own_folder_or_beside_others(home: Path, monkeypatch: pytest.MonkeyPatch, folder: str):
    monkeypatch.setenv("WRF_MI_DATA", str(home / "data"))
    place = home / "data" / folder
    place.mkdir(parents=True)
    refusal(load, "newrf-office", "run `wrf-mi data fetch newrf-office`")
    write_arrays(place / "office.npz", converted())
    assert load("newrf-office").source == str(place / "office.npz")
    refusal(load, "newrf-conference", "newrf-conference: not on this machine")
    assert {s.dataset.name for s in datasets() if s.location} == {"newrf-office"}


@functools.cache
def converted() -> dict[str, np.ndarray]:
    """Arrays of the pickle that is served."""
    return convert_newrf(PICKLES / "newrf_protocol5.pkl")


def room(root: Path) -> list[RemoteFile]:
    """A served room: its mesh and its pickle."""
    (root / "abc123").mkdir()
    (root / "abc123" / "hall.stl").write_bytes(b"mesh")
    shutil.copyfile(PICKLES / "newrf_protocol5.pkl", root / "abc123" / "data.pkl")
    return [
        remote(root / "abc123" / "hall.stl", "hall.stl"),
        RemoteFile("hall.npz", arrays_sha256(converted()), "abc123/data.pkl", True),
    ]


def test_a_room_is_converted_and_its_arrays_are_checked_again(server: Server, tmp_path: Path):
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
    refusal(download, DATASET, entries, target, url, r"hall\.npz: missing or is not .* file \(1 of 2 are not\)")
    (target / "hall.npz").write_bytes(b"")
    refusal(download, DATASET, entries, target, url, r"hall\.npz: missing or is not the published file")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: b"not a pickle", r"data\.pkl cannot be converted \(not the pickle of a table .*; nothing was kept"),
        (
            lambda content: content.replace(b"\x33\x33\x33\x33", b"\x34\x33\x33\x33"),
            r"data\.pkl does not hold the published arrays, nothing was kept; set WRF_MI_DATA",
        ),
    ],
)
def test_a_pickle_with_other_content_is_refused(server: Server, tmp_path: Path, change: Any, message: str):
    url, root = server
    entries, served = room(root), root / "abc123" / "data.pkl"
    served.write_bytes(change(served.read_bytes()))
    refused(entries, tmp_path / "home", url, message)


@needs("rfid-lab")
@pytest.mark.parametrize("name", ["rfid-lab", "flat-ble", "newrf-conference", "newrf-office"])
def test_existing_copy_is_checked_without_network(name: str):
    folder = fetch(name, base_url="http://127.0.0.1:9", progress=False)
    assert folder.parent == DATA
