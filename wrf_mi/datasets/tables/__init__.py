"""Import of measurements from tables as people have them: `import_measurements`."""

from .importing import ImportReport, import_measurements
from .options import ImportOptions

__all__ = ["ImportOptions", "ImportReport", "import_measurements"]
