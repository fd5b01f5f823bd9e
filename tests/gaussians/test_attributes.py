"""Attributes of Gaussians that installed packages add."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from outside_packages import ROUGHNESS, commands, installed

from wrf_mi.core import InputError, Receiver
from wrf_mi.gaussians import ATTRIBUTES, FIELDS, Encoding, WithAttributes, random_gaussians
from wrf_mi.gaussians.attributes import grown_attributes, with_attributes

SETTINGS = (
    *("steps=60", "batch=8", "initial.gaussians=6", "density.every=20", "density.stop=0.7", "view.height=4"),
    *("network.layers=2", "network.width=8", "view.columns=8", "attributes=roughness"),
)
RECEIVER = Receiver("r", np.zeros(3), np.array([0.0, 0, 0, 1]))


@pytest.fixture
def roughness() -> Any:
    """The attribute of the other package."""
    module: dict[str, Any] = {}
    exec(ROUGHNESS, module)
    return module["ROUGHNESS"]


def test_commands_train_an_attribute_of_an_installed_package(flat_folder: Path, tmp_path: Path) -> None:
    environment, run = installed(tmp_path / "site"), tmp_path / "run"
    words = [word for setting in SETTINGS for word in ("--set", setting)]
    (tmp_path / "tx.csv").write_text("x,y,z\n1,2,1\n")
    train = ["train", flat_folder, "--model", "wrf-gs+", *words, "--json", "--out", run]
    results = commands(environment, {"trained": train})
    for name in ("model.npz", "metrics.json", "predictions.npz"):
        (run / name).unlink(missing_ok=True)  # as of a run that was stopped
    calls = {
        "resumed": ["train", "--resume", run, "--json"],
        "scored": ["evaluate", run, "--json"],
        "predicted": ["predict", run, "--tx", tmp_path / "tx.csv", "--out", tmp_path / "p.npz"],
        "compared": ["compare", run, "--out", tmp_path / "page"],
        "exported": ["export", run, "--format", "3dgs", "--tx", "1,2,1", "--out", tmp_path / "splat.ply"],
    }
    results |= commands(environment, calls)
    assert [status for status, _, _ in results.values()] == [0] * 6, results
    errors = [json.loads(results[name][1])["abs_error_db"]["mean"] for name in ("trained", "resumed", "scored")]
    assert errors[0] == pytest.approx(errors[1]) == pytest.approx(errors[2])
    with np.load(run / "model.npz") as arrays:
        stored = arrays["params/roughness"]
    assert stored.shape[0] == 1
    assert not np.isin(stored, np.array([0.1, 0.05], np.float32)).any()  # all have been trained
    exported = trimesh.load(tmp_path / "splat.ply").metadata["_ply_raw"]["vertex"]["data"]["roughness"]
    np.testing.assert_array_equal(np.ravel(exported), stored[0])


@pytest.mark.parametrize("name", list(FIELDS))
def test_attribute_changes_signals_of_any_field(name: str, roughness: Any) -> None:
    rng = np.random.default_rng(0)
    start = random_gaussians([RECEIVER], 5, rng)
    field = FIELDS[name](encoding=Encoding(1, 1.0, 2, 1.0))
    rough = WithAttributes(field, (roughness,))
    from wrf_mi.backend.device import to_tensor

    params = {key: to_tensor(values) for key, values in rough.init(start, np.random.default_rng(1)).items()}
    tx = to_tensor(np.array([[0.0, 1.0], [2.0, 3.0], [1.0, 1.0]], np.float32))
    smooth = np.array(field.gaussians(params, tx).signal)
    np.testing.assert_allclose(np.array(rough.gaussians(params, tx).signal), smooth * np.exp(-0.01), rtol=1e-6)
    assert rough.per_gaussian == (*field.per_gaussian, "roughness")
    assert replace(rough).blending == field.blending


def test_density_control_follows_the_rule_of_the_attribute(roughness: Any) -> None:
    before = {"roughness": np.array([[0.3, 0.4]], np.float32)}
    grown = grown_attributes(WithAttributes(None, (roughness,)), before, np.array([0, 1, 1]))
    np.testing.assert_array_equal(grown["roughness"], np.array([[0.3, 0.05, 0.05]], np.float32))


def test_unknown_and_clashing_attributes_are_refused(roughness: Any) -> None:
    field, rng = FIELDS["wrf-gs"](), np.random.default_rng(0)
    with pytest.raises(InputError, match="setting attributes: 'haze' is unknown or stated twice; known are none"):
        with_attributes(field, "haze")
    ATTRIBUTES.add("roughness", roughness)
    try:
        with pytest.raises(InputError, match="'roughness' is unknown or stated twice; known are roughness"):
            with_attributes(field, "roughness, roughness")
    finally:
        del ATTRIBUTES._known["roughness"]
    roughness.name = "rotation"
    with pytest.raises(InputError, match="attribute rotation: the field has a parameter of that name"):
        WithAttributes(field, (roughness,)).init(random_gaussians([RECEIVER], 4, rng), rng)
