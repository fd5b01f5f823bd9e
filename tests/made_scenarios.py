"""Scenarios of DeepMIMO 4 made of random paths, and the package's own channels of them."""

import contextlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from wrf_mi.core.array_files import write_arrays

CARRIER_HZ = 3.5e9
LACKING = "the package deepmimo is not installed (pip install '.[deepmimo]')"
CHOSEN: dict[str, dict[str, Any]] = {
    "default": {},
    "array": {
        "bs_antenna": {
            "shape": [4, 2],
            "spacing": 0.5,
            "rotation": [10, -20, 130],
            "radiation_pattern": "halfwave-dipole",
        },
        "ue_antenna": {"radiation_pattern": "halfwave-dipole"},
        "ofdm": {"bandwidth": 20e6, "subcarriers": 64, "selected_subcarriers": [0, 21, 42, 63]},
    },
}
"""Parameters of channels, by DeepMIMO's names."""


def txrx_set(number: int, is_tx: bool, points: int) -> dict[str, Any]:
    return {"name": f"set{number}", "id": number, "is_tx": is_tx, "is_rx": not is_tx, "num_points": points}


def params(stations: int = 1, users: tuple[int, ...] = (10,)) -> dict[str, Any]:
    sets = [txrx_set(0, True, stations), *(txrx_set(1 + k, False, count) for k, count in enumerate(users))]
    return {
        "version": "4.0.5",
        "rt_params": {"frequency": CARRIER_HZ},
        "txrx_sets": {f"txrx_set_{entry['id']}": entry for entry in sets},
        "materials": {},
        "scene": {"num_scenes": 1},
    }


def matrices(rng: np.random.Generator, users: int, paths: int, station: np.ndarray) -> dict[str, np.ndarray]:
    """Matrices of random paths in single precision, as DeepMIMO stores them; user 0 has no path."""
    arrays = {
        "power": rng.uniform(-140, -60, (users, paths)),
        "phase": rng.uniform(-180, 180, (users, paths)),
        "delay": rng.uniform(1e-8, 2e-6, (users, paths)),
        "aod_az": rng.uniform(-180, 180, (users, paths)),
        "aod_el": rng.uniform(1, 179, (users, paths)),
        "aoa_az": rng.uniform(-180, 180, (users, paths)),
        "aoa_el": rng.uniform(1, 179, (users, paths)),
        "inter": rng.choice([0.0, 1.0, 11.0, 2.0], (users, paths)),
    }
    count = rng.integers(1, paths + 1, users)
    count[0] = 0
    for values in arrays.values():
        values[np.arange(paths) >= count[:, None]] = np.nan
    arrays["inter_pos"] = np.full((users, paths, 2, 3), np.nan)
    arrays |= {"rx_pos": rng.uniform(-50, 50, (users, 3)), "tx_pos": station[None]}
    return {key: values.astype(np.float32) for key, values in arrays.items()}


def write_scenario(folder, stations=1, users=(10,), paths=5, suffix=".npz"):
    """A scenario of base stations with the same sets of users."""
    rng = np.random.default_rng(7)
    folder.mkdir(parents=True)
    (folder / "params.json").write_text(json.dumps(params(stations, users)))
    positions: dict[int, np.ndarray] = {}
    for index in range(stations):
        station = np.array([10.0 * index, 5, 20])
        for k, count in enumerate(users):
            arrays = matrices(rng, count, paths, station)
            arrays["rx_pos"] = positions.setdefault(k, arrays["rx_pos"])
            for key, values in arrays.items():
                file = folder / f"{key}_t000_tx{index:03}_r{1 + k:03}{suffix}"
                if suffix == ".mat":
                    savemat(file, {key: values})
                elif suffix == ".npy":
                    np.save(file, values)
                else:
                    write_arrays(file, {key: values})
    np.savez(folder / "vertices.npz", vertices=np.zeros((0, 3)))
    (folder / "objects.json").write_text("[]")
    return folder


def package_dataset(folder: Path, **load: Any) -> Any:
    """The scenario as `deepmimo.load` opens it; the test is skipped where the package is not installed."""
    deepmimo = pytest.importorskip("deepmimo", reason=LACKING)
    deepmimo.config.set("scenarios_folder", str(folder.parent))
    with contextlib.redirect_stdout(io.StringIO()):
        return deepmimo.load(folder.name, **load)


def package_channels(dataset: Any, chosen: Mapping[str, Any], **more: Any) -> np.ndarray:
    """`compute_channels` of the package for the users' single antenna [n, m, k], times sqrt(N)."""
    deepmimo = pytest.importorskip("deepmimo", reason=LACKING)
    parameters = {"bs_antenna": {"shape": [1, 1]}, **chosen, **more}
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        channels = dataset.compute_channels(deepmimo.ChannelParameters(parameters))
    return channels[:, 0] * np.sqrt(parameters.get("ofdm", {}).get("subcarriers", 512))
