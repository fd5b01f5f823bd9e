"""A field with its parameters, asked for one transmitter: what the emitter and the medium hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
    """A field's parameters and a transmitter position; the Gaussians follow from them.

    Attributes:
        field: a model, e.g. ``wrf_mi.gaussians.WrfGsPlus``: any object with its method ``gaussians``.
        params: the model's parameters by name, ``mi.TensorXf``.
        tx_position: ``mi.Point3f`` of width 1, world frame, metres.
    """

    field: Any
    params: dict[str, Any]
    tx_position: Any

    def gaussians(self) -> Gaussians:
        """The Gaussians for the transmitter (batch 1). Differentiable in parameters and transmitter position."""
        return self.field.gaussians(self.params, mi.TensorXf(dr.ravel(self.tx_position), (3, 1)))

    def traverse(self, callback: Any) -> None:
        """Expose the transmitter position and every parameter; dots in names become underscores.

        Moving a Gaussian moves the edge of its footprint, where derivatives miss a jump of exp(-4.5) of its peak: so
        the geometry is flagged discontinuous.
        """
        differentiable, discontinuous = mi.ParamFlags.Differentiable, mi.ParamFlags.Discontinuous
        callback.put("tx_position", self.tx_position, differentiable)
        for name, values in self.params.items():
            flags = discontinuous if name in GEOMETRY else differentiable
            callback.put(name.replace(".", "_"), values, flags)


def source_of(field: Any, params: dict[str, ArrayLike], tx_position_m: ArrayLike) -> FieldSource:
    """A source from a model and its parameters.

    Args:
        field: the model.
        params: its parameters as arrays, see its ``init``.
        tx_position_m: three coordinates, world frame.

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
        InputError: one of them is missing, or the run folder is none or damaged.
    """
    name = props.plugin_name()
    for key, what in (("run", "a run folder made by wrf-mi train"), ("tx_position", "x, y, z in metres")):
        if key not in props:
            raise InputError(f"{name}: no {key}; give {what}")
    path = Path(str(mi.file_resolver().resolve(props["run"])))
    trained = open_run(path.parent if path.name == FITTED else path).field
    return source_of(trained.field, trained.params, list(props["tx_position"]))
