"""Settings of a fit: what is accepted, what is refused, and that none is lost on the way to a file and back."""

from __future__ import annotations

import dataclasses
from dataclasses import asdict
from operator import attrgetter
from typing import Any, get_type_hints

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from wrf_mi.core import InputError
from wrf_mi.core.settings import describe, settings_from, with_settings
from wrf_mi.training.config import PRESETS, TrainConfig
from wrf_mi.training.fit_plan import make_field


def leaves(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def read(values: Any, source: str = "config") -> TrainConfig:
    return settings_from(TrainConfig, values, source)


DEFAULTS = leaves(asdict(TrainConfig()))
INSIDE = {"initial.opacity"}
"""Shares that must be neither 0 nor 1: their logits are stored."""
LARGEST = {
    "holdout_steps_fraction": 1.0,
    "loss.ssim_weight": 1.0,
    "initial.size_deg": 89.0,
    "optimiser.cosine_start": 1.0,
    "optimiser.final": 1.0,
    "optimiser.ema_decay": 0.9999,
    "density.start": 1.0,
    "density.stop": 1.0,
    "density.growth_fraction": 1.0,
    "traced.alone": 0.4,
    "traced.faint": 0.4,
    "traced.depth": 12,
    "traced.pattern_degree": 8,
    "traced.rays": 1 << 24,
} | dict.fromkeys(INSIDE, 0.999)


def good_values(name: str, default: Any) -> st.SearchStrategy[Any]:
    if isinstance(default, bool):
        return st.booleans()
    if isinstance(default, int):
        return st.integers(1, int(LARGEST.get(name, 10**9)))
    if name == "receiver":
        return st.sampled_from(["auto", "pixel", "array"])
    if name == "traced.materials":
        return st.sampled_from(["named", "surface"])
    if name == "evaluation":
        return st.sampled_from(["splatted", "traced"])
    if isinstance(default, str):
        return st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    if name == "initial.nearest_m":  # not beyond the farthest
        return st.floats(0.01, 1.0)
    if name == "initial.farthest_m":
        return st.floats(1.0, 1000.0)
    return st.floats(0.001, LARGEST.get(name, 1e6))


SOURCES = ("points", "mesh", "paths")


@st.composite
def configurations(draw: st.DrawFn) -> TrainConfig:
    """Any valid configuration, most settings changed."""

    def build(kind: type, prefix: str) -> Any:
        types = get_type_hints(kind)
        values = {}
        for field in dataclasses.fields(kind):
            name = f"{prefix}{field.name}"
            if dataclasses.is_dataclass(types[field.name]):
                values[field.name] = build(types[field.name], f"{name}.")
            else:
                values[field.name] = draw(good_values(name, DEFAULTS[name]))
        if prefix == "initial.":
            # Gaussians start from one source.
            source = draw(st.sampled_from(SOURCES))
            values |= {other: "" for other in SOURCES if other != source}
        return kind(**values)

    return build(TrainConfig, "")


@given(configurations())
def test_a_configuration_survives_a_dictionary_and_a_file(config: TrainConfig) -> None:
    assert read(asdict(config)) == config
    assert read(yaml.safe_load(yaml.safe_dump(asdict(config)))) == config


def as_text(value: Any) -> str:
    """A value as it is typed after ``--set key=``."""
    return yaml.safe_dump(value, width=1000).removesuffix("...\n").strip()


@given(configurations())
def test_settings_as_text_make_any_configuration(config: TrainConfig) -> None:
    changed = [(name, value) for name, value in leaves(asdict(config)).items() if value != DEFAULTS[name]]
    assert with_settings(TrainConfig(), [f"{name}={as_text(value)}" for name, value in changed]) == config


def test_missing_settings_keep_their_defaults() -> None:
    assert read({}) == TrainConfig()
    config = read({"steps": 5, "density": {"growth_fraction": 0.5}})
    assert (config.steps, config.density.growth_fraction, config.density.every) == (5, 0.5, TrainConfig().density.every)


@pytest.mark.parametrize(
    ("setting", "name", "value"),
    [
        ("steps=2000", "steps", 2000),
        ("optimiser.network=1e-3", "optimiser.network", 0.001),  # YAML 1.1 reads this as text
        ("optimiser.network=1.0e-3", "optimiser.network", 0.001),
        ("optimiser.network=.5", "optimiser.network", 0.5),
        ("optimiser.position=1", "optimiser.position", 1.0),  # a whole number where a float is due
        ("initial.farthest_m=2e1", "initial.farthest_m", 20.0),
        ("deterministic=true", "deterministic", True),
        ("deterministic=no", "deterministic", False),
        ("initial.points=cloud.ply", "initial.points", "cloud.ply"),
        ("initial.points=", "initial.points", ""),
        ("initial.points=a=b.ply", "initial.points", "a=b.ply"),
        (" model =wrf-gs", "model", "wrf-gs"),
    ],
)
def test_setting_changes_one_value_and_keeps_its_type(setting: str, name: str, value: Any) -> None:
    flat = leaves(asdict(with_settings(TrainConfig(), [setting])))
    assert flat[name] == value
    assert type(flat[name]) is type(value)
    assert flat == DEFAULTS | {name: value}


def test_the_last_of_several_settings_counts() -> None:
    assert with_settings(TrainConfig(), ["steps=1", "batch=2", "steps=3"]).steps == 3


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("steps", "--set steps: expected key=value"),
        ("stepz=1", "--set stepz=1: unknown setting stepz"),
        ("optimiser.nothing=1", "unknown setting optimiser.nothing"),
        ("optimiser=1", "unknown setting optimiser"),
        ("steps.more=1", "unknown setting steps.more"),
        ("=1", "unknown setting"),
        ("steps=1.5", "setting steps: expected int, got 1.5"),
        ("steps=true", "setting steps: expected int, got True"),
        ("steps=many", "setting steps: expected int, got 'many'"),
        ("steps=", "setting steps: expected int, got ''"),
        ("steps=1e3", "setting steps: expected int, got '1e3'"),
        ("steps=[1", "'[1' is no YAML value"),
        ("steps=2024-13-45", "'2024-13-45' is no YAML value"),
        ("deterministic=1", "setting deterministic: expected bool, got 1"),
        ("optimiser.network=fast", "setting optimiser.network: expected float, got 'fast'"),
        ("optimiser.network=true", "setting optimiser.network: expected float, got True"),
        ("optimiser.network=null", "setting optimiser.network: expected float, got None"),
        pytest.param(f"optimiser.network={10**400}", "network: inf is out of range", id="larger than any float"),
        ("initial.points=3", "setting initial.points: expected string, got 3"),
    ],
)
def test_invalid_settings_are_refused(setting: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        with_settings(TrainConfig(), [setting])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_settings_that_are_constants_now_are_read_at_their_value_alone() -> None:
    """Run files of earlier versions have them."""
    assert read({"density": {"split_deg": 5.0}, "network": {"phase_hz": 0.0}}) == TrainConfig()
    with pytest.raises(InputError, match=r"config, setting density.split_deg: 6.0, where this version has 5.0"):
        read({"density": {"split_deg": 6.0}})


@pytest.mark.parametrize(
    "setting",
    [
        *(f"{name}=0" for name in ("batch", "log_every", "validate_every", "checkpoint_every")),
        "seed=-1",
        "holdout_steps_fraction=1.01",
        "loss.ssim_weight=-0.1",
        "initial.gaussians=0",
        "initial.opacity=1",
        "initial.opacity=0",
        "initial.size_deg=0",
        "initial.size_deg=90",
        "initial.nearest_m=0",
        "initial.nearest_m=9",  # beyond the farthest
        "initial.farthest_m=.inf",
        "encoding.position_octaves=0",
        "encoding.tx_octaves=-1",
        "encoding.tx_scale_m=-1",
        "encoding.position_scale_m=-1",
        "optimiser.network=-1e-3",
        "optimiser.network=.nan",
        "optimiser.signal=.inf",
        "optimiser.ema_decay=1",
        "density.every=-1",
        "density.growth_fraction=2",
    ],
)
def test_values_out_of_range(setting: str) -> None:
    name = setting.partition("=")[0]
    with pytest.raises(InputError, match=f"^setting {name}: .*(out of range, choose|beyond)"):
        with_settings(TrainConfig(), [setting])


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("holdout_steps_fraction", 0.0),
        ("holdout_steps_fraction", 1.0),
        ("encoding.tx_octaves", 0),
        ("density.every", 0),
        ("optimiser.ema_decay", 0.0),
        ("seed", 0),
    ],
)
def test_ends_of_ranges_are_accepted(setting: str, value: float) -> None:
    other = with_settings(TrainConfig(), ["holdout_steps_fraction=0.5", "seed=7"])
    config = with_settings(other, [f"{setting}={value}"])
    assert attrgetter(setting)(config) == value
    assert config != other


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stepz": 1}, "config.yaml, setting stepz: unknown; known here: steps, batch,"),
        ({"density": {"evry": 1}}, "config.yaml, setting density.evry: unknown; known here: density.every,"),
        ({"density": 3}, "config.yaml, setting density: expected a mapping, got 3"),
        (None, "config.yaml, setting top: expected a mapping, got None"),
        ({"steps": "3"}, "config.yaml, setting steps: expected int, got '3'"),
    ],
)
def test_invalid_files_are_refused(values: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read(values, "config.yaml")
    assert message in str(caught.value)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_settings(name: str) -> None:
    config = with_settings(TrainConfig(), PRESETS[name])
    assert (config == TrainConfig()) == (name == "default")


def test_paper_preset_equals_the_papers_settings() -> None:
    """Section V-A: L = 9, ten octaves, for Gaussians and transmitter; eta = 0.2."""
    config = with_settings(TrainConfig(), PRESETS["paper"])
    assert (config.encoding.position_octaves, config.encoding.tx_octaves) == (10, 10)
    assert config.loss.ssim_weight == 0.2


def test_zero_steps_resolve_to_the_models_default() -> None:
    near = np.zeros((2, 3))
    assert TrainConfig(model="wrf-gs+").resolved(near).steps == 9000
    assert TrainConfig(model="wrf-gs").resolved(near).steps == 15000
    assert TrainConfig(steps=7).resolved(near).steps == 7


@pytest.mark.parametrize(("extent_m", "scale_m"), [(0, 1), (1.99, 1), (2, 2), (3.9, 2), (8.8, 8), (63, 32)])
def test_zero_scale_distinguishes_all_training_transmitters(extent_m: float, scale_m: float) -> None:
    """Positions a period, two units, apart are one to the network."""
    tx = np.array([[5.0, 1, -7], [5, 1 + extent_m, -7], [5, 1, -7.5]])
    resolved = TrainConfig().resolved(tx)
    assert resolved.encoding.tx_scale_m == scale_m
    assert resolved.resolved(10 * tx) == resolved
    own = with_settings(TrainConfig(), ["encoding.tx_scale_m=0.25"])
    assert own.resolved(tx).encoding.tx_scale_m == 0.25


def test_unresolved_scale_is_refused() -> None:
    with pytest.raises(InputError, match=r"encoding\.tx_scale_m: 0 is resolved by the training transmitters"):
        make_field(TrainConfig())


def test_quick_preset_is_shorter() -> None:
    assert with_settings(TrainConfig(), PRESETS["quick"]).steps < TrainConfig().resolved(np.zeros((1, 3))).steps


def test_description_names_every_setting_and_can_be_set() -> None:
    lines = describe(TrainConfig()).splitlines()
    assert [line.partition("=")[0] for line in lines] == list(DEFAULTS)
    assert with_settings(TrainConfig(steps=7, seed=9), lines) == TrainConfig()
