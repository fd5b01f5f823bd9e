"""Constants, angle convention, errors and the plain types."""

from .angles import azimuth_elevation, pixel_directions, rotation_matrix, unit_vectors
from .errors import BackendError, InputError
from .paths import Paths, load_paths, save_paths
from .types import Receiver, Record, Split

__all__ = [
    "BackendError",
    "InputError",
    "Paths",
    "Receiver",
    "Record",
    "Split",
    "azimuth_elevation",
    "load_paths",
    "pixel_directions",
    "rotation_matrix",
    "save_paths",
    "unit_vectors",
]
