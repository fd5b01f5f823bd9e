"""Constants, angle convention, errors and the plain types."""

from .angles import azimuth_elevation, pixel_directions, rotation_matrix, unit_vectors
from .antenna import Antenna, AntennaOptions
from .errors import BackendError, DataFault, InputError
from .paths import Paths, load_paths, save_paths
from .prediction import Prediction
from .receivers import receiver_arrays, stored_receivers
from .task import Task
from .types import Receiver, Record, Split

__all__ = [
    "Antenna",
    "AntennaOptions",
    "BackendError",
    "DataFault",
    "InputError",
    "Paths",
    "Prediction",
    "Receiver",
    "Record",
    "Split",
    "Task",
    "azimuth_elevation",
    "load_paths",
    "pixel_directions",
    "receiver_arrays",
    "rotation_matrix",
    "save_paths",
    "stored_receivers",
    "unit_vectors",
]
