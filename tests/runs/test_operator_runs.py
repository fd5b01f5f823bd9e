"""Predictions of trained fields by operator: those of splatting, stored with the run, built anew when they must be."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_spectra import OCTAVES, RECEIVERS, SIZE, true_field
from small_fits import settings

from wrf_mi.backend.device import to_tensor
from wrf_mi.cli.main import main
from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.gaussians import Encoding, Factorised, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.operator import recorded_signals, static_signals
from wrf_mi.runs.api import open_run, predict_to_file, train
from wrf_mi.training import evaluator
from wrf_mi.training.evaluator import OperatorReports, Request, read_weights
from wrf_mi.training.predictor import Predictor

GREYS = 1e-5
"""Largest difference of greys up to about one: float32 sums of some ten terms in another order."""
SIGNALS = 1e-4
"""Relative L2 error of signals: float32 networks, sines of large arguments, in another order."""

TX = np.random.default_rng(5).uniform(-1, 1, (3, 3))


def made(model: str) -> tuple[Any, dict[str, np.ndarray]]:
    if model == "wrf-gs":
        return true_field(model)
    rng = np.random.default_rng(0)
    field: Any = (
        Factorised(encoding=OCTAVES, terms=5, layers=2, width=16)
        if model == "factorised"
        else WrfGsPlus(encoding=OCTAVES, width=16, layers=3, skip=1, static_geometry=True)
    )
    start = random_gaussians(RECEIVERS[:1], 8, rng, (1.0, 4.0), 12.0, 0.5, 1.0)
    return field, field.init(start, rng)


class Operator:
    """Operators of a field's receivers, called with transmitters and the number of a receiver."""

    def __init__(self, field: Any, params: Any, receivers: Any, height: int, width: int, store: Path | None = None):
        self.reports = OperatorReports(Predictor.of_field(field, params, receivers, height, width).graph, store)
        self.reports.update({name: to_tensor(values) for name, values in params.items()})

    def __call__(self, tx_pos_m: np.ndarray, receiver: int) -> np.ndarray:
        return self.reports(Request(tx_pos_m, receiver, None, np.arange(len(tx_pos_m))))

    def key(self, receiver: int) -> str:
        return self.reports.key(receiver)


MODELS = ["wrf-gs", "factorised", "wrf-gs+ still"]


@pytest.mark.parametrize("model", MODELS)
def test_operator_predicts_as_splatting_does(model: str) -> None:
    field, params = made(model)
    direct = Predictor.of_field(field, params, RECEIVERS, *SIZE)
    by_operator = Predictor.of_field(field, params, RECEIVERS, *SIZE, operator=True)
    for receiver in range(2):
        expected = direct(TX, receiver)
        assert np.abs(expected - expected[:1]).max() > 0.01
        np.testing.assert_allclose(by_operator(TX, receiver), expected, atol=GREYS)
    # Other parameters: everything is built anew.
    params["position"] = params["position"] + np.float32(0.2)
    for predictor in (direct, by_operator):
        predictor.update({name: direct.evaluate.params[name] * 1 for name in params})
        predictor.update(Predictor.of_field(field, params, RECEIVERS, *SIZE).evaluate.params)
    assert np.abs(direct(TX) - expected).max() > 0.01
    np.testing.assert_allclose(by_operator(TX), direct(TX), atol=GREYS)


def test_moving_geometry_is_splatted() -> None:
    """WRF-GS+ turns and stretches its Gaussians with the transmitter."""
    field, params = true_field("wrf-gs+")
    asked = Predictor.of_field(field, params, RECEIVERS, *SIZE, operator=True)
    np.testing.assert_array_equal(asked(TX), Predictor.of_field(field, params, RECEIVERS, *SIZE)(TX))
    assert not isinstance(asked.evaluate, OperatorReports)


@pytest.mark.parametrize(
    "field",
    [
        WrfGs(Encoding(3, 4.0, 2, 1.0), layers=3, width=16, signal_widths=(12, 8)),
        WrfGs(Encoding(1, 4.0, 0, 1.0), layers=2, width=16, signal_widths=(12, 8)),
        Factorised(Encoding(0, 4.0, 3, 0.5), terms=4, layers=3, width=16),
    ],
)
def test_networks_in_numpy_equal_those_of_the_field(field: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    params = field.init(random_gaussians(RECEIVERS[:1], 30, rng), rng)
    params = {k: v + 0.1 * rng.standard_normal(v.shape).astype(np.float32) for k, v in params.items()}
    tx = rng.uniform(-3, 3, (7, 3)).astype(np.float32)
    expected = recorded_signals(field, params)(tx)
    monkeypatch.setattr("wrf_mi.gaussians.operator.PAIRS_PER_CHUNK", 100)  # three transmitters at a time
    factors, coefficients = static_signals(field, params)
    found = coefficients(tx)
    if factors is not None:
        found = found @ factors.T
    assert np.linalg.norm(found - expected) < SIGNALS * np.linalg.norm(expected)


@pytest.fixture(scope="module")
def run(one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = settings("steps=5", model="factorised")
    return train(one_gateway, tmp_path_factory.mktemp("runs") / "run", config.model, settings=config).folder


def test_operator_is_stored_with_the_run(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = run / "operator0.npz"
    first = stored.read_bytes()
    with np.load(stored, allow_pickle=False) as arrays:
        assert set(arrays.files) == {"format", "key", "data", "indices", "indptr", CHECKSUM}
    built = open_run(run).predictor()(TX)

    def never(*_: Any) -> None:
        raise AssertionError("built although it is stored")

    monkeypatch.setattr(evaluator, "pixel_weights", never)
    np.testing.assert_array_equal(open_run(run).predictor()(TX), built)
    assert stored.read_bytes() == first
    np.testing.assert_allclose(open_run(run, operator=False).predictor()(TX), built, atol=GREYS)
    stored.unlink()
    with pytest.raises(AssertionError, match="although"):
        open_run(run).predictor()(TX)
    stored.write_bytes(first)
    for name, operator in (("with.npz", True), ("without.npz", False)):
        predict_to_file(run, TX, tmp_path / name, operator=operator)
    with np.load(tmp_path / "with.npz") as a, np.load(tmp_path / "without.npz") as b:
        np.testing.assert_allclose(a["prediction"], b["prediction"], atol=GREYS)


def test_no_operator_option_splats(run: Path, tmp_path: Path) -> None:
    """The operator is not built."""
    (tmp_path / "tx.csv").write_text("x,y,z\n0.1,0.2,0.3\n")
    own = tmp_path / "run"
    shutil.copytree(run, own)
    stored = own / "operator0.npz"
    found = {}
    for extra, there in (("--no-operator", False), (None, True)):
        stored.unlink(missing_ok=True)
        out = tmp_path / "out.npz"
        words = ["predict", str(own), "--tx", str(tmp_path / "tx.csv"), "--out", str(out), *([extra] if extra else [])]
        assert main(words) == 0
        assert stored.exists() == there
        with np.load(out) as arrays:
            found[there] = arrays["prediction"]
    np.testing.assert_allclose(found[True], found[False], atol=GREYS)


CHANGES = {
    "another place": lambda f, p, r, s: (f, p, replace(r, position_m=r.position_m + 1e-6), s),
    "turned": lambda f, p, r, s: (f, p, replace(r, orientation_xyzw=np.array([0, 0, 1.0, 0])), s),
    "another size": lambda f, p, r, s: (f, p, r, (SIZE[0], SIZE[1] + 1)),
    "a Gaussian moved": lambda f, p, r, s: (f, p | {"position": p["position"] + np.float32(1e-3)}, r, s),
    "another scale": lambda f, p, r, s: (f, p | {"log_scale": p["log_scale"] * np.float32(1.01)}, r, s),
    "another opacity": lambda f, p, r, s: (f, p | {"opacity": -p["opacity"]}, r, s),
    "one Gaussian less": lambda f, p, r, s: (
        f,
        {k: v[:, 1:] if k in f.per_gaussian else v for k, v in p.items()},
        r,
        s,
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_changed_geometry_rebuilds_the_operator(what: str, tmp_path: Path) -> None:
    field, params = made("factorised")
    before = Operator(field, params, RECEIVERS[:1], *SIZE, tmp_path)
    before(TX, 0)
    field, params, receiver, size = CHANGES[what](field, params, RECEIVERS[0], SIZE)
    after = Operator(field, params, [receiver], *size, tmp_path)
    assert after.key(0) != before.key(0)
    expected = Predictor.of_field(field, params, [receiver], *size)(TX)
    np.testing.assert_allclose(after(np.float32(TX), 0), expected, atol=GREYS)
    # Stored in place of the one before.
    count = params["position"].shape[1]
    assert read_weights(tmp_path / "operator0.npz", after.key(0), (size[0] * size[1], count)) is not None


@pytest.mark.parametrize("model", MODELS)
def test_changed_signals_keep_the_operator(model: str) -> None:
    """Another signal network or other coefficients: the same weights serve."""
    field, params = made(model)
    changed = {k: v * 2 if k.startswith(field.signal_parameters) else v for k, v in params.items()}
    assert any(k.startswith(field.signal_parameters) for k in params)
    keys = {Operator(field, p, RECEIVERS[:1], *SIZE).key(0) for p in (params, changed)}
    assert len(keys) == 1
    if model == "wrf-gs":
        other = params | {"attenuation.1.bias": params["attenuation.1.bias"] + np.float32(0.1)}
        assert Operator(field, other, RECEIVERS[:1], *SIZE).key(0) not in keys


@pytest.mark.parametrize("damage", ["cut", "text", "outside", "short", "format"])
def test_damaged_store_is_built_anew(damage: str, tmp_path: Path) -> None:
    field, params = made("factorised")
    expected = Operator(field, params, RECEIVERS[:1], *SIZE, tmp_path)(TX, 0)
    path = tmp_path / "operator0.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:200])
    elif damage == "text":
        path.write_text("no arrays")
    else:
        if damage == "outside":
            arrays["indices"] = arrays["indices"] + 8
        elif damage == "short":
            arrays["data"] = arrays["data"][:-1]
        else:
            arrays["format"] = np.asarray(99)
        np.savez(path, **arrays)
    again = Operator(field, params, RECEIVERS[:1], *SIZE, tmp_path)
    np.testing.assert_array_equal(again(TX, 0), expected)
    assert read_weights(path, again.key(0), (SIZE[0] * SIZE[1], 8)) is not None


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_operator_works_in_a_read_only_folder(tmp_path: Path) -> None:
    field, params = made("factorised")
    tmp_path.chmod(0o500)
    found = Operator(field, params, RECEIVERS[:1], *SIZE, tmp_path)(TX, 0)
    np.testing.assert_array_equal(found, Operator(field, params, RECEIVERS[:1], *SIZE)(TX, 0))
    assert not any(tmp_path.iterdir())


def test_too_large_operator_is_replaced_by_splatting(monkeypatch: pytest.MonkeyPatch) -> None:
    field, params = made("factorised")
    monkeypatch.setattr(evaluator, "MOST_BYTES", 1000)
    asked = Predictor.of_field(field, params, RECEIVERS[:1], *SIZE, operator=True)
    with pytest.warns(UserWarning, match="operator: weights of 8 Gaussians take more than"):
        found = asked(TX)
    np.testing.assert_array_equal(found, Predictor.of_field(field, params, RECEIVERS[:1], *SIZE)(TX))
    np.testing.assert_array_equal(asked(TX), found)  # and says so once


def test_factorised_field_needs_the_transmitter() -> None:
    with pytest.raises(InputError, match="tx_octaves: 0 leaves factorised nothing to see"):
        Factorised(Encoding(tx_octaves=0))


def test_factorised_field_is_the_sum_of_its_terms() -> None:
    """S = C phi, per transmitter."""
    field, params = made("factorised")
    tensors = {name: to_tensor(values) for name, values in params.items()}
    tx = to_tensor(TX.T)
    phi = field.functions(tensors, tx).numpy()
    phi, c = phi[:5] + 1j * phi[5:], params["signal"][:5] + 1j * params["signal"][5:]
    re, im = field.gaussians(tensors, tx).signal
    np.testing.assert_allclose((re.numpy() + 1j * im.numpy()).reshape(3, 8), phi.T @ c, atol=1e-5)


def test_each_receiver_has_its_operator(tmp_path: Path) -> None:
    field, params = made("factorised")
    both = Operator(field, params, RECEIVERS, *SIZE, tmp_path)
    assert isinstance(RECEIVERS[1], Receiver)
    assert np.abs(both(TX, 0) - both(TX, 1)).max() > 0.01
    assert sorted(p.name for p in tmp_path.iterdir()) == ["operator0.npz", "operator1.npz"]
