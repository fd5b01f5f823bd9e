"""Synthetic data sets in folders: made once for their parameters, with a LiDAR scan and a scene as measured."""

from __future__ import annotations

import io
import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from wrf_mi_scenes.mitsuba_xml import Parts, write_scene

from ..core import Record
from ..datasets import load, user_cache
from ..datasets.registry import locate
from ..scene.scan import simulate_scan

logger = logging.getLogger(__name__)

RECIPE = "traced.yml"  # file with the parameters of a folder's data; other parameters make them anew
SCAN = "lidar/points.npz"  # file with the simulated LiDAR scan of the scene
SCANNED_RAYS = 60_000
Files = dict[str, str | bytes]  # content of files by their paths in a folder


def stored(
    name: str,
    folder: str | Path | None,
    facts: Mapping[str, Any],
    write: Callable[[Path, Files], None],
    read: Callable[[Path, str], Record],
) -> Record:
    """The record of a name in a folder, which is made unless it holds data of the same parameters, ``facts``.

    Without a folder it is the one of this name below ``WRF_MI_DATA`` if it exists, as it is, else in the user's cache.
    ``write`` makes the data, of a folder and the file that states the parameters, which comes last: without it the data
    are made again. ``read`` reads them, of a folder and a name.
    """
    if folder is None:
        location = locate(name)
        if location is not None and location.parent != user_cache():
            return replace(load(location), name=name)
        folder = user_cache() / name
    folder = Path(folder)
    recipe = yaml.safe_dump({**facts, "sionna_rt": version("sionna-rt")}, sort_keys=False)
    content = None
    with suppress(OSError, ValueError, yaml.YAMLError):  # the data are not there, or written in part
        content = yaml.safe_load((folder / RECIPE).read_text(encoding="utf-8"))
    if content != yaml.safe_load(recipe):
        logger.info("tracing %s into %s", name, folder)
        write(folder, {RECIPE: recipe})
    return read(folder, name)


def scan_file(xml: Path, seed: int, scanner_m: Sequence[tuple[float, float, float]]) -> Files:
    """The file `SCAN` of a scene, from some positions of the LiDAR, metres."""
    points = simulate_scan(xml, scanner_m, rays_per_pose=SCANNED_RAYS, seed=seed)
    stream = io.BytesIO()
    np.savez_compressed(stream, points=points.astype(np.float32))
    return {SCAN: stream.getvalue()}


def scene_files(parts: Parts, folder: str, origin: str) -> Files:
    """The files of a measured scene in a folder; ``origin`` is the module of its parts."""
    with tempfile.TemporaryDirectory() as work:
        write_scene(Path(work), parts, "Bare walls as measured, one material", origin)
        files = sorted(file for file in Path(work).rglob("*") if file.is_file())
        return {f"{folder}/{file.relative_to(work).as_posix()}": file.read_bytes() for file in files}
