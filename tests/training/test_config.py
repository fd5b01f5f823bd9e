"""Settings of a fit: what is accepted, what is refused, and that none is lost on the way to a file and back."""

import dataclasses
from dataclasses import asdict
from operator import attrgetter
from typing import Any, get_type_hints

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from wrf_mi.core import InputError
from wrf_mi.core.settings import settings_from, with_settings
from wrf_mi.training.config import PRESETS, TrainConfig
from wrf_mi.training.fields import make_field


def leaves(values, prefix=""):
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def read(values, source="config"):
    return settings_from(TrainConfig, values, source)


DEFAULTS = leaves(asdict(TrainConfig()))
ONES = "holdout_steps_fraction loss.ssim_weight optimiser.cosine_start optimiser.final density.start density.stop"
LARGEST = (
    dict.fromkeys([*ONES.split(), "density.growth_fraction"], 1.0)
    | {"initial.size_deg": 89.0, "initial.opacity": 0.999, "optimiser.ema_decay": 0.9999}
    | {"traced.alone": 0.4, "traced.faint": 0.4, "traced.depth": 12, "traced.pattern_degree": 8, "traced.rays": 1 << 24}
)
CHOICES = {"receiver": ["auto", "pixel", "array"], "traced.materials": ["named", "surface"]}
CHOICES |= {"evaluation": ["splatted", "traced"]}


def good_values(name, default):
    if name in CHOICES:
        return st.sampled_from(CHOICES[name])
    if isinstance(default, bool):
        return st.booleans()
    if isinstance(default, int):
        return st.integers(1, int(LARGEST.get(name, 10**9)))
    if isinstance(default, str):
        return st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    # The nearest is not beyond the farthest.
    low, high = {"initial.nearest_m": (0.01, 1.0), "initial.farthest_m": (1.0, 1000.0)}.get(name, (0.001, 1e6))
    return st.floats(low, LARGEST.get(name, high))


@st.composite
def configurations(draw):
    """Any valid configuration, most settings changed."""

    def build(kind, prefix):
        types = get_type_hints(kind)
        values = {}
        for field in dataclasses.fields(kind):
            name = f"{prefix}{field.name}"
            if dataclasses.is_dataclass(types[field.name]):
                values[field.name] = build(types[field.name], f"{name}.")
            else:
                values[field.name] = draw(good_values(name, DEFAULTS[name]))
        if prefix == "initial.":
            source = draw(st.sampled_from(["points", "mesh", "paths"]))  # Gaussians start from one
            values |= {other: "" for other in ("points", "mesh", "paths") if other != source}
        return kind(**values)

    return build(TrainConfig, "")


@given(configurations())
@settings(max_examples=30, deadline=None)
def test_a_configuration_survives_a_dictionary_a_file_and_settings_as_text(config):
    """Values as they are typed after ``--set key=``."""
    assert read(asdict(config)) == config
    assert read(yaml.safe_load(yaml.safe_dump(asdict(config)))) == config
    changed = [(name, value) for name, value in leaves(asdict(config)).items() if value != DEFAULTS[name]]
    typed = {name: yaml.safe_dump(value, width=1000).removesuffix("...\n").strip() for name, value in changed}
    assert with_settings(TrainConfig(), [f"{name}={text}" for name, text in typed.items()]) == config


def test_missing_settings_keep_their_defaults_and_the_last_of_several_counts():
    assert read({}) == TrainConfig()
    config = read({"steps": 5, "density": {"growth_fraction": 0.5}})
    assert (config.steps, config.density.growth_fraction, config.density.every) == (5, 0.5, TrainConfig().density.every)
    assert with_settings(TrainConfig(), ["steps=1", "batch=2", "steps=3"]).steps == 3


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        *(("steps=2000", 2000), ("deterministic=true", True), ("deterministic=no", False)),
        *((f"optimiser.network={text}", 0.001) for text in ("1e-3", "1.0e-3")),  # YAML 1.1 reads the first as text
        *(("optimiser.network=.5", 0.5), ("optimiser.position=1", 1.0)),  # a whole number where a float is due
        *(("initial.farthest_m=2e1", 20.0), ("initial.points=cloud.ply", "cloud.ply")),
        *((" model =wrf-gs", "wrf-gs"), ("initial.points=", ""), ("initial.points=a=b.ply", "a=b.ply")),
    ],
)
def test_setting_changes_one_value_and_keeps_its_type(setting, value):
    flat, name = leaves(asdict(with_settings(TrainConfig(), [setting]))), setting.partition("=")[0].strip()
    assert (flat[name], type(flat[name])) == (value, type(value))
    assert flat == DEFAULTS | {name: value}


WRONG_TYPES = [
    *(("steps", "int", text, text) for text in ("many", "", "1e3")),
    *(("steps", "int", "1.5", 1.5), ("steps", "int", "true", True)),
    *(("optimiser.network", "float", text, got) for text, got in {"fast": "fast", "true": True, "null": None}.items()),
    *(("deterministic", "bool", "1", 1), ("initial.points", "string", "3", 3)),
]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        *((f"{name}={text}", f"setting {name}: expected {kind}, got {got!r}") for name, kind, text, got in WRONG_TYPES),
        *(("steps", "--set steps: expected key=value"), ("stepz=1", "--set stepz=1: unknown setting stepz")),
        *((f"{name}=1", f"unknown setting {name}") for name in ("optimiser.nothing", "optimiser", "steps.more", "")),
        *(("steps=[1", "'[1' is no YAML value"), ("steps=2024-13-45", "'2024-13-45' is no YAML value")),
        pytest.param(f"optimiser.network={10**400}", "network: inf is out of range", id="larger than any float"),
    ],
)
def test_invalid_settings_are_refused(setting, message):
    with pytest.raises(InputError) as caught:
        with_settings(TrainConfig(), [setting])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_settings_that_are_constants_now_are_read_at_their_value_alone():
    """Run files of earlier versions have them."""
    assert read({"density": {"split_deg": 5.0}, "network": {"phase_hz": 0.0}}) == TrainConfig()
    with pytest.raises(InputError, match=r"config, setting density.split_deg: 6.0, where this version has 5.0"):
        read({"density": {"split_deg": 6.0}})


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((name, "0") for name in ("batch", "log_every", "validate_every", "checkpoint_every", "initial.gaussians")),
        *(("seed", "-1"), ("holdout_steps_fraction", "1.01"), ("loss.ssim_weight", "-0.1"), ("initial.opacity", "0 1")),
        *(("initial.size_deg", "0 90"), ("initial.nearest_m", "0 9"), ("initial.farthest_m", ".inf")),  # beyond: 9
        *(("encoding.position_octaves", "0"), ("encoding.tx_octaves", "-1"), ("encoding.tx_scale_m", "-1")),
        *(("encoding.position_scale_m", "-1"), ("optimiser.network", "-1e-3 .nan"), ("optimiser.signal", ".inf")),
        *(("optimiser.ema_decay", "1"), ("density.every", "-1"), ("density.growth_fraction", "2")),
    ],
)
def test_values_out_of_range(name, values):
    for value in values.split():
        with pytest.raises(InputError, match=f"^setting {name}: .*(out of range, choose|beyond)"):
            with_settings(TrainConfig(), [f"{name}={value}"])


def test_ends_of_ranges_are_accepted():
    zero = "encoding.tx_octaves", "density.every", "optimiser.ema_decay", "seed", "holdout_steps_fraction"
    start = with_settings(TrainConfig(), ["holdout_steps_fraction=0.5", "seed=7"])
    for name, value in (*((name, 0) for name in zero), ("holdout_steps_fraction", 1.0)):
        config = with_settings(start, [f"{name}={value}"])
        assert (name, attrgetter(name)(config)) == (name, value)
        assert config != start, name


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stepz": 1}, "config.yaml, setting stepz: unknown; known here: steps, batch,"),
        ({"density": {"evry": 1}}, "config.yaml, setting density.evry: unknown; known here: density.every,"),
        (None, "config.yaml, setting top: expected a mapping, got None"),
    ],
)
def test_invalid_files_are_refused(values, message):
    with pytest.raises(InputError) as caught:
        read(values, "config.yaml")
    assert message in str(caught.value)


def test_presets_are_settings():
    """The paper's: section V-A: L = 9, ten octaves, for Gaussian and transmitter; eta = 0.2."""
    configs = {name: with_settings(TrainConfig(), values) for name, values in PRESETS.items()}
    assert [name for name, config in configs.items() if config == TrainConfig()] == ["default"]
    paper = configs["paper"]
    assert (paper.encoding.position_octaves, paper.encoding.tx_octaves, paper.loss.ssim_weight) == (10, 10, 0.2)
    assert configs["fast"].steps < TrainConfig().resolved(np.zeros((1, 3))).steps < configs["best"].steps


def test_zero_steps_resolve_to_the_models_default():
    for config, steps in ({"model": "wrf-gs+"}, 9000), ({"model": "wrf-gs"}, 15000), ({"steps": 7}, 7):
        assert TrainConfig(**config).resolved(np.zeros((2, 3))).steps == steps, config


@pytest.mark.parametrize(("extent_m", "scale_m"), [(0, 1), (1.99, 1), (2, 2), (3.9, 2), (8.8, 8), (63, 32)])
def test_zero_scale_distinguishes_all_training_transmitters(extent_m, scale_m):
    """Positions a period, two units, apart are one to the network."""
    tx = np.array([[5.0, 1, -7], [5, 1 + extent_m, -7], [5, 1, -7.5]])
    resolved = TrainConfig().resolved(tx)
    assert resolved.encoding.tx_scale_m == scale_m
    assert resolved.resolved(10 * tx) == resolved
    config = with_settings(TrainConfig(), ["encoding.tx_scale_m=0.25"])
    assert config.resolved(tx).encoding.tx_scale_m == 0.25
    with pytest.raises(InputError, match=r"encoding\.tx_scale_m: 0 is resolved by the training transmitters"):
        make_field(TrainConfig())
