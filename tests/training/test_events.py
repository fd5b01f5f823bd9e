"""Training curves that TensorBoard reads."""

import json
from pathlib import Path

import pytest

from wrf_mi.training.checkpoint import LOG, append_log, cut_log
from wrf_mi.training.loop import Progress

reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")


def test_curves_are_those_of_the_log_also_after_a_resumption(tmp_path: Path) -> None:
    def log(step: int, loss: float) -> None:
        append_log(tmp_path, Progress(step, float(step), loss, None, held_out=False, gaussians=3, left_s=1.0))

    for step, loss in ((10, 0.5), (20, 0.25), (30, 0.125)):
        log(step, loss)
    cut_log(tmp_path, 10)  # stopped before the checkpoint after step 10
    log(20, 0.75)
    events = reader.EventAccumulator(str(tmp_path))
    events.Reload()
    expected = [(line["step"], line["loss"]) for line in map(json.loads, (tmp_path / LOG).read_text().splitlines())]
    assert [(event.step, event.value) for event in events.Scalars("loss")] == expected == [(10, 0.5), (20, 0.75)]
    assert "validation_score" not in events.Tags()["scalars"]
