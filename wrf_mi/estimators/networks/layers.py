"""Networks that hold their weights, and positions as their inputs, on Dr.Jit tensors whose columns are samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import drjit as dr
import numpy as np
from drjit import nn
from numpy.typing import ArrayLike, NDArray

from ...backend.device import to_tensor
from ...core import InputError
from ...core.angles import FloatArray
from ...gaussians.network import encode, encoded_size

GAIN = float(np.sqrt(2.0))
"""Deviation of initial weights times the root of a layer's inputs, where a rectifier follows (He et al. 2015)."""
LEAST_M = 1e-3  # smallest extent that coordinates are divided by: all rows may lie at one height
relu = nn.ReLU()


class Module:
    """A network or a part of a network: every array among its attributes is a weight.

    Weights have dotted paths of attribute names: ``q.out.bias`` is the bias of the layer ``out`` of the module ``q``.
    Modules of a list ``norm`` are ``norm0``, ``norm1``, ...; those of a list ``layers`` are ``0``, ``1``, ... A
    trailing underscore is no part of a path.
    """

    def state(self) -> dict[str, Any]:
        """All weights by path."""
        weights: dict[str, Any] = {}
        _mapped(self, "", lambda path, weight: weights.setdefault(path, weight))
        return weights

    def with_state(self, weights: Mapping[str, Any]) -> Self:
        """The same network with other weights, by path."""
        changed: Self = _mapped(self, "", lambda path, _: weights[path])
        return changed

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All weights by path, as NumPy arrays."""
        return {path: np.asarray(weight) for path, weight in self.state().items()}

    def on_device(self, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The same network with the weights of `arrays`, as single-precision tensors; errors as `check`."""
        self.check(arrays)
        return self.with_state({path: to_tensor(arrays[path]) for path in self.state()})

    def check(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Refuse weights that are missing, of another shape, or not finite: the backend would end the process."""
        for path, like in self.state().items():
            weight = arrays.get(path)
            if weight is None or weight.shape != tuple(like.shape) or not np.isfinite(weight).all():
                text = "missing" if weight is None else f"of shape {weight.shape}, or not finite"
                raise InputError(f"weight {path} is {text}, where the settings need {tuple(like.shape)}")


def _mapped(value: Any, path: str, change: Callable[[str, Any], Any]) -> Any:
    """A module, list of modules or weight at a path, with each weight replaced by ``change(path, weight)``."""
    if isinstance(value, Module):
        changed, start = copy(value), f"{path}." if path else ""
        for name, inner in vars(value).items():
            # An attribute such as ``in_`` has the underscore because Python keeps the word.
            setattr(changed, name, _mapped(inner, start + name.removesuffix("_"), change))
        return changed
    if isinstance(value, list):
        stem = path.removesuffix("layers")
        return [_mapped(inner, f"{stem}{number}", change) for number, inner in enumerate(value)]
    return change(path, value) if isinstance(value, np.ndarray | dr.ArrayBase) else value


class Linear(Module):
    """Affine map of one input, or of the concatenation of named inputs with a matrix each.

    Weights are normal with deviation gain / sqrt(inputs) (He et al. 2015), the bias [outputs, 1] is zero. ``inputs`` is
    the number of inputs, or numbers by name; the matrix of a single input is ``hidden``. ``gain`` is `GAIN` before a
    rectifier, 1 before no activation.
    """

    bias: Any

    def __init__(
        self, inputs: int | Mapping[str, int], outputs: int, rng: np.random.Generator, gain: float = GAIN
    ) -> None:
        sizes = {"hidden": inputs} if isinstance(inputs, int) else inputs
        deviation = gain / np.sqrt(sum(sizes.values()))
        for name, size in sizes.items():
            setattr(self, name, (rng.standard_normal((outputs, size)) * deviation).astype(np.float32))
        self.bias = np.zeros((outputs, 1), np.float32)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"layer without an input {name}")

    def __call__(self, *hidden: Any, **parts: Any) -> Any:
        """Outputs [outputs, n] of the inputs [size, n] by name."""
        # Matrices of named inputs spare joining them: W [a; b] = W_a a + W_b b.
        products = [getattr(self, name) @ x for name, x in [*(("hidden", x) for x in hidden), *parts.items()]]
        return sum(products[1:], products[0] + self.bias)


class Mlp(Module):
    """Hidden layers with an activation after each, and an output layer without; None: the last hidden layer is it."""

    def __init__(self, layers: list[Linear], out: Linear | None, activation: Callable[[Any], Any] = relu) -> None:
        self.layers, self.out, self.activation = layers, out, activation

    def __call__(self, *hidden: Any, **parts: Any) -> Any:
        """Outputs of the inputs of the first layer."""
        first, *others = self.layers
        x = self.activation(first(*hidden, **parts))
        for layer in others:
            x = self.activation(layer(x))
        return x if self.out is None else self.out(x)


def columns(x: Any, picked: Any) -> Any:
    """Columns of a tensor [size, n] by index, [size, batch]."""
    # `dr.take` drops the axis for a single index.
    return dr.reshape(dr.take(x, picked, axis=1), (x.shape[0], dr.width(picked)))


@dataclass(frozen=True)
class Coordinates:
    """A frame of positions, fitted on training rows."""

    centre_m: FloatArray  # mean of the training positions [3]
    extent_m: float  # largest distance from it along an axis, metres

    @classmethod
    def of(cls, positions_m: ArrayLike) -> Coordinates:
        """The frame of training positions [n, 3]."""
        p = np.asarray(positions_m, float)
        centre = p.mean(axis=0)
        return cls(centre, max(float(np.abs(p - centre).max()), LEAST_M))

    def features(self, positions_m: ArrayLike, octaves: int, scale_m: float) -> Any:
        """Features of positions [n, 3]: a Dr.Jit tensor [3 + 6 octaves, n], see `with_encoding`."""
        points = to_tensor((np.asarray(positions_m, float) - self.centre_m).T)
        return with_encoding(points, octaves, scale_m, 1 / self.extent_m)


def with_encoding(points: Any, octaves: int, scale_m: float, factor: Any) -> Any:
    """Points [3, n] times a factor, and their positional encoding, [3 + 6 octaves, n].

    NeRF's code gives its network both. ``scale_m`` is the unit of the encoding (`wrf_mi.gaussians.network`).
    """
    return dr.concat([points * factor, encode(points, octaves, scale_m)], axis=0)


def feature_count(octaves: int) -> int:
    """Rows of the result of `with_encoding`."""
    return 3 + encoded_size(octaves)
