"""Short fits to spectra of few lobes: predictions follow the transmitter, and are no constant."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_lobes import lobes
from small_fits import official

import wrf_mi
from wrf_mi.backend.device import to_tensor
from wrf_mi.core import InputError
from wrf_mi.core.settings import with_settings
from wrf_mi.gaussians import FIELDS, WrfGsPlus, random_gaussians
from wrf_mi.runs.baselines import CONSTANT, LEAST_VARIATION, VARIATION
from wrf_mi.runs.results import read_run
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

FLOAT32 = 1e-5
"""Rounding of exp and of x / sqrt(1 + x^2) of 1000, which is 5e-7 below one."""

SPECTRA: dict[str, dict[str, Any]] = {
    "one lobe": {},
    "sparse": {"width_deg": 15.0, "rows": 100},
    "dark": {"peak": 0.1},
    "two lobes": {"reflected": True},
    "noisy": {"ground": 0.05, "noise": 0.03},
}
SIZE, SIZES = (12, 48), [(9, 36), (18, 72)]
OF_FIELD = (
    *("batch=4", "initial.gaussians=60", "density.every=0", "network.width=64", "validate_every=1000"),
    *("optimiser.network=3e-3", "optimiser.warm_up=20", "optimiser.ema_decay=0.95"),
)
OF_NERF2: tuple[str, ...] = (
    "steps=400",
    "batch=8",
    "rays=324",
    "samples=3",
    "networks.width=64",
    "networks.layers=4",
    "networks.skip=0",
)
OF_NERF2 += ("optimiser.network=5e-3", "validate_every=100")


def check(model: str, size: tuple[int, int], kind: str, out: Path) -> None:
    """Fit and compare with the constant that is best for the fit, and with how much the truth varies."""
    # Narrow lobes take longer: black has most of their score.
    settings = (*OF_FIELD, f"steps={800 if kind == 'sparse' else 400}") if model in FIELDS else OF_NERF2
    record = lobes(size, **SPECTRA[kind])
    metrics = wrf_mi.train(record, model, out=out, settings=settings).metrics
    assert metrics[VARIATION]["ratio"] > LEAST_VARIATION
    if model in FIELDS:
        assert metrics["ssim"]["mean"] > metrics[CONSTANT]["mean"]
        return
    # The loss of NeRF2 is the squared error, of which the mean is the best constant. A ground of 0.01 in place of 0
    # adds nothing to it, and lowers the structural similarity by more than lobes raise it.
    results, training = read_run(out), record.observation[:, record.official[0]]
    errors = [np.square(values - results.truth).mean() for values in (results.prediction, training.mean(1)[:, None])]
    assert errors[0] < errors[1]


LEARNED = [("wrf-gs", "two lobes"), ("wrf-gs+", "one lobe")]
"""Models and kinds beside the factorised field, which is fitted the fastest; the slow test below has all of them."""


@pytest.mark.parametrize(("model", "kind"), [*LEARNED, *(("factorised", k) for k in ("sparse", "dark", "noisy"))])
def test_lobes_of_any_kind_are_learned(model: str, kind: str, tmp_path: Path) -> None:
    check(model, SIZE, kind, tmp_path / "run")


def test_few_steps_do_not_make_narrow_lobes_black(tmp_path: Path) -> None:
    """Counted by pixels alone, the many dark ones would have all of them dark within these steps."""
    settings = (*OF_FIELD, "steps=400")
    metrics = wrf_mi.train(lobes(SIZE, width_deg=15.0), "wrf-gs", out=tmp_path / "run", settings=settings).metrics
    assert metrics[VARIATION]["ratio"] > LEAST_VARIATION


def test_lobes_are_learned_by_rays(tmp_path: Path) -> None:
    check("nerf2", SIZES[0], "one lobe", tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", SPECTRA)
@pytest.mark.parametrize("model", [*FIELDS, "nerf2"])
def test_lobes_are_learned_at_any_resolution(model: str, kind: str, size: tuple[int, int], tmp_path: Path) -> None:
    check(model, size, kind, tmp_path / "run")


@pytest.mark.parametrize("offset", [-1e3, 1e3])
def test_offset_of_scales_stays_within_a_factor_of_e(offset: float) -> None:
    """Else one bias, common to all Gaussians, makes all of them too small for the pixels to see."""
    record = lobes(SIZE)
    field, rng = FIELDS["wrf-gs+"](width=8), np.random.default_rng(0)
    params = field.init(random_gaussians(record.receivers, 4, rng), rng)
    params["deform.scale.bias"][:] = offset
    gaussians = field.gaussians({k: to_tensor(v) for k, v in params.items()}, to_tensor(record.tx_pos_m[:1].T.copy()))
    ratio = np.stack([scale.numpy() for scale in gaussians.scale]) / np.exp(params["log_scale"])
    assert ratio == pytest.approx(np.exp(np.sign(offset)), rel=FLOAT32)


def test_start_without_signals_is_refused() -> None:
    with pytest.raises(InputError, match=r"initial\.signal"):
        with_settings(TrainConfig(), ["initial.signal=0"])


class Tinted(WrfGsPlus):
    """A field with a parameter of its own for each Gaussian."""

    def init(self, initial: Any, rng: np.random.Generator) -> Any:
        return super().init(initial, rng) | {"tint": np.zeros((1, initial.count), np.float32)}


def test_parameter_without_a_learning_rate_is_refused() -> None:
    record = lobes(SIZE)
    trainer = Trainer(record, official(record), with_settings(TrainConfig(), OF_FIELD), field=Tinted(width=8))
    with pytest.raises(InputError, match="no learning rate for parameter tint of the field"):
        trainer.run()
