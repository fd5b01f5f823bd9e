"""Channels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Record, Task
from .one_antenna import ALONE, JOINT, sums_of_rays
from .scores import cea_db, level_of_amplitudes


class Csi(Task):
    """Observations are channels [subcarriers] or [antennas, subcarriers], complex64, scored by estimation accuracy."""

    name = "csi"
    block, label, higher_is_better = "cea_db", "CEA (dB)", True
    score = staticmethod(cea_db)
    limits = -10.0, 40.0
    axes, more_axes, is_complex, frequency_dimension = 1, 1, True, "subcarrier"
    several_carriers = False
    settings, settings_with_scene = ALONE, JOINT
    receiver = receiver_with_scene = "csi"
    carrier_stated_in = "frequencies_hz in base-station.yml"
    from_uplink = "copy of the uplink"
    heading, quantity = "channel coefficients", "power (dB)"
    level_kind, level_note = "gain", "mean of |h|^2 over antennas and subcarriers, in the unit of the data"
    note = (
        "CEA is the channel estimation accuracy, -10 log10 of the relative squared error over a sample's antennas "
        "and subcarriers; IDW averages the nearest training rows, whose number held-out ones choose, by inverse "
        "squared distance; the copy of the uplink takes each antenna's uplink coefficients for the downlink's."
    )

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Zero, whose accuracy is 0 dB."""
        # Over some wavelengths of positions the phase takes every value: the mean of few training rows is chance.
        return {"zero": np.zeros(observed.shape[1:], observed.dtype)}

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Mean squared difference over received observations."""
        from .losses import squared_error

        return squared_error(prediction, truth)

    def level(self, prediction: Prediction) -> Prediction:
        """Channel gain: mean power of the coefficients over antennas and subcarriers (`level_of_amplitudes`)."""
        shape = prediction.mean.shape[1:]
        return level_of_amplitudes(prediction, np.full(shape, 1 / max(int(np.prod(shape)), 1)))

    def unit(self, observed: NDArray[Any]) -> float:
        """Root mean square of a receiver's channels: far and near receivers then have equal weight."""
        size = np.square(np.abs(np.asarray(observed, complex)))
        power = float(np.nanmean(size)) if np.isfinite(size).any() else 0.0
        return power**0.5 if power > 0 else 1.0

    def outputs(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """The shape, as integers of Python."""
        return tuple(map(int, shape))

    def of_rays(self, parts: tuple[Any, Any], shape: tuple[int, int, int], offset: Any, receiver: Any) -> Any:
        """Real parts of the outputs, then imaginary ones, [batch, 2 outputs]."""
        import drjit as dr

        outputs, batch, rays = shape
        both = dr.concat([*sums_of_rays(parts, rays)])
        return dr.moveaxis(type(offset)(both, (2 * outputs, batch)), 0, 1)

    def with_arrays(self, record: Record) -> Record:
        """The record with arrays for several antennas alone; `InputError`: these are unknown."""
        several = record.observation.ndim > 3
        if several and any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antennas' positions unknown; state base_station in base-station.yml")
        return record if several else record.with_array(None)

    def check(self, record: Record) -> None:
        """Refuse inconsistent numbers of rows, antennas, subcarriers and frequencies."""
        source, shape = record.source or record.name, record.observation.shape
        if len(shape) not in (3, 4):
            text = "expected [receivers, rows, subcarriers] or [receivers, rows, antennas, subcarriers]"
            raise InputError(f"{source}: channel coefficients {list(shape)}; {text}")
        counts = [("", shape[-1], record.frequencies_hz, {1, shape[-1]})]
        if record.uplink is not None:
            uplink, antennas = record.uplink.shape, math.prod(shape[2:-1])
            if len(uplink) != 3 or uplink[:2] != (shape[1], antennas):
                text = f"a downlink of {shape[1]} rows and {antennas} antennas; give both for the same ones"
                raise InputError(f"{source}: uplink {list(uplink)} beside {text}")
            counts.append(("uplink ", uplink[2], record.uplink_hz, {uplink[2]}))
        for link, subcarriers, stated_hz, allowed in counts:
            if stated_hz is not None and len(stated_hz) not in allowed:
                text = f"{subcarriers} {link}subcarriers and {len(stated_hz)} frequencies; give one for each"
                raise InputError(f"{source}: {text}")
