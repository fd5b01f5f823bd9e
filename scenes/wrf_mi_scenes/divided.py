"""Rooms of any number of triangles, for measuring the cost of a mesh: finely divided walls, or clutter."""

from __future__ import annotations

import numpy as np
import trimesh

from .build_laboratory import HEIGHT, LENGTH, WIDTH, Mesh, joined

CLUTTER_M2 = 60.0
"""Total surface of the clutter, a quarter of the room's, so that the free path of rays does not depend on the
number."""
CLEAR_M = 1.0
"""Distance from points that are kept free."""


def divided_room(triangles: int) -> Mesh:
    """The laboratory's shell, its sides divided into equal cells of two triangles, at least ``triangles`` in all."""
    cells = max(1, int(np.ceil(np.sqrt(triangles / 12))))
    steps = np.linspace(0, 1, cells + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    at = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    sides = []
    for axis in range(3):
        for end in (0.0, 1.0):
            corners = np.full((len(u), 3), end)
            corners[:, [k for k in range(3) if k != axis]] = np.stack([u, v], axis=1)
            sides.append(corners * [LENGTH, WIDTH, HEIGHT])
    numbered = np.concatenate([faces + k * len(u) for k in range(len(sides))])
    return Mesh(vertices=np.concatenate(sides), faces=numbered, process=False)


def cluttered_room(triangles: int, clear: np.ndarray, seed: int = 0) -> Mesh:
    """The laboratory's shell with boxes turned at random, the smaller the more of them, about ``triangles`` in all.

    Boxes keep away from the points ``clear`` [n, 3].
    """
    count, rng = max(1, (triangles - 12) // 12), np.random.default_rng(seed)
    side = np.sqrt(CLUTTER_M2 / 6 / count)
    place = np.zeros((0, 3))
    while len(place) < count:
        drawn = rng.uniform(0, [LENGTH, WIDTH, HEIGHT], (2 * count, 3))
        far = np.linalg.norm(drawn[:, None] - clear, axis=-1).min(axis=1) > CLEAR_M + side
        place = np.concatenate([place, drawn[far]])[:count]
    box = trimesh.creation.box((side, side, side))
    turn = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    corners = np.einsum("vj,nij->nvi", np.asarray(box.vertices), turn) + place[:, None]
    faces = np.asarray(box.faces)[None] + np.arange(count)[:, None, None] * corners.shape[1]
    shell = divided_room(12)
    boxes = Mesh(vertices=corners.reshape(-1, 3), faces=faces.reshape(-1, 3), process=False)
    return joined([shell, boxes])
