"""A check in a subprocess: ``python -m wrf_mi_bench.check MODULE:FUNCTION FILE``."""

import json
import sys
from pathlib import Path

from wrf_mi.backend import init
from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically
from wrf_mi.core.registry import resolve


def main(function: str, out: str) -> int:
    """Call ``function`` (``module:name``) and write its result as JSON.

    The exit status is 2 with one line where data are missing, 130 where it was interrupted.
    """
    init()
    try:
        figures = resolve(function)()
    except InputError as error:
        print(f"wrf-mi: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    write_atomically(Path(out), json.dumps(figures, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
