"""Channels of a random room (`wrf_mi_scenes.random_rooms`), and a scene made from its own misregistered scan.

One antenna at an access point, eight subcarriers over 80 MHz at 2.44 GHz, noise. Paths: line of sight, reflections and
transmissions, three at most. The scan is simulated from some positions in the room; it is displaced and turned against
the frame of the devices as a whole, and each of its positions a little more, as registration leaves it. The scene is
made of the scan by the pipeline of the command ``mesh``, with the materials of the default rules.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.core import Receiver, Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.array_files import write_arrays
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.scan import simulate_scan
from wrf_mi.synthetic.floor_channels import with_noise
from wrf_mi.synthetic.searches import free_positions
from wrf_mi.tasks import CSI
from wrf_mi.tracing.options import TraceOptions
from wrf_mi.tracing.sionna.scenes import open_scene
from wrf_mi.tracing.tracer import RayTracer

CARRIER_HZ = 2.44e9
SUBCARRIERS_HZ: FloatArray = CARRIER_HZ + np.linspace(-40e6, 40e6, 8)
OPTIONS = TraceOptions(transmission=True, depth=3, rays=1 << 18, seed=1)  # paths of the true channels


LOW_M, HIGH_M = 0.5, 2.0  # bounds of the transmitters' height
CLEAR_M, FROM_STATION_M = 0.1, 0.5  # least distances of transmitters from surfaces and from the access point
SNR_DB = 30.0
POSES = 4  # number of the LiDAR's positions
FRAME_M, FRAME_RAD = 0.055, 0.009  # length of the scan's displacement and angle of its rotation, in random directions
POSE_M, POSE_RAD = 0.01, 0.001
"""Standard deviations, along and about each axis, of the errors of each position of the LiDAR."""


@dataclass(frozen=True)
class Survey:
    """Numbers of training and test rows, and of rays at each position of the LiDAR."""

    train: int = 300
    test: int = 100
    rays: int = 60_000


DEFAULT = Survey()
SCANNER_CLEAR_M = 0.35  # least distance of the LiDAR from surfaces, metres


def random_room_record(
    seed: int, folder: str | Path, survey: Survey = DEFAULT, subcarriers_hz: FloatArray = SUBCARRIERS_HZ
) -> tuple[Record, Path, Path]:
    """Measure the room of a seed: its channels, and a scene made from a scan of it; all files go into ``folder``.

    The official split is the first ``train`` rows and the rest; positions are drawn independently.

    Returns:
        The record, with ``task="csi"`` and `Record.truth`; the scene file of the true room, for comparison only; and
        the scene folder made from the scan, the input of models.
    """
    folder, room = Path(folder), random_room(seed)
    true = write_scene(folder / "truth", room.parts, f"Random room {seed}", "wrf_mi_scenes.random_rooms")
    scene = open_scene(true.parent, CARRIER_HZ)
    station = np.array(room.station_m)
    count, rng = survey.train + survey.test, np.random.default_rng([seed, 1])
    bounds = np.array([[0.0, 0.0, LOW_M], [*room.size_m[:2], HIGH_M]])
    positions = free_positions(scene, bounds, count, CLEAR_M, rng, seed, (station, FROM_STATION_M))
    record = Record(
        f"random-room-{seed}",
        CSI,
        positions,
        (Receiver("access-point", station, np.array(UPRIGHT)),),
        np.zeros((1, count, len(subcarriers_hz)), np.complex64),
        official=(np.arange(survey.train), np.arange(survey.train, count)),
        frequencies_hz=subcarriers_hz,
    )
    channel = RayTracer(true.parent, Instrument("csi", record.receivers, subcarriers_hz), OPTIONS)(positions)[0]
    noisy = with_noise(channel[:, None], SNR_DB, np.random.default_rng([seed, 2]))[:, 0]
    poses = free_positions(scene, bounds, POSES, SCANNER_CLEAR_M, rng, seed)
    scan = write_arrays(folder / "scan.npz", {"points": _scan(true, poses, seed, survey).astype(np.float32)})
    measured = make_scene(scan, folder / "measured", replace=True).folder
    observed = noisy.astype(np.complex64)[None]
    return replace(record, observation=observed, truth=channel.astype(np.complex64)[None]), true.parent, measured


def _scan(xml: Path, poses_m: FloatArray, seed: int, survey: Survey) -> FloatArray:
    """Points [n, 3] in a frame that is off by the errors of the survey, metres."""
    rng, parts = np.random.default_rng([seed, 3]), []
    along, about = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    common = FRAME_M * along, Rotation.from_rotvec(FRAME_RAD * about)
    middle = poses_m.mean(axis=0)
    for number, pose in enumerate(poses_m):
        points = simulate_scan(xml, pose[None], rays_per_pose=survey.rays, seed=seed * len(poses_m) + number)
        turn = Rotation.from_rotvec(rng.normal(0, POSE_RAD, 3))
        points = turn.apply(points - pose) + pose + rng.normal(0, POSE_M, 3)
        parts.append(common[1].apply(points - middle) + middle + common[0])
    return np.concatenate(parts)
