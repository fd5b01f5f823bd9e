"""Checks of whole data sets and of scenes: every fault, and what is likely wrong; repair of scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .check import SUSPICIONS, DataReport, Suspicion, check_data, warn_of_suspicions
    from .scene_check import check_scene
    from .scene_findings import Finding, SceneReport
    from .scene_repair import Repair, repair_scene

# Imported when first used: each training warns of suspicions, without the packages that check meshes.
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "check": ["SUSPICIONS", "DataReport", "Suspicion", "check_data", "warn_of_suspicions"],
        "scene_check": ["check_scene"],
        "scene_findings": ["Finding", "SceneReport"],
        "scene_repair": ["Repair", "repair_scene"],
    },
)

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
