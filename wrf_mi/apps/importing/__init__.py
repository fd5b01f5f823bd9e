"""Import of measurements from tables as people have them: `import_measurements`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .importing import ImportReport, import_measurements
    from .options import ImportOptions

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "importing": ["ImportReport", "import_measurements"],
        "options": ["ImportOptions"],
    },
)

__all__ = ["ImportOptions", "ImportReport", "import_measurements"]
