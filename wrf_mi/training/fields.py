"""Field of Gaussians from a configuration."""

from __future__ import annotations

from typing import Any

from ..core import InputError
from ..gaussians import FIELDS, Encoding
from ..graph.graph import Field
from .config import TrainConfig


def make_field(config: TrainConfig, components: int = 1, features: int = 0) -> Field:
    """The field of a configuration.

    Args:
        config: settings.
        components: complex signals of a Gaussian.
        features: number of features that describe a transmitter instead of its position; 0: its position.

    Raises:
        InputError: no trainable model of that name, unsuitable settings, or an unresolved scale of transmitters.
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
        raise InputError(f"setting network.static_geometry: {config.model} always moves signals alone; omit it")
    if config.model == "wrf-gs":
        if n.width:
            sizes["signal_widths"] = (n.width, max(1, n.width // 2))
    elif config.model == "wrf-gs+":
        if n.layers:
            sizes["skip"] = n.layers // 2
        sizes["static_geometry"], sizes["phase_hz"] = n.static_geometry, n.phase_hz
    if n.phase_hz and config.model != "wrf-gs+":
        raise InputError(f"setting network.phase_hz: {config.model} has no such phase; omit it")
    if n.phase_hz and (components > 1 or features):
        raise InputError("setting network.phase_hz: needs one signal a Gaussian and positions; omit it")
    if n.terms:
        if config.model != "factorised":
            raise InputError(f"setting network.terms: {config.model} has none; omit it")
        sizes["terms"] = n.terms
    return FIELDS[config.model](encoding=encoding, **sizes)
