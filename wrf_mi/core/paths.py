"""Propagation paths between transmitters and receivers as plain arrays, and their file format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray
from .array_files import stored_arrays, write_arrays
from .errors import InputError
from .files import readable
from .stored import from_arrays, to_arrays
from .types import IntArray

FORMAT = 2  # version of the file format


@dataclass(frozen=True)
class Paths:
    """Paths from ``n_tx`` transmitters to ``n_rx`` receivers; p paths in all, sorted by receiver, transmitter, length.

    Attributes:
        tx: transmitter of each path, shape [p].
        rx: receiver of each path, shape [p].
        gain: complex, shape [p]: free-space loss lambda / (4 pi length), interactions and antenna patterns, without the
            phase exp(-j k length) of travelling.
        length_m: unfolded length, shape [p], metres, float64.
        departure: unit vector in which the wave leaves the transmitter, world frame, shape [p, 3].
        arrival: unit vector from the receiver against the direction of propagation, world frame, shape [p, 3].
        interactions: kind of each interaction from transmitter to receiver, uint8, shape [p, depth]: the values of
            Sionna RT's ``InteractionType`` (1 reflection, 2 scattering, 4 transmission, 8 diffraction), 0 beyond
            the last.
        vertices_m: interaction points, world frame, metres, shape [p, depth, 3], NaN beyond the last.
        objects: index into ``object_names`` of the surface of each interaction, int32, shape [p, depth], -1 beyond the
            last.
        object_names: names of the scene's surfaces.
        n_tx: transmitters traced, with or without a path.
        n_rx: receivers traced, with or without a path.

    Raises:
        ValueError: arrays of inconsistent shapes.
    """

    tx: IntArray
    rx: IntArray
    gain: NDArray[np.complex128]
    length_m: FloatArray
    departure: FloatArray
    arrival: FloatArray
    interactions: NDArray[np.uint8]
    vertices_m: FloatArray
    objects: NDArray[np.int32]
    object_names: tuple[str, ...]
    n_tx: int
    n_rx: int

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.tx)

    def __post_init__(self) -> None:
        depth = self.interactions.shape[1] if self.interactions.ndim == 2 else -1
        more: dict[str, tuple[int, ...]] = {"departure": (3,), "arrival": (3,), "interactions": (depth,)}
        more |= {"objects": (depth,), "vertices_m": (depth, 3)}
        for name in ARRAYS:
            expected, actual = (len(self.tx), *more.get(name, ())), getattr(self, name).shape
            if actual != expected:
                raise ValueError(f"Paths: {name} has shape {list(actual)}, expected {list(expected)}")

    @property
    def bounces(self) -> IntArray:
        """Number of interactions of each path, shape [p]."""
        return np.asarray(np.count_nonzero(self.interactions, axis=1))

    def select(self, which: NDArray[Any]) -> Paths:
        """The paths of a mask or of ascending indices ``which`` [p], of the same devices."""
        return replace(self, **{name: getattr(self, name)[which] for name in ARRAYS})


ARRAYS = tuple(each.name for each in fields(Paths) if each.name not in ("object_names", "n_tx", "n_rx"))
"""Attributes of `Paths` whose first axis counts paths."""


def save_paths(file: str | Path, paths: Paths, extra: Mapping[str, Any] | None = None) -> Path:
    """Write paths (`wrf_mi.core.stored`), and extra arrays by other keys, to a compressed ``.npz``, atomically."""
    return write_arrays(Path(file), {"format": FORMAT, **to_arrays(paths), **(extra or {})}, compressed=True)


def load_paths(file: str | Path) -> Paths:
    """Read a file of `save_paths`; `InputError`: missing, damaged, or of another format version."""
    return read_paths_file(file)[0]


def read_paths_file(file: str | Path) -> tuple[Paths, dict[str, NDArray[Any]]]:
    """The paths of a file, and all its arrays (`load_paths`)."""
    path = Path(file)
    with readable(path, f"{path}: missing; trace the paths first", "trace the paths anew"):
        arrays = stored_arrays(path)
        version = int(arrays.pop("format"))
        if version != FORMAT:
            raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
        return from_arrays(Paths, arrays), arrays
