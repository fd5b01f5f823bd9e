"""Child process of `wrf_mi.parallel.run_module`: ``python -m wrf_mi.parallel.child THREADS MODULE ARGUMENTS``.

The package does not import it: Python runs it as the main module.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading

INTERRUPTED = 130  # exit status after Ctrl-C


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def main(threads: str, module: str, *arguments: str) -> None:
    """Watch the pipe, set the number of threads (0: all cores) and run the module."""
    # Workers ignore Ctrl-C, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        if int(threads):
            from ..backend import init

            init(threads=int(threads))
        sys.argv = [module, *arguments]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except KeyboardInterrupt:  # while the module is imported
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main(*sys.argv[1:])
