"""Spectra of a field at any receiver, pose and size, and its recovery from spectra."""

import numpy as np
import pytest
from made_spectra import RECEIVERS, SIZE, spectra, true_field
from small_fits import official, settings

from wrf_mi.core import InputError, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.estimators.interpolation.idw import InverseDistance
from wrf_mi.tasks.scores import ssim
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.loop import FitState
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.trainer import Trainer

FLOAT32_TOLERANCE = 1e-4
"""Greys of one field computed on two ways: float32 rounding, and footprints' cut-off, which is worth 0.01."""


def test_predictor_of_other_receivers_and_sizes():
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


def test_invalid_positions_are_refused():
    predict = Predictor.of_field(*true_field("wrf-gs+"), RECEIVERS, *SIZE)
    for positions, message in (
        (np.zeros(3), r"expected shape \[m, 3\], got \[3\]"),
        (np.zeros((2, 4)), r"expected shape \[m, 3\], got \[2, 4\]"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), "row 2: not a finite number"),
    ):
        with pytest.raises(InputError, match=message):
            predict(positions)


def test_predictions_are_recorded_once(one_gateway):
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


RECOVERED = 0.97
"""Median similarity on transmitters never trained on. The nearest-neighbour blend stays below 0.91 there."""


def recover(model, steps, rows, **size):
    """Median similarity on held-out transmitters before and after training, and the blend's.

    Training starts from the parameters that made the spectra, each disturbed by a tenth of its group's spread
    (centres: 5 cm of 1 to 4 m; log scales, rotations and logits: 0.1).
    """
    record, field, params = spectra(model, rows=rows, **size)
    split = Split("own", 0, np.arange(rows - 14), np.arange(rows - 14, rows - 10), np.arange(rows - 10, rows))
    config = with_settings(
        TrainConfig(model=model),
        [
            *(f"steps={steps}", "batch=4", "holdout_steps_fraction=1", "density.every=0", "log_every=500"),
            *("optimiser.network=3e-4", "optimiser.ema_decay=0.99"),
        ],
    )
    trainer = Trainer(record, split, config, field=field)
    rng = np.random.default_rng(7)
    spread = {"position": 0.5, "log_scale": 1.0, "rotation": 1.0, "opacity": 1.0}
    trainer.state = FitState(
        {
            name: (values + 0.1 * spread.get(name, values.std()) * rng.standard_normal(values.shape)).astype(np.float32)
            for name, values in params.items()
        }
    )
    trainer.record_functions()
    truth, tx = record.observation[0, split.test], record.tx_pos_m

    def score():
        return float(np.median(ssim(trainer.predictor()(tx[split.test]), truth)))

    before = score()
    trainer.run()
    known = split.all_train
    blend = InverseDistance().fit(tx[known], record.observation[0, known]).predict(tx[split.test])
    return before, score(), float(np.median(ssim(blend, truth)))


@pytest.mark.parametrize(("model", "steps"), [("wrf-gs", 500), ("wrf-gs+", 1200)])
def test_field_is_recovered_from_its_spectra(model, steps):
    """The parameters are recovered where interpolation of spectra does not suffice."""
    before, after, blend = recover(model, steps=steps, rows=94)
    assert before < 0.93
    assert blend < 0.93
    assert after > RECOVERED


@pytest.mark.slow
@pytest.mark.parametrize(("model", "width"), [("wrf-gs", 128), ("wrf-gs+", 256)])
def test_field_of_the_papers_width_is_recovered(model, width):
    """More Gaussians, layers as wide as the paper's, and pixels of two degrees: a minute for the two."""
    before, after, blend = recover(model, steps=2500, rows=94, size=(45, 180), count=24, width=width)
    assert before < 0.93
    assert after > max(RECOVERED, blend + 0.015)
