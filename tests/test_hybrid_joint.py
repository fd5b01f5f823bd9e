"""One fit of both sides: each learns what the other cannot."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hybrid_room import CEILING, FREQUENCY_HZ, HEIGHT, WALLS, receiver, room, transmitters

from wrf_mi.backend.device import to_tensor
from wrf_mi.hybrid import (
    ArrayReceiver,
    CsiReceiver,
    JointFit,
    PixelReceiver,
    PowerReceiver,
    TracedField,
    TracedOptions,
    View,
)

# isort: split
import drjit as dr

from wrf_mi.core import pixel_directions
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.types import Receiver
from wrf_mi.field import Encoding, WrfGsPlus, random_gaussians
from wrf_mi.loss.spectrum import spectrum_loss
from wrf_mi.receive.array import bartlett_spectrum
from wrf_mi.receive.channel import element_signals
from wrf_mi.trace import TraceOptions, trace_paths
from wrf_mi.trace.materials import BELOW_1_GHZ

ROWS, COLUMNS = 30, 120
ARRAY_M = planar_array(4, 4, 0.16)
TRAIN, HELD_OUT, STEPS = 20, 8, 200
OPTIONS = TraceOptions(max_depth=1, rays=4096)
TRUE_PERMITTIVITY, START_PERMITTIVITY = BELOW_1_GHZ["concrete"][0], 2.5
PERMITTIVITY = "material.itu_concrete.permittivity"
ENCODING = Encoding(position_octaves=2, position_scale_m=4.0, tx_octaves=3, tx_scale_m=0.6)
FIELD = WrfGsPlus(encoding=ENCODING, layers=3, width=64, skip=2)
RATES = {"material.*.permittivity": 0.05, "material.*": 0.0, "receiver.*": 0.0}
FIELD_RATES = {"field.signal": 0.01, "field.position": 0.01, "field.*": 0.005}


class Guess(TracedField):
    """The traced side with a wrong idea of concrete."""

    def parameters(self) -> dict[str, Any]:
        values = super().parameters()
        values[PERMITTIVITY] = np.array([np.log(START_PERMITTIVITY - 1)], np.float32)
        return values


@dataclass
class Truth:
    """A room with a metal ceiling, and what is known of it: the walls."""

    known: Any
    own: Receiver
    positions: np.ndarray
    spectra: np.ndarray
    unit: float

    def fit(self, traced: bool, learned: bool, seed: int = 0) -> JointFit:
        train = self.positions[:TRAIN]
        side = Guess(self.known, train, self.own, TracedOptions(OPTIONS, gain=self.unit)) if traced else None
        view = View(self.own, ArrayReceiver(ROWS, COLUMNS, ARRAY_M, FREQUENCY_HZ), self.spectra[:TRAIN], side)
        start = random_gaussians([self.own], 40, np.random.default_rng(1), size_deg=10.0, signal=0.05)
        rates = (RATES if traced else {}) | (FIELD_RATES if learned else {})
        return JointFit(train, [view], FIELD if learned else None, start if learned else None, rates=rates, seed=seed)

    def error(self, fit: JointFit) -> float:
        """Mean absolute error at positions that were not trained on, of spectra whose highest is 1."""
        return float(np.abs(fit.predict(self.positions[TRAIN:]) - self.spectra[TRAIN:]).mean())


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """Spectra by Sionna RT and the NumPy array; nothing of the hybrid is in them."""
    folder = tmp_path_factory.mktemp("rooms")
    whole, known = room(folder / "whole", {**WALLS, **CEILING}), room(folder / "known", WALLS)
    own, positions = receiver(), transmitters(TRAIN + HELD_OUT)
    paths = trace_paths(whole, positions, own, OPTIONS).paths
    h = element_signals(paths, own, ARRAY_M, FREQUENCY_HZ)[0]
    spectra = bartlett_spectrum(h, ARRAY_M, FREQUENCY_HZ, ROWS, COLUMNS)
    unit = 1 / spectra.max()
    return Truth(known, own, positions, spectra * unit, unit)


def test_each_side_learns_what_the_other_cannot(truth: Truth) -> None:
    """The traced side lacks the ceiling, the learned one has few Gaussians for all there is; together they suffice."""
    fits = {
        "joint": truth.fit(True, True),
        "traced": truth.fit(True, False),
        "learned": truth.fit(False, True),
    }
    for fit in fits.values():
        fit.run(STEPS, final_factor=0.1)
    trained = {name: float(np.mean(fit.losses[-10:])) for name, fit in fits.items()}
    held_out = {name: truth.error(fit) for name, fit in fits.items()}
    for other in ("traced", "learned"):
        assert trained["joint"] < trained[other] / 2
        assert held_out["joint"] < held_out[other] * 0.75

    # The tracer's part: alone it puts the ceiling's echo down to the walls.
    found = {name: fits[name].materials()[PERMITTIVITY] for name in ("joint", "traced")}
    assert found["joint"] == pytest.approx(TRUE_PERMITTIVITY, abs=0.2)
    assert abs(found["traced"] - TRUE_PERMITTIVITY) > 2 * abs(found["joint"] - TRUE_PERMITTIVITY)

    # The field's part: its energy lies around the transmitters' images above the ceiling.
    image = truth.positions.mean(axis=0) * [1, 1, -1] + [0, 0, 2 * HEIGHT]
    towards = (image - truth.own.position_m) @ truth.own.to_world
    near = pixel_directions(ROWS, COLUMNS).reshape(-1, 3) @ (towards / np.linalg.norm(towards)) > np.cos(np.radians(20))
    weight = solid_angles(ROWS, COLUMNS)
    share = {}
    for name in ("joint", "learned"):
        energy = (np.abs(fits[name].learned()) ** 2).mean(axis=0) * weight
        share[name] = energy[near].sum() / energy.sum()
    assert share["joint"] > 0.4 > share["learned"]


def test_the_pose_too(truth: Truth) -> None:
    """A receiver that stands 3 cm off and is turned by 2 degrees: found by the traced side of the complete room."""
    truth_pose = np.array([0.02, -0.015, 0.01]), np.radians([0.5, -1.0, 2.0])
    view = truth.fit(True, False).views[0]
    assert view.traced is not None
    parameters = {name: to_tensor(value) for name, value in view.traced.parameters().items()}
    names = [f"receiver.array.{what}" for what in ("position", "turn")]
    moved = {name: to_tensor(value) for name, value in zip(names, truth_pose, strict=True)}
    observed = view.model(view.traced({**parameters, **moved}), None).numpy().reshape(TRAIN, ROWS, COLUMNS)
    rates = {"receiver.*.position": 0.002, "receiver.*.turn": 0.005, "*": 0.0}
    fit = JointFit(truth.positions[:TRAIN], [replace(view, observation=observed)], rates=rates)
    assert sorted(fit.adam) == names
    fit.run(200, final_factor=0.02)
    values = fit.values()
    np.testing.assert_allclose(values[names[0]], truth_pose[0], atol=1e-3)
    np.testing.assert_allclose(values[names[1]], truth_pose[1], atol=1e-3)
    assert fit.losses[-1] < 0.05 * fit.losses[0]


@pytest.mark.all_threads
def test_two_receivers_batches_and_another_loss(truth: Truth) -> None:
    """Views share the field, have poses of their own, and take steps in turn; batches go through all rows."""
    count = 5
    positions = truth.positions[:count]
    second = Receiver("tag", np.array([1.0, 4.0, 2.0]), truth.own.orientation_xyzw)
    options = TracedOptions(OPTIONS, gain=truth.unit)
    power = np.full((count,), -20.0)
    power[1] = np.nan
    views = [
        View(
            truth.own,
            PixelReceiver(ROWS, COLUMNS, ARRAY_M, FREQUENCY_HZ, "power"),
            truth.spectra[:count],
            TracedField(truth.known, positions, truth.own, options),
        ),
        View(
            second,
            PowerReceiver(10, 20, (FREQUENCY_HZ,)),
            power,
            TracedField(truth.known, positions, second, options),
        ),
    ]
    heard: list[int] = []

    def loss(prediction: Any, observed: Any, batch: int, *shape: int) -> Any:
        heard.append(batch)
        if len(shape) == 2:
            return spectrum_loss(prediction, observed, batch, *shape)[0]
        known = dr.isfinite(observed)
        return dr.mean(dr.select(known, dr.square(prediction - dr.select(known, observed, 0)), 0)) * 1e-3

    start = random_gaussians([truth.own, second], 12, np.random.default_rng(0), signal=0.05)
    fit = JointFit(positions, views, FIELD, start, loss=loss, batch=2, seed=3)
    assert {"receiver.array.gain", "receiver.tag.gain"} <= set(fit.adam)
    assert "receiver.tag.position" in fit.fixed
    steps: list[int] = []
    last = fit.run(12, listen=lambda step, _: steps.append(step))
    assert np.isfinite(last)
    assert steps == list(range(1, 13))
    assert set(heard) == {2}
    assert fit.predict(view=1).shape == (count,)
    assert fit.learned(view=1).shape == (count, 2 * 10 * 20)
    np.testing.assert_array_equal(fit.predict(view=second.name), fit.predict(view=1))
    np.testing.assert_array_equal(fit.learned(view=second.name), fit.learned(view=1))
    assert fit.predict(truth.positions[:3]).shape == (3, ROWS, COLUMNS)
    rows = np.concatenate([fit._next_rows() for _ in range(5)])
    assert np.bincount(rows, minlength=count).min() >= 1


def test_the_documented_fit_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """As it stands, but for the number of steps."""
    page = (Path(__file__).parents[1] / "docs" / "hybrid.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert script.count("fit.run(300") == 1
    exec(compile(script.replace("fit.run(300", "fit.run(2"), "docs/hybrid.md", "exec"), {})
    permittivity, error = (float(line) for line in capsys.readouterr().out.split())
    assert 1 < permittivity < 10
    assert 0 < error < 1


@pytest.mark.parametrize("kind", ["array", "scaled", "rssi", "csi"])
def test_matched_gain_and_kept_values(truth: Truth, kind: str) -> None:
    """A gain of the truth's own is found again, and a fit goes on from another's values."""
    positions, frequencies = truth.positions[:4], (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ)
    models: dict[str, Any] = {
        "array": ArrayReceiver(ROWS, COLUMNS, ARRAY_M, FREQUENCY_HZ),
        "scaled": ArrayReceiver(ROWS, COLUMNS, ARRAY_M, FREQUENCY_HZ, instrument_scale=True),
        "rssi": PowerReceiver(4, 8, frequencies),
        "csi": CsiReceiver(4, 8, frequencies),
    }
    traced = TracedField(truth.known, positions, truth.own, TracedOptions(OPTIONS))
    model, count = models[kind], len(positions)
    observed = np.zeros((count, *model.shape))
    observed = observed[..., 0] + 0j if kind == "csi" else observed
    fit = JointFit(positions, [View(truth.own, model, observed, traced)], rates={"*": 0.01})
    fit.set_values({traced.gain_name: np.array([np.log(40.0), 0.0])})
    report = fit.predict()
    if kind == "csi":
        report = report @ [1, 1j]
    again = JointFit(positions, [View(truth.own, model, report, traced)], rates={"*": 0.01})
    again.match_gain()
    if kind == "scaled":
        plain = replace(model, instrument_scale=False)
        peaks = plain(traced(again.parameters), None).numpy().reshape(count, -1).max(axis=1)
        assert peaks.mean() == pytest.approx(1, abs=1e-3)
    else:
        # Reports are float32, and magnitudes of some 0.1 have a floor of 1e-4 in both.
        assert again.values()[traced.gain_name][0] == pytest.approx(np.log(40), abs=1e-3)
    again.set_values(fit.values())
    assert all((again.values()[name] == value).all() for name, value in fit.values().items())
    with pytest.raises(ValueError, match="not a parameter"):
        fit.set_values({traced.gain_name: np.zeros(3)})


def test_nothing_is_traced_after_the_first_steps(truth: Truth) -> None:
    """Later batches, rates and views replay what was recorded; another loss is recorded anew."""
    fit = truth.fit(True, True)
    fit.batch = 7
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):  # a recording belongs to such flags
        fit.run(5, final_factor=0.5)
        recordings = fit.recordings
        dr.kernel_history_clear()
        fit.run(6, final_factor=0.1)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len(history) >= 6
    assert [entry["hash"] for entry in history if not entry["cache_hit"]] == []
    assert fit.recordings == recordings > 0


def test_a_new_search_for_paths_counts_at_once(truth: Truth) -> None:
    """The recording holds for the paths that it was made with: after another search it is not used any more."""
    fits = [truth.fit(True, False) for _ in range(2)]
    for fit in fits:
        fit.step()
    traced = fits[1].views[0].traced
    assert traced is not None
    elsewhere = truth.own.position_m - np.array([0.0, 0.0, 0.4])
    traced._search(elsewhere)  # as `refresh` does once the receiver has moved
    assert traced.searches == 2
    prediction, loss = fits[1].predict(), fits[1].step()
    expected = np.abs(prediction - truth.spectra[:TRAIN]).mean()
    assert loss == pytest.approx(expected, rel=1e-3)


def test_a_seed_decides(truth: Truth) -> None:
    losses = []
    for seed in (0, 0, 1):
        fit = truth.fit(False, True, seed=seed)
        fit.run(3)
        losses.append(fit.losses)
    # Parallel sums differ in the last digit of float32.
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-4)
    assert abs(losses[2][0] - losses[0][0]) > 1e-4 * losses[0][0]


def test_a_step_that_breaks_is_not_taken(truth: Truth) -> None:
    fit = truth.fit(True, False)
    fit.step()
    before = fit.values()
    fit._loss = lambda prediction, observed, batch, *shape: dr.sum(prediction) / 0
    # Dr.Jit's sums drop NaN on the way back, so that Adam would go on by its momentum alone.
    with pytest.raises(FloatingPointError, match="step 1"):
        fit.step()
    assert all((fit.values()[name] == value).all() for name, value in before.items())


def test_what_does_not_belong_together(truth: Truth) -> None:
    fit = truth.fit(True, False)
    view, train = fit.views[0], truth.positions[:TRAIN]
    with pytest.raises(ValueError, match="has shape"):
        JointFit(train, [replace(view, observation=truth.spectra[: TRAIN - 1])])
    with pytest.raises(ValueError, match="other transmitters"):
        JointFit(train + 0.1, [view])
    with pytest.raises(ValueError, match="neither"):
        JointFit(train, [replace(view, traced=None)])
    with pytest.raises(ValueError, match="initial"):
        JointFit(train, [view], FIELD)
    with pytest.raises(ValueError, match=r"rate for matreial\.\*"):
        JointFit(train, [view], rates={"matreial.*": 1.0})
    with pytest.raises(ValueError, match="no learned side"):
        fit.learned()
