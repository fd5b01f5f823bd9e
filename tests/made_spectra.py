"""Small spectra made by a field of known parameters: what training is tested on."""

from typing import Any

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.gaussians import Encoding, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.graph.graph import Graph
from wrf_mi.receivers.registry import PIXEL, ObservationSpec
from wrf_mi.training.predictor import Predictor

RECEIVERS = (
    Receiver("gateway1", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])),
    Receiver("gateway2", np.array([1.0, -0.5, 6.0]), np.array([1.0, 0.0, 0.0, 0.0])),
)
"""One on the floor that looks up and one on the ceiling that looks down."""

SIZE = (20, 40)
OCTAVES = Encoding(position_octaves=2, position_scale_m=4.0, tx_octaves=2, tx_scale_m=1.0)
"""Slow enough that some tens of transmitters within 2 m determine the field between them."""
WIDTH = 64


def small_field(model: str, width: int = WIDTH) -> WrfGs | WrfGsPlus:
    """A model with narrow layers."""
    if model == "wrf-gs":
        return WrfGs(encoding=OCTAVES, width=width, signal_widths=(width, width // 2))
    return WrfGsPlus(encoding=OCTAVES, width=width)


def true_field(model: str, count: int = 8, seed: int = 0, width: int = WIDTH) -> tuple[Any, dict[str, np.ndarray]]:
    """A field of few Gaussians whose signals change much with the transmitter, and its parameters."""
    rng = np.random.default_rng(seed)
    field = small_field(model, width)
    params = field.init(random_gaussians(RECEIVERS[:1], count, rng, (1.0, 4.0), 12.0, 0.5, 1.0), rng)
    params["log_scale"] += rng.normal(0, 0.3, params["log_scale"].shape).astype(np.float32)
    head = "signal.out." if model == "wrf-gs" else "deform.signal."
    for name in params:
        if name.startswith(head):
            params[name] *= 4
    if model == "wrf-gs":
        params["attenuation.delta.bias"][0] = 0.5  # less transparent than where training starts
    return field, params


def spectra_predictor(field, params, receivers, height, width, operator=False):
    """Predictor of spectra of an image size by a field alone, with the papers' receiver."""
    return Predictor(Graph(field, receivers, ObservationSpec(PIXEL, (height, width))), params, operator)


def spectra(model="wrf-gs+", rows=24, receivers=1, size=SIZE, **field):
    """A record of ``rows`` transmitters within a cube of 2 m, and the field and parameters that made it.

    Signals are scaled such that the largest grey is one. The last fifth of the rows is the official test set, and
    every third row belongs to the same spatial fold.
    """
    model_field, params = true_field(model, **field)
    tx_pos = np.random.default_rng(1).uniform(-1, 1, (rows, 3))

    def observe() -> np.ndarray:
        predict = spectra_predictor(model_field, params, RECEIVERS[:receivers], *size)
        return np.stack([predict(tx_pos, r) for r in range(receivers)])

    largest = observe().max()
    for name in params:
        if name == "signal" or name.startswith(("signal.out.", "deform.signal.")):
            params[name] = params[name] / largest
    everything = np.arange(rows)
    record = Record(
        name="made-here",
        task="spectrum",
        tx_pos_m=tx_pos,
        receivers=RECEIVERS[:receivers],
        observation=np.minimum(observe(), 1.0),
        official=(everything[: -rows // 5], everything[-rows // 5 :]),
        folds=everything % 3,
    )
    return record, model_field, params
