"""Small fields for the plugins: untrained, as arrays and as run folders."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from small_fits import official, settings

from wrf_mi.core import Receiver, Record
from wrf_mi.gaussians import Encoding, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.runs.api import train

RECEIVER = Receiver("gateway1", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))

FIELDS: dict[str, Any] = {
    "wrf-gs": WrfGs(Encoding(3, 4.0, 3, 1.0), layers=2, width=8, signal_widths=(8, 8)),
    "wrf-gs+": WrfGsPlus(Encoding(3, 4.0, 3, 1.0), layers=3, width=8, skip=1),
}


def weights_of(model: str, count: int = 6, seed: int = 0) -> dict[str, np.ndarray]:
    """Parameters of Gaussians of all shapes some metres around the origin."""
    rng = np.random.default_rng(seed)
    start = random_gaussians([RECEIVER], count, rng, distance_m=(1.0, 3.0), size_deg=10, opacity=0.4)
    weights = FIELDS[model].init(start, rng)
    weights["log_scale"] = (weights["log_scale"] + rng.normal(0, 0.3, (3, count))).astype(np.float32)
    weights["rotation"] = rng.standard_normal((4, count)).astype(np.float32)
    return {name: np.asarray(values, np.float32) for name, values in weights.items()}


def write_run(folder: Path, record: Record, model: str, *own: str) -> Path:
    """A run folder after two steps of training, with settings of one's own."""
    config = settings("steps=2", "log_every=1", "validate_every=2", *own, model=model)
    return train(record, model, out=folder, settings=config, split=official(record)).folder


def plain(array: Any) -> np.ndarray:
    """A Dr.Jit array as float64."""
    return np.asarray(array.numpy(), float)


def slopes(loss: Callable[[], Any], params: Any, key: str, change: Any, step: float) -> tuple[float, float]:
    """Derivatives of a loss by a scene's parameter along a change of it: backward, and by central differences."""
    kind, start = type(params[key]), plain(params[key])

    def moved(distance: float, grad: bool = False) -> Any:
        leaf = kind((start + distance * change).astype(np.float32))
        if grad:
            dr.enable_grad(leaf)
        params.update({key: leaf})
        return loss()

    numeric = float(moved(step)[0] - moved(-step)[0]) / (2 * step)
    dr.backward(moved(0.0, grad=True))
    return float(np.sum(plain(dr.grad(params[key])) * change)), numeric
