"""Spectra of a field at any receiver, pose and size."""

from __future__ import annotations

import numpy as np
import pytest
from made_spectra import RECEIVERS, SIZE, true_field
from small_fits import official, settings

from wrf_mi.core import InputError, Record
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.trainer import Trainer

FLOAT32_TOLERANCE = 1e-4
"""Greys of one field computed on two ways: float32 rounding, and footprints' cut-off, which is worth 0.01."""


def test_predictor_of_other_receivers_and_sizes() -> None:
    field, params = true_field("wrf-gs")
    tx = np.random.default_rng(5).uniform(-1, 1, (3, 3))
    both = Predictor.of_field(field, params, RECEIVERS, *SIZE)
    for r, receiver in enumerate(RECEIVERS):
        alone = Predictor.of_field(field, params, [receiver], *SIZE)(tx)
        np.testing.assert_array_equal(both(tx, r), alone)
        np.testing.assert_array_equal(both(tx, receiver.name), alone)
        # Pixels are points: twice the size has the same directions at every other pixel.
        double = Predictor.of_field(field, params, [receiver], 2 * SIZE[0], 2 * SIZE[1])(tx)
        np.testing.assert_allclose(double[:, ::2, ::2], alone, atol=FLOAT32_TOLERANCE)
    assert np.abs(both(tx, 0) - both(tx, 1)).max() > 0.01
    # One by one or together.
    np.testing.assert_array_equal(np.concatenate([both(t[None], 0) for t in tx]), both(tx, 0))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (np.zeros(3), r"expected shape \[m, 3\], got \[3\]"),
        (np.zeros((2, 4)), r"expected shape \[m, 3\], got \[2, 4\]"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), "row 2: not a finite number"),
    ],
)
def test_invalid_positions_are_refused(positions: np.ndarray, message: str) -> None:
    field, params = true_field("wrf-gs+")
    with pytest.raises(InputError, match=message):
        Predictor.of_field(field, params, RECEIVERS, *SIZE)(positions)


def test_predictions_are_recorded_once(one_gateway: Record) -> None:
    """For one transmitter or many, before training and after."""
    trainer = Trainer(one_gateway, official(one_gateway), settings("steps=5"))
    predictor = trainer.predictor()
    before = predictor(one_gateway.tx_pos_m[:3])
    trainer.run()
    assert trainer.predictor() is predictor
    after = predictor(one_gateway.tx_pos_m[:3])
    assert np.abs(after - before).max() > 0
    recorded = predictor.evaluate.recordings.values()
    assert 1 <= sum(one.frozen.n_recordings for one in recorded) <= 2  # new ones for other memory layouts are no harm
