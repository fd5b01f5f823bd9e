"""Correction of scenes with known errors, from channels; and of scenes without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, TRUE_MATERIALS, channels, stated_scene, true_scene

from wrf_mi.core import InputError
from wrf_mi.correction import Correction, CorrectionOptions, correct_scene, write_page
from wrf_mi.correction.misfit import Misfit, search_options
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.tasks import instrument_of, task_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.corrected_scene import material_constants
from wrf_mi.tracing.plane_parameters import SHIFT, TILT
from wrf_mi.tracing.tracer import RayTracer

PLANE_M, PLANE_RAD = 1e-3, 1e-3
PERMITTIVITY = 0.1
"""Relative."""


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Correction, Any, np.ndarray, np.ndarray, Path]:
    folder = tmp_path_factory.mktemp("recovery")
    true, shift, tilt = true_scene(folder)
    record = channels(true, 160)
    stated = stated_scene(folder / "stated")
    found = correct_scene(stated, record, make_splits(record, "official")[0], CorrectionOptions(steps=10))
    return found, record, shift, tilt, folder


def test_planes_are_recovered_from_channels(corrected: Any) -> None:
    found, _, shift, tilt, _ = corrected
    moved = found.vector[found.misfit.parts[SHIFT]]
    turned = found.vector[found.misfit.parts[TILT]].reshape(tilt.shape)
    np.testing.assert_allclose(moved, shift, atol=PLANE_M)
    np.testing.assert_allclose(turned, tilt, atol=PLANE_RAD)


def test_permittivities_are_recovered_from_channels(corrected: Any, tmp_path: Path) -> None:
    """Of every surface but the board of metal, whose permittivity no wave feels."""
    found, *_ = corrected
    slabs = found.misfit.sides[0].slabs
    true = open_scene(stated_scene(tmp_path / "named", TRUE_MATERIALS), CARRIER_HZ)
    expected = (
        Misfit(found.misfit.record, found.misfit.rows[:2], true, search_options(1, 4096, 0.0, 0), lambda name: True)
        .sides[0]
        .slabs
    )
    assert slabs.names == expected.names
    felt = [not name.startswith("board") for name in slabs.names]
    ratio = material_constants(slabs, found.parameters)[felt, 0] / expected.permittivity[felt]
    assert np.mean(np.abs(ratio - 1) < PERMITTIVITY) >= 0.8


def test_standard_deviations_cover_the_errors(corrected: Any) -> None:
    """Errors of the planes are within four standard deviations, which are below those stated before."""
    found, _, shift, _, _ = corrected
    part = found.misfit.parts[SHIFT]
    error = np.abs(found.vector[part] - shift)
    assert (error < 4 * found.deviation[part] + 1e-4).all()
    assert (found.deviation[part] < found.prior[part] / 2).all()


def test_corrected_scene_is_a_folder_that_a_plain_trace_opens(corrected: Any) -> None:
    """Channels at test positions, traced anew in the written scene, are 20 dB better than in the stated one."""
    found, record, _, _, folder = corrected
    facts = write_page(found, folder / "corrected")
    test = record.official[1]
    score = {}
    for name in ("stated", "corrected"):
        tracer = RayTracer(folder / name, instrument_of(record), TraceOptions(transmission=True, max_depth=3))
        score[name] = np.median(task_of(record).score(tracer(record.tx_pos_m[test])[0], record.observation[0, test]))
    assert score["corrected"] > score["stated"] + 20
    from sionna import rt

    assert len(rt.load_scene(str(folder / "corrected" / "scene.xml"), merge_shapes=False).objects) == 7
    assert {"correction.md", "correction.json", "correction.png"} <= {p.name for p in (folder / "corrected").iterdir()}
    assert facts["kept"] == "materials, planes, frame"
    board = read_scene_folder(folder / "corrected").materials.constants["fitted_board"]
    assert board["conductivity"] > 1e5


def test_a_scene_without_errors_stays_as_good(tmp_path: Path) -> None:
    """Held-out scores are never below those of the stated scene."""
    scene = stated_scene(tmp_path / "scene")
    record = channels(scene, 60, snr_db=15)
    options = CorrectionOptions(steps=2, depth=2)
    found = correct_scene(scene, record, make_splits(record, "official")[0], options)
    mean = {stage: np.nanmean(score) for stage, score in found.scores.items()}
    assert mean[found.kept] >= mean[""]


def test_derivatives_are_those_of_finite_differences(tmp_path: Path) -> None:
    scene = stated_scene(tmp_path / "scene")
    record = channels(scene, 12)
    options = search_options(2, 4096, 0.0, 0)
    misfit = Misfit(record, np.arange(len(record)), open_scene(scene, CARRIER_HZ), options, lambda name: True)
    columns = np.array([part.start for part in misfit.parts.values()])
    slopes = misfit.jacobian(misfit.start, columns, lambda place: None)
    for place, column in enumerate(columns):
        step = np.eye(1, len(misfit.start), column)[0] * 1e-4
        expected = (misfit.residual(misfit.start + step) - misfit.residual(misfit.start - step)) / 2e-4
        np.testing.assert_allclose(slopes[:, :, place], expected, atol=2e-2 * max(1e-3, np.abs(expected).max()))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"parts": ("walls",)}, r"'walls' is not a part; choose of materials"), ({"parts": ()}, r"nothing to change")],
)
def test_unknown_parts_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CorrectionOptions(**options)


def test_few_rows_are_refused(tmp_path: Path) -> None:
    scene = stated_scene(tmp_path / "scene")
    record = channels(scene, 18)
    with pytest.raises(InputError, match=r"training rows are too few to hold some out"):
        correct_scene(scene, record, make_splits(record, "official", n_train=5)[0])
