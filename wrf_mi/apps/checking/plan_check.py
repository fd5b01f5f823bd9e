"""Whether a plan can be read, and the command that makes a scene of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core import InputError
from ...scene.mesh.surfaces import box_of
from ...scene.plan.buildings import Buildings
from ...scene.plan.sources import read_plan
from ...scene.plan.storey import plan_surfaces
from .scene_findings import Finding, SceneReport, refused

HEIGHT_M = 2.5  # of walls while they are counted


def check_plan(path: Path, name: str, units: str) -> SceneReport:
    """Whether a plan has walls that enclose a floor without further options, and its size.

    Args:
        path: the file.
        name: name of the source in the report.
        units: unit of the coordinates of a DXF; m: that which it states.
    """
    units_option = "" if units == "m" else f" --units {units}"
    command, height = f"wrf-mi mesh {path}{units_option} --out SCENE", " --wall-height METRES"
    try:
        plan = read_plan(path, units=None if units == "m" else units)
        is_town = isinstance(plan, Buildings)
        surfaces = plan_surfaces(plan, height_m=None if is_town else HEIGHT_M, name=str(path))
    except InputError as error:
        finding = refused("unclear-plan", path, error)
        return SceneReport(name, (replace(finding, remedy=f"{finding.remedy}: {command}{height}"),))
    width_m, depth_m, _ = np.ptp(box_of(surfaces), axis=0)
    text = f"a plan of {width_m:.1f} m x {depth_m:.1f} m, {sum(each.kind == 'wall' for each in surfaces)} walls"
    finding = Finding("plan", path, "", text, f"make a scene of it: {command}{'' if is_town else height}")
    return SceneReport(name, (finding,), len(surfaces), sum(len(surface.faces) for surface in surfaces))
