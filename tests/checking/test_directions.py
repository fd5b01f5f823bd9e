"""Spectra in another reading, orientations and plans are suspected; reflections and shading alone suggest none."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from checked_records import WALL, channels, spectra, strengths, with_images, with_orientations
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from wrf_mi.apps.checking.directions import brightness, reversed_share, spectrum_axes
from wrf_mi.apps.checking.plans import distance_law, explained, levels_db, placements
from wrf_mi.apps.checking.units import distances_m
from wrf_mi.core import Record

POSE = (Rotation.from_quat(WALL) * Rotation.from_euler("zx", [20, 30], degrees=True)).as_quat()
"""An array that is turned on its wall by 20 degrees and tilted by 30 degrees, so that no mirror image is the same."""


@pytest.fixture(scope="module")
def hall():
    return spectra(orientation=POSE)


def test_the_stated_reading_few_rows_and_few_places_are_not_suspected(hall):
    assert brightness(hall).mean() > 0.95
    assert reversed_share(hall.observation) == 0
    assert list(spectrum_axes(hall)) == []
    wrong = with_images(hall, lambda s: np.roll(s, 60, axis=-1))
    few = replace(wrong, tx_pos_m=wrong.tx_pos_m[:30], observation=wrong.observation[:, :30], official=None)
    places = replace(wrong, tx_pos_m=wrong.tx_pos_m[np.arange(200) % 10])
    unknown = replace(wrong, tx_pos_m=np.full((200, 3), np.nan))
    assert [list(spectrum_axes(record)) for record in (few, places, unknown)] == [[], [], []]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("spread_m", [0.5, 4.0])
@pytest.mark.parametrize("direct", [0.0, 0.2])
def test_lobes_of_reflectors_suggest_no_other_reading(seed, spread_m, direct):
    """No line of sight, or a weak one, from transmitters in a small region or all around."""
    record = spectra(seed=seed, direct=direct, reflectors=1 + seed % 3, spread_m=spread_m)
    assert list(spectrum_axes(record)) == []


def test_rows_from_the_zenith_transposed_images_and_other_orientations_are_suspected(hall):
    for record in (hall, spectra(30, direct=0.0, reflectors=4)):  # a line of sight is not needed
        reversed_rows = with_images(record, lambda s: s[:, :, ::-1])
        assert reversed_share(reversed_rows.observation) > 0.7
        ((name, text),) = spectrum_axes(reversed_rows)
        assert name == "spectrum-axes"
        assert text.startswith("image rows count from the zenith: in ")
    for wrong, name, begin in (
        (with_images(hall, lambda s: s.swapaxes(2, 3)), "spectrum-axes", "images have 120 rows and 30 columns"),
        (with_orientations(hall, lambda q: np.roll(q, 1)), "orientation", "orientations are in the order w, x, y, z: "),
        (with_orientations(hall, lambda q: np.array([0.5, -0.5, -0.5, 0.5])), "orientation", AWAY),
    ):
        ((found, text),) = spectrum_axes(wrong)
        assert (found, text[: len(begin)]) == (name, begin)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda s: np.roll(s, s.shape[-1] // 2, axis=-1), "image columns count from -180 degrees"),
        (lambda s: np.roll(s[..., ::-1], 1, axis=-1), "image columns count clockwise"),
        (lambda s: np.roll(s[..., ::-1], 61, axis=-1), "image columns count clockwise from 180 degrees"),
    ],
)
def test_columns_with_another_origin_or_order_are_suspected(hall, change, what):
    ((name, text),) = spectrum_axes(with_images(hall, change))
    assert (name, text.partition(":")[0]) == ("spectrum-axes", what)
    assert "of the hemisphere is then darker than the direction of the transmitter, as stated" in text
    both = [text for _, text in spectrum_axes(with_images(hall, lambda s: change(s)[:, :, ::-1]))]
    assert [text.partition(":")[0] for text in both] == ["image rows count from the zenith", what]


AWAY = "all transmitters are behind the array of receiver gateway1, outside the hemisphere of "


@pytest.mark.parametrize(
    ("matrix", "what"), [([[1, 0], [0, -1]], "y is mirrored"), ([[0, 1], [1, 0]], "x and y are swapped")]
)
def test_transmitters_in_another_plan_are_suspected(matrix, what):
    """As a sign or two columns that are confused, in a hall that lies beside the x axis."""
    hall = spectra()
    moved = hall.tx_pos_m.copy()
    moved[:, :2] = moved[:, :2] @ np.array(matrix, float)
    found = dict(spectrum_axes(replace(hall, tx_pos_m=moved)))
    assert set(found) == {"plan"}
    assert found["plan"].startswith(f"transmitters are in another plan than receivers, {what}:")


@pytest.mark.parametrize("size", [(1, 1), (7, 7), (16, 33), (40, 13)])
def test_images_of_any_size_are_checked(size):
    rng = np.random.default_rng(0)
    hall = spectra(48)
    record = replace(hall, observation=rng.random((1, 48, *size)).astype(np.float32))
    assert [name for name, _ in spectrum_axes(record)] == ["spectrum-axes"] * (size[0] > size[1])


def shadowed(record: Record, seed: int, deviation_db: float = 8.0, length_m: float = 3.0) -> Record:
    """Walls: for each receiver a random field over the place in place of the distance law."""
    rng = np.random.default_rng(seed)
    covariance = np.exp(-cdist(record.tx_pos_m, record.tx_pos_m) / length_m) + 1e-6 * np.eye(len(record))
    root = np.linalg.cholesky(covariance)
    fields = deviation_db * (root @ rng.normal(size=(len(record), len(record.receivers)))).T
    return replace(record, observation=(-60 + fields).astype(np.float32))


def test_a_distance_law_explains_what_it_made():
    record = strengths(noise_db=0)
    share, exponent = explained(levels_db(record), distances_m(record))
    assert share == pytest.approx(1, abs=1e-5)
    assert exponent == pytest.approx(2, abs=1e-3)
    assert explained(-levels_db(record), distances_m(record)) == (0, 0)
    observation = record.observation.copy()
    observation[0] = np.nan
    observation[1, :50] = np.nan
    share, exponent = explained(observation.astype(float), distances_m(record))
    assert exponent == pytest.approx(2, abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_stated_plan_is_not_suspected(seed):
    for receivers in (1, 2, 4):
        record = strengths(seed=seed, receivers=receivers)
        assert list(distance_law(record)) == []
    assert list(distance_law(channels(seed=seed))) == []


@pytest.mark.parametrize("receivers", [1, 2, 4])
def test_shading_alone_suggests_no_other_plan(receivers):
    """Strengths that have nothing to do with distance, in random fields of some metres."""
    record = strengths(receivers=receivers)
    alarms = [any(True for _ in distance_law(shadowed(record, seed))) for seed in range(100)]
    assert np.mean(alarms) <= 0.06


def test_other_plans_are_suspected():
    record = strengths()
    hall_m = np.array([6.0, 4.0])
    for placement in itertools.islice(placements(record.tx_pos_m, hall_m), 7):
        wrong = replace(record, tx_pos_m=placement.positions_m)
        ((name, text),) = distance_law(wrong)
        assert name == "plan"
        undone = {"by 90": "by -90", "by -90": "by 90"}
        turn = next((part for part in ("by 90", "by -90") if part in placement.motion), "")
        motion = placement.motion.replace(turn, undone[turn]) if turn else placement.motion
        assert text.startswith(f"transmitters are in another plan than receivers, {motion}: distance then explains ")
        assert "of the variance of the signal strengths, as stated" in text


def test_placements_state_what_they_do():
    xy = np.array([[1.0, 2.0, 0.5], [3.0, 5.0, 0.5]])
    names = {"x": 0, "y": 1}
    for placement in placements(xy, np.array([2.0, 3.0])):
        formulas = placement.remedy.removeprefix("use ").split(", ")
        for formula, column in zip(formulas, placement.positions_m[:, :2].T, strict=True):
            source = formula.partition("= ")[2]
            values = eval(source, {name: xy[:, k] for name, k in names.items()})
            np.testing.assert_allclose(values, column, atol=0.01)
        np.testing.assert_array_equal(placement.positions_m[:, 2], xy[:, 2])
