"""Training curves for TensorBoard, written beside ``log.jsonl`` where the package ``tensorboard`` is installed.

Format: TensorFlow's TFRecord of `Event` messages, one file for each fit; ``tensorboard --logdir RUN`` shows those of
all its folds and options while they are trained.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

EVENTS = "events.out.tfevents.training"  # TensorBoard finds files by the part of the name before the last dot


@cache
def available() -> bool:
    """Whether TensorBoard is installed; a folder of that name, which Python also imports, is not it."""
    return find_spec("tensorboard") is not None and find_spec("tensorboard.compat") is not None


def append_event(folder: Path, entry: Mapping[str, Any]) -> None:
    """Add the numbers of a line of the log, at its ``step``."""
    if available():
        from tensorboard.compat.proto.summary_pb2 import Summary

        named = {name: value for name, value in entry.items() if name != "step" and type(value) in (int, float)}
        values = [Summary.Value(tag=name, simple_value=value) for name, value in named.items()]
        _write(folder, step=entry["step"], summary=Summary(value=values))


def restart(folder: Path, step: int) -> None:
    """State that values after a step are to be dropped: a fit resumes there."""
    if (folder / EVENTS).is_file() and available():
        from tensorboard.compat.proto.event_pb2 import SessionLog

        _write(folder, step=step + 1, session_log=SessionLog(status=SessionLog.START))


def _write(folder: Path, **content: Any) -> None:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.summary.writer.record_writer import RecordWriter

    new = not (folder / EVENTS).exists()
    with (folder / EVENTS).open("ab") as file:
        writer, now = RecordWriter(file), time.time()
        if new:
            writer.write(Event(wall_time=now, file_version="brain.Event:2").SerializeToString())
        writer.write(Event(wall_time=now, **content).SerializeToString())
