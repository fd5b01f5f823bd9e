from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short training by the command."""
    from calling import SET

    from wrf_mi.apps.commands.main import main

    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", str(folder), "--model", "wrf-gs+", "--out", str(out), *SET]) == 0
    return out
