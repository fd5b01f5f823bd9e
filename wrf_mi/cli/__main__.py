"""``python -m wrf_mi.cli``: the command ``wrf-mi``."""

import sys

from .main import main

if __name__ == "__main__":
    sys.exit(main())
