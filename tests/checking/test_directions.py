"""Spectra in another reading of images, orientations and plans are suspected; reflections alone suggest none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checked_records import WALL, spectra, with_images, with_orientations
from scipy.spatial.transform import Rotation

from wrf_mi.checking.directions import brightness, reversed_share, spectrum_axes
from wrf_mi.core import Record

POSE = (Rotation.from_quat(WALL) * Rotation.from_euler("zx", [20, 30], degrees=True)).as_quat()
"""An array that is turned on its wall by 20 degrees and tilted by 30 degrees, so that no mirror image is the same."""


@pytest.fixture(scope="module")
def hall() -> Record:
    return spectra(orientation=POSE)


def test_the_stated_reading_is_not_suspected(hall: Record) -> None:
    assert brightness(hall).mean() > 0.95
    assert reversed_share(hall.observation) == 0
    assert list(spectrum_axes(hall)) == []


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("spread_m", [0.5, 4.0])
@pytest.mark.parametrize("direct", [0.0, 0.2])
def test_lobes_of_reflectors_suggest_no_other_reading(seed: int, spread_m: float, direct: float) -> None:
    """No line of sight, or a weak one, from transmitters in a small region or all around."""
    record = spectra(seed=seed, direct=direct, reflectors=1 + seed % 3, spread_m=spread_m)
    assert list(spectrum_axes(record)) == []


def test_rows_from_the_zenith_are_suspected(hall: Record) -> None:
    for record in (hall, spectra(30, direct=0.0, reflectors=4)):  # a line of sight is not needed
        reversed_rows = with_images(record, lambda s: s[:, :, ::-1])
        assert reversed_share(reversed_rows.observation) > 0.7
        ((name, text),) = spectrum_axes(reversed_rows)
        assert name == "spectrum-axes"
        assert text.startswith("image rows count from the zenith: in ")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda s: np.roll(s, s.shape[-1] // 2, axis=-1), "image columns count from -180 degrees"),
        (lambda s: np.roll(s[..., ::-1], 1, axis=-1), "image columns count clockwise"),
        (lambda s: np.roll(s[..., ::-1], 61, axis=-1), "image columns count clockwise from 180 degrees"),
    ],
)
def test_columns_with_another_origin_or_order_are_suspected(hall: Record, change, what: str) -> None:
    ((name, text),) = spectrum_axes(with_images(hall, change))
    assert (name, text.partition(":")[0]) == ("spectrum-axes", what)
    assert "of the hemisphere is then darker than the direction of the transmitter, as stated" in text
    both = [text for _, text in spectrum_axes(with_images(hall, lambda s: change(s)[:, :, ::-1]))]
    assert [text.partition(":")[0] for text in both] == ["image rows count from the zenith", what]


def test_transposed_images_are_suspected(hall: Record) -> None:
    ((name, text),) = spectrum_axes(with_images(hall, lambda s: s.swapaxes(2, 3)))
    assert name == "spectrum-axes"
    assert text.startswith("images have 120 rows and 30 columns")


def test_orientations_in_another_order_are_suspected(hall: Record) -> None:
    ((name, text),) = spectrum_axes(with_orientations(hall, lambda q: np.roll(q, 1)))
    assert name == "orientation"
    assert text.startswith("orientations are in the order w, x, y, z: ")


def test_an_array_that_looks_away_is_suspected(hall: Record) -> None:
    ((name, text),) = spectrum_axes(with_orientations(hall, lambda q: np.array([0.5, -0.5, -0.5, 0.5])))
    assert name == "orientation"
    assert text.startswith("all transmitters are behind the array of receiver gateway1, outside the hemisphere of ")


@pytest.mark.parametrize(
    ("matrix", "what"), [([[1, 0], [0, -1]], "y is mirrored"), ([[0, 1], [1, 0]], "x and y are swapped")]
)
def test_transmitters_in_another_plan_are_suspected(matrix: list[list[int]], what: str) -> None:
    """As a sign or two columns that are confused, in a hall that lies beside the x axis."""
    hall = spectra()
    moved = hall.tx_pos_m.copy()
    moved[:, :2] = moved[:, :2] @ np.array(matrix, float)
    found = dict(spectrum_axes(replace(hall, tx_pos_m=moved)))
    assert set(found) == {"plan"}
    assert found["plan"].startswith(f"transmitters are in another plan than receivers, {what}:")


def test_few_rows_and_few_places_are_no_evidence(hall: Record) -> None:
    wrong = with_images(hall, lambda s: np.roll(s, 60, axis=-1))
    few = replace(wrong, tx_pos_m=wrong.tx_pos_m[:30], observation=wrong.observation[:, :30], official=None)
    assert list(spectrum_axes(few)) == []
    places = wrong.tx_pos_m[np.arange(200) % 10]
    assert list(spectrum_axes(replace(wrong, tx_pos_m=places))) == []
    assert list(spectrum_axes(replace(wrong, tx_pos_m=np.full((200, 3), np.nan)))) == []


@pytest.mark.parametrize("size", [(1, 1), (7, 7), (16, 33), (40, 13)])
def test_images_of_any_size_are_checked(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    hall = spectra(48)
    record = replace(hall, observation=rng.random((1, 48, *size)).astype(np.float32))
    assert [name for name, _ in spectrum_axes(record)] == ["spectrum-axes"] * (size[0] > size[1])
