"""A field that generates spectra is recovered from them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_spectra import spectra

from wrf_mi.core import Split
from wrf_mi.core.settings import with_settings
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.tasks.scores import ssim
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.loop import FitState
from wrf_mi.training.trainer import Trainer

RECOVERED = 0.97
"""Median similarity on transmitters never trained on. The nearest-neighbour blend stays below 0.91 there."""


def recover(model: str, steps: int, rows: int, **size: Any) -> tuple[float, float, float]:
    """Median similarity on held-out transmitters before and after training, and the blend's.

    Training starts from the parameters that made the spectra, each disturbed by a tenth of its group's spread
    (centres: 5 cm of 1 to 4 m; log scales, rotations and logits: 0.1).
    """
    record, field, params = spectra(model, rows=rows, **size)
    split = Split("own", 0, np.arange(rows - 14), np.arange(rows - 14, rows - 10), np.arange(rows - 10, rows))
    config = with_settings(
        TrainConfig(model=model),
        [f"steps={steps}", "batch=4", "holdout_steps_fraction=1", "density.every=0", "optimiser.network=3e-4",
         "optimiser.ema_decay=0.99", "log_every=500"],
    )  # fmt: skip
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

    def score() -> float:
        return float(np.median(ssim(trainer.predictor()(tx[split.test]), truth)))

    before = score()
    trainer.run()
    known = split.all_train
    blend = InverseDistance().fit(tx[known], record.observation[0, known]).predict(tx[split.test])
    return before, score(), float(np.median(ssim(blend, truth)))


@pytest.mark.parametrize(("model", "steps"), [("wrf-gs", 700), ("wrf-gs+", 1200)])
def test_field_is_recovered_from_its_spectra(model: str, steps: int) -> None:
    """The parameters are recovered where interpolation of spectra does not suffice."""
    before, after, blend = recover(model, steps=steps, rows=94)
    assert before < 0.93
    assert blend < 0.93
    assert after > RECOVERED


@pytest.mark.slow
@pytest.mark.parametrize(("model", "width"), [("wrf-gs", 128), ("wrf-gs+", 256)])
def test_field_of_the_papers_width_is_recovered(model: str, width: int) -> None:
    """More Gaussians, layers as wide as the paper's, and pixels of two degrees: a minute for the two."""
    before, after, blend = recover(model, steps=2500, rows=94, size=(45, 180), count=24, width=width)
    assert before < 0.93
    assert after > max(RECOVERED, blend + 0.015)
