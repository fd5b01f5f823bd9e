"""Footprints drawn on the sky."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from wrf_mi_bench import field_oracle

from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.footprint import LOW_PASS_RAD, NEAR_M, Footprints, project
from wrf_mi.runs import figures
from wrf_mi.training.step import device_pose

RECEIVER = Receiver("gateway1", np.array([1.0, 2.0, 3.0]), np.array([0.36, 0.48, 0.0, 0.8]))
ROUND = np.array([[0.0, 0.0, 0.0, 1.0]])
OUTLINE_TOLERANCE = 1e-9
"""Rounding of a few float64 operations on numbers of order one."""


def placed(azimuth_deg: float, elevation_deg: float, distance_m: float) -> FloatArray:
    direction = unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg))
    return RECEIVER.position_m + RECEIVER.to_world @ (distance_m * direction)


def footprints(position_m: FloatArray, scale_m: FloatArray) -> Footprints:
    nothing = [Float64(np.zeros(len(position_m)))]
    position, scale = ([Float64(column.copy()) for column in part.T] for part in (position_m, scale_m))
    signal, rotation = nothing * 2, [*nothing * 3, nothing[0] + 1]
    return project(
        Gaussians(position, scale, rotation, signal, opacity=nothing[0], attenuation=None, batch=1),
        device_pose(RECEIVER, Float64),
    )


def outlines_of(figure: Figure) -> list[FloatArray]:
    """Unit vectors along each outline in the right picture, in the order in which they are drawn."""
    (lines,) = figure.axes[1].collections
    return [unit_vectors(s[:, 0], np.radians(90 - s[:, 1])) for s in lines.get_segments()]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("azimuth", "elevation"), [(90, 60), (0, 10), (200, 89), (359.5, 0)])
def test_outline_of_a_round_gaussian_is_a_circle_on_the_sky(azimuth: float, elevation: float) -> None:
    """The angular radius is the scale seen from the receiver with the low-pass added, also at seam and zenith."""
    projected = footprints(placed(azimuth, elevation, 4.0)[None], np.full((1, 3), 0.4))
    (outline,) = outlines_of(figures.footprint_sky(np.zeros((9, 36)), projected, [1.0]))
    angle = np.arccos(outline @ unit_vectors(np.radians(azimuth), np.radians(elevation)))
    assert angle == pytest.approx(np.arctan(np.hypot(0.4 / 4.0, LOW_PASS_RAD)), abs=OUTLINE_TOLERANCE)


def test_outline_is_where_the_footprint_is_one_deviation() -> None:
    position, scale = placed(40, 70, 2.0)[None], np.array([[0.1, 0.3, 0.5]])
    (outline,) = outlines_of(figures.footprint_sky(np.zeros((9, 36)), footprints(position, scale), [1.0]))
    projected = field_oracle.project(position, scale, ROUND, RECEIVER)
    assert field_oracle.footprint(projected, 0, outline) == pytest.approx(np.exp(-0.5), abs=OUTLINE_TOLERANCE)


def test_largest_weight_is_drawn_last_and_absent_footprints_are_omitted() -> None:
    directions = unit_vectors(np.radians([0, 90, 180, 270]), np.radians(45))
    distance = np.array([3.0, 3.0, 3.0, NEAR_M / 2])
    position = RECEIVER.position_m + (distance[:, None] * directions) @ RECEIVER.to_world.T
    projected = footprints(position, np.full((4, 3), 0.1))
    figure = figures.footprint_sky(np.zeros((9, 36)), projected, [0.5, 0.9, 0.1, 2.0])
    centres = [outline[:-1].mean(axis=0) for outline in outlines_of(figure)]
    azimuth = [round(np.degrees(np.arctan2(y, x))) % 360 for x, y, _ in centres]
    assert azimuth == [180, 0, 90]
    (lines,) = figure.axes[1].collections
    assert lines.get_array().tolist() == [0.1, 0.5, 0.9]


def test_stages_name_what_is_drawn() -> None:
    def report(stage: str, is_kept: bool, score: float) -> dict[str, object]:
        return {"stage": stage, "kept": is_kept, "held_out": score}

    reports = [report("mean", True, 3.0), report("residual", True, 2.0)]
    (axes,) = figures.stage_steps({"run": reports}).axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["run, held-out rows"]
    assert not axes.get_title()
    (axes,) = figures.stage_steps({"run": [*reports, report("calibration", False, 1.0)]}).axes
    assert axes.get_title() == figures.NOT_KEPT
