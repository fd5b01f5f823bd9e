"""Corrections by rows of several carriers: one set of materials, with exponents of their conductivities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from correction_rooms import TRUE_MATERIALS, channels, stated_scene

from wrf_mi.core import Record
from wrf_mi.correction import Correction, CorrectionOptions, correct_scene, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.scene_parameters import EXPONENT, SURFACE, name_of
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.tracer import RayTracer

CARRIERS_HZ = (1.2e9, 2.4e9, 5.8e9)
OPTIONS = CorrectionOptions(("materials", "gain"), depth=2, rays=4096, steps=6)
ROUNDING_DB = 2e-3
"""Of reports in single precision: 8e-6 of 100 dB, and conductivities as float32."""


def strengths(scene: Path, count: int, seed: int = 0) -> Record:
    """Received powers in dB at positions of their own at each carrier."""
    base, parts, carriers = channels(scene, count, seed=seed), [], []
    each = len(base) // len(CARRIERS_HZ)
    for number, carrier_hz in enumerate(CARRIERS_HZ):
        positions = base.tx_pos_m[number * each : (number + 1) * each]
        here = replace(
            base,
            task="rssi",
            tx_pos_m=positions,
            observation=np.zeros((1, each), np.float32),
            frequencies_hz=np.array([carrier_hz]),
            official=None,
        )
        tracer = RayTracer(scene, instrument_of(here), TraceOptions(transmission=True, depth=2, rays=4096))
        parts.append(replace(here, observation=tracer(positions).astype(np.float32)))
        carriers += [carrier_hz] * each
    return Record(
        "bands",
        "rssi",
        np.concatenate([part.tx_pos_m for part in parts]),
        base.receivers,
        np.concatenate([part.observation for part in parts], axis=1),
        carriers_hz=np.array(carriers),
    )


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Correction, Record, Path]:
    """The lowest and the highest carrier correct the stated materials."""
    folder = tmp_path_factory.mktemp("bands")
    record = strengths(stated_scene(folder / "true", TRUE_MATERIALS), 300)
    stated = stated_scene(folder / "stated")
    found = correct_scene(stated, record, make_splits(record, "frequency:1")[0], OPTIONS)
    write_page(found, folder / "corrected")
    return found, record, folder


def test_residuals_are_those_of_each_carrier_alone(tmp_path: Path) -> None:
    """In the order of the rows, whatever the order of carriers; materials at another carrier follow ITU-R P.2040."""
    scene = stated_scene(tmp_path / "scene", TRUE_MATERIALS)
    record = strengths(scene, 60)
    rows = np.random.default_rng(0).permutation(len(record))[:24]
    whole = Misfit(record, rows, Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    residual = whole.residual(whole.start)
    assert whole.several_carriers
    np.testing.assert_allclose(residual, 0, atol=ROUNDING_DB)
    for carrier_hz in CARRIERS_HZ:
        which = np.flatnonzero(record.carriers_hz[rows] == carrier_hz)
        alone = replace(record, carriers_hz=None, frequencies_hz=np.array([carrier_hz]))
        single = Misfit(alone, rows[which], Prepared(open_scene(scene, carrier_hz)), OPTIONS)
        assert not single.several_carriers
        np.testing.assert_allclose(residual[which], single.residual(single.start), atol=ROUNDING_DB)


def test_paths_are_searched_once_for_all_carriers(tmp_path: Path, searches: list[int]) -> None:
    """Of positions that are partly the same at all carriers."""
    scene = stated_scene(tmp_path / "scene", TRUE_MATERIALS)
    record = strengths(scene, 30)
    record = replace(record, tx_pos_m=record.tx_pos_m[np.arange(len(record)) % 14])
    opened = open_scene(scene, 2.4e9)
    searches.clear()
    misfit = Misfit(record, np.arange(len(record)), Prepared(opened), OPTIONS)
    assert len(misfit.sides) == len(CARRIERS_HZ)
    assert searches == [14]


def test_derivatives_by_exponents_are_those_of_finite_differences(tmp_path: Path) -> None:
    """To 1 % of the largest, or the rounding of float32 reports over the step."""
    scene, step = stated_scene(tmp_path / "scene", TRUE_MATERIALS), 0.02
    misfit = Misfit(strengths(scene, 60), np.arange(50), Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    part = misfit.parts[name_of(SURFACE, EXPONENT)]
    columns = np.arange(part.start, part.stop)
    slopes = misfit.jacobian(misfit.start, columns)
    for place, column in enumerate(columns):
        way = np.eye(1, len(misfit.start), column)[0] * step
        expected = (misfit.residual(misfit.start + way) - misfit.residual(misfit.start - way)) / (2 * step)
        np.testing.assert_allclose(slopes[place], expected, atol=4e-4 + 0.01 * np.abs(expected).max())
    assert np.abs(slopes).max() > 0.1  # dB: exponents are felt


def test_a_carrier_without_rows_is_predicted_better(corrected: Any) -> None:
    """Powers at 2.4 GHz, traced in the scene that rows at 1.2 and 5.8 GHz corrected."""
    found, record, folder = corrected
    assert found.kept == "materials+gain"
    split = make_splits(record, "frequency:1")[0]
    spread = {}
    for name in ("stated", "corrected"):
        at = replace(record, carriers_hz=None, frequencies_hz=np.array([CARRIERS_HZ[1]]))
        tracer = RayTracer(folder / name, instrument_of(at), TraceOptions(transmission=True, depth=2, rays=4096))
        spread[name] = np.std(tracer(record.tx_pos_m[split.test])[0] - record.observation[0, split.test])
    # Of some twenty rows; with seeds 0 to 4 of the positions it is 0.10 to 0.40.
    assert spread["corrected"] < 0.5 * spread["stated"]


def test_the_folder_states_laws_of_conductivities(corrected: Any) -> None:
    """Sionna RT's file holds the conductivity at a training carrier; other carriers follow the exponent."""
    *_, folder = corrected
    laws = read_scene_folder(folder / "corrected").materials.laws
    assert laws
    assert {carrier for _, carrier in laws.values()} == {5.8e9}
    name, (exponent, _) = max(laws.items(), key=lambda item: item[1][0])
    assert exponent > 0.1
    low, high = (open_scene(folder / "corrected", hz).radio_materials[name].conductivity[0] for hz in (1.2e9, 4.8e9))
    assert high / low == pytest.approx(4**exponent, rel=1e-5)
