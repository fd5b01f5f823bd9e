"""Further attributes of Gaussians, such as a roughness, that installed packages add to any field.

An attribute is an instance of `GaussianAttribute`, which an entry point of the group ``wrf_mi.gaussian_attributes``
names by the attribute's name; ``attributes=roughness`` in the settings of a fit uses it. It states everything that
training, density control, prediction and export need to know of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.registry import Registry
from ..core.types import IntArray
from .initial import InitialGaussians
from .network import Params, Weights
from .parameters import Gaussians, rows


class GaussianAttribute(ABC):
    """A trained attribute of each Gaussian.

    Attributes:
        name: name of the parameter, tensor [size, n], without a dot; it is none of the field's parameters.
        size: number of values of a Gaussian.
        rate: learning rate.
    """

    name: str
    size: int = 1
    rate: float = 5e-3

    @abstractmethod
    def start(self, initial: InitialGaussians, rng: np.random.Generator) -> NDArray[np.float32]:
        """Starting values [size, n]."""

    @abstractmethod
    def applied(self, gaussians: Gaussians, values: list[Any]) -> Gaussians:
        """The Gaussians with changed footprints or signals; differentiable.

        Args:
            gaussians: Gaussians of the field for a batch of transmitters.
            values: ``size`` Dr.Jit arrays [n], the same for all transmitters.
        """

    def grown(self, values: NDArray[np.float32], source: IntArray, divided: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Values [size, m] after a round of density control: those of the Gaussian that each new one comes from.

        Args:
            values: values before the round [size, n].
            source: number of the old Gaussian of each new one [m].
            divided: which new ones are parts or copies of a Gaussian [m].
        """
        return values[:, source].copy()

    def columns(self, values: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
        """Columns [n] of a splat file by their names, from values [size, n]."""
        return {self.name if self.size == 1 else f"{self.name}_{k}": each for k, each in enumerate(values)}


ATTRIBUTES: Registry[GaussianAttribute] = Registry("attribute of Gaussians", "wrf_mi.gaussian_attributes", {})


@dataclass(frozen=True)
class WithAttributes:
    """A field whose Gaussians have further attributes; all else is that of ``field``.

    Raises:
        InputError: an attribute of the name of a parameter that the field has.
    """

    field: Any
    attributes: tuple[GaussianAttribute, ...]

    @property
    def per_gaussian(self) -> tuple[str, ...]:
        """Names of the parameters of each Gaussian."""
        return (*self.field.per_gaussian, *(attribute.name for attribute in self.attributes))

    def __getattr__(self, name: str) -> Any:
        # Without it, copying an instance would look the field up before there is one.
        if name.startswith("__") or name == "field":
            raise AttributeError(name)
        return getattr(self.field, name)

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """Parameters of the field and starting values of the attributes, as NumPy arrays."""
        weights: Weights = self.field.init(initial, rng)
        for attribute in self.attributes:
            values = np.asarray(attribute.start(initial, rng), np.float32)
            if values.shape != (attribute.size, initial.count) or attribute.name in weights:
                text = f"shape {list(values.shape)} of new values, expected {[attribute.size, initial.count]}"
                why = "the field has a parameter of that name" if attribute.name in weights else text
                raise InputError(f"attribute {attribute.name}: {why}; change the attribute")
            weights[attribute.name] = values
        return weights

    def gaussians(self, params: Params, tx_pos: Any) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        gaussians: Gaussians = self.field.gaussians(params, tx_pos)
        for attribute in self.attributes:
            gaussians = attribute.applied(gaussians, rows(params[attribute.name]))
        return gaussians


def attributes_of(field: Any) -> tuple[GaussianAttribute, ...]:
    """Further attributes of a field's Gaussians; most fields have none."""
    return field.attributes if isinstance(field, WithAttributes) else ()


def with_attributes(field: Any, names: str) -> Any:
    """A field with registered attributes of some names, separated by commas; "": the field itself.

    Raises:
        InputError: an unknown name, or one that is there twice.
    """
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    for name in wanted:
        if name not in ATTRIBUTES or wanted.count(name) > 1:
            choices = ", ".join(ATTRIBUTES) or "none: no installed package adds one"
            raise InputError(f"setting attributes: {name!r} is unknown or stated twice; known are {choices}")
    return WithAttributes(field, tuple(ATTRIBUTES[name] for name in wanted)) if wanted else field


def grown_attributes(
    field: Any, before: Mapping[str, NDArray[np.float32]], source: IntArray
) -> dict[str, NDArray[np.float32]]:
    """Attributes of a field after a round of density control, by their names; as `GaussianAttribute.grown`."""
    divided = np.bincount(source)[source] > 1
    return {each.name: each.grown(before[each.name], source, divided) for each in attributes_of(field)}
