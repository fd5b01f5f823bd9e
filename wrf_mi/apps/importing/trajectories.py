"""Trajectories of a camera or a robot: positions and headings with z up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...core import DataFault
from .files import Table, read_table
from .programs import MATRIX, QUATERNION

AXES = {
    "z": np.eye(3),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Rotation to z up of each axis that is up: a camera's frame has x to the right, y down and z ahead."""
FLAT = 0.5  # of the least extent to the next one where the former is vertical: walkers stay on a floor


def upright(table: Table, up: str) -> Table:
    """A trajectory with columns x, y, z and a heading, or any other table as it is.

    The heading is that of the body's x axis, or of its z axis, where a camera looks, in the frame of one.

    Raises:
        InputError: a trajectory of which y seems to be vertical, without ``up``.
    """
    names = set(table.frame.columns)
    is_matrix = set(MATRIX) <= names
    if not is_matrix and not set(QUATERNION) <= names:
        return table
    position = np.column_stack([table.numbers(axis) for axis in "xyz"])
    if is_matrix:
        rotation = np.column_stack([table.numbers(name) for name in MATRIX]).reshape(-1, 3, 3)
        up = up or "-y"
    else:
        rotation = Rotation.from_quat(np.column_stack([table.numbers(name) for name in QUATERNION])).as_matrix()
    extent = np.ptp(position, axis=0)
    if not up and extent[1] < FLAT * extent[[0, 2]].min():
        text = f"a trajectory over {extent[0]:.3g} x {extent[1]:.3g} x {extent[2]:.3g} m, so y seems to be vertical"
        remedy = "give --up=-y (y down, a camera's frame), --up=y, or --up=z"
        raise DataFault(table.files[0][0], f"{text}; {remedy}", line=1)
    turn = AXES[up or "z"]
    ahead = np.einsum("ij,njk->nik", turn, rotation)[:, :, 0 if up in ("", "z") else 2]
    headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))  # linear between two of them in time
    position = position @ turn.T
    frame = table.frame.drop(columns=[name for name in (*MATRIX, *QUATERNION) if name in names])
    frame = frame.assign(x=position[:, 0], y=position[:, 1], z=position[:, 2], heading_rad=headings)
    times = table.files[0][0].with_name("times.txt")
    if is_matrix and times.is_file():
        of_rows = read_table(times).numbers("1")
        if len(of_rows) != len(table):
            raise DataFault(times, f"{len(of_rows)} times for {len(table)} poses; give one for each, or rename it")
        frame = frame.assign(time=of_rows)
    note = f"{table.files[0][0].name}: a trajectory with {up or 'z'} up (--up), headings of its "
    note += "x axis" if up in ("", "z") else "z axis"
    if up in ("y", "-y"):  # its origin is the first pose, at an unknown height
        frame, note = frame.drop(columns="z"), f"{note}; heights count from the first pose: left out (--height)"
    return replace(table, frame=frame, notes=(*table.notes, note))
