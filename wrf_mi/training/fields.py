"""Field of Gaussians from a configuration."""

from __future__ import annotations

from typing import Any

from ..core import InputError
from ..gaussians import FIELDS, Encoding
from ..graph.graph import Field
from ..graph.receivers import Form
from .config import PATHS_ALONE, TrainConfig


def field_of(config: TrainConfig, form: Form) -> Field | None:
    """The field of a configuration for observations of a form; None: paths are trained alone.

    Raises:
        InputError: as `make_field`.
    """
    if config.model == PATHS_ALONE:
        return None
    return make_field(config, form.components, form.features, form.carriers_hz is not None)


def make_field(config: TrainConfig, components: int = 1, features: int = 0, carrier: bool = False) -> Field:
    """The field of a configuration.

    Args:
        config: settings.
        components: complex signals of a Gaussian.
        features: number of features that describe a transmitter instead of its position; 0: its position.
        carrier: whether networks see the carrier.

    Raises:
        InputError: no trainable model of that name, unsuitable settings, or an unresolved scale of transmitters.
    """
    model, e, n = config.model, config.encoding, config.network
    if model not in FIELDS:
        raise InputError(f"model {model!r} cannot be trained here; choose from {', '.join(FIELDS)}")
    if not e.tx_scale_m:
        raise InputError("setting encoding.tx_scale_m: 0 is resolved by the training transmitters; give metres")
    plus = model == "wrf-gs+"
    for wrong, text in (
        (n.static_geometry and not plus, f"static_geometry: {model} always moves signals alone"),
        (n.phase_hz and not plus, f"phase_hz: {model} has no such phase"),
        (n.phase_hz and (components > 1 or features), "phase_hz: needs one signal a Gaussian and positions"),
        (n.terms and model != "factorised", f"terms: {model} has none"),
    ):
        if wrong:
            raise InputError(f"setting network.{text}; omit it")
    sizes: dict[str, Any] = {name: getattr(n, name) for name in ("width", "layers", "terms") if getattr(n, name)}
    if model == "wrf-gs" and n.width:
        sizes["signal_widths"] = (n.width, max(1, n.width // 2))
    if plus:
        sizes |= {"static_geometry": n.static_geometry, "phase_hz": n.phase_hz}
        sizes |= {"skip": n.layers // 2} if n.layers else {}
    encoding = Encoding(e.position_octaves, e.position_scale_m, e.tx_octaves, e.tx_scale_m, features, carrier)
    return FIELDS[model](encoding=encoding, components=components, **sizes)
