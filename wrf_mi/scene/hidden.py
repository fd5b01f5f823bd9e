"""Faces of furniture that a scan could not see, supposed from those that it saw.

Most furniture is made of boxes with upright sides. Two sides that meet in a corner or are opposite, or a top and a side
at its edge, state where the other sides and the top of a box are. Whether they are there, and of what, measurements
have to tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations, count, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import shapely

from ..core.angles import FloatArray
from .edit import read_surfaces
from .folder import write_scene
from .materials import FILE
from .mesh.surfaces import Surface, bodies

PREFIX = "hidden_"  # names of supposed faces begin with it
FLAT_M = 0.03  # largest distance of a face's corners from its plane
UPRIGHT = np.sin(np.radians(10))  # sine of the largest lean of a side, and of the largest deviation from a right angle
TOUCH_M = 0.15  # largest gap where two faces of a box meet: an edge is seen to the point spacing of the scan
SAME_M = 0.1  # distance within which parallel faces are one: a cabinet's back at a wall is the wall
COVERED = 0.3  # share of a face, seen along its normal, from which on another one in its place stands for it
GRID_M = 1e-4  # grid of outlines that are compared
LEAST_SIDE_M, MOST_SIDE_M = 0.15, 3.0  # sides of boxes
Box = tuple[FloatArray, float, float]
"""Corners [4, 2] of a box's base in the order of the outline, lowest and highest z."""


@dataclass(frozen=True)
class Rectangle:
    """A flat face.

    Attributes:
        centre: its centre [3], metres.
        sides: its half sides [2, 3], metres, at right angles.
        name: name of its surface; "": it has none.
    """

    centre: FloatArray
    sides: FloatArray
    name: str = ""

    @property
    def normal(self) -> FloatArray:
        """Unit normal [3]."""
        across = np.cross(*self.sides)
        return np.asarray(across / np.linalg.norm(across))

    @property
    def corners(self) -> FloatArray:
        """Corners [4, 3] in the order of the outline."""
        return np.asarray(self.centre + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ self.sides)

    def covered_by(self, other: Rectangle) -> bool:
        """Whether another face lies in its place."""
        if abs(self.normal @ other.normal) < np.sqrt(1 - UPRIGHT**2):
            return False
        if abs((other.centre - self.centre) @ self.normal) > SAME_M:
            return False
        length = np.linalg.norm(self.sides, axis=1)
        flat = [
            shapely.Polygon((face.corners - self.centre) @ (self.sides / length[:, None]).T) for face in (self, other)
        ]
        # On a grid: of outlines that are equal but for rounding, GEOS may else find no intersection.
        return bool(shapely.intersection(*flat, grid_size=GRID_M).area > COVERED * flat[0].area)

    @property
    def heights_m(self) -> FloatArray:
        """Lowest and highest z [2] of a side, whose second half side is upright."""
        return np.asarray(self.centre[2] + self.sides[1, 2] * np.array([-1, 1]))


class Boxes(NamedTuple):
    """Boxes of furniture: faces that complete them, and names of the surfaces of each box, those faces included."""

    hidden: list[Surface]
    members: list[frozenset[str]]


@contextmanager
def with_hidden_faces(scene: str | Path) -> Iterator[tuple[str | Path, Boxes]]:
    """A scene folder with the hidden faces of its `boxes` for as long as the context lasts, and these.

    They are of the material that its rules give furniture. The scene (see `wrf_mi.tracing.open_scene`) itself where it
    has none.
    """
    supposed = Boxes([], [])
    if (Path(scene) / FILE).is_file():
        surfaces, materials = read_surfaces(scene)
        supposed = boxes(surfaces)
    if not supposed.hidden:
        yield scene, supposed
        return
    kinds = {**materials.surfaces, **{face.name: face.kind for face in supposed.hidden}}
    materials = replace(materials, surfaces=kinds)
    parts, frame = [*surfaces, *supposed.hidden], f"that of {scene}"
    with TemporaryDirectory() as place:
        yield write_scene(Path(place) / "scene", parts, frame=frame, source=str(scene), materials=materials), supposed


def boxes(surfaces: Sequence[Surface]) -> Boxes:
    """Boxes of surfaces of the kind ``other``, with faces that complete them where no other surfaces lie.

    Faces are named ``hidden_01`` and so on, less the names that surfaces have.
    """
    # Walls, floor and ceiling may stand in the place of a box's face, but are no faces of boxes.
    furniture, around = (
        list(_faces([surface for surface in surfaces if (surface.kind == "other") == is_furniture]))
        for is_furniture in (True, False)
    )
    names = _free_names({surface.name for surface in surfaces})
    hidden, members = list[Rectangle](), dict[frozenset[str], None]()
    for box in filter(_has_size_of_furniture, _boxes(furniture)):
        present, missing = _present_and_missing(box, [*furniture, *hidden], around)
        completing = [replace(face, name=next(names)) for face in missing]
        hidden += completing
        members[frozenset(face.name for face in present + completing)] = None
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    return Boxes([Surface(face.name, "other", face.corners, halves) for face in hidden], list(members))


def _free_names(names_in_use: set[str]) -> Iterator[str]:
    return (name for number in count(1) if (name := f"{PREFIX}{number:02d}") not in names_in_use)


def _present_and_missing(
    box: Box, furniture: Sequence[Rectangle], around: Sequence[Rectangle]
) -> tuple[list[Rectangle], list[Rectangle]]:
    """Faces of furniture in the place of a box's faces, and its faces in whose place no face is known."""
    present, missing = list[Rectangle](), list[Rectangle]()
    for face in _faces_of_box(*box):
        in_place = [other for other in furniture if face.covered_by(other)]
        present += in_place
        # Walls and floors in its place hide a face for good, and belong to no box.
        if not in_place and not any(map(face.covered_by, around)):
            missing.append(face)
    return present, missing


def _has_size_of_furniture(box: Box) -> bool:
    base, low, high = box
    sizes = np.linalg.norm(base[1:3] - base[:2], axis=1)
    return bool(min(*sizes, high - low) >= LEAST_SIDE_M and max(sizes) <= MOST_SIDE_M)


def _faces_of_box(base: FloatArray, low: float, high: float) -> Iterator[Rectangle]:
    """Sides and top of a `Box`."""
    middle = np.append(base.mean(axis=0), (low + high) / 2)
    along, across = (np.append((base[k + 1] - base[k]) / 2, 0.0) for k in (0, 1))
    up = np.array([0.0, 0.0, (high - low) / 2])
    for side, other in ((along, across), (across, along)):
        yield Rectangle(middle - other, np.stack([side, up]))
        yield Rectangle(middle + other, np.stack([side, up]))
    yield Rectangle(middle + up, np.stack([along, across]))


def _faces(surfaces: Sequence[Surface]) -> Iterator[Rectangle]:
    """Upright and level faces of surfaces."""
    for surface in surfaces:
        for body in bodies(surface.vertices_m[surface.faces]):
            corners = body.corners_m.reshape(-1, 3)
            centre = corners.mean(axis=0)
            # The direction in which the corners spread least.
            normal = np.linalg.svd(corners - centre, full_matrices=False)[2][2]
            axes = _axes(normal, corners)
            if axes is None or np.abs((corners - centre) @ normal).max() > FLAT_M:
                continue
            flat = (corners - centre) @ axes.T
            low, high = flat.min(axis=0), flat.max(axis=0)
            if (high - low > FLAT_M).all():
                yield Rectangle(centre + (low + high) / 2 @ axes, (high - low)[:, None] / 2 * axes, surface.name)


def _axes(normal: FloatArray, corners: FloatArray) -> FloatArray | None:
    """Unit vectors [2, 3] along the sides of an upright or level face; None for a face that is neither."""
    if abs(normal[2]) < UPRIGHT:
        along = np.array([-normal[1], normal[0], 0.0]) / np.hypot(*normal[:2])
        return np.stack([along, [0.0, 0.0, 1.0]])
    outline = shapely.get_coordinates(shapely.MultiPoint(corners[:, :2]).minimum_rotated_rectangle)
    if np.hypot(*normal[:2]) >= UPRIGHT or len(outline) < 4:
        return None
    side = np.append(outline[1] - outline[0], 0.0)
    side /= np.linalg.norm(side)
    return np.stack([side, np.array([-side[1], side[0], 0.0])])


def _boxes(faces: Sequence[Rectangle]) -> Iterator[Box]:
    """Boxes of which two faces are known."""
    sides = [face for face in faces if abs(face.normal[2]) < 0.5]
    tops = [face for face in faces if abs(face.normal[2]) > 0.5]
    # A top states its outline, and a side below it the height; of two sides the outline is at right angles or parallel.
    for top, side in product(tops, sides):
        if _is_below(top, side):
            yield top.corners[:, :2], side.heights_m[0], top.centre[2]
    for first, second in combinations(sides, 2):
        base = _corner(first, second)
        base = _between(first, second) if base is None else base
        if base is not None:
            heights = np.concatenate([first.heights_m, second.heights_m])
            yield base, heights.min(), heights.max()


def _is_below(top: Rectangle, side: Rectangle) -> bool:
    """Whether a side stands below an edge of a top."""
    for edge, half in (top.sides, top.sides[::-1]):
        length = np.linalg.norm(edge)
        along = edge / length
        for middle in (top.centre - half, top.centre + half):
            away = side.centre + side.sides[1] - middle  # from the edge to the side's upper end
            near = abs(away @ half) / np.linalg.norm(half) < TOUCH_M and abs(away[2]) < TOUCH_M
            if abs(side.normal @ along) < UPRIGHT and near and abs(away @ along) < length:
                return True
    return False


def _corner(first: Rectangle, second: Rectangle) -> FloatArray | None:
    """Base [4, 2] of the box of two sides that meet; None: they do not, or not at right angles."""
    lows, highs = np.stack([first.heights_m, second.heights_m], axis=1)
    if abs(first.normal @ second.normal) > UPRIGHT or highs.min() - lows.max() < LEAST_SIDE_M:
        return None
    # Each end of the one with each end of the other.
    for a, b in product((first.sides[0, :2], -first.sides[0, :2]), (second.sides[0, :2], -second.sides[0, :2])):
        end, begin = first.centre[:2] - a, second.centre[:2] - b
        if np.linalg.norm(end - begin) < TOUCH_M:
            corner = (end + begin) / 2
            along = 2 * a
            across = 2 * (b - (b @ a) / (a @ a) * a)  # square to the first side, as long as the second
            return np.stack([corner, corner + along, corner + along + across, corner + across])
    return None


def _between(first: Rectangle, second: Rectangle) -> FloatArray | None:
    """Base [4, 2] of the box between two sides of equal outline; None: they are not opposite."""
    a, gap = first.sides[0, :2], second.centre - first.centre
    size = np.linalg.norm(a)
    # From one middle to the other: along the sides, where opposite ones do not differ, and square to them.
    along, across = float(gap[:2] @ a / size), gap[:2] - (gap[:2] @ a) / size**2 * a
    longer = np.linalg.norm(first.sides, axis=1) - np.linalg.norm(second.sides, axis=1)
    if abs(first.normal @ second.normal) < np.sqrt(1 - UPRIGHT**2) or np.linalg.norm(across) < SAME_M:
        return None
    if max(abs(along), abs(gap[2]), *np.abs(longer)) > TOUCH_M:
        return None
    corner = first.centre[:2] - a
    return np.stack([corner, corner + 2 * a, corner + 2 * a + across, corner + across])
