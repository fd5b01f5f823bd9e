"""Predictions of trained fields by operator: those of splatting, stored with the run, built anew when they must be."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import contents, copied
from commands import Command, arrays_in, positions_file
from made_spectra import OCTAVES, RECEIVERS, SIZE, spectra_predictor, true_field
from small_fits import settings

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import InputError, Record
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.gaussians import Encoding, Factorised, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.operator import recorded_signals, static_signals
from wrf_mi.runs.api import open_run, predict_to_file, train
from wrf_mi.training import evaluator
from wrf_mi.training.evaluator import OperatorObservations, Request, read_weights
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
    field: Any = WrfGsPlus(encoding=OCTAVES, width=16, layers=3, skip=1, static_geometry=True)
    if model == "factorised":
        field = Factorised(encoding=OCTAVES, terms=5, layers=2, width=16)
    return field, field.init(random_gaussians(RECEIVERS[:1], 8, rng, (1.0, 4.0), 12.0, 0.5, 1.0), rng)


def predictor(field: Any, params: Any, receivers: Any = RECEIVERS[:1], size: Any = SIZE, **more: Any) -> Predictor:
    return spectra_predictor(field, params, receivers, *size, **more)


class Operator:
    """Operators of a field's receivers, called with transmitters and the number of a receiver."""

    def __init__(self, field: Any, params: Any, receivers: Any = RECEIVERS[:1], size: Any = SIZE, store: Any = None):
        self.evaluate = OperatorObservations(predictor(field, params, receivers, size).graph, store)
        self.evaluate.update({name: to_tensor(values) for name, values in params.items()})

    def __call__(self, receiver: int = 0, tx_pos_m: np.ndarray = TX) -> np.ndarray:
        return self.evaluate(Request(tx_pos_m, receiver, None, np.arange(len(tx_pos_m))))


MODELS = ["wrf-gs", "factorised", "wrf-gs+ still"]


@pytest.mark.parametrize("model", MODELS)
def test_operator_predicts_as_splatting_does(model: str) -> None:
    field, params = made(model)
    direct = predictor(field, params, RECEIVERS)
    by_operator = predictor(field, params, RECEIVERS, operator=True)
    for receiver in range(2):
        expected = direct(TX, receiver)
        assert np.abs(expected - expected[:1]).max() > 0.01
        np.testing.assert_allclose(by_operator(TX, receiver), expected, atol=GREYS)
    # Other parameters: everything is built anew.
    params["position"] = params["position"] + np.float32(0.2)
    for changed in (direct, by_operator):
        changed.update({name: direct.evaluate.params[name] * 1 for name in params})
        changed.update(predictor(field, params, RECEIVERS).evaluate.params)
    assert np.abs(direct(TX) - expected).max() > 0.01
    np.testing.assert_allclose(by_operator(TX), direct(TX), atol=GREYS)


def test_moving_geometry_is_splatted() -> None:
    """WRF-GS+ turns and stretches its Gaussians with the transmitter."""
    field, params = true_field("wrf-gs+")
    asked = predictor(field, params, operator=True)
    np.testing.assert_array_equal(asked(TX), predictor(field, params)(TX))
    assert not isinstance(asked.evaluate, OperatorObservations)


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
    computed = coefficients(tx)
    if factors is not None:
        computed = computed @ factors.T
    assert np.linalg.norm(computed - expected) < SIGNALS * np.linalg.norm(expected)


@pytest.fixture(scope="module")
def run(one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = settings("steps=5", model="factorised")
    return train(one_gateway, config.model, out=tmp_path_factory.mktemp("runs") / "run", settings=config).folder


def test_operator_is_stored_with_the_run(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = run / "operator0.npz"
    first = stored.read_bytes()
    assert set(arrays_in(stored)) == {"format", "key", "data", "indices", "indptr", CHECKSUM}
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
    by_operator, splatted = tmp_path / "with.npz", tmp_path / "without.npz"
    predict_to_file(run, TX, by_operator, operator=True)
    predict_to_file(run, TX, splatted, operator=False)
    np.testing.assert_allclose(arrays_in(by_operator)["prediction"], arrays_in(splatted)["prediction"], atol=GREYS)


def test_no_operator_option_splats(run: Path, tmp_path: Path, command: Command) -> None:
    """The operator is not built."""
    stored, predictions = copied(run, tmp_path / "run") / "operator0.npz", {}
    stored.unlink()
    words = ["predict", tmp_path / "run", "--tx", positions_file(tmp_path / "tx.csv", TX)]
    for built, option in ((False, ["--no-operator"]), (True, [])):
        command.done([*words, "--out", tmp_path / "out.npz", *option])
        assert stored.exists() == built
        predictions[built] = arrays_in(tmp_path / "out.npz")["prediction"]
    np.testing.assert_allclose(predictions[True], predictions[False], atol=GREYS)


PLACE = RECEIVERS[0].position_m
CHANGES: dict[str, tuple[Any, Any, Any]] = {
    "another place": ({}, {"position_m": PLACE + 1e-6}, SIZE),
    "turned": ({}, {"orientation_xyzw": np.array([0, 0, 1.0, 0])}, SIZE),
    "another size": ({}, {}, (SIZE[0], SIZE[1] + 1)),
    "a Gaussian moved": ({"position": lambda values: values + np.float32(1e-3)}, {}, SIZE),
    "another scale": ({"log_scale": lambda values: values * np.float32(1.01)}, {}, SIZE),
    "another opacity": ({"opacity": lambda values: -values}, {}, SIZE),
    "one Gaussian less": (dict.fromkeys(made("factorised")[0].per_gaussian, lambda values: values[:, 1:]), {}, SIZE),
}
"""Changes of parameters, of the receiver and of the size of its observation."""


@pytest.mark.parametrize("what", CHANGES)
def test_changed_geometry_rebuilds_the_operator(what: str, tmp_path: Path) -> None:
    field, params = made("factorised")
    before = Operator(field, params, store=tmp_path)
    before()
    functions, pose, size = CHANGES[what]
    params = {name: functions[name](values) if name in functions else values for name, values in params.items()}
    receiver = replace(RECEIVERS[0], **pose)
    after = Operator(field, params, [receiver], size, tmp_path)
    assert after.evaluate.key(0) != before.evaluate.key(0)
    expected = predictor(field, params, [receiver], size)(TX)
    np.testing.assert_allclose(after(0, np.asarray(TX, np.float32)), expected, atol=GREYS)
    # Stored in place of the one before.
    count = params["position"].shape[1]
    assert read_weights(tmp_path / "operator0.npz", after.evaluate.key(0), (size[0] * size[1], count)) is not None


@pytest.mark.parametrize("model", MODELS)
def test_changed_signals_keep_the_operator(model: str) -> None:
    """Another signal network or other coefficients: the same weights serve."""
    field, params = made(model)
    changed = {k: v * 2 if k.startswith(field.signal_parameters) else v for k, v in params.items()}
    assert any(k.startswith(field.signal_parameters) for k in params)
    key, same = (Operator(field, values).evaluate.key(0) for values in (params, changed))
    assert key == same
    if model == "wrf-gs":
        other = params | {"attenuation.1.bias": params["attenuation.1.bias"] + np.float32(0.1)}
        assert Operator(field, other).evaluate.key(0) != key


DAMAGES: dict[str, Any] = {
    "cut": lambda file, arrays: file.write_bytes(file.read_bytes()[:200]),
    "text": lambda file, arrays: file.write_text("no arrays"),
    "outside": lambda file, arrays: np.savez(file, **arrays | {"indices": arrays["indices"] + 8}),
    "short": lambda file, arrays: np.savez(file, **arrays | {"data": arrays["data"][:-1]}),
    "format": lambda file, arrays: np.savez(file, **arrays | {"format": np.asarray(99)}),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_store_is_built_anew(damage: str, tmp_path: Path) -> None:
    field, params = made("factorised")
    expected, file = Operator(field, params, store=tmp_path)(), tmp_path / "operator0.npz"
    DAMAGES[damage](file, arrays_in(file))
    again = Operator(field, params, store=tmp_path)
    np.testing.assert_array_equal(again(), expected)
    assert read_weights(file, again.evaluate.key(0), (SIZE[0] * SIZE[1], 8)) is not None


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_operator_works_in_a_read_only_folder(tmp_path: Path) -> None:
    field, params = made("factorised")
    tmp_path.chmod(0o500)
    np.testing.assert_array_equal(Operator(field, params, store=tmp_path)(), Operator(field, params)())
    assert not any(tmp_path.iterdir())


def test_too_large_operator_is_replaced_by_splatting(monkeypatch: pytest.MonkeyPatch) -> None:
    field, params = made("factorised")
    monkeypatch.setattr(evaluator, "MOST_BYTES", 1000)
    asked = predictor(field, params, operator=True)
    with pytest.warns(UserWarning, match="operator: weights of 8 Gaussians take more than"):
        predicted = asked(TX)
    np.testing.assert_array_equal(predicted, predictor(field, params)(TX))
    np.testing.assert_array_equal(asked(TX), predicted)  # and says so once


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
    both = Operator(field, params, RECEIVERS, store=tmp_path)
    assert np.abs(both(0) - both(1)).max() > 0.01
    assert contents(tmp_path) == {"operator0.npz", "operator1.npz"}
