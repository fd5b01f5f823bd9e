"""The two networks of NeRF2 and the sum along a ray, on Dr.Jit tensors.

A ray leaves the receiver in direction u and is cut into S cells of length D; in the middle of each is a point that
radiates. With a and b the loss of amplitude and phase in a cell, in nepers and radians a metre, and s the signal that
its point sends towards the receiver, the ray brings

    R(u) = sum_s  s_s  (D / r_s)  exp(-j k r_s)  exp(- sum_{q < s} (a_q + j b_q) D)

a and b are the attenuation network's, functions of the point alone; s is the radiance network's, a function of that
network's feature, the ray's direction and the transmitter. Everything that depends on the point alone is computed once
for all transmitters of a batch, which is most of the work.

Source: Zhao, An, Pan and Yang, "NeRF2: neural radio-frequency radiance fields" (MobiCom 2023), equations of section 4,
and the authors' code (XPengZhao/NeRF2, model.py and renderer.py, MIT), whose activations these are: |leaky ReLU| for
amplitudes, 2 pi sigmoid for phases. The wave's phase and the loss over distance are as in the paper's equations.

Columns of points run ray by ray, the S points of a ray one after the other. ``outputs`` is the number of complex
numbers that a ray brings: one, or one a subcarrier.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.constants import speed_of_light

from ...core.settings import Count, Positive
from ...gaussians.parameters import logistic
from .layers import Linear, Mlp, Module, feature_count, relu, with_encoding

LEAK = 0.01  # slope of the leaky ReLU below zero, PyTorch's default


@dataclass(frozen=True)
class Networks:
    """Sizes of the two networks."""

    layers: Count = 8  #: hidden layers of the attenuation network
    #: neurons of these layers; the radiance network has layers of this and half of this width
    width: Annotated[int, Field(ge=2, description="2 or more")] = 128
    skip: int = 5  #: hidden layers before the encoded point enters again; 0: it does not
    point_octaves: int = 3  #: octaves of the encoding of points
    view_octaves: int = 3  #: octaves of the encoding of directions
    scale_m: Positive = 1.0  #: unit of encoded points and transmitters, metres (`wrf_mi.gaussians.network`)


class Nerf2Network(Module):
    """Attenuation network, radiance network, and offset of each receiver's power in dB.

    A transmitter has ``condition`` features, and a ray brings ``outputs`` complex numbers.
    """

    def __init__(self, s: Networks, condition: int, outputs: int, receivers: int, rng: np.random.Generator) -> None:
        point, view, width = feature_count(s.point_octaves), feature_count(s.view_octaves), s.width
        self.sizes = s
        inputs: list[dict[str, int]] = [{"hidden": width} for _ in range(s.layers)]
        inputs[0] = {"point": point}
        if 0 < s.skip < s.layers:
            inputs[s.skip]["point"] = point
        hidden = [Linear(parts, width, rng) for parts in inputs]
        self.attenuation = Mlp(hidden, Linear(width, 2 * outputs, rng, gain=0.5))
        self.feature = Linear(width, width, rng, gain=1.0)
        first = Linear({"feature": width, "view": view, "condition": condition}, width, rng)
        last = [Linear(width, width // 2, rng), Linear(width // 2, 2 * outputs, rng, gain=1.0)]
        self.radiance = Mlp([first, last[0]], last[1])
        self.offset: Any = np.zeros(receivers, np.float32)


@dataclass
class RayPoints:
    """Everything about the points of some rays that does not depend on the transmitter."""

    weight_re: Any  # real part of the factor of s_s in the sum, tensor [outputs, rays * S]
    weight_im: Any  # its imaginary part
    first: Any  # sum of the inputs of the radiance network's first layer but the condition, [width, rays * S]


def look(network: Nerf2Network, rays: Mapping[str, Any]) -> RayPoints:
    """Evaluate the attenuation network on all points of some rays.

    ``rays`` has tensors of `constant_parts`, ``direction`` (unit vectors in the world [3, rays]) and ``origin``
    (starting point [3, 1], metres from the frame's centre).
    """
    sizes, radiance = network.sizes, network.radiance.layers[0]
    count, samples = rays["direction"].shape[1], rays["distance"].shape[1]
    tensor = type(rays["direction"])
    n = count * samples
    along: Any = dr.reshape(rays["direction"], (3, count, 1)) * dr.reshape(rays["distance"], (1, 1, samples))
    points = dr.reshape(along, (3, n)) + rays["origin"]
    encoded = with_encoding(points, sizes.point_octaves, sizes.scale_m, 1 / rays["extent"])
    view = with_encoding(rays["direction"], sizes.view_octaves, 1.0, 1)
    first, *others = network.attenuation.layers
    hidden = relu(first(point=encoded))
    for number, layer in enumerate(others, 1):
        hidden = relu(layer(hidden, point=encoded) if number == sizes.skip else layer(hidden))
    assert network.attenuation.out is not None
    out = network.attenuation.out(hidden)
    outputs = out.shape[0] // 2

    def before(x: Any) -> Any:
        """Sum over the cells before each, times their length, [outputs, rays * S]."""
        total = dr.reshape(x, (outputs * count, samples)) @ rays["before"]
        return dr.reshape(total * rays["cell"], (outputs, n))

    amplitude = dr.exp(-before(strength(out[:outputs, :])))
    sine, cosine = dr.sincos(before(phase(out[outputs:, :])))
    # All rays have the same cells.
    waves: list[Any] = [
        dr.reshape(dr.reshape(w, (outputs, 1, samples)) + dr.zeros(tensor, (1, count, 1)), (outputs, n))
        for w in (rays["wave_re"], rays["wave_im"])
    ]
    wave_re, wave_im = waves
    # (D / r) exp(-j k r) times exp(-sum (a + j b) D): a turn by minus the phase that the cells before have added.
    re = amplitude * (wave_re * cosine + wave_im * sine)
    im = amplitude * (wave_im * cosine - wave_re * sine)
    seen_from: Any = dr.reshape(radiance.view @ view, (sizes.width, count, 1))
    # The radiance network's first layer is linear in its inputs: all of it but the condition is summed here, once.
    total = dr.reshape(radiance.feature @ network.feature(hidden), (sizes.width, count, samples)) + seen_from
    return RayPoints(re, im, dr.reshape(total, (sizes.width, n)) + radiance.bias)


def march(network: Nerf2Network, points: RayPoints, condition: Any, samples: int) -> tuple[Any, Any]:
    """Signal of each ray of S samples for conditions [features, batch]: real and imaginary part.

    Both are flat arrays [outputs * batch * rays]; ``points`` is the result of `look`.
    """
    width, n = points.first.shape
    outputs, batch = points.weight_re.shape[0], condition.shape[1]
    first, second = network.radiance.layers
    assert network.radiance.out is not None
    # Pairs of a condition and a point: the sum of both shares of the first layer, then the rest of the network.
    sender: Any = dr.reshape(first.condition @ condition, (width, batch, 1))
    hidden = relu(dr.reshape(dr.reshape(points.first, (width, 1, n)) + sender, (width, batch * n)))
    out = network.radiance.out(relu(second(hidden)))
    amplitude: Any = dr.reshape(strength(out[:outputs, :]), (outputs, batch, n))
    angle: Any = dr.reshape(phase(out[outputs:, :]), (outputs, batch, n))
    sine, cosine = dr.sincos(angle)
    w_re, w_im = (cast(Any, dr.reshape(w, (outputs, 1, n))) for w in (points.weight_re, points.weight_im))
    re = amplitude * (cosine * w_re - sine * w_im)
    im = amplitude * (cosine * w_im + sine * w_re)
    return dr.block_sum(re.array, samples), dr.block_sum(im.array, samples)


def strength(x: Any) -> Any:
    """|leaky ReLU|, from all numbers to positive ones."""
    return dr.select(x > 0, x, -LEAK * x)


def phase(x: Any) -> Any:
    """2 pi times the logistic function, radians."""
    return 2 * dr.pi * logistic(x)


def constant_parts(
    extent_m: float, near_m: float, far_m: float, samples: int, frequencies_hz: ArrayLike
) -> Mapping[str, NDArray[Any]]:
    """Constants of all rays, as NumPy arrays; a frequency of 0 has no phase.

    Returns:
        ``distance``: r_s of the cells' middles [1, S], metres; ``cell``: D, metres [1]; ``before``: strictly lower
        triangular ones [S, S], transposed: sums over the cells before each; ``wave_re`` and ``wave_im``: parts of
        (D / r_s) exp(-j k r_s), [outputs, S]; ``extent``: unit of plain coordinates [1], metres.
    """
    # In double precision: k r is thousands of radians, of which float32 keeps three digits behind the point at most.
    cell = (far_m - near_m) / samples
    distance = near_m + (np.arange(samples, dtype=np.float64) + 0.5) * cell
    wavenumber = 2 * np.pi * np.asarray(frequencies_hz, float)[:, None] / speed_of_light
    wave = (cell / distance) * np.exp(-1j * wavenumber * distance)
    return {
        "distance": distance[None, :],
        "cell": np.array([cell]),
        "before": np.triu(np.ones((samples, samples)), 1),
        "wave_re": wave.real,
        "wave_im": wave.imag,
        "extent": np.array([extent_m]),
    }
