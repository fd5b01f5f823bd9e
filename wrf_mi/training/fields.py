"""Fields of Gaussians by their settings, checks of their parameters, and the memory of a training step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver
from ..core.memory import require_memory
from ..datasets.observations import LARGEST, computable
from ..gaussians import FIELDS, Encoding, random_gaussians
from ..gaussians.attributes import with_attributes
from ..graph.graph import Field
from ..receivers.registry import ObservationSpec
from .config import PATHS_ALONE, NetworkConfig, TrainConfig

BYTES_PER_NEURON, BYTES_PER_PAIR, BYTES_PER_NUMBER = 11, 1000, 24
"""Memory of a training step for each neuron, and beside networks, of each pair of a Gaussian and a transmitter, and for
each number of a Gaussian (its value, gradient, moments, running mean and best state): measured on 4,000 and 16,000
Gaussians of the three fields, within a third."""
MOST_NUMBERS = (1 << 32) - 1  # most numbers of an array of Dr.Jit


def field_of(config: TrainConfig, form: ObservationSpec) -> Field | None:
    """The field for observations of a form (`make_field`); None: paths are trained alone."""
    if config.model == PATHS_ALONE:
        return None
    return make_field(config, form.components, form.features, form.carriers_hz is not None)


def make_field(config: TrainConfig, components: int = 1, features: int = 0, carrier: bool = False) -> Field:
    """The field of a configuration, of ``components`` complex signals of a Gaussian.

    ``features`` is the number of those that describe a transmitter instead of its position; 0: its position.
    ``carrier``: whether networks see the carrier.

    Raises:
        InputError: no trainable model of that name, unsuitable settings, or an unresolved scale of transmitters.
    """
    model, e, n = config.model, config.encoding, config.network
    if model not in FIELDS:
        raise InputError(f"model {model!r} cannot be trained here; choose from {', '.join(FIELDS)}")
    if not e.tx_scale_m:
        raise InputError("setting encoding.tx_scale_m: 0 is resolved by the training transmitters; give metres")
    if n.static_geometry and model != "wrf-gs+":
        raise InputError(f"setting network.static_geometry: {model} always moves signals alone; omit it")
    if n.terms and model != "factorised":
        raise InputError(f"setting network.terms: {model} has none; omit it")
    encoding = Encoding(e.position_octaves, e.position_scale_m, e.tx_octaves, e.tx_scale_m, features, carrier)
    field: Field = with_attributes(
        FIELDS[model](encoding=encoding, components=components, **_sizes(model, n)), config.attributes
    )
    return field


def _sizes(model: str, network: NetworkConfig) -> dict[str, Any]:
    network_sizes = {name: getattr(network, name) for name in ("width", "layers", "terms")}
    sizes: dict[str, Any] = {name: size for name, size in network_sizes.items() if size}
    if model == "wrf-gs" and network.width:
        sizes["signal_widths"] = (network.width, max(1, network.width // 2))
    if model == "wrf-gs+":
        sizes["static_geometry"] = network.static_geometry
        sizes |= {"skip": network.layers // 2} if network.layers else {}
    return sizes


def _shapes(field: Field) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters of a field with four Gaussians, by name."""
    place, rng = Receiver("", np.zeros(3), np.array([0.0, 0, 0, 1])), np.random.default_rng(0)
    return {name: values.shape for name, values in field.init(random_gaussians([place], 4, rng), rng).items()}


def check_params(field: Field | None, params: Mapping[str, NDArray[Any]], source: str) -> None:
    """Refuse parameters of a file ``source`` that are missing, not usable, or of other shapes than the field's."""
    for name, values in params.items():
        if values.dtype.kind != "f" or not computable(values).all():
            text = f"parameter {name} does not hold finite numbers of at most {LARGEST:g}"
            raise InputError(f"{source}: {text}; train the run anew")
    if field is None:
        return
    # The backend ends the process on other shapes.
    count = params.get("position", np.zeros((3, 0))).shape[1]
    for name, shape in _shapes(field).items():
        wanted = (shape[0], count) if name in field.per_gaussian else shape
        shape_in_file = getattr(params.get(name), "shape", "none")
        if shape_in_file != wanted or not count:
            text = f"parameter {name} of shape {shape_in_file}, where the settings need {wanted}"
            raise InputError(f"{source}: {text}; train the run anew")


def check_memory(config: TrainConfig, field: Field) -> None:
    """Refuse a training step that does not fit into memory; raises InputError."""
    density = config.density
    # Of the largest field that density control may grow, so that no fit ends in its middle.
    count = max(config.initial.gaussians, density.max_gaussians if density.every else 0)
    sizes = _shapes(field)
    widths = [shape[0] for name, shape in sizes.items() if name.endswith(".bias")]
    numbers = sum(sizes[name][0] for name in field.per_gaussian)
    grown = count > config.initial.gaussians
    what = f"setting {'density.max_gaussians' if grown else 'initial.gaussians'}={count} with batch={config.batch}: "
    remedy = "lower one of them, or network.width"
    pairs = count * config.batch
    # The widest layer has its width of numbers for every pair; Dr.Jit's indices of 32 bits would wrap around unnoticed.
    if pairs * max(widths, default=numbers) > MOST_NUMBERS:
        raise InputError(f"{what}more numbers than an array of Dr.Jit holds; {remedy}")
    import mitsuba as mi  # not above: commands import this module before they choose the backend

    # `require_memory` knows the machine's memory, not that of a GPU.
    if not (mi.variant() or "").startswith("cuda"):
        step = pairs * (BYTES_PER_NEURON * sum(widths) + BYTES_PER_PAIR)
        require_memory(step + BYTES_PER_NUMBER * count * numbers, f"{what}a training step", remedy)
