"""Receiver models: from the field, or from traced paths, to what an instrument reports."""

from .array import array_response, bartlett_spectrum, minmax_scale
from .channel import antenna_csi, csi, element_signals, received_power, rssi_dbm
from .footprints import gaussian_signals
from .lags import Lags
from .physical_array import Array, Pattern, instrument_report

__all__ = [
    "Array",
    "Lags",
    "Pattern",
    "antenna_csi",
    "array_response",
    "bartlett_spectrum",
    "csi",
    "element_signals",
    "gaussian_signals",
    "instrument_report",
    "minmax_scale",
    "received_power",
    "rssi_dbm",
]
