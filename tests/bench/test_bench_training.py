"""Operations, shares and lines of the training benchmark."""

import json
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from small_fits import official, settings
from wrf_mi_bench import training as bench_training
from wrf_mi_bench.training import (
    BACKWARD,
    FORWARD,
    PRODUCTS,
    SHARED_BACKWARD,
    SHARED_FORWARD,
    WALKS,
    product_call,
    rows,
    shares,
    some_steps,
    stream_call,
    work_of,
)

from wrf_mi.training.trainer import Trainer

SMALL = ("network.width=16", "network.layers=2", "encoding.tx_octaves=3", "encoding.position_octaves=2", "steps=1000")
ONCE = FORWARD + BACKWARD


def test_operations_follow_from_the_shapes(one_gateway):
    """WRF-GS+ of 8 Gaussians, two layers of 16 that both see 12 and 18 numbers, nine outputs."""
    trainer, n, width = Trainer(one_gateway, official(one_gateway), settings(*SMALL)), 8, 16
    encoded = 2 * (2 * width * 12 * n + 2 * width * 18)  # twice: encodings have no derivative
    hidden, heads = 3 * 2 * width * width * n, 3 * 2 * 9 * width * n
    assert work_of(trainer).network_gflop * 1e9 == pytest.approx(2 * encoded + hidden + heads, rel=1e-12)


@pytest.mark.parametrize(
    ("model", "walks"), [("wrf-gs+", 4 * ONCE), ("factorised", ONCE + 3 * (SHARED_FORWARD + SHARED_BACKWARD))]
)
def test_static_geometry_is_walked_once_per_batch(model, walks, one_gateway):
    one, four = (
        work_of(Trainer(one_gateway, official(one_gateway), settings("steps=9", f"batch={batch}", model=model)))
        for batch in (1, 4)
    )
    assert four.splat_gflop / one.splat_gflop == pytest.approx(walks / ONCE)
    assert one.splat_gflop > 0
    assert one.moved_gb < four.moved_gb < 4 * one.moved_gb


def test_shares_of_a_step_sum_to_one(one_gateway):
    trainer = Trainer(one_gateway, official(one_gateway), settings(*SMALL))
    of_step = shares(some_steps(trainer, 3))
    assert trainer.state.step == 6
    assert sum(of_step.values()) >= 1 - 1e-9
    assert min(of_step.values()) >= 0
    assert of_step[PRODUCTS] > 0
    assert of_step[WALKS] > 0


def test_reference_calls_compute_a_product_and_a_copy():
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal((32, 32)) for _ in range(2))
    np.testing.assert_allclose(product_call(32)().numpy(), a @ b, atol=1e-4)
    assert dr.width(stream_call(1000)()) == 1000


def test_fit_of_a_subprocess_has_its_time_and_scores(monkeypatch):
    def run_command(arguments: tuple[str, ...], folder: Path, where: str) -> None:
        assert arguments == ("train", bench_training.DATA, "--model", "wrf-gs")
        folder.mkdir()
        metrics = {"train_seconds": 9.0, "peak_memory_mb": 80.0, "ssim": {"median": 0.9}, "gaussians": 7, "steps": 3}
        (folder / "metrics.json").write_text(json.dumps(metrics))

    monkeypatch.setattr(bench_training, "run_command", run_command)
    fit = bench_training.fit("wrf-gs")
    assert fit["processor_seconds"] >= 0
    assert (fit["seconds"], fit["peak_memory_mb"], fit["gaussians"]) == (9.0, 80.0, 7)


def test_lines_state_the_share_of_the_limit():
    fit = {"seconds": 90.4, "processor_seconds": 170.0, "peak_memory_mb": 380.2, "ssim": {"median": 0.9731}}
    work = {"network_gflop": 0.9, "splat_gflop": 0.1, "moved_gb": 0.02}
    step = {"ms": {"value": 10.0, "low": 9.0, "high": 11.0}, "work": work, "shares": {"products of networks": 0.6}}
    machine = {"product_gflop_s": 200.0, "stream_gb_s": 20.0}
    lines = {line["what"]: line for line in rows({"wrf-gs+": fit}, {"WRF-GS+, 1": step}, machine)}
    fitted = lines["WRF-GS+, fit to its final accuracy"]
    assert fitted["value"] == "90 s, of processors 170 s; 380 MB; median SSIM 0.973"
    assert fitted["asked"] == "180 s, 2048 MB"
    # 1 GFLOP at 200 GFLOP/s are 5 ms, 20 MB at 20 GB/s one.
    assert lines["WRF-GS+, a step of 1 transmitter"]["value"].endswith("at least 5.00 ms, 50 %")
    assert lines["WRF-GS+, a step of 1 transmitter: where its time goes"]["value"] == "products of networks 60 %"
