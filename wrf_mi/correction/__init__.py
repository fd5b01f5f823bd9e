"""A scene corrected by measurements: materials, planes, frame and antennas, with their standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .correct import Correction, correct_scene, default_options
    from .options import CorrectionOptions
    from .page import write_page

# Imported when first used: a fit needs no picture of a correction.
_HOME = {
    "correct": ["Correction", "correct_scene", "default_options"],
    "options": ["CorrectionOptions"],
    "page": ["write_page"],
}
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=_HOME)

__all__ = ["Correction", "CorrectionOptions", "correct_scene", "default_options", "write_page"]
