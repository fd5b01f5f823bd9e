"""Choice of depth, rays and kinds of path by convergence, and searches announced or refused by their length."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.constants import speed_of_light
from traced_rooms import FREQUENCY_HZ, PARTITION, inside, receiver, room

from wrf_mi.core import InputError, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import rssi_dbm
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.runs.api import train
from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.convergence import choose_options, remainder
from wrf_mi.tracing.paths import solve
from wrf_mi.tracing.search import chains as search

RX = receiver([3.1, 2.2, 1.5])
PLAIN = TraceOptions(transmission=False)
FINE = replace(PLAIN, depth=6, rays=1 << 16)
"""Three interactions more than for a target of 1.5 dB; each adds a third of the previous change."""


@pytest.fixture(scope="module")
def fine(shoebox):
    """Received power of ten positions in a much finer trace."""
    return rssi_dbm(trace_paths(shoebox, inside(10), RX, FINE).paths)


@pytest.mark.parametrize("target_db", [4.0, 1.5])
def test_error_is_within_the_target(target_db, shoebox, fine):
    """Compared with a much finer trace, also at positions outside the sample."""
    choice = choose_options(shoebox, inside(10)[:5], RX, target_db, PLAIN, kinds=())
    assert choice.reached
    assert choice.options.depth < FINE.depth
    coarse = rssi_dbm(trace_paths(shoebox, inside(10), RX, choice.options).paths)
    assert np.abs(coarse - fine).max() <= target_db


def test_smaller_error_takes_more_depth(shoebox):
    # Two positions as in other tests: kernels of a single one are others, and compiling them takes seconds.
    rough, good = (choose_options(shoebox, inside(2), RX, db, PLAIN, kinds=()) for db in (8.0, 0.5))
    assert rough.options.depth < good.options.depth
    assert good.error_db < rough.error_db
    with pytest.raises(InputError, match="above 0"):
        choose_options(shoebox, inside(2), RX, 0.0, PLAIN)


@pytest.mark.slow
def test_diffraction_is_switched_on_where_it_counts(shoebox, tmp_path):
    """Not in a closed box; behind a partition that reaches the ceiling, where only paths round its edge arrive."""
    choice = choose_options(shoebox, inside(2), RX, 4.0, PLAIN, kinds=("diffraction",))
    assert not choice.options.diffraction
    parts = [trial.part for trial in choice.trials]
    assert (parts[0], parts[-1]) == ("depth", "diffraction")
    assert "scattering" not in parts
    shaded = room(tmp_path, PARTITION), [[1.0, 2.0, 1.0]], receiver([5.0, 2.0, 1.0])
    assert choose_options(*shaded, 6.0, PLAIN, kinds=("diffraction",)).options.diffraction


def test_remainder_of_a_geometric_series():
    """1 + 1/2 + 1/4 + ... has a remainder of its last term; an ended series none; a growing one an infinite one."""
    series = [1.0, 0.5], [1.0, 0.0], [0.5, 1.0], [1.0]
    assert [remainder(changes) for changes in series] == pytest.approx([0.5, 0, np.inf, np.inf])


def test_command_refuses_depth_or_rays_beside_a_target(tmp_path, command):
    asked = ["trace", "laboratory", "--scene", "laboratory", "--out", tmp_path / "run", "--target-error"]
    for words, message in ((["2", "--depth", "2"], "--depth"), (["2", "--rays", "auto"], "--rays"), (["0"], "error")):
        command.refused([*asked, *words], message)
    assert not (tmp_path / "run").exists()


def test_run_states_its_convergence(shoebox_xml, tmp_path):
    power, hz = np.arange(-50, -44, dtype=np.float32)[None], np.array([FREQUENCY_HZ])
    split = np.arange(4), np.arange(4, 6)
    record = Record("made-here", "rssi", inside(6), (RX,), power, official=split, frequencies_hz=hz)
    settings = ("target_error_db=8", "target_kinds=")
    folder = train(record, "ray-tracing", out=tmp_path / "run", scene=shoebox_xml, settings=settings).folder
    convergence = json.loads((folder / "convergence.json").read_text())
    assert convergence["target_db"] == 8.0
    assert convergence["error_db"] <= 8.0
    assert convergence["options"].items() <= yaml.safe_load((folder / "config.yaml").read_text())["settings"].items()
    assert [t["value"] for t in convergence["trials"] if t["part"] == "depth"][:2] == [1, 2]


def test_error_of_spectra_is_within_the_target(shoebox):
    """Waves interfere at an array: spectra are judged beside power, also at a position outside the sample."""
    array_m, tx, target_db = planar_array(4, 4, 0.5 * speed_of_light / FREQUENCY_HZ), inside(3), 4.0
    instrument = Instrument("array", (replace(RX, array_m=array_m),), np.array([FREQUENCY_HZ]), size=(18, 36))
    by_power = choose_options(shoebox, tx[:2], RX, target_db, PLAIN, kinds=())
    choice = choose_options(shoebox, tx[:2], RX, target_db, PLAIN, kinds=(), spectra=instrument.observe)
    assert (by_power.judged_by, by_power.spectrum_error) == (("power",), None)
    assert all(trial.spectrum is None for trial in by_power.trials)
    assert choice.reached
    assert choice.options.depth >= by_power.options.depth
    fine = replace(FINE, depth=choice.options.depth + 1)
    coarse, true = (instrument.observe(trace_paths(shoebox, tx, RX, o).paths)[0] for o in (choice.options, fine))
    error = np.linalg.norm(coarse - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() <= 10 ** (target_db / 20) - 1
    assert all(trial.change_db >= 20 * np.log10(1 + trial.spectrum) - 1e-12 for trial in choice.trials[1:])
    convergence = json.loads(json.dumps(choice.plain()))
    assert convergence["judged_by"] == ["power", "spectrum"]
    assert convergence["spectrum_error"] == pytest.approx(10 ** (choice.error_db / 20) - 1)


IMMEDIATE_S = 5.0  # More than a refusal takes on a busy machine, and less than the shortest search that is refused


@pytest.mark.parametrize(
    "options",
    [
        *(TraceOptions(depth=3, rays=64), TraceOptions(depth=2, reflection=False, rays=64)),
        *(TraceOptions(depth=4, reflections=count, transmission=True, rays=64) for count in (2, 0)),
    ],
)
def test_estimate_counts_the_hits_of_the_search(options, shoebox, monkeypatch):
    counts, shoot = [0], search._shoot

    def counted(scene, surfaces, directions, source_m, depth, *arguments):
        counts[0] += directions.shape[1] * depth
        return shoot(scene, surfaces, directions, source_m, depth, *arguments)

    monkeypatch.setattr(search, "_shoot", counted)
    monkeypatch.setattr(search, "_kept", type(search._kept)())
    solve.Prepared(shoebox).chains(inside(2), options, 64)
    assert counts[0] == 2 * search.hits(options, 64)


def test_search_of_hours_is_refused_before_it_begins(shoebox):
    begun, options = time.perf_counter(), TraceOptions(depth=12, rays=1 << 24)
    with pytest.raises(InputError, match=r"12 reflections: about \d+\.\d hours; give a smaller --depth .12"):
        solve.trace_paths(shoebox, inside(3), RX, options)
    assert time.perf_counter() - begun < IMMEDIATE_S


def test_search_of_seconds_is_announced_once(shoebox, monkeypatch, caplog):
    options, prepared, rx = TraceOptions(depth=2, rays=64), solve.Prepared(shoebox), receiver([4.0, 3.0, 2.0])
    monkeypatch.setattr(search, "SECONDS_PER_HIT", 20.0 / search.hits(options, 64))
    for seed in range(2):
        solve.trace_paths(shoebox, inside(3, seed), rx, options, prepared=prepared)
    message = "search for paths with up to 2 reflections: about 20 s; faster with a smaller --depth"
    assert caplog.text.count(message) == 1
    caplog.clear()
    monkeypatch.setattr(search, "WARN_S", 30.0)
    solve.trace_paths(shoebox, [[1.0, 1.0, 1.0]], receiver([4.0, 2.0, 2.0]), options)
    assert caplog.text == ""
