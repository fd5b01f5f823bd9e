"""One variant of `wrf_mi_bench.elsewhere`: ``python -m wrf_mi_bench.elsewhere_job FILE BACKEND THREADS SMALL``."""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.backend import init

SETTINGS = ("deterministic=true", "density.every=10", "density.start=0", "validate_every=1000000")


def main(file: str, backend: str, threads: str, small: str) -> None:
    """Compute images, gradients and metrics, and store them as ``.npz``; ``small`` is "1" for few rows and steps.

    A deterministic training, with one thread, is only made on ``llvm``.
    """
    backend_info = init(backend, int(threads))
    import drjit as dr
    import mitsuba as mi

    from wrf_mi.backend.device import to_float, to_tensor
    from wrf_mi.core.settings import with_settings
    from wrf_mi.datasets import make_splits
    from wrf_mi.gaussians.tiles import perception_plane
    from wrf_mi.graph.graph import Batch
    from wrf_mi.runs.api import train
    from wrf_mi.synthetic.laboratory import RECEIVER, transmitter_path
    from wrf_mi.tasks.losses import spectrum_loss
    from wrf_mi.tracing import TraceOptions
    from wrf_mi.training.config import TrainConfig
    from wrf_mi.training.step import TrainingData, device_pose
    from wrf_mi.training.trainer import Trainer

    from .traced import random_field, splatted
    from .workloads import record, tracer

    few = small == "1"
    rows, gaussians, steps = (8, 20, 5) if few else (40, 200, 200)
    arrays: dict[str, Any] = {"image": np.abs(splatted(*random_field(0, "alpha", gaussians)))}
    ordered = np.arange(rows)
    traced = tracer(TraceOptions(transmission=False))(transmitter_path(rows)).astype(np.float32)
    arrays["traced"] = traced
    spectra = replace(record(rows, official=(ordered[: -rows // 4], ordered[-rows // 4 :])), observation=traced)
    config = with_settings(TrainConfig(), [f"initial.gaussians={gaussians}", f"steps={steps}"])
    split = make_splits(spectra, "official")[0]
    trainer = Trainer(spectra, split, config)
    params = {name: to_tensor(values) for name, values in trainer.state.params().items()}
    dr.enable_grad(params)
    plane, pose = perception_plane(*spectra.observation.shape[-2:], mi.Float), device_pose(RECEIVER)
    data = TrainingData(to_tensor(spectra.tx_pos_m.T), to_float(spectra.observation), to_float([1.0]))
    batch = config.batch
    tx, truth, _ = data.select(mi.UInt32(split.train[:batch].tolist()), mi.UInt32(0), plane.pixels)
    shown = trainer.graph.observation(0, None)(params, Batch(tx, None, None, pose, plane))
    dr.backward(spectrum_loss(shown, truth, batch, plane.height, plane.width, config.loss.ssim_weight)[0])
    arrays |= {f"gradient/{name}": dr.grad(value).numpy() for name, value in params.items()}
    if backend == "llvm":
        with tempfile.TemporaryDirectory() as folder:
            words = [*SETTINGS, f"initial.gaussians={gaussians}", f"steps={steps}"]
            score = train(spectra, "wrf-gs+", out=Path(folder) / "run", settings=words).metrics["ssim"]
        arrays["metrics"] = np.array([score[name] for name in ("median", "mean", "p10", "p90")])
    versions = {"numpy": np.__version__, "llvm": backend_info.llvm_version or "", "device": backend_info.device}
    np.savez(file, versions=json.dumps(versions), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
