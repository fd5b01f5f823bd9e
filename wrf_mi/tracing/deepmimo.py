"""Traced paths as a scenario of DeepMIMO 4, which ``deepmimo.load`` opens.

Base stations are the static receivers, users the transmitters: by reciprocity the gain is that from the base station to
the user, departure is at the base station, and interactions are in the order from there. Source of the format: as
`wrf_mi.datasets.deepmimo`.
"""

from __future__ import annotations

import json
import logging
import re
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core import InputError, Paths
from ..core.array_files import write_arrays
from ..core.files import atomic_folder
from ..core.types import FloatArray, IntArray
from ..datasets.deepmimo import PARAMS, VERSION
from ..version import __version__
from .paths.result import TraceResult

logger = logging.getLogger(__name__)

STATIONS, USERS = 0, 1  # numbers of the sets of base stations and of users
CODES = {0: 0, 1: 1, 2: 3, 4: 4, 8: 2}
"""DeepMIMO's codes (1 reflection, 2 diffraction, 3 scattering, 4 transmission) of Sionna RT's kinds of interaction."""
LOADED_PATHS = 25  # paths of a user that ``deepmimo.load`` reads (``max_paths``) and ``compute_channels`` adds


def check_deepmimo_folder(path: str | Path, replace: bool = False) -> Path:
    """Refuse (`InputError`) a folder that exists and may not be replaced, or that ``deepmimo.load`` cannot name."""
    folder = Path(path)
    name = folder.resolve().name
    if name != name.lower() or not name or re.search(r'[\\:*?"\'<>|\n]', name):
        text = f"{folder}: {name!r} as name of a scenario, which deepmimo.load turns into lower case"
        raise InputError(f"{text}; choose small letters, digits and _")
    if folder.exists() and not replace:
        raise InputError(f"{folder}: exists; remove it, choose another folder, or give --replace")
    return folder


def write_deepmimo(path: str | Path, traced: TraceResult, replace: bool = False) -> Path:
    """Write a trace atomically as a scenario of DeepMIMO 4.

    Powers and phases are those of the traced gains, antennas included, and phases include the carrier's exp(-j 2 pi f
    delay). Scene and materials are not written. Paths of a user are ordered as line of sight, then by falling power;
    ``deepmimo.load`` reads 25 of them unless its ``max_paths`` states more.

    Args:
        path: folder of the scenario; its name is that of the scenario, in small letters.
        traced: paths from users (transmitters) to base stations (receivers).
        replace: replace an existing folder.

    Raises:
        InputError: no path, several carriers, or a folder as `check_deepmimo_folder` refuses it.
    """
    folder = check_deepmimo_folder(path, replace)
    carriers_hz = {traced.frequency_hz} if traced.carriers_hz is None else set(traced.carriers_hz.tolist())
    if len(carriers_hz) > 1 or any(map(attrgetter("frequency_hz"), traced.receivers)):
        raise InputError(f"{folder}: paths of several carriers; DeepMIMO has one, so trace the rows of each alone")
    carrier_hz = carriers_hz.pop()
    paths = traced.paths.select(traced.paths.gain != 0)
    if not len(paths):
        raise InputError(f"{folder}: no path from {paths.n_tx} users to {paths.n_rx} base stations; nothing to write")
    rank = _ranks(paths)
    matrices, most = _matrices(paths, carrier_hz), int(rank.max()) + 1
    if most > LOADED_PATHS:
        text = "%s: up to %d paths of a user, of which DeepMIMO uses %d by default; load with max_paths=%d and compute "
        logger.warning(text + "channels with num_paths=%d", folder, most, LOADED_PATHS, most, most)
    users = traced.tx_pos_m.astype(np.float32)
    with atomic_folder(folder, replace) as part:
        for index, station in enumerate(traced.receivers):
            of = paths.rx == index
            pair = f"t{STATIONS:03}_tx{index:03}_r{USERS:03}"
            positions = {"tx_pos": station.position_m.astype(np.float32)[None], "rx_pos": users}
            for key, values in positions.items():
                write_arrays(part / f"{key}_{pair}.npz", {key: values}, compressed=True)
            for key, values in matrices.items():
                filled = np.full((paths.n_tx, most, *values.shape[1:]), np.nan, values.dtype)
                filled[paths.tx[of], rank[of]] = values[of]
                write_arrays(part / f"{key}_{pair}.npz", {key: filled}, compressed=True)
        write_arrays(part / "vertices.npz", {"vertices": np.zeros((0, 3), np.float32)})
        (part / "objects.json").write_text("[]\n", encoding="utf-8")
        text = json.dumps(_params(traced, paths, carrier_hz), indent=2)
        (part / PARAMS).write_text(f"{text}\n", encoding="utf-8")
    return folder


def _ranks(paths: Paths) -> IntArray:
    """Place [p] of each path among those of its pair: the line of sight first, as DeepMIMO's status of it wants."""
    pair = paths.rx * paths.n_tx + paths.tx
    order = np.lexsort((-np.abs(paths.gain), paths.bounces > 0, pair))
    ordered = pair[order]
    rank = np.empty(len(pair), np.int64)
    rank[order] = np.arange(len(pair)) - np.searchsorted(ordered, ordered)
    return rank


def _matrices(paths: Paths, carrier_hz: float) -> dict[str, NDArray[Any]]:
    """Matrices by DeepMIMO's names with first axis p: dBW, degrees, seconds, metres."""
    # Gains are without the carrier's phase, which DeepMIMO expects; whole turns are removed before the exponential.
    delay = paths.length_m / speed_of_light
    phase = np.angle(paths.gain * np.exp(-2j * np.pi * np.remainder(carrier_hz * delay, 1)), deg=True)
    # From the base station: the interactions of a path backwards.
    depth, bounces = paths.interactions.shape[1], paths.bounces
    used = max(1, int(bounces.max()))
    backwards = np.arange(len(paths))[:, None], bounces[:, None] - 1 - np.arange(depth)
    kinds = np.where(backwards[1] >= 0, paths.interactions[backwards], 0)
    vertices = np.where(backwards[1][..., None] >= 0, paths.vertices_m[backwards], np.nan)
    # A decimal digit for each interaction, the first in the leading place.
    code = np.zeros(len(paths))
    for level in range(depth):
        digit = np.array([CODES[int(kind)] for kind in kinds[:, level]], float)
        code = np.where(kinds[:, level] != 0, 10 * code + digit, code)
    single = {
        "power": 20 * np.log10(np.abs(paths.gain)),
        "phase": phase,
        "delay": delay,
        **dict(zip(("aoa_az", "aoa_el"), _angles_deg(paths.departure), strict=True)),
        **dict(zip(("aod_az", "aod_el"), _angles_deg(paths.arrival), strict=True)),
        "inter_pos": vertices[:, :used],
    }
    # Codes are float64: a float32 holds seven digits.
    return {**{key: values.astype(np.float32) for key, values in single.items()}, "inter": code}


def _angles_deg(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Azimuth in (-180, 180] and zenith angle in [0, 180], degrees, of unit vectors [p, 3]."""
    x, y, z = directions.T
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(np.hypot(x, y), z))


def _params(traced: TraceResult, paths: Paths, carrier_hz: float) -> dict[str, Any]:
    options = traced.options
    rt_params = {
        "raytracer_name": "Sionna Ray Tracing",
        "raytracer_version": version("sionna-rt"),
        "frequency": carrier_hz,
        "max_path_depth": options.depth,
        "max_reflections": options.most_reflections,
        "max_diffractions": int(options.diffraction),
        "max_scattering": int(options.scattering),
        "max_transmissions": options.depth if options.transmission else 0,
        "diffuse_reflections": options.depth - 1 if options.scattering and options.reflection else 0,
        "diffuse_diffractions": 0,
        "diffuse_transmissions": 0,
        "diffuse_final_interaction_only": False,
        "diffuse_random_phases": False,
        "terrain_reflection": options.reflection,
        "terrain_diffraction": options.diffraction,
        "terrain_scattering": options.scattering,
        "num_rays": traced.rays,
        "ray_casting_method": "uniform",
        "synthetic_array": True,
        "ray_casting_range_az": 360.0,
        "ray_casting_range_el": 180.0,
        "gps_bbox": [0, 0, 0, 0],
        "raw_params": {"written_by": f"wrf-mi {__version__}", "phase": "with the carrier's exp(-j 2 pi f delay)"},
    }
    scene = {"num_scenes": 1, "n_objects": 0, "n_vertices": 0, "n_faces": 0, "n_triangular_faces": 0}
    sets = {
        "txrx_set_0": _set(STATIONS, "base_stations", paths.n_rx, paths.rx),
        "txrx_set_1": _set(USERS, "users", paths.n_tx, paths.tx),
    }
    scene_facts = {**scene, "representation": "hull"}
    return {"version": VERSION, "rt_params": rt_params, "txrx_sets": sets, "materials": {}, "scene": scene_facts}


def _set(number: int, name: str, count: int, reached: IntArray) -> dict[str, Any]:
    return {
        "name": name,
        "id_orig": number,
        "id": number,
        "is_tx": number == STATIONS,
        "is_rx": number == USERS,
        "num_points": count,
        "num_active_points": len(np.unique(reached)),
        "num_ant": 1,
        "dual_pol": False,
        "ant_rel_positions": [[0, 0, 0]],
        "array_orientation": [0, 0, 0],
        "grid_spacing": None,
    }
