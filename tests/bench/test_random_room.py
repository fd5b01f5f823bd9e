"""Random rooms: what a seed fixes, and what rooms and their channels promise."""

from pathlib import Path

import numpy as np
import pytest
from wrf_mi_bench.random_room import SNR_DB, Survey, random_room_record
from wrf_mi_scenes.mitsuba_xml import PERFECT
from wrf_mi_scenes.random_rooms import CLEAR_M, FEWEST, HEIGHTS_M, LEAST_M, MOST, MOST_M, MOUNTED_M, MOUNTS, random_room

from wrf_mi.core import Record

ROOMS = [random_room(seed) for seed in range(200, 240)]
SMALL = Survey(train=30, test=4, rays=10_000)


def test_rooms_keep_their_bounds():
    for room in ROOMS:
        low, high = (
            getattr(np, what)([m.bounds[k] for _, m in room.parts.values()], axis=0)
            for k, what in enumerate(("min", "max"))
        )
        np.testing.assert_allclose(low, 0, atol=1e-12)
        np.testing.assert_allclose(high, room.size_m)
        assert ((np.array(room.size_m[:2]) >= LEAST_M) & (np.array(room.size_m[:2]) <= MOST_M)).all()
        assert HEIGHTS_M[0] <= room.size_m[2] <= HEIGHTS_M[1]
        assert FEWEST <= len(room.parts) - 6 <= MOST


def test_furniture_and_access_point_stand_apart():
    for room in ROOMS:
        boxes = [mesh.bounds for name, (_, mesh) in room.parts.items() if name.startswith("piece")]
        for index, one in enumerate(boxes):
            assert (np.maximum(one[0] - room.station_m, room.station_m - one[1]).max()) >= CLEAR_M - 1e-4
            for other in boxes[:index]:
                assert np.maximum(one[0] - other[1], other[0] - one[1])[:2].max() > 0
        walls = np.concatenate([room.station_m, np.subtract(room.size_m, room.station_m)])
        assert walls.min() == pytest.approx(MOUNTED_M, abs=1e-4) if room.mount != "free" else walls.min() > MOUNTED_M


def test_rooms_differ_in_mount_and_materials():
    assert {room.mount for room in ROOMS} == set(MOUNTS)
    perfect = [{material for material, _ in room.parts.values()} == {PERFECT} for room in ROOMS]
    assert perfect == [room.perfect for room in ROOMS]
    assert 0 < sum(perfect) < len(ROOMS) / 2


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path, Path]:
    return random_room_record(103, tmp_path_factory.mktemp("room"), SMALL)


def test_a_seed_fixes_channels_and_scan(made, tmp_path):
    record, _, scan = made
    again, _, other = random_room_record(103, tmp_path, SMALL)
    np.testing.assert_array_equal(record.observation, again.observation)
    np.testing.assert_array_equal(record.tx_pos_m, again.tx_pos_m)
    one, two = (sorted((path / "meshes").iterdir()) for path in (scan, other))
    assert [file.read_bytes() for file in one] == [file.read_bytes() for file in two]


def test_noise_has_the_stated_power(made):
    record, *_ = made
    noise = np.square(np.abs(record.observation - record.truth)).mean(axis=2)
    signal = np.square(np.abs(record.truth)).mean(axis=2)
    assert 10 * np.log10((signal / noise).mean()) == pytest.approx(SNR_DB, abs=1.5)
