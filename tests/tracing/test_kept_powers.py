"""Powers kept on the disk are those traced, and are read only for the same scene, positions and antennas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traced_rooms import SHOEBOX, inside, receiver, room

from wrf_mi.core import Antenna
from wrf_mi.core.angles import FloatArray
from wrf_mi.receivers import rssi_dbm
from wrf_mi.tracing import TraceOptions, power_map, trace_paths
from wrf_mi.tracing.paths.solve import Prepared

OPTIONS = TraceOptions(transmission=True, depth=1)
POSITIONS, CENTRE = inside(5), (3.0, 2.0, 1.5)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(power_map, "user_cache", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def powers(scene: Any, positions: FloatArray = POSITIONS, **changed: Any) -> FloatArray:
    given = {"receivers": [receiver(CENTRE)], "options": OPTIONS, "tx_antenna": Antenna(), **changed}
    return power_map.traced_powers(Prepared(scene), positions, **given)


def test_kept_powers_are_those_traced(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = room(tmp_path)
    expected = rssi_dbm(trace_paths(scene, POSITIONS, [receiver(CENTRE)], OPTIONS).paths)
    np.testing.assert_allclose(powers(scene), expected, rtol=1e-6)
    assert len(list(cache.rglob("*.npz"))) == 1
    monkeypatch.setattr(power_map, "trace_paths", None)
    np.testing.assert_allclose(powers(scene), expected, rtol=1e-6)


def test_another_scene_position_antenna_or_depth_is_traced(tmp_path: Path, cache: Path) -> None:
    scene = room(tmp_path / "one")
    powers(scene)
    powers(scene, POSITIONS[:4])
    powers(scene, tx_antenna=Antenna("dipole"))
    powers(scene, options=replace(OPTIONS, reflections=0))
    powers(scene, receivers=[receiver(CENTRE, "other")])
    higher = {name: (kind, mesh.copy().apply_translation([0, 0, 1e-3])) for name, (kind, mesh) in SHOEBOX.items()}
    powers(room(tmp_path / "two", higher))
    softer = {name: ("itu_wood", mesh) for name, (_, mesh) in SHOEBOX.items()}
    powers(room(tmp_path / "three", softer))
    assert len(list(cache.rglob("*.npz"))) == 7
