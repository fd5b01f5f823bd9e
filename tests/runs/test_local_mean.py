"""Scores of local mean powers over some wavelengths."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from made_building import building
from scipy.constants import speed_of_light

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.datasets import write_ble_folder
from wrf_mi.runs.api import train
from wrf_mi.runs.local_mean import LocalMean, _carriers_hz, local_mean_dbm, local_mean_scores
from wrf_mi.tasks.scores import signed_errors_db

CARRIER_HZ = 2.44e9
EXACT = 1e-12  # float64
FLOAT32_DB = 1e-4


def faded(rows: int = 600, apart_m: float = 0.03) -> Record:
    """Rayleigh fading about the power of free space along a line, a row each few centimetres; every other row trains.

    The receiver is 30 m away, so that the mean power hardly changes along the line.
    """
    x_m, rng = np.arange(rows) * apart_m, np.random.default_rng(0)
    place_m = np.stack([x_m, np.zeros(rows), np.ones(rows)], axis=1)
    receivers = tuple(
        Receiver(name, np.array([x, 30.0, 2.0]), np.array(UPRIGHT)) for name, x in (("anchor1", 0.0), ("anchor2", 9.0))
    )
    distance_m = np.stack([np.linalg.norm(place_m - receiver.position_m, axis=1) for receiver in receivers])
    power_dbm = -40 - 20 * np.log10(distance_m) + 10 * np.log10(rng.exponential(size=distance_m.shape))
    official = np.arange(0, rows, 2), np.arange(1, rows, 2)
    observed = power_dbm.astype(np.float32)
    observed[1, 5:40] = np.nan
    return Record(
        "line", "rssi", place_m, receivers, observed, official=official, frequencies_hz=np.array([CARRIER_HZ])
    )


def run_of(record: Record, folder: Path) -> Path:
    return train(write_ble_folder(folder / "data", record), "mri", out=folder / "run").folder


def test_local_mean_is_that_of_milliwatts_within_the_window() -> None:
    rng = np.random.default_rng(0)
    power_dbm, place_m, diameter_m = rng.normal(-70, 9, (2, 40)), rng.uniform(0, 3, (40, 3)), 1.4
    mean_dbm, count = local_mean_dbm(power_dbm, place_m, diameter_m)
    for row in range(40):
        near = np.linalg.norm(place_m - place_m[row], axis=1) <= diameter_m / 2
        assert count[row] == near.sum()
        expected = 10 * np.log10(np.mean(10 ** (power_dbm[:, near] / 10), axis=1))
        np.testing.assert_allclose(mean_dbm[:, row], expected, rtol=EXACT)


def test_scores_are_of_the_averages_of_each_receiver(tmp_path: Path) -> None:
    record, wavelengths = faded(rows=120), 2.0
    run = run_of(record, tmp_path)
    scores = local_mean_scores(run, wavelengths)
    window_m = wavelengths * speed_of_light / CARRIER_HZ
    assert scores.diameter_m == pytest.approx((window_m, window_m))
    with np.load(run / "predictions.npz") as stored:
        place_m, both = stored["tx_pos"], np.stack([stored["prediction"], stored["truth"]]).astype(float)
    pairs = []
    for receiver in range(2):
        rows = np.flatnonzero(np.isfinite(both[1, receiver]))
        mean_dbm, count = local_mean_dbm(both[:, receiver, rows], place_m[rows], window_m)
        pairs.append(mean_dbm[:, count > 1])
    predicted, measured = np.concatenate(pairs, axis=1)
    assert scores.count == len(predicted)
    assert {key: scores.score[key] for key in ("bias", "std", "rmse")} == pytest.approx(
        signed_errors_db(predicted, measured), abs=FLOAT32_DB
    )
    assert scores.score["median"] == pytest.approx(np.median(np.abs(predicted - measured)), abs=FLOAT32_DB)


def test_fading_averages_out_over_wavelengths(tmp_path: Path) -> None:
    """Powers of Rayleigh fading have a standard deviation of 5.57 dB, means of n of them less by about sqrt(n)."""
    run = run_of(faded(), tmp_path)
    short, long = (local_mean_scores(run, wavelengths) for wavelengths in (5, 20))
    assert short.single["std"] == pytest.approx(5.57, abs=0.6)
    assert long.rows > short.rows > 5
    assert long.score["std"] < short.score["std"] < short.single["std"] / 2


def test_rows_without_another_one_in_the_window_are_said_in_a_line(tmp_path: Path, command: Command) -> None:
    run = run_of(building(), tmp_path)
    line = "local mean power over 0.1 wavelengths (0.012 m): no test row has another one in its window"
    assert line in command.done(["evaluate", run, "--local-mean", "0.1"])
    scores = local_mean_scores(run, 0.1)
    assert scores == LocalMean(0.1, scores.diameter_m)
    assert scores.diameter_m == pytest.approx((0.0123, 0.0123), abs=1e-4)


def test_command_shows_windows_in_turn(tmp_path: Path, command: Command) -> None:
    run = run_of(faded(rows=120), tmp_path)
    out = command.done(["evaluate", run, "--local-mean", "5,10"])
    lines = [line for line in out.splitlines() if line.startswith("local mean power over ")]
    assert [line.partition(":")[0].split(" over ")[1] for line in lines] == [
        "5 wavelengths (0.61 m)",
        "10 wavelengths (1.2 m)",
    ]
    (block,) = command.json(["evaluate", run, "--local-mean", "5", "--json"])["local_mean"]
    assert f"median absolute error {block['score']['median']:.3f} dB" in lines[0]
    assert "local_mean" not in json.loads((run / "metrics.json").read_text())


def test_receivers_have_windows_of_their_carriers() -> None:
    record = faded(rows=8)
    other = replace(record.receivers[1], frequency_hz=9e8)
    two = replace(record, receivers=(record.receivers[0], other))
    np.testing.assert_array_equal(_carriers_hz(two, np.arange(3)), [[CARRIER_HZ] * 3, [9e8] * 3])
    unknown = replace(record, frequencies_hz=None)
    with pytest.raises(InputError, match="carrier frequency unknown; state frequency_hz"):
        _carriers_hz(unknown, np.arange(3))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--local-mean", "far"], "--local-mean far: give numbers of wavelengths"),
        (["--local-mean", "0"], "local mean over 0 wavelengths: choose a positive number"),
        (["--local-mean", "5", "--split", "random"], "--local-mean is of the run's own test rows"),
    ],
)
def test_bad_windows_are_one_line(words: list[str], message: str, tmp_path: Path, command: Command) -> None:
    command.refused(["evaluate", run_of(building(), tmp_path), *words], message)
