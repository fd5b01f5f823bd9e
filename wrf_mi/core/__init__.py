"""Constants, angle convention, errors and the plain types."""

from .angles import azimuth_elevation, pixel_directions, rotation_matrix, unit_vectors
from .errors import BackendError, InputError
from .types import Receiver, Record, Split

__all__ = [
    "BackendError",
    "InputError",
    "Receiver",
    "Record",
    "Split",
    "azimuth_elevation",
    "pixel_directions",
    "rotation_matrix",
    "unit_vectors",
]
