"""Prediction by operator: a trained field with static geometry at the receivers of a run.

    operator<r>.npz    of receiver r: format version, key, weights [pixels, n] as a sparse matrix; arrays only

The file is a cache: its key is a digest of everything that the weights depend on, including the package's version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..backend.device import to_tensor
from ..core import Receiver
from ..core.array_files import stored_arrays, write_arrays
from ..core.digest import content_digest
from ..gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M
from ..gaussians.operator import Images, PixelOperator, pixel_weights
from ..gaussians.static_signals import static_signals
from ..gaussians.tiles import perception_plane
from ..graph.graph import Field
from ..receivers.reports import SQUARED_MAGNITUDE_EPS
from ..version import __version__
from .step import device_pose

FORMAT = 1
"""Version of the file."""
MOST_BYTES = 1 << 30
"""Largest size of one receiver's weights; larger fields are evaluated directly."""


class StaticOperator:
    """A field with static geometry at receivers, evaluated by operators that ``folder`` caches (None: memory only)."""

    def __init__(
        self,
        field: Field,
        params: Mapping[str, NDArray[np.float32]],
        receivers: Sequence[Receiver],
        height: int,
        width: int,
        folder: Path | None = None,
    ) -> None:
        self._field, self._params, self._receivers = field, params, tuple(receivers)
        self._size, self._folder = (height, width), folder
        self._factors, self._coefficients = static_signals(field, params)
        self._ready: dict[int, Images | PixelOperator] = {}

    def __call__(self, tx_pos_m: NDArray[np.float32], receiver: int) -> NDArray[np.float32]:
        """Greys [m, height, width] of transmitters [m, 3]."""
        if receiver not in self._ready:
            operator = PixelOperator(self.weights(receiver), *self._size)
            self._ready[receiver] = operator if self._factors is None else operator.composed(self._factors)
        return self._ready[receiver].magnitude(self._coefficients(tx_pos_m), SQUARED_MAGNITUDE_EPS)

    def key(self, receiver: int) -> str:
        """Digest of everything that the weights at a receiver depend on."""
        pose = self._receivers[receiver]
        constants = (FORMAT, __version__, *self._size, CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M, repr(self._field))
        signal_alone = self._field.signal_parameters
        arrays = {name: a for name, a in self._params.items() if not name.startswith(signal_alone)}
        return content_digest(constants, pose.position_m, pose.to_world, arrays)

    def weights(self, receiver: int) -> csr_array:
        """Weights [pixels, n] at a receiver: stored ones if they are valid, else built and stored.

        Raises:
            MemoryError: they would take more than `MOST_BYTES`.
        """
        key = self.key(receiver)
        shape = self._size[0] * self._size[1], self._params["position"].shape[1]
        path = None if self._folder is None else self._folder / f"operator{receiver}.npz"
        stored = None if path is None else read_weights(path, key, shape)
        if stored is not None:
            return stored
        tensors = {name: to_tensor(values) for name, values in self._params.items()}
        with dr.suspend_grad():
            gaussians = self._field.gaussians(tensors, to_tensor(np.zeros((3, 1))))
            pose, plane = device_pose(self._receivers[receiver]), perception_plane(*self._size, mi.Float)
            weights = pixel_weights(gaussians, pose, plane, MOST_BYTES)
        if path is not None:
            write_weights(path, key, weights)
        return weights


def write_weights(path: Path, key: str, weights: csr_array) -> None:
    """Store weights if the folder can be written."""
    parts = {name: getattr(weights, name) for name in ("data", "indices", "indptr")}
    try:
        write_arrays(path, {"format": np.asarray(FORMAT), "key": np.asarray(key)} | parts, checksum=True)
    except OSError:
        return


def read_weights(path: Path, key: str, shape: tuple[int, int]) -> csr_array | None:
    """Stored weights of ``shape``; None if there are none, or if they are damaged or have another key."""
    try:
        stored = stored_arrays(path)
        if int(stored["format"]) != FORMAT or str(stored["key"]) != key:
            return None
        weights = csr_array(tuple(stored[name] for name in ("data", "indices", "indptr")), shape=shape)
        # SciPy's product checks nothing: an index out of range would end the process.
        weights.check_format(full_check=True)
    except Exception:  # numpy, zipfile and scipy raise a dozen kinds on damaged files
        return None
    return weights
