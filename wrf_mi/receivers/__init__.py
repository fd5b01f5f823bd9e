"""Receiver models in NumPy: from traced paths to spectra, channel coefficients and signal strengths, and back."""

from .array import Lags, array_response, bartlett_spectrum
from .channel import antenna_csi, array_channels, csi, received_power, rssi_dbm
from .delay_doppler import Sampling, csi_over_time, delay_doppler_spectrum
from .reports import minmax_scale

__all__ = [
    "Lags",
    "Sampling",
    "antenna_csi",
    "array_channels",
    "array_response",
    "bartlett_spectrum",
    "csi",
    "csi_over_time",
    "delay_doppler_spectrum",
    "minmax_scale",
    "received_power",
    "rssi_dbm",
]
