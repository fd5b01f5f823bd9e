"""The nearest-neighbour blend and the scores, against closed forms and the published figures of the data."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from skimage.metrics import structural_similarity

from wrf_mi.baselines.idw import InverseDistance
from wrf_mi.core import InputError
from wrf_mi.report.metrics import ssim, summary

EXACT = 1e-12
PUBLISHED = 0.0005
"""The data's description gives three digits."""

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 3, 0], [50, 50, 0]], float)


def test_blend_by_hand():
    values = np.array([[1.0, 10], [2, 20], [3, 30], [1e9, 1e9]])
    # Distances from (0.5, 0, 0): 0.5, 0.5, sqrt(9.25); weights 4, 4, 1 / 9.25.
    expected = (4 * 1 + 4 * 2 + 3 / 9.25) / (8 + 1 / 9.25)
    blend = InverseDistance(k=3).fit(SQUARE, values).predict([[0.5, 0, 0]])
    assert blend == pytest.approx(np.array([[expected, 10 * expected]]), rel=EXACT)
    expected = (2 * 1 + 2 * 2 + 3 / 9.25**0.5) / (4 + 1 / 9.25**0.5)
    assert InverseDistance(k=3, power=1).fit(SQUARE, values).predict([[0.5, 0, 0]])[0, 0] == pytest.approx(expected)


def test_training_positions_give_their_own_value_and_twins_their_mean():
    positions = np.concatenate([SQUARE, SQUARE[:1]])
    values = np.array([1.0, 2, 3, 4, 5])
    blend = InverseDistance().fit(positions, values).predict(SQUARE)
    assert blend == pytest.approx([3, 2, 3, 4], rel=EXACT)


def test_fewer_rows_than_neighbours_and_single_precision():
    spectra = np.random.default_rng(0).random((2, 8, 9)).astype(np.float32)
    blend = InverseDistance(k=4).fit(SQUARE[:2], spectra).predict([[0.5, 0, 0]])
    assert blend.dtype == np.float32
    assert blend[0] == pytest.approx(spectra.mean(axis=0), abs=1e-6)  # float32 rounding


def test_tiny_distances_do_not_overflow():
    blend = InverseDistance(k=2, power=4).fit(SQUARE * 1e-100, [1.0, 2, 3, 4]).predict([[0.5e-100, 0, 0]])
    assert blend == pytest.approx([1.5], rel=EXACT)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 12), st.integers(1, 6), st.floats(0.5, 4), st.integers(0, 2**32 - 1))
def test_blend_lies_within_the_values_and_ignores_row_order_and_origin(n, k, power, seed):
    rng = np.random.default_rng(seed)
    positions, values, asked = rng.standard_normal((n, 3)), rng.standard_normal(n), rng.standard_normal((5, 3))
    blend = InverseDistance(k, power).fit(positions, values).predict(asked)
    assert (blend >= values.min() - EXACT).all()
    assert (blend <= values.max() + EXACT).all()
    shuffle = rng.permutation(n)
    other = InverseDistance(k, power).fit(positions[shuffle] + 1, values[shuffle]).predict(asked + 1)
    assert other == pytest.approx(blend, abs=1e-9)  # adding one rounds the positions


def test_bad_arguments_are_refused():
    with pytest.raises(InputError, match="neighbour"):
        InverseDistance(k=0)
    with pytest.raises(InputError, match="4 positions and 3 observations"):
        InverseDistance().fit(SQUARE, np.zeros(3))
    with pytest.raises(InputError, match="0 positions"):
        InverseDistance().fit(np.zeros((0, 3)), np.zeros(0))


def test_ssim_is_taken_image_by_image():
    rng = np.random.default_rng(1)
    prediction, truth = rng.random((2, 3, 8, 9)), rng.random((2, 3, 8, 9))
    scores = ssim(prediction, truth)
    assert scores.shape == (2, 3)
    assert scores[1, 2] == structural_similarity(truth[1, 2], prediction[1, 2], data_range=1.0)
    assert ssim(truth, truth) == pytest.approx(1, abs=EXACT)


def test_ssim_refuses_other_shapes_and_small_images():
    with pytest.raises(InputError, match="differ in shape"):
        ssim(np.zeros((2, 8, 8)), np.zeros((1, 8, 8)))
    with pytest.raises(InputError, match="at least 7 x 7"):
        ssim(np.zeros((2, 6, 8)), np.zeros((2, 6, 8)))


def test_summary_of_known_values():
    assert summary(np.arange(11).reshape(1, 11) ** 2) == {"median": 25.0, "mean": 35.0, "p10": 1.0, "p90": 81.0}
    with pytest.raises(InputError, match="no test rows"):
        summary([])


@pytest.fixture(scope="module")
def rfid_lab():
    if "WRF_MI_DATA" not in os.environ:
        pytest.skip("WRF_MI_DATA is not set: no measured spectra")
    folder = Path(os.environ["WRF_MI_DATA"]) / "rfid-lab"
    positions = np.loadtxt(folder / "tx_pos.csv", delimiter=",", skiprows=1)
    files = [folder / "spectrum" / f"{i:05d}.png" for i in range(1, len(positions) + 1)]
    spectra = np.stack([np.asarray(Image.open(f)) for f in files]) / np.float32(255)
    return folder, positions, spectra


def scores_of_blend(positions, spectra, train, test):
    blend = InverseDistance().fit(positions[train], spectra[train]).predict(positions[test])
    return ssim(blend, spectra[test])


def test_published_figure_of_the_authors_split(rfid_lab):
    folder, positions, spectra = rfid_lab
    train, test = (np.loadtxt(folder / f"{part}_index.txt", dtype=int) - 1 for part in ("train", "test"))
    assert summary(scores_of_blend(positions, spectra, train, test))["median"] == pytest.approx(0.978, abs=PUBLISHED)


def test_published_figures_of_the_blocked_split(rfid_lab):
    folder, positions, spectra = rfid_lab
    fold = np.loadtxt(folder / "blocked_folds.txt", dtype=int)
    pooled = [scores_of_blend(positions, spectra, fold != f, fold == f) for f in range(5)]
    scores = summary(np.concatenate(pooled))
    assert scores["median"] == pytest.approx(0.630, abs=PUBLISHED)
    assert (scores["p10"], scores["p90"]) == pytest.approx((0.40, 0.86), abs=10 * PUBLISHED)
