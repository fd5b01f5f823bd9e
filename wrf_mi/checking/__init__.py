"""Checks of whole data sets and of scenes: every fault, and what is likely wrong; repair of scenes."""

from .check import SUSPICIONS, DataReport, Suspicion, check_data, warn_of_suspicions
from .scene_check import check_scene
from .scene_findings import Finding, SceneReport
from .scene_repair import Repair, repair_scene

__all__ = [
    "SUSPICIONS",
    "DataReport",
    "Finding",
    "Repair",
    "SceneReport",
    "Suspicion",
    "check_data",
    "check_scene",
    "repair_scene",
    "warn_of_suspicions",
]
