"""Signal strengths without headings, at heights that differ, of anchors with names: every step from file to picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused, stored
from made_flat import NAMED_ANCHORS_M

from wrf_mi.measure import load
from wrf_mi.report.compare import compare

NAMES = list(NAMED_ANCHORS_M)
MODELS = {"kriging": (), "trees": ("--set", "trees=20"), "mri": (), "hybrid": ()}


@pytest.fixture(scope="module")
def runs(plain_flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    from wrf_mi.cli import main

    folder = tmp_path_factory.mktemp("runs")
    for model, more in MODELS.items():
        given = ["train", str(plain_flat_folder), "--model", model, "--out", str(folder / model), *more]
        assert main(given) == 0
    return {model: folder / model for model in MODELS}


@pytest.mark.parametrize("model", MODELS)
def test_models_work_without_headings(
    model: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(json.loads((runs[model] / "metrics.json").read_text())["receivers"]) == NAMES
    before = stored(runs[model])
    assert call(["evaluate", runs[model]], capsys)[0] == 0
    np.testing.assert_array_equal(stored(runs[model])["prediction"], before["prediction"])
    (tmp_path / "tx.csv").write_text("\n".join(["x,y,z", *(",".join(map(str, row)) for row in before["tx_pos"])]))
    assert call(["predict", runs[model], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "out.npz"], capsys)[0] == 0
    with np.load(tmp_path / "out.npz") as found:
        assert found["receiver_name"].tolist() == NAMES
        np.testing.assert_allclose(found["prediction"], before["prediction"], atol=1e-4)


@pytest.mark.parametrize("model", ["kriging", "trees", "hybrid"])
def test_models_see_the_height(
    model: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tx.csv").write_text("x,y,z\n0.6,0.6,0.3\n0.6,0.6,1.9\n")
    assert call(["predict", runs[model], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "out.npz"], capsys)[0] == 0
    with np.load(tmp_path / "out.npz") as found:
        assert (np.abs(np.diff(found["prediction"], axis=1)) > 1e-3).any()


def test_comparison_shows_names_as_they_are(runs: dict[str, Path], tmp_path: Path) -> None:
    """Also those in which Matplotlib would see a formula, and a wrong one."""
    compare(list(runs.values()), tmp_path / "out")
    assert (tmp_path / "out" / "plain-samples.png").exists()


def test_length_over_headings_is_refused(
    plain_flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load(plain_flat_folder).tx_heading_rad is None
    given = ["train", plain_flat_folder, "--model", "kriging", "--out", tmp_path / "run", "--set", "heading_length=1"]
    refused(given, "plain: has no headings for kriging's heading_length; leave the setting away", capsys)
    assert not (tmp_path / "run").exists()
