"""What a view shows, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Count
from ...core.types import IntArray

STORED_TRANSMITTERS, SHOWN_GAUSSIANS, SHOWN_PATHS = 40, 1000, 200


@dataclass(frozen=True)
class ViewOptions(CheckedSettings):
    """Limits of a view, as the arguments of `wrf_mi.apps.viewer.view.view`."""

    transmitters: Count = STORED_TRANSMITTERS
    gaussians: Count = SHOWN_GAUSSIANS
    paths: Count = SHOWN_PATHS


@dataclass(frozen=True)
class MaterialMesh:
    """Triangles of a material."""

    material: str  # name of the radio material
    colour: str  # its colour, ``#rrggbb``
    ceiling: bool  # whether these hide the inside from above
    corners_m: FloatArray  # corners [f, 3, 3], metres
    surface: NDArray[np.str_]  # name of the surface of each triangle [f]


@dataclass(frozen=True)
class SceneContent:
    """Mesh of a scene: triangles by material, and edges [e, 2, 3] in metres along which its surfaces end."""

    meshes: tuple[MaterialMesh, ...]
    edges_m: FloatArray


@dataclass(frozen=True)
class RowsContent:
    """Held-out rows of a run."""

    row: IntArray  # numbers of the rows [m]
    tx_pos_m: FloatArray  # positions of their transmitters [m, 3], metres
    score: FloatArray  # score of each receiver [n_rx, m]; NaN where nothing was received
    label: str  # name of the score
    digits: int  # digits of the score after the decimal point
    stored: IntArray  # indices [t] into the rows of the transmitters that can be chosen
    # ``measured`` and ``predicted`` observations of the stored transmitters, and their ``kind``: ``image``, spectra
    # [n_rx, t, H, W] in steps of 1/255; ``level``, numbers [n_rx, t]; or ``curve``, numbers [n_rx, t, k]
    observed: dict[str, Any]
    quantity: str  # name of the observed quantity, with its unit


@dataclass(frozen=True)
class GaussiansContent:
    """Gaussians of a learned field for t transmitters, the strongest first."""

    position_m: FloatArray  # centres [n, 3], metres
    log_scale: FloatArray  # natural logarithms of the standard deviations in metres [t or 1, n, 3]
    rotation_xyzw: FloatArray  # quaternions [t or 1, n, 4]
    strength_db: FloatArray  # opacity times magnitude of the signal [t, n], dB
    total: int  # number of Gaussians of the field


@dataclass(frozen=True)
class PathsContent:
    """Paths of t transmitters; p paths of v corners in all."""

    tx: IntArray  # transmitter of each path [p]
    rx: IntArray  # receiver of each path [p]
    order: IntArray  # number of interactions [p]
    kind: IntArray  # interactions of each path, index into ``kinds`` [p]
    kinds: tuple[str, ...]  # interactions in words
    gain_db: FloatArray  # 20 log10 of the gain [p]
    length_m: FloatArray  # length [p], metres
    # corners from transmitter to receiver of all paths, one after the other [v, 3], metres; a path has ``order`` + 2
    corners_m: FloatArray


@dataclass(frozen=True)
class MapContent:
    """A map on a horizontal grid or on points."""

    name: str  # name of its file
    height_m: float | None  # height of the grid, metres; None: points
    # x_m, y_m: coordinates of the grid [nx], [ny], or of the points [q], metres
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray | None  # heights of the points [q], metres; None: a grid
    receivers: tuple[str, ...]  # names of the receivers of ``values``; empty: values are common to all
    # by name of the quantity, [n_rx, ny, nx] or [n_rx, q]; n_rx is 1 where it has no axis of receivers
    values: dict[str, NDArray[np.float32]]
    labels: dict[str, str]  # name of each quantity with its unit


@dataclass
class ViewContent:
    """All that a view shows."""

    title: str  # names of what is shown
    notes: list[str] = field(default_factory=list)  # what was left out, and where data come from; sentences
    receivers: Sequence[str] = ()  # names of the receivers
    # their positions [n_rx, 3], metres; NaN where unknown
    receivers_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    scene: SceneContent | None = None
    rows: RowsContent | None = None
    gaussians: GaussiansContent | None = None
    paths: PathsContent | None = None
    maps: list[MapContent] = field(default_factory=list)

    @property
    def counts(self) -> dict[str, int]:
        """Number of elements of each layer that is present."""
        counts: dict[str, int] = {}
        if self.scene is not None:
            counts["triangles"] = sum(len(mesh.corners_m) for mesh in self.scene.meshes)
        if self.rows is not None:
            counts |= {"held_out_rows": len(self.rows.row), "transmitters": len(self.rows.stored)}
        if self.gaussians is not None:
            counts["gaussians"] = len(self.gaussians.position_m)
        if self.paths is not None:
            counts["paths"] = len(self.paths.tx)
        return counts | ({"maps": len(self.maps)} if self.maps else {})
