"""The two networks of NeRF2 and the sum along a ray, on Dr.Jit tensors.

A ray leaves the receiver in direction u and is cut into S cells of length D; in the middle of each is a point that
sends again. With a and b what a cell takes from amplitude and phase, in nepers and radians a metre, and s what its
point sends towards the receiver, the ray brings

    R(u) = sum_s  s_s  (D / r_s)  exp(-j k r_s)  exp(- sum_{q < s} (a_q + j b_q) D)

a and b are the attenuation network's, functions of the point alone; s is the radiance network's, a function of that
network's feature, the ray's direction and the transmitter. Whatever depends on the point alone is computed once for all
transmitters of a batch, which is most of the work.

Source: Zhao, An, Pan and Yang, "NeRF2: neural radio-frequency radiance fields" (MobiCom 2023), equations of section 4,
and the authors' code (XPengZhao/NeRF2, model.py and renderer.py, MIT), whose activations these are: |leaky ReLU| for
amplitudes, 2 pi sigmoid for phases. It leaves out the wave's own phase for spectra and the loss over distance for RSSI;
here both are there for all, as in the paper's equations.

Columns of points run ray by ray, the S points of a ray one after the other. ``outputs`` is the number of complex
numbers that a ray brings: one, or one a subcarrier.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ...core import InputError
from ...gaussians.encoding import encode
from ...gaussians.network import Params, Weights, init_layer, linear, relu
from .coordinates import feature_count

LEAK = 0.01
"""Slope of the leaky ReLU below zero, PyTorch's default."""


@dataclass(frozen=True)
class Networks:
    """Sizes of the two networks.

    Attributes:
        layers: hidden layers of the attenuation network.
        width: their neurons; the radiance network has this and half of it.
        skip: hidden layers before the encoded point enters again; 0: it does not.
        point_octaves: of the encoding of points.
        view_octaves: of the encoding of directions.
        scale_m: metres that make the unit of encoded points and transmitters (`wrf_mi.gaussians.encoding`).
    """

    layers: int = 8
    width: int = 128
    skip: int = 5
    point_octaves: int = 3
    view_octaves: int = 3
    scale_m: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what is no network.

        Raises:
            InputError: naming the setting.
        """
        if self.layers < 1 or self.width < 2 or min(self.skip, self.point_octaves, self.view_octaves) < 0:
            raise InputError(
                f"nerf2: {self.layers} layers of {self.width} neurons, skip {self.skip}, octaves "
                f"{self.point_octaves} and {self.view_octaves}; choose at least 1 layer, 2 neurons, 0 octaves"
            )
        if not self.scale_m > 0:
            raise InputError(f"nerf2: networks.scale_m {self.scale_m}; choose a positive length")

    def init(self, condition: int, outputs: int, rng: np.random.Generator) -> Weights:
        """Random weights, for a condition of so many features and so many outputs."""
        point, view, width = feature_count(self.point_octaves), feature_count(self.view_octaves), self.width
        weights: Weights = {}
        for i in range(self.layers):
            inputs = {"hidden": width} if i else {"point": point}
            if i and i == self.skip:
                inputs["point"] = point
            weights |= init_layer(f"attenuation.{i}", inputs, width, rng)
        weights |= init_layer("attenuation.out", {"hidden": width}, 2 * outputs, rng, gain=0.5)
        weights |= init_layer("feature", {"hidden": width}, width, rng, gain=1.0)
        weights |= init_layer("radiance.0", {"feature": width, "view": view, "condition": condition}, width, rng)
        weights |= init_layer("radiance.1", {"hidden": width}, width // 2, rng)
        return weights | init_layer("radiance.out", {"hidden": width // 2}, 2 * outputs, rng, gain=1.0)


@dataclass
class Rays:
    """Rays on the device, as arguments of recorded functions.

    Attributes:
        direction: unit vectors in the world [3, rays].
        origin: where they start [3, 1], metres from the frame's centre.
        distance: r_s of the cells' middles [1, S], metres.
        cell: D, metres [1].
        before: strictly lower triangular ones [S, S], transposed: sums over the cells before each.
        wave_re: real part of (D / r_s) exp(-j k r_s), [outputs, S].
        wave_im: its imaginary part.
        extent: metres that make one unit of plain coordinates [1].
    """

    direction: Any
    origin: Any
    distance: Any
    cell: Any
    before: Any
    wave_re: Any
    wave_im: Any
    extent: Any


def cells(near_m: float, far_m: float, samples: int) -> tuple[NDArray[np.float64], float]:
    """Distances [samples] of the cells' middles and their length, metres."""
    cell = (far_m - near_m) / samples
    middles: NDArray[np.float64] = near_m + (np.arange(samples, dtype=np.float64) + 0.5) * cell
    return middles, cell


def free_wave(distance_m: ArrayLike, cell_m: float, frequencies_hz: ArrayLike) -> NDArray[np.complex128]:
    """(D / r_s) exp(-j k r_s) for each frequency, [outputs, samples]; a frequency of 0 leaves the phase out."""
    r = np.asarray(distance_m, float)
    wavenumber = 2 * np.pi * np.asarray(frequencies_hz, float)[:, None] / speed_of_light
    wave: NDArray[np.complex128] = (cell_m / r) * np.exp(-1j * wavenumber * r)
    return wave


@dataclass
class Seen:
    """What the points of some rays are to any transmitter.

    Attributes:
        weight_re: real part of what stands before s_s in the sum, tensor [outputs, rays * S].
        weight_im: its imaginary part.
        own: share of the radiance network's first layer, [width, rays * S].
    """

    weight_re: Any
    weight_im: Any
    own: Any


def with_plain(points: Any, octaves: int, scale_m: float, extent: Any) -> Any:
    """Points [3, n] in units of ``extent`` and encoded, [3 + 6 octaves, n]."""
    return dr.concat([points / extent, encode(points, octaves, scale_m)], axis=0)


def look(networks: Networks, params: Params, rays: Rays) -> Seen:
    """Evaluate the attenuation network on all points of some rays."""
    count, samples = rays.direction.shape[1], rays.distance.shape[1]
    tensor = type(rays.direction)
    n = count * samples
    along: Any = dr.reshape(rays.direction, (3, count, 1)) * dr.reshape(rays.distance, (1, 1, samples))
    points = dr.reshape(along, (3, n)) + rays.origin
    encoded = with_plain(points, networks.point_octaves, networks.scale_m, rays.extent)
    unit = tensor(dr.ones(type(encoded.array), 1), (1,))
    view = with_plain(rays.direction, networks.view_octaves, 1.0, unit)
    hidden = relu(linear(params, "attenuation.0", encoded, "point"))
    for i in range(1, networks.layers):
        own = linear(params, f"attenuation.{i}", hidden)
        if i == networks.skip:
            own = own + params[f"attenuation.{i}.point"] @ encoded
        hidden = relu(own)
    out = linear(params, "attenuation.out", hidden)
    outputs = out.shape[0] // 2

    def before(x: Any) -> Any:
        """Sum over the cells before each, times their length, [outputs, rays * S]."""
        total = dr.reshape(x, (outputs * count, samples)) @ rays.before
        return dr.reshape(total * rays.cell, (outputs, n))

    amplitude = dr.exp(-before(strength(out[:outputs, :])))
    sine, cosine = dr.sincos(before(phase(out[outputs:, :])))
    # All rays have the same cells.
    waves: list[Any] = [
        dr.reshape(dr.reshape(w, (outputs, 1, samples)) + dr.zeros(tensor, (1, count, 1)), (outputs, n))
        for w in (rays.wave_re, rays.wave_im)
    ]
    wave_re, wave_im = waves
    re = amplitude * (wave_re * cosine + wave_im * sine)
    im = amplitude * (wave_im * cosine - wave_re * sine)
    feature = linear(params, "feature", hidden)
    seen_from: Any = dr.reshape(params["radiance.0.view"] @ view, (networks.width, count, 1))
    own = dr.reshape(params["radiance.0.feature"] @ feature, (networks.width, count, samples)) + seen_from
    return Seen(re, im, dr.reshape(own, (networks.width, n)) + params["radiance.0.bias"])


def march(params: Params, seen: Seen, condition: Any, samples: int) -> tuple[Any, Any]:
    """What each ray brings for each condition.

    Args:
        params: weights.
        seen: of the rays' points.
        condition: what the radiance network knows of the transmitter, [features, batch].
        samples: S.

    Returns:
        Real and imaginary part, flat arrays [outputs * batch * rays].
    """
    width, n = seen.own.shape
    outputs, batch = seen.weight_re.shape[0], condition.shape[1]
    sender: Any = dr.reshape(params["radiance.0.condition"] @ condition, (width, batch, 1))
    hidden = relu(dr.reshape(dr.reshape(seen.own, (width, 1, n)) + sender, (width, batch * n)))
    out = linear(params, "radiance.out", relu(linear(params, "radiance.1", hidden)))
    amplitude: Any = dr.reshape(strength(out[:outputs, :]), (outputs, batch, n))
    angle: Any = dr.reshape(phase(out[outputs:, :]), (outputs, batch, n))
    sine, cosine = dr.sincos(angle)
    weights: list[Any] = [dr.reshape(w, (outputs, 1, n)) for w in (seen.weight_re, seen.weight_im)]
    w_re, w_im = weights
    re = amplitude * (cosine * w_re - sine * w_im)
    im = amplitude * (cosine * w_im + sine * w_re)
    return dr.block_sum(re.array, samples), dr.block_sum(im.array, samples)


def strength(x: Any) -> Any:
    """|leaky ReLU|, from all numbers to positive ones."""
    return dr.select(x > 0, x, -LEAK * x)


def phase(x: Any) -> Any:
    """2 pi sigmoid, radians."""
    return 2 * dr.pi * dr.rcp(1 + dr.exp(-x))


def constant_parts(
    origin_m: ArrayLike,
    centre_m: ArrayLike,
    extent_m: float,
    near_m: float,
    far_m: float,
    samples: int,
    frequencies_hz: ArrayLike,
) -> Mapping[str, NDArray[Any]]:
    """Everything of `Rays` but the directions, as NumPy arrays."""
    distance, cell = cells(near_m, far_m, samples)
    wave = free_wave(distance, cell, frequencies_hz)
    return {
        "origin": (np.asarray(origin_m, float) - np.asarray(centre_m, float))[:, None],
        "distance": distance[None, :],
        "cell": np.array([cell]),
        "before": np.triu(np.ones((samples, samples)), 1),
        "wave_re": wave.real,
        "wave_im": wave.imag,
        "extent": np.array([extent_m]),
    }
