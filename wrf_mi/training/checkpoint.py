"""Files of a training run in progress, each written atomically.

checkpoint.npz  format version, parameters, optimiser state and training time; arrays only
log.jsonl       a line each ``log_every`` steps: step, seconds, loss, validation_score, held_out, gaussians
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.files import readable, stored_arrays, write_arrays, write_atomically

if TYPE_CHECKING:
    from .loop import Progress, TrainingLoop

FORMAT = 6
"""Version of ``checkpoint.npz``."""
CHECKPOINT, LOG = "checkpoint.npz", "log.jsonl"


def write_checkpoint(folder: Path, loop: TrainingLoop, beside: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write ``checkpoint.npz``, with further arrays ``beside`` the loop's state."""
    header = {"format": np.asarray(FORMAT), "seconds": np.asarray(loop.seconds)}
    write_arrays(folder / CHECKPOINT, {**loop.state.arrays(), **header, **(beside or {})})


def read_checkpoint(folder: Path) -> dict[str, NDArray[Any]]:
    """Arrays of ``checkpoint.npz``.

    Raises:
        InputError: missing, damaged, or of another format version.
    """
    path = folder / CHECKPOINT
    missing = f"{folder}: no {CHECKPOINT}, the run was stopped early; go on with train --resume"
    with readable(path, missing, "restore it or train anew"):
        arrays = stored_arrays(path)
        version = int(arrays["format"])
    if version != FORMAT:
        raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
    return arrays


def checkpoint_seconds(folder: Path) -> float:
    """Training time up to the checkpoint in a folder; 0 without a checkpoint.

    Raises:
        InputError: damaged, or of another format version.
    """
    return float(read_checkpoint(folder)["seconds"]) if (folder / CHECKPOINT).exists() else 0.0


def append_log(folder: Path, progress: Progress) -> None:
    """Add a line to ``log.jsonl``."""
    entry = asdict(progress)
    del entry["left_s"], entry["label"]
    if progress.validation_score is not None and math.isnan(progress.validation_score):
        entry["validation_score"] = None  # there are no validation rows, and JSON has no NaN
    with (folder / LOG).open("a") as stream:
        stream.write(json.dumps(entry) + "\n")


def cut_log(folder: Path, step: int) -> None:
    """Drop lines after ``step``, the step of the checkpoint from which a run resumes."""
    path = folder / LOG
    if path.is_file():
        lines = [line for line in path.read_text().splitlines() if line and json.loads(line)["step"] <= step]
        write_atomically(path, "".join(f"{line}\n" for line in lines))
