"""Fields made smaller: which Gaussians go, how numbers are stored, and that the run stays one that is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from made_fields import BATCH, COUNT, POSE, SIZE, Float64, fields, image
from small_fits import settings as small

from wrf_mi.cli.main import main
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.operator import removal
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.runs.api import evaluate_run, open_run, resume, train
from wrf_mi.runs.compressed import COMPRESSION
from wrf_mi.training.compress import Compression, compress, importance, prune
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.fields import make_field
from wrf_mi.training.packed import LEVELS, pack_params, unpack_params
from wrf_mi.training.predictor import Predictor

QUOTIENT_TOLERANCE = 1e-6
"""What lies behind is found by a quotient whose divisor goes down to 1e-3 here, in float64."""


def of_transmitter(gaussians: Gaussians, b: int) -> Gaussians:
    def taken(values: Any) -> Any:
        return dr.gather(Float64, values, dr.arange(mi.UInt32, COUNT) + b * COUNT)

    return gaussians.mapped(taken, signal=[taken(part) for part in gaussians.signal], batch=1)


@pytest.mark.parametrize("product", [False, True])
def test_removal_equals_change_of_the_image_without_the_gaussian(product: bool) -> None:
    """Against images without one Gaussian."""
    gaussians = fields(4, product)
    plane = perception_plane(*SIZE, Float64)
    found = np.stack([removal(of_transmitter(gaussians, b), POSE, plane) for b in range(BATCH)])
    whole = image(gaussians)
    for i in range(0, COUNT, 5):
        without = fields(4, product)
        keep = Float64((np.arange(BATCH * COUNT) % COUNT != i).astype(float))
        if product:
            assert without.attenuation is not None
            without.attenuation = [without.attenuation[0] * keep + (1 - keep), without.attenuation[1] * keep]
        else:
            without.opacity = without.opacity * keep
        without.signal = [s * keep for s in without.signal]
        expected = np.abs(image(without) - whole).reshape(BATCH, -1).sum(axis=1)
        np.testing.assert_allclose(found[:, i], expected, rtol=QUOTIENT_TOLERANCE, atol=1e-9)
    assert (found > 0).any()


NAMES = ("position", "deform.0.hidden", "deform.0.bias")
HALF_RELATIVE, HALF_ABSOLUTE = 2.0**-11, 2.0**-25
"""Half a unit in the last place of binary16, and half its smallest (subnormal) number."""


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["single", "half", "8bit"]),
    *[hnp.arrays(np.float32, shape, elements=st.floats(-50, 50, width=32)) for shape in ((3, 7), (5, 6), (5, 1))],
)
def test_packing_error_is_within_its_bound(precision: str, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    params = dict(zip(NAMES, (a, b, c), strict=True))
    packed = pack_params(params, precision)
    assert all(values.dtype != object for values in packed.values())
    back = unpack_params(packed)
    assert list(back) == list(params)
    for name, values in params.items():
        assert back[name].shape == values.shape
        error = np.abs(back[name].astype(float) - values)
        if precision == "single":
            assert not error.any()
        elif precision == "8bit" and name == "deform.0.hidden":
            step = np.ptp(values.astype(float), axis=1, keepdims=True) / LEVELS
            # Half a step, and the rounding of the step itself over 255 of them.
            assert (error <= step * (0.5 + 1e-4) + 1e-5).all()
        else:
            assert (error <= HALF_RELATIVE * np.abs(values) + HALF_ABSOLUTE).all()


def test_numbers_too_large_for_half_are_refused() -> None:
    with pytest.raises(InputError, match="too large for it; choose single"):
        pack_params({"position": np.full((3, 2), 1e6, np.float32)}, "half")
    with pytest.raises(InputError, match="unknown; choose from single, half, 8bit"):
        pack_params({}, "quarter")


@pytest.fixture(scope="module")
def run(one_gateway: Record, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short fit of eight Gaussians."""
    out = tmp_path_factory.mktemp("runs") / "run"
    return train(
        str(folder),
        out,
        "wrf-gs+",
        settings=small("steps=60", "holdout_steps_fraction=0", "network.width=32", "network.layers=4"),
    ).folder


def test_prune_removes_the_least_important_gaussian(run: Path, one_gateway: Record) -> None:
    """A Gaussian that is made idle has no importance, and is the one that pruning drops."""
    config, params = open_run(run).field.config, dict(open_run(run).field.params)
    params["opacity"] = params["opacity"].copy()
    params["opacity"][0, 3] = -30.0
    split = make_splits(one_gateway, "official")[0]
    score = importance(config, params, one_gateway, split)
    assert np.argmin(score) == 3
    assert score[3] < 1e-9 < np.sort(score)[1]
    less = prune(params, make_field(config).per_gaussian, score, 7)
    np.testing.assert_array_equal(less["position"], np.delete(params["position"], 3, axis=1))
    same = [
        Predictor(make_field(config), own, one_gateway.receivers, 20, 40)(one_gateway.tx_pos_m[:2])
        for own in (params, less)
    ]
    np.testing.assert_allclose(*same, atol=1e-6)


def test_compressed_run_opens_as_a_run(
    run: Path, one_gateway: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "small"
    call = ["compress", str(run), "--out", str(out), "--budget", "6", "--precision", "8bit", "--fine-tune", "5"]
    assert main([*call, "--json"]) == 0
    printed = capsys.readouterr()
    assert "fine-tune 5/5" in printed.err
    found = json.loads(printed.out)
    assert found == json.loads((out / COMPRESSION).read_text())
    assert found["after"]["gaussians"] == 6
    assert found["after"]["bytes"] == (out / "model.npz").stat().st_size
    assert found["times_smaller"] > 1.5
    assert found["after"]["ssim"] == evaluate_run(out)["ssim"]["median"]
    assert open_run(out).predictor()(one_gateway.tx_pos_m[:1]).shape == (1, 20, 40)
    assert resume(out).metrics["ssim"]["median"] == found["after"]["ssim"]  # nothing is left to train
    assert main(call) == 2
    assert "choose another --out" in capsys.readouterr().err


@pytest.mark.parametrize(("precision", "most"), [("single", 0.0), ("half", 5e-3), ("8bit", 5e-2)])
def test_packing_changes_spectra_within_tolerance(precision: str, most: float, run: Path, one_gateway: Record) -> None:
    """Greys of the same field from its numbers in few bits, whose errors add up over the layers."""
    field, params = open_run(run).field.field, open_run(run).field.params
    few = unpack_params(pack_params(params, precision))
    say = [Predictor(field, own, one_gateway.receivers, 20, 40)(one_gateway.tx_pos_m[:3]) for own in (params, few)]
    assert np.abs(say[0] - say[1]).max() <= most


@pytest.mark.parametrize(
    ("sizes", "model", "steps"),
    [({"width": 8, "layers": 2}, "wrf-gs+", 80), ({"terms": 4, "width": 16}, "factorised", 80)],
)
def test_distillation_recovers_the_teachers_spectra(
    sizes: dict[str, int], model: str, steps: int, run: Path, one_gateway: Record
) -> None:
    config, params = open_run(run).field.config, dict(open_run(run).field.params)
    split = make_splits(one_gateway, "official")[0]
    rows = one_gateway.tx_pos_m[split.test]

    def error(own: tuple[TrainConfig, dict[str, np.ndarray]]) -> float:
        say = [Predictor(make_field(c), p, one_gateway.receivers, 20, 40)(rows) for c, p in ((config, params), own)]
        return float(np.abs(say[0] - say[1]).mean())

    untaught, taught = (
        compress(config, params, one_gateway, split, Compression(**sizes, distil=count)) for count in (0, steps)
    )
    assert taught[0].model == model
    assert [getattr(taught[0].network, name) for name in sizes] == list(sizes.values())
    small, large = (sum(v.size for k, v in own.items() if "." in k) for own in (taught[1], params))
    assert small < large / 2
    assert error(taught) < 0.7 * error(untaught)


@pytest.mark.parametrize(
    ("how", "message"),
    [({"budget": -1}, "budget -1"), ({"fine_tune": -2}, "fine-tune -2"), ({"precision": "x"}, "unknown; choose from")],
)
def test_invalid_compressions_are_refused(how: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Compression(**how)  # type: ignore[arg-type]


def test_budget_above_number_of_gaussians_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compress", str(run), "--out", str(tmp_path / "x"), "--budget", "9"]) == 2
    assert "has 8 Gaussians; choose fewer" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_sizes_of_networks_are_settings() -> None:
    def field(*own: str) -> Any:
        return make_field(small(*own).resolved(np.zeros((1, 3))))

    assert (field().width, field().layers) == (256, 8)
    plus = field("network.width=32", "network.layers=4", "network.static_geometry=true")
    assert (plus.width, plus.layers, plus.skip, plus.static_geometry) == (32, 4, 2, True)
    first = field("model=wrf-gs", "network.width=16")
    assert (first.width, first.signal_widths, first.layers) == (16, (16, 8), 8)
    terms = field("model=factorised", "network.terms=5", "network.width=16")
    assert (terms.terms, terms.width, terms.layers) == (5, 16, 3)
    for bad in (
        ("model=wrf-gs", "network.static_geometry=true"),
        ("model=wrf-gs", "network.phase_hz=1e9"),
        ("network.terms=4",),
    ):
        with pytest.raises(InputError, match="omit it"):
            field(*bad)
