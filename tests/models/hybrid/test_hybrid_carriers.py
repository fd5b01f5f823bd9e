"""The hybrid at a carrier without training rows: one of the other carriers is held out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wrf_mi
from wrf_mi.core import Record
from wrf_mi.datasets import load, make_splits
from wrf_mi.training.selection import hold_out

CARRIERS_HZ = (0.9e9, 1.8e9, 2.4e9, 3.5e9)


@pytest.fixture(scope="module")
def bands(flat_folder: Path) -> Record:
    """Signal strengths of equal positions at four carriers, lower by 6 dB an octave."""
    record = replace(load(flat_folder), official=None)
    loss_db = [20 * np.log10(hz / CARRIERS_HZ[0]) for hz in CARRIERS_HZ]
    return Record(
        "bands",
        "rssi",
        np.tile(record.tx_pos_m, (4, 1)),
        record.receivers,
        np.concatenate([record.observation - loss for loss in loss_db], axis=1).astype(np.float32),
        carriers_hz=np.repeat(CARRIERS_HZ, len(record)),
    )


@pytest.mark.parametrize("known", [True, False])
def test_a_carrier_is_held_out_as_the_split_does(bands: Record, known: bool) -> None:
    """A trained one; its held-out rows' positions remain in training only where the test rows' do."""
    split = make_splits(bands, "frequency-known:2" if known else "frequency:2")[0]
    fold = hold_out(bands, split)
    trained, held = fold.all_train, fold.test
    assert set(trained) | set(held) <= set(split.all_train)
    assert len(set(bands.carriers_hz[held])) == 1
    assert not set(bands.carriers_hz[held]) & set(bands.carriers_hz[trained])
    places = [set(map(tuple, bands.tx_pos_m[rows])) for rows in (held, trained)]
    assert places[0] <= places[1] if known else not places[0] & places[1]


def test_a_carrier_between_others_is_predicted_with_intervals(bands: Record, tmp_path: Path) -> None:
    """Strengths are linear in the logarithm of the frequency, so that interpolation has the error of one carrier."""
    run = wrf_mi.train(bands, tmp_path / "run", split="frequency-known:2")
    assert run.metrics["abs_error_db"]["median"] < 0.5  # positions are known at the other carriers
    assert 0.5 < run.metrics["inside_90"] <= 1
    again = wrf_mi.open_run(run.folder, bands)
    position, carrier = bands.tx_pos_m[:3], np.full(3, 2.4e9)
    found = again.predict(position, 0, carriers_hz=carrier).mean
    assert found == pytest.approx(run.predict(position, 0, carriers_hz=carrier).mean)
