"""Choice of depth, rays and kinds of path by convergence: the error stays within the target."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.constants import speed_of_light
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, inside, receiver, room, write_xml

from wrf_mi.cli.main import main
from wrf_mi.core import InputError, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import rssi_dbm
from wrf_mi.receivers.instruments import SpectrumInstrument
from wrf_mi.runs.api import train
from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.convergence import choose_options, remainder

RX = receiver([3.1, 2.2, 1.5])
PLAIN = TraceOptions(transmission=False)
FINE = replace(PLAIN, depth=6, rays=1 << 16)
"""Three interactions more than for a target of 1.5 dB; each adds a third of the previous change."""


@pytest.fixture(scope="module")
def shoebox(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("shoebox"))


@pytest.fixture(scope="module")
def fine(shoebox: Any) -> np.ndarray:
    """Received power of ten positions in a much finer trace."""
    return rssi_dbm(trace_paths(shoebox, inside(10), RX, FINE).paths)


@pytest.mark.parametrize("target_db", [4.0, 1.5])
def test_error_is_within_the_target(target_db: float, shoebox: Any, fine: np.ndarray) -> None:
    """Compared with a much finer trace, also at positions outside the sample."""
    choice = choose_options(shoebox, inside(10)[:5], RX, target_db, PLAIN, kinds=())
    assert choice.reached
    assert choice.options.depth < FINE.depth
    coarse = rssi_dbm(trace_paths(shoebox, inside(10), RX, choice.options).paths)
    assert np.abs(coarse - fine).max() <= target_db


def test_smaller_error_takes_more_depth(shoebox: Any) -> None:
    # Two positions as in other tests: kernels of a single one are others, and compiling them takes seconds.
    rough, good = (choose_options(shoebox, inside(2), RX, db, PLAIN, kinds=()) for db in (8.0, 0.5))
    assert rough.options.depth < good.options.depth
    assert good.error_db < rough.error_db


@pytest.mark.slow
def test_diffraction_is_switched_on_where_it_counts(shoebox: Any, tmp_path: Path) -> None:
    """Not in a closed box; behind a partition that reaches the ceiling, where only paths round its edge arrive."""
    choice = choose_options(shoebox, inside(2), RX, 4.0, PLAIN, kinds=("diffraction",))
    assert not choice.options.diffraction
    parts = [trial.part for trial in choice.trials]
    assert parts[0] == "depth"
    assert parts[-1] == "diffraction"
    assert "scattering" not in parts
    alone, tx = room(tmp_path, PARTITION), np.array([[1.0, 2.0, 1.0]])
    shadow = choose_options(alone, tx, receiver([5.0, 2.0, 1.0]), 6.0, PLAIN, kinds=("diffraction",))
    assert shadow.options.diffraction


def test_remainder_of_a_geometric_series() -> None:
    """1 + 1/2 + 1/4 + ... has a remainder of its last term; an ended series none; a growing one an infinite one."""
    assert remainder([1.0, 0.5]) == pytest.approx(0.5)
    assert remainder([1.0, 0.0]) == 0
    assert remainder([0.5, 1.0]) == np.inf
    assert remainder([1.0]) == np.inf


def test_target_error_of_zero_is_refused(shoebox: Any) -> None:
    with pytest.raises(InputError, match="above 0"):
        choose_options(shoebox, inside(2), RX, 0.0, PLAIN)


def test_command_refuses_depth_or_rays_beside_a_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = ["trace", "laboratory", "rfid-lab", "--out", str(tmp_path / "run"), "--target-error", "2"]
    for more, named in ((["--depth", "2"], "--depth"), (["--rays", "auto"], "--rays")):
        assert main([*call, *more]) == 2
        assert named in capsys.readouterr().err
    assert main([*call[:-1], "0"]) == 2
    assert not (tmp_path / "run").exists()


def test_run_states_its_convergence(tmp_path: Path) -> None:
    scene = write_xml(tmp_path / "scene", SHOEBOX)
    rows = np.arange(6)
    record = Record(
        name="made-here",
        task="rssi",
        tx_pos_m=inside(6),
        receivers=(RX,),
        observation=np.full((1, 6), -50, np.float32) + rows.astype(np.float32),
        official=(rows[:4], rows[4:]),
        frequencies_hz=np.array([FREQUENCY_HZ]),
    )
    settings = ("target_error_db=8", "target_kinds=")
    folder = train(record, tmp_path / "run", "ray-tracing", scene=scene, settings=settings).folder
    stated = json.loads((folder / "convergence.json").read_text())
    assert stated["target_db"] == 8.0
    assert stated["error_db"] <= 8.0
    assert stated["options"].items() <= yaml.safe_load((folder / "config.yaml").read_text())["settings"].items()
    assert [t["value"] for t in stated["trials"] if t["part"] == "depth"][:2] == [1, 2]


def test_error_of_spectra_is_within_the_target(shoebox: Any) -> None:
    """Waves interfere at an array: spectra are judged beside power, also at a position outside the sample."""
    array_m = planar_array(4, 4, 0.5 * speed_of_light / FREQUENCY_HZ)
    instrument = SpectrumInstrument((replace(RX, array_m=array_m),), np.array([FREQUENCY_HZ]), size=(18, 36))
    target_db = 4.0
    here = inside(3)
    by_power = choose_options(shoebox, here[:2], RX, target_db, PLAIN, kinds=())
    choice = choose_options(shoebox, here[:2], RX, target_db, PLAIN, kinds=(), spectra=instrument.observe)
    assert by_power.judged_by == ("power",)
    assert by_power.spectrum_error is None
    assert all(trial.spectrum is None for trial in by_power.trials)
    assert choice.reached
    assert choice.options.depth >= by_power.options.depth
    fine = replace(FINE, depth=choice.options.depth + 1)
    coarse, true = (instrument.observe(trace_paths(shoebox, here, RX, o).paths)[0] for o in (choice.options, fine))
    error = np.linalg.norm(coarse - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() <= 10 ** (target_db / 20) - 1
    for trial in choice.trials[1:]:
        assert trial.spectrum is not None
        assert trial.change_db >= 20 * np.log10(1 + trial.spectrum) - 1e-12
    stated = json.loads(json.dumps(choice.plain()))
    assert stated["judged_by"] == ["power", "spectrum"]
    assert stated["spectrum_error"] == pytest.approx(10 ** (choice.error_db / 20) - 1)
