"""The field of Gaussians that a configuration names."""

from __future__ import annotations

from typing import Any

from ..core import InputError
from ..gaussians import FIELDS, Encoding
from ..graph.graph import Field
from .config import TrainConfig


def make_field(config: TrainConfig, components: int = 1, features: int = 0) -> Field:
    """The model that a configuration names.

    Args:
        config: settings.
        components: complex signals of a Gaussian.
        features: number of features that tell of a transmitter in place of its position; 0: its position.

    Raises:
        InputError: no trainable model of that name, or transmitters whose scale is still open.
    """
    if config.model not in FIELDS:
        raise InputError(f"model {config.model!r} cannot be trained here; choose from {', '.join(FIELDS)}")
    e = config.encoding
    if not e.tx_scale_m:
        raise InputError("setting encoding.tx_scale_m: 0 is resolved by the training transmitters; give metres")
    encoding = Encoding(e.position_octaves, e.position_scale_m, e.tx_octaves, e.tx_scale_m, features)
    n = config.network
    sizes: dict[str, Any] = {"components": components}
    if n.width:
        sizes["width"] = n.width
    if n.layers:
        sizes["layers"] = n.layers
    if n.static_geometry and config.model != "wrf-gs+":
        raise InputError(f"setting network.static_geometry: {config.model} moves signals alone anyway; leave it away")
    if config.model == "wrf-gs":
        if n.width:
            sizes["signal_widths"] = (n.width, max(1, n.width // 2))
    elif config.model == "wrf-gs+":
        if n.layers:
            sizes["skip"] = n.layers // 2
        sizes["static_geometry"], sizes["phase_hz"] = n.static_geometry, n.phase_hz
    if n.phase_hz and config.model != "wrf-gs+":
        raise InputError(f"setting network.phase_hz: {config.model} has no such phase; leave it away")
    if n.phase_hz and (components > 1 or features):
        raise InputError("setting network.phase_hz: belongs to one signal a Gaussian and to positions; leave it away")
    if n.terms:
        if config.model != "factorised":
            raise InputError(f"setting network.terms: {config.model} has none; leave it away")
        sizes["terms"] = n.terms
    return FIELDS[config.model](encoding=encoding, **sizes)
