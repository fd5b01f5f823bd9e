"""Positions in pixels of a plan, or in another frame that pairs of points tell, as metres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...core import DataFault, InputError
from ...core.angles import FloatArray
from ...scene.plan.sources import picture_scale
from ...scene.register import read_pairs, register_pairs, similar_pixels
from .places import LocalFrame


def registered_frame(
    xy: FloatArray,
    plan: str | Path | None,
    resolution_m: float,
    origin_m: Sequence[float],
    pairs: str | Path | None,
    is_pixels: bool,
) -> tuple[LocalFrame, str]:
    """The frame of pixels of a plan, whose y runs down, or of coordinates that pairs of points register, and a note.

    Args:
        xy: coordinates [n, 2] of the table.
        plan: picture, or YAML of a ROS map that names one; None: none.
        resolution_m: side of a pixel in metres; 0: that of the YAML, or by ``pairs``.
        origin_m: metres x, y from the lower left corner of the picture that become the origin, as of ``wrf-mi mesh``.
        pairs: file with ``x,y,to_x,to_y``, coordinates of the table and metres; None: none.
        is_pixels: whether coordinates are pixels, whose scale the pairs state.

    Raises:
        InputError: neither plan nor pairs, no scale, positions outside the plan, or pairs that disagree.
    """
    if pairs is not None:
        source, target = read_pairs(pairs)
        if is_pixels:
            matrix = similar_pixels(source[:, :2], target[:, :2], str(pairs))
        else:
            matrix = register_pairs(source[:, :2], target[:, :2], str(pairs))[:2, [0, 1, 3]]
        angle = np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0]))
        note = f"positions are registered by {len(source)} pairs: {np.hypot(*matrix[:, 0]):.4g} m a unit"
        return LocalFrame(affine=tuple(map(tuple, matrix.tolist()))), f"{note}, turned by {angle:.1f} degrees"
    if plan is None:
        raise InputError("--units px: pixels of which picture? Give --plan plan.png, or --register-pairs pairs.csv")
    (height, width), scale_m, (x_m, y_m, yaw) = picture_scale(Path(plan), resolution_m or None)
    if (outside := ((xy < 0) | (xy > [width, height])).any(axis=1)).any():
        text = f"{outside.sum()} of {len(xy)} positions are outside its {width} x {height} pixels"
        raise DataFault(Path(plan), f"{text}; give the picture that was clicked, or --register-pairs pairs.csv")
    corner_m = np.array([x_m, y_m]) - (np.asarray(origin_m, float)[:2] if len(origin_m) else 0.0)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])  # of a robot's map about its corner
    affine = np.column_stack([scale_m * turn @ np.diag([1, -1]), turn @ [0, height * scale_m] + corner_m])
    note = f"positions are pixels of {Path(plan).name} ({height} rows, {scale_m:g} m each): y runs down there, up here"
    frame = LocalFrame(affine=tuple(map(tuple, affine.tolist())))
    options = f" --resolution {resolution_m:g}" if resolution_m else ""
    options += f" --origin {','.join(f'{value:g}' for value in origin_m)}" if len(origin_m) else ""
    return frame, f"{note}; the frame is that of wrf-mi mesh {Path(plan).name}{options} --wall-height M"
