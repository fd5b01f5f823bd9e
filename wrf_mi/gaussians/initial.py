"""Starting values of Gaussians, at random or on a point cloud, and adaptive density control while they are trained.

Density control: clone, split, prune and reset of opacities (Kerbl et al. 2023, section 5.2), on parameters as NumPy
arrays with the Gaussians in the last axis, between two steps. The criterion is the mean gradient of the loss by a
Gaussian's direction: the gradient by its centre times its distance from the receiver. Where the paper is silent, a
fixed share of the Gaussians with the largest mean grows in a round, so that no threshold depends on the scale of the
loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from ..core import InputError, Receiver, rotation_matrix, unit_vectors
from .network import Weights

SPLIT_SHRINK = 1.6  # ratio of sizes of a split Gaussian and its parts (Kerbl et al. 2023)
SPLIT_RAD = float(np.radians(5.0))  # size from the receiver above which a growing Gaussian is split, not cloned
LEAST_OPACITY = 0.005  # opacity below which a Gaussian is pruned (Kerbl et al. 2023)
RESET_OPACITY = 0.05  # largest after a reset, well above `LEAST_OPACITY`: Gaussians in use have a round to grow


@dataclass(frozen=True)
class InitialGaussians:
    """Starting values of the static attributes.

    Attributes:
        position_m: shape [n, 3], world frame.
        scale_m: standard deviation of each (isotropic) Gaussian, shape [n].
        opacity: alpha at the centre, common to all or of each, shape [n], in (0, 1).
        signal: standard deviation of the random starting signals.
        signals: complex signal of each, shape [n], in place of random ones; None: random.
    """

    position_m: NDArray[np.float64]
    scale_m: NDArray[np.float64]
    opacity: float | NDArray[np.float64] = 0.1
    signal: float = 0.3
    signals: NDArray[np.complex128] | None = None

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.position_m)

    def geometry(self) -> Weights:
        """The parameters ``position`` [3, n], ``log_scale`` [3, n] and ``rotation`` [4, n] (identity)."""
        rotation = np.zeros((4, self.count), np.float32)
        rotation[3] = 1.0
        return {
            "position": np.ascontiguousarray(self.position_m.T, np.float32),
            "log_scale": np.tile(np.log(self.scale_m), (3, 1)).astype(np.float32),
            "rotation": rotation,
        }

    def opacity_logit(self) -> NDArray[np.float32]:
        """The parameter ``opacity``, shape [1, n], as a logit."""
        return np.broadcast_to(logit(self.opacity), (1, self.count)).astype(np.float32)

    def static_signal(self, rng: np.random.Generator) -> NDArray[np.float32]:
        """The parameter ``signal`` [2, n] of a field with a static signal: real and imaginary parts."""
        if self.signals is not None:
            return np.stack([self.signals.real, self.signals.imag]).astype(np.float32)
        return (rng.standard_normal((2, self.count)) * self.signal).astype(np.float32)


def random_gaussians(
    receivers: Sequence[Receiver],
    count: int,
    rng: np.random.Generator,
    distance_m: tuple[float, float] = (1.0, 8.0),
    size_deg: float = 7.0,
    opacity: float = 0.1,
    signal: float = 0.3,
    *,
    sphere: bool = False,
) -> InitialGaussians:
    """Gaussians in random directions around the receivers, uniform over each receiver's hemisphere or full sphere.

    The paper draws points "within a specified range". Here directions are uniform, distances are uniform in
    ``distance_m``, and scales give each Gaussian the standard deviation ``size_deg`` as seen from its receiver.
    """
    share = np.array_split(np.arange(count), len(receivers))
    position, scale = np.empty((count, 3)), np.empty(count)
    for receiver, index in zip(receivers, share, strict=True):
        # A margin below the horizon: footprints of Gaussians there reach above it.
        lowest = -1.0 if sphere else -np.sin(np.radians(size_deg))
        # Equal areas of a sphere have equal heights (Archimedes): the sine is uniform, not the elevation.
        elevation = np.arcsin(rng.uniform(lowest, 1.0, len(index)))
        direction = unit_vectors(rng.uniform(0, 2 * np.pi, len(index)), elevation)
        distance = rng.uniform(*distance_m, len(index))
        position[index] = receiver.position_m + (direction * distance[:, None]) @ receiver.to_world.T
        # Of equal size as seen from the receiver, near or far: a receiver resolves angles, not metres.
        scale[index] = distance * np.tan(np.radians(size_deg))
    return InitialGaussians(position, scale, opacity, signal)


def gaussians_from_points(points_m: NDArray[np.float64], count: int, rng: np.random.Generator) -> InitialGaussians:
    """Gaussians at ``count`` points (4 or more) of a cloud [m, 3], metres, each as large as the gap to its neighbours.

    The scale is the root mean square distance to the three nearest chosen points (3D Gaussian splatting, Kerbl et al.
    2023, section 5.1). `InputError` for too few points, or a coordinate that is not a number.
    """
    points = np.asarray(points_m, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"point cloud: expected shape [m, 3], got {list(points.shape)}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"point cloud, row {bad[0] + 1}: not a number; remove that point")
    if not 4 <= count <= len(points):
        raise InputError(f"point cloud: {len(points)} points for {count} Gaussians; ask for between 4 and that many")
    chosen = points[rng.choice(len(points), count, replace=False)]
    gaps, _ = cKDTree(chosen).query(chosen, k=4)
    scale = np.sqrt((gaps[:, 1:] ** 2).mean(axis=1))
    # Repeated points would give scale 0, whose logarithm is the parameter.
    return InitialGaussians(chosen, np.maximum(scale, 1e-3))


@dataclass(frozen=True)
class DensityChange:
    """A new set of Gaussians in terms of the old one."""

    parameters: Weights  # per-Gaussian parameters of the new set, [k, m]
    source: NDArray[np.int64]  # old Gaussian of each new one, [m]
    fresh: NDArray[np.bool_]  # new Gaussians whose optimiser moments start at zero, [m]


def adapt(
    parameters: Weights,
    view_gradient_norm: NDArray[np.floating],
    distance_m: NDArray[np.float64],
    rng: np.random.Generator,
    growth_fraction: float,
    max_gaussians: int,
) -> DensityChange:
    """One round of pruning, cloning and splitting.

    ``parameters`` are those per Gaussian, [k, n] each, with ``position``, ``log_scale`` and ``rotation``, and under
    alpha blending ``opacity`` (logits). ``view_gradient_norm`` [n] is the mean gradient of the loss by each Gaussian's
    direction since the last round, zero where no pixel saw it, ``distance_m`` [n] that from the nearest receiver. The
    share ``growth_fraction`` of the Gaussians is cloned or split, up to ``max_gaussians``.
    """
    keep = view_gradient_norm > 0
    if "opacity" in parameters:
        keep &= parameters["opacity"][0] >= logit(LEAST_OPACITY)
    if not keep.any():
        # A field without Gaussians could never recover: the strongest stays.
        keep[np.argmax(parameters["opacity"][0] if "opacity" in parameters else view_gradient_norm)] = True
    alive = np.flatnonzero(keep)
    room = max(0, min(round(growth_fraction * len(alive)), max_gaussians - len(alive)))
    growing = alive[np.argsort(-view_gradient_norm[alive], kind="stable")[:room]]
    # Angular size, as a receiver sees it, decides between a clone and a split: metres far away are no detail.
    size = np.exp(parameters["log_scale"].max(axis=0)) / distance_m
    split = growing[size[growing] > SPLIT_RAD]
    source = np.concatenate([alive, growing])
    fresh = np.concatenate([np.isin(alive, split), np.ones(len(growing), bool)])
    new = {name: values[:, source].copy() for name, values in parameters.items()}
    # Both parts of a split Gaussian move, each to a point drawn from it, and shrink.
    parts = np.flatnonzero(np.isin(source, split))
    old = source[parts]
    axes = rotation_matrix(parameters["rotation"][:, old].T)
    draw = rng.standard_normal((len(parts), 3)) * np.exp(parameters["log_scale"][:, old].T)
    new["position"][:, parts] += np.einsum("nij,nj->in", axes, draw).astype(np.float32)
    new["log_scale"][:, parts] -= np.float32(np.log(SPLIT_SHRINK))
    if "opacity" in parameters:
        # Two copies of this opacity blend to the old one (Rota Bulo et al. 2024, "Revising densification").
        doubled = np.isin(source, growing)
        alpha = expit(parameters["opacity"][0, source[doubled]].astype(float))
        each = np.clip(1 - np.sqrt(1 - alpha), 1e-6, 1 - 1e-6)
        new["opacity"][0, doubled] = logit(each)
    return DensityChange(new, source, fresh)


def reset_opacity(opacity_logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Opacity logits, limited to `RESET_OPACITY`."""
    return np.minimum(opacity_logits, np.float32(logit(RESET_OPACITY)))
