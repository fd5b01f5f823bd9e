"""The command within this process, as the fixture ``command`` gives it, and the files that it reads and writes."""

import csv
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from calling import call, refused

from wrf_mi.core.array_files import write_arrays


def arrays_in(file: Path) -> dict[str, np.ndarray]:
    with np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def rows_of(file: Path) -> list[dict[str, str]]:
    """Rows of a table in CSV."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def positions_file(file: Path, tx_pos_m: Any, heading_rad: np.ndarray | None = None) -> Path:
    """Positions of transmitters for `wrf-mi predict`, as CSV or npz by the file's name."""
    headings: dict[str, Any] = {} if heading_rad is None else {"heading_rad": heading_rad}
    if file.suffix == ".npz":
        write_arrays(file, {"tx_pos": tx_pos_m} | headings)
    else:
        table = np.column_stack([tx_pos_m, *headings.values()])
        np.savetxt(file, table, "%.17g", ",", header=",".join(["x,y,z", *headings]), comments="")
    return file


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    out: str
    err: str


class Command:
    """Runs the words of a command."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, words: list[Any]) -> Ended:
        return Ended(*call(words, self._capsys))

    def done(self, words: list[Any]) -> str:
        """Standard output of a command that succeeds."""
        ended = self(words)
        assert ended.status == 0, (words, ended.err)
        return ended.out

    def json(self, words: list[Any]) -> Any:
        """What a command that succeeds prints with ``--json``."""
        return json.loads(self.done([*words, "--json"]))

    def predicted(self, run: Path, positions: Path) -> dict[str, np.ndarray]:
        """What `wrf-mi predict` writes at positions in a file; it says nothing on standard error."""
        out, option = positions.with_name("predicted.npz"), "--input" if positions.suffix == ".npz" else "--tx"
        status, _, err = self(["predict", run, option, positions, "--out", out])
        assert (status, err) == (0, "")
        return arrays_in(out)

    def refused(self, words: list[Any], message: str) -> None:
        """The command prints one line with the error, and nothing else."""
        refused(words, message, self._capsys)
