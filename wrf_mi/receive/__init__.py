"""Receiver models: from the field, or from traced paths, to what an instrument reports."""

from .array import array_response, bartlett_spectrum, minmax_scale
from .channel import csi, element_signals, received_power, rssi_dbm

__all__ = [
    "array_response",
    "bartlett_spectrum",
    "csi",
    "element_signals",
    "minmax_scale",
    "received_power",
    "rssi_dbm",
]
