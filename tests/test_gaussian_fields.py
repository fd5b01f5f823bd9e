"""WRF-GS and WRF-GS+ for signal strengths and channels: against the operator, principal components, round trips."""

from dataclasses import replace

import numpy as np
import pytest

from wrf_mi.backend import init

init()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from wrf_mi.backend.device import to_tensor  # noqa: E402
from wrf_mi.baselines import nerf2  # noqa: E402
from wrf_mi.baselines.band_fields import spread  # noqa: E402
from wrf_mi.baselines.gaussian_evaluation import AT_ONCE, Evaluation, GaussianSettings, frame_of  # noqa: E402
from wrf_mi.baselines.gaussian_fields import components_of, method_of  # noqa: E402
from wrf_mi.baselines.method import inputs_of  # noqa: E402
from wrf_mi.baselines.models import METHODS  # noqa: E402
from wrf_mi.baselines.nerf2_field import Nerf2Settings  # noqa: E402
from wrf_mi.baselines.nerf2_march import Networks  # noqa: E402
from wrf_mi.baselines.training import Training  # noqa: E402
from wrf_mi.core import InputError, Receiver, Record, Split  # noqa: E402
from wrf_mi.field import random_gaussians  # noqa: E402
from wrf_mi.fit.step import device_pose  # noqa: E402
from wrf_mi.receive.operator import SectorOperator  # noqa: E402
from wrf_mi.splat.tiles import perception_plane  # noqa: E402

MODELS = ("wrf-gs", "wrf-gs+")
SMALL = GaussianSettings(
    training=Training(steps=120, batch=8, rate=2e-3, rounds=2),
    gaussians=12,
    layers=2,
    width=16,
    height=6,
    columns=24,
    components=3,
)
THREADED = 1e-2
"""Of the largest value: ten steps of Adam, whose gradients are summed by threads in any order."""
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
TURNED = np.array([0.5, -0.5, 0.5, 0.5])
ROUNDING = 2e-3
"""dB: float32 sums of 288 directions that partly cancel, in another order than the operator's."""


def receivers(count: int) -> tuple[Receiver, ...]:
    turns = (UPRIGHT, TURNED)
    return tuple(Receiver(f"rx{r}", np.array([2.0 * r, 1.0, 0.5]), turns[r % 2]) for r in range(count))


def strengths(count: int = 2, rows: int = 60) -> Record:
    rng = np.random.default_rng(0)
    along = rng.permutation(np.linspace(-3, 3, rows))
    tx, places = np.stack([along, 2 + np.sin(along), np.full(rows, 0.3)], axis=1), receivers(count)
    distance = np.stack([np.linalg.norm(tx - r.position_m, axis=1) for r in places])
    power = -40 - 20 * np.log10(distance)
    power[0, :3] = np.nan
    return Record("made", "rssi", tx, places, power.astype(np.float32), frequencies_hz=np.array([2.4e9]))


def channels(rows: int = 60, antennas: int = 3, subcarriers: int = 8) -> Record:
    """Two paths whose delays go with one coordinate: the downlink follows from the uplink."""
    rng = np.random.default_rng(1)
    along = rng.uniform(0, 1, (rows, antennas, 1))
    band = np.arange(2 * subcarriers) / subcarriers
    h = np.exp(-2j * np.pi * band * (0.2 + 0.3 * along)) + 0.4 * np.exp(-2j * np.pi * band * (0.6 - 0.2 * along))
    h = (3e-4 * h).astype(np.complex64)
    nowhere = np.full((rows, 3), np.nan)
    return Record(
        "made", "csi", nowhere, receivers(1), h[None, ..., subcarriers:], uplink=h[..., :subcarriers], uplink_hz=None
    )


def halves(record: Record, validation: int = 6) -> Split:
    rows = np.arange(len(record))
    return Split("halves", 0, rows[: 40 - validation], rows[40 - validation : 40], rows[40:])


def quiet(what: str, share: float) -> None:
    """Hears of progress."""


@pytest.mark.parametrize("model", MODELS)
def test_power_is_that_of_the_operator_over_the_full_sphere(model):
    record = strengths()
    settings = replace(SMALL, tx_scale_m=SMALL.scale_m)
    evaluation = Evaluation(settings, frame_of(model, record, np.ones((1, 1), complex), np.ones(2)), 0)
    rng = np.random.default_rng(3)
    weights = evaluation.field.init(random_gaussians(record.receivers, 12, rng, size_deg=20, sphere=True), rng)
    offsets = np.array([[-3.0, 7.0]], np.float32)
    params = {name: to_tensor(values) for name, values in (weights | {"offset": offsets}).items()}
    tx = to_tensor(record.tx_pos_m[:1].T)
    for r, receiver in enumerate(record.receivers):
        found = evaluation.predict(params, tx, r)[0, 0]
        gaussians = evaluation.field.gaussians(params, tx)
        operator = SectorOperator.of(gaussians, device_pose(receiver), perception_plane(6, 24, mi.Float))
        re, im = (part.numpy() for part in gaussians.signal)
        assert found == pytest.approx(offsets[0, r] + operator.power_db((re + 1j * im)[None])[0], abs=ROUNDING)


def test_spread_gives_each_component_an_image_of_its_own():
    record = channels()
    frame = frame_of("wrf-gs+", record, np.eye(3, 8, dtype=complex), np.ones(1))
    evaluation = Evaluation(SMALL, frame, 16)
    rng = np.random.default_rng(0)
    weights = evaluation.field.init(random_gaussians(record.receivers, 5, rng, sphere=True), rng)
    params = {name: to_tensor(values) for name, values in weights.items()}
    given = evaluation.field.gaussians(params, to_tensor(rng.normal(size=(16, 4))))
    found = spread(given, 3)
    assert found.batch == 12
    assert found.count == 5
    for component in range(3):
        for part, half in ((0, 0), (1, 3)):
            signal = found.signal[part].numpy().reshape(4, 3, 5)[:, component]
            np.testing.assert_array_equal(signal, given.signal[half + component].numpy().reshape(4, 5))
        for wide, narrow in zip((*found.scale, found.opacity), (*given.scale, given.opacity), strict=True):
            np.testing.assert_array_equal(
                wide.numpy().reshape(4, 3, 5)[:, component], narrow.numpy().reshape(4, 5), strict=True
            )


def test_components_hold_what_channels_are_made_of():
    rng = np.random.default_rng(0)
    modes = rng.normal(size=(2, 7)) + 1j * rng.normal(size=(2, 7))
    h = (rng.normal(size=(50, 2)) + 1j * rng.normal(size=(50, 2))) @ modes
    basis = components_of(h, 2)
    np.testing.assert_allclose(basis @ basis.conj().T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose((h @ basis.conj().T) @ basis, h, atol=1e-10)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.all_threads
@pytest.mark.parametrize("shared", [False, True])
def test_strengths_are_learned_and_kept(model, shared):
    record = strengths()
    split, method = halves(record), method_of(model)
    fitted = method.fit(record, split, replace(SMALL, shared=shared), 0, quiet)
    inputs = inputs_of(record, split.test)
    again = method.load(fitted.arrays(), record)
    for r in range(2):
        found, truth = fitted.predict(inputs, r), record.observation[r, split.test]
        mean = np.abs(np.nanmean(record.observation[r, split.all_train]) - truth)
        assert np.median(np.abs(found - truth)) < np.median(mean)
        np.testing.assert_array_equal(again.predict(inputs, r), found)


@pytest.mark.parametrize("model", MODELS)
def test_channels_are_learned_from_the_uplink_and_kept(model):
    record = channels()
    split, method = halves(record), method_of(model)
    settings = replace(SMALL, training=Training(steps=300, batch=32, rate=3e-3, rounds=3))
    fitted = method.fit(record, split, settings, 0, quiet)
    inputs = inputs_of(record, split.test)
    found, truth = fitted.predict(inputs, 0), record.observation[0, split.test]
    assert found.shape == truth.shape

    def error(prediction):
        return np.median(np.square(np.abs(prediction - truth)).sum((1, 2)) / np.square(np.abs(truth)).sum((1, 2)))

    assert error(found) < 0.3 * error(record.uplink[split.test])
    np.testing.assert_array_equal(method.load(fitted.arrays(), record).predict(inputs, 0), found)


def two_stations(rows: int = 60) -> Record:
    """Channels over positions; the second station's are 20 dB weaker and orthogonal to the first's, some unheard."""
    rng = np.random.default_rng(4)
    tx = np.column_stack([rng.uniform(-2, 2, (rows, 2)), np.full(rows, 0.3)])
    modes = np.exp(2j * np.pi * np.outer([1, 3], np.arange(8)) / 8)
    h = np.exp(1j * tx[:, :1]) * modes[:, None] * np.array([1e-3, 1e-4])[:, None, None]
    h[0, :5] = np.nan
    h[1, 3:9] = np.nan
    return Record("made", "csi", tx, receivers(2), h.astype(np.complex64))


def test_a_second_receiver_with_other_components_is_learned():
    record = two_stations()
    split = halves(record)
    settings = replace(SMALL, components=2, training=Training(steps=300, batch=16, rate=3e-3, rounds=3))
    fitted = method_of("wrf-gs+").fit(record, split, settings, 0, quiet)
    inputs = inputs_of(record, split.test)
    for r in range(2):
        truth, found = record.observation[r, split.test], fitted.predict(inputs, r)
        error = np.square(np.abs(found - truth)).sum(axis=1) / np.square(np.abs(truth)).sum(axis=1)
        assert np.median(error) < 0.2, "in components of the other receiver alone it is 1 at least"


@pytest.mark.all_threads
@pytest.mark.parametrize("name", [*MODELS, "nerf2"])
def test_a_weak_receiver_is_learned_as_well_as_a_strong_one(name):
    """A receiver 40 dB weaker is told in its own units: a power of two changes no digit of what is learned."""
    record, weak = two_stations(), 2.0**-7
    fainter = replace(record, observation=record.observation * np.array([1, weak], np.float32)[:, None, None])
    split, quick = halves(record), Training(steps=10, batch=8, rounds=1)
    method = METHODS[name]
    settings = (
        Nerf2Settings(training=quick, sphere_batch=8, sphere_rays=16, networks=Networks(layers=2, width=8))
        if name == "nerf2"
        else replace(SMALL, components=2, shared=True, training=quick)
    )
    inputs = inputs_of(record, split.test)
    plain, faint = (method.fit(one, split, settings, 0, quiet).predict(inputs, 1) for one in (record, fainter))
    assert np.abs(plain).max() > 1e-6
    np.testing.assert_allclose(faint, weak * plain, rtol=0, atol=THREADED * weak * np.abs(plain).max())


def test_any_number_of_rows_is_predicted_alike():
    record = strengths(1, 2 * AT_ONCE + 3)
    rows = np.arange(len(record))
    split = Split("all", 0, rows[:40], rows[40:50], rows[50:])
    quick = replace(SMALL, training=Training(steps=10, batch=8, rounds=1))
    fitted = method_of("wrf-gs+").fit(record, split, quick, 0, quiet)
    everything = fitted.predict(inputs_of(record, rows), 0)
    alone = np.concatenate([fitted.predict(inputs_of(record, rows[i : i + 1]), 0) for i in (0, AT_ONCE, len(rows) - 1)])
    # The same kernels on other numbers of columns: products round differently.
    np.testing.assert_allclose(everything[[0, AT_ONCE, len(rows) - 1]], alone, atol=1e-3)


def test_what_cannot_be_learned_from_is_refused():
    method, record = method_of("wrf-gs+"), strengths()
    nowhere = replace(record, tx_pos_m=np.full_like(record.tx_pos_m, np.nan))
    with pytest.raises(InputError, match="no position in row 0"):
        method.fit(nowhere, halves(record), SMALL, 0, quiet)
    deaf = replace(record, observation=np.full_like(record.observation, np.nan))
    with pytest.raises(InputError, match="received no training row"):
        method.fit(deaf, halves(record), SMALL, 0, quiet)
    dr.sync_thread()


@pytest.mark.parametrize("name", [*MODELS, "nerf2"])
@pytest.mark.parametrize("lost", ["position_m", "orientation_xyzw"])
def test_receivers_without_a_pose_are_refused_where_positions_tell(name, lost):
    record = strengths()
    unknown = replace(record.receivers[1], **{lost: np.full(3 if lost == "position_m" else 4, np.nan)})
    record = replace(record, receivers=(record.receivers[0], unknown))
    method, quick = method_of(name) if name in MODELS else nerf2.METHOD, Training(steps=2, batch=4, rounds=1)
    with pytest.raises(InputError, match=r"made: the pose of receiver rx1 is not known.*give its position") as error:
        method.fit(record, halves(record), method.settings(quick), 0, quiet)
    assert "\n" not in str(error.value)
