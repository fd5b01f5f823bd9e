"""Fully connected networks on Dr.Jit tensors, columns as samples.

Weights live in a plain dictionary, so that optimiser, checkpoint and `dr.freeze` see one flat set of arrays.
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import numpy as np
from numpy.typing import NDArray

Weights = dict[str, NDArray[np.float32]]
Params = Mapping[str, dr.ArrayBase]


def init_layer(
    name: str, inputs: Mapping[str, int], outputs: int, rng: np.random.Generator, gain: float = np.sqrt(2.0)
) -> Weights:
    """A layer whose input is a concatenation of named parts, as one matrix [outputs, size] a part and a bias.

    Normal weights with deviation gain / sqrt(total inputs) (He et al. 2015), zero bias [outputs, 1].
    """
    deviation = gain / np.sqrt(sum(inputs.values()))
    weights = {
        f"{name}.{part}": (rng.standard_normal((outputs, size)) * deviation).astype(np.float32)
        for part, size in inputs.items()
        if size > 0
    }
    return weights | {f"{name}.bias": np.zeros((outputs, 1), np.float32)}


def linear(params: Params, name: str, x: dr.ArrayBase, part: str = "hidden") -> dr.ArrayBase:
    """Affine map W x + b of columns: [inputs, n] to [outputs, n]."""
    return params[f"{name}.{part}"] @ x + params[f"{name}.bias"]


def linear_of_pairs(
    params: Params,
    name: str,
    per_gaussian: Mapping[str, dr.ArrayBase],
    per_transmitter: Mapping[str, dr.ArrayBase],
    hidden: dr.ArrayBase | None = None,
) -> dr.ArrayBase:
    """Affine map of the concatenation of parts, for every pair of a transmitter and a Gaussian.

    W [x; y] + b = W_x x + W_y y + b: what depends on the Gaussian alone is multiplied once for all
    transmitters and the other way round.

    Args:
        params: the layer's weights, one matrix for each part.
        name: of the layer.
        per_gaussian: parts [size, n].
        per_transmitter: parts [size, batch].
        hidden: a part [size, batch * n] that depends on both, batch-major; its matrix is ``name.hidden``.

    Returns:
        Tensor [outputs, batch * n].
    """
    bias = params[f"{name}.bias"]
    outputs = bias.shape[0]
    # An encoding of zero octaves has no rows and no matrix.
    gaussian = [params[f"{name}.{k}"] @ v for k, v in per_gaussian.items() if v.shape[0]]
    transmitter = [params[f"{name}.{k}"] @ v for k, v in per_transmitter.items() if v.shape[0]]
    n = next(iter(per_gaussian.values())).shape[1]
    batch = next(iter(per_transmitter.values())).shape[1]
    total: dr.ArrayBase = dr.reshape(sum(gaussian[1:], gaussian[0]) + bias, (outputs, 1, n))
    own = sum(transmitter[1:], transmitter[0]) if transmitter else dr.zeros(type(bias), (outputs, batch))
    total = total + dr.reshape(own, (outputs, batch, 1))
    total = dr.reshape(total, (outputs, batch * n))
    return total if hidden is None else total + params[f"{name}.hidden"] @ hidden


def relu(x: dr.ArrayBase) -> dr.ArrayBase:
    """Rectified linear unit."""
    return dr.maximum(x, 0)
