"""A field with its parameters and one transmitter, held by the emitter and the medium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import InputError
from wrf_mi.gaussians.fields import GEOMETRY
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.runs.api import open_run
from wrf_mi.runs.folder import FITTED


@dataclass
class FieldSource:
    """A field's parameters and a transmitter position, which determine the Gaussians.

    Attributes:
        field: model, e.g. ``wrf_mi.gaussians.WrfGsPlus``: any object with its method ``gaussians``.
        params: the model's parameters by name, ``mi.TensorXf``.
        tx_position: ``mi.Point3f`` of width 1, world frame, metres.
    """

    field: Any
    params: dict[str, Any]
    tx_position: Any

    def gaussians(self) -> Gaussians:
        """The Gaussians for the transmitter (batch 1). Differentiable in parameters and transmitter position."""
        position: Any = dr.ravel(self.tx_position)
        return cast(Gaussians, self.field.gaussians(self.params, mi.TensorXf(position, (3, 1))))

    def traverse(self, callback: Any) -> None:
        """Expose the transmitter position and every parameter; dots in names become underscores.

        The geometry is flagged discontinuous: derivatives miss the jump of exp(-4.5) at the edge of a footprint.
        """
        differentiable, discontinuous = mi.ParamFlags.Differentiable, mi.ParamFlags.Discontinuous
        callback.put("tx_position", self.tx_position, differentiable)
        for name, values in self.params.items():
            flags = discontinuous if name in GEOMETRY else differentiable
            callback.put(name.replace(".", "_"), values, flags)


def source_of(field: Any, params: Mapping[str, ArrayLike], tx_position_m: ArrayLike) -> FieldSource:
    """A source from a model and its parameters.

    Args:
        field: model.
        params: parameters of the model as arrays, see its ``init``.
        tx_position_m: transmitter position [3], world frame, metres.

    Raises:
        InputError: a position of another shape or not finite.
    """
    position = np.asarray(tx_position_m, float)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InputError(f"tx_position: expected three finite coordinates in metres, got {tx_position_m!r}")
    tensors = {name: to_tensor(values) for name, values in params.items()}
    return FieldSource(field, tensors, mi.Point3f(*position.tolist()))


def source_from_properties(props: Any) -> FieldSource:
    """A source from the properties ``run`` and ``tx_position`` of a plugin.

    Raises:
        InputError: a missing property, or a missing or damaged run folder.
    """
    name = props.plugin_name()
    for key, what in (("run", "a run folder made by wrf-mi train"), ("tx_position", "x, y, z in metres")):
        if key not in props:
            raise InputError(f"{name}: no {key}; give {what}")
    resolver: Any = mi.file_resolver
    path = Path(str(resolver().resolve(props["run"])))
    trained = open_run(path.parent if path.name == FITTED else path).field
    return source_of(trained.field, trained.params, list(props["tx_position"]))
