"""Where Gaussians start, from what physics tells before training: traced paths, or a mesh's surfaces.

A receiver sees a specular path as if it came from the transmitter's image. So paths of the training transmitters say
from which directions waves arrive, how strong, and from which distance: clusters of their last points of interaction
become Gaussians of that power. A mesh alone says where anything that scatters can be.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from ..core import InputError, Paths, Receiver
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..gaussians.initial import InitialGaussians, gaussians_from_points

LEAST_SCALE_M = 0.02
"""Smallest starting scale: a cluster of one point still has a size."""
LEAST_SHARE = 1e-3
"""Clusters of less power than this share of the strongest start as if they had it, so that they can be seen to grow."""


@dataclass(frozen=True)
class PathGaussians(InitialGaussians):
    """Starting values with a signal and an opacity of each Gaussian.

    Attributes:
        signals: complex, shape [n]: amplitude relative to the strongest times ``signal``, and phase of the path.
        opacities: alpha at the centre of each, shape [n].
        image_map: affine map of the transmitter to the image that each Gaussian shows, [n, 3, 4]: image = A [x, 1].
    """

    signals: NDArray[np.complex128] = field(kw_only=True)
    opacities: FloatArray = field(kw_only=True)
    image_map: FloatArray = field(kw_only=True)

    def opacity_logit(self) -> NDArray[np.float32]:
        """The parameter ``opacity``, shape [1, n], as a logit."""
        return np.log(self.opacities / (1 - self.opacities))[None].astype(np.float32)

    def static_signal(self, rng: np.random.Generator) -> NDArray[np.float32]:
        """The parameter ``signal`` [2, n]: that of the paths; nothing is drawn."""
        return np.stack([self.signals.real, self.signals.imag]).astype(np.float32)

    def image(self) -> NDArray[np.float32]:
        """The parameter ``image``, shape [12, n], of the chains of surfaces that paths have come by."""
        return np.ascontiguousarray(self.image_map.reshape(-1, 12).T, np.float32)


def gaussians_from_paths(
    paths: Paths,
    tx_pos_m: FloatArray,
    receivers: tuple[Receiver, ...],
    count: int,
    rng: np.random.Generator,
    opacity: float = 0.4,
    signal: float = 0.3,
) -> PathGaussians:
    """Gaussians on clusters of the last points of interaction of traced paths, the transmitter itself for direct ones.

    Points are clustered by direction and distance as their receiver sees them, weighted by power; a cluster's mean is
    the centre, its spread the scale, its mean power the signal and (as a share of the strongest) the opacity. The
    affine map from transmitter to image is that of the cluster's strongest chain of surfaces, by least squares.

    Args:
        paths: of the training transmitters.
        tx_pos_m: these transmitters [n, 3], metres.
        receivers: of the paths.
        count: number of Gaussians.
        rng: draws the clusters' first centres.
        opacity: of the strongest Gaussian, the weakest having a tenth of it.
        signal: amplitude of the strongest Gaussian.

    Raises:
        InputError: no path.
    """
    if not len(paths):
        raise InputError("start from paths: no path arrives; trace more kinds of path, or start at random")
    row = np.arange(len(paths))
    bounces = paths.bounces
    last = paths.vertices_m[row, np.maximum(bounces - 1, 0)]
    last = np.where((bounces > 0)[:, None], last, tx_pos_m[paths.tx])
    rx = np.stack([receiver.position_m for receiver in receivers])[paths.rx]
    away = last - rx
    distance = np.linalg.norm(away, axis=1)
    # Directions in units of a tenth of a radian, distances in octaves: what a receiver can tell apart.
    features = np.column_stack([10 * away / distance[:, None], 2 * np.log2(distance)])
    power = np.abs(paths.gain) ** 2
    drawn = rng.choice(len(paths), min(len(paths), 40 * count), replace=False, p=None)
    few = min(count, len(np.unique(np.round(features[drawn], 6), axis=0)))
    centres, _ = kmeans2(features[drawn], few, iter=20, minit="++", rng=rng)
    label = _nearest(features, centres)
    used = np.unique(label)
    # Every Gaussian that was asked for gets a place: clusters of most paths are taken more than once.
    chosen = np.concatenate([used, rng.choice(used, count - len(used))]) if len(used) < count else used
    position, scale = np.empty((count, 3)), np.empty(count)
    strength, phase = np.empty(count), np.empty(count)
    affine = np.empty((count, 3, 4))
    for index, cluster in enumerate(chosen):
        own = np.flatnonzero(label == cluster)
        share = power[own] / power[own].sum() if power[own].sum() > 0 else np.full(len(own), 1 / len(own))
        position[index] = share @ last[own]
        square = share @ ((last[own] - position[index]) ** 2).sum(axis=1)
        scale[index] = max(np.sqrt(square / 3), LEAST_SCALE_M)
        # Power that arrives by the cluster from a transmitter, on average over all of them.
        strength[index] = power[own].sum() / paths.n_tx
        phase[index] = np.angle(paths.gain[own[np.argmax(power[own])]])
        affine[index] = _image_map(paths, tx_pos_m, receivers, own)
    repeated = np.bincount(chosen, minlength=len(centres))[chosen]
    relative = np.maximum(strength / repeated / strength.max(), LEAST_SHARE)
    amplitude = signal * np.sqrt(relative)
    opacities = np.clip(opacity * (0.1 + 0.9 * relative), 1e-3, 1 - 1e-3)
    jitter = rng.standard_normal((count, 3)) * scale[:, None] * (repeated > 1)[:, None]
    return PathGaussians(
        position + jitter,
        scale,
        opacity,
        signal,
        signals=amplitude * np.exp(1j * phase),
        opacities=opacities,
        image_map=affine,
    )


def gaussians_from_mesh(
    triangles_m: FloatArray, count: int, rng: np.random.Generator, opacity: float = 0.4, signal: float = 0.3
) -> InitialGaussians:
    """Gaussians on a mesh's surfaces, drawn evenly by area; scales as `gaussians_from_points`.

    Args:
        triangles_m: corners [f, 3, 3], metres.
        count: number of Gaussians, at least 4.
        rng: draws them.
        opacity: alpha at the centre.
        signal: deviation of the starting signals.

    Raises:
        InputError: no surface.
    """
    corners = np.asarray(triangles_m, float).reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0:
        raise InputError("start from a mesh: it has no surface; give triangles with an area")
    face = rng.choice(len(corners), count, p=area / area.sum())
    a, b = rng.random((2, count, 1))
    flip = a + b > 1
    a, b = np.where(flip, 1 - a, a), np.where(flip, 1 - b, b)
    one, two, three = corners[face].transpose(1, 0, 2)
    start = gaussians_from_points(one + a * (two - one) + b * (three - one), count, rng)
    return InitialGaussians(start.position_m, start.scale_m, opacity, signal)


def _nearest(features: FloatArray, centres: FloatArray) -> IntArray:
    from scipy.spatial import cKDTree

    label: IntArray = cKDTree(centres).query(features)[1].astype(np.int64)
    return label


def _image_map(paths: Paths, tx_pos_m: FloatArray, receivers: tuple[Receiver, ...], own: IntArray) -> FloatArray:
    """Affine map [3, 4] from transmitter to image of the strongest chain among some paths."""
    strongest = own[np.argmax(np.abs(paths.gain[own]))]
    same = own[(paths.objects[own] == paths.objects[strongest]).all(axis=1) & (paths.rx[own] == paths.rx[strongest])]
    rx = receivers[int(paths.rx[strongest])].position_m
    image = rx + paths.arrival[same] * paths.length_m[same, None]
    x = tx_pos_m[paths.tx[same]]
    mean_x, mean_i = x.mean(axis=0), image.mean(axis=0)
    # With few transmitters the map is a mirror's: orthogonal, as every chain of reflections is (Kabsch 1976).
    u, s, vt = np.linalg.svd((image - mean_i).T @ (x - mean_x))
    linear = np.eye(3) if len(same) < 4 or s[-1] < 1e-6 else u @ vt
    return np.column_stack([linear, mean_i - linear @ mean_x])
