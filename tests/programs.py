"""Programs that some tests need, which ``.ci/test_programs.sh`` installs."""

import os
import shutil
import sys
from pathlib import Path

import pytest


def installed(*names: str) -> str:
    """Path of the first of some programs that is on the PATH or beside Python.

    Without any, the test is skipped; in continuous integration (``CI=true``) it fails.
    """
    folders = os.pathsep.join((os.environ.get("PATH", os.defpath), str(Path(sys.executable).parent)))
    for name in names:
        if path := shutil.which(name, path=folders):
            return path
    message = f"none of {', '.join(names)} is installed; install it: .ci/test_programs.sh"
    if os.environ.get("CI") == "true":
        pytest.fail(message, pytrace=False)
    pytest.skip(message)
