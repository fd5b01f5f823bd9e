"""What a view shows, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.settings import CheckedSettings, Count
from ..core.types import IntArray

STORED_TRANSMITTERS, SHOWN_GAUSSIANS, SHOWN_PATHS = 40, 1000, 200


@dataclass(frozen=True)
class ViewOptions(CheckedSettings):
    """Limits of a view, as the arguments of `wrf_mi.view`."""

    transmitters: Count = STORED_TRANSMITTERS
    gaussians: Count = SHOWN_GAUSSIANS
    paths: Count = SHOWN_PATHS


@dataclass(frozen=True)
class MaterialMesh:
    """Triangles of a material.

    Attributes:
        material: name of the radio material.
        ceiling: whether these hide the inside from above.
        corners_m: corners [f, 3, 3], metres.
        surface: surface of each triangle, index into ``names`` [f].
        names: names of the surfaces.
    """

    material: str
    ceiling: bool
    corners_m: FloatArray
    surface: IntArray
    names: tuple[str, ...]


@dataclass(frozen=True)
class SceneContent:
    """Mesh of a scene: triangles by material, and edges [e, 2, 3] in metres along which its surfaces end."""

    meshes: tuple[MaterialMesh, ...]
    edges_m: FloatArray


@dataclass(frozen=True)
class RowsContent:
    """Held-out rows of a run.

    Attributes:
        row: numbers of the rows [m].
        tx_pos_m: positions of their transmitters [m, 3], metres.
        score: score of each receiver [n_rx, m]; NaN where nothing was received.
        label: name of the score.
        digits: digits of the score after the decimal point.
        higher_is_better: whether the score is an accuracy or an error.
        stored: indices [t] into the rows of the transmitters that can be chosen.
        observed: measured and predicted observations of the stored transmitters: ``image``, PNG by receiver and
            transmitter; ``level``, numbers [n_rx, t]; or ``curve``, numbers [n_rx, t, k] (`observations_of`).
        quantity: name of the observed quantity, with its unit.
    """

    row: IntArray
    tx_pos_m: FloatArray
    score: FloatArray
    label: str
    digits: int
    higher_is_better: bool
    stored: IntArray
    observed: dict[str, Any]
    quantity: str


@dataclass(frozen=True)
class GaussiansContent:
    """Gaussians of a learned field for t transmitters, the strongest first.

    Attributes:
        position_m: centres [n, 3], metres.
        log_scale: natural logarithms of the standard deviations in metres [t or 1, n, 3].
        rotation_xyzw: quaternions [t or 1, n, 4].
        strength_db: opacity times magnitude of the signal [t, n], dB.
        total: number of Gaussians of the field.
    """

    position_m: FloatArray
    log_scale: FloatArray
    rotation_xyzw: FloatArray
    strength_db: FloatArray
    total: int


@dataclass(frozen=True)
class PathsContent:
    """Paths of t transmitters; p paths of v corners in all.

    Attributes:
        tx: transmitter of each path [p].
        rx: receiver of each path [p].
        order: number of interactions [p].
        kind: interactions of each path, index into ``kinds`` [p].
        kinds: interactions in words.
        gain_db: 20 log10 of the gain [p].
        length_m: length [p], metres.
        corners_m: corners from transmitter to receiver of all paths, one after the other [v, 3], metres; a path has
            ``order`` + 2.
    """

    tx: IntArray
    rx: IntArray
    order: IntArray
    kind: IntArray
    kinds: tuple[str, ...]
    gain_db: FloatArray
    length_m: FloatArray
    corners_m: FloatArray


@dataclass(frozen=True)
class MapContent:
    """A map on a horizontal grid or on points.

    Attributes:
        name: name of its file.
        height_m: height of the grid, metres; None: points.
        x_m, y_m: coordinates of the grid [nx], [ny], or of the points [q], metres.
        z_m: heights of the points [q], metres; None: a grid.
        receivers: names of the receivers of ``values``; empty: values are common to all.
        values: by name of the quantity, [n_rx, ny, nx] or [n_rx, q]; n_rx is 1 where it has no axis of receivers.
        labels: name of each quantity with its unit.
    """

    name: str
    height_m: float | None
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray | None
    receivers: tuple[str, ...]
    values: dict[str, NDArray[np.float32]]
    labels: dict[str, str]


@dataclass
class ViewContent:
    """All that a view shows.

    Attributes:
        title: names of what is shown.
        notes: what was left out, and where data come from; sentences.
        receivers: names of the receivers.
        receivers_m: their positions [n_rx, 3], metres; NaN where unknown.
    """

    title: str
    notes: list[str] = field(default_factory=list)
    receivers: Sequence[str] = ()
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
