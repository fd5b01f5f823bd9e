"""Adaptive density control: clone, split, prune, opacity reset (Kerbl et al. 2023, section 5.2).

Works on parameters as NumPy arrays with the Gaussians in the last axis, between two steps. The criterion is the mean
gradient of the loss by a Gaussian's direction: the gradient by its centre times its distance from the receiver. Where
the paper is silent, a fixed share of the Gaussians with the largest mean grows in a round, so that no threshold depends
on the scale of the loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from ..core import rotation_matrix

Arrays = dict[str, NDArray[np.float32]]

SPLIT_SHRINK = 1.6  # ratio of sizes of a split Gaussian and its parts (Kerbl et al. 2023)
SPLIT_RAD = float(np.radians(5.0))
"""Size as seen from the receiver above which a growing Gaussian is split instead of cloned."""
LEAST_OPACITY = 0.005  # opacity below which a Gaussian is pruned (Kerbl et al. 2023)
RESET_OPACITY = 0.05
"""Largest opacity after a reset, well above `LEAST_OPACITY`: Gaussians in use have a round to grow back."""


@dataclass(frozen=True)
class DensityChange:
    """A new set of Gaussians in terms of the old one."""

    parameters: Arrays  # per-Gaussian parameters of the new set, [k, m]
    source: NDArray[np.int64]  # old Gaussian of each new one, [m]
    fresh: NDArray[np.bool_]  # new Gaussians whose optimiser moments start at zero, [m]


def adapt(
    parameters: Arrays,
    view_gradient_norm: NDArray[np.floating],
    distance_m: NDArray[np.float64],
    rng: np.random.Generator,
    growth_fraction: float,
    max_gaussians: int,
) -> DensityChange:
    """One round of pruning, cloning and splitting.

    Args:
        parameters: per-Gaussian parameters, [k, n] each; ``position``, ``log_scale`` and ``rotation`` among them.
            Under alpha blending also ``opacity`` (logits).
        view_gradient_norm: mean gradient of the loss by each Gaussian's direction since the last round, [n]; zero: no
            pixel saw it.
        distance_m: distance of each Gaussian from the nearest receiver, [n].
        rng: generator of the positions of split Gaussians.
        growth_fraction: share of the Gaussians that are cloned or split.
        max_gaussians: largest number of Gaussians.
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
