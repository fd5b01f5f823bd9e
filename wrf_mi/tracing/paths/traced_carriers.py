"""Traced fields of a receiver at several carriers from one search, as the geometry of paths has no carrier."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core import Receiver
from ...core.angles import FloatArray
from ...core.carriers import rows_by_carrier
from .corrected_scene import MovedSearch
from .instrument_parameters import moved_m
from .result import TraceResult
from .solve import Prepared, trace_paths
from .traced_field import TracedField, TracedOptions, needs_search


def traced_fields(
    scene: Any,
    tx_pos_m: ArrayLike,
    receiver: Receiver,
    options: TracedOptions,
    prepared: Prepared,
    tx_heading_rad: ArrayLike | None = None,
    carriers_hz: FloatArray | None = None,
    parameters: Mapping[str, Any] | None = None,
    searched: MovedSearch | None = None,
) -> list[TracedField]:
    """Traced fields of the transmitters of each carrier at a receiver, in ascending order of the carriers.

    Paths are searched once for all carriers, and once at positions that repeat; wavelength and materials of a field are
    those of its carrier. Arguments and errors are those of `TracedField`, and ``carriers_hz``: carrier of each
    transmitter [n], Hz (None: that of the scene); ``parameters``: Dr.Jit tensors by the names of
    `TracedField.parameters`, where they move the receiver further than `TracedField.refresh` allows at a carrier, paths
    are searched from there (None: the stated pose); ``searched``: where paths are searched (None: in the stated scene).
    """
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    heading = None if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
    distinct, number = np.unique(positions, axis=0, return_inverse=True)
    number = number.reshape(-1)
    stated_m, here_m = receiver.position_m, moved_m(receiver, parameters or {})
    found, fields = dict[bool, TraceResult](), list[TracedField]()
    for carrier_hz, rows in rows_by_carrier(carriers_hz, len(positions)):
        moved = needs_search(here_m, stated_m, carrier_hz or float(scene.frequency[0]))
        from_m = here_m if moved else stated_m
        if moved not in found:
            there = replace(receiver, position_m=from_m)
            where = searched.prepared if searched else prepared
            how: dict[str, Any] = {"prepared": where, "tx_antenna": options.tx_antenna}
            how |= {"check": False, "gains": False}
            found[moved] = trace_paths(where.scene, distinct, there, options.trace, **how)
        given = positions[rows], receiver, options, None if heading is None else heading[rows]
        traced = found[moved].of_transmitters(number[rows])
        present = searched.parameters if searched else None
        fields.append(TracedField(scene, *given, traced, prepared, carrier_hz, from_m, present))
    return fields
