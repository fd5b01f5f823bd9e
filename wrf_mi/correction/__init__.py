"""A scene corrected by measurements: materials, planes, frame and antennas, with their standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .edits import Correction, default_options
    from .options import CorrectionOptions
    from .page import write_page, write_scene

# Imported when first used: a fit needs no picture of a correction.
_HOME = {
    "edits": ["Correction", "default_options"],
    "options": ["CorrectionOptions"],
    "page": ["write_page", "write_scene"],
}
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=_HOME)

__all__ = ["Correction", "CorrectionOptions", "default_options", "write_page", "write_scene"]
