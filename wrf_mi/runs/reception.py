"""Scores of probabilities of reception beside those of two references."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction, Record, Split
from ..estimators.reception import ReceivedShares
from ..tasks.scores import calibration_bins, probability_scores
from .results import RECEPTION

RUN = "run"  # array of ``predictions.npz``: names of the runs of the measurement that test rows are of [m]
REFERENCES = ("reception_rate", "reception_neighbours")
"""Arrays of ``predictions.npz``: the share of the training rows that a receiver received, and of the nearest ones."""


def reception_arrays(
    record: Record, split: Split, truth: NDArray[Any], stated: Mapping[int, Prediction]
) -> dict[str, NDArray[np.float32]]:
    """Probabilities of reception [n_rx, m] by a model and by two references; NaN where the truth is not scored."""
    shares, rows = ReceivedShares(record, split.all_train), split.test
    arrays = {key: np.full(truth.shape, np.nan, np.float32) for key in (RECEPTION, *REFERENCES)}
    for receiver, prediction in stated.items():
        near = shares.near(record.tx_pos_m[rows], receiver)[0]
        is_scored = np.isfinite(truth[receiver]) | np.isnan(record.scored[receiver, rows])
        for values, probability in zip(
            arrays.values(), (prediction.reception, shares.rate[receiver], near), strict=True
        ):
            values[receiver] = np.where(is_scored, probability, np.nan)
    return arrays


def reception_block(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Block ``reception`` of ``metrics.json``: scores, those of the references, and the reliability in bins.

    Where test rows are of several runs of the measurement, ``runs`` has the same scores of each.
    """
    is_scored = np.isfinite(arrays[RECEPTION])
    block = _scores(arrays, is_scored)
    runs = arrays.get(RUN, np.zeros(is_scored.shape[1], str))
    if len(names := np.unique(runs)) > 1:
        of_runs = {str(name): is_scored & (runs == name) for name in names}
        block["runs"] = {name: _scores(arrays, pairs) for name, pairs in of_runs.items() if pairs.any()}
    return block


def _scores(arrays: Mapping[str, Any], pairs: NDArray[np.bool_]) -> dict[str, Any]:
    """Block of some pairs of a receiver and a row [n_rx, m]; see `reception_block`."""
    received = np.isfinite(arrays["truth"][pairs])
    probability, *others = (arrays[key][pairs].astype(float) for key in (RECEPTION, *REFERENCES))
    bins = zip(*calibration_bins(probability, received), strict=True)
    return {
        "received": float(received.mean()),
        **probability_scores(probability, received),
        "reference": {
            key: probability_scores(values, received) for key, values in zip(REFERENCES, others, strict=True)
        },
        "bins": [list(map(float, row)) for row in bins if row[2]],
    }
