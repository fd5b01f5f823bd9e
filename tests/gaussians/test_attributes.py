"""Attributes of Gaussians that other packages add; `test_registries` trains one by commands."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from outside_packages import ROUGHNESS

from wrf_mi.core import InputError, Receiver
from wrf_mi.gaussians import ATTRIBUTES, FIELDS, Encoding, WithAttributes, random_gaussians
from wrf_mi.gaussians.attributes import grown_attributes, with_attributes

RECEIVER = Receiver("r", np.zeros(3), np.array([0.0, 0, 0, 1]))


@pytest.fixture
def roughness() -> Any:
    """The attribute of the other package."""
    module: dict[str, Any] = {}
    exec(ROUGHNESS, module)
    return module["ROUGHNESS"]


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
