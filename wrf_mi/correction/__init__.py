"""A scene corrected by measurements: materials, planes, frame and antennas, with their standard deviations."""

from __future__ import annotations

from .correct import Correction, correct_scene, default_options
from .options import CorrectionOptions
from .page import write_page

__all__ = ["Correction", "CorrectionOptions", "correct_scene", "default_options", "write_page"]
