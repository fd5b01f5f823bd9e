"""Receiver models in NumPy: from traced paths to spectra, channel coefficients and signal strengths, and back."""

from .array import Lags, array_response, bartlett_spectrum
from .channel import antenna_csi, array_channels, csi, received_power, rssi_dbm
from .scaling import minmax_scale

__all__ = [
    "Lags",
    "antenna_csi",
    "array_channels",
    "array_response",
    "bartlett_spectrum",
    "csi",
    "minmax_scale",
    "received_power",
    "rssi_dbm",
]
