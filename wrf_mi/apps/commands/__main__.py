"""``python -m wrf_mi.apps.commands``: the command ``wrf-mi``."""

import sys

from .main import main

if __name__ == "__main__":
    sys.exit(main())
