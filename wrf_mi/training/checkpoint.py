"""Files of a training run in progress: whole at any moment, also on a full disk.

checkpoint.npz  format version, parameters, optimiser state and training time; arrays only
log.jsonl       a line each ``log_every`` steps: step, seconds, loss, validation_score, held_out, gaussians, and of
                scored rows validation_rows, validation_m, test_m, far_score, far_rows
                (`wrf_mi.training.loop.Progress`)
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.array_files import stored_arrays, under, write_arrays
from ..core.files import append_line, readable, write_atomically
from .events import append_event, restart

if TYPE_CHECKING:
    from .loop import Progress, TrainingLoop

logger = logging.getLogger(__name__)

FORMAT = 8  # version of ``checkpoint.npz``
GROUPS = ("param", "mean", "first", "second")
"""Groups of arrays with equal names and shapes: parameters, their running mean, and Adam's moments."""
CHECKPOINT, LOG = "checkpoint.npz", "log.jsonl"


def write_checkpoint(folder: Path, loop: TrainingLoop, beside: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write ``checkpoint.npz``, with further arrays ``beside`` the loop's state."""
    header = {"format": np.asarray(FORMAT), "seconds": np.asarray(loop.seconds)}
    write_arrays(folder / CHECKPOINT, {**loop.state.arrays(), **header, **(beside or {})}, checksum=True)


def read_checkpoint(folder: Path) -> dict[str, NDArray[Any]]:
    """Arrays of ``checkpoint.npz`` (InputError: missing, damaged, or of another format version)."""
    path = folder / CHECKPOINT
    missing = f"{folder}: no {CHECKPOINT}, the run was stopped early; go on with train --resume"
    with readable(path, missing, "restore it or train anew"):
        arrays = stored_arrays(path)
        version = int(arrays["format"])
    if version != FORMAT:
        raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
    # A fit may go back to its best state, which has arrays of its own.
    for lead in ("", "best/"):
        _check_state(path, arrays, lead)
    return arrays


def _check_state(path: Path, arrays: Mapping[str, NDArray[Any]], lead: str) -> None:
    """Refuse parameters, means and moments that do not fit together or are not finite; keys begin with ``lead``."""
    shapes = {}
    for group in GROUPS:
        start = f"{lead}{group}/"
        of_group = under(start, arrays)
        shapes[group] = {name: values.shape for name, values in of_group.items()}
        # The backend ends the process on arrays of other types and shapes than it was recorded with.
        for name, values in of_group.items():
            if values.dtype != np.float32 or not np.isfinite(values).all():
                raise InputError(f"{path}: {start}{name} is not finite in single precision; train the run anew")
        if shapes[group] != shapes[GROUPS[0]]:
            raise InputError(f"{path}: {start}* has other shapes than {lead}{GROUPS[0]}/*; train the run anew")
    gaussians = shapes[GROUPS[0]].get("position", (3, 0))[-1]
    if (norm := arrays.get(f"{lead}view_gradient_norm")) is not None and norm.shape != (max(gaussians, 1),):
        raise InputError(f"{path}: {lead}view_gradient_norm has shape {norm.shape}; train the run anew")


def checkpoint_seconds(folder: Path) -> float:
    """Training time up to the checkpoint in a folder, 0 without one; errors as `read_checkpoint`."""
    return float(read_checkpoint(folder)["seconds"]) if (folder / CHECKPOINT).exists() else 0.0


def append_log(folder: Path, progress: Progress) -> None:
    """Add a line to ``log.jsonl``."""
    entry = asdict(progress)
    del entry["left_s"], entry["label"]
    if progress.validation_score is not None and math.isnan(progress.validation_score):
        entry["validation_score"] = None  # there are no validation rows, and JSON has no NaN
    append_line(folder / LOG, json.dumps(entry))
    append_event(folder, entry)


def cut_log(folder: Path, step: int) -> None:
    """Drop lines after ``step``, the step of the checkpoint from which a run resumes, and damaged ones (logged)."""
    path = folder / LOG
    if not path.is_file():
        return
    restart(folder, step)
    written = [line for line in path.read_bytes().splitlines() if line]
    steps = [_step_of(line) for line in written]
    if damaged := steps.count(None):
        logger.warning("%s: %d damaged lines left out", path, damaged)
    # A run that is resumed takes these steps again, and would otherwise write their lines twice.
    lines = [line + b"\n" for line, at in zip(written, steps, strict=True) if at is not None and at <= step]
    write_atomically(path, b"".join(lines))


def _step_of(line: bytes) -> int | None:
    try:
        at = json.loads(line)["step"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return at if isinstance(at, int) else None
