"""Two made-up floors of several rooms, a flat and an office, for channels between a base station and walking users.

Walls, boards and panes are single sheets, as in `build_laboratory`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from .build_laboratory import Mesh, Span, box, joined, sheet, table, wall
from .furnished import GENERIC
from .mitsuba_xml import Parts

Point = tuple[float, float]
Opening = tuple[Span, Span]

DOOR_M = 2.1
"""Height of the doors, which are open."""


@dataclass(frozen=True)
class FloorPlan:
    """A floor with a base station and walking users.

    Attributes:
        parts: radio material and mesh of each part by its name, metres.
        bare: names of the parts of the empty floor: its floor, ceiling, walls and panes.
        station_m: middle of the base station's array, which looks along +x.
        routes: closed polylines of points (x, y) in metres that users walk along, clear of furniture and walls.
    """

    parts: Parts
    bare: tuple[str, ...]
    station_m: tuple[float, float, float]
    routes: tuple[tuple[Point, ...], ...]


def measured(plan: FloorPlan, error_m: float, seed: int) -> Parts:
    """The bare floor, all of `GENERIC`, each part displaced by errors of a standard deviation in metres."""
    off = np.random.default_rng(seed).normal(0, error_m, (len(plan.bare), 3))
    moved = {name: plan.parts[name][1].copy() for name in plan.bare}
    for mesh, by in zip(moved.values(), off, strict=True):
        mesh.apply_translation(by)
    return {name: (GENERIC, mesh) for name, mesh in moved.items()}


def _shell(length: float, width: float, height: float, windows: Mapping[str, Iterable[Opening]]) -> dict[str, Mesh]:
    """Floor, ceiling, the four outer walls with openings for windows, and the panes in these."""
    sides = {
        "south": (1, 0.0, length),
        "north": (1, width, length),
        "west": (0, 0.0, width),
        "east": (0, length, width),
    }
    parts = {
        "floor": sheet(2, 0.0, (0, length), (0, width)),
        "ceiling": sheet(2, height, (0, length), (0, width)),
    }
    panes = []
    for name, (axis, at, along) in sides.items():
        openings = list(windows.get(name, ()))
        parts[f"wall_{name}"] = wall(axis, at, (0, along), (0, height), openings)
        panes += [sheet(axis, at, *opening) for opening in openings]
    return {**parts, "windows": joined(panes)}


def _doors(*along: Span) -> list[Opening]:
    return [(span, (0.0, DOOR_M)) for span in along]


def flat() -> FloorPlan:
    """A flat of 11 x 8 x 2.6 m: living room and kitchen in the south, a corridor, two bedrooms and a bath in the north.

    The base station hangs in the living room; the bedrooms and most of the corridor have no line of sight to it.
    """
    height = 2.6
    windows = {
        "south": [((1.0, 3.6), (0.8, 2.2)), ((7.4, 9.4), (0.9, 2.1))],
        "north": [((1.0, 2.6), (0.8, 2.1)), ((7.6, 9.6), (0.8, 2.1))],
    }
    shell = _shell(11.0, 8.0, height, windows)
    up = (0.0, height)
    inner = {
        "corridor_south": wall(1, 3.6, (0, 11), up, _doors((2.5, 3.4), (8.0, 8.9))),
        "corridor_north": wall(1, 4.8, (0, 11), up, _doors((1.5, 2.4), (4.6, 5.4), (8.2, 9.1))),
        "kitchen_west": wall(0, 6.2, (0, 3.6), up, _doors((1.1, 2.3))),
        "bath_west": sheet(0, 4.0, (4.8, 8.0), up),
        "bath_east": sheet(0, 6.0, (4.8, 8.0), up),
    }
    wood = {
        "tables": joined([table((2.6, 4.2), (1.5, 2.3), 0.74), table((9.3, 10.3), (0.9, 1.9), 0.74)]),
        "beds": joined([sheet(2, 0.5, (0.1, 1.2), (6.3, 7.9)), sheet(2, 0.5, (9.2, 10.9), (6.2, 7.9))]),
    }
    boards = {
        "wardrobes": joined([box((3.35, 5.6, 0.0), (3.95, 7.8, 2.1)), box((6.05, 5.4, 0.0), (6.65, 7.4, 2.1))]),
        "kitchen_units": box((6.9, 0.05, 0.0), (10.9, 0.6, 0.9)),
    }
    metal = {
        "fridge": box((10.3, 2.8, 0.0), (10.9, 3.5, 1.8)),
        "oven_hood": sheet(2, 1.7, (8.2, 8.9), (0.05, 0.5)),
        "screen": sheet(0, 5.9, (0.3, 0.95), (0.7, 1.4)),
    }
    materials = {name: "itu_brick" for name in shell} | {"floor": "itu_concrete", "ceiling": "itu_concrete"}
    materials |= {"windows": "itu_glass"} | {name: "itu_plasterboard" for name in inner}
    materials |= {name: "itu_wood" for name in wood} | {name: "itu_chipboard" for name in boards}
    materials |= {name: "itu_metal" for name in metal}
    meshes = {**shell, **inner, **wood, **boards, **metal}
    living = ((1.3, 0.9), (5.0, 0.9), (5.2, 2.8), (1.4, 2.9))
    kitchen = ((2.95, 3.0), (2.95, 4.2), (8.45, 4.2), (8.45, 2.6), (7.2, 1.7), (5.0, 1.7), (5.0, 2.9))
    west = ((1.95, 4.2), (1.95, 5.7), (2.6, 7.0), (1.6, 5.6), (1.95, 4.2), (6.5, 4.2))
    east = ((8.65, 4.2), (8.65, 5.4), (8.4, 7.3), (7.4, 6.4), (8.65, 5.4), (8.65, 4.2), (9.9, 4.2))
    bath = ((5.0, 4.2), (5.0, 6.6), (5.0, 4.2), (0.9, 4.2))
    parts = {name: (materials[name], mesh) for name, mesh in meshes.items()}
    return FloorPlan(parts, (*shell, *inner), (0.3, 1.8, 2.1), (living, kitchen, west, east, bath))


def office() -> FloorPlan:
    """An office of 18 x 10 x 3 m: an open plan with partitions in the south, a corridor, four rooms behind glass.

    The base station hangs in the open plan, over the partitions; a metal-clad core stands in the middle.
    """
    height = 3.0
    windows = {
        "south": [((x, x + 2.4), (0.9, 2.4)) for x in (1.5, 5.5, 9.5, 13.5)],
        "north": [((x, x + 1.8), (0.9, 2.4)) for x in (1.4, 5.9, 10.4, 14.9)],
        "east": [((6.0, 6.9), (1.0, 2.4))],
    }
    shell = _shell(18.0, 10.0, height, windows)
    up = (0.0, height)
    fronts = wall(1, 7.0, (0, 18), up, _doors(*((x, x + 0.9) for x in (3.2, 7.7, 12.2, 16.7))))
    inner = {f"room_wall_{k}": sheet(0, 4.5 * k, (7.0, 10.0), up) for k in (1, 2, 3)}
    inner["corridor_south"] = wall(1, 5.5, (11.0, 18.0), up, _doors((14.0, 15.0)))
    desks = [(x, y + 0.05 * k) for k, x in enumerate((3.0, 6.2, 12.6, 15.6)) for y in (1.2, 3.4)]
    wood = {
        "desks": joined((table((x, x + 1.6), (y, y + 0.8), 0.74) for x, y in desks)),
        "room_desks": joined(table((x, x + 1.4), (8.6, 9.4), 0.74) for x in (0.6, 5.1, 9.6, 14.1)),
    }
    boards = {"partitions": joined((sheet(1, y + 0.4, (x, x + 1.6), (0.74, 1.4)) for x, y in desks))}
    metal = {
        "core": box((8.6, 2.2, 0.0), (10.4, 4.0, 3.0)),
        "cabinets": joined([box((11.1, 0.05, 0.0), (12.3, 0.5, 1.9)), box((0.05, 6.2, 0.0), (0.5, 6.9, 1.9))]),
        "shelves": joined(sheet(0, x, (8.2, 9.8), (0.1, 1.9)) for x in (4.3, 8.8, 13.3)),
    }
    materials = {name: "itu_concrete" for name in shell} | {"ceiling": "itu_ceiling_board", "windows": "itu_glass"}
    materials |= {"fronts": "itu_glass"} | {name: "itu_plasterboard" for name in inner}
    materials |= {name: "itu_wood" for name in wood} | {name: "itu_chipboard" for name in boards}
    materials |= {name: "itu_metal" for name in metal}
    meshes = {**shell, "fronts": fronts, **inner, **wood, **boards, **metal}
    plan = ((1.4, 0.7), (8.2, 0.7), (8.2, 4.8), (1.6, 4.8), (1.6, 2.7))
    aisle = ((5.4, 0.8), (5.4, 4.85), (11.5, 4.85), (11.5, 1.1), (8.2, 0.8))
    corridor = ((1.2, 6.2), (17.0, 6.2), (14.5, 6.2), (14.5, 4.8), (11.5, 4.8), (8.0, 5.0), (2.0, 5.1))
    rooms_west = (
        (3.65, 6.2),
        (3.65, 7.9),
        (1.6, 7.7),
        (3.65, 7.7),
        (3.65, 6.2),
        (8.15, 6.2),
        (8.15, 7.9),
        (6.2, 7.7),
        (8.15, 7.7),
        (8.15, 6.2),
    )
    rooms_east = (
        (12.65, 6.2),
        (12.65, 7.9),
        (10.6, 7.7),
        (12.65, 7.7),
        (12.65, 6.2),
        (17.15, 6.2),
        (17.15, 7.9),
        (15.0, 7.7),
        (17.15, 7.7),
        (17.15, 6.2),
    )
    parts = {name: (materials[name], mesh) for name, mesh in meshes.items()}
    return FloorPlan(
        parts, (*shell, "fronts", *inner), (0.3, 3.0, 2.4), (plan, aisle, corridor, rooms_west, rooms_east)
    )
