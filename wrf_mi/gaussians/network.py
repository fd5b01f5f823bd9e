"""Fully connected networks on Dr.Jit tensors, columns as samples, and the positional encoding of coordinates.

Weights live in a plain dictionary, so that optimiser, checkpoint and `dr.freeze` see one flat set of arrays. The
encoding is that of the WRF-GS+ paper, section V-A, after NeRF:

    gamma(t) = (sin(2^0 pi t), cos(2^0 pi t), ..., sin(2^L pi t), cos(2^L pi t)),   L + 1 octaves

The paper sets L = 9, ten octaves, and does not say on what scale of coordinates. Here ``t`` is the coordinate in metres
divided by ``scale_m``, so the shortest period is ``2 * scale_m / 2^L``: 4 mm for L = 9 and one metre. A field changes
over about half a wavelength, which for 915 MHz is 0.16 m: shorter periods let a network memorise its training
positions, which is why fewer octaves predict better (see `docs/gaussians.md`). The longest period is ``2 * scale_m``:
transmitters at that distance along an axis have equal features.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

Weights = dict[str, NDArray[np.float32]]
Params = Mapping[str, dr.ArrayBase]


def unambiguous_scale(points_m: ArrayLike, least_m: float) -> float:
    """Scale in metres, ``least_m`` or more, at which points [n, 3] have different encodings: none is a period apart."""
    extent = float(np.ptp(np.asarray(points_m, float), axis=0).max(initial=0.0))
    scale = least_m
    while 2 * scale <= extent < np.inf:
        scale *= 2
    return scale


def encoded_size(octaves: int) -> int:
    """Number of features that `encode` makes of one 3D point."""
    return 6 * octaves


def encode(points: Any, octaves: int, scale_m: float) -> Any:
    """Positional encoding of points [3, n] in metres, NumPy's or tensors. Differentiable.

    Returns [6 * octaves, n]: all sines, then all cosines; octave by octave, x, y, z in each.
    """
    host = isinstance(points, np.ndarray)
    if octaves == 0:
        return points[:0] if host else dr.zeros(type(points), (0, points.shape[1]))
    # Whole periods are subtracted in each octave before the sine: exact, because the factors are
    # powers of two, and sin() in float32 loses digits of large arguments.
    octave = [points * (2.0**k / (2.0 * scale_m)) for k in range(octaves)]
    if host:
        phase = np.concatenate([t - np.rint(t) for t in octave]) * np.float32(2 * np.pi)
        return np.concatenate([np.sin(phase), np.cos(phase)])
    turns = dr.concat([t - dr.round(dr.detach(t)) for t in octave], axis=0)
    sine, cosine = dr.sincos(2 * dr.pi * turns)
    return dr.concat([sine, cosine], axis=0)


def init_layer(
    name: str, inputs: Mapping[str, int], outputs: int, rng: np.random.Generator, gain: float = np.sqrt(2.0)
) -> Weights:
    """A layer whose input is a concatenation of named parts, as one matrix [outputs, size] a part and a bias."""
    # Normal weights with deviation gain / sqrt(total inputs) (He et al. 2015), zero bias [outputs, 1].
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


class _Rectified(dr.CustomOp):
    """max(product + per-transmitter + per-Gaussian part, 0) with a derivative that sums whole rows."""

    # Dr.Jit's derivative of a bias is a scatter of all columns into one number a row, which takes five times as long.

    def eval(self, product: Any, per_gaussian: Any, per_transmitter: Any) -> Any:
        outputs, self.batch = per_transmitter.shape
        self.columns = per_gaussian.shape[1] if per_gaussian is not None else product.shape[1] // self.batch
        # Columns are batch-major (b * n + i): a transmitter's part repeats, a Gaussian's is tiled.
        total = dr.repeat(per_transmitter.array, self.columns)
        if per_gaussian is not None and self.batch > 1:
            zeros = dr.zeros(type(per_transmitter), (1, self.batch, 1))
            total += (dr.reshape(per_gaussian, (outputs, 1, self.columns)) + zeros).array
        elif per_gaussian is not None:
            total += per_gaussian.array
        if product is not None:
            total += product.array
        self.present = product is not None, per_gaussian is not None
        self.out = type(per_transmitter)(dr.maximum(total, 0), (outputs, self.batch * self.columns))
        return self.out

    def backward(self) -> None:
        outputs, kind = self.out.shape[0], type(self.out)
        gradient: Any = self.grad_out()
        # The rectifier passes gradients where its output is positive; sums over rows are those of broadcast parts.
        slope = kind(dr.select(self.out.array > 0, gradient.array, 0), self.out.shape)
        dr.eval(slope)
        self.set_grad_in("per_transmitter", kind(dr.block_sum(slope.array, self.columns), (outputs, self.batch)))
        # What all transmitters of the batch share gets the sum of their gradients.
        if self.present[1]:
            parts: Any = dr.reshape(slope, (outputs, self.batch, self.columns))
            self.set_grad_in("per_gaussian", slope if self.batch == 1 else dr.sum(parts, axis=1))
        if self.present[0]:
            self.set_grad_in("product", slope)

    def name(self) -> str:
        return "wrf_mi layer"


def dense(params: Params, name: str, x: dr.ArrayBase, part: str = "hidden") -> dr.ArrayBase:
    """A hidden layer max(W x + b, 0) of columns: [inputs, n] to [outputs, n]; of NumPy's arrays too."""
    if isinstance(x, np.ndarray):
        return np.maximum(linear(params, name, x, part), 0)
    rectified: dr.ArrayBase = dr.custom(_Rectified, params[f"{name}.{part}"] @ x, None, params[f"{name}.bias"])
    return rectified


def dense_of_pairs(
    params: Params,
    name: str,
    per_gaussian: Mapping[str, dr.ArrayBase],
    per_transmitter: Mapping[str, dr.ArrayBase],
    hidden: dr.ArrayBase | None = None,
) -> dr.ArrayBase:
    """A hidden layer [outputs, batch * n] of concatenated parts, for every pair of a transmitter and a Gaussian.

    W [x; y] + b = W_x x + W_y y + b: products of parts [size, n] that depend on the Gaussian only are computed once for
    all transmitters, and vice versa for parts [size, batch]. ``hidden`` [size, batch * n] depends on both, batch-major;
    its matrix is ``name.hidden``.
    """
    bias = params[f"{name}.bias"]
    batch = next(iter(per_transmitter.values())).shape[1]
    # An encoding of zero octaves has no rows and no matrix.
    gaussian = [params[f"{name}.{k}"] @ v for k, v in per_gaussian.items() if v.shape[0]]
    transmitter = [params[f"{name}.{k}"] @ v for k, v in per_transmitter.items() if v.shape[0]]
    biased = sum(transmitter, bias) if transmitter else bias + dr.zeros(type(bias), (1, batch))
    product = None if hidden is None else params[f"{name}.hidden"] @ hidden
    rectified: dr.ArrayBase = dr.custom(_Rectified, product, sum(gaussian[1:], gaussian[0]), biased)
    return rectified
