"""A flat of one room in the layout of flat-ble: walls, two anchors, strengths that fall with distance."""

from pathlib import Path

import numpy as np

ANCHORS_M = {1: (0.4, 0.5, 2.1), 2: (4.5, 3.4, 2.3)}
NAMED_ANCHORS_M = {"kitchen": (0.4, 0.5, 2.1), "hall $_$": (4.5, 3.4, 2.3)}
TAG_HEIGHT_M = 1.3


def write_flat(folder: Path, rows: int = 24, held_out: int = 6) -> Path:
    """Write the folder; the room is 5 m x 4 m."""
    return _write(folder, rows, held_out, ANCHORS_M, plain=False)


def write_plain_flat(folder: Path, rows: int = 24, held_out: int = 6) -> Path:
    """The same without headings, with heights that differ and anchors that have names."""
    return _write(folder, rows, held_out, NAMED_ANCHORS_M, plain=True)


def _write(folder: Path, rows: int, held_out: int, anchors_m: dict, plain: bool) -> Path:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(5)
    (folder / "layout.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n")
    lines = [f"{name},{x},{y},{z}" for name, (x, y, z) in anchors_m.items()]
    (folder / "anchors.csv").write_text("\n".join(["id,x,y,z", *lines]) + "\n")
    for name, count in (("calibration_df.csv", rows), ("test_robot_df.csv", held_out)):
        header = ["ts", "x", "y", "z" if plain else "heading", *(f"rssi_{anchor}" for anchor in anchors_m)]
        table = [",".join(header)]
        for row in range(count):
            x, y = rng.uniform([0.6, 0.6], [4.2, 3.2])
            z = rng.uniform(0.3, 1.9) if plain else TAG_HEIGHT_M
            distance = [np.linalg.norm(np.subtract(at, (x, y, z))) for at in anchors_m.values()]
            strength = [-45 - 20 * np.log10(d) + rng.normal(0, 2) for d in distance]
            numbers = (row, x, y, z if plain else rng.uniform(-3, 3), *strength)
            table.append(",".join(f"{value:.3f}" for value in numbers))
        (folder / name).write_text("\n".join(table) + "\n")
    return folder
